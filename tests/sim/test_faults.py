"""Faults: each kind on each simulator does what it says, once, and the same for the same seed."""

from __future__ import annotations

import asyncio
import math
import os
import re
import select
import socket
import struct
import subprocess
import sys
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sim.faults
from sim.apogee import QuantumModel, QuantumSensor
from sim.baumer import DistanceSensor, RangeModel
from sim.clock import Clock, ManualClock
from sim.errors import SimError
from sim.faults import FROM, KINDS, TOWARDS, Fault, Faulty, Strike, applicable, parse
from sim.keithley import Keithley6485
from sim.konica_minolta import Photometer, PhotometerModel
from sim.modbus import ModbusBus, crc
from sim.newport import Esp301
from sim.optoncdt import OptoNCDT, TriangulationModel
from sim.oriental import AzAxis, AzModel
from sim.sigma_koki import GSC_02, SHOT_302GS, SigmaKoki
from sim.wire import Instrument, Line
from sim.zaber import ZaberChain
from tests.conftest import ROOT
from tests.sim.served import served


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def framed(text: str) -> bytes:
    data = bytes.fromhex(text)
    return data + crc(data)


MAKERS: dict[str, Callable[[Clock], Instrument]] = {
    "zaber": lambda clock: ZaberChain(clock, [10.0, 20.0]),
    "newport": lambda clock: Esp301(clock, [10.0, 20.0]),
    "shot": lambda clock: SigmaKoki(clock, [10.0, 20.0], SHOT_302GS),
    "gsc": lambda clock: SigmaKoki(clock, [10.0, 20.0], GSC_02),
    "oriental": lambda clock: ModbusBus(clock, {1: AzAxis(AzModel(), 10.0), 2: AzAxis(AzModel(), 20.0)}, "az", "oriental-az"),
    "keithley": lambda clock: Keithley6485(clock, lambda t0, t1: 1e-9, rng()),
    "ls-100": lambda clock: Photometer(clock, lambda t0, t1: 123.4, rng(), PhotometerModel(noise=0.0)),
    "cs-100a": lambda clock: Photometer(clock, lambda t0, t1: 123.4, rng(), PhotometerModel(colour=True, noise=0.0)),
    "apogee": lambda clock: ModbusBus(clock, {1: QuantumSensor(lambda t0, t1: 1000.0, rng(), QuantumModel(noise=0.0))}, "lamp", "sq"),
    "om20": lambda clock: ModbusBus(clock, {1: DistanceSensor(lambda t0, t1: 100.0, rng(), RangeModel(noise=0.0))}, "om", "om20"),
    "optoncdt": lambda clock: OptoNCDT(clock, lambda t0, t1: 25.0, rng(), TriangulationModel(noise=0.0)),
}
# Two requests each that are answered differently, and at once.
TALK: dict[str, tuple[bytes, bytes]] = {
    "zaber": (b"/1 0 04 get deviceid:3E\n", b"/1 1 34 move abs 1000:E9\n"),
    "newport": (b"1ID?\r", b"VE?\r"),
    "shot": (b"?:V\r\n", b"Q:\r\n"),
    "gsc": (b"?:V\r\n", b"Q:\r\n"),
    "oriental": (framed("01 03 00 7F 00 01"), framed("02 03 00 CC 00 02")),
    "keithley": (b"*IDN?\n", b"SYST:ERR?\n"),
    "ls-100": (b"CLE\r\n", b"NONE\r\n"),
    "cs-100a": (b"CLE\r\n", b"NONE\r\n"),
    "apogee": (framed("01 03 00 00 00 02"), framed("01 03 00 12 00 02")),
    "om20": (framed("01 04 00 CA 00 02"), framed("01 04 00 20 00 1A")),
    "optoncdt": (b"GETINFO\r\n", b"ECHO\r\n"),
}
INSIDE = {
    "zaber": ("alarm", "stall", "limit-hit"),
    "newport": ("alarm", "stall", "limit-hit"),
    "shot": ("limit-hit",),
    "gsc": ("limit-hit",),
    "oriental": ("alarm", "stall", "limit-hit"),
    "keithley": ("over-range",),
    "ls-100": ("alarm", "over-range"),
    "cs-100a": ("alarm", "over-range"),
    "apogee": ("over-range",),
    "om20": ("alarm", "over-range"),
    "optoncdt": ("over-range",),
}
CHECKED = ("zaber", "oriental", "apogee", "om20")
BYTES = ("silence", "dropped-byte", "doubled-byte", "garbage", "cut-short", "wrong-checksum", "wrong-address", "stale-reply")


class Tape:
    """A line whose client says some things and listens; also one that notes what passes on its way to another."""

    def __init__(self, line: Line | None = None, hangs_up: bool = True) -> None:
        self.hangs_up = hangs_up
        self.said: asyncio.Queue[bytes] = asyncio.Queue()
        self.read_: list[bytes] = []
        self.written: list[bytes] = []
        self._line = line

    async def read(self) -> bytes:
        data = await (self.said.get() if self._line is None else self._line.read())
        self.read_.append(data)
        return data

    def write(self, data: bytes) -> None:
        self.written.append(data)
        if self._line is not None:
            self._line.write(data)

    async def drain(self) -> None:
        if self._line is not None:
            await self._line.drain()


