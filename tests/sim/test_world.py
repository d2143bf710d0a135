"""What the world is made of: streams of random numbers, arms on any axis, sensors in their own units, stop commands."""

from __future__ import annotations

import asyncio
import json
import math
import struct
import time
from pathlib import Path

import pytest

from sim.bench import Misalignment
from sim.clock import ManualClock
from sim.errors import SimError
from sim.faults import Fault
from sim.modbus import ModbusBus, crc
from sim.newport import Esp301
from sim.sigma_koki import SigmaKoki
from sim.world import INSTRUMENTS, LINES, Settings, World, build
from sim.zaber import ZaberChain

ALL = tuple(INSTRUMENTS)
WHITE = "lambert:1"


class Desk:
    """A world with a clock in hand."""

    def __init__(self, *instruments: str, source: str | None = None, detector: str | None = None, seed: int = 5) -> None:
        self.clock = ManualClock(eager=True)
        settings = Settings(
            WHITE, seed=seed, misalignment=Misalignment(0.1, -0.08), instruments=instruments, source=source, detector=detector
        )
        self.world = build(settings, self.clock)

    def wait(self, seconds: float = 100.0) -> None:
        self.clock.set(self.clock.now() + seconds)

    def zaber(self, name: str, *packets: bytes) -> None:
        chain = self.world.devices[name]
        assert isinstance(chain, ZaberChain)
        for packet in packets:
            assert all(b" OK " in reply for reply in chain.answer(packet))
            self.wait()

    def newport(self, *commands: bytes) -> None:
        esp = self.world.devices["newport"]
        assert isinstance(esp, Esp301)
        for command in commands:
            esp.execute(command)
            self.wait()

    def sigma(self, name: str, *commands: bytes) -> None:
        sigma = self.world.devices[name]
        assert isinstance(sigma, SigmaKoki)
        for command in commands:
            assert sigma.answer(command) in (b"OK", None)
            self.wait()

    def modbus(self, name: str, *frames: bytes) -> bytes:
        bus = self.world.devices[name]
        assert isinstance(bus, ModbusBus)
        reply = b""
        for frame in frames:
            reply = bus.answer(frame + crc(frame)) or b""
            assert not reply[1] & 0x80
            self.wait()
        return reply[3:-2]

    def angles(self) -> tuple[float, float]:
        return self.world.bench.angles(self.clock.now())


# Random numbers


@pytest.mark.parametrize(
    ("seed", "parked", "misalignment", "trend", "offset", "readings", "signal"),
    [
        (
            7,
            (287.2293072636083, 19.113797972305466),
            Misalignment(-0.09805820057358117, -0.07226889399909658),
            0.0038961327067087194,
            3.5807207175562234e-13,
            [b"+5.008740E-07", b"+5.008780E-07", b"+5.008870E-07", b"+5.008990E-07"],
            5.006929752585515e-07,
        ),
        (
            20260101,
            (184.08395776221158, 353.91647132327404),
            Misalignment(-0.07769549620884085, -0.08027640774409654),
            -0.0025764949855304965,
            -4.072650352286002e-13,
            [b"+5.004410E-07", b"+5.004560E-07", b"+5.004650E-07", b"+5.004670E-07"],
            5.0074704984023e-07,
        ),
    ],
)
@pytest.mark.parametrize("instruments", [("stages", "meter"), ALL])
def test_earlier_runs_are_reproduced_to_the_last_digit(
    instruments: tuple[str, ...],
    seed: int,
    parked: tuple[float, float],
    misalignment: Misalignment,
    trend: float,
    offset: float,
    readings: list[bytes],
    signal: float,
) -> None:
    """As the world of two instruments was before it had others; whatever else is served changes nothing."""
    clock = ManualClock(eager=True)
    world = build(Settings(specimen="lambert:0.5", seed=seed, instruments=instruments), clock)
    assert tuple(axis.track.nominal(0.0)[0] for axis in world.stages.axes) == parked
    assert (world.bench.misalignment, world.bench.lamp.trend, world.meter.offset) == (misalignment, trend, offset)
    world.stages.answer(b"/0 home")
    clock.set(60.0)
    world.stages.answer(b"/1 1 move abs 576000")
    world.stages.answer(b"/2 1 move abs 341333")
    clock.set(75.0)

    async def read() -> list[bytes | None]:
        for command in (b"*RST", b"SYST:ZCH OFF", b"FORM:ELEM READ"):
            await world.meter.answer(command)
        return [await world.meter.answer(b"READ?") for _ in range(4)]

    assert asyncio.run(read()) == readings
    assert world.bench.signal(80.0, 80.1) == signal


