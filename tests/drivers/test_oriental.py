"""Oriental Motor AZ: frames of the sheet byte by byte, and the axis over its wire simulator."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import pytest

from drivers.errors import (
    BadChecksum,
    DeviceFault,
    InvalidSetting,
    NotHomed,
    PortClosed,
    TransportTimeout,
    UnexpectedReply,
)
from drivers.kinds import MotionProfile, Stage
from drivers.link import Link
from drivers.modbus import ModbusLink, ModbusRefusal
from drivers.motion import wait_until_idle
from drivers.stages.oriental import OrientalAxis
from rig.clock import Clock
from sim.clock import SimClock
from sim.modbus import ModbusBus
from sim.oriental import STOP as STOP_BIT
from sim.oriental import AzAxis, AzModel
from tests.drivers.rtu import framed
from tests.sim.served import served

SPEED = 40.0
CLOCK = Clock(SPEED)
HOME, STOP, CLEAR = (bytes.fromhex(f"01 06 00 7D {tail}") for tail in ("00 10 18 1E", "00 20 18 0A", "00 00 19 D2"))  # from the sheet


ASK_OUTPUTS = framed("01 03 00 7E 00 04")
ASK_POSITION = framed("01 03 00 CC 00 02")


def outputs(word: str, alarm: str = "00") -> bytes:
    """The reply to `ASK_OUTPUTS`."""
    return framed(f"01 03 08 0000 {word} 0000 00{alarm}")


READY = outputs("40 30")  # IN-POS, READY, HOME-END
MOVING = outputs("20 10")


@pytest.fixture
def axis(make_peer: Any, script: Any) -> Any:
    """An axis whose other end follows the dialogue given."""
    with contextlib.ExitStack() as links:

        def make(*frames: bytes, more: tuple[Any, ...] = (), timeout_s: float = 20.0, **options: Any) -> OrientalAxis:
            peer = make_peer(*script.dialogue(*frames), *more)
            link = links.enter_context(ModbusLink.open(peer.url, timeout_s=timeout_s, baudrate=115200))
            return OrientalAxis(link, "theta_i", **options)

        yield make


# frames ---------------------------------------------------------------------------------------------------------------


def test_homing_is_a_pulse_on_zhome(axis: Any) -> None:
    axis(ASK_OUTPUTS, outputs("40 20"), HOME, HOME, CLEAR, CLEAR, ASK_OUTPUTS, outputs("20 00")).start_home()


def test_homing_by_another_input(axis: Any) -> None:
    pulse = framed("01 06 00 7D 10 00")
    axis(ASK_OUTPUTS, outputs("40 20"), pulse, pulse, CLEAR, CLEAR, ASK_OUTPUTS, outputs("20 00"), home_bit=12).start_home()


def test_a_stop_is_a_pulse_on_stop(axis: Any) -> None:
    axis(STOP, STOP, CLEAR, CLEAR).stop()


def test_a_move_is_one_write_of_the_direct_operation(axis: Any) -> None:
    # 45 deg = 2250 steps = 8CAh; 20 deg/s = 1000 Hz; 100 deg/s^2 = 5000 steps/s^2, which is 5000 times 0.001 kHz/s.
    move = framed("01 10 00 58 00 10 20 00000000 00000001 000008CA 000003E8 00001388 00001388 000003E8 00000001")
    axis(ASK_OUTPUTS, READY, move, framed("01 10 00 58 00 10"), ASK_OUTPUTS, MOVING).start_move(45.0)


def test_a_move_the_other_way_with_another_scale_and_profile(axis: Any) -> None:
    move = framed("01 10 00 58 00 10 20 00000000 00000001 FFFFFFF6 00000001 00000002 00000002 000003E8 00000001")
    stage = axis(
        *(ASK_OUTPUTS, READY, move, framed("01 10 00 58 00 10"), ASK_OUTPUTS, MOVING),
        steps_per_degree=10.0,
        limits=(-90.0, 90.0),
        profile=MotionProfile(0.1, 0.2),
    )
    assert stage.limits() == (-90.0, 90.0)
    stage.start_move(-1.0)


@pytest.mark.parametrize(
    ("reply", "position", "expected"),
    [
        (READY, "00 00 08 CA", (45.0, False, True, ())),
        (MOVING, "FF FF FF FF", (-0.02, True, True, ())),
        (outputs("40 20"), "00 00 00 00", (0.0, False, False, ())),
        (outputs("40 90", "30"), "00 00 00 32", (1.0, False, True, ("ALARM 30",))),
        (outputs("40 70"), "00 00 00 32", (1.0, False, True, ("INFO",))),
    ],
)
def test_state(axis: Any, reply: bytes, position: str, expected: tuple[float, bool, bool, tuple[str, ...]]) -> None:
    state = axis(ASK_OUTPUTS, reply, ASK_POSITION, framed(f"01 03 04 {position}")).state()
    assert (state.position, state.moving, state.homed, state.warnings) == expected


def test_an_alarm_output_without_an_alarm_makes_no_sense(axis: Any) -> None:
    with pytest.raises(UnexpectedReply, match="ALM-A"):
        axis(ASK_OUTPUTS, outputs("40 B0")).state()


def test_without_home_end_it_does_not_start(axis: Any) -> None:
    with pytest.raises(NotHomed, match="home the axis first"):
        axis(ASK_OUTPUTS, outputs("40 20")).start_move(45)


def test_home_end_seen_once_is_enough_if_it_does_not_hold(axis: Any) -> None:
    here, gone, lost = READY, outputs("40 20"), outputs("40 80", "4A")
    position = (ASK_POSITION, framed("01 03 04 00 00 00 00"))
    stage = axis(*(frame for reply in (gone, here, gone, lost, gone) for frame in (ASK_OUTPUTS, reply, *position)), home_end_holds=False)
    assert [stage.state().homed for _ in range(5)] == [False, True, True, False, False]


def test_an_alarm_forbids_a_start_and_is_named(axis: Any) -> None:
    with pytest.raises(DeviceFault, match=r"theta_i on /dev/.*45\.0000 deg: alarm 30h, overload"):
        axis(ASK_OUTPUTS, outputs("40 90", "30")).start_move(45)


def test_a_driver_that_is_not_ready_is_not_started(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="not ready"):
        axis(ASK_OUTPUTS, outputs("40 10")).start_home()


def test_a_start_that_is_refused(axis: Any, script: Any) -> None:
    stage = axis(ASK_OUTPUTS, READY, more=(Taken(41), script.send(framed("01 90 04"))))
    with pytest.raises(ModbusRefusal, match="device failure") as caught:
        stage.start_move(45)
    assert isinstance(caught.value, DeviceFault)


class Taken:
    """The next bytes, whatever they are."""

    def __init__(self, count: int) -> None:
        self._count = count

    def run(self, wire: Any) -> None:
        """Read them."""
        left = self._count
        while left:
            assert wire.ready(20.0)
            left -= len(os.read(wire.fd, left))


@pytest.mark.parametrize("reply", [b"", framed("01 10 00 58 00 10")[:-1] + b"\0", framed("02 10 00 58 00 10")])
def test_a_move_whose_reply_is_lost_or_damaged_is_not_sent_again(axis: Any, script: Any, reply: bytes) -> None:
    stage = axis(ASK_OUTPUTS, READY, more=(Taken(41), *([script.send(reply)] if reply else [])), timeout_s=0.3)
    with pytest.raises((TransportTimeout, BadChecksum, UnexpectedReply)):
        stage.start_move(45)


def test_homing_whose_reply_is_lost_is_not_sent_again_and_the_input_is_cleared_before_the_next(axis: Any, script: Any) -> None:
    more = script.dialogue(CLEAR, CLEAR, ASK_OUTPUTS, outputs("40 20"), HOME, HOME, CLEAR, CLEAR, ASK_OUTPUTS, outputs("20 00"))
    stage = axis(ASK_OUTPUTS, outputs("40 20"), more=(script.expect(HOME), *more), timeout_s=0.3)
    with pytest.raises(TransportTimeout):
        stage.start_home()
    stage.start_home()


def test_a_stop_whose_reply_is_lost_is_sent_again(axis: Any, script: Any) -> None:
    axis(more=(script.expect(STOP), *script.dialogue(STOP, STOP, CLEAR, CLEAR)), timeout_s=0.3).stop()


def test_a_stop_between_the_question_and_the_start_keeps_the_start_back(axis: Any, script: Any) -> None:
    asked = threading.Event()
    more = (script.expect(ASK_OUTPUTS), script.tell(asked), *script.dialogue(STOP, STOP, CLEAR, CLEAR, ASK_OUTPUTS, READY))
    stage = axis(more=more)
    with ThreadPoolExecutor(1) as pool:
        starting = pool.submit(stage.start_move, 45.0)
        assert asked.wait(20)
        stage.stop()
        with pytest.raises(DeviceFault, match="stopped before it could start"):
            starting.result()


@pytest.mark.parametrize("deg", [math.nan, math.inf, -0.01, 360.01])
def test_moves_beyond_the_limits_are_not_sent(axis: Any, deg: float) -> None:
    with pytest.raises(InvalidSetting):
        axis().start_move(deg)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e-3, 1e9])
def test_impossible_profiles_are_not_taken(axis: Any, value: float) -> None:
    stage = axis()
    before = stage.profile()
    with pytest.raises(InvalidSetting):
        stage.set_profile(speed=value)
    with pytest.raises(InvalidSetting):
        stage.set_profile(speed=30.0, acceleration=value)
    assert stage.profile() == before


@pytest.mark.parametrize(
    "options",
    [
        {"steps_per_degree": 0.0},
        {"limits": (10.0, 0.0)},
        {"limits": (0.0, math.nan)},
        {"home_bit": 5},
        {"home_bit": 16},
        {"address": 0},
    ],
)
def test_options_that_make_no_sense(axis: Any, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting):
        axis(**options)


def test_closed(axis: Any) -> None:
    stage = axis()
    stage.close()
    with pytest.raises(PortClosed):
        stage.state()


# over the simulator ---------------------------------------------------------------------------------------------------


@dataclass
class Rig:
    """An axis on its link, and the simulated one behind it."""

    axis: OrientalAxis
    link: Link
    simulated: AzAxis
    now: Callable[[], float]

    def settle(self) -> None:
        """Wait for rest."""
        wait_until_idle(self.axis, 0.0, timeout_s=60.0, clock=CLOCK)

    def home(self) -> None:
        """Home and wait."""
        self.axis.start_home()
        self.settle()


@pytest.fixture(params=["tcp", "pty"])
def bench(request: pytest.FixtureRequest) -> Iterator[Rig]:
    clock = SimClock(SPEED)
    simulated = AzAxis(AzModel(), 77.0)
    with served(lambda: ModbusBus(clock, {1: simulated}, "az", "az", turnaround_s=0.003)) as (_, ports):
        url = ports.tcp if request.param == "tcp" else ports.pty
        with ModbusLink.open(url, timeout_s=2.0, baudrate=115200) as link:
            yield Rig(OrientalAxis.open(link, "theta_i", speed=60.0, acceleration=600.0), link, simulated, clock.now)


def test_home_move_and_arrive(bench: Rig) -> None:
    assert isinstance(bench.axis, Stage)
    assert not bench.axis.state().homed
    with pytest.raises(NotHomed):
        bench.axis.start_move(10.0)
    bench.home()
    assert bench.axis.state().homed
    for deg in (10.0, 123.4, 33.3):
        bench.axis.start_move(deg)
        bench.settle()
        bench.axis.check_arrival(deg, 0.001)
        assert bench.simulated.track.nominal(bench.now()) == (pytest.approx(deg, abs=0.011), 0.0)
    with pytest.raises(DeviceFault, match=r"rests at 33\.3"):
        bench.axis.check_arrival(34.0, 0.01)


def test_stop_on_the_way(bench: Rig) -> None:
    bench.home()
    bench.axis.start_move(300.0)
    with pytest.raises(DeviceFault, match="still moving"):
        bench.axis.check_arrival(300.0, 0.01)
    bench.axis.stop()
    bench.axis.stop()
    bench.settle()
    assert bench.axis.state().position < 299.0
    bench.axis.start_move(20.0)
    bench.settle()
    bench.axis.check_arrival(20.0, 0.001)


def test_a_stall_under_way_is_a_fault_until_it_is_cleared(bench: Rig) -> None:
    bench.home()
    bench.axis.start_move(300.0)
    bench.simulated.fail(bench.now(), 0x30)
    bench.settle()
    with pytest.raises(DeviceFault, match="alarm 30h, overload"):
        bench.axis.check_arrival(300.0, 0.01)
    assert bench.axis.state().warnings == ("ALARM 30",)
    with pytest.raises(DeviceFault, match="alarm 30h"):
        bench.axis.start_move(10.0)
    bench.axis.reset_alarm()
    bench.axis.start_move(10.0)
    bench.settle()
    bench.axis.check_arrival(10.0, 0.001)
    bench.simulated.fail(bench.now(), 0x28)
    with pytest.raises(DeviceFault, match="alarm 28h, sensor error"):
        bench.axis.reset_alarm()


def test_the_driver_s_own_limits_refuse_what_ours_let_through(bench: Rig) -> None:
    bench.home()
    wide = OrientalAxis(bench.link, "theta_i", limits=(-10.0, 400.0))
    with pytest.raises(DeviceFault, match="alarm 67h, software overtravel"):
        wide.start_move(361.0)
    assert wide.state().position == 0.0


def test_a_lost_origin_is_not_homed(bench: Rig) -> None:
    bench.home()
    bench.simulated.fail(bench.now(), 0x4A)
    with pytest.raises(NotHomed, match="alarm 4Ah"):
        bench.axis.start_move(10.0)


def test_a_stop_input_held_by_another_master(bench: Rig) -> None:
    bench.home()
    bench.simulated.write_holding(bench.now(), 0x7D, (STOP_BIT,))
    with pytest.raises(DeviceFault, match=r"not ready.*stop the axis"):
        bench.axis.start_move(10.0)
    bench.axis.stop()
    bench.axis.start_move(10.0)
