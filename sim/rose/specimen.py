"""A folder of files, as if a flower had been measured and taken apart on the bench."""

import json
from pathlib import Path

import numpy as np

from sim.rose.arrangement import Rose, grow, t_flower_scan
from sim.rose.files import write_abs, write_ply
from sim.rose.mesh import apply, inverse
from sim.rose.placement import measure, toml
from sim.rose.scanner import RangeFinder, lay_down, scan


def write_specimen(
    folder: Path,
    petals: int,
    opening: float = 0.5,
    seed: int = 0,
    *,
    finder: RangeFinder | None = None,
    angle_sd: float = 3.0,
    base_sd: float = 1.0,
    triangles: int = 12_500,
    meshes: bool = True,
) -> Rose:
    """Grow a rose, measure it, take it apart and scan its petals.

    Writes P01.abs, P02.abs, ... (range images), placement.toml (measured, with errors), truth.json, and P01.ply, ... (true meshes in the
    scan frame) if `meshes`.

    Parameters
    ----------
    folder
        Made if it is not there; files of the same names are replaced.
    petals, opening, seed, triangles
        As for `grow`.
    finder
        The range finder; its defaults if None.
    angle_sd, base_sd
        Errors of the placement, degrees and mm.
    meshes
        Whether to write the true meshes.

    Returns
    -------
    The rose, flower frame.

    Raises
    ------
    RoseError
        As `grow`, `measure` and `lay_down`.
    """
    finder = finder or RangeFinder()
    rose = grow(petals, opening=opening, seed=seed, triangles=triangles)
    name = f"virtual rose, {petals} petals, opening {opening:g}, seed {seed}"
    placement = measure(rose, seed=seed, angle_sd=angle_sd, base_sd=base_sd)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "placement.toml").write_text(toml(placement, name), encoding="utf-8")
    truth: dict[str, object] = {}
    for number, petal in enumerate(rose.petals):
        rng = np.random.default_rng([seed, 2, number])
        t_flower_petal = petal.t_flower_petal()
        t_scan_petal = lay_down(petal.mesh, t_flower_petal, finder, rng)
        place = t_flower_scan(petal, t_scan_petal)
        laid = petal.mesh.moved(inverse(place))
        image = scan(laid, finder, rng)
        write_abs(folder / f"{petal.name}.abs", image)
        if meshes:
            write_ply(folder / f"{petal.name}.ply", laid)
        base, inflection, tip = apply(inverse(place), petal.midrib_points())
        truth[petal.name] = {
            "scan": f"{petal.name}.abs",
            "mesh": f"{petal.name}.ply" if meshes else None,
            "T_flower_scan": place.tolist(),
            "T_scan_petal": t_scan_petal.tolist(),
            "stem_angle": petal.form.stem_angle,
            "azimuth": petal.form.azimuth,
            "base_radius": petal.form.base_radius,
            "base_height": petal.form.base_height,
            "left": {"petal": petal.left.petal, "side": petal.left.side},
            "right": {"petal": petal.right.petal, "side": petal.right.side},
            "base": base.tolist(),
            "inflection": inflection.tolist(),
            "tip": tip.tolist(),
            "points": int(image.valid.sum()),
            "mixed": int(image.mixed.sum()),
            "hidden": int(image.hidden.sum()),
            "step": image.step,
        }
    record = {
        "name": name,
        "units": "mm, degrees",
        "petals": truth,
        "order": [petal.name for petal in rose.petals],
        "order_note": "from the outermost to the innermost",
        "seed": seed,
        "opening": opening,
        "triangles": triangles,
    }
    (folder / "truth.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return rose
