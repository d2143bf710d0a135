"""VIVID / FRGC ascii range images, `.abs`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scanning.errors import EmptyScanError, FormatError
from scanning.formats.files import content, millimetres, numbers, refuse_absurd, refuse_swapped
from scanning.rangeimage import RangeImage

NO_POINT = -999999.0
_HEADER = (
    (rb"\s*(\d{1,9})\s+rows\s*", "`H rows`"),
    (rb"\s*(\d{1,9})\s+columns\s*", "`W columns`"),
    (rb"\s*pixels\s*\(.*\)\s*:?\s*", "`pixels (flag X Y Z):`"),
)
_LINES = ("flags", "X", "Y", "Z")


def read_abs(path: str | Path, *, unit: str = "mm") -> RangeImage:
    """Read an `.abs` file: three header lines, then flags, X, Y and Z, one line each, row by row.

    Parameters
    ----------
    path : str or Path
        The file; may be gzip'ed.
    unit : str
        Unit of its coordinates; the format names none, VIVID writes mm.

    Raises
    ------
    FormatError
        Where a line is missing, has too many or too few values or text among them, or where rows and columns are swapped.
    EmptyScanError
        Where no point is valid.
    """
    scale = millimetres(unit)
    lines = content(path).rstrip().split(b"\n")
    sizes = []
    for row, (pattern, expected) in enumerate(_HEADER):
        seen = lines[row] if row < len(lines) else b""
        match = re.fullmatch(pattern, seen)
        if match is None:
            raise FormatError(f"header is {seen[:40].decode('ascii', 'backslashreplace')!r}", file=path, line=row + 1, expected=expected)
        sizes += [int(group) for group in match.groups()]
    height, width = sizes
    if not (height and width):
        raise FormatError(f"a grid of {height} rows and {width} columns", file=path, line=1, expected="at least one of each")
    if len(lines) != 7:
        raise FormatError(
            f"{len(lines) - 3} lines of values",
            file=path,
            line=len(lines),
            expected="four: flags, X, Y, Z",
            hint="The file is cut off; copy or export it again" if len(lines) < 7 else "The file goes on after its last line",
        )
    values = []
    for row, name in enumerate(_LINES, start=4):
        found = numbers(lines[row - 1], path, row)
        if found.size != height * width:
            raise FormatError(
                f"{found.size} values of {name}",
                file=path,
                line=row,
                expected=f"{height} x {width} = {height * width}",
                hint="The file is cut off, or its header does not belong to it",
            )
        values.append(found)
    flags = values[0]
    strange = np.flatnonzero((flags != 0) & (flags != 1))
    if strange.size:
        raise FormatError(f"flag {flags[strange[0]]:g} of point {strange[0]}", file=path, line=4, expected="0 or 1")
    valid = flags == 1
    if not valid.any():
        raise EmptyScanError(
            f"none of the {height * width} points is valid", file=path, line=4, hint="Scan again, nearer or with more light returned"
        )
    points = np.stack(values[1:], axis=-1)
    refuse_absurd(points, valid, scale, path, first_line=5)
    points[~valid] = np.nan
    points *= scale
    refuse_swapped(points, valid, height, width, path, line=1, where="the numbers of lines 1 and 2")
    return RangeImage(points.reshape(height, width, 3), valid.reshape(height, width), str(path))


def write_abs(path: str | Path, image: RangeImage) -> None:
    """Write a range image as `.abs`, with six decimals, mm."""
    height, width = image.shape
    flat = np.where(image.valid[..., None], image.points, NO_POINT).reshape(-1, 3)
    rows = [" ".join(np.where(image.valid.ravel(), "1", "0"))] + [" ".join(f"{value:.6f}" for value in flat[:, axis]) for axis in range(3)]
    Path(path).write_text("\n".join([f"{height} rows", f"{width} columns", "pixels (flag X Y Z):", *rows]) + "\n", encoding="ascii")
