"""Faults on the wire and in the instruments, by name and seed.

A `Faulty` instrument serves another one over lines on which a `Fault` strikes once, at the first opportunity after so many messages. A
message is a whole request, or what the instrument sends in one go, an answer or not. What a fault does depends on its seed and on what is
on the line at that moment, on nothing else.

towards the instrument or from it
    silence (the message is lost), dropped-byte, doubled-byte, unplugged, frozen (the message is lost, and all that follows either way for
    2 to 6 s of real time; the line itself stays up)
from the instrument
    delay (0.2 to 3 s of real time, and whatever follows waits behind it; the instrument itself is not held up), garbage (noise before,
    inside or instead), cut-short, stale-reply (an earlier answer in front or instead), and, where the protocol has them, wrong-checksum
    and wrong-address (of the device or of the axis), all else being right
inside the instrument
    alarm, stall, limit-hit, over-range: see `sim.troubles` and the simulators; stall and limit-hit wait for an axis that moves

unplugged lasts 0.1 to 1 s of real time. Clients on sockets are hung up on, and hung up on again if they come back too early. A
pseudo-terminal cannot go away and come back under its name: there the plug is out at the instrument's end, nothing passes either way, and
the terminal stays open.
"""

from __future__ import annotations

import asyncio
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, cast

import numpy as np

from sim.clock import Clock
from sim.errors import SimError
from sim.modbus import ModbusBus, crc, find_request
from sim.troubles import TROUBLES
from sim.wire import Instrument, Line
from sim.zaber import ZaberChain, checksum

TOWARDS, FROM = "tx", "rx"
"""The two ways of a line, as in traces: towards the instrument, and from it."""

_BOTH_WAYS = ("silence", "dropped-byte", "doubled-byte", "unplugged", "frozen")
_PROTOCOL = ("wrong-checksum", "wrong-address")
KINDS = (
    "silence",
    "delay",
    "dropped-byte",
    "doubled-byte",
    "garbage",
    "cut-short",
    *_PROTOCOL,
    "stale-reply",
    "unplugged",
    "frozen",
    *TROUBLES,
)

