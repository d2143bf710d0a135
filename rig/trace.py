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
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Literal

from rig.errors import ConfigError

VERSION = 1
MOST_WAITING = 100_000
"""Lines that may wait for the disk: what comes while there are more is lost, rather than the memory."""
CLOSING_S = 30.0
"""How long a disk may take at the end to write what is waiting."""

_Line = tuple[float, str, Literal["tx", "rx"], bytes]


class Trace(AbstractContextManager["Trace"]):
    """A trace being written; safe from any thread.

    A thread of its own writes, so that neither a slow nor a full disk is felt on the wires. What it is given is on its way to the disk at
    once, and is there, all of it, when the `with` block has ended; a program that is killed loses the last moments at most. After a
    failure nothing more is written: what is there is the beginning, without gaps.

    Parameters
    ----------
    path : Path
        A new file: an older trace is never overwritten.
    about : mapping
        Said in the first line.
    records : mapping, optional
        What was known of the axes at the start: the fields of each `AxisRecord`, by the stage's identity. Said in the first line too.

    Attributes
    ----------
    broken : str
        Why something is missing in the file; empty while nothing is.

    Raises
    ------
    ConfigError
        The file is there already, or cannot be made.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], records: Mapping[str, Any] | None = None) -> None:
        self.broken = ""
        self._path = path
        self._start = time.monotonic()
        head = {"trace": VERSION, "started": datetime.now(UTC).isoformat(), "records": dict(records or {}), **about}
        try:
            self._file = path.open("xb")
            self._file.write(_encoded(head))
            self._file.flush()
        except FileExistsError:
            raise ConfigError(f"--trace {path}: is there already; a trace gets a file of its own") from None
        except OSError as exc:
            raise ConfigError(f"--trace {path}: cannot be made: {exc.strerror or exc}") from exc
        self._queue: SimpleQueue[_Line | None] = SimpleQueue()
        self._closed = False
        self._writer = threading.Thread(target=self._write, name="trace", daemon=True)
        self._writer.start()

    def traffic(self, port: str) -> Callable[[float, Literal["tx", "rx"], bytes], None]:
        """Return the listener for one port's link; it never raises, and never waits for the disk."""

        def listen(at: float, way: Literal["tx", "rx"], data: bytes) -> None:
            if self._closed or self.broken:  # closed: a thread that was still reading when the bench was closed
                return
            if self._queue.qsize() >= MOST_WAITING:
                self.broken = self._failure("the disk is too slow: what came later is missing")
                return
            self._queue.put((at, port, way, bytes(data)))

        return listen

    def _write(self) -> None:
        going_on = True
        try:
            while going_on:
                lines = [self._queue.get()]
                try:
                    while lines[-1] is not None:  # all that is there already in one go
                        lines.append(self._queue.get_nowait())
                except Empty:
                    pass
                going_on = lines[-1] is not None
                self._file.write(b"".join(self._line(*line) for line in lines if line is not None))
                self._file.flush()
        except OSError as exc:
            self.broken = self._failure(f"cannot be written any more: {exc.strerror or exc}")
        finally:
            try:
                self._file.close()
            except OSError as exc:
                self.broken = self.broken or self._failure(f"cannot be written to its end: {exc.strerror or exc}")

    def _line(self, at: float, port: str, way: str, data: bytes) -> bytes:
        return _encoded({"t": round(at - self._start, 6), "port": port, "way": way, "hex": data.hex()})

    def _failure(self, what: str) -> str:
        return f"--trace {self._path}: {what}"

    def __exit__(self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None) -> None:
        self._closed = True
        self._queue.put(None)
        self._writer.join(CLOSING_S)
        if self._writer.is_alive():
            self.broken = self.broken or self._failure(f"the disk has not taken all of it within {CLOSING_S:g} s")


def _encoded(line: Mapping[str, Any]) -> bytes:
    return json.dumps(line).encode("ascii") + b"\n"