def test_an_instrument_is_the_same_whatever_is_served_beside_it() -> None:
    everything = Desk(*ALL).world
    for name in ("linear", "newport", "shot", "gsc", "oriental"):
        alone = Desk(name).world
        numbers = {axis: track.nominal(0.0)[0] for axis, track in alone.axes.items()}
        assert list(numbers) == [f"{name}:1", f"{name}:2"]
        assert numbers == {axis: everything.axes[axis].nominal(0.0)[0] for axis in numbers}
    parked = [track.nominal(0.0)[0] for track in everything.axes.values()]
    assert len(set(parked)) == len(parked) == 12


def test_each_has_a_name_a_model_and_line_settings() -> None:
    world = Desk(*ALL).world
    assert {name: device.model for name, device in world.devices.items()} == {
        "stages": "zaber-x-rsw60a",
        "linear": "zaber-x-lsm",
        "newport": "newport-esp301",
        "shot": "sigma-koki-shot-302gs",
        "gsc": "sigma-koki-gsc-02",
        "oriental": "oriental-az",
        "meter": "keithley-6485",
        "ls-100": "konica-minolta-ls-100",
        "cs-100a": "konica-minolta-cs-100a",
        "apogee": "apogee-sq-422x",
        "om20": "baumer-om20",
        "optoncdt": "micro-epsilon-ild1420",
    }
    assert all(device.name == name for name, device in world.devices.items())
    assert {*LINES, "camera"} == set(INSTRUMENTS)


# Arms


def test_the_arms_are_carried_by_the_zaber_stages_unless_told_otherwise() -> None:
    desk = Desk("stages", "meter")
    assert {arm: carried.axis for arm, carried in desk.world.arms.items()} == {"source": "stages:1", "detector": "stages:2"}
    desk.zaber("stages", b"/0 home", b"/1 1 move abs 576000", b"/2 1 move abs 341333")
    assert desk.angles() == pytest.approx((45.1, -20.08), abs=1e-3)
    arms, now = desk.world.arms, desk.clock.now()
    assert arms["source"].nominal(now) == pytest.approx(45.0)
    assert arms["detector"].nominal(now) == pytest.approx(-20.0, abs=1e-3)


def test_mixed_arms_move_the_light() -> None:
    desk = Desk(*ALL, source="newport:2", detector="shot:1")
    desk.newport(b"2MO", b"2OR1", b"2PA135")
    desk.sigma("shot", b"H:1", b"A:1+P32000", b"G:")
    now = desk.clock.now()
    assert desk.angles() == pytest.approx((45.1, -20.08), abs=1e-3)
    assert desk.world.arms["source"].nominal(now) == pytest.approx(45.0)
    lit = desk.world.bench.photocurrent(now, now + 0.1)
    assert lit == pytest.approx(float(desk.world.truth(45.0, -20.0)), rel=0.01, abs=0)
    desk.newport(b"2PA150")  # 60 deg
    now = desk.clock.now()
    dimmed = desk.world.bench.photocurrent(now, now + 0.1)
    assert dimmed / lit == pytest.approx(math.cos(math.radians(60.1)) / math.cos(math.radians(45.1)), rel=0.01)
    desk.zaber("stages", b"/0 home", b"/1 1 move abs 1000000")  # carries nothing
    desk.newport(b"1MO", b"1OR1")
    assert desk.angles() == pytest.approx((60.1, -20.08), abs=1e-3)


def test_an_arm_may_ride_on_any_rotary_axis() -> None:
    desk = Desk(*ALL, source="oriental:2", detector="gsc:2")
    start = struct.pack(">BBHHB8i", 2, 16, 0x58, 16, 32, 0, 1, 6750, 1000, 1_000_000, 1_000_000, 1000, 1)
    desk.modbus("oriental", b"\x02\x06\x00\x7d\x00\x10", b"\x02\x06\x00\x7d\x00\x00", start)  # ZHOME; 135 deg at 0.02 deg a step
    desk.sigma("gsc", b"H:2+", b"A:2+P32000", b"G")
    assert desk.angles() == pytest.approx((45.1, -20.08), abs=1e-3)


