"""One file for arrays and what they are: .npz, with the sum of its content (SHA-256), checked when it is read."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.errors import DomainError, TableError

ABOUT = "about"
"""Member that holds, as JSON, the format, what the caller says of the arrays, and the sum."""

DAMAGE = (OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, MemoryError, struct.error, zipfile.BadZipFile, zlib.error)
"""What reading a foreign, cut or changed file may raise."""


def write(path: str | Path, format: str, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays and what they are to one file.

    Parameters
    ----------
    path : str or Path
        The file; what is there is replaced.
    format : str
        Name and version of what the arrays make up: `read` takes no other.
    about : mapping
        What JSON can hold.
    arrays : mapping of str to ndarray
        Numbers or truth values, under any names but `ABOUT`.

    Raises
    ------
    DomainError
        If `about` or an array is nothing that such a file can hold.
    """
    for name, array in arrays.items():
        if not name or name == ABOUT or array.dtype.kind not in "biuf":
            raise DomainError(
                f"{path}: an array {name!r} of {array.dtype} cannot be stored; expected numbers, and another name than {ABOUT!r}"
            )
    try:
        known = json.dumps({"format": format, "about": about, "sha256": _sum(format, about, arrays)}, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise DomainError(f"{path}: what is said about the arrays must be what JSON can hold: {error}") from error
    members: dict[str, Any] = {**arrays, ABOUT: np.array(known)}
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **members)


def read(path: str | Path, format: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read a file that `write` wrote.

    Parameters
    ----------
    path : str or Path
        The file.
    format : str
        As it was given to `write`.

    Returns
    -------
    about : dict
        As JSON gives it back: tuples have become lists.
    arrays : dict of str to ndarray

    Raises
    ------
    TableError
        If the file cannot be read, is of another format, or its content is not what was written.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files if name != ABOUT}
            known = json.loads(str(stored[ABOUT]))
        if known["format"] != format:
            raise ValueError(f"its format is {known['format']!r}")
        if known["sha256"] != _sum(format, known["about"], arrays):
            raise ValueError("its content is not what was written: the sums (SHA-256) differ")
        about = dict(known["about"])
    except DAMAGE as error:
        raise TableError(path, f"not a file of the format {format!r} ({type(error).__name__}: {error}): make it again") from error
    return about, arrays


def _sum(format: str, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of all that a file holds, whatever the machine's order of bytes."""
    found = hashlib.sha256(json.dumps([format, about], sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name].astype(arrays[name].dtype.newbyteorder("<"), copy=False)
        found.update(f"{name} {array.dtype.str} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()
