"""The flower on a page: what the editor asks about its petals, what it saves, and what the viewer says."""

import json
import math
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.files import write_atomically

if TYPE_CHECKING:
    from render.editor import Editor
    from render.viewer import Page
    from rig.fits import StoredFit
    from scanning.assemble import Assembly
    from scanning.flower import PetalScan
    from scanning.placement import Placement
    from scanning.terms import Habit

Array = NDArray[np.float64]
Poses = dict[str, Array]

LOOKED_AT = 500  # vertices of each petal, to tell which of two is inside


@dataclass(frozen=True)
class HandFlower:
    """A flower to be put right by hand.

    Attributes
    ----------
    folder : Path
    petals : mapping of name to the petal as scanned
    placement : Placement
        What was measured.
    start : mapping of name to T_flower_scan (4, 4)
        Of `assembly.json`, else what the measurements alone give.
    table : dict or None
        `assembly.json` as it was found.
    habit : Habit
        What is assumed of the flower: as it was when it was assembled.
    """

    folder: Path
    petals: "Mapping[str, PetalScan]"
    placement: "Placement"
    start: Poses
    table: dict[str, Any] | None
    habit: "Habit"
    # Open3D's scenes are made when first asked for: by the thread that looks for collisions, or by the one that saves.
    _one_at_a_time: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    @property
    def names(self) -> list[str]:
        """The petals' names, sorted."""
        return list(self.petals)

    def angles(self, name: str, T_flower_scan: Array) -> tuple[float, float]:
        """Return stem angle and azimuth, degrees, of a petal that lies at `T_flower_scan`."""
        from scanning.poses import AZIMUTH, stem_angles

        q = self._coordinates(name, T_flower_scan)
        stem_angle = stem_angles(q[None], self.petals[name].inflection[None])[0]
        return math.degrees(stem_angle), math.degrees(q[AZIMUTH]) % 360

    def turned(self, name: str, T_flower_scan: Array, stem_angle: float, azimuth: float) -> Array:
        """Return T_flower_scan of a petal brought from where it lies to other angles, degrees.

        Its base's place along, beside and above the receptacle stays, and so does its roll.

        Raises
        ------
        RunError
            No tilt of the petal, rolled as it is, has that stem angle.
        """
        from scanning.poses import AZIMUTH, TILT, inverse, petal_poses

        q = self._coordinates(name, T_flower_scan)
        q[TILT] = self._tilt(name, q, stem_angle)
        q[AZIMUTH] = math.radians(azimuth)
        return petal_poses(q[None])[0] @ inverse(self.petals[name].T_scan_petal)

    def colliding(self, poses: Poses) -> set[str]:
        """Name the petals that pass through others."""
        from scanning.contact import crossings

        with self._one_at_a_time:
            pierced = crossings([petal.sheet for petal in self.petals.values()], self._stacked(poses))
        return {self.names[k] for pair in pierced for k in pair}

    def assembly(self, poses: Poses) -> "Assembly":
        """Return the flower as it lies: whether petals intersect, clearance, residuals and conflicts, all found anew."""
        from scanning.assemble import judge
        from scanning.terms import measured

        names, petals = self.names, list(self.petals.values())
        sheets, placed = [petal.sheet for petal in petals], self._stacked(poses)
        m = measured(self.placement, names, np.array([petal.inflection for petal in petals]), self.habit)
        stated = self.placement.inside_of()
        known = {(str(a), str(b)) for a, b in self.table.get("inside", [])} if self.table else set()
        ran = {key: self.table[key] for key in ("seed", "seconds") if key in self.table} if self.table else {}
        q = np.array([self._coordinates(name, poses[name]) for name in names])
        with self._one_at_a_time:
            outside = self._contrary(placed)
            pairs = [(names.index(a), names.index(b)) for a, b in (known | set(stated)) - outside]
            found = judge(names, sheets, q, placed, m, pairs, habit=self.habit, **ran)
        return replace(found, conflicts=found.conflicts + _on_wrong_sides([pair for pair in stated if pair in outside]))

    def _coordinates(self, name: str, T_flower_scan: Array) -> Array:
        from scanning.poses import coordinates

        return coordinates((T_flower_scan @ self.petals[name].T_scan_petal)[None])[0]

    def _stacked(self, poses: Poses) -> Array:
        return np.array([poses[name] for name in self.names])

    def _tilt(self, name: str, q: Array, stem_angle: float) -> float:
        """Return the tilt (rad) nearest to the present one that has this stem angle: cos(stem_angle) = reach cos(tilt - lean)."""
        from scanning.poses import ROLL, TILT

        x, y, z = self.petals[name].inflection
        across = z * math.cos(q[ROLL]) - x * math.sin(q[ROLL])
        reach, lean = math.hypot(y, across), math.atan2(across, y)
        cosine = math.cos(math.radians(stem_angle)) / reach
        if abs(cosine) > 1 + 1e-12:
            least = math.degrees(math.acos(reach))
            reached = f"{least:.2f} to {180 - least:.2f} can be reached"
            raise RunError(f"{name}, rolled as it is, cannot have a stem angle of {stem_angle:.1f} deg: {reached}")
        away = math.acos(max(-1.0, min(1.0, cosine)))
        return min((lean + away, lean - away), key=lambda tilt: abs(math.remainder(tilt - q[TILT], math.tau)))

    def _contrary(self, placed: Array) -> set[tuple[str, str]]:
        """Return pairs (a, b) where a, seen along the normals between the two, lies outside b."""
        from scanning.contact import gaps, samples

        sheets = [petal.sheet for petal in self.petals.values()]
        rng = np.random.default_rng(0)
        seen = gaps(sheets, placed, [samples(sheet, LOOKED_AT, rng) for sheet in sheets])
        # A point of i on the inner face's side of j says that i is inside; one of j before i says the contrary.
        total = np.zeros((len(sheets), len(sheets)))
        np.add.at(total, (seen.i, seen.j), seen.height)
        inside = total - total.T
        return {(self.names[i], self.names[j]) for i, j in zip(*np.nonzero(inside < 0), strict=True)}