class Scene:
    """A client, a faulty line, and an instrument whose own end of it is listened in to."""

    def __init__(self, inner: Instrument, clock: ManualClock, hangs_up: bool = True) -> None:
        self.clock, self.inner, self.hangs_up = clock, inner, hangs_up
        self.client = Tape(hangs_up=hangs_up)
        self.ends: list[Tape] = []
        serve = inner.serve

        async def tapped(line: Line) -> None:
            self.ends.append(Tape(line))
            await serve(self.ends[-1])

        inner.serve = tapped  # type: ignore[method-assign]
        self.faulty = Faulty(inner, clock)
        self.task = asyncio.get_running_loop().create_task(self.faulty.serve(self.client))

    async def settle(self) -> None:
        for _ in range(15):
            await asyncio.sleep(0)

    async def say(self, *messages: bytes) -> None:
        for message in messages:
            self.client.said.put_nowait(message)
            await self.settle()

    async def ask(self, message: bytes) -> bytes:
        """Say something and return what is heard thereupon."""
        before = len(self.client.written)
        await self.say(message)
        return b"".join(self.client.written[before:])

    async def wait(self, seconds: float) -> None:
        """Let simulated time pass."""
        await self.settle()
        await self.clock.advance(seconds)
        await self.settle()

    @property
    def received(self) -> list[bytes]:
        """What the instrument got."""
        return [data for end in self.ends for data in end.read_ if data]

    @property
    def sent(self) -> list[bytes]:
        """What the instrument wrote."""
        return [data for end in self.ends for data in end.written]

    @property
    def heard(self) -> list[bytes]:
        """What came to the client."""
        return self.client.written

    async def end(self) -> None:
        self.client.said.put_nowait(b"")
        await self.task


def scene(name: str, act: Callable[[Scene], Awaitable[Any]], *faults: Fault, hangs_up: bool = True) -> Scene:
    """Play a scene to its end."""

    async def play() -> Scene:
        clock = ManualClock()
        stage = Scene(MAKERS[name](clock), clock, hangs_up)
        for fault in faults:
            stage.faulty.inject(fault)
        await act(stage)
        await stage.end()
        return stage

    return asyncio.run(play())


async def talk(stage: Scene) -> None:
    name = next(name for name in TALK if MAKERS[name](stage.clock).model == stage.inner.model)
    await stage.say(*TALK[name], *TALK[name], *TALK[name])


# Names


def test_kinds() -> None:
    assert KINDS == (
        "silence", "delay", "dropped-byte", "doubled-byte", "garbage", "cut-short", "wrong-checksum", "wrong-address", "stale-reply",
        "unplugged", "frozen", "alarm", "stall", "limit-hit", "over-range",
    )  # fmt: skip


def test_parse() -> None:
    assert parse("stages:cut-short:7") == ("stages", Fault("cut-short", 7))
    assert parse("meter:over-range:0:12") == ("meter", Fault("over-range", 0, 12))


@pytest.mark.parametrize(
    "text", ["", "stages", "stages:silence", ":silence:1", "a:silence:x", "a:silence:-1", "a:silence:1:", "a:silence:1:2:3", "a:fire:1"]
)
def test_nonsense_is_refused_with_what_is_allowed(text: str) -> None:
    with pytest.raises(SimError, match="silence, delay, dropped-byte"):
        parse(text)


@pytest.mark.parametrize("name", MAKERS)
def test_applicable(name: str) -> None:
    instrument = MAKERS[name](ManualClock())
    bytewise = {"delay", "unplugged", "frozen", *BYTES} - (set() if name in CHECKED else {"wrong-checksum", "wrong-address"})
    assert applicable(instrument) == tuple(kind for kind in KINDS if kind in bytewise or kind in INSIDE[name])
    faulty = Faulty(instrument, ManualClock())
    assert applicable(faulty) == applicable(instrument)
    assert (faulty.name, faulty.model) == (instrument.name, instrument.model)
    for kind in set(KINDS) - set(applicable(instrument)):
        with pytest.raises(SimError, match=f"no fault {kind} on a {instrument.model}"):
            faulty.inject(Fault(kind))


@pytest.mark.parametrize("wrong", [("fire", 0, 0), ("alarm", -1, 0), ("alarm", 0, -1)])
def test_impossible_faults(wrong: tuple[str, int, int]) -> None:
    with pytest.raises(SimError):
        Fault(*wrong)


def test_the_drivers_are_not_needed() -> None:
    code = "import sim.faults, sim.replay, sys; print(sorted(name for name in sys.modules if name.split('.')[0] in ('drivers', 'rig')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


# Bytes


def lrc(text: bytes) -> int:
    return -sum(text) & 0xFF


def fields(name: str, frame: bytes) -> tuple[tuple[bytes, ...], bool]:
    """Return the address fields and the rest of a reply, and whether its checksum is right."""
    if name == "zaber":
        found = re.fullmatch(rb"@(\d\d) (\d)( .*):([0-9A-F]{2})\r\n", frame)
        assert found, frame
        return found.groups()[:3], int(found[4], 16) == lrc(frame[1:-5])
    remainder = 0xFFFF
    for byte in frame[:-2]:
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder >> 1) ^ 0xA001 if remainder & 1 else remainder >> 1
    return (frame[:1], frame[1:-2]), frame[-2:] == struct.pack("<H", remainder)


