"""The ESP301 as a state machine: grammar, units, the error queue, power, limits, motion."""

from __future__ import annotations

import asyncio
import dataclasses

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.motion import Ringing
from sim.newport import Esp301, EspStage
from tests.sim.lines import Recorder


class Desk:
    """A controller with two stages and a clock in hand."""

    def __init__(self, stage: EspStage | None = None) -> None:
        self.clock = ManualClock()
        self.esp = Esp301(self.clock, [200.0, 30.0], stage or EspStage(ringing=Ringing(0.0)))

    def send(self, message: str) -> list[str]:
        answers = [self.esp.execute(part)[1] for part in message.encode("latin-1").split(b";")]
        return [answer for answer in answers if answer is not None]

    def ask(self, message: str) -> str:
        (answer,) = self.send(message)
        return answer

    def number(self, message: str) -> float:
        return float(self.ask(message))

    def errors(self) -> list[int]:
        codes = []
        while code := int(self.ask("TE?")):
            codes.append(code)
        return codes

    def wait(self, seconds: float = 60.0) -> None:
        self.clock.set(self.clock.now() + seconds)

    def home(self) -> None:
        self.send("1MO;1OR1;2MO;2OR1")
        self.wait()
        assert self.errors() == []

    def angle(self, axis: int = 1) -> float:
        return self.esp.axes[axis - 1].track.mechanical(self.clock.now())


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def homed(desk: Desk) -> Desk:
    desk.home()
    return desk


# Grammar


def test_a_message_may_join_commands_and_spell_them_loosely(homed: Desk) -> None:
    assert homed.send("1PA+10.0;1MD?;2MD?") == ["0", "1"]
    homed.wait()
    assert homed.send(" 1 pa 20 ; 1 tp ") == ["10.000000"]
    homed.wait()
    assert homed.number("1TP") == homed.number("1TP?") == homed.number("1DP?") == 20.0


def test_set_commands_are_silent(desk: Desk) -> None:
    assert desk.send("1MO;1VA20;1AC100;1SN7;1ST;AB;1WS0") == []


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ("1XY5", 6),
        ("hello", 6),
        ("1", 6),
        ("\xb2PA1", 6),
        ("PA5", 37),
        ("4PA5", 9),
        ("0PA5", 9),
        ("3PA5", 308),
        ("1PA", 38),
        ("1PAfive", 7),
        ("1VA", 38),
        ("1VA0", 101),
        ("1VA81", 110),
        ("2AC1201", 211),
        ("1PA5", 113),
        ("1OR1", 113),
        ("1SN2", 101),
        ("1SN12", 101),
        ("1SL400", 101),
        ("1MO;1OR9", 101),
        ("1MO;1PA361", 106),
        ("1MO;1PA-1", 107),
        ("1MO;1PR-1", 107),
        ("1MO;1OR1;1PA5", 130),
    ],
)
def test_errors_name_what_was_wrong(desk: Desk, message: str, code: int) -> None:
    assert desk.send(message) == []
    assert desk.errors() == [code]


def test_an_error_is_read_once_oldest_first_with_time_and_text(desk: Desk) -> None:
    desk.wait(2.0)
    desk.send("1PA5")
    desk.wait(1.0)
    desk.send("1XY")
    assert desk.ask("TB?") == "113, 5000, MOTOR NOT ENABLED"
    assert desk.ask("TB?") == "6, 7500, COMMAND DOES NOT EXIST"
    assert desk.ask("TB?") == "0, 7500, NO ERROR DETECTED"
    assert desk.ask("TE?") == "0"


def test_the_error_queue_holds_ten(desk: Desk) -> None:
    for _ in range(15):
        desk.send("1XY")
    assert desk.errors() == [6] * 10


def test_identity(desk: Desk) -> None:
    assert desk.ask("VE?").startswith("ESP301 Version ")
    assert desk.ask("1ID?") == "URS75BCC, SN00000"


def test_the_status_byte(desk: Desk) -> None:
    assert ord(desk.ask("TS")) & 0x17 == 0
    desk.home()
    assert ord(desk.ask("TS")) & 0x17 == 0x10
    desk.send("2PA100")
    assert ord(desk.ask("TS")) & 0x17 == 0x12
    desk.send("1PA100")
    assert ord(desk.ask("TS")) & 0x17 == 0x13


# Settings and units


@pytest.mark.parametrize(("name", "value"), [("VA", 25.0), ("AC", 150.0), ("AG", 90.0), ("SL", -5.0), ("SR", 300.0), ("OH", 10.0)])
def test_settings_are_kept_by_each_axis(desk: Desk, name: str, value: float) -> None:
    desk.send(f"1{name}{value}")
    assert desk.number(f"1{name}?") == value
    assert desk.number(f"2{name}?") != value
    assert desk.errors() == []


