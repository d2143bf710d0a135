"""From scan files to the petals of a flower folder."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from scanning.clean import Cleaned, Cleaning, clean
from scanning.errors import PetalError, ScanError
from scanning.formats import read_range_image
from scanning.formats.ply import write_mesh
from scanning.mesh import TriangleMesh
from scanning.petal import Petal, measure_petal
from scanning.triangulate import triangulate


class ImportFailed(ScanError):
    """Some scans could not be made petals; the others were. `errors` has them by file."""

    def __init__(self, errors: Mapping[str, ScanError]) -> None:
        super().__init__(f"{len(errors)} scans could not be made petals:\n  " + "\n  ".join(str(error) for error in errors.values()))
        self.errors = dict(errors)


@dataclass(frozen=True, eq=False)
class ImportedPetal:
    """A petal as it was written.

    Attributes
    ----------
    name : str
        Name of the petal, the scan's file name without its endings.
    file : Path
        The scan.
    folder : Path
        Where the petal was written.
    mesh : TriangleMesh
        Scan frame, mm, normals to the inner face's side.
    petal : Petal
        Base, tip, frame, inflection.
    cleaned : Cleaned
        The scan after cleaning.
    quality : dict
        Figures of the quality table.
    """

    name: str
    file: Path
    folder: Path
    mesh: TriangleMesh
    petal: Petal
    cleaned: Cleaned
    quality: dict[str, float | int]


def import_scans(
    files: Iterable[str | Path],
    flower_dir: str | Path,
    *,
    name: str = "",
    simulated: bool = False,
    source: str = "",
    unit: str = "mm",
    cleaning: Cleaning | None = None,
    bases: Mapping[str, Sequence[float]] | None = None,
    pictures: bool = True,
    progress: Callable[[int, int, str], None] = lambda done, total, petal: None,
) -> list[ImportedPetal]:
    """Clean, triangulate and measure scans, and write each as a petal of a flower folder.

    Parameters
    ----------
    files : iterable of paths
        Scans, one petal each; `P01.abs` becomes petal P01. A petal of that name in the folder is replaced, once the new one is complete.
    flower_dir : path
        The flower's folder; made where it is missing.
    name : str
        Name of the flower; the folder's by default.
    simulated : bool
        Whether the scans are of virtual petals; pictures then say SIMULATED.
    source : str
        Where the scans come from, in the user's words.
    unit : str
        Unit of the files' coordinates.
    cleaning : Cleaning, optional
        Thresholds of the cleaning.
    bases : mapping of petal name to (x, y), optional, mm
        Bases of petals whose claw cannot be recognised, scan frame.
    pictures : bool
        Whether to draw each petal; most of the time goes into that.
    progress : callable
        Called before each petal and at the end with the count done, the count of all, and the petal's name (empty at the end).

    Returns
    -------
    list of ImportedPetal
        In the order of the files.

    Raises
    ------
    ScanError
        Where there is nothing to import or names clash, before anything is written; or where a scan failed, after the others were written
        (ImportFailed where several did).
    """
    paths = [Path(file) for file in files]
    names = [petal_name(path) for path in paths]
    bases = bases or {}
    if not paths:
        raise ScanError("no scans to import", expected="files like P01.abs")
    for petal in sorted({n for n in names if names.count(n) > 1}):
        raise ScanError(f"several scans are called {petal}", file=flower_dir, expected="one file for each petal", hint="Rename one")
    for petal in sorted(bases.keys() - set(names)):
        raise PetalError("a base is given for it, but it is not among the scans", file=petal, expected=f"one of {', '.join(names)}")
    folder = Path(flower_dir)
    try:
        (folder / "petals").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ScanError(f"cannot be made a folder: {error}", file=flower_dir) from error
    imported, errors = [], {}
    for done, (path, petal) in enumerate(zip(paths, names, strict=True)):
        progress(done, len(paths), petal)
        try:
            imported.append(_import(path, petal, folder / "petals", unit, cleaning or Cleaning(), bases.get(petal), pictures, simulated))
        except ScanError as error:
            errors[str(path)] = error
    progress(len(paths), len(paths), "")
    if imported:
        text = [
            f"name = {quoted(name or folder.resolve().name)}",
            f"simulated = {str(simulated).lower()}",
            'units = "mm"',
            f"source = {quoted(source)}",
        ]
        (folder / "flower.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    if errors:
        raise next(iter(errors.values())) if len(errors) == 1 else ImportFailed(errors)
    return imported


def petal_name(path: Path) -> str:
    """Name of the petal a file holds: its own, without endings."""
    stem = path.name.split(".")[0]
    if not stem or not all(c.isalnum() or c in "-_" for c in stem):
        raise ScanError(f"{stem!r} cannot be the name of a petal", file=path, expected="letters, digits, - and _", hint="Rename the file")
    return stem


def _import(
    path: Path, name: str, petals: Path, unit: str, cleaning: Cleaning, base: Sequence[float] | None, pictures: bool, simulated: bool
) -> ImportedPetal:
    image = read_range_image(path, unit=unit)
    cleaned = clean(image, cleaning)
    mesh = triangulate(cleaned.image, cleaned.jump)
    petal = measure_petal(mesh, name=name, file=str(path), base=base)
    quality: dict[str, float | int] = {
        "points_measured": int(image.valid.sum()),
        "points": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "holes": petal.holes,
        **{f"removed_{reason}": count for reason, count in cleaned.removed.items()},
        "closed_notches": cleaned.closed_notches,
        "removed_loose": int(cleaned.image.valid.sum()) - len(mesh.vertices),
        "roughness_mm": cleaned.roughness,
        "quantum_mm": cleaned.quantum,
        "jump_mm": cleaned.jump,
        "step_mm": image.step,
        "area_mm2": petal.area,
        "rim_length_mm": petal.rim_length,
        "narrowness": petal.narrowness,
    }
    result = ImportedPetal(name, path, petals / name, mesh, petal, cleaned, quality)
    _write(result, cleaning, unit, pictures, simulated)
    return result


def _write(result: ImportedPetal, cleaning: Cleaning, unit: str, pictures: bool, simulated: bool) -> None:
    """Write a petal beside its place and move it there when it is whole."""
    new = result.folder.with_name(f".{result.name}.new")
    try:
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        write_mesh(new / "mesh.ply", result.mesh, comment=f"petal {result.name}, scan frame" + (", SIMULATED" if simulated else ""))
        (new / "petal.toml").write_text(petal_toml(result, cleaning, unit), encoding="utf-8")
        if pictures:
            from scanning.picture import draw_petal  # matplotlib is slow to load

            draw_petal(new / "picture.png", result.mesh, result.petal, name=result.name, simulated=simulated)
        shutil.rmtree(result.folder, ignore_errors=True)
        new.rename(result.folder)
    except OSError as error:
        raise ScanError(f"cannot be written: {error}", file=result.folder, hint="Check the folder and the space on the disk") from error


def petal_toml(result: ImportedPetal, cleaning: Cleaning, unit: str) -> str:
    """Text of `petal.toml`: lengths in mm, scan frame."""
    petal = result.petal
    lines = [
        f"name = {quoted(result.name)}",
        f"base = {_row(petal.base)}",
        f"tip = {_row(petal.tip)}",
        "T_scan_petal = [",
        *(f"  {_row(row)}," for row in petal.T_scan_petal),
        "]",
        "",
        "[inflection]",
        f"point = {_row(petal.inflection)}",
        f"direction = {_row(petal.direction)}",
        f"changes_sign = {str(petal.changes_sign).lower()}  # false: the midrib bends one way only, this is the middle of its length",
        "",
        "[quality]",
        *(f"{key} = {value if isinstance(value, int) else repr(float(value))}" for key, value in result.quality.items()),
        "",
        "[provenance]",
        f"file = {quoted(str(result.file))}",
        f"sha256 = {quoted(hashlib.sha256(result.file.read_bytes()).hexdigest())}",
        f"unit = {quoted(unit)}",
        "",
        "[cleaning]",
        *(f"{key} = {value!r}" for key, value in asdict(cleaning).items() if value is not None),
    ]
    return "\n".join(lines) + "\n"


def quoted(text: str) -> str:
    """Text as a TOML basic string."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _row(values: np.ndarray) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