def check(name: str, kind: str, strike: Strike, sent: list[bytes]) -> None:
    """Assert that what a strike did is what its kind says, looking at the bytes alone."""
    before, after = strike.before, strike.after
    match kind:
        case "silence":
            assert after == b""
        case "dropped-byte":
            assert after in [before[:i] + before[i + 1 :] for i in range(len(before))]
        case "doubled-byte":
            assert after in [before[:i] + before[i : i + 1] + before[i:] for i in range(len(before))]
        case "garbage":
            more = len(after) - len(before)
            inserted = 1 <= more <= 16 and any(after[:i] + after[i + more :] == before for i in range(len(before)))
            assert inserted or (1 <= len(after) <= 16 and after != before)
        case "cut-short":
            assert after in [before[:i] for i in range(1, len(before))]
        case "stale-reply":
            earlier = sent[: sent.index(before)]
            assert after in [*earlier, *(old + before for old in earlier)]
            assert after != before
        case "wrong-checksum":
            (old, right), (new, wrong) = fields(name, before), fields(name, after)
            assert (new, right, wrong) == (old, True, False)
        case "wrong-address":
            (old, right), (new, still_right) = fields(name, before), fields(name, after)
            assert right
            assert still_right
            assert sum(a != b for a, b in zip(old, new, strict=True)) == 1
            assert old[-1] == new[-1]


@pytest.mark.parametrize(
    ("name", "kind"),
    [(name, kind) for name in MAKERS for kind in BYTES if name in CHECKED or kind not in ("wrong-checksum", "wrong-address")],
)
def test_bytes_go_wrong_as_the_kind_says_once_and_alike_for_the_same_seed(name: str, kind: str) -> None:
    ways, done = set(), set()
    for seed in range(4):
        stage = scene(name, talk, Fault(kind, seed, after=2))
        (strike,) = stage.faulty.struck
        assert stage.faulty.pending == ()
        assert (strike.kind, strike.time) == (kind, 0.0)
        check(name, kind, strike, stage.sent)
        # One message was changed, on one side, and what came before and after it was not.
        wire = [*TALK[name]] * 3, stage.received, stage.sent, stage.heard
        (near, far), (same, equal) = (wire[:2], wire[2:]) if strike.way == TOWARDS else (wire[2:], wire[:2])
        assert b"".join(same) == b"".join(equal)
        place = next(i for i in range(1, len(near)) if near[i] == strike.before)
        assert b"".join(far) == b"".join([*near[:place], strike.after, *near[place + 1 :]])
        again = scene(name, talk, Fault(kind, seed, after=2))
        assert (again.faulty.struck, again.heard, again.received) == ([strike], stage.heard, stage.received)
        ways.add(strike.way)
        done.add(strike.after)
    assert ways == ({TOWARDS, FROM} if kind in ("silence", "dropped-byte", "doubled-byte") else {FROM})
    assert len(done) > 1 or kind == "silence"


@pytest.mark.parametrize("after", [0, 1, 2, 3, 7])
def test_so_many_messages_pass_first(after: int) -> None:
    async def act(stage: Scene) -> None:
        for i in range(6):
            await stage.say(b"/1 0 %02d\n" % i)

    stage = scene("zaber", act, Fault("silence", seed=FROM_INSTRUMENT, after=after))
    assert stage.faulty.struck[0].before.split()[2] == b"%02d" % (after // 2)  # a request and a reply are two
    assert len(stage.heard) == 5


FROM_INSTRUMENT = next(seed for seed in range(99) if np.random.default_rng(seed).integers(2))
TO_INSTRUMENT = next(seed for seed in range(99) if not np.random.default_rng(seed).integers(2))


def test_each_of_many_faults_strikes_a_message_of_its_own() -> None:
    stage = scene("zaber", talk, *(Fault("dropped-byte", FROM_INSTRUMENT) for _ in range(3)), Fault("cut-short", 1, after=2))
    assert [strike.kind for strike in stage.faulty.struck] == ["dropped-byte"] * 3 + ["cut-short"]
    assert [strike.before for strike in stage.faulty.struck] == stage.sent[:4]


def test_a_stale_reply_can_be_one_that_was_lost() -> None:
    async def act(stage: Scene) -> None:
        assert await stage.ask(b"VE?\r") == b""
        assert (await stage.ask(b"1ID?\r")).startswith(b"ESP301 Version 3.10 simulated\r\n")

    scene("newport", act, Fault("silence", FROM_INSTRUMENT), Fault("stale-reply", after=2))


def test_a_stale_reply_instead_waits_for_one_that_differs() -> None:
    async def act(stage: Scene) -> None:
        version = await stage.ask(b"VE?\r")
        assert await stage.ask(b"VE?\r") == version
        assert stage.faulty.pending
        assert await stage.ask(b"1MO?\r") == version
        assert await stage.ask(b"1MO?\r") == b"0\r\n"

    scene("newport", act, Fault("stale-reply", FROM_INSTRUMENT))  # its first draw says: instead


def test_a_wrong_checksum_waits_for_a_reply_that_has_one() -> None:
    async def act(stage: Scene) -> None:
        assert await stage.ask(b"/1 0 01\n") == b"@01 0 01 OK IDLE WR 0\r\n"
        assert stage.faulty.pending
        assert await stage.ask(b"/1 0 04 get deviceid:3E\n") != stage.sent[-1]

    assert len(scene("zaber", act, Fault("wrong-checksum", 3)).faulty.struck) == 1


def test_requests_of_one_packet_and_requests_in_pieces_are_told_apart() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"/1 0 01\n/1 0", b" 02\r", b"\n/1 0 03\n", b"/1 0 04")

    stage = scene("zaber", act, Fault("silence", TO_INSTRUMENT, after=2))
    assert stage.faulty.struck[0].before == b"/1 0 02\r"
    assert stage.received == [b"/1 0 01\n", b"\n/1 0 03\n", b"/1 0 04"]
    noisy = b"\xff\x00" + framed("01 03 00 7F 00 01")

    async def modbus(stage: Scene) -> None:
        await stage.say(noisy + TALK["oriental"][1][:3], TALK["oriental"][1][3:])

    stage = scene("oriental", modbus, Fault("silence", TO_INSTRUMENT, after=1))
    assert (stage.received, stage.faulty.struck[0].before) == ([noisy], TALK["oriental"][1])


