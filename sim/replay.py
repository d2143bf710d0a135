"""Recorded instruments: the bytes of a trace, played again to a client that says the same.

A trace file holds JSON lines. The first is about the recording, `{"trace": 1, "started": "2024-05-01T12:00:00+00:00"}`; each of the
others is about bytes, `{"t": 0.1, "port": "sim:stages", "way": "tx", "hex": "2f310a"}`: seconds since the start, the port's name, `tx`
towards the instrument or `rx` from it. One tx line is one whole write of the client. Lines need not stand in the order of their times; the
times say what came first.

Times are not replayed: what was received after a request is sent at once. A port at which nothing was recorded can be served too, and then
all that is said there diverges.
"""

from __future__ import annotations

import json
import math
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from sim.errors import SimError
from sim.wire import Line, TcpPort, beside

VERSION = 1


@dataclass(frozen=True)
class Event:
    """Some bytes that went over a port.

    Parameters
    ----------
    t : float
        Seconds since the start.
    port, way : str
        Whose bytes, and `tx` or `rx`.
    data : bytes
    line : int
        Of the file, from 1.
    """

    t: float
    port: str
    way: str
    data: bytes
    line: int


@dataclass(frozen=True)
class Trace:
    """A recording.

    Parameters
    ----------
    path : Path
    started : datetime
    events : tuple of Event
        In the order of the file.
    about : dict
        The file's first line.
    """

    path: Path
    started: datetime
    events: tuple[Event, ...]
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def ports(self) -> tuple[str, ...]:
        """The ports' names, in the order in which they come up."""
        return tuple(dict.fromkeys(event.port for event in self.events))


def load(path: str | Path) -> Trace:
    """Read a trace file.

    A last line that was not written to its end, as a power cut leaves it, is left out.

    Raises
    ------
    SimError
        There is no such file, or a line is not as it should be; it says which and why.
    """
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as error:
        raise SimError(f"trace {path}: {error.strerror or error}") from error
    lines = text.split(b"\n")
    torn = lines.pop()  # nothing, if the last line was ended
    if torn and _object(torn) is not None:
        lines.append(torn)
    if not lines:
        raise SimError(f'trace {path}, line 1: expected a line that begins with {{"trace": {VERSION}')
    about, started = _about(lines[0], path)
    events = [_event(line, f"trace {path}, line {number}", number) for number, line in enumerate(lines[1:], 2)]
    return Trace(path, started, tuple(events), about)


