"""Newport ESP301: the codec against the sheet and against damage, the axis against exchanges spelled out by hand and over its simulator."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.errors import DeviceFault, InvalidSetting, NotHomed, PortClosed, TransportTimeout, UnexpectedReply
from drivers.kinds import Identity, Stage
from drivers.link import Link
from drivers.stages.newport import EspError, NewportAxis, find_version, parse_error, parse_number
from sim.clock import SimClock
from sim.newport import Esp301
from tests.sim.served import served

SHORT_S = 0.1
HELLO = (b"VE?\r", b"ESP301 Version 3.10 01/02/03\r\n")
NONE = b"0, 451322, NO ERROR DETECTED\r\n"
LIMITS = (b"1SL?\r", b"-170.000\r\n", b"1SR?\r", b"170.000\r\n")
QUIET = (b"TB?\r", NONE)
READY = (b"1MO?\r", b"1\r\n", *LIMITS, *QUIET)


# the codec ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (b"0, 451322, NO ERROR DETECTED", EspError(0, "NO ERROR DETECTED")),
        (b"6,0,COMMAND DOES NOT EXIST", EspError(6, "COMMAND DOES NOT EXIST")),
        (b" 306, 12, POSITIVE SOFTWARE LIMIT DETECTED ", EspError(306, "POSITIVE SOFTWARE LIMIT DETECTED")),
    ],
)
def test_error_messages(line: bytes, error: EspError) -> None:
    assert parse_error(line) == error


def test_errors_name_their_axis() -> None:
    assert [EspError(code, "").axis for code in (0, 38, 100, 203, 330)] == [0, 0, 1, 2, 3]


@pytest.mark.parametrize(("line", "number"), [(b"12.5", 12.5), (b" -0.0002 ", -0.0002), (b"+1E-3", 0.001), (b".5", 0.5), (b"7", 7.0)])
def test_numbers(line: bytes, number: float) -> None:
    assert parse_number(line) == number


@pytest.mark.parametrize("line", [b"", b"fast", b"nan", b"inf", b"1e999", b"1 2", b"0x10", b"1,5", b"--1", b"12\xff", b"\xb2"])
def test_what_is_no_number(line: bytes) -> None:
    with pytest.raises(UnexpectedReply):
        parse_number(line)


def test_versions() -> None:
    assert find_version(b"ESP301 Version 3.10 01/02/03 ") == ("ESP301", "Version 3.10 01/02/03")
    assert find_version(b"45.0002") is find_version(b"0, 1, NO ERROR DETECTED") is None


@given(st.binary(max_size=30) | st.binary(max_size=30).map(lambda noise: b"ESP301" + noise))
@example(b"ESP301\xae Version 3.0")
def test_noise_is_a_printable_version_or_none(line: bytes) -> None:
    found = find_version(line)
    assert found is None or all(part.isascii() and part.isprintable() for part in found)


@given(st.floats(-1e6, 1e6))
def test_numbers_round_trip(number: float) -> None:
    assert parse_number(f"{number:+.6f}".encode()) == pytest.approx(number, abs=5e-7)


TOLD = (b"1DP?\r", b"10.0\r\n")
"""The target read back after a move to 10 deg."""

# the axis -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def axis(plug: Any, script: Any) -> Any:
    """An axis that was homed, whose other end greets it and then follows the dialogue given."""

    def make(*lines: bytes, timeout_s: float = 20.0, **options: Any) -> NewportAxis:
        options = {"assume_homed": True, **options}
        return NewportAxis(plug(*script.dialogue(*HELLO, *lines), timeout_s=timeout_s), "theta_r", **options)

    return make


def rest(position: bytes, *errors: bytes) -> tuple[bytes, ...]:
    """What the state of an axis at rest is read with."""
    queue = [line for error in errors for line in (b"TB?\r", error)]
    where = (b"1TP?\r", position + b"\r\n")
    return (*where, b"1MD?\r", b"1\r\n", b"1MO?\r", b"1\r\n", *queue, *QUIET, *where, *where)


def test_it_is_a_rotary_axis(plug: Any) -> None:
    assert isinstance(NewportAxis(plug(), "theta_r"), Stage)


@pytest.mark.parametrize(
    ("units", "degrees"),
    [(b"7", 1.0), (b"8", 0.9), (b"9", 180 / math.pi), (b"10", math.degrees(1e-3)), (b"11", math.degrees(1e-6))],
)
def test_open_reads_the_units_and_sets_the_profile(plug: Any, script: Any, units: bytes, degrees: float) -> None:
    speed, acceleration = (f"{value / degrees:.6f}".encode() for value in (20, 80))
    settings = [line for command in (b"2VA" + speed, b"2AC" + acceleration, b"2AG" + acceleration) for line in (command + b";TB?\r", NONE)]
    link = plug(*script.dialogue(*HELLO, b"2SN?\r", units + b"\r\n", *settings))
    stage = NewportAxis.open(link, "theta_i", axis=2, speed=20, acceleration=80)
    assert stage.degrees_per_unit == pytest.approx(degrees)


@pytest.mark.parametrize("units", [0, 1, 2, 6])
def test_open_on_units_that_are_no_angle_says_what_to_do(plug: Any, script: Any, units: int) -> None:
    link = plug(*script.dialogue(*HELLO, b"1SN?\r", b"%d\r\n" % units))
    with pytest.raises(DeviceFault, match=f"units {units}.*give degrees_per_unit"):
        NewportAxis.open(link, "theta_i")


def test_open_with_a_given_scale_asks_nothing(plug: Any) -> None:
    assert NewportAxis.open(plug(), "theta_i", degrees_per_unit=0.001).degrees_per_unit == 0.001


def test_identity(axis: Any) -> None:
    stage = axis(b"1ID?\r", b"URS75BCC, SN1263\r\n")
    assert stage.identify() == Identity("Newport", "ESP301 axis 1, URS75BCC", "1263", "3.10 01/02/03")


def test_state_at_rest_reads_the_position_until_two_readings_agree(axis: Any) -> None:
    spoilt = (b"1TP?\r", b"4.0002\r\n", b"1TP?\r", b"45.0002\r\n", b"1TP?\r", b"45.0000\r\n")
    state = axis(b"1TP?\r", b"45.0002\r\n", b"1MD?\r", b"1\r\n", b"1MO?\r", b"1\r\n", *QUIET, *spoilt).state()
    assert (state.position, state.moving, state.homed, state.warnings) == (45.0, False, True, ())


def test_a_position_that_never_repeats_itself_is_not_believed(axis: Any) -> None:
    readings = [line for deg in (45, 4, 45, 5) for line in (b"1TP?\r", b"%d.0\r\n" % deg)]
    stage = axis(b"1TP?\r", b"45.0\r\n", b"1MD?\r", b"1\r\n", b"1MO?\r", b"1\r\n", *QUIET, *readings)
    with pytest.raises(UnexpectedReply, match="check the cable"):
        stage.state()


def test_state_on_the_way(axis: Any) -> None:
    state = axis(b"1TP?\r", b"-1.25\r\n", b"1MD?\r", b"0\r\n").state()
    assert (state.position, state.moving) == (-1.25, True)


def test_without_motor_power_it_is_not_homed(axis: Any) -> None:
    where = (b"1TP?\r", b"45.0\r\n")
    stage = axis(*where, b"1MD?\r", b"1\r\n", b"1MO?\r", b"0\r\n", *QUIET, *where, *where)
    assert not stage.state().homed


def test_errors_of_other_axes_are_kept_for_them(plug: Any, script: Any) -> None:
    where = (b"2TP?\r", b"7.0\r\n")
    errors = (b"203, 5, FOLLOWING ERROR THRESHOLD EXCEEDED\r\n", b"4, 6, EMERGENCY STOP ACTIVATED\r\n")
    second = (*where, b"2MD?\r", b"1\r\n", b"2MO?\r", b"1\r\n", *QUIET, *where, *where)
    link = plug(*script.dialogue(*HELLO, *rest(b"45.0", *errors), *second))
    one, two = (NewportAxis(link, f"axis {number}", axis=number) for number in (1, 2))
    assert one.state().warnings == ("4 EMERGENCY STOP ACTIVATED",)
    assert two.state().warnings == ("203 FOLLOWING ERROR THRESHOLD EXCEEDED", "4 EMERGENCY STOP ACTIVATED")


def test_an_error_queue_without_end(axis: Any) -> None:
    queue = [b"TB?\r", b"6, 1, COMMAND DOES NOT EXIST\r\n"] * 33
    with pytest.raises(DeviceFault, match="never ends"):
        axis(b"1TP?\r", b"1.0\r\n", b"1MD?\r", b"1\r\n", b"1MO?\r", b"1\r\n", *queue).state()


@pytest.mark.parametrize("answer", [b"2\r\n", b"-1\r\n", b"0.5\r\n"])
def test_yes_or_no_is_nothing_else(axis: Any, answer: bytes) -> None:
    question = (b"1MD?\r", answer)
    with pytest.raises(UnexpectedReply, match="whole number 0 to 1"):
        axis(b"1TP?\r", b"1.0\r\n", *question, *HELLO, *question).state()


def test_limits_and_profile(axis: Any) -> None:
    stage = axis(*LIMITS, b"1VA?\r", b"20.0\r\n", b"1AC?\r", b"90.0\r\n", b"1AG?\r", b"80.0\r\n")
    assert stage.limits() == (-170.0, 170.0)
    profile = stage.profile()
    assert (profile.speed, profile.acceleration) == (20.0, 80.0)


def test_a_profile_of_zero_is_not_a_profile(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="acceleration 0"):
        axis(b"1VA?\r", b"20.0\r\n", b"1AC?\r", b"0.0\r\n", b"1AG?\r", b"80.0\r\n").profile()


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e-9])
def test_impossible_speeds_are_not_sent(plug: Any, value: float) -> None:
    stage = NewportAxis(plug(), "theta_r")
    with pytest.raises(InvalidSetting):
        stage.set_profile(speed=value)
    with pytest.raises(InvalidSetting):
        stage.set_profile(speed=1.0, acceleration=value)


@pytest.mark.parametrize("code", [110, 101, 6, 7, 38])
def test_settings_the_axis_refuses(axis: Any, code: int) -> None:
    with pytest.raises(DeviceFault, match=f"refused with error {code} SOMETHING"):
        axis(b"1VA2000.000000;TB?\r", b"%d, 5, SOMETHING\r\n" % code, *QUIET).set_profile(speed=2000)


def test_home_switches_the_motor_on_and_is_over_when_the_motion_is(axis: Any) -> None:
    stage = axis(*QUIET, b"1MO;TB?\r", NONE, b"1OR4;TB?\r", NONE, *rest(b"0.0"), assume_homed=False, home_search=4)
    stage.start_home()
    assert stage.state().homed


def test_a_home_that_ends_in_an_error_gives_no_reference(axis: Any) -> None:
    failed = rest(b"0.0", b"120, 77, HOMING ABORTED\r\n")
    stage = axis(*QUIET, b"1MO;TB?\r", NONE, b"1OR1;TB?\r", NONE, *failed)
    stage.start_home()
    state = stage.state()
    assert not state.homed
    assert state.warnings == ("120 HOMING ABORTED",)


def test_a_stopped_home_gives_no_reference(axis: Any) -> None:
    stage = axis(*QUIET, b"1MO;TB?\r", NONE, b"1OR1;TB?\r", NONE, b"1ST;TB?\r", NONE, *rest(b"0.0"))
    stage.start_home()
    stage.stop()
    assert not stage.state().homed


def test_a_home_stopped_before_its_start_was_acknowledged_gives_no_reference(plug: Any, script: Any) -> None:
    blocked = threading.Event()
    link = plug(
        *script.dialogue(*HELLO, *QUIET, b"1MO;TB?\r", NONE, b"1OR1;TB?\r"),
        script.tell(blocked),
        script.expect(b"1ST;TB?\r"),
        script.send(NONE + NONE),
        *script.dialogue(*rest(b"0.0")),
    )
    stage = NewportAxis(link, "theta_r")
    with ThreadPoolExecutor(1) as pool:
        homing = pool.submit(stage.start_home)
        assert blocked.wait(5)
        stage.stop()
        homing.result()
    assert not stage.state().homed


@pytest.mark.parametrize(("deg", "words"), [(10.0, b"+10.000000"), (-70.0, b"-70.000000"), (0.0, b"+0.000000"), (33.3, b"+33.300000")])
def test_move(axis: Any, deg: float, words: bytes) -> None:
    axis(*READY, b"1PA" + words + b";TB?\r", NONE, b"1DP?\r", words + b"\r\n").start_move(deg)


def test_a_target_read_back_wrongly_once_does_not_matter(axis: Any) -> None:
    told = (b"1DP?\r", b"1.0\r\n", b"1DP?\r", b"10.0\r\n")
    axis(*READY, b"1PA+10.000000;TB?\r", NONE, *told).start_move(10.0)


def test_an_axis_that_was_sent_elsewhere_is_stopped_at_once(axis: Any) -> None:
    told = (b"1DP?\r", b"110.0\r\n") * 2
    with pytest.raises(DeviceFault, match="on its way elsewhere"):
        axis(*READY, b"1PA+10.000000;TB?\r", NONE, *told, b"1ST;TB?\r", NONE).start_move(10.0)


def test_old_errors_do_not_refuse_a_new_move(axis: Any) -> None:
    old = (b"TB?\r", b"103, 5, FOLLOWING ERROR THRESHOLD EXCEEDED\r\n")
    stage = axis(b"1MO?\r", b"1\r\n", *LIMITS, *old, *QUIET, b"1PA+10.000000;TB?\r", NONE, *TOLD, *rest(b"10.0"))
    stage.start_move(10.0)
    stage.check_arrival(10.0, 0.01)


def test_an_error_of_another_axis_does_not_refuse_a_move(axis: Any) -> None:
    axis(*READY, b"1PA+10.000000;TB?\r", b"203, 5, FOLLOWING ERROR\r\n", *QUIET, *TOLD).start_move(10.0)


@pytest.mark.parametrize("code", [106, 113, 130, 9])
def test_moves_the_axis_refuses(axis: Any, code: int) -> None:
    with pytest.raises(DeviceFault, match=rf"theta_r on /dev/.*10\.0000 deg: refused with error {code} NO"):
        axis(*READY, b"1PA+10.000000;TB?\r", b"%d, 5, NO\r\n" % code, *QUIET).start_move(10.0)


@pytest.mark.parametrize("deg", [math.nan, math.inf, -math.inf])
def test_moves_to_nowhere_are_not_sent(plug: Any, deg: float) -> None:
    with pytest.raises(InvalidSetting):
        NewportAxis(plug(), "theta_r", assume_homed=True).start_move(deg)


def test_move_without_reference(plug: Any) -> None:
    with pytest.raises(NotHomed, match="home the axis first"):
        NewportAxis(plug(), "theta_r").start_move(10)


def test_move_without_power(axis: Any) -> None:
    with pytest.raises(NotHomed):
        axis(b"1MO?\r", b"0\r\n").start_move(10)


@pytest.mark.parametrize("deg", [-170.001, 170.001])
def test_moves_beyond_the_limits_are_not_sent(axis: Any, deg: float) -> None:
    with pytest.raises(DeviceFault, match="beyond the software limits"):
        axis(b"1MO?\r", b"1\r\n", *LIMITS).start_move(deg)


def test_a_lost_answer_to_a_move_is_not_asked_for_again(plug: Any, script: Any) -> None:
    """Strict script: a second move command would fail it."""
    link = plug(*script.dialogue(*HELLO, *READY, b"1PA+10.000000;TB?\r"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match="theta_r on /dev/"):
        NewportAxis(link, "theta_r", assume_homed=True).start_move(10)


def test_a_damaged_answer_to_a_home_is_not_asked_for_again(axis: Any) -> None:
    with pytest.raises(UnexpectedReply):
        axis(*QUIET, b"1MO;TB?\r", NONE, b"1OR1;TB?\r", b"0, 45\xff\r\n").start_home()


# what else is on the line ---------------------------------------------------------------------------------------------


def test_a_garbled_answer_is_asked_for_again_after_finding_step(axis: Any) -> None:
    moving = (b"1MD?\r", b"0\r\n")
    stage = axis(b"1TP?\r", b"4\x855.0\r\n", *HELLO, b"1TP?\r", b"45.0\r\n", *moving)
    assert stage.state().position == 45.0


def test_a_late_answer_is_not_taken_for_that_of_the_next_question(plug: Any, script: Any) -> None:
    """The answer to the first question comes when the second one has been sent, between it and its own."""
    link = plug(
        *script.dialogue(*HELLO, b"1TP?\r"),
        *script.dialogue(b"VE?\r", b"99.0\r\n" + HELLO[1], b"1TP?\r", b"45.0\r\n", b"1MD?\r", b"0\r\n"),
        timeout_s=SHORT_S,
    )
    assert NewportAxis(link, "theta_r").state().position == 45.0


def test_doubt_is_shared_by_the_axes_of_a_link(plug: Any, script: Any) -> None:
    link = plug(
        *script.dialogue(*HELLO, *READY, b"1PA+10.000000;TB?\r"),
        *script.dialogue(b"VE?\r", NONE + HELLO[1], b"2TP?\r", b"5.0\r\n", b"2MD?\r", b"0\r\n"),
        timeout_s=SHORT_S,
    )
    one, two = (NewportAxis(link, f"axis {number}", axis=number, assume_homed=True) for number in (1, 2))
    with pytest.raises(TransportTimeout):
        one.start_move(10)
    assert two.state().position == 5.0


@pytest.mark.parametrize("other", [NONE, HELLO[1], b"0, 1, X\r\n"])
def test_lines_of_another_shape_are_not_the_answer(axis: Any, other: bytes) -> None:
    assert axis(b"1TP?\r", other + b"45.0\r\n", b"1MD?\r", b"0\r\n").state().position == 45.0


# stopping -------------------------------------------------------------------------------------------------------------


def test_stop_overtakes_a_blocked_exchange_and_both_get_their_answers(plug: Any, script: Any) -> None:
    blocked = threading.Event()
    link = plug(
        *script.dialogue(*HELLO, b"1TP?\r"),
        script.tell(blocked),
        script.expect(b"2ST;TB?\r"),
        script.send(b"45.0\r\n"),
        script.send(NONE),
        *script.dialogue(b"1MD?\r", b"0\r\n"),
    )
    one, two = (NewportAxis(link, f"axis {number}", axis=number) for number in (1, 2))
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(one.state)
        assert blocked.wait(5)
        two.stop()
        assert waiting.result().position == 45.0


def test_a_move_that_has_not_gone_out_is_dropped_by_a_stop(plug: Any, script: Any) -> None:
    blocked, stopped = threading.Event(), threading.Event()
    link = plug(
        *script.dialogue(*HELLO, *READY[:-1]),
        script.tell(blocked),
        script.expect(b"1ST;TB?\r"),
        script.send(NONE + NONE),
        script.wait(stopped),
    )
    stage = NewportAxis(link, "theta_r", assume_homed=True)
    with ThreadPoolExecutor(1) as pool:
        moving = pool.submit(stage.start_move, 10)
        assert blocked.wait(5)
        stage.stop()
        stopped.set()
        with pytest.raises(DeviceFault, match="stopped before it could start"):
            moving.result()


def test_an_unanswered_stop_is_sent_again(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"1ST;TB?\r"), *script.dialogue(b"1ST;TB?\r", NONE), timeout_s=SHORT_S)
    NewportAxis(link, "theta_r").stop()


def test_an_error_that_comes_with_the_stop_is_kept(axis: Any) -> None:
    """And the stop sent again: the error may have been of that."""
    error = b"103, 1, FOLLOWING ERROR THRESHOLD EXCEEDED\r\n"
    stage = axis(*rest(b"1.0"), b"1ST;TB?\r", error, b"1ST;TB?\r", NONE, *rest(b"1.0"))
    stage.state()
    stage.stop()
    assert stage.state().warnings == ("103 FOLLOWING ERROR THRESHOLD EXCEEDED",)


# arriving -------------------------------------------------------------------------------------------------------------


def test_arrival(axis: Any) -> None:
    axis(*rest(b"45.0003")).check_arrival(45, 0.001)


@pytest.mark.parametrize("code", [102, 103, 104, 105, 4, 8])
def test_arrival_disturbed(axis: Any, code: int) -> None:
    with pytest.raises(DeviceFault, match=rf"theta_r on /dev/.*{code} TROUBLE at 45\.0000 deg"):
        axis(*rest(b"45.0", b"%d, 5, TROUBLE\r\n" % code)).check_arrival(45, 0.01)


def test_arrival_elsewhere(axis: Any) -> None:
    with pytest.raises(DeviceFault, match=r"rests at 44\.0625 deg"):
        axis(*rest(b"44.0625")).check_arrival(45, 0.01)


def test_arrival_not_yet(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="still moving"):
        axis(b"1TP?\r", b"45.0\r\n", b"1MD?\r", b"0\r\n").check_arrival(45, 0.01)


# the end --------------------------------------------------------------------------------------------------------------


def test_unplugged(plug: Any, script: Any) -> None:
    link = plug(*script.dialogue(*HELLO, b"1TP?\r"), script.unplug())
    with pytest.raises(PortClosed, match="theta_r on /dev/"):
        NewportAxis(link, "theta_r").state()


def test_closed(plug: Any) -> None:
    stage = NewportAxis(plug(), "theta_r")
    stage.close()
    stage.close()
    with pytest.raises(PortClosed, match="theta_r"):
        stage.state()


@pytest.mark.parametrize(
    "options", [{"axis": 0}, {"axis": 4}, {"home_search": 0}, {"home_search": 7}, {"degrees_per_unit": 0.0}, {"degrees_per_unit": math.nan}]
)
def test_nonsense_options(plug: Any, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match="theta_r"):
        NewportAxis(plug(), "theta_r", **options)


# over the simulator ---------------------------------------------------------------------------------------------------


@pytest.fixture
def bench() -> Iterator[tuple[Esp301, NewportAxis, NewportAxis]]:
    """Two axes of a simulated controller, forty times as fast as life."""
    with (
        served(lambda: Esp301(SimClock(40.0), [200.0, 30.0])) as (esp, ports),
        Link.open(ports.tcp, timeout_s=5.0, terminator=b"\r\n") as link,
    ):
        yield esp, NewportAxis.open(link, "theta_i", axis=1), NewportAxis.open(link, "theta_r", axis=2)


def arrive(stage: NewportAxis) -> None:
    while stage.state().moving:
        pass


def test_two_axes_home_and_move_at_once(bench: tuple[Esp301, NewportAxis, NewportAxis]) -> None:
    _, *stages = bench
    for stage in stages:
        with pytest.raises(NotHomed):
            stage.start_move(1.0)
        stage.start_home()
    for stage in stages:
        arrive(stage)
        assert stage.state().homed
    for stage, deg in zip(stages, (120.0, 33.3), strict=True):
        stage.start_move(deg)
    for stage, deg in zip(stages, (120.0, 33.3), strict=True):
        arrive(stage)
        stage.check_arrival(deg, 0.001)


def test_a_stalled_axis_says_so_and_the_other_does_not(bench: tuple[Esp301, NewportAxis, NewportAxis]) -> None:
    esp, *stages = bench
    for stage in stages:
        stage.start_home()
    for stage in stages:
        arrive(stage)
        stage.start_move(60.0)
    esp.fail(2, 3)
    for stage in stages:
        arrive(stage)
    stages[0].check_arrival(60.0, 0.001)
    with pytest.raises(DeviceFault, match="203 FOLLOWING ERROR"):
        stages[1].check_arrival(60.0, 0.001)
    assert not stages[1].state().homed
    with pytest.raises(NotHomed):
        stages[1].start_move(10.0)
