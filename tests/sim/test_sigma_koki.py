"""The two-axis controllers as state machines: grammar, answers, arming and starting, speeds, limits, motion."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.motion import Ringing
from sim.sigma_koki import GSC_02, SHOT_302GS, Kind, SigmaKoki, StageModel


class Desk:
    """A controller with two stages and a clock in hand."""

    def __init__(self, kind: Kind = SHOT_302GS, stage: StageModel | None = None) -> None:
        self.clock = ManualClock()
        self.sigma = SigmaKoki(self.clock, [100.0, 30.0], kind, stage or StageModel(ringing=Ringing(0.0)))

    def ask(self, command: str) -> str | None:
        answer = self.sigma.answer(command.encode("latin-1"))
        return None if answer is None else answer.decode("ascii")

    def run(self, *commands: str) -> None:
        """Send commands that are all taken, and wait for the end of what each starts."""
        for command in commands:
            assert self.ask(command) in ("OK", None)
            self.wait()

    def wait(self, seconds: float = 120.0) -> None:
        self.clock.set(self.clock.now() + seconds)

    def angle(self, axis: int = 1) -> float:
        return self.sigma.axes[axis - 1].track.mechanical(self.clock.now())


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def homed(desk: Desk) -> Desk:
    desk.run("H:W")
    return desk


@pytest.fixture
def gsc() -> Desk:
    desk = Desk(GSC_02)
    desk.run("H:W+-")
    return desk


# Grammar and status


def test_the_status_line_of_the_sheet(homed: Desk) -> None:
    assert homed.ask("Q:") == "         0,         0,K,K,R"
    homed.run("A:1+P14000", "G:")
    assert homed.ask("Q:") == "     14000,         0,K,K,R"
    homed.run("A:W-P20-P300", "G:")
    line = homed.ask("Q:")
    assert line == "-       20,-      300,K,K,R"
    assert (line[24], line[26]) == ("K", "R")


def test_questions(desk: Desk) -> None:
    assert desk.ask("?:SW") == "2,2"
    assert desk.ask("?:V") == "V1.00"
    assert desk.ask("!:") == "R"
    desk.ask("H:1")
    assert desk.ask("!:") == "B"
    assert str(desk.ask("Q:")).endswith("K,K,B")


@pytest.mark.parametrize(
    "command",
    [
        "",
        "X:1",
        "H:3",
        "H:",
        "H:1+",
        "A:1P100",
        "A:1+100",
        "A:1+P",
        "A:1+P1000000000",
        "A:1+P268435456",
        "A:W+P10",
        "A:1+P10+P20",
        "A:1+P10x",
        "A:1+P\xb2",
        "J:1",
        "J:W+",
        "G:1",
        "L:",
        "L:3",
        "D:1S0F100R100",
        "D:1S200F100R100",
        "D:1S10F600000R100",
        "D:1S10F100R1001",
        "D:1S63F8000R100",
        "D:W" + "S10F100R10",
        "D:1F100",
        "C:12",
        "C:31",
        "S:13",
        "S:1",
        "?:X",
        "Q",
        "h:1",
    ],
)
def test_what_is_refused(homed: Desk, command: str) -> None:
    assert homed.ask(command) == "NG"
    assert str(homed.ask("Q:"))[22] == "X"
    assert homed.ask("G:") == "OK"
    assert homed.ask("Q:") == "         0,         0,K,K,R"


@pytest.mark.parametrize("command", ["A:1+P268435455", "M:W+P0-P0", "D:1S64F8000R0", "D:WS1F1R0S500F500000R1000", "C:W0", "S:2250", "R:W"])
def test_what_is_taken(homed: Desk, command: str) -> None:
    assert homed.ask(command) == "OK"
    assert str(homed.ask("Q:"))[22] == "K"


def test_while_busy_only_stops_and_questions_are_taken(homed: Desk) -> None:
    assert (homed.ask("A:1+P40000"), homed.ask("G:")) == ("OK", "OK")
    for command in ("A:2+P10", "M:1+P1", "G:", "H:2", "R:2", "D:2S1F2R3", "C:21", "S:22", "J:2+"):
        assert homed.ask(command) == "NG"
    assert homed.ask("L:2") == "OK"
    assert homed.ask("!:") == "B"


def test_the_gsc_02_answers_questions_only(gsc: Desk) -> None:
    for command in ("A:1+P1000", "G", "C:11", "D:2S500F5000R200S500F5000R200"):
        assert gsc.ask(command) is None
        assert str(gsc.ask("Q:"))[22] == "K"
        gsc.wait()
    assert gsc.ask("Q:") == "      1000,         0,K,K,R"


@pytest.mark.parametrize(
    "command",
    [
        *("H:1", "H:W+", "H:1++", "A:1+P16777215", "D:1S1F201R10S1F200R10", "D:2S49F500R10S50F500R10", "D:2S50F20001R10S50F500R10"),
        *("D:2S500F5000R200", "D:WS500F5000R200S500F5000R200", "S:12"),
    ],
)
def test_what_the_gsc_02_refuses_shows_in_its_status(gsc: Desk, command: str) -> None:
    assert gsc.ask(command) is None
    assert str(gsc.ask("Q:"))[22] == "X"


# Motion


def test_power_up(desk: Desk) -> None:
    assert desk.ask("Q:") == "         0,         0,K,K,R"
    assert (desk.angle(1), desk.angle(2)) == (100.0, 30.0)


def test_the_return_to_the_origin_takes_its_time_and_ends_at_zero(desk: Desk) -> None:
    desk.ask("H:1")
    desk.wait(99 / 25)
    assert desk.ask("!:") == "B"
    desk.wait(3.0)
    assert desk.ask("Q:") == "         0,         0,K,K,R"
    assert desk.angle(1) == pytest.approx(0.0, abs=1e-9)
    assert desk.angle(2) == 30.0


def test_a_stopped_return_leaves_the_counter_as_it_was(desk: Desk) -> None:
    desk.ask("H:1")
    desk.wait(1.0)
    desk.run("L:1")
    assert desk.angle(1) == pytest.approx(100.0 + int(str(desk.ask("Q:"))[:10].replace(" ", "")) * 0.0025, abs=0.002)
    assert desk.angle(1) > 70.0


def test_nothing_moves_before_go(homed: Desk) -> None:
    homed.run("A:W+P4000-P8000")
    assert (homed.angle(1), homed.angle(2)) == pytest.approx((0.0, 0.0))
    homed.run("G:")
    assert (homed.angle(1), homed.angle(2)) == pytest.approx((10.0, -20.0))
    homed.run("G:")  # nothing is armed any more
    assert (homed.angle(1), homed.angle(2)) == pytest.approx((10.0, -20.0))


def test_arming_again_and_stopping_forget_what_was_armed(homed: Desk) -> None:
    homed.run("A:1+P4000", "A:2+P4000", "G:")
    assert (homed.angle(1), homed.angle(2)) == pytest.approx((0.0, 10.0))
    homed.run("A:1+P4000", "L:1", "G:")
    assert homed.angle(1) == pytest.approx(0.0)


def test_relative_moves(homed: Desk) -> None:
    homed.run("M:1+P400", "G:", "M:1-P100", "G:")
    assert homed.ask("Q:") == "       300,         0,K,K,R"


def test_a_move_takes_as_long_as_its_speeds_say(homed: Desk) -> None:
    """Two ramps from 500 to 5000 pulses/s of 0.2 s each, and 5000 pulses/s between them."""
    homed.ask("A:1+P40000")
    homed.ask("G:")
    duration = 0.4 + (40000 - 2 * 0.2 * (500 + 5000) / 2) / 5000
    homed.wait(duration - 1e-3)
    assert homed.ask("!:") == "B"
    homed.wait(2e-3)
    assert homed.ask("Q:") == "     40000,         0,K,K,R"


def test_speeds_are_each_axis_own(homed: Desk) -> None:
    homed.run("D:2S64F8000R100")
    assert [axis.speeds for axis in homed.sigma.axes] == [(500, 5000, 200), (64, 8000, 100)]
    homed.run("D:WS1F2R3S4F5R6")
    assert [axis.speeds for axis in homed.sigma.axes] == [(1, 2, 3), (4, 5, 6)]


@pytest.mark.parametrize(("command", "way"), [("L:1", 40.0), ("L:W", 40.0), ("L:E", 0.0)])
def test_stops_decelerate_but_the_emergency_stop_does_not(homed: Desk, command: str, way: float) -> None:
    homed.ask("A:1+P400000")
    homed.ask("G:")
    homed.wait(2.0)
    before = homed.angle()
    homed.run(command)
    braking = 12.5**2 / (2 * homed.sigma.axes[0].acceleration()) if way else 0.0
    assert homed.angle() - before == pytest.approx(braking, abs=1e-6)


def test_a_jog_goes_on_at_start_speed(homed: Desk) -> None:
    homed.ask("J:2-")
    homed.ask("G:")
    homed.wait(10.0)
    assert homed.angle(2) == pytest.approx(-500 * 0.0025 * 10, rel=0.01)
    homed.run("L:2")
    assert homed.ask("!:") == "R"


def test_limit_sensors_stop_an_axis_and_say_so_until_it_leaves(homed: Desk) -> None:
    homed.run("A:W+P200000-P200000", "G:")
    assert (homed.angle(1), homed.angle(2)) == pytest.approx((400.0, -400.0))
    assert str(homed.ask("Q:"))[24] == "W"
    homed.run("M:1-P100", "G:")
    assert str(homed.ask("Q:"))[24] == "M"
    homed.run("M:2+P100", "G:")
    assert str(homed.ask("Q:"))[24] == "K"
    homed.sigma.limit(1)
    assert str(homed.ask("Q:"))[24] == "L"


def test_setting_the_origin_and_the_division(homed: Desk) -> None:
    homed.run("A:1+P4000", "G:", "R:1", "A:1+P4000", "G:")
    assert homed.ask("Q:") == "      4000,         0,K,K,R"
    assert homed.angle() == pytest.approx(20.0)
    homed.run("S:11", "M:1+P1000", "G:")
    assert homed.ask("?:SW") == "1,2"
    assert homed.ask("Q:") == "      5000,         0,K,K,R"
    assert homed.angle() == pytest.approx(25.0)


def test_without_excitation_nothing_starts(homed: Desk) -> None:
    homed.run("C:10", "A:1+P100")
    assert homed.ask("G:") == "NG"
    assert homed.ask("H:1") == "NG"
    homed.run("C:11", "A:1+P100", "G:")
    assert homed.angle() == pytest.approx(0.25)


# Whatever arrives

WORDS = st.sampled_from(["H:", "A:", "M:", "J:", "G:", "G", "L:", "R:", "D:", "C:", "S:", "Q:", "!:", "?:", "1", "2", "W", "E", "+", "-",
                         "P", "100", "S64F8000R10", "F", "0", "V", "SW", "99999999", "\xb2"])  # fmt: skip


@given(
    st.one_of(st.binary(max_size=60), st.lists(WORDS, max_size=8).map(lambda words: "".join(words).encode("latin-1"))),
    st.sampled_from([SHOT_302GS, GSC_02]),
    st.floats(0, 3),
)
@example(b"D:1S1F1R0", SHOT_302GS, 0.0)
@example(b"R:1" + b"9" * 500, SHOT_302GS, 0.0)
def test_no_bytes_can_upset_it(message: bytes, kind: Kind, pause: float) -> None:
    desk = Desk(kind)
    answer = desk.sigma.answer(message)
    assert answer is None or answer in (b"OK", b"NG", b"R", b"B", b"2,2", b"V1.00") or len(answer) == 27
    desk.ask("G:")
    desk.wait(pause)
    desk.ask("L:E")
    desk.wait(1.0)
    status = desk.ask("Q:")
    assert status is not None
    assert len(status) == 27
    assert status[-1] == "R"


@pytest.mark.parametrize("change", [{"full_step": 0.0}, {"slow": 6000}, {"division": 3}, {"sensor_min": 500.0}, {"home_speed": math.nan}])
def test_impossible_stages_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(SimError):
        dataclasses.replace(StageModel(), **change)  # type: ignore[arg-type]


def test_there_are_two_axes() -> None:
    with pytest.raises(SimError):
        SigmaKoki(ManualClock(), [0.0])
