"""Sigma Koki: the codec against the sheet and against damage, the axis against exchanges spelled out by hand and over its simulator."""

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
from drivers.incidents import Incident
from drivers.kinds import Identity, Stage
from drivers.link import Link
from drivers.stages.sigma_koki import SigmaKokiAxis, Speeds, Status, find_version, parse_status
from sim.clock import SimClock
from sim.sigma_koki import GSC_02, SHOT_302GS, Kind, SigmaKoki
from tests.sim.served import served

SHORT_S = 0.1
HELLO = (b"?:V\r\n", b"V2.01\r\n")
READY = b"     18000,-     4000,K,K,R"
BUSY = b"     18000,-     4000,K,K,B"


def says(*lines: bytes) -> tuple[bytes, ...]:
    """Questions and answers, with their line ends."""
    return tuple(line + b"\r\n" for line in lines)


# the codec ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "status"),
    [
        (b"     14000,         0,K,K,R", Status((14000, 0), False, (), False)),
        (b"-     4000,-268435455,X,K,B", Status((-4000, -268435455), True, (), True)),
        (b"      -400,         1,K,L,R", Status((-400, 1), False, (1,), False)),
        (b"         0,         0,K,M,R", Status((0, 0), False, (2,), False)),
        (b"         0,         0,K,W,R", Status((0, 0), False, (1, 2), False)),
    ],
)
def test_status_lines(line: bytes, status: Status) -> None:
    assert parse_status(line) == status


@given(st.binary(max_size=30) | st.binary(max_size=30).map(lambda noise: b"V" + noise))
def test_noise_is_a_printable_version_or_none(line: bytes) -> None:
    found = find_version(line)
    assert found is None or (found.isascii() and found.isprintable())


@pytest.mark.parametrize("line", [b"", b"OK", b"NG", b"R", b"B", b"K,K,R", b"2,2", READY, READY[8:], b"K"])
def test_other_lines_are_no_version(line: bytes) -> None:
    assert find_version(line) is None
    assert find_version(b"V2.01") == "V2.01"


@given(st.data())
def test_a_byte_lost_or_doubled_is_noticed(source: st.DataObject) -> None:
    at = source.draw(st.integers(0, len(READY) - 1))
    for damaged in (READY[:at] + READY[at + 1 :], READY[: at + 1] + READY[at:]):
        with pytest.raises(UnexpectedReply):
            parse_status(damaged)


@given(st.integers(-999_999_999, 999_999_999), st.integers(-999_999_999, 999_999_999))
def test_counters_round_trip(one: int, two: int) -> None:
    fields = ",".join(("-" if count < 0 else " ") + str(abs(count)).rjust(9) for count in (one, two))
    assert parse_status(f"{fields},K,K,R".encode()).pulses == (one, two)


@given(st.floats(20, 400_000), st.floats(0.01, 1.0))
@example(20.5, 0.5)  # rounded to 20 pulses/s: the acceleration is kept, and the ramp is shorter
def test_speeds_take_as_long_as_the_ramp_asked_for(speed: float, ramp_s: float) -> None:
    asked = speed / ramp_s
    speeds = Speeds.nearest(speed, asked, 500_000)
    if speeds is not None:
        assert abs(speeds.fast - speed) <= 0.5
        assert 1 <= speeds.slow <= speeds.fast
        assert speeds.fast < 8000 or speeds.slow >= 64
        assert speeds.fast / speeds.acceleration == pytest.approx(speeds.fast / asked, rel=0, abs=0.00051)