@pytest.mark.parametrize(("units", "per_degree"), [(7, 1.0), (8, 10 / 9), (9, 0.01745329), (10, 17.45329), (11, 17453.29), (0, 5000)])
def test_every_value_is_in_the_units_in_use(homed: Desk, units: int, per_degree: float) -> None:
    homed.send("1PA90")
    homed.wait()
    homed.send(f"1SN{units}")
    assert homed.number("1SN?") == units
    assert homed.number("1TP") == pytest.approx(90 * per_degree, rel=1e-5)
    assert homed.number("1VA?") == pytest.approx(60 * per_degree, rel=1e-5)
    homed.send(f"1PA{45 * per_degree:.6f}")
    homed.wait()
    assert homed.errors() == []
    assert homed.angle() == pytest.approx(45.0, abs=2e-4)


# Motion


def test_power_up(desk: Desk) -> None:
    assert desk.ask("1MO?") == "0"
    assert desk.ask("1MD?") == "1"
    assert desk.number("1TP") == 0.0
    assert desk.angle() == 200.0


def test_homing_finds_the_switch_and_takes_its_time(desk: Desk) -> None:
    desk.send("1MO;1OR1")
    desk.wait(199 / 30)
    assert desk.ask("1MD?") == "0"
    desk.wait(3.0)
    assert desk.ask("1MD?") == "1"
    assert desk.number("1TP") == 0.0
    assert desk.angle() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("search", "end"), [(2, 0.0), (3, 370.0), (4, -10.0), (5, 370.0), (6, -10.0)])
def test_home_searches_end_at_their_switches(desk: Desk, search: int, end: float) -> None:
    desk.send(f"1MO;1OR{search}")
    desk.wait()
    assert desk.angle() == pytest.approx(end, abs=1e-9)
    assert desk.number("1TP") == 0.0


def test_the_search_for_the_zero_count_goes_there_and_changes_nothing(desk: Desk) -> None:
    desk.send("1MO;1PA40")
    desk.wait()
    desk.send("1OR0")
    desk.wait()
    assert desk.number("1TP") == 0.0
    assert desk.angle() == pytest.approx(200.0)


def test_a_stopped_homing_is_an_error_and_gives_no_reference(desk: Desk) -> None:
    desk.send("1MO;1OR1")
    desk.wait(1.0)
    desk.send("1ST")
    desk.wait()
    assert desk.errors() == [120]
    assert desk.angle() > 150.0
    assert desk.number("1TP") == pytest.approx(desk.angle() - 200.0, abs=2e-4)


def test_a_move_follows_the_trapezoid_of_its_settings(homed: Desk) -> None:
    homed.send("1VA20;1AC100;1AG100")
    start = homed.clock.now()
    homed.send("1PA100")
    assert homed.esp.axes[0].track.end - start == pytest.approx(100 / 20 + 20 / 100)
    homed.wait(2.6)
    assert homed.number("1TP") == pytest.approx(50.0, abs=1e-3)
    assert homed.number("1TV") == pytest.approx(20.0)
    homed.wait(2.6 - 1e-6)
    assert homed.ask("1MD?") == "0"
    homed.wait(2e-6)
    assert homed.send("1MD?;1TP") == ["1", "100.000000"]


def test_readback_is_in_whole_counts(homed: Desk) -> None:
    homed.send("1PA33.33333")
    homed.wait()
    assert homed.number("1TP") == pytest.approx(33.3334, abs=1e-9)


def test_relative_moves_add_up_even_under_way(homed: Desk) -> None:
    homed.send("1PA100;1PR20")
    homed.wait(0.5)
    homed.send("1PR-10")
    homed.wait()
    assert homed.number("1TP") == pytest.approx(110.0)


def test_stop_and_abort_brake_from_where_the_axis_is(homed: Desk) -> None:
    for command, deceleration in (("1ST", 600.0), ("1AB", 2400.0), ("AB", 2400.0)):
        homed.send("1PA300")
        homed.wait(1.0)
        before = homed.number("1TP")
        homed.send(command)
        homed.wait(1.0)
        assert homed.ask("1MD?") == "1"
        assert homed.number("1TP") - before == pytest.approx(60**2 / (2 * deceleration), abs=1e-3)
        homed.send("1PA0")
        homed.wait()


def test_switching_the_motor_off_ends_the_motion(homed: Desk) -> None:
    homed.send("1PA300")
    homed.wait(1.0)
    homed.send("1MF")
    homed.wait(1.0)
    assert homed.send("1MD?;1MO?") == ["1", "0"]
    homed.send("1PA0")
    assert homed.errors() == [113]


