"""The picoammeter as a state machine: SCPI, ranges, zero correction, filter, timing."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.keithley import RANGES, Keithley6485, MeterModel
from tests.sim.lines import Recorder

OVERFLOW = 9.9e37
START = "*RST;:SYST:ZCH ON;:CURR:RANG 2e-9;:INIT;:SYST:ZCOR:ACQ;:SYST:ZCOR ON;:CURR:RANG:AUTO ON;:SYST:ZCH OFF;:FORM:ELEM READ,TIME,STAT"


class Desk:
    """A meter whose input current and clock are in hand."""

    def __init__(self, current: float | Callable[[float], float] = 1e-7, offset: float = 3e-13, **model: float) -> None:
        self.clock = ManualClock(eager=True)
        self.current: Callable[[float], float] = current if callable(current) else lambda t: current
        self.windows: list[tuple[float, float]] = []
        self.meter = Keithley6485(self.clock, self._signal, np.random.default_rng(2), MeterModel(offset=offset, **model))  # type: ignore[arg-type]

    def _signal(self, t0: float, t1: float) -> float:
        self.windows.append((t0, t1))
        return self.current((t0 + t1) / 2)

    def send(self, message: str) -> str | None:
        reply = asyncio.run(self.meter.answer(message.encode("latin-1")))
        return None if reply is None else reply.decode("ascii")

    def ask(self, message: str) -> str:
        reply = self.send(message)
        assert reply is not None
        return reply

    def read(self, message: str = "READ?") -> list[float]:
        return [float(word) for word in self.ask(message).split(",")]

    def errors(self) -> list[int]:
        return [int(code) for code in self.ask("SYST:ERR:CODE:ALL?").split(",") if code != "0"]

    def ready(self, more: str = "") -> Desk:
        self.send(START + more)
        assert self.errors() == []
        self.windows.clear()
        return self


@pytest.fixture
def desk() -> Desk:
    return Desk()


# Language


@pytest.mark.parametrize(
    "message",
    ["CURR:RANG:AUTO?", "curr:rang:auto?", "CURRENT:DC:RANGE:AUTO?", ":SENS:CURR:RANG:AUTO?", "SENSE1:CURR:DC:RANG:UPP:AUTO?",
     "Sens:Current:Range:Auto?"],
)  # fmt: skip
def test_headers_in_short_and_long_form_with_and_without_their_optional_parts(desk: Desk, message: str) -> None:
    assert desk.ask(message) == "1"


@pytest.mark.parametrize(
    "message",
    ["CURRE:RANG?", "RANG?", "SENS2:CURR:RANG?", "CURR:RANGES?", "CURR?", "VOLT:RANG?", "*XYZ", "READ", "INIT?", "SYST:ZCOR:ACQ?"],
)
def test_other_headers_are_undefined_and_get_no_answer(desk: Desk, message: str) -> None:
    assert desk.send(message) is None
    assert desk.ask("SYST:ERR?") == '-113,"Undefined header"'
    assert desk.ask("STAT:QUE?") == '0,"No error"'


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ("CURR:RANG", -109), ("CURR:RANG volts", -104), ("CURR:RANG 1", -222), ("CURR:NPLC 0.001", -222), ("CURR:NPLC 61", -222),
        ("SYST:ZCH", -109),
        ("SYST:ZCH maybe", -104), ("FORM:ELEM LIGHT", -224), ("FORM:ELEM", -109), ("FORM BIN", -224), ("FUNC 'VOLT'", -224),
        ("FUNC CURR", -224),
        ("TRIG:COUN 0", -222), ("TRIG:COUN 1e999", -222), ("AVER:TCON SLOW", -224), ("AVER:COUN 1", -222), ("*RST 1", -108),
        ("READ? 1", -108),
        ("FETC?", -230), ("SYST:ZCH OFF;ZCOR:ACQ", -221), ("!?", -102), ("CURR:RANG\x012", -101), ("caf\xe9", -101), ("SYST:LFR 55", -222),
    ],
)  # fmt: skip
def test_errors_are_queued(desk: Desk, message: str, code: int) -> None:
    assert desk.send(message) is None
    assert desk.errors() == [code]
    assert desk.ask("*IDN?").startswith("KEITHLEY INSTRUMENTS INC.,MODEL 6485,")


def test_relative_headers_continue_the_path_and_a_colon_starts_anew(desk: Desk) -> None:
    desk.send("SYST:ZCH ON;ZCOR ON;*CLS;ZCH OFF;:CURR:NPLC 1;RANG 2e-6")
    assert desk.errors() == []
    assert desk.ask("SYST:ZCH?;ZCOR?;:CURR:NPLC?") == "0;1;1.000000E+00".replace(";1.0", ";+1.0")
    desk.send("SYST:ZCH ON;CURR:NPLC 5")
    assert desk.errors() == [-113]
    assert float(desk.ask("CURR:NPLC?")) == 1.0


def test_after_an_error_the_rest_of_the_message_is_dropped(desk: Desk) -> None:
    assert desk.send("*OPC?;BAD;*OPC?") == "1"


def test_the_queue_holds_ten(desk: Desk) -> None:
    for _ in range(12):
        desk.send("BAD")
    assert desk.ask("SYST:ERR:COUN?") == "10"
    assert desk.errors() == [-113] * 9 + [-350]
    desk.send("BAD")
    desk.send("*CLS")
    assert desk.errors() == []


def test_event_register(desk: Desk) -> None:
    assert desk.ask("*ESR?") == "128"
    desk.send("BAD")
    desk.send("CURR:RANG 5")
    desk.send("*OPC")
    assert desk.ask("*ESR?") == str(32 + 16 + 1)
    assert desk.ask("*ESR?") == "0"


def test_queries_the_6514_client_asks(desk: Desk) -> None:
    assert desk.ask("FUNCTION?") == '"CURR:DC"'
    assert desk.ask("CONF?") == '"CURR:DC"'
    assert float(desk.ask("CURR:DC:RANGE:UPPER?")) == 20e-3
    desk.send('FUNCTION "CURR:DC"')
    assert desk.errors() == []


@pytest.mark.parametrize(
    ("tell", "ask", "value"),
    [
        ("CURR:NPLC 0.1", "SENS:CURR:NPLC?", 0.1), ("CURR:NPLC MAX", "CURR:NPLC?", 60.0), ("AVER:COUN 5", "AVER:COUN?", 5), ("AVER ON",
        "AVERAGE:STATE?", 1),
        ("TRIG:COUN 7", "TRIGGER:COUNT?", 7), ("ARM:COUN 3", "ARM:COUN?", 3), ("TRIG:DEL 0.5", "TRIG:DEL?", 0.5), ("SYST:LFR 50",
        "SYST:LFR?", 50),
        ("SYST:ZCH 0", "SYST:ZCH?", 0), ("SYST:ZCOR 1", "SYST:ZCOR?", 1), ("CURR:RANG:AUTO:ULIM 1e-6", "CURR:RANG:AUTO:ULIM?", 2e-6),
        ("*ESE 32", "*ESE?", 32), ("CURR:RANG 1.5e-8", "CURR:RANG?", 2e-8), ("CURR:RANG -3e-4", "CURR:RANG?", 2e-3), ("CURR:RANG MIN",
        "CURR:RANG?", 2e-9),
        ("CURR:RANG 2.1e-2", "CURR:RANG?", 2e-2), ("CURR:RANG 2.05e-7", "CURR:RANG?", 2e-7),
    ],
)  # fmt: skip
def test_settings_are_kept(desk: Desk, tell: str, ask: str, value: float) -> None:
    desk.send(tell)
    assert desk.errors() == []
    assert float(desk.ask(ask)) == pytest.approx(value, rel=1e-12, abs=0)
    desk.send("AVER:TCON REPEAT")
    assert desk.ask("AVER:TCON?") == "REP"


def test_reset_and_configure(desk: Desk) -> None:
    desk.ready(";:CURR:RANG 2e-6;NPLC 1;:TRIG:COUN 4;:AVER ON")
    desk.send("CONF:CURR")
    assert desk.ask("CURR:RANG:AUTO?;:TRIG:COUN?;:AVER?;:SYST:ZCOR?") == "1;1;0;1"
    desk.send("*RST")
    assert desk.ask("SYST:ZCH?;ZCOR?;:FORM:ELEM?") == "1;0;READ,UNIT,TIME,STAT"
    assert desk.send("FETC?") is None


# Readings


def test_reading_with_unit_time_and_status_looks_like_the_manual() -> None:
    desk = Desk(1.23456e-7).ready(";ELEM READ,UNIT,TIME,STAT")
    reading, time, status = desk.ask("READ?").split(",")
    assert reading.startswith("+1.234")
    assert reading.endswith("E-07A")
    assert float(time) == pytest.approx(desk.clock.now(), rel=1e-5)
    assert status == "+1.024000E+03"


@pytest.mark.parametrize(("elements", "fields"), [("READ", 1), ("STAT,READ", 2), ("READING,TIME,STATUS", 3), ("TIME", 1)])
def test_elements(desk: Desk, elements: str, fields: int) -> None:
    desk.ready(f";ELEM {elements}")
    assert len(desk.read()) == fields
    assert desk.ask("FETC?") == desk.ask("FETC?")
    if "READ" in elements:
        assert desk.read()[0] == pytest.approx(1e-7, rel=1e-4, abs=0)  # always first, in whatever order asked for


@pytest.mark.parametrize(("frequency", "cycles"), [(60.0, 1.0), (50.0, 1.0), (50.0, 0.1), (60.0, 60.0)])
def test_a_reading_takes_its_integration_time(frequency: float, cycles: float) -> None:
    desk = Desk(line_frequency=frequency).ready(f";:CURR:NPLC {cycles};RANG 2e-7")
    begin = desk.clock.now()
    desk.read()
    assert desk.windows == [(begin, pytest.approx(begin + cycles / frequency))]
    assert desk.clock.now() - begin == pytest.approx(cycles / frequency)


def test_time_stamps_wrap_and_can_be_reset(desk: Desk) -> None:
    desk.ready()
    desk.clock.set(100_050.0)
    assert desk.read()[1] == pytest.approx(50.01, abs=1.0)
    desk.send("SYST:TIME:RES")
    assert desk.read()[1] < 5.0


@pytest.mark.parametrize("current", [1e-12, 1.5e-9, 2.05e-9, 2.2e-9, 5e-8, 1e-6, 3e-5, 2e-3, 1.9e-2, -4e-7])
def test_auto_range_finds_the_decade(current: float) -> None:
    desk = Desk(current).ready()
    value, _, status = desk.read()
    fitting = next(full for full in RANGES if abs(current) <= 1.05 * full)
    assert float(desk.ask("CURR:RANG?")) == fitting
    assert value == pytest.approx(current, abs=5 * 5e-6 * fitting + fitting / 2e6)
    assert not int(status) & 1


def test_each_decade_costs_a_conversion_and_the_next_reading_none() -> None:
    desk = Desk(1e-6).ready(";:CURR:NPLC 1;RANG 2e-9;RANG:AUTO ON")
    desk.read()
    assert len(desk.windows) == 4  # 2 nA, 20 nA, 200 nA, 2 uA
    assert desk.windows[-1][1] - desk.windows[0][0] == pytest.approx(4 / 60)
    desk.windows.clear()
    desk.read()
    assert len(desk.windows) == 1


@pytest.mark.parametrize("upper", [2e-8, 2e-7])
def test_auto_range_keeps_its_upper_limit(upper: float) -> None:
    desk = Desk(1e-6).ready(f";:CURR:RANG:AUTO:ULIM {upper}")
    desk.send("CURR:RANG 2e-9;RANG:AUTO ON")
    assert desk.read()[0] == OVERFLOW
    assert float(desk.ask("CURR:RANG?")) == upper


@pytest.mark.parametrize(("current", "over"), [(2.09e-7, False), (2.11e-7, True), (-2.11e-7, True), (1.0, True)])
def test_overflow_on_a_fixed_range(current: float, over: bool) -> None:
    desk = Desk(current).ready(";:CURR:RANG 2e-7")
    value, _, status = desk.read()
    assert (value == OVERFLOW) == over
    assert bool(int(status) & 1) == over
    assert len(desk.windows) == 1


def test_zero_check_cuts_the_input_off(desk: Desk) -> None:
    desk.send("FORM:ELEM READ,TIME,STAT")
    value, _, status = desk.read()
    assert desk.windows == []
    assert int(status) == 1 << 9
    assert value == pytest.approx(3e-13, abs=1e-13)


def test_zero_correction_removes_the_offset() -> None:
    desk = Desk(0.0, offset=4e-13)
    desk.send("*RST;:SYST:ZCH OFF;:FORM:ELEM READ")
    raw = np.mean([desk.read()[0] for _ in range(20)])
    assert raw == pytest.approx(4e-13, abs=1e-14)
    desk.ready()
    corrected = np.mean([desk.read()[0] for _ in range(20)])
    assert abs(corrected) < 2e-14
    assert int(desk.read()[2]) == 1 << 10


@pytest.mark.parametrize("full", RANGES[:4])
def test_quantisation_and_noise_follow_the_range(full: float) -> None:
    desk = Desk(full / 2).ready(f";:CURR:RANG {full};NPLC 1;:TRIG:COUN 500;:FORM:ELEM READ")
    readings = np.array(desk.read())
    assert np.std(readings) == pytest.approx(5e-6 * full, rel=0.15, abs=0)
    zero = desk.meter._correction
    steps = (readings + zero) / (full / 2e6)
    # Replies have seven digits: half a unit of the last one is 0.5 of a step here at most.
    assert np.max(np.abs(steps - np.round(steps))) < 0.51
    desk.send("CURR:NPLC 25")
    assert np.std(desk.read()) == pytest.approx(1e-6 * full, rel=0.15, abs=0)


def test_coarse_steps_show_on_a_wide_range() -> None:
    desk = Desk(3.3e-9, offset=0.0).ready(";:CURR:RANG 2e-2;NPLC 60;:TRIG:COUN 50;:FORM:ELEM READ")
    readings = np.array(desk.read()) + desk.meter._correction
    assert np.max(np.abs(readings)) < 7e-8
    assert np.allclose(readings / 1e-8, np.round(readings / 1e-8), atol=1e-3)


def test_counts_multiply(desk: Desk) -> None:
    desk.ready(";:FORM:ELEM READ;:TRIG:COUN 3;:ARM:COUN 4")
    assert len(desk.read()) == 12
    assert len(desk.read("FETC?")) == 12
    assert len(desk.read("DATA?")) == 1
    assert len(desk.read("MEAS?")) == 1


def test_fetch_repeats_and_init_renews() -> None:
    desk = Desk(lambda t: 1e-8 * t).ready()
    first = desk.read()
    assert desk.read("FETC?") == first
    desk.send("INIT")
    assert desk.read("FETC?")[0] > first[0]


def test_repeating_filter_takes_all_its_conversions_and_moving_filter_one() -> None:
    desk = Desk(lambda t: 1e-8 + 1e-8 * t).ready(";:CURR:RANG 2e-6;NPLC 1;:AVER:COUN 10;TCON REP;STAT ON;:FORM:ELEM READ,STAT")
    value, status = desk.read()
    middle = (desk.windows[0][0] + desk.windows[-1][1]) / 2
    assert len(desk.windows) == 10
    assert value == pytest.approx(1e-8 + 1e-8 * middle, abs=5 * 1e-11 / math.sqrt(10))
    assert int(status) & 2
    desk.send("AVER:TCON MOV")
    desk.windows.clear()
    values = [desk.read()[0] for _ in range(12)]
    assert len(desk.windows) == 12
    middle = (desk.windows[-10][0] + desk.windows[-1][1]) / 2
    assert values[-1] == pytest.approx(1e-8 + 1e-8 * middle, abs=5 * 1e-11 / math.sqrt(10))


def test_start_sequence_of_the_sheet_command_by_command(desk: Desk) -> None:
    for message in (
        "*RST", "SYST:ZCH ON", "CURR:RANG 2e-9", "INIT", "SYST:ZCOR:ACQ", "SYST:ZCOR ON", "CURR:RANG:AUTO ON", "SYST:ZCH OFF",
    ):  # fmt: skip
        assert desk.send(message) is None
    reading = desk.ask("READ?").split(",")[0]
    assert float(reading.removesuffix("A")) == pytest.approx(1e-7, rel=1e-4, abs=0)
    assert desk.errors() == []


# Wire


def served(*pieces: bytes, current: float = 1e-7, terminator: str = "LF", advance: float = 100.0) -> list[bytes]:
    """Say these things with the clock standing still, then let time pass, and return what was heard."""

    async def scene() -> list[bytes]:
        clock, line = ManualClock(), Recorder()
        meter = Keithley6485(clock, lambda t0, t1: current, np.random.default_rng(0), MeterModel(terminator=terminator))
        task = asyncio.create_task(meter.serve(line))
        for piece in pieces:
            line.said.put_nowait(piece)
            await clock.advance(0.0)
        await clock.advance(advance)
        line.said.put_nowait(b"")
        await task
        return line.heard

    return asyncio.run(scene())


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n", b"\n\r"])
@pytest.mark.parametrize(("terminator", "sent"), [("LF", b"\n"), ("CR", b"\r"), ("CRLF", b"\r\n"), ("LFCR", b"\n\r")])
def test_terminators(end: bytes, terminator: str, sent: bytes) -> None:
    assert served(b"*OPC?" + end + b"*OP", b"C?" + end, terminator=terminator) == [b"1" + sent] * 2


@pytest.mark.parametrize("terminator", ["lf", "", "\n"])
def test_unknown_terminators_are_refused(terminator: str) -> None:
    with pytest.raises(SimError, match="terminator"):
        MeterModel(terminator=terminator)


@pytest.mark.parametrize("abort", [b"\x03", b"\x18"])
def test_control_characters_abort_what_is_pending(abort: bytes) -> None:
    heard = served(b"READ?\n", b"*OPC?\nCURR:NPLC 2\n", b"CURR:NP", abort + b"CURR:NPLC?\n")
    assert heard == [b"+2.000000E+00\n"]


def test_without_an_abort_everything_is_answered_in_order() -> None:
    heard = served(b"FORM:ELEM STAT\nREAD?\n", b"*OPC?\nCURR:NPLC 2;NPLC?\n")
    assert heard == [b"+5.120000E+02\n", b"1\n", b"+2.000000E+00\n"]


def test_nothing_is_read_out_before_its_time() -> None:
    assert served(b"READ?\n", advance=0.0999) == []
    assert len(served(b"CURR:RANG 2e-9\nREAD?\n", advance=0.1001)) == 1  # 6 cycles of 60 Hz


def test_an_overlong_message_is_an_input_overrun() -> None:
    heard = served(b"x" * 3000, b"\nSYST:ERR?\n")
    assert heard == [b'-363,"Input buffer overrun"\n']


# Whatever arrives

WORDS = st.sampled_from(
    ["*RST", "*CLS", "SYST", ":", "ZCH", "ZCOR", "ACQ", "CURR", "RANG", "AUTO", "NPLC", "?", ";", " ", "ON", "2e-9", "1e999", "-1",
     "READ", "FETC",
     "INIT", "MEAS", "FORM", "ELEM", "UNIT", ",", '"', "'", "AVER", "COUN", "*ESE 1e999", "SENS1", "MAX", "1" * 400, "\u00b2"]
)  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(st.one_of(st.binary(max_size=60), st.lists(WORDS, max_size=12).map(lambda words: "".join(words).encode("latin-1"))))
def test_no_bytes_can_upset_it(message: bytes) -> None:
    desk = Desk()
    asyncio.run(desk.meter.answer(message))
    desk.send("*CLS")
    assert desk.errors() == []
    assert desk.ready().read()[0] == pytest.approx(1e-7, rel=1e-4, abs=0)
