"""The AZ driver behind its registers: motion, inputs, outputs, alarms."""

from __future__ import annotations

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.modbus import FAILURE, ILLEGAL_VALUE, ModbusBus, Refusal, crc
from sim.motion import Profile
from sim.oriental import ALM_A, FREE, HOME_END, IN_POS, MOVE, NOT_RESETTABLE, READY, START, STOP, ZHOME, AzAxis, AzModel, to_target

STEP = 0.02  # deg


class Desk:
    """One axis with a clock in hand."""

    def __init__(self, model: AzModel | None = None, angle: float = 200.0) -> None:
        self.clock = ManualClock()
        self.axis = AzAxis(model or AzModel(), angle)
        self.bus = ModbusBus(self.clock, {1: self.axis}, "az", "az")

    def send(self, text: str) -> str:
        data = bytes.fromhex(text)
        reply = self.bus.answer(data + crc(data))
        assert reply is not None
        return reply[:-2].hex(" ").upper()

    def read(self, address: int) -> int:
        high, low = self.axis.read_holding(self.clock.now(), address, 2)
        return (high << 16 | low) - ((high & 0x8000) << 17)

    def write(self, address: int, *numbers: int) -> None:
        words = [word for number in numbers for word in (number >> 16 & 0xFFFF, number & 0xFFFF)]
        self.axis.write_holding(self.clock.now(), address, words)

    def pulse(self, bits: int) -> None:
        self.write(0x7C, bits)
        self.write(0x7C, 0)

    def wait(self, seconds: float = 60.0) -> None:
        self.clock.set(self.clock.now() + seconds)

    def home(self) -> None:
        self.pulse(ZHOME)
        self.wait()

    def start(self, kind: int, position: int, speed: int = 1000, rate: int = 10_000, stop_rate: int = 10_000) -> None:
        self.write(0x58, 0, kind, position, speed, rate, stop_rate, 1000, 1)

    @property
    def outputs(self) -> int:
        return self.read(0x7E)

    @property
    def alarm(self) -> int:
        return self.read(0x80)


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def homed(desk: Desk) -> Desk:
    desk.home()
    return desk


# At the wire


def test_the_sheet_s_frame_turns_the_table_by_8500_steps(homed: Desk) -> None:
    frame = "01 10 00 58 00 10 20 00000000 00000002 00002134 000007D0 000005DC 000005DC 000003E8 00000001 1C 08"
    assert homed.bus.answer(bytes.fromhex(frame)) == bytes.fromhex("01 10 00 58 00 10") + crc(bytes.fromhex("01 10 00 58 00 10"))
    # 2000 Hz at 1500 Hz/s: two ramps of 4/3 s, and what they leave of 8500 steps at full speed.
    duration = 2 * 2000 / 1500 + (8500 - 2000**2 / 1500) / 2000
    homed.wait(duration - 0.01)
    assert homed.outputs & (MOVE | READY | IN_POS) == MOVE
    homed.wait(0.02)
    assert homed.outputs & (MOVE | READY | IN_POS) == READY | IN_POS
    assert homed.read(0xCC) == homed.read(0xC6) == homed.read(0x120) == homed.read(0x122) == 8500
    assert homed.axis.track.mechanical(homed.clock.now() + 5) == pytest.approx(8500 * STEP)


def test_home_and_stop_as_the_sheet_spells_them(desk: Desk) -> None:
    assert desk.send("01 03 00 7F 00 01") == "01 03 02 40 20"
    for frame in ("01 06 00 7D 00 10", "01 06 00 7D 00 00"):
        assert desk.send(frame) == frame
    assert desk.send("01 03 00 7F 00 01") == "01 03 02 20 00"
    desk.wait()
    assert desk.send("01 03 00 7F 00 01") == "01 03 02 40 30"
    assert desk.send("01 03 00 CC 00 02") == "01 03 04 00 00 00 00"
    desk.start(1, 9000)
    desk.wait(3)
    for frame in ("01 06 00 7D 00 20", "01 06 00 7D 00 00"):
        assert desk.send(frame) == frame
    desk.wait(1)
    assert 0 < desk.read(0xCC) < 9000
    assert desk.outputs & READY


