"""Keithley 6485: readings from the sheet, the start sequence byte for byte, and what goes wrong on the way."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceFault, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.kinds import Identity, LightSensor
from drivers.sensors.keithley6485 import Keithley6485, StatusBits, parse_identity, parse_reading

SHORT_S = 0.1
IDN = b"KEITHLEY INSTRUMENTS INC.,MODEL 6485,4038279,C01   Jun 23 2010 12:22:00/A02  /H\r"
NO_ERROR = b'0,"No error"\r'
ZERO_CORRECTION = (
    b"*RST",
    b"FORM:ELEM READ,UNIT,TIME,STAT",
    b"SYST:ZCH ON",
    b"CURR:RANG 2e-9",
    b"INIT",
    b"SYST:ZCOR:ACQ",
    b"SYST:ZCOR ON",
    b"CURR:RANG:AUTO ON",
    b"SYST:ZCH OFF",
)


def commands(*texts: bytes) -> list[bytes]:
    """Commands that the meter takes, each checked in its error queue."""
    return [line for text in texts for line in (text + b"\rSYST:ERR?\r", NO_ERROR)]


OPENING = [b"*IDN?\r", IDN, b"SYST:ERR?\r", NO_ERROR, *commands(*ZERO_CORRECTION)]
SYNCHRONISED = [b"*IDN?\r", IDN]


@pytest.fixture
def meter(plug: Any, script: Any) -> Any:
    """A meter whose other end follows the dialogue given; nothing is sent to set it up."""

    def make(*lines: bytes, timeout_s: float = 20.0, **options: Any) -> Keithley6485:
        return Keithley6485(plug(*script.dialogue(*lines), terminator=b"\r", timeout_s=timeout_s), "diode", **options)

    return make


# readings -------------------------------------------------------------------------------------------------------------


def test_reading_of_the_sheet() -> None:
    reading = parse_reading(b"+1.040564E-06A,+2.236299E+02,+1.380000E+02")
    assert (reading.value, reading.unit, reading.device_time_s, reading.status) == (1.040564e-6, "A", 223.6299, 138)
    assert reading.good
    assert reading.flags == ("filter", "null", "over_voltage")  # 138 = 2 + 8 + 128


def as_told(value: float) -> float:
    """The nearest number of the meter's; its exponents have two digits."""
    return float(f"{value if abs(value) > 1e-15 else 0.0:.6E}")


@given(st.floats(-0.021, 0.021).map(as_told), st.floats(0, 99999).map(as_told))
def test_readings_round_trip(value: float, time_s: float) -> None:
    reading = parse_reading(f"{value:+.6E}A,{time_s:+.6E},+1.024000E+03".encode())
    assert (reading.value, reading.device_time_s, reading.flags) == (value, time_s, ("zero_correct",))


@pytest.mark.parametrize("text", [b"+9.9E37A", b"+9.900000E+37A"])
def test_overflow_is_never_a_good_value(text: bytes) -> None:
    reading = parse_reading(text + b",+1.000000E+00,+0.000000E+00")
    assert reading.over_range
    assert not reading.good
    assert reading.value == math.inf


def test_negative_overflow() -> None:
    assert parse_reading(b"-9.9E37A,+1.000000E+00,+1.000000E+00").value == -math.inf


def test_overflow_told_by_the_status_alone() -> None:
    reading = parse_reading(b"+2.100000E-09A,+1.000000E+00,+1.000000E+00")
    assert reading.over_range
    assert reading.value == math.inf


def test_not_a_number_is_a_fault() -> None:
    with pytest.raises(DeviceFault, match="not-a-number"):
        parse_reading(b"+9.91E37A,+1.000000E+00,+0.000000E+00")


def test_zero_check_is_a_fault() -> None:
    with pytest.raises(DeviceFault, match="zero check"):
        parse_reading(b"+1.000000E-12A,+1.000000E+00,+5.120000E+02")


def test_unverified_status_bits_can_be_changed() -> None:
    bits = StatusBits(overflow=-1, zero_check=3)
    assert parse_reading(b"+1.000000E-12A,+1.000000E+00,+5.130000E+02", bits).good
    with pytest.raises(DeviceFault, match="zero check"):
        parse_reading(b"+1.000000E-12A,+1.000000E+00,+8.000000E+00", bits)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"+1.040564E-06A",
        b"+1.040564E-06A,+2.236299E+02",
        b"+1.040564E-06,+2.236299E+02,+0.000000E+00",  # no unit
        b"+1.040564E-06V,+2.236299E+02,+0.000000E+00",
        b"+1.040564E-06OHM,+2.236299E+02,+0.000000E+00",
        b"+1.040564E+06A,+2.236299E+02,+0.000000E+00",  # a million amperes
        b"+1.040564E-06A,+2.236299E+02,+1.500000E+00",
        b"+1.040564E-06A,+2.236299E+02,-1.000000E+00",
        b"+1.040564E-06A,-2.236299E+02,+0.000000E+00",
        b"+1.040564E-06A,+2.236299E+02,+0.000000E+00,+1.000000E+00",
        b"+1.0405\xff4E-06A,+2.236299E+02,+0.000000E+00",
        b'0,"No error"',
        b"nanA,+2.236299E+02,+0.000000E+00",
    ],
)
def test_what_is_not_a_reading(line: bytes) -> None:
    with pytest.raises(UnexpectedReply) as caught:
        parse_reading(line)
    assert caught.value.raw == line


