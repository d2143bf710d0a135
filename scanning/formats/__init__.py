"""Files of range images and meshes."""

from __future__ import annotations

from pathlib import Path

from scanning.errors import FormatError
from scanning.rangeimage import RangeImage


def read_range_image(path: str | Path, *, unit: str = "mm") -> RangeImage:
    """Read a range image of any known format, told by its name.

    Parameters
    ----------
    path : str or Path
        `.abs` or `.abs.gz` (VIVID / FRGC ascii) or `.ply` (range grid).
    unit : str
        Unit of the file's coordinates: ``mm``, ``cm``, ``m`` or ``in``. Neither format says.

    Raises
    ------
    ScanError
        Where the file cannot be read, or not as what its name says.
    """
    from scanning.formats import abs as abs_format  # the readers are needed one at a time
    from scanning.formats import ply

    name = Path(path).name.lower()
    if name.endswith((".abs", ".abs.gz")):
        return abs_format.read_abs(path, unit=unit)
    if name.endswith(".ply"):
        return ply.read_range_grid(path, unit=unit)
    raise FormatError(
        "not a known kind of range image",
        file=path,
        expected="a name ending in .abs, .abs.gz or .ply",
        hint="Export .cdm, .cdk or .vvd files from the scanner's own program as .abs",
    )
