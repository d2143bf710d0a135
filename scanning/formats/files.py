"""What the readers share: bytes of a file, and numbers in text."""

from __future__ import annotations

import gzip
import warnings
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanning.errors import FormatError, ScanError

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