def test_identity_of_the_sheet() -> None:
    assert parse_identity(IDN) == Identity("KEITHLEY INSTRUMENTS INC.", "6485", "4038279", "C01   Jun 23 2010 12:22:00/A02  /H")


def test_another_instrument_is_noticed() -> None:
    with pytest.raises(UnexpectedReply, match="another instrument"):
        parse_identity(b"KEITHLEY INSTRUMENTS INC.,MODEL 2400,1,C30")


# the meter ------------------------------------------------------------------------------------------------------------


def test_start_sequence(plug: Any, script: Any) -> None:
    reading = [b"READ?\r", b"+1.040564E-06A,+2.236299E+02,+1.024000E+03\r"]
    configured = commands(b"SENS:CURR:NPLC 5.00", b"CURR:RANG:AUTO ON")
    link = plug(*script.dialogue(*OPENING, *configured, *reading), terminator=b"\r")
    meter = Keithley6485.open(link, "diode")
    assert isinstance(meter, LightSensor)
    assert (meter.name, meter.unit, meter.integration_s, meter.range_a) == ("diode", "A", 0.1, None)
    assert meter.read().value == 1.040564e-6


def test_start_sequence_with_options(plug: Any, script: Any) -> None:
    configured = commands(b"SENS:CURR:NPLC 60.00", b"CURR:RANG:AUTO OFF", b"CURR:RANG 2e-06")
    link = plug(*script.dialogue(*OPENING, *configured), terminator=b"\r")
    meter = Keithley6485.open(link, "diode", integration_s=1.0, range=1e-6, line_frequency_hz=60)
    assert (meter.integration_s, meter.range_a) == (1.0, 2e-6)


@pytest.mark.parametrize("terminator", [b"\n", b"\r\n", b"\n\r"])
def test_other_terminators_are_used_both_ways(plug: Any, script: Any, terminator: bytes) -> None:
    lines = [line.replace(b"\r", terminator) for line in SYNCHRONISED]
    meter = Keithley6485(plug(*script.dialogue(*lines), terminator=terminator), "diode")
    assert meter.identify().model == "6485"


def test_errors_of_earlier_users_are_dropped(plug: Any, script: Any) -> None:
    left = [b"SYST:ERR?\r", b'-113,"Undefined header"\r']
    configured = commands(b"SENS:CURR:NPLC 5.00", b"CURR:RANG:AUTO ON")
    link = plug(*script.dialogue(*SYNCHRONISED, *left, *left, *OPENING[2:], *configured), terminator=b"\r")
    Keithley6485.open(link, "diode")


def test_a_refused_command_is_named(plug: Any, script: Any) -> None:
    begun = [*OPENING[:-2], OPENING[-2], b'-222,"Parameter data out of range"\r']
    link = plug(*script.dialogue(*begun), terminator=b"\r")
    with pytest.raises(DeviceFault, match=r"diode on /dev/.*sending SYST:ZCH OFF: error -222, Parameter data out of range"):
        Keithley6485.open(link, "diode")


@pytest.mark.parametrize(
    ("integration_s", "hz", "text", "true_s"),
    [
        (0.02, 50, b"1.00", 0.02),
        (1 / 60, 60, b"1.00", 1 / 60),
        (0.01004, 50, b"0.50", 0.01),
        (0.0002, 50, b"0.01", 0.0002),
        (1.0, 50, b"50.00", 1.0),
    ],
)
def test_integration_time(meter: Any, integration_s: float, hz: int, text: bytes, true_s: float) -> None:
    diode = meter(*SYNCHRONISED, *commands(b"SENS:CURR:NPLC " + text, b"CURR:RANG:AUTO ON"), line_frequency_hz=hz)
    diode.configure(integration_s)
    assert diode.integration_s == pytest.approx(true_s)


@pytest.mark.parametrize(
    ("current", "text", "full_scale"),
    [(2e-9, b"2e-09", 2e-9), (2.1e-9, b"2e-08", 2e-8), (0.000002, b"2e-06", 2e-6), (0.02, b"2e-02", 0.02)],
)
def test_ranges(meter: Any, current: float, text: bytes, full_scale: float) -> None:
    diode = meter(*SYNCHRONISED, *commands(b"SENS:CURR:NPLC 5.00", b"CURR:RANG:AUTO OFF", b"CURR:RANG " + text))
    diode.configure(0.1, range=current)
    assert diode.range_a == full_scale