@pytest.mark.parametrize(("way", "end", "code"), [("+", 370.0, 104), ("-", -10.0, 105)])
def test_a_limit_switch_ends_an_endless_motion_with_its_error(homed: Desk, way: str, end: float, code: int) -> None:
    homed.send(f"1MV{way}")
    homed.wait(0.1)
    assert homed.errors() == []
    homed.wait()
    assert homed.angle() == pytest.approx(end)
    assert homed.errors() == [code]


def test_without_a_reference_a_move_can_hit_the_switch(desk: Desk) -> None:
    desk.send("1MO;1PA300")  # from 200 deg true
    desk.wait()
    assert desk.angle() == pytest.approx(370.0)
    assert desk.errors() == [104]


def test_a_following_error_stops_it_dead_without_power(homed: Desk) -> None:
    homed.send("1PA300")
    homed.wait(1.0)
    where = homed.angle()
    homed.esp.fail(1, 3)
    homed.wait(1.0)
    assert homed.angle() == pytest.approx(where)
    assert homed.send("1MD?;1MO?;2MO?") == ["1", "0", "1"]
    assert homed.ask("TB?").startswith("103, ")


def test_the_red_button_stops_every_axis(homed: Desk) -> None:
    homed.send("1PA300;2PA300")
    homed.wait(1.0)
    homed.esp.emergency()
    homed.wait(1.0)
    assert homed.send("1MD?;2MD?;1MO?;2MO?") == ["1", "1", "0", "0"]
    assert homed.errors() == [4]


def test_defining_home_moves_the_counter_and_not_the_arm(homed: Desk) -> None:
    homed.send("1PA50")
    homed.wait()
    homed.send("1DH")
    assert homed.number("1TP") == 0.0
    homed.send("1DH12.5")
    assert homed.number("1TP") == 12.5
    assert homed.angle() == pytest.approx(50.0)


def test_waiting_holds_back_what_follows() -> None:
    async def scene() -> None:
        clock = ManualClock()
        esp, line = Esp301(clock, [10.0], EspStage(speed=20, acceleration=100)), Recorder()
        task = asyncio.create_task(esp.serve(line))
        line.said.put_nowait(b"1MO;1PA40;1WP20;1TP;1WS500;1MD?\r")
        await clock.advance(1.0)
        assert line.heard == []
        await clock.advance(0.2)
        assert len(line.heard) == 1
        assert float(line.heard[0]) == pytest.approx(20.0, abs=0.01)
        await clock.advance(1.4)  # the move takes 2.2 s
        assert len(line.heard) == 1
        line.said.put_nowait(b"1T")
        line.said.put_nowait(b"P\r")
        await clock.advance(0.2)
        assert line.heard[1:] == [b"1\r\n", b"40.000000\r\n"]
        line.said.put_nowait(b"")
        await task

    asyncio.run(scene())


# Whatever arrives

WORDS = st.sampled_from(
    "1 2 3 9 PA PR OR MO MF ST AB TP MD? TB? TE? VA AC SL SR SN DH MV + - ? ; . 10 1e9 -5 0 7 11 WS WP TS VE? 1e99 \xb2".split(" ")  # noqa: SIM905
)


@given(st.one_of(st.binary(max_size=60), st.lists(WORDS, max_size=12).map(lambda words: "".join(words).encode("latin-1"))), st.floats(0, 3))
@example(b"1DH" + b"9" * 240 + b"e99", 0.0)
@example(b"1MO;1SN11;1VA1e-99;1PA1", 1.0)
def test_no_bytes_can_upset_it(message: bytes, pause: float) -> None:
    desk = Desk()
    desk.home()
    for command in message.split(b";"):
        _, answer = desk.esp.execute(command)
        assert answer is None or answer.isascii()
    desk.wait(pause)
    desk.send("AB")
    desk.wait(1e9)
    assert desk.send("1MD?;2MD?")[-2:] == ["1", "1"]
    assert len(desk.errors()) <= 10


@pytest.mark.parametrize(
    "change", [{"speed": 0.0}, {"count": -1.0}, {"limit_min": 400.0}, {"hard_max": -20.0}, {"home_speed": float("nan")}]
)
def test_impossible_stages_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(SimError):
        Esp301(ManualClock(), [0.0], dataclasses.replace(EspStage(), **change))  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [0, 4])
def test_there_are_one_to_three_axes(count: int) -> None:
    with pytest.raises(SimError):
        Esp301(ManualClock(), [0.0] * count)