def open_flower(folder: Path) -> HandFlower:
    """Read a flower: petals, what was measured, and how they lie.

    Raises
    ------
    RunError
        `assembly.json` is of other petals.
    scanning.errors.ScanError
        A file is missing or malformed.
    """
    from scanning.flower import load, read_poses
    from scanning.terms import Habit

    petals, placement = load(folder)
    named = {petal.name: petal for petal in petals}
    path = folder / "assembly.json"
    if not path.exists():
        return HandFlower(folder, named, placement, _as_measured(petals, placement, Habit()), None, Habit())
    poses = read_poses(path)
    if poses.keys() != named.keys():
        raise RunError(
            f"{path}: holds {', '.join(sorted(poses))}, but the flower's petals are {', '.join(named)}: "
            f"rig flower assemble {folder}, or take the file away to begin with the measured poses"
        )
    table = json.loads(path.read_text(encoding="utf-8"))
    try:
        habit = Habit(**table.get("assumed", {}))
    except TypeError as error:
        raise RunError(f"{path}: assumed: {error}; expected what rig flower assemble writes: assemble the flower again") from error
    return HandFlower(folder, named, placement, {name: poses[name] for name in named}, table, habit)


def _as_measured(petals: "Sequence[PetalScan]", placement: "Placement", habit: "Habit") -> Poses:
    from scanning.poses import inverse, petal_poses
    from scanning.terms import measured

    m = measured(placement, [petal.name for petal in petals], np.array([petal.inflection for petal in petals]), habit)
    return {petal.name: T @ inverse(petal.T_scan_petal) for petal, T in zip(petals, petal_poses(m.start()), strict=True)}


class Saving:
    """Keeps what was done by hand as the flower's `assembly.json`."""

    def __init__(self, flower: HandFlower) -> None:
        self._flower, self._last = flower, flower.start

    def __call__(self, poses: Poses) -> str:
        """Write the flower as it lies; returns what there is to say about it."""
        from scanning.flower import write_assembly

        flower = self._flower
        assembly = flower.assembly(poses)
        with tempfile.TemporaryDirectory() as folder:
            draft = Path(folder) / "assembly.json"
            write_assembly(draft, assembly)
            table = json.loads(draft.read_text(encoding="utf-8"))
        moved = [name for name in flower.names if not np.array_equal(poses[name], self._last[name])]
        by_hand = self._by_hand(moved)
        if by_hand:
            table["by_hand"] = by_hand
        path = flower.folder / "assembly.json"
        write_atomically(path, json.dumps(table, indent=1, allow_nan=False) + "\n")
        self._flower, self._last = replace(flower, table=table), {name: T.copy() for name, T in poses.items()}
        return f"{path}, {told_state(table)}"

    def _by_hand(self, moved: list[str]) -> dict[str, Any] | None:
        """Return the mark: what the work by hand began with, and each save with the petals moved since the one before."""
        table = self._flower.table
        if table and not moved:
            return table.get("by_hand")
        mark = (table or {"by_hand": {"began_with": "the measured poses", "saves": []}}).get("by_hand")
        mark = mark or {"began_with": "an assembly", "saves": []}
        return mark | {"saves": [*mark["saves"], {"time": datetime.now(UTC).isoformat(timespec="seconds"), "moved": moved}]}