@pytest.mark.parametrize("integration_s", [0.0, -0.1, 1.1, 1e-5, math.nan, math.inf])
def test_impossible_integration_times_are_not_sent(meter: Any, integration_s: float) -> None:
    with pytest.raises(InvalidSetting, match="diode"):
        meter().configure(integration_s)


@pytest.mark.parametrize("current", [0.0, -1e-6, 0.021, math.nan, math.inf])
def test_impossible_ranges_are_not_sent(meter: Any, current: float) -> None:
    with pytest.raises(InvalidSetting, match="diode"):
        meter().configure(0.1, range=current)


def test_impossible_options_are_refused_before_anything_is_sent(plug: Any) -> None:
    with pytest.raises(InvalidSetting):
        Keithley6485.open(plug(terminator=b"\r"), "diode", integration_s=5.0)
    with pytest.raises(InvalidSetting, match="50 or 60"):
        Keithley6485.open(plug(terminator=b"\r"), "diode", line_frequency_hz=55)


def test_the_reply_may_take_as_long_as_the_integration(plug: Any) -> None:
    """Allowed: the link's time, and a reading on each of the eight ranges while the meter chooses."""
    meter = Keithley6485(plug(terminator=b"\r", timeout_s=0.5), "diode")
    meter._integration_s = 1.0
    assert meter._allowance_s() == pytest.approx(0.5 + 8 * 3)
    meter._range_a = 2e-6
    assert meter._allowance_s() == pytest.approx(0.5 + 3)


# trouble on the line --------------------------------------------------------------------------------------------------


def quick(meter: Keithley6485) -> Keithley6485:
    """Shorten the time allowed, for replies that never come."""
    meter._range_a, meter._integration_s = 2e-6, 0.001
    return meter


def test_a_late_reading_never_answers_the_next_question(plug: Any, script: Any) -> None:
    """The first reading comes after its time, when the meter is asked for its name; it is dropped, and a fresh one taken."""
    late, fresh = b"+1.000000E-06A,+1.000000E+00,+0.000000E+00\r", b"+2.000000E-06A,+2.000000E+00,+0.000000E+00\r"
    link = plug(
        *script.dialogue(*SYNCHRONISED),
        script.expect(b"READ?\r"),
        script.expect(b"*IDN?\r"),
        script.send(late + IDN),
        *script.dialogue(b"READ?\r", fresh),
        terminator=b"\r",
        timeout_s=SHORT_S,
    )
    assert quick(Keithley6485(link, "diode")).read().value == 2e-6


def test_a_garbled_reading_is_taken_once_more(meter: Any) -> None:
    fresh = b"+2.000000E-06A,+2.000000E+00,+0.000000E+00\r"
    diode = meter(*SYNCHRONISED, b"READ?\r", b"+1.0#0E-06A,+1.000000E+00\r", *SYNCHRONISED, b"READ?\r", fresh)
    assert diode.read().value == 2e-6


def test_a_reading_that_stays_garbled(meter: Any) -> None:
    garbled = [b"READ?\r", b"+1.0#0E-06A,+1.000000E+00\r"]
    with pytest.raises(UnexpectedReply, match=r"diode on /dev/.*taking a reading"):
        meter(*SYNCHRONISED, *garbled, *SYNCHRONISED, *garbled).read()


def test_a_fault_is_not_asked_again(meter: Any) -> None:
    with pytest.raises(DeviceFault, match="not-a-number"):
        meter(*SYNCHRONISED, b"READ?\r", b"+9.91E37A,+1.000000E+00,+0.000000E+00\r").read()


def test_a_cut_reading_is_never_returned(plug: Any, script: Any) -> None:
    """Cut after the second element's first digits: without the terminator it is no reading, however plausible."""
    cut = [script.expect(b"READ?\r"), script.send(b"+1.000000E-06A,+1.000000E+00,+0")]
    link = plug(
        *script.dialogue(*SYNCHRONISED), *cut, script.expect(b"*IDN?\r"), script.expect(b"*IDN?\r"), terminator=b"\r", timeout_s=SHORT_S
    )
    with pytest.raises(TransportTimeout):
        quick(Keithley6485(link, "diode")).read()


def test_no_meter(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"*IDN?\r"), script.expect(b"*IDN?\r"), terminator=b"\r", timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match="diode on /dev/"):
        quick(Keithley6485(link, "diode")).read()


def test_unplugged(plug: Any, script: Any) -> None:
    link = plug(*script.dialogue(*SYNCHRONISED), script.expect(b"READ?\r"), script.unplug(), terminator=b"\r")
    with pytest.raises(PortClosed, match="diode on /dev/"):
        Keithley6485(link, "diode").read()


def test_closed(meter: Any) -> None:
    diode = meter()
    diode.close()
    with pytest.raises(PortClosed, match="diode"):
        diode.read()
