"""Figure 14 in numbers: how the flower's contrast orders the cultivars, and how the readings do."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from rig.fits import ROSE_ASPECT, refitted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from render.camera import Camera
    from render.raycast import Picture, Raycaster
    from rig.fits import StoredFit
    from rig.workspace import Workspace


@dataclass(frozen=True)
class ContrastRow:
    """One cultivar.

    Attributes
    ----------
    label : str
    measured : float
        I(+40)/I(-40) of the readings at 45 deg.
    fitted, C : float
        The same ratio of the fit, and the flower's contrast with it; see `render.contrast.Contrast`.
    fitted_tall, C_tall : float
        Both with the readings fitted by cells as tall as a rose's.
    """

    label: str
    measured: float
    fitted: float
    C: float
    fitted_tall: float
    C_tall: float


def compare(
    raycaster: "Raycaster", camera: "Camera", fits: "Mapping[str, StoredFit]", workspace: "Workspace"
) -> "tuple[dict[str, Picture], list[ContrastRow], float]":
    """Take the picture with each fit and measure its contrast; return the pictures, the rows, and C of a Lambert surface.

    Raises
    ------
    render.errors.RenderError
        If too little of the flower faces the light, or mirrors it, to compare.
    """
    from render import Lambert, measure_contrast
    from rig.pictures import shade_of, take

    pictures, rows = {}, []
    for label, fit in fits.items():
        tall = refitted(fit, ROSE_ASPECT)
        pictures[label], tall_picture = (take(raycaster, camera, shade_of(some, workspace)) for some in (fit, tall))
        C, C_tall = (measure_contrast(picture).C for picture in (pictures[label], tall_picture))
        rows.append(
            ContrastRow(label, _ratio(fit, fit.fit.measured), _ratio(fit, fit.fit.modelled), C, _ratio(tall, tall.fit.modelled), C_tall)
        )
    matt = measure_contrast(take(raycaster, camera, Lambert())).C
    return pictures, rows, matt


def contrast_table(rows: list[ContrastRow], matt: float) -> str:
    """Return the rows as lines, and why orders differ where they do."""
    tall = f"cells of aspect {ROSE_ASPECT:g}"
    lines = [
        f"{'':<6}{'I(+40)/I(-40)':>14}{'fit':>18}{'':>10}{tall:>20}",
        f"{'':<6}{'measured':>14}{'I(+40)/I(-40)':>18}{'C':>10}{'I(+40)/I(-40)':>20}{'C':>10}",
    ]
    lines += [f"{r.label:<6}{r.measured:>14.2f}{r.fitted:>18.2f}{r.C:>10.3f}{r.fitted_tall:>20.2f}{r.C_tall:>10.3f}" for r in rows]
    lines.append(f"C of a Lambert surface in the same pixels: {matt:.3f}")
    turned = _turned(rows, "C")
    if turned:
        lines += [
            f"C orders {turned} otherwise than the readings: C tells only what the fit follows, and a fit that misses the lobe",
            "towards the light (its own I(+40)/I(-40) is near 1) comes out as Lambert's. "
            + (f"With {tall} the order is {'still another' if _turned(rows, 'C_tall') else 'that of the readings'}."),
        ]
    else:
        lines.append("C orders the cultivars as the readings do")
    return "\n".join(lines)


def _turned(rows: list[ContrastRow], by: str) -> str:
    """Name the pairs that are ordered otherwise than by the readings."""
    pairs = [f"{a.label}-{b.label}" for a, b in combinations(rows, 2) if (getattr(a, by) - getattr(b, by)) * (a.measured - b.measured) < 0]
    return ", ".join(pairs)


def _ratio(fit: "StoredFit", values: "NDArray[np.float64]") -> float:
    by_angle = dict(zip(map(round, fit.fit.theta_r_deg), values, strict=True))
    return float(by_angle[40] / by_angle[-40])