def edit(folder: Path, *, port: int = 0) -> "tuple[Editor, list[str]]":
    """Serve the editor's page; returns it with what there is to say about the flower.

    Raises
    ------
    RunError, scanning.errors.ScanError
        A file of the flower is missing or malformed.
    render.errors.RenderError
        The optional viewer is not installed, or the port is taken.
    """
    from render.editor import serve_editor
    from rig.pictures import is_simulated

    flower = open_flower(folder)
    notes = ["SIMULATED petals"] if is_simulated(folder) else []
    if flower.table is None:
        notes.append("there is no assembly.json yet: the petals lie as measured")
    page = serve_editor(
        {name: (petal.sheet.vertices, petal.sheet.triangles, flower.start[name]) for name, petal in flower.petals.items()},
        bases={name: petal.T_scan_petal[:3, 3] for name, petal in flower.petals.items()},
        angles=flower.angles,
        turned=flower.turned,
        collisions=flower.colliding,
        save=Saving(flower),
        title=f"Flower {folder.resolve().name}",
        notes=notes,
        port=port,
    )
    return page, notes


def view(folder: Path, fit: "StoredFit | None" = None, *, port: int = 0) -> "tuple[Page, list[str]]":
    """Serve a page with the assembled flower, in the hue of a fit's cultivar; returns it with what there is to say.

    Raises
    ------
    RunError
        The folder is not a flower's.
    render.errors.RenderError
        The flower is not assembled, the optional viewer is not installed, or the port is taken.
    """
    from render.scene import read_flower
    from render.viewer import COLLIDING, serve_viewer
    from rig.pictures import COLOURS, is_simulated

    scene = read_flower(folder)
    table = json.loads((folder / "assembly.json").read_text(encoding="utf-8"))
    petals = {mesh.name: (mesh.vertices, mesh.triangles, np.eye(4)) for mesh in scene.meshes}
    colliding = {name for pair in table.get("intersecting", []) for name in pair if name in petals}
    notes = ["SIMULATED"] if is_simulated(folder) or (fit and fit.simulated) else []
    notes.append(told_state(table) + (" (orange): not usable as it is" if colliding else ""))
    if moved := _moved(table):
        notes.append(f"moved by hand: {', '.join(moved)}")
    hue = COLOURS.get(fit.label) if fit else None
    if fit:
        shown = f"in the hue of {fit.label}" if hue else f"there is no hue for {fit.label}"
        notes.append(f"{shown}, lit for the eye only: the fitted reflectance itself is in the pictures of rig render")
    page = serve_viewer(
        petals,
        title=f"Flower {folder.resolve().name}",
        port=port,
        colours=dict.fromkeys(colliding, COLLIDING),
        hue=hue,
        notes=notes,
    )
    return page, notes


def moved_by_hand(folder: Path) -> list[str]:
    """Return the petals that were moved by hand since the flower was assembled."""
    try:
        table = json.loads((folder / "assembly.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []  # nothing that could be lost
    return _moved(table)


def _moved(table: Mapping[str, Any]) -> list[str]:
    return sorted({name for save in table.get("by_hand", {}).get("saves", []) for name in save["moved"]})


def told_state(table: Mapping[str, Any]) -> str:
    """Say of an `assembly.json` whether its petals intersect."""
    if table.get("state") == "free":
        clearance = table.get("clearance_mm")
        return "no two petals intersect" + (f", clearance {clearance:.3f} mm" if clearance is not None else "")
    pairs = ", ".join("-".join(pair) for pair in table.get("intersecting", []))
    return f"INTERSECTING: {pairs or 'which petals is not told'}"


def _on_wrong_sides(pairs: list[tuple[str, str]]) -> list[str]:
    return [f"{inner} is said to lie inside {outer}, but lies outside of it" for inner, outer in pairs]