def test_an_abort_is_not_kept_waiting() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"READ?\n", b"\x18")
        assert stage.received == [b"READ?\n", b"\x18"]

    scene("keithley", act, Fault("silence", after=99))


# Late, unplugged, and frozen


@pytest.mark.parametrize(("kind", "low", "high"), [("delay", 0.2, 3.0), ("unplugged", 0.1, 1.0), ("frozen", 2.0, 6.0)])
def test_how_long_is_drawn(kind: str, low: float, high: float) -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"/1 0 01\n")

    told = [scene("zaber", act, Fault(kind, seed)).faulty.struck[0].what for seed in range(30)]
    seconds = [float(re.search(r"[0-9.]+", what)[0]) for what in told]  # type: ignore[index]
    assert low <= min(seconds) < low + 0.3 * (high - low)
    assert high - 0.3 * (high - low) < max(seconds) <= high


def test_a_late_reply_keeps_its_place_and_does_not_hold_the_instrument_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim.faults, "_LATE", (0.02, 0.02))

    async def act(stage: Scene) -> None:
        loop, heard = asyncio.get_running_loop(), asyncio.Event()
        begun = loop.time()
        write = stage.client.write
        stage.client.write = lambda data: (write(data), heard.set())  # type: ignore[method-assign, assignment]
        await stage.say(b"/1 0 01\n", b"/1 1 stop\n")
        assert len(stage.sent) == 2
        assert stage.heard == []
        await heard.wait()
        assert loop.time() - begun > 0.018
        assert stage.heard == [b"".join(stage.sent)]
        assert await stage.ask(b"/1 0 03\n") == b"@01 0 03 OK IDLE WR 0\r\n"

    scene("zaber", act, Fault("delay", 5))


def test_of_two_delays_the_later_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    async def act(stage: Scene) -> None:
        loop = asyncio.get_running_loop()
        dues = []
        for low in (50.0, 10.0, 90.0):
            monkeypatch.setattr(sim.faults, "_LATE", (low, low))
            stage.faulty.inject(Fault("delay"))
            await stage.say(b"/1\n")
            (line,) = stage.faulty._lines
            dues.append(line._release.when() - loop.time())  # type: ignore[union-attr]
        assert dues == pytest.approx([50, 50, 90], abs=5)
        line._let_go()
        assert stage.heard == [b"@01 0 OK IDLE WR 0\r\n" * 3]

    scene("zaber", act)


def test_a_client_may_leave_before_its_late_reply() -> None:
    lines = []

    async def act(stage: Scene) -> None:
        await stage.say(b"/1 0 01\n")
        lines.extend(stage.faulty._lines)
        assert not lines[0]._release.cancelled()  # type: ignore[union-attr]

    assert scene("zaber", act, Fault("delay", 5)).heard == []
    assert lines[0]._release.cancelled()  # type: ignore[union-attr]


def connect(url: str) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), timeout=10)


def ask(client: socket.socket, request: bytes) -> bytes:
    """Return a line, or nothing if the client is hung up on."""
    try:
        client.sendall(request)
        with client.makefile("rb") as lines:
            return lines.readline()
    except ConnectionError:
        return b""