@pytest.mark.parametrize(
    ("speed", "acceleration"), [(0.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (600_000, 1e6), (1000, 0.0), (1000, math.nan), (1000, 1.0)]
)
def test_impossible_speeds(speed: float, acceleration: float) -> None:
    assert Speeds.nearest(speed, acceleration, 500_000) is None


# the axis -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def axis(plug: Any, script: Any) -> Any:
    """An axis that was homed, whose other end greets it and then follows the dialogue given."""

    def make(*lines: bytes, timeout_s: float = 20.0, **options: Any) -> SigmaKokiAxis:
        options = {"assume_homed": True, **options}
        return SigmaKokiAxis(plug(*script.dialogue(*HELLO, *says(*lines)), timeout_s=timeout_s), "theta_r", **options)

    return make


def test_it_is_a_rotary_axis(plug: Any) -> None:
    assert isinstance(SigmaKokiAxis(plug(), "theta_r"), Stage)


def test_open_reads_the_division_and_sets_nothing(plug: Any, script: Any) -> None:
    """The controller refuses to have its speeds set while an axis moves, and may be opened to be stopped."""
    stage = SigmaKokiAxis.open(plug(*script.dialogue(*HELLO, *says(b"?:SW", b"2,10"))), "theta_i", axis=2)
    assert stage.degrees_per_pulse == pytest.approx(0.0005)
    profile = stage.profile()  # as delivered: 5000 pulses/s after 200 ms, from 500
    assert (profile.speed, profile.acceleration) == pytest.approx((2.5, 2.5 / 0.2 / 0.9))


def test_open_sets_the_speeds_when_told_to(plug: Any, script: Any) -> None:
    link = plug(*script.dialogue(*HELLO, *says(b"?:SW", b"2,10", b"D:2S64F10000R168", b"OK")))
    profile = SigmaKokiAxis.open(link, "theta_i", axis=2, speed=5.0, acceleration=30.0).profile()
    assert (profile.speed, profile.acceleration) == pytest.approx((5.0, 30.0), rel=0.005)


def test_the_first_setting_of_a_program_sets_all_and_with_nothing_given_is_the_only_one(axis: Any) -> None:
    """What the controller has been left with is not known."""
    stage = axis(b"D:1S64F5000R211", b"OK", b"D:1S64F2000R86", b"OK")
    stage.set_profile()
    profile = stage.profile()
    assert (profile.speed, profile.acceleration) == pytest.approx((12.5, 60.0), rel=0.005)
    stage.set_profile(speed=5.0)
    stage.set_profile()
    assert stage.profile().speed == pytest.approx(5.0)


def test_a_first_setting_of_the_speed_alone_sets_the_default_acceleration(axis: Any) -> None:
    stage = axis(b"D:1S64F2000R86", b"OK")
    stage.set_profile(speed=5.0)
    assert stage.profile().acceleration == pytest.approx(60.0, rel=0.01)


def test_a_setting_that_was_refused_is_not_believed(axis: Any) -> None:
    stage = axis(b"D:1S64F5000R211", b"NG", b"D:1S64F5000R211", b"OK")
    with pytest.raises(DeviceFault, match="still moving"):
        stage.set_profile()
    assert stage.profile().acceleration == pytest.approx(2.5 / 0.2 / 0.9 * 5)  # as delivered
    stage.set_profile()


def test_on_a_gsc_02_one_command_sets_both_axes(plug: Any, script: Any) -> None:
    """The other one as delivered, until it is set too; and ACK1 tells whether the command was taken."""
    answer = READY + b"\r\n"
    link = plug(
        *script.dialogue(*HELLO, b"D:2S64F5000R211S500F5000R200\r\nQ:\r\n", answer, b"D:2S64F5000R211S64F2000R86\r\nQ:\r\n", answer)
    )
    one, two = (SigmaKokiAxis.open(link, f"axis {number}", controller="GSC-02", axis=number) for number in (1, 2))
    one.set_profile()
    two.set_profile(speed=5.0)


def test_identity(axis: Any) -> None:
    assert axis().identify() == Identity("Sigma Koki", "SHOT-302GS axis 1", "not told", "V2.01")


def test_state_at_rest_is_read_until_two_answers_agree(axis: Any) -> None:
    state = axis(b"Q:", b"     16000,-     4000,K,K,R", b"Q:", READY, b"Q:", READY).state()
    assert (state.position, state.moving, state.homed, state.warnings) == (45.0, False, True, ())


def test_a_position_that_never_repeats_itself_is_not_believed(axis: Any) -> None:
    lines = [line for count in range(4) for line in (b"Q:", b"%10d,         0,K,K,R" % count)]
    with pytest.raises(UnexpectedReply, match="check the cable"):
        axis(*lines).state()


def test_state_of_the_second_axis_on_the_way(axis: Any) -> None:
    state = axis(b"Q:", BUSY, axis=2).state()
    assert (state.position, state.moving) == (-10.0, True)


@pytest.mark.parametrize(("deg", "words"), [(10.0, b"+P4000"), (-10.0, b"-P4000"), (0.0, b"+P0"), (0.0012, b"+P0"), (0.0013, b"+P1")])
def test_move(axis: Any, deg: float, words: bytes) -> None:
    axis(b"Q:", READY, b"A:1" + words, b"OK", b"G:", b"OK").start_move(deg)


def test_move_on_a_gsc_02(plug: Any, script: Any) -> None:
    steps = script.dialogue(
        *HELLO, *says(b"Q:", READY), b"A:2-P4000\r\nQ:\r\n", READY + b"\r\n", b"G\r\nQ:\r\n", READY.replace(b"R", b"B") + b"\r\n"
    )
    SigmaKokiAxis(plug(*steps), "theta_r", controller="GSC-02", axis=2, assume_homed=True).start_move(-10)


@pytest.mark.parametrize("refused", [0, 1])
def test_moves_the_controller_refuses(axis: Any, refused: int) -> None:
    dialogue = (b"A:1+P4000", b"NG") if refused == 0 else (b"A:1+P4000", b"OK", b"G:", b"NG")
    with pytest.raises(DeviceFault, match=r"theta_r on /dev/.*10\.0000 deg: .* was refused"):
        axis(b"Q:", READY, *dialogue).start_move(10)


def test_moves_a_gsc_02_refuses_show_in_ack1(plug: Any, script: Any) -> None:
    steps = script.dialogue(*HELLO, *says(b"Q:", READY), b"A:1+P4000\r\nQ:\r\n", b"         0,         0,X,K,R\r\n")
    with pytest.raises(DeviceFault, match="was refused"):
        SigmaKokiAxis(plug(*steps), "theta_r", controller="GSC-02", assume_homed=True).start_move(10)


def test_home_and_its_end(axis: Any) -> None:
    zero = b"         0,         7,K,K,R"
    stage = axis(b"Q:", READY, b"C:11", b"OK", b"H:1", b"OK", b"Q:", BUSY, b"Q:", zero, b"Q:", zero, assume_homed=False)
    stage.start_home()
    assert stage.state().moving
    assert stage.state().homed


def test_a_gsc_02_homes_in_the_direction_configured(plug: Any, script: Any) -> None:
    answer = READY + b"\r\n"
    steps = script.dialogue(*HELLO, *says(b"Q:", READY), b"C:11\r\nQ:\r\n", answer, b"H:1+\r\nQ:\r\n", answer)
    SigmaKokiAxis(plug(*steps), "theta_r", controller="GSC-02", home_direction="+").start_home()


def test_a_home_that_ends_elsewhere_gives_no_reference(axis: Any) -> None:
    stage = axis(b"Q:", READY, b"C:11", b"OK", b"H:1", b"OK", b"Q:", READY, b"Q:", READY)
    stage.start_home()
    assert not stage.state().homed


def test_a_stopped_home_gives_no_reference(axis: Any) -> None:
    zero = b"         0,         7,K,K,R"
    stage = axis(b"Q:", READY, b"C:11", b"OK", b"H:1", b"OK", b"L:1", b"OK", b"Q:", zero, b"Q:", zero)
    stage.start_home()
    stage.stop()
    assert not stage.state().homed


def test_a_home_stopped_before_its_start_was_acknowledged_gives_no_reference(plug: Any, script: Any) -> None:
    blocked, zero = threading.Event(), b"         0,         7,K,K,R"
    link = plug(
        *script.dialogue(*HELLO, *says(b"Q:", READY, b"C:11", b"OK"), b"H:1\r\n"),
        script.tell(blocked),
        script.expect(b"L:1\r\n"),
        script.send(b"OK\r\nOK\r\n"),
        *script.dialogue(*says(b"Q:", zero, b"Q:", zero)),
    )
    stage = SigmaKokiAxis(link, "theta_r")
    with ThreadPoolExecutor(1) as pool:
        homing = pool.submit(stage.start_home)
        assert blocked.wait(5)
        stage.stop()
        homing.result()
    assert not stage.state().homed


@pytest.mark.parametrize("deg", [math.nan, math.inf, -math.inf])
def test_moves_to_nowhere_are_not_sent(plug: Any, deg: float) -> None:
    with pytest.raises(InvalidSetting):
        SigmaKokiAxis(plug(), "theta_r", assume_homed=True).start_move(deg)


@pytest.mark.parametrize("deg", [-90.01, 120.01])
def test_moves_beyond_the_travel_are_not_sent(plug: Any, deg: float) -> None:
    stage = SigmaKokiAxis(plug(), "theta_r", assume_homed=True, low_deg=-90, high_deg=120)
    assert stage.limits() == (-90, 120)
    with pytest.raises(DeviceFault, match="beyond the travel"):
        stage.start_move(deg)


def test_moves_of_too_many_pulses_are_not_sent(plug: Any) -> None:
    stage = SigmaKokiAxis(plug(), "theta_r", controller="GSC-02", assume_homed=True, degrees_per_pulse=1e-6)
    with pytest.raises(InvalidSetting, match="16777214"):
        stage.start_move(17.0)


def test_move_without_reference(plug: Any) -> None:
    with pytest.raises(NotHomed, match="home the axis first"):
        SigmaKokiAxis(plug(), "theta_r").start_move(10)


def test_a_move_while_somebody_else_moves_the_controller_is_refused(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="busy"):
        axis(b"Q:", BUSY).start_move(10)


def test_a_move_waits_for_the_controller_s_other_axis(plug: Any, script: Any) -> None:
    """The second axis starts at the first look that finds the controller ready; until then it counts as moving, the resting one not."""
    link = plug(
        *script.dialogue(
            *HELLO,
            *says(b"Q:", READY, b"A:1+P4000", b"OK", b"G:", b"OK", b"Q:", BUSY, b"Q:", BUSY),
            *says(b"Q:", READY, b"Q:", READY, b"A:2+P8000", b"OK", b"G:", b"OK", b"Q:", BUSY, b"Q:", BUSY),
        )
    )
    one, two = (SigmaKokiAxis(link, f"axis {number}", axis=number, assume_homed=True) for number in (1, 2))
    one.start_move(10)
    two.start_move(20)
    assert two.state().moving
    assert two.state().moving  # this one starts it
    assert not one.state().moving
    assert two.state().moving


def test_a_stop_forgets_the_move_that_waits(plug: Any, script: Any) -> None:
    link = plug(
        *script.dialogue(
            *HELLO,
            *says(b"Q:", READY, b"A:1+P4000", b"OK", b"G:", b"OK", b"Q:", BUSY, b"L:2", b"OK", b"Q:", READY, b"Q:", READY),
        )
    )
    one, two = (SigmaKokiAxis(link, f"axis {number}", axis=number, assume_homed=True) for number in (1, 2))
    one.start_move(10)
    two.start_move(20)
    two.stop()
    assert not two.state().moving


def test_a_lost_answer_to_a_start_is_not_asked_for_again(plug: Any, script: Any) -> None:
    """Strict script: a second start would fail it."""
    link = plug(*script.dialogue(*HELLO, *says(b"Q:", READY, b"A:1+P4000", b"OK", b"G:")), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match="theta_r on /dev/"):
        SigmaKokiAxis(link, "theta_r", assume_homed=True).start_move(10)


@pytest.mark.parametrize("options", [{"speed": 0.0}, {"speed": math.nan}, {"speed": 1300.0}, {"acceleration": 1.0}])
def test_impossible_profiles_are_not_sent(plug: Any, options: dict[str, float]) -> None:
    with pytest.raises(InvalidSetting):
        SigmaKokiAxis(plug(), "theta_r").set_profile(**options)


# what else is on the line ---------------------------------------------------------------------------------------------


def test_a_garbled_answer_is_asked_for_again_after_finding_step(axis: Any) -> None:
    stage = axis(b"Q:", BUSY[1:], *(line[:-2] for line in HELLO), b"Q:", BUSY)
    assert stage.state().position == 45.0


def test_a_late_answer_is_not_taken_for_that_of_the_next_question(plug: Any, script: Any) -> None:
    late = b"         1,         1,K,K,B\r\n"
    link = plug(
        *script.dialogue(*HELLO, b"Q:\r\n"),
        *script.dialogue(HELLO[0], late + HELLO[1], *says(b"Q:", BUSY)),
        timeout_s=SHORT_S,
    )
    assert SigmaKokiAxis(link, "theta_r").state().position == 45.0


@pytest.mark.parametrize("other", [b"OK", b"NG", b"R", b"B"])
def test_lines_of_another_shape_are_not_the_answer(axis: Any, other: bytes) -> None:
    assert axis(b"Q:", other + b"\r\n" + BUSY).state().position == 45.0


# stopping and arriving ------------------------------------------------------------------------------------------------


def test_stop_overtakes_a_blocked_exchange_and_both_get_their_answers(plug: Any, script: Any) -> None:
    blocked = threading.Event()
    link = plug(
        *script.dialogue(*HELLO, b"Q:\r\n"),
        script.tell(blocked),
        script.expect(b"L:2\r\n"),
        script.send(b"OK\r\n" + BUSY + b"\r\n"),
    )
    one, two = (SigmaKokiAxis(link, f"axis {number}", axis=number) for number in (1, 2))
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(one.state)
        assert blocked.wait(5)
        two.stop()
        assert waiting.result().position == 45.0


def test_a_move_that_is_armed_and_not_started_is_dropped_by_a_stop(plug: Any, script: Any) -> None:
    blocked, stopped = threading.Event(), threading.Event()
    link = plug(
        *script.dialogue(*HELLO, *says(b"Q:", READY), b"A:1+P4000\r\n"),
        script.tell(blocked),
        script.expect(b"L:1\r\n"),
        script.send(b"OK\r\nOK\r\n"),
        script.wait(stopped),
    )
    stage = SigmaKokiAxis(link, "theta_r", assume_homed=True)
    with ThreadPoolExecutor(1) as pool:
        moving = pool.submit(stage.start_move, 10)
        assert blocked.wait(5)
        stage.stop()
        stopped.set()
        with pytest.raises(DeviceFault, match="stopped before it could start"):
            moving.result()


def test_an_unanswered_stop_is_sent_again(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"L:1\r\n"), *script.dialogue(*says(b"L:1", b"OK")), timeout_s=SHORT_S)
    SigmaKokiAxis(link, "theta_r").stop()


