"""Tables as text: what the line-by-line formats share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from fitting.errors import TableError
from fitting.formats import replacing
from fitting.formats.grid import Array

LONGEST_LINE = 1 << 16
"""Characters; what is longer is no line of a table."""


def lines(path: Path | str) -> Iterator[tuple[int, str]]:
    """Read a text file line by line.

    Yields
    ------
    number, line : int, str
        From 1, and without the white space around it. Bytes that are not UTF-8 are passed on as they are: old comments hold them.

    Raises
    ------
    TableError
        If the file cannot be read or is not made of lines.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", errors="surrogateescape") as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ""), 1):
                if len(line) >= LONGEST_LINE or "\0" in line:
                    raise TableError(path, "not a table of text: expected lines of numbers", number)
                yield number, line.strip()
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error


def numbers(path: Path | str, line: int, cells: Sequence[str], names: Sequence[str]) -> list[float]:
    """Read one row of numbers.

    Raises
    ------
    TableError
        With the line, if there are more or fewer than `names`, or one is not a finite number.
    """
    if len(cells) != len(names):
        raise TableError(path, f"{len(cells)} numbers, expected {len(names)}: {', '.join(names)}", line)
    try:
        row = [float(cell) for cell in cells]
        if all(map(math.isfinite, row)) and not any("_" in cell for cell in cells):
            return row
    except ValueError:
        pass
    bad = next(k for k, cell in enumerate(cells) if not _is_number(cell))
    raise TableError(path, f"{names[bad]} is {cells[bad]!a}, expected a finite number", line)


def whole(path: Path | str, line: int, text: str, name: str, most: int) -> int:
    """Read a count, 0 to `most`; TableError with the line if it is none."""
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= most):
        raise TableError(path, f"{name} is {text!a}, expected a whole number of at most {most}", line)
    return int(text)


def write_lines(path: Path | str, written: Iterable[str]) -> None:
    """Write a text file, whole or not at all.

    Raises
    ------
    TableError
        If it cannot be written.
    """
    try:
        with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(line + "\n" for line in written)
    except OSError as error:
        raise TableError(path, f"cannot be written: {error.strerror or error}") from error


def one_line(text: object) -> str:
    """Make a header's value of anything: one line without quotes, of a bounded length."""
    return " ".join(str(text).replace('"', "'").split())[:500]


def once(path: Path | str, directions: Array, rows: Sequence[int]) -> None:
    """Refuse two readings of one geometry.

    Parameters
    ----------
    path : Path or str
        The file.
    directions : ndarray, shape (n, k)
        Angles as the file has them.
    rows : sequence of int
        Line of each.

    Raises
    ------
    TableError
        With the line of the second.
    """
    if not len(directions):
        return
    order = np.lexsort(directions.T[::-1])  # stable: the later line comes second
    same = np.flatnonzero(np.all(np.diff(directions[order], axis=0) == 0, axis=1))
    if same.size:
        first, second = min((rows[order[k]], rows[order[k + 1]]) for k in same)
        raise TableError(path, f"same angles as in line {first}: average the two or leave one out", second)


def require(path: Path | str, rows: Sequence[int], good: np.ndarray, problem: str) -> None:
    """Raise a TableError with the line of the first reading that is not good."""
    if not np.all(good):
        raise TableError(path, problem, rows[int(np.flatnonzero(~good)[0])])


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell)) and "_" not in cell
    except ValueError:
        return False