@pytest.mark.parametrize("seed", [TO_INSTRUMENT, FROM_INSTRUMENT])
def test_unplugged_on_sockets(monkeypatch: pytest.MonkeyPatch, quiet: None, seed: int) -> None:
    monkeypatch.setattr(sim.faults, "_UNPLUGGED", (3600.0, 3600.0))
    with served(lambda: Faulty(MAKERS["newport"](ManualClock()), ManualClock())) as (faulty, ports):
        with connect(ports.tcp) as client, connect(ports.tcp) as other:
            assert ask(client, b"VE?\r") == ask(other, b"VE?\r") == b"ESP301 Version 3.10 simulated\r\n"
            faulty.inject(Fault("unplugged", seed))
            assert ask(client, b"1MO\r1MO?\r") == b""
            assert other.recv(10) == b""
        for _ in range(3):
            with connect(ports.tcp) as early:
                assert ask(early, b"VE?\r") == b""
        faulty._plugged_in = 0.0
        with connect(ports.tcp) as client:
            reply = ask(client, b"1MO?\r")
        # Whether the command was carried out is what the client cannot know.
        assert reply == (b"0\r\n" if seed == TO_INSTRUMENT else b"1\r\n")
        assert [strike.before for strike in faulty.struck] == [b"1MO\r" if seed == TO_INSTRUMENT else b"1\r\n"]


def test_unplugged_on_a_terminal(monkeypatch: pytest.MonkeyPatch, quiet: None) -> None:
    monkeypatch.setattr(sim.faults, "_UNPLUGGED", (0.1, 0.1))
    with served(lambda: Faulty(MAKERS["newport"](ManualClock()), ManualClock())) as (faulty, ports):
        terminal = os.open(ports.pty, os.O_RDWR | os.O_NOCTTY)
        try:
            faulty.inject(Fault("unplugged", TO_INSTRUMENT))
            os.write(terminal, b"VE?\r")
            while not select.select([terminal], [], [], 0.02)[0]:  # until the plug is in again
                os.write(terminal, b"1MO?\r")
            assert os.read(terminal, 3) == b"0\r\n"
            assert faulty.struck[0].before == b"VE?\r"
        finally:
            os.close(terminal)


def test_a_terminal_loses_what_is_said_while_the_plug_is_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim.faults, "_UNPLUGGED", (3600.0, 3600.0))

    async def act(stage: Scene) -> None:
        assert await stage.ask(b"VE?\r") == b""
        assert await stage.ask(b"1MO\r") == b""
        stage.faulty._plugged_in = 0.0
        assert await stage.ask(b"1MO?\r") == b"0\r\n"

    scene("newport", act, Fault("unplugged", TO_INSTRUMENT), hangs_up=False)


def test_unplugging_ends_a_measurement_under_way() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"MES\r\n")
        stage.faulty.inject(Fault("unplugged", TO_INSTRUMENT))
        await stage.say(b"MES\r\n")
        await stage.wait(10.0)

    stage = scene("ls-100", act)
    assert stage.heard == [b"OK00,   123.4\r\n"]


@pytest.mark.parametrize("seed", [TO_INSTRUMENT, FROM_INSTRUMENT])
def test_on_a_frozen_wire_nothing_passes_and_nobody_is_hung_up_on(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.setattr(sim.faults, "_FROZEN", (3600.0, 3600.0))

    async def act(stage: Scene) -> None:
        assert await stage.ask(b"1MO\r1MO?\r") == b""
        assert await stage.ask(b"1MF\r") == b""
        assert await stage.ask(b"1MO?\r") == b""
        assert not next(iter(stage.faulty._lines)).hung_up.done()
        stage.faulty._thawed = 0.0
        # 1MO is lost on its way, or is carried out and the answer to the question after it is lost; 1MF is lost anyhow.
        assert await stage.ask(b"1MO?\r") == (b"0\r\n" if seed == TO_INSTRUMENT else b"1\r\n")

    assert scene("newport", act, Fault("frozen", seed)).faulty.struck[0].way == (TOWARDS if seed == TO_INSTRUMENT else FROM)


# Inside the instruments


def number(text: str, pattern: str) -> float:
    found = re.search(pattern, text)
    assert found, text
    return float(found[1])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("kind", "flag"), [("stall", b"FS"), ("limit-hit", b"FE")])
def test_a_zaber_stage_halts_on_its_way(kind: str, flag: bytes, seed: int) -> None:
    async def act(stage: Scene) -> None:
        assert (await stage.ask(b"/2 1 get pos\n")).split()[-1] == b"0"
        assert stage.faulty.struck == []  # nothing moves
        assert await stage.ask(b"/2 1 move rel 384000\n") == b"@02 1 OK BUSY WR 0\r\n"
        assert await stage.ask(b"/2\n") == b"@02 0 OK BUSY WR 0\r\n"
        (strike,) = stage.faulty.struck
        assert (strike.way, strike.before, strike.after) == ("", b"", b"")
        await stage.wait(10.0)
        where = number(strike.what, "device 2 halts at ([0-9]+) microsteps")
        assert 0 < where < 384000
        assert await stage.ask(b"/2 1 get pos\n") == b"@02 1 OK IDLE %b %d\r\n" % (flag, where)
        assert await stage.ask(b"/2 1 warnings clear\n") == b"@02 1 OK IDLE WR 02 %b WR\r\n" % flag
        assert (await stage.ask(b"/2 1 move rel 1000\n")).startswith(b"@02 1 OK BUSY WR")
        await stage.wait(10.0)
        assert await stage.ask(b"/2 1 get pos\n") == b"@02 1 OK IDLE WR %d\r\n" % (where + 1000)

    scene("zaber", act, Fault(kind, seed))