def test_reach_and_motion_of_an_arm() -> None:
    desk = Desk("newport", source="newport:1")
    desk.newport(b"1MO", b"1OR1", b"1PA135", b"1PA30")
    source, t = desk.world.arms["source"], desk.clock.now()
    low, high = source.reach
    assert low == pytest.approx(-90.0)  # while homing; the arm stood within 0 to 360 deg of its stage before
    assert high >= 45.0
    esp = desk.world.devices["newport"]
    assert isinstance(esp, Esp301)
    esp.execute(b"1PA100")
    desk.wait(0.5)
    assert source.moving(desk.clock.now())
    esp.execute(b"1ST")  # at 57 deg, 3 more to brake
    assert source.reach_since(t) == (pytest.approx(-60.0), pytest.approx(-33.0))
    desk.wait()
    assert source.reach_since(t) == (pytest.approx(-60.0), pytest.approx(-30.0))
    assert not source.moving(desk.clock.now())
    assert source.reach[1] == high


def test_arms_stand_still_where_no_stages_are_served() -> None:
    world = Desk("meter", "newport").world
    assert world.bench.angles(0.0) == pytest.approx((45.1, -0.08))
    assert world.bench.angles(1e6) == world.bench.angles(0.0)
    assert {carried.axis for carried in world.arms.values()} == {None}
    assert world.arms["source"].reach == (45.0, 45.0)


@pytest.mark.parametrize(
    ("instruments", "source", "detector", "message"),
    [
        (("stages",), "newport:1", None, r"source 'newport:1': .* stages:1 or stages:2$"),
        (("stages",), "stages:3", None, r"source 'stages:3': .* stages:1 or stages:2$"),
        (("stages", "linear"), None, "linear:2", r"detector 'linear:2': .*rotary.* stages:1 or stages:2$"),
        (("meter",), None, "stages:2", r"detector 'stages:2': .* none$"),
        (("stages",), "stages:2", None, "both arms"),
        (("stages", "theodolite"), None, None, r"'theodolite': expected some of stages, linear, .*, camera$"),
        (("stages", "stages"), None, None, "each but once"),
        ((), None, None, "at least one"),
    ],
)
def test_what_does_not_fit_together_is_refused(
    instruments: tuple[str, ...], source: str | None, detector: str | None, message: str
) -> None:
    with pytest.raises(SimError, match=message):
        Desk(*instruments, source=source, detector=detector)


# Sensors


def test_every_light_sensor_tells_the_same_light_in_its_own_unit() -> None:
    desk = Desk(*ALL, source="newport:1", detector="newport:2")
    desk.newport(b"1MO", b"2MO", b"1OR1", b"2OR1", b"1PA135", b"2PA100")
    devices, bench, now = desk.world.devices, desk.world.bench, desk.clock.now()
    level = bench.lamp.level(now)
    # A white Lambertian at 45 deg gives 1000 nA; its radiance is E cos/pi = 5 W/(m^2 sr) and its luminance 300 lm/W of that.
    lit = level * math.cos(math.radians(45.1)) / math.cos(math.radians(45))
    assert bench.photocurrent(now, now + 0.1) == pytest.approx(1e-6 * lit, rel=1e-3, abs=0)
    assert bench.radiance(now, now + 0.1) == pytest.approx(5 * lit, rel=1e-3)

    async def asked(name: str) -> list[str]:
        reply: bytes = await devices[name].answer(b"MES")  # type: ignore[attr-defined]
        return reply.decode().split(",")

    for name in ("ls-100", "cs-100a"):
        code, luminance, *_ = asyncio.run(asked(name))
        assert (code, float(luminance)) == ("OK00", pytest.approx(1500 * lit, rel=5e-3))
    (flux,) = struct.unpack(">f", desk.modbus("apogee", b"\x01\x03\x00\x00\x00\x02"))
    assert flux == pytest.approx(5 * math.sqrt(2) * math.pi * 4.6 * level, rel=5e-3)
    # The quantum sensor faces the lamp: where the lamp and the detector stand is nothing to it.
    desk.newport(b"1PA100", b"2PA110")  # the detector's arm in the beam
    assert bench.photocurrent(desk.clock.now(), desk.clock.now() + 0.1) == 0
    (flux,) = struct.unpack(">f", desk.modbus("apogee", b"\x01\x03\x00\x00\x00\x02"))
    assert flux == pytest.approx(102.2, rel=0.02)
    assert float(asyncio.run(asked("ls-100"))[1]) == 0


def test_truth_is_at_the_angles_the_stages_tell() -> None:
    world = Desk("stages").world
    assert float(world.truth(45.0, -20.0)) == float(world.bench.light(45.1, -20.08))
    assert world.truth([30.0, 60.0], 0.0) == pytest.approx(world.bench.light([30.1, 60.1], -0.08), rel=1e-9, abs=0)
    nominal = math.cos(math.radians(45.1)) / math.cos(math.radians(45))
    assert float(world.truth(45.0, 0.0)) == pytest.approx(1e-6 * nominal, rel=1e-9, abs=0)
    assert float(world.truth(45.0, 0.0, "ls-100")) == pytest.approx(1500 * nominal)
    assert world.truth([30.0, 60.0], 0.0, "apogee") == pytest.approx([102.18, 102.18], rel=1e-3)
    with pytest.raises(SimError, match="'om20'"):
        world.truth(45.0, 0.0, "om20")


