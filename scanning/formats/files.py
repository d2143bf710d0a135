"""What the readers share: bytes of a file, numbers in text, and a grid whose rows and columns are not the wrong way round."""

from __future__ import annotations

import gzip
import warnings
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanning.errors import FormatError, ScanError
from scanning.rangeimage import Array, neighbour_distances

# Rows and columns are taken to be swapped when that brings points of one column this many times nearer to each other. Read the wrong way
# round, a grid puts points below each other that lie a row and a column apart, or two rows, or more.
_NEARER = 1.1
_LEAST_PAIRS = 50
_FARTHEST = 1e5  # mm from the scan frame's origin; VIVID's mark of an invalid point, -999999, is beyond it in every unit

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}


def millimetres(unit: str) -> float:
    """Length of a unit in mm; FormatError for an unknown one."""
    if unit not in MILLIMETRES:
        raise FormatError(f"unknown unit {unit!r}", expected=f"one of {', '.join(MILLIMETRES)}")
    return MILLIMETRES[unit]


def content(path: str | Path) -> bytes:
    """Bytes of a file, unpacked where it is gzip'ed; ScanError where it cannot be read."""
    try:
        data = Path(path).read_bytes()
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError, zlib.error) as error:
        raise ScanError(f"cannot be read: {error}", file=path, hint="Check the name, or copy the file again") from error


def numbers(text: bytes, path: str | Path, line: int) -> NDArray[np.float64]:
    """Numbers of a text separated by white space, shape (n,); FormatError naming file and line where there is something else."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            # Bytes beyond ASCII would be decoded as UTF-8 by NumPy; they are no numbers anyway.
            return np.fromstring(text.decode("ascii"), sep=" ")
        except (DeprecationWarning, ValueError):
            pass
    for row, words in enumerate(text.split(b"\n"), start=line):
        for word in words.split():
            try:
                float(word)
            except ValueError:
                raise FormatError(
                    f"{word[:40].decode('ascii', 'backslashreplace')!r} where a number should be", file=path, line=row
                ) from None
    raise FormatError("numbers that cannot be read", file=path, line=line)


def refuse_absurd(points: Array, valid: NDArray[np.bool_], scale: float, path: str | Path, *, first_line: int | None = None) -> None:
    """Raise where a valid coordinate, shape (n, 3), is not finite or, times the scale, beyond any scanner's reach.

    With `first_line`, the axes stand in the file's lines from there on, one each.
    """
    with np.errstate(invalid="ignore"):
        broken = np.argwhere(valid[:, None] & ~(np.abs(points) < _FARTHEST / scale))
    if len(broken):
        point, axis = (int(k) for k in broken[0])
        raise FormatError(
            f"point {point} is valid but its {'XYZ'[axis]} is {points[point, axis]:g}",
            file=path,
            line=None if first_line is None else first_line + axis,
            expected=f"less than {_FARTHEST / scale:g}",
            hint="The file is damaged, or in another unit",
        )


def refuse_swapped(
    points: Array, valid: NDArray[np.bool_], height: int, width: int, path: str | Path, *, line: int | None = None, where: str
) -> None:
    """Raise where points of one column lie farther apart as the header has it than with rows and columns swapped.

    Parameters
    ----------
    points, valid : ndarray, shapes (height * width, 3), (height * width,)
        In the file's order.
    line, where
        The header's line, and what to exchange, for the message.

    Raises
    ------
    FormatError
        Where rows and columns seem swapped.
    """

    def apart(rows: int, columns: int) -> tuple[float, int]:
        distances = neighbour_distances(points.reshape(rows, columns, 3), valid.reshape(rows, columns), 0)
        return (float(np.median(distances)), distances.size) if distances.size else (np.inf, 0)

    if height == width or min(height, width) < 2:
        return
    (said, _), (swapped, pairs) = apart(height, width), apart(width, height)
    if pairs >= _LEAST_PAIRS and said > _NEARER * swapped:
        raise FormatError(
            f"rows and columns seem swapped: points below each other are {said:.3g} mm apart as the header's {height} rows and {width}"
            f" columns, and {swapped:.3g} mm as {width} rows and {height} columns",
            file=path,
            line=line,
            expected="neighbours on the grid that are neighbours in space",
            hint=f"Exchange {where}",
        )