def test_a_stop_that_is_refused_is_sent_again(plug: Any, script: Any) -> None:
    incidents: list[Incident] = []
    link = plug(*script.dialogue(*says(b"L:1", b"NG", b"L:1", b"OK")), report=incidents.append)
    SigmaKokiAxis(link, "theta_r").stop()
    assert [(incident.what, incident.detail) for incident in incidents] == [("repeated", "L:1 was refused")]


def test_a_stop_that_is_refused_twice_is_an_error(plug: Any, script: Any) -> None:
    with pytest.raises(DeviceFault, match="L:1 was refused"):
        SigmaKokiAxis(plug(*script.dialogue(*says(b"L:1", b"NG", b"L:1", b"NG"))), "theta_r").stop()


def test_arrival(axis: Any) -> None:
    axis(b"Q:", READY, b"Q:", READY).check_arrival(45, 0.001)


@pytest.mark.parametrize(("number", "letter"), [(1, b"L"), (2, b"M"), (1, b"W"), (2, b"W")])
def test_arrival_on_a_limit_sensor(axis: Any, number: int, letter: bytes) -> None:
    line = READY.replace(b"K,K", b"K," + letter)
    with pytest.raises(DeviceFault, match=r"theta_r on /dev/.*limit sensor"):
        axis(b"Q:", line, b"Q:", line, axis=number).check_arrival(45, 0.01)