@pytest.mark.parametrize(
    ("text", "reply"),
    [
        ("01 04 00 7F 00 01", "01 84 01"),
        ("01 03 10 00 00 01", "01 83 02"),
        ("01 06 00 7F 00 01", "01 86 02"),
        ("01 10 00 5E 00 02 04 7F FF FF FF", "01 90 03"),
        ("01 10 00 68 00 02 04 00 00 00 01", "01 90 03"),
        ("01 08 00 00 12 34", "01 08 00 00 12 34"),
    ],
)
def test_requests_that_are_refused(desk: Desk, text: str, reply: str) -> None:
    assert desk.send(text) == reply


# Motion


def test_absolute_incremental_and_from_feedback(homed: Desk) -> None:
    for kind, position, ends in ((1, 5000, 5000), (2, -1000, 4000), (3, 500, 4500), (1, 0, 0)):
        homed.start(kind, position)
        homed.wait()
        assert homed.read(0xCC) == ends


def test_the_speed_shows_under_way(homed: Desk) -> None:
    homed.start(1, 5000, speed=1000)
    homed.wait(2.0)
    assert homed.read(0xD0) == 1000
    assert homed.read(0xCE) == 60


def test_a_new_start_under_way_takes_over(homed: Desk) -> None:
    homed.start(1, 9000)
    homed.wait(2)
    homed.start(1, 100)
    homed.wait()
    assert homed.read(0xCC) == 100


def test_one_field_alone_changes_under_way(homed: Desk) -> None:
    homed.start(1, 9000)
    homed.wait(1)
    homed.write(0x5C, 3000)
    homed.write(0x58, 5)  # not taken over: only the position is triggered
    homed.write(0x66, -5)
    homed.wait()
    assert homed.read(0xCC) == 3000


def test_no_trigger_no_start(homed: Desk) -> None:
    homed.write(0x58, 0, 1, 5000, 1000, 1000, 1000, 1000, 0)
    homed.wait()
    assert homed.read(0xCC) == 0
    homed.write(0x66, 1)
    homed.wait()
    assert homed.read(0xCC) == 5000


def test_stored_operations(homed: Desk) -> None:
    homed.write(0x0400 + 2 * 3, 700)
    homed.write(0x0500 + 2 * 3, 1)
    homed.pulse(START | 3)
    homed.wait()
    assert homed.read(0xCC) == 700
    homed.write(0x0400, 50)  # number 0, incremental as delivered
    homed.write(0x78, START)  # the inputs that clear themselves
    homed.wait()
    assert homed.read(0xCC) == 750


def test_only_the_rising_edge_counts(homed: Desk) -> None:
    homed.write(0x0400, 50)
    homed.write(0x7C, START)
    homed.wait()
    homed.write(0x7C, START)
    homed.wait()
    assert homed.read(0xCC) == 50


def test_stop_left_on_keeps_it_from_starting(homed: Desk) -> None:
    homed.write(0x7C, STOP)
    assert not homed.outputs & READY
    with pytest.raises(Refusal) as caught:
        homed.start(1, 100)
    assert caught.value.code == FAILURE
    homed.write(0x7C, 0)
    homed.start(1, 100)
    homed.wait()
    assert homed.read(0xCC) == 100


def test_the_motor_set_free_is_not_ready(homed: Desk) -> None:
    homed.write(0x7C, FREE)
    assert not homed.outputs & READY


@pytest.mark.parametrize("holds", [True, False])
def test_home_end_when_it_moves_on(holds: bool) -> None:
    desk = Desk(AzModel(home_end_holds=holds))
    assert not desk.outputs & HOME_END
    desk.home()
    assert desk.outputs & HOME_END
    desk.start(1, 100)
    desk.wait()
    assert bool(desk.outputs & HOME_END) == holds


def test_preset(desk: Desk) -> None:
    desk.write(0x38C, 1234)
    desk.write(0x18A, 1)
    assert desk.read(0xCC) == 1234
    assert desk.outputs & HOME_END


@given(
    st.floats(-100, 100),
    st.floats(-50, 50),
    st.floats(-100, 100),
    st.floats(0.5, 60),
    st.floats(1, 1000),
    st.floats(1, 1000),
)
def test_any_plan_ends_at_rest_at_its_target(
    position: float, velocity: float, target: float, speed: float, rate: float, stop_rate: float
) -> None:
    profile = Profile(0.0, position, velocity, to_target(position, velocity, target, speed, rate, stop_rate))
    assert profile.at(profile.end)[0] == pytest.approx(target, abs=1e-6)
    end, velocity_at_end = profile.at(math.nextafter(profile.end, 0))
    assert end == pytest.approx(target, abs=1e-6)
    assert abs(velocity_at_end) < 1e-3
    for duration, push in profile.segments:
        assert duration > 0
        assert any(abs(push) == pytest.approx(limit) for limit in (0.0, rate, stop_rate))