def _object(line: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _about(line: bytes, path: Path) -> tuple[dict[str, Any], datetime]:
    about = _object(line) or {}
    version, started = about.get("trace"), about.get("started")
    if type(version) is not int:
        raise SimError(f'trace {path}, line 1: not the first line of a trace; expected {{"trace": {VERSION}, "started": ...}}')
    if version != VERSION:
        raise SimError(f"trace {path}, line 1: version {version}; only {VERSION} can be read")
    try:
        return about, datetime.fromisoformat(started or "")
    except (TypeError, ValueError):
        raise SimError(f"trace {path}, line 1: started {started!r}; expected a date and time, ISO 8601") from None


def _event(line: bytes, where: str, number: int) -> Event:
    found = _object(line)
    if found is None:
        raise SimError(f"{where}: not a JSON object: {line[:60]!r}")
    t, port, way, text = (found.get(key) for key in ("t", "port", "way", "hex"))
    if isinstance(t, bool) or not isinstance(t, int | float) or not 0 <= t < math.inf:
        raise SimError(f"{where}: t {t!r}; expected seconds since the start")
    if not isinstance(port, str) or not port:
        raise SimError(f"{where}: port {port!r}; expected a name")
    if way not in ("tx", "rx"):
        raise SimError(f"{where}: way {way!r}; expected tx or rx")
    try:
        data = bytes.fromhex(text if isinstance(text, str) else "?")
    except ValueError:
        raise SimError(f"{where}: hex {text!r}; expected two hexadecimal digits per byte") from None
    return Event(t, port, way, data, number)


@dataclass(frozen=True)
class Divergence:
    """What a client said that was not recorded, or was replayed already.

    Parameters
    ----------
    data : bytes
        What it said.
    line : int or None
        Of the trace: the earliest request not yet replayed; None if all were.
    expected : bytes
        That request.
    """

    data: bytes
    line: int | None
    expected: bytes

    def __str__(self) -> str:
        wanted = "nothing more" if self.line is None else f"{self.expected!r} (line {self.line} of the trace)"
        return f"{self.data!r} came where {wanted} was expected"


@dataclass
class _Exchange:
    line: int
    request: bytes
    reply: bytes = b""


class Replay:
    """A port of a trace as an instrument: it answers recorded requests as they were answered, each once.

    What the client sends is collected until it begins with a recorded request, the one that is next in the trace if that is among them,
    else the longest; of identical ones the earliest is used up. What cannot become any recorded request is a divergence, and is not
    answered. The state belongs to the port: a client that connects anew goes on where the last one left. What was received before the
    first request is sent to the first client upon connection.

    Parameters
    ----------
    trace : Trace
    port : str
        One of the trace's.
    silent : bool
        Nothing was recorded at this port, and nothing is answered.

    Attributes
    ----------
    divergences : list of Divergence

    Raises
    ------
    SimError
        The trace has no such port.
    """

    model = "replay"

    def __init__(self, trace: Trace, port: str, *, silent: bool = False) -> None:
        if port not in trace.ports and not silent:
            raise SimError(f"trace {trace.path}: no port {port!r}; it has {', '.join(trace.ports) or 'none'}")
        self.name = port
        self.divergences: list[Divergence] = []
        self._greeting = b""
        self._left: list[_Exchange] = []
        for event in sorted(trace.events, key=lambda event: event.t):
            if event.port != port or not event.data:
                continue
            if event.way == "tx":
                self._left.append(_Exchange(event.line, event.data))
            elif self._left:
                self._left[-1].reply += event.data
            else:
                self._greeting += event.data

    @property
    def finished(self) -> bool:
        """Whether every recorded request has come."""
        return not self._left

    async def serve(self, line: Line) -> None:
        """Replay to `line` until the client has gone."""
        line.write(self._greeting)
        self._greeting = b""
        held = b""
        while data := await line.read():
            held += data
            while held and (exchange := self._meant(held)) is not None:
                self._left.remove(exchange)
                held = held[len(exchange.request) :]
                line.write(exchange.reply)
            if held and not any(exchange.request.startswith(held) for exchange in self._left):
                expected = (self._left[0].line, self._left[0].request) if self._left else (None, b"")
                self.divergences.append(Divergence(held, *expected))
                held = b""
            await line.drain()

    def _meant(self, held: bytes) -> _Exchange | None:
        if self._left and held.startswith(self._left[0].request):
            return self._left[0]
        return max((exchange for exchange in self._left if held.startswith(exchange.request)), key=_length, default=None)


def _length(exchange: _Exchange) -> int:
    return len(exchange.request)


@asynccontextmanager
async def replaying(trace: Trace, replays: Sequence[Replay] | None = None) -> AsyncIterator[dict[str, Any]]:
    """Open a TCP port for every port of a trace and yield the report that tells where they are; close them at the end.

    Parameters
    ----------
    trace : Trace
    replays : sequence of Replay, optional
        Those to serve; one for each port of the trace if not given.
    """
    devices = []
    async with AsyncExitStack() as ports:
        for replay in _replays(trace) if replays is None else replays:
            tcp = TcpPort(replay)
            await tcp.open()
            ports.push_async_callback(tcp.close)
            devices.append({"name": replay.name, "model": replay.model, "tcp": tcp.url})
        yield {"replayed": str(trace.path), "started": trace.started.isoformat(), "devices": devices}


def _replays(trace: Trace, silent: Iterable[str] = ()) -> tuple[Replay, ...]:
    others = [port for port in dict.fromkeys(silent) if port not in trace.ports]
    return (*(Replay(trace, port) for port in trace.ports), *(Replay(trace, port, silent=True) for port in others))


@dataclass(frozen=True)
class Replayed:
    """Recorded instruments at work in another thread: where they are, and how far they have come."""

    report: dict[str, Any]
    replays: tuple[Replay, ...]

    def url(self, port: str) -> str:
        """Return the TCP URL of the port that was recorded under this name."""
        return str(next(device["tcp"] for device in self.report["devices"] if device["name"] == port))

    @property
    def divergences(self) -> dict[str, list[Divergence]]:
        """What clients said that was not recorded, by port; ports without any are left out."""
        return {replay.name: list(replay.divergences) for replay in self.replays if replay.divergences}

    @property
    def finished(self) -> bool:
        """Whether every recorded request of every port has come."""
        return all(replay.finished for replay in self.replays)


@contextmanager
def in_background(trace: Trace, silent: Iterable[str] = ()) -> Iterator[Replayed]:
    """Serve all ports of a trace from a thread of its own for the length of a `with` block, and `silent` ones of these names."""
    replays = _replays(trace, silent)
    with beside(replaying(trace, replays), "replay") as report:
        yield Replayed(report, replays)
