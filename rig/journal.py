"""The journal of a run: event-model documents, one JSON line each, on the disk before the next point is measured."""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rig.errors import RunError
from rig.files import fsync_folder

SCHEMA_VERSION = 1


def _plain(value: Any, where: str) -> Any:
    """Return `value` in JSON's own types; arrays become lists, and what JSON cannot say is refused."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if hasattr(value, "tolist"):  # NumPy arrays and scalars, whatever their dtype
        return _plain(value.tolist(), where)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise RunError(f"{where} is {value}: a journal holds finite numbers only")
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise RunError(f"{where} is a {type(value).__name__}, which a journal cannot hold")


class JournalWriter:
    """Appends documents to a journal; each is flushed and fsynced before the call returns.

    Use it as the engine's first callback: what later callbacks show is then on the disk.

    Parameters
    ----------
    path : Path
        Made where it is not there. A torn last line, left by a crash, is closed off and stays where it is.
    abort_reason : callable
        Asked why, when a run is closed as aborted: the engine loses the reason it was given.

    Raises
    ------
    RunError
        Where the file cannot be written (a full disk, say), or a document holds what JSON cannot.
    """

    def __init__(self, path: Path, *, abort_reason: Callable[[], str] = lambda: "") -> None:
        self.path = path
        self._abort_reason = abort_reason
        new = not path.exists()
        try:
            self._file = path.open("ab", buffering=0)
            if not new and path.stat().st_size and not _ends_with_newline(path):
                self._file.write(b"\n")
            if new:
                fsync_folder(path.parent)
        except OSError as exc:
            raise RunError(f"{path}: cannot be written: {exc.strerror}") from exc

    def __call__(self, name: str, doc: Mapping[str, Any]) -> None:
        """Append one document; `name` is `start`, `descriptor`, `event` or `stop`."""
        if name == "stop" and doc["exit_status"] == "abort" and not doc.get("reason"):
            doc = {**doc, "reason": self._abort_reason()}
        line = json.dumps({"name": str(name), "doc": _plain(doc, str(name))}, allow_nan=False) + "\n"
        try:
            rest = memoryview(line.encode())
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except OSError as exc:
            raise RunError(f"{self.path}: the journal cannot be written: {exc.strerror}; the run ends here") from exc

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_documents(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the documents of a journal as (name, document).

    A torn line is passed over where a crash leaves one: at the end, or where a later run was appended.

    Raises
    ------
    RunError
        Where the file cannot be read or a line is damaged; names the line.
    """
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as exc:
        raise RunError(f"{path}: cannot be read: {exc.strerror}") from exc
    torn = 0
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            entry = json.loads(line)
            name, doc = entry["name"], entry["doc"]
        except (ValueError, KeyError, TypeError):
            if torn:
                raise RunError(f"{path}:{torn}: not a document") from None
            torn = number
            continue
        if torn and name != "start":
            raise RunError(f"{path}:{torn}: not a document, and not where a crash could have cut it off")
        torn = 0
        yield name, doc


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
