"""The folder of a flower: its petals' meshes, how they stand, and the flower put together.

FLOWER/flower.toml, FLOWER/petals/NAME/{mesh.ply, petal.toml}, FLOWER/placement.toml and FLOWER/assembly.json. Scan frames and the
flower's frame in mm, angles in degrees; `T_flower_scan` is [T_i alpha_i] of eq. (14).
"""

import json
import math
import platform
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanning.assemble import MEASUREMENTS, Assembly, Progress, assemble
from scanning.contact import Sheet
from scanning.errors import ScanError
from scanning.placement import Placement, PlacementError, examine
from scanning.poses import Array


class FlowerError(ScanError):
    """A flower folder that lacks something, or holds something that cannot be read."""


@dataclass(frozen=True)
class PetalScan:
    """A petal as it was scanned: mesh in the scan frame, T_scan_petal (4, 4), inflection's direction (3,) in the petal's frame."""

    name: str
    sheet: Sheet
    T_scan_petal: Array
    inflection: Array


def new(folder: Path, name: str, *, source: str = "", simulated: bool = False) -> None:
    """Make an empty flower folder.

    Raises
    ------
    FlowerError
        If there is a flower already.
    """
    if (folder / "flower.toml").exists():
        raise FlowerError("there is a flower already", file=folder, hint="Choose another name")
    (folder / "petals").mkdir(parents=True, exist_ok=True)
    values = {"name": name, "simulated": simulated, "units": "mm", "source": source}
    text = "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())
    (folder / "flower.toml").write_text(text, encoding="utf-8")


def petal_names(folder: Path) -> list[str]:
    """Return the names of the petals that have meshes, sorted."""
    return sorted(path.parent.name for path in folder.glob("petals/*/mesh.ply") if not path.parent.name.startswith("."))


def load_petal(folder: Path, name: str) -> PetalScan:
    """Read one petal of a flower.

    Raises
    ------
    FlowerError
        If its mesh or its frame is missing or makes no sense.
    """
    import open3d as o3d

    where = folder / "petals" / name
    toml, ply = where / "petal.toml", where / "mesh.ply"
    try:
        table = tomllib.loads(toml.read_text(encoding="utf-8"))
        T_scan_petal = np.array(table["T_scan_petal"], float)
        direction = np.array(table["inflection"]["direction"], float)
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        expected = "T_scan_petal (4 rows of 4) and [inflection] direction"
        raise FlowerError(f"cannot be read: {error!r}", file=toml, expected=expected, hint="Import the scan again") from error
    turn = T_scan_petal[:3, :3] if T_scan_petal.shape == (4, 4) else np.zeros((3, 3))
    if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0):
        raise FlowerError("T_scan_petal is not a rigid transform", file=toml, hint="Import the scan again")
    if direction.shape != (3,) or not math.isclose(float(np.linalg.norm(direction)), 1.0, abs_tol=1e-3):
        raise FlowerError("the inflection's direction is not a unit vector", file=toml, hint="Import the scan again")
    if not ply.exists():
        raise FlowerError("no such file", file=ply, hint="Import the scan again")
    mesh = o3d.io.read_triangle_mesh(ply)
    vertices, triangles = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.triangles).astype(np.int64)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise FlowerError("holds no triangles, or corners that are not numbers", file=ply, hint="Import the scan again")
    return PetalScan(name, Sheet(vertices, triangles), T_scan_petal, turn.T @ direction / np.linalg.norm(direction))


def load(folder: Path) -> tuple[list[PetalScan], Placement]:
    """Read the petals of a flower and how they stand.

    Raises
    ------
    PlacementError
        Listing everything that is wrong in `placement.toml`.
    FlowerError
        If there are no petals, or one cannot be read.
    """
    names = petal_names(folder)
    if not names:
        raise FlowerError("no petals", file=folder, expected="petals/NAME/mesh.ply", hint="Import scans first")
    placement, problems = examine(folder / "placement.toml", names)
    if problems:
        raise PlacementError("\n".join(map(str, problems)))
    return [load_petal(folder, name) for name in names], placement


def put_together(folder: Path, *, seed: int = 0, progress: Progress | None = None, **options: Any) -> Assembly:
    """Assemble the flower of a folder and write its `assembly.json`; see `scanning.assemble.assemble` for the options."""
    petals, placement = load(folder)
    names, sheets = [petal.name for petal in petals], [petal.sheet for petal in petals]
    frames, directions = (np.array([getattr(petal, what) for petal in petals]) for what in ("T_scan_petal", "inflection"))
    assembly = assemble(names, sheets, frames, directions, placement, seed=seed, progress=progress, **options)
    write_assembly(folder / "assembly.json", assembly)
    return assembly


def write_assembly(path: Path, assembly: Assembly) -> None:
    """Write a flower put together as JSON; an infinite clearance (a single petal) is written as null."""
    a = assembly
    petals = {
        name: {
            "T_flower_scan": a.poses[k].tolist(),
            "stem_angle": float(a.stem_angle[k]),
            "azimuth": float(a.azimuth[k]),
            "residuals_sd": dict(zip(MEASUREMENTS, a.residuals[k].tolist(), strict=True)),
        }
        for k, name in enumerate(a.names)
    }
    table = {
        "state": a.state,
        "clearance_mm": a.clearance if math.isfinite(a.clearance) else None,
        "petals": petals,
        "inside": [list(pair) for pair in a.pairs],
        "intersecting": [list(pair) for pair in a.intersecting],
        "conflicts": a.conflicts,
        "assumed": asdict(a.habit),
        "seed": a.seed,
        "seconds": round(a.seconds, 2),
        "versions": _versions(),
    }
    path.write_text(json.dumps(table, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_poses(path: Path) -> dict[str, Array]:
    """Return T_flower_scan (4, 4) of each petal in an `assembly.json`.

    Raises
    ------
    FlowerError
        If the file is not one.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        poses = {name: np.array(petal["T_flower_scan"], float) for name, petal in table["petals"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FlowerError(f"cannot be read: {error!r}", file=path, expected="an assembly.json", hint="Assemble the flower again") from error
    if any(pose.shape != (4, 4) or not np.isfinite(pose).all() for pose in poses.values()):
        raise FlowerError("T_flower_scan is not 4 rows of 4 numbers", file=path, hint="Assemble the flower again")
    return poses


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    return {"python": platform.python_version(), **{name: version(name) for name in ("numpy", "scipy", "open3d")}}