# Alarms


def test_an_absolute_move_without_origin_is_alarm_4a(desk: Desk) -> None:
    desk.start(1, 100)
    assert desk.alarm == 0x4A
    assert desk.outputs & (ALM_A | READY) == ALM_A
    desk.wait()
    assert desk.read(0xCC) == 0


def test_an_absolute_sensor_needs_no_homing() -> None:
    desk = Desk(AzModel(origin_known=True), angle=20.0)
    assert desk.read(0xCC) == 1000
    desk.start(1, 500)
    desk.wait()
    assert (desk.alarm, desk.read(0xCC)) == (0, 500)


@pytest.mark.parametrize("position", [-1, 18_001])
def test_beyond_the_software_limits(homed: Desk, position: int) -> None:
    homed.start(1, position)
    assert homed.alarm == 0x67
    homed.wait()
    assert homed.read(0xCC) == 0


@pytest.mark.parametrize(("speed", "ends"), [(5000, 18_000), (-5000, 0)])
def test_an_endless_motion_ends_at_the_limit_in_alarm(homed: Desk, speed: int, ends: int) -> None:
    homed.start(1, 9000)
    homed.wait()
    homed.start(16, 0, speed=speed)
    homed.wait()
    assert homed.alarm == 0x67
    assert homed.read(0xCC) == ends


@pytest.mark.parametrize("kind", [0, 4, 8, 17, 20])
def test_operations_that_are_not_simulated_are_alarm_70(homed: Desk, kind: int) -> None:
    homed.start(kind, 100)
    assert homed.alarm == 0x70


def test_a_stall_under_way_stops_it_and_forbids_starts_until_reset(homed: Desk) -> None:
    homed.start(1, 9000)
    homed.wait(2)
    homed.axis.fail(homed.clock.now(), 0x30)
    homed.wait(1)
    where = homed.read(0xCC)
    assert 0 < where < 9000
    assert (homed.alarm, homed.read(0x82)) == (0x30, 0x30)
    with pytest.raises(Refusal):
        homed.start(1, 100)
    homed.pulse(ZHOME)
    homed.wait()
    assert homed.read(0xCC) == where
    homed.write(0x180, 1)
    assert homed.alarm == 0
    homed.write(0x180, 1)
    homed.axis.fail(homed.clock.now(), 0x30)
    homed.write(0x180, 1)  # no edge
    assert homed.alarm == 0x30
    homed.pulse(0x80)  # ALM-RST
    assert homed.alarm == 0


@pytest.mark.parametrize("code", sorted(NOT_RESETTABLE))
def test_some_alarms_need_a_power_cycle(homed: Desk, code: int) -> None:
    homed.axis.fail(homed.clock.now(), code)
    homed.write(0x180, 1)
    assert homed.alarm == code
    homed.axis.power_up(homed.clock.now())
    assert homed.alarm == 0
    assert not homed.outputs & HOME_END


def test_the_history_keeps_ten_and_can_be_cleared(homed: Desk) -> None:
    for code in range(0x10, 0x1C):
        homed.axis.fail(homed.clock.now(), code)
    assert [homed.read(0x82 + 2 * place) for place in range(10)] == list(range(0x1B, 0x11, -1))
    homed.write(0x184, 1)
    assert homed.read(0x82) == 0


def test_what_was_written_before_a_refused_number_stays_written(homed: Desk) -> None:
    with pytest.raises(Refusal) as caught:
        homed.write(0x5C, 777, 5_000_000)
    assert caught.value.code == ILLEGAL_VALUE
    assert homed.read(0x5C) == 777
    assert homed.read(0x5E) == 1000


@given(st.integers(0, 0xFFFF), st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=20))
def test_no_write_breaks_it(address: int, values: list[int]) -> None:
    desk = Desk()
    for start in (address, address % 0x200):
        with contextlib.suppress(Refusal):
            desk.axis.write_holding(desk.clock.now(), start, values)
        desk.wait(1.0)
        assert 0 <= desk.outputs <= 0xFFFF


@pytest.mark.parametrize("options", [{"steps_per_turn": 0}, {"home_speed": -1.0}, {"limit_min": 400.0}])
def test_models_that_cannot_be(options: dict[str, float]) -> None:
    with pytest.raises(SimError):
        AzModel(**options)  # type: ignore[arg-type]