def test_range_finders_see_the_plate_the_linear_stage_moves() -> None:
    desk = Desk(*ALL)

    def seen() -> float:
        low, high = struct.unpack(">2H", desk.modbus("om20", b"\x01\x04\x00\xca\x00\x02"))
        return float(struct.unpack(">f", struct.pack(">2H", high, low))[0])

    opto = desk.world.devices["optoncdt"]
    for steps in (100_000, 1_000_000):
        desk.zaber("linear", b"/1 home", b"/1 1 move abs %d" % steps)
        position = steps * 0.047625e-3
        assert seen() == pytest.approx(60 + position, abs=0.06)
        word = opto._word(desk.clock.now(), desk.clock.now() + 1e-3)  # type: ignore[attr-defined]
        assert (word * 1.02 / 65520 - 0.01) * 50 == pytest.approx(position, abs=0.03)
    before = seen()
    desk.zaber("linear", b"/2 home", b"/2 1 move abs 500000")  # y
    assert seen() == pytest.approx(before, abs=0.06)
    assert Desk("om20").modbus("om20", b"\x01\x04\x00\xca\x00\x02")


# Stops


def stop_everything(desk: Desk) -> list[str]:
    desk.zaber("stages", b"/2 stop", b"/stop")
    desk.newport(b"1ST", b"2AB", b"AB", b"ST", b"1PA5")
    desk.sigma("shot", b"L:2", b"L:W")
    desk.sigma("gsc", b"L:E")
    # STOP on and off again to unit 2, off to unit 1, on to all.
    desk.modbus("oriental", b"\x02\x06\x00\x7d\x00\x20", b"\x02\x06\x00\x7d\x00\x00", b"\x01\x06\x00\x7d\x00\x00")
    bus = desk.world.devices["oriental"]
    assert isinstance(bus, ModbusBus)
    everybody = b"\x00\x06\x00\x7d\x00\x20"
    assert bus.answer(everybody + crc(everybody)) is None
    return [
        "stages:2", "stages:1", "stages:2", "newport:1", "newport:2", "newport:1", "newport:2",
        "shot:2", "shot:1", "shot:2", "gsc:1", "gsc:2", "oriental:2", "oriental:1", "oriental:2",
    ]  # fmt: skip


def test_stop_commands_are_logged_with_the_real_time(tmp_path: Path) -> None:
    desk = Desk(*ALL)
    path = tmp_path / "stops.jsonl"
    before = time.monotonic()
    with desk.world.stops.written_to(path):
        expected = stop_everything(desk)
        written = [json.loads(line) for line in path.read_text().splitlines()]  # while it goes on: each line is there at once
    desk.zaber("stages", b"/1 stop")
    stops = desk.world.stops.all()
    assert [stop.axis for stop in stops] == [*expected, "stages:1"]
    assert [(stop["time"], stop["axis"]) for stop in written] == list(stops[:-1])
    assert len(path.read_text().splitlines()) == len(expected)
    times = [before, *(stop.time for stop in stops), time.monotonic()]
    assert times == sorted(times)


def test_a_stop_log_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SimError, match="no-such"), Desk("stages").world.stops.written_to(tmp_path / "no-such" / "file"):
        pass


# Faults


def made(*faults: str) -> World:
    return build(Settings(WHITE, instruments=("stages", "om20", "camera"), faults=faults), ManualClock())


def test_faults_wait_at_the_instrument_they_are_for() -> None:
    world = made("stages:silence:3:10", "om20:wrong-checksum:7", "stages:delay:1")
    assert {name: faulty.pending for name, faulty in world.faulty.items()} == {
        "stages": (Fault("silence", 3, 10), Fault("delay", 1)),
        "om20": (Fault("wrong-checksum", 7),),
    }


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("meter:silence:1", "'meter:silence:1': expected one of stages, om20"),
        ("camera:silence:1", "expected one of stages, om20"),
        ("stages:over-range:1", "no fault over-range"),
        ("stages:hiccup:1", "hiccup"),
        ("stages", "NAME:KIND:SEED"),
    ],
)
def test_a_fault_that_cannot_be_is_refused(fault: str, message: str) -> None:
    with pytest.raises(SimError, match=message):
        made(fault)
