"""Every byte on the wires, both ways, with times: JSON lines that `rig sim replay` stands in for the instruments with.

The first line says when the trace was begun and how; each other one holds seconds since then, the port, ``tx`` (towards the instrument) or
``rx``, and the bytes in hex.
"""

import json
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from rig.errors import ConfigError

VERSION = 1


class Trace(AbstractContextManager["Trace"]):
    """A trace being written; safe from any thread.

    Parameters
    ----------
    path : Path
        A new file: an older trace is never overwritten.
    about : mapping
        Said in the first line.

    Raises
    ------
    ConfigError
        The file is there already, or cannot be made.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        try:
            self._file = path.open("x", encoding="ascii")
        except FileExistsError:
            raise ConfigError(f"--trace {path}: is there already; a trace gets a file of its own") from None
        except OSError as exc:
            raise ConfigError(f"--trace {path}: cannot be made: {exc.strerror}") from exc
        self._lock = threading.Lock()
        self._start = time.monotonic()
        self._write({"trace": VERSION, "started": datetime.now(UTC).isoformat(), **about})

    def traffic(self, port: str) -> Callable[[float, Literal["tx", "rx"], bytes], None]:
        """Return the listener for one port's link."""

        def listen(at: float, way: Literal["tx", "rx"], data: bytes) -> None:
            self._write({"t": round(at - self._start, 6), "port": port, "way": way, "hex": data.hex()})

        return listen

    def _write(self, line: Mapping[str, Any]) -> None:
        text = json.dumps(line) + "\n"
        with self._lock:
            if not self._file.closed:  # a thread that was still reading when the bench was closed
                self._file.write(text)
                self._file.flush()

    def __exit__(self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None) -> None:
        with self._lock:
            self._file.close()