def test_arrival_elsewhere_or_not_yet(axis: Any) -> None:
    with pytest.raises(DeviceFault, match=r"rests at 45\.0000 deg"):
        axis(b"Q:", READY, b"Q:", READY).check_arrival(44.9, 0.01)
    with pytest.raises(DeviceFault, match="still moving"):
        axis(b"Q:", BUSY).check_arrival(45, 0.01)


def test_unplugged_and_closed(plug: Any, script: Any) -> None:
    stage = SigmaKokiAxis(plug(*script.dialogue(*HELLO, b"Q:\r\n"), script.unplug()), "theta_r")
    with pytest.raises(PortClosed, match="theta_r on /dev/"):
        stage.state()
    stage.close()
    with pytest.raises(PortClosed, match="the device was closed"):
        stage.stop()


@pytest.mark.parametrize(
    "options",
    [
        {"axis": 0},
        {"axis": 3},
        {"controller": "SHOT"},
        {"home_direction": "up"},
        {"degrees_per_pulse": 0.0},
        {"degrees_per_pulse": math.nan},
        {"low_deg": 10.0, "high_deg": -10.0},
        {"high_deg": math.inf},
    ],
)
def test_nonsense_options(plug: Any, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match="theta_r"):
        SigmaKokiAxis(plug(), "theta_r", **options)