_LATE = (0.2, 3.0)
_UNPLUGGED = (0.1, 1.0)
_FROZEN = (2.0, 6.0)
_MOST_NOISE = 16
_REMEMBERED = 8
_LONGEST_REQUEST = 4096


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong once.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    seed : int
        Decides all that the kind leaves open.
    after : int
        So many messages pass unharmed first.
    """

    kind: str
    seed: int = 0
    after: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise SimError(f"fault {self.kind!r}: expected one of {', '.join(KINDS)}")
        if self.seed < 0 or self.after < 0:
            raise SimError(f"fault {self.kind}: seed {self.seed}, after {self.after} messages; expected zero or more")


@dataclass(frozen=True)
class Strike:
    """What a fault did.

    Parameters
    ----------
    time : float
        Simulated, s.
    kind : str
        Of the fault.
    way : str
        TOWARDS the instrument or FROM it; empty for what happened inside it.
    before, after : bytes
        The message as it was sent, and as it went on.
    what : str
        The same in words.
    """

    time: float
    kind: str
    way: str
    before: bytes
    after: bytes
    what: str


def parse(text: str) -> tuple[str, Fault]:
    """Take `NAME:KIND:SEED[:AFTER]` apart: the instrument's name, and the fault.

    Raises
    ------
    SimError
        It is not of this form.
    """
    name, *rest = text.split(":")
    if not name or len(rest) not in (2, 3) or not all(re.fullmatch("[0-9]{1,18}", number) for number in rest[1:]):
        raise SimError(f"fault {text!r}: expected NAME:KIND:SEED or NAME:KIND:SEED:AFTER, with whole numbers; kinds: {', '.join(KINDS)}")
    return name, Fault(rest[0], *map(int, rest[1:]))


def applicable(instrument: Instrument) -> tuple[str, ...]:
    """Return the kinds of fault that this instrument and its protocol know."""
    inner = instrument.inner if isinstance(instrument, Faulty) else instrument
    inside = getattr(inner, "troubles", ())
    spoils = _frames(inner).spoils
    return tuple(kind for kind in KINDS if (kind in inside if kind in TROUBLES else kind not in _PROTOCOL or kind in spoils))


# What the frames of the protocols look like, no more than is needed to harm them.

_Spoil = Callable[[bytes, np.random.Generator], bytes | None]


@dataclass(frozen=True)
class _Frames:
    """How requests are told apart, and what can be made wrong in a reply; None from a spoil if this reply has no such thing."""

    split: Callable[[bytes], tuple[list[bytes], bytes]]
    spoils: Mapping[str, _Spoil] = field(default_factory=dict)


_ENDED = re.compile(rb"[^\r\n\x03\x18]*[\r\n\x03\x18]+")  # ^C and ^X act alone on the instruments that know them


def _split_lines(held: bytes) -> tuple[list[bytes], bytes]:
    found = _ENDED.findall(held)
    return found, held[sum(map(len, found)) :]


def _split_modbus(held: bytes) -> tuple[list[bytes], bytes]:
    """Cut after each whole request; what stands before one goes with it."""
    found = []
    while (place := find_request(held)) is not None:
        found.append(held[: place[1]])
        held = held[place[1] :]
    return found, held


_ZABER_REPLY = re.compile(rb"(?P<sign>[@#!])(?P<device>\d\d) (?P<axis>\d)(?P<rest>[^:\r\n]*)(?P<check>:[0-9A-F]{2})?\r\n")


def _zaber_checksum(reply: bytes, rng: np.random.Generator) -> bytes | None:
    found = _ZABER_REPLY.fullmatch(reply)
    if found is None or found["check"] is None:
        return None
    return reply[:-4] + b"%02X\r\n" % (int(found["check"][1:], 16) ^ int(rng.integers(1, 256)))


def _zaber_address(reply: bytes, rng: np.random.Generator) -> bytes | None:
    found = _ZABER_REPLY.fullmatch(reply)
    if found is None:
        return None
    device, axis = int(found["device"]), int(found["axis"])
    if rng.integers(2):
        device = _other(device, 1, 99, rng)
    else:
        axis = _other(axis, 0, 9, rng)
    body = b"%02d %d%b" % (device, axis, found["rest"])
    return found["sign"] + body + (b":%02X" % checksum(body) if found["check"] else b"") + b"\r\n"


def _modbus_checksum(reply: bytes, rng: np.random.Generator) -> bytes | None:
    wrong = int.from_bytes(reply[-2:], "big") ^ int(rng.integers(1, 1 << 16))
    return reply[:-2] + wrong.to_bytes(2, "big")


def _modbus_address(reply: bytes, rng: np.random.Generator) -> bytes | None:
    body = bytes([_other(reply[0], 1, 247, rng)]) + reply[1:-2]
    return body + crc(body)


def _other(number: int, low: int, high: int, rng: np.random.Generator) -> int:
    drawn = int(rng.integers(low, high))
    return drawn + (drawn >= number)


_LINES = _Frames(_split_lines)
_ZABER = _Frames(_split_lines, dict(zip(_PROTOCOL, (_zaber_checksum, _zaber_address), strict=True)))
_MODBUS = _Frames(_split_modbus, dict(zip(_PROTOCOL, (_modbus_checksum, _modbus_address), strict=True)))


def _frames(instrument: Instrument) -> _Frames:
    if isinstance(instrument, ModbusBus):
        return _MODBUS
    return _ZABER if isinstance(instrument, ZaberChain) else _LINES


def _harmed(kind: str, message: bytes, rng: np.random.Generator, earlier: tuple[bytes, ...], frames: _Frames) -> tuple[bytes, str] | None:
    """Return the message as it goes on, and what was done to it in words; None if this kind cannot be done to this one."""
    size = len(message)
    match kind:
        case "silence":
            return b"", "lost"
        case "dropped-byte":
            i = int(rng.integers(size))
            return message[:i] + message[i + 1 :], f"byte {i} dropped"
        case "doubled-byte":
            i = int(rng.integers(size))
            return message[: i + 1] + message[i:], f"byte {i} doubled"
        case "garbage":
            noise, mode = rng.bytes(int(rng.integers(1, _MOST_NOISE + 1))), int(rng.integers(3))
            if mode == 2:
                return (noise, f"{len(noise)} bytes of noise instead") if noise != message else None
            i = int(rng.integers(1, size)) if mode == 1 and size > 1 else 0
            return message[:i] + noise + message[i:], f"{len(noise)} bytes of noise before byte {i}"
        case "cut-short":
            if size < 2:
                return None
            kept = int(rng.integers(1, size))
            return message[:kept], f"cut after {kept} of {size} bytes"
        case "stale-reply":
            instead = bool(rng.integers(2))
            choice = [old for old in earlier if not instead or old != message]
            if not choice:
                return None
            old = choice[int(rng.integers(len(choice)))]
            return (old, "an earlier answer instead") if instead else (old + message, "an earlier answer in front")
    spoilt = frames.spoils[kind](message, rng)
    return None if spoilt is None else (spoilt, kind.replace("-", " "))


# The wire


class _Troubled(Protocol):
    troubles: tuple[str, ...]

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None: ...


@dataclass
class _Pending:
    fault: Fault
    passed: int = 0  # messages since it was injected

    @property
    def ripe(self) -> bool:
        return self.passed >= self.fault.after


class Faulty:
    """An instrument behind lines that can fail; without a fault pending, they only pass on what they are given.

    Parameters
    ----------
    instrument : Instrument
        The one to serve, `inner` from then on.
    clock : Clock
        Simulated time, for the records.

    Attributes
    ----------
    struck : list of Strike
        What the faults did, in the order in which they struck.
    """

    def __init__(self, instrument: Instrument, clock: Clock) -> None:
        self.name, self.model = instrument.name, instrument.model
        self.inner = instrument
        self.struck: list[Strike] = []
        self._clock = clock
        self._frames = _frames(instrument)
        self._pending: tuple[_Pending, ...] = ()
        self._changing = threading.Lock()
        self._lines: set[_FaultyLine] = set()
        self._plugged_in = 0.0  # time.monotonic() from which on the plug is in
        self._thawed = 0.0  # time.monotonic() from which on bytes pass

    def inject(self, fault: Fault) -> None:
        """Have a fault strike; from any thread.

        Raises
        ------
        SimError
            This instrument knows no such fault.
        """
        known = applicable(self)
        if fault.kind not in known:
            raise SimError(f"{self.name}: no fault {fault.kind} on a {self.model}; expected one of {', '.join(known)}")
        with self._changing:
            self._pending += (_Pending(fault),)

    @property
    def pending(self) -> tuple[Fault, ...]:
        """The faults that have not struck yet."""
        return tuple(waiting.fault for waiting in self._pending)

    async def serve(self, line: Line) -> None:
        """Let the instrument serve `line` until the client has gone, or the plug is out."""
        if line.hangs_up and self.unplugged():
            return
        faulty = _FaultyLine(line, self, self._frames)
        self._lines.add(faulty)
        serving = asyncio.create_task(self.inner.serve(faulty))
        try:
            await asyncio.wait({serving, faulty.hung_up}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._lines.discard(faulty)
            faulty.close()
            serving.cancel()
            await asyncio.wait({serving})
        if not serving.cancelled():
            serving.result()  # whatever it failed of comes out here

    def unplugged(self) -> bool:
        """Tell whether the plug is out."""
        return time.monotonic() < self._plugged_in

    def dead(self) -> bool:
        """Tell whether nothing passes, either way."""
        return time.monotonic() < max(self._plugged_in, self._thawed)

    def busy(self) -> bool:
        """Tell whether any fault is pending."""
        return bool(self._pending)

    def look_inside(self) -> None:
        """Do the troubles that are due, as far as there is an opportunity: the instrument has carried out all it was given."""
        for waiting in self._pending:
            fault = waiting.fault
            if waiting.ripe and fault.kind in TROUBLES:
                told = cast(_Troubled, self.inner).trouble(fault.kind, np.random.default_rng(fault.seed))
                if told is not None:
                    self._strikes(waiting, "", b"", b"", told)

    def passing(self, line: _FaultyLine, message: bytes, way: str) -> bytes:
        """Count a message, let the first fault that is due and can strike it, and return what goes on."""
        went_on = None
        for waiting in self._pending:
            if went_on is None and waiting.ripe and waiting.fault.kind not in TROUBLES:
                went_on = self._try(waiting, line, message, way)
            waiting.passed += 1
        return message if went_on is None else went_on

    def _try(self, waiting: _Pending, line: _FaultyLine, message: bytes, way: str) -> bytes | None:
        kind, rng = waiting.fault.kind, np.random.default_rng(waiting.fault.seed)
        struck_way = (TOWARDS, FROM)[int(rng.integers(2))] if kind in _BOTH_WAYS else FROM
        if way != struck_way:
            return None
        if kind == "delay":
            seconds = float(rng.uniform(*_LATE))
            line.hold_back(seconds)
            harm: tuple[bytes, str] | None = message, f"{seconds:.3f} s late"
        elif kind == "unplugged":
            seconds = float(rng.uniform(*_UNPLUGGED))
            self._unplug(seconds)
            harm = b"", f"unplugged for {seconds:.3f} s"
        elif kind == "frozen":
            seconds = float(rng.uniform(*_FROZEN))
            self._thawed = time.monotonic() + seconds
            for other in self._lines:
                other.lose()
            harm = b"", f"frozen for {seconds:.3f} s"
        else:
            harm = _harmed(kind, message, rng, tuple(line.earlier), self._frames)
        if harm is None:
            return None
        self._strikes(waiting, way, message, *harm)
        return harm[0]

    def _unplug(self, seconds: float) -> None:
        self._plugged_in = time.monotonic() + seconds
        for line in self._lines:
            line.unplug()

    def _strikes(self, waiting: _Pending, way: str, before: bytes, after: bytes, what: str) -> None:
        with self._changing:
            self._pending = tuple(other for other in self._pending if other is not waiting)
        self.struck.append(Strike(self._clock.now(), waiting.fault.kind, way, before, after, what))


class _FaultyLine:
    def __init__(self, line: Line, owner: Faulty, frames: _Frames) -> None:
        self.hangs_up = line.hangs_up
        self.hung_up: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.earlier: deque[bytes] = deque(maxlen=_REMEMBERED)  # what the instrument said
        self._line, self._owner, self._frames = line, owner, frames
        self._requests: deque[bytes] = deque()  # whole ones
        self._held = b""  # begun, or not to be told apart
        self._left = False  # the client
        self._late: list[bytes] | None = None  # replies held back
        self._release: asyncio.TimerHandle | None = None

    def close(self) -> None:
        if self._release is not None:
            self._release.cancel()
        self.hung_up.cancel()

    def lose(self) -> None:
        """Lose what is on its way."""
        self._requests.clear()
        self._held = b""
        if self._late is not None:
            self._late = []

    def unplug(self) -> None:
        """Lose what is on its way, and the client where that can be."""
        self.lose()
        if self.hangs_up and not self.hung_up.done():
            self.hung_up.set_result(None)

    async def read(self) -> bytes:
        owner = self._owner
        while True:
            if owner.busy():
                owner.look_inside()
            if self._requests:
                request = self._requests.popleft()
                if owner.busy() and request.strip(b"\r\n"):
                    request = owner.passing(self, request, TOWARDS)
                if request:
                    return request
                if self.hung_up.done():
                    return b""
                continue
            if self._held and not owner.busy():
                rest, self._held = self._held, b""
                return rest
            if self._left:
                return b""
            data = await self._line.read()
            if not data:
                self._left = True
                rest, self._held = self._held, b""
                return rest
            if owner.dead():
                continue
            if not owner.busy() and not self._held:
                return data
            whole, self._held = self._frames.split(self._held + data)
            self._requests += whole
            if len(self._held) > _LONGEST_REQUEST:
                rest, self._held = self._held, b""
                self._requests.append(rest)

    def write(self, data: bytes) -> None:
        owner = self._owner
        if owner.dead():
            return
        sent = owner.passing(self, data, FROM) if data and owner.busy() else data
        self.earlier.append(data)
        if not sent:
            return
        if self._late is not None:
            self._late.append(sent)
        else:
            self._line.write(sent)

    def hold_back(self, seconds: float) -> None:
        """Keep back what is written from now on for so long; real time, for a client's patience is real."""
        loop = asyncio.get_running_loop()
        due = loop.time() + seconds
        if self._release is not None:
            due = max(due, self._release.when())
            self._release.cancel()
        self._late = [] if self._late is None else self._late
        self._release = loop.call_at(due, self._let_go)

    def _let_go(self) -> None:
        late, self._late, self._release = self._late, None, None
        if late:
            self._line.write(b"".join(late))

    async def drain(self) -> None:
        if self._owner.busy():
            self._owner.look_inside()
        await self._line.drain()