def test_the_alert_of_a_stalled_stage_comes_when_it_halts() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"/1 set comm.alert 1\n", b"/1 1 move rel 384000\n")
        axis = stage.inner.axes[0]  # type: ignore[attr-defined]
        assert axis.track.end < 384000 / 1_536_000 * 360 / 60  # a quarter of a turn at 60 deg/s
        await stage.wait(axis.track.end - 1e-6)
        assert len(stage.heard) == 2
        await stage.wait(2e-6)
        assert stage.heard[2:] == [b"!01 1 IDLE FS\r\n"]

    scene("zaber", act, Fault("stall", 1))


def test_a_stop_before_the_stall_is_a_stop() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"/1 1 move rel 384000\n", b"/1 1 stop\n")
        await stage.wait(10.0)
        assert await stage.ask(b"/1\n") == b"@01 0 OK IDLE WR 0\r\n"

    scene("zaber", act, Fault("stall", 1))


def test_a_stalled_homing_leaves_the_axis_unhomed() -> None:
    async def zaber(stage: Scene) -> None:
        await stage.say(b"/1 1 home\n")
        await stage.wait(60.0)
        assert await stage.ask(b"/1 1 warnings\n") == b"@01 1 OK IDLE FS 02 FS WR\r\n"
        assert (await stage.ask(b"/1 1 move abs 1000\n")).split()[2] == b"RJ"

    scene("zaber", zaber, Fault("stall", 1))

    async def newport(stage: Scene) -> None:
        await stage.say(b"1MO\r", b"1OR1\r")
        await stage.wait(60.0)
        assert await stage.ask(b"TE?\r") == b"103\r\n"
        assert float(await stage.ask(b"1TP\r")) < -0.5  # it came from 0, where it stood at power-up, and is not at the switch, now 0

    scene("newport", newport, Fault("stall", 1))

    async def oriental(stage: Scene) -> None:
        await stage.say(framed("01 06 00 7D 00 10"), framed("01 06 00 7D 00 00"))
        await stage.wait(60.0)
        assert not struct.unpack(">H", (await stage.ask(framed("01 03 00 7F 00 01")))[3:5])[0] & 0x10  # HOME-END

    scene("oriental", oriental, Fault("limit-hit", 1))

    async def shot(stage: Scene) -> None:
        await stage.say(b"H:1\r\n")
        await stage.wait(60.0)
        count = int((await stage.ask(b"Q:\r\n")).split(b",")[0].replace(b" ", b""))
        assert count < 0  # as counted from power-up; a homing that had ended would read 0

    scene("shot", shot, Fault("limit-hit", 1))


def test_a_zaber_driver_disabled() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"/1 1 move rel 384000\n", b"/2 1 move rel 384000\n")
        await stage.wait(0.5)
        stage.faulty.inject(Fault("alarm", 1))
        shown = [await stage.ask(b"/%d\n" % device) for device in (1, 2)]
        device = int(number(stage.faulty.struck[0].what, r"device (\d) shows FO"))
        assert shown[device - 1] == b"@%02d 0 OK IDLE FO 0\r\n" % device
        assert shown[2 - device] == b"@%02d 0 OK BUSY WR 0\r\n" % (3 - device)
        for command in (b"move rel 1000", b"home", b"move vel 1000"):
            assert await stage.ask(b"/%d 1 %b\n" % (device, command)) == b"@%02d 1 RJ IDLE FO DRIVERDISABLED\r\n" % device
        await stage.say(b"/%d 1 warnings clear\n" % device)
        assert await stage.ask(b"/%d 1 stop\n" % device) == b"@%02d 1 OK IDLE FO 0\r\n" % device
        assert await stage.ask(b"/%d 1 driver enable\n" % device) == b"@%02d 1 OK IDLE WR 0\r\n" % device
        assert (await stage.ask(b"/%d 1 move rel 1000\n" % device)).startswith(b"@%02d 1 OK BUSY" % device)

    scene("zaber", act)


@pytest.mark.parametrize("way", [b"", b"-"])
@pytest.mark.parametrize(("kind", "power"), [("stall", b"0"), ("limit-hit", b"1")])
def test_an_esp_axis_halts_on_its_way(kind: str, power: bytes, way: bytes) -> None:
    error = b"203" if kind == "stall" else b"205" if way else b"204"

    async def act(stage: Scene) -> None:
        await stage.say(b"2SL-90\r", b"2MO\r", b"2PR%b30\r" % way)
        assert await stage.ask(b"2MD?\r") == b"0\r\n"
        await stage.wait(10.0)
        where = number(stage.faulty.struck[0].what, r"axis 2 halts at (-?[0-9.]+) deg")
        assert 0 < abs(where) < 30
        assert float(await stage.ask(b"2TP\r")) == pytest.approx(where, abs=1.5e-4)
        assert await stage.ask(b"TE?\r") == error + b"\r\n"
        assert await stage.ask(b"TE?\r") == b"0\r\n"
        assert await stage.ask(b"2MO?\r") == power + b"\r\n"
        assert await stage.ask(b"1MO?\r") == b"0\r\n"

    scene("newport", act, Fault(kind, 2))