# over the simulator ---------------------------------------------------------------------------------------------------


@pytest.fixture(params=[SHOT_302GS, GSC_02], ids=["SHOT-302GS", "GSC-02"])
def bench(request: pytest.FixtureRequest) -> Iterator[tuple[SigmaKoki, SigmaKokiAxis, SigmaKokiAxis]]:
    """Both axes of a simulated controller, forty times as fast as life."""
    kind: Kind = request.param
    controller = "SHOT-302GS" if kind.answers else "GSC-02"
    with (
        served(lambda: SigmaKoki(SimClock(40.0), [100.0, 30.0], kind)) as (sigma, ports),
        Link.open(ports.tcp, timeout_s=5.0, terminator=b"\r\n") as link,
    ):
        options: dict[str, Any] = {"controller": controller, "speed": 40.0, "acceleration": 200.0}
        yield sigma, SigmaKokiAxis.open(link, "theta_i", axis=1, **options), SigmaKokiAxis.open(link, "theta_r", axis=2, **options)


def arrive(*stages: SigmaKokiAxis) -> None:
    for stage in stages:
        while stage.state().moving:
            pass


def test_both_axes_home_and_move_one_after_the_other(bench: tuple[SigmaKoki, SigmaKokiAxis, SigmaKokiAxis]) -> None:
    sigma, *stages = bench
    for stage in stages:
        with pytest.raises(NotHomed):
            stage.start_move(1.0)
    for stage in stages:
        stage.start_home()
    arrive(*stages)
    assert all(stage.state().homed for stage in stages)
    for stage, deg in zip(stages, (120.0, -33.3), strict=True):
        stage.start_move(deg)
    arrive(*stages)
    for stage, deg, truth in zip(stages, (120.0, -33.3), sigma.axes, strict=True):
        stage.check_arrival(deg, 0.001)
        assert truth.track.nominal(sigma._clock.now())[0] == pytest.approx(deg, abs=0.00126)


def test_a_limit_sensor_on_the_way_denies_the_arrival(bench: tuple[SigmaKoki, SigmaKokiAxis, SigmaKokiAxis]) -> None:
    sigma, stage, other = bench
    stage.start_home()
    arrive(stage)
    stage.start_move(100.0)
    sigma.limit(1)
    arrive(stage)
    with pytest.raises(DeviceFault, match="limit sensor"):
        stage.check_arrival(100.0, 0.001)
    assert other.state().warnings == ()