def test_an_esp_amplifier_fails() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"1MO\r", b"2MO\r", b"1PR30\r", b"2PR30\r")
        await stage.wait(0.2)
        stage.faulty.inject(Fault("alarm", 3))
        done = [await stage.ask(b"%dMD?\r" % axis) for axis in (1, 2)]
        code = int(await stage.ask(b"TE?\r"))
        assert code in (102, 202)
        assert done == ([b"1\r\n", b"0\r\n"] if code == 102 else [b"0\r\n", b"1\r\n"])
        assert await stage.ask(b"%dMO?\r" % (code // 100)) == b"0\r\n"

    scene("newport", act)


@pytest.mark.parametrize(("axis", "letter"), [(1, b"L"), (2, b"M")])
@pytest.mark.parametrize("name", ["shot", "gsc"])
def test_a_sigma_koki_axis_meets_a_sensor(name: str, axis: int, letter: bytes) -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"M:%d+P10000\r\n" % axis, b"G:\r\n")
        assert (await stage.ask(b"Q:\r\n")).endswith(b",K,K,B\r\n")
        await stage.wait(10.0)
        where = number(stage.faulty.struck[0].what, f"axis {axis} halts at ([0-9]+) pulses")
        assert 0 < where < 10000
        status = (await stage.ask(b"Q:\r\n")).strip().split(b",")
        assert (int(status[axis - 1]), status[2:]) == (where, [b"K", letter, b"R"])
        await stage.say(b"M:%d-P100\r\n" % axis, b"G:\r\n")
        await stage.wait(10.0)
        assert (await stage.ask(b"Q:\r\n")).endswith(b",K,K,R\r\n")

    scene(name, act, Fault("limit-hit", 4))


# The sheet's own frame: 8500 steps on, at 2000 Hz.
START = bytes.fromhex("01 10 00 58 00 10 20 00000000 00000002 00002134 000007D0 000005DC 000005DC 000003E8 00000001 1C 08")


@pytest.mark.parametrize(("kind", "codes"), [("stall", (0x10, 0x30)), ("limit-hit", (0x60, 0x66))])
def test_an_az_axis_halts_on_its_way(kind: str, codes: tuple[int, ...]) -> None:
    async def word(stage: Scene, address: str) -> int:
        reply = await stage.ask(framed(f"01 03 {address} 00 02"))
        assert reply == framed(reply[:-2].hex())
        return int(struct.unpack(">i", reply[3:7])[0])

    seen = set()
    for seed in range(8):

        async def act(stage: Scene) -> None:
            assert await word(stage, "00 7E") & 1 << 5  # READY
            await stage.say(START)
            assert await word(stage, "00 7E") & 1 << 13  # MOVE
            await stage.wait(60.0)
            where = number(stage.faulty.struck[0].what, "device 1: halts at ([0-9]+) steps")
            assert 0 < where < 8500
            assert await word(stage, "00 CC") == where
            assert await word(stage, "00 7E") & (1 << 13 | 1 << 7 | 1 << 5) == 1 << 7  # ALM-A
            seen.add(await word(stage, "00 80"))
            assert (await stage.ask(START))[1] == 0x90
            await stage.say(framed("01 06 01 81 00 01"))
            assert await word(stage, "00 80") == 0

        scene("oriental", act, Fault(kind, seed))
    assert seen == set(codes)


def test_an_az_alarm() -> None:
    codes = set()
    for seed in range(12):

        async def act(stage: Scene) -> None:
            alarms = [struct.unpack(">I", (await stage.ask(framed(f"0{i} 03 00 80 00 02")))[3:7])[0] for i in (1, 2)]
            device, code = re.fullmatch(r"device (\d): alarm (\w\w)h", stage.faulty.struck[0].what).groups()  # type: ignore[union-attr]
            assert alarms == [int(code, 16) if i == int(device) else 0 for i in (1, 2)]
            codes.add((device, code))

        scene("oriental", act, Fault("alarm", seed))
    assert {device for device, _ in codes} == {"1", "2"}
    assert len({code for _, code in codes}) > 2


def test_keithley_overflows_once() -> None:
    async def act(stage: Scene) -> None:
        await stage.say(b"FORM:ELEM READ,STAT\n", b"READ?\n")
        await stage.wait(5.0)
        await stage.say(b"SYST:ZCH OFF\n", b"READ?\n")
        await stage.wait(5.0)
        await stage.say(b"READ?\n")
        await stage.wait(5.0)

    checked, dazzled, plain = ([float(n) for n in text.split(b",")] for text in scene("keithley", act, Fault("over-range")).heard)
    assert abs(checked[0]) < 1e-6  # under zero check no light reaches the input
    assert (checked[1], dazzled, plain[1]) == (512, [9.9e37, 1], 0)
    assert plain[0] == pytest.approx(1e-9, rel=0.01)


@pytest.mark.parametrize(
    ("name", "over", "plain"), [("ls-100", b"ER10", b"OK00,   123.4"), ("cs-100a", b"OK12,,,", b"OK00,  123.4,.3127,.3290")]
)
def test_luminance_meters(name: str, over: bytes, plain: bytes) -> None:
    async def measure(stage: Scene) -> bytes:
        before = len(stage.heard)
        await stage.say(b"MES\r\n")
        await stage.wait(5.0)
        return b"".join(stage.heard[before:]).removesuffix(b"\r\n")

    async def dazzled(stage: Scene) -> None:
        assert [await measure(stage), await measure(stage)] == [over, plain]

    async def weak(stage: Scene) -> None:
        assert [await measure(stage), await measure(stage)] == [b"ER30", b"ER30"]
        stage.inner.battery_low = False  # type: ignore[attr-defined]
        assert await measure(stage) == plain

    scene(name, dazzled, Fault("over-range"))
    scene(name, weak, Fault("alarm"))


def test_apogee_at_full_scale_once() -> None:
    async def act(stage: Scene) -> None:
        seen = []
        for _ in range(4):
            await stage.wait(0.5)
            seen.append(struct.unpack(">f", (await stage.ask(TALK["apogee"][0]))[3:7])[0])
        assert seen == [1000.0, 4000.0, 1000.0, 1000.0]

    scene("apogee", act, Fault("over-range", after=2))


def test_baumer_loses_its_target_once_and_its_window_gets_dirty() -> None:
    async def distance(stage: Scene) -> tuple[int, int, float]:
        reply = await stage.ask(framed("01 04 00 C8 00 0D"))
        quality, outputs, low, high = struct.unpack(">4H", reply[3:11])
        return quality, outputs & 2, struct.unpack(">f", struct.pack(">2H", high, low))[0]

    async def lost(stage: Scene) -> None:
        await stage.wait(1.0)
        await stage.say(framed("01 04 00 20 00 1A"))  # the product's name tells no distance
        quality, alarm, none = await distance(stage)
        assert (quality, alarm, math.isnan(none)) == (2, 2, True)
        assert await distance(stage) == (0, 0, 100.0)

    async def dirty(stage: Scene) -> None:
        await stage.wait(1.0)
        assert await distance(stage) == (2, 2, 100.0)
        stage.inner.units[1].quality = 0  # type: ignore[attr-defined]
        assert await distance(stage) == (0, 0, 100.0)

    scene("om20", lost, Fault("over-range"))
    scene("om20", dirty, Fault("alarm"))


def test_optoncdt_sends_error_words() -> None:
    counts = set()
    for seed in range(5):

        async def act(stage: Scene) -> None:
            await stage.say(b"OUTPUT RS422\r\n")
            await stage.wait(0.1)

        stage = scene("optoncdt", act, Fault("over-range", seed))
        stream = b"".join(stage.heard).partition(b"->")[2]
        words = [a & 0x3F | (b & 0x3F) << 6 | (c & 0x3F) << 12 for a, b, c in zip(*[iter(stream)] * 3, strict=True)]
        count = int(number(stage.faulty.struck[0].what, "next ([0-9]+) values"))
        assert words == [262_077] * count + [32_760] * (len(words) - count)
        counts.add(count)
    assert len(counts) > 1


# Nothing pending


class Script:
    """An instrument that answers each stretch of bytes with a given one."""

    name = model = "script"

    def __init__(self, replies: list[bytes]) -> None:
        self._replies = list(replies)

    async def serve(self, line: Line) -> None:
        while await line.read():
            if self._replies:
                line.write(self._replies.pop(0))
            await line.drain()


PIECES = st.lists(st.binary(min_size=1, max_size=12) | st.sampled_from([b"\r", b"\n", b"\x18", b"VE?\r", TALK["om20"][0]]), max_size=12)


def script(said: list[bytes], replies: list[bytes], inner: Callable[[], Instrument] | None = None, *faults: Fault) -> Scene:
    async def play() -> Scene:
        clock = ManualClock()
        stage = Scene(inner() if inner else Script(replies), clock)
        for fault in faults:
            stage.faulty.inject(fault)
        await stage.say(*said)
        await stage.end()
        return stage

    return asyncio.run(play())


@settings(max_examples=100, deadline=None)
@given(PIECES, st.lists(st.binary(min_size=1, max_size=20), max_size=12))
def test_a_faulty_line_with_nothing_pending_is_transparent(said: list[bytes], replies: list[bytes]) -> None:
    stage = script(said, replies)
    assert [*map(id, stage.received)] == [*map(id, said)]  # not even a copy
    assert [*map(id, stage.heard)] == [*map(id, replies[: len(said)])]
    assert stage.faulty.struck == []


@settings(max_examples=60, deadline=None)
@given(PIECES, st.sampled_from(["zaber", "om20", "keithley"]))
def test_a_fault_that_is_not_due_changes_no_byte(said: list[bytes], name: str) -> None:
    def silent() -> Instrument:
        inner = MAKERS[name](ManualClock())

        async def serve(line: Line) -> None:
            while await line.read():
                pass

        inner.serve = serve  # type: ignore[method-assign]
        return inner

    stage = script(said, [], silent, Fault("silence", after=1000))
    assert b"".join(stage.received) == b"".join(said)


def test_a_failure_of_the_simulator_is_not_hidden() -> None:
    class Broken(Script):
        async def serve(self, line: Line) -> None:
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        asyncio.run(Faulty(Broken([]), ManualClock()).serve(Tape()))
