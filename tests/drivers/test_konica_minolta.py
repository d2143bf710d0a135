"""Konica Minolta luminance meters: replies from the sheet, the settings byte for byte, and what goes wrong on the way."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.errors import DeviceFault, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.kinds import LightReading, LightSensor
from drivers.sensors.konica_minolta import REFUSALS, LuminanceMeter, parse_reading

SHORT_S = 0.1
SYNCHRONISED = [b"MDS,04\r\n", b"OK00\r\n"]
OPENING = [*SYNCHRONISED, b"MDS,00\r\n", b"OK00\r\n", b"MDS,09\r\n", b"OK00\r\n", b"MDS,07\r\n", b"OK00\r\n"]
READING = [b"MES\r\n", b"OK00,   123.4\r\n"]


@pytest.fixture
def meter(plug: Any, script: Any) -> Any:
    """A meter whose other end follows the dialogue given; nothing is sent to set it up."""

    def make(*lines: bytes, timeout_s: float = 20.0, **options: Any) -> LuminanceMeter:
        return LuminanceMeter(plug(*script.dialogue(*lines), timeout_s=timeout_s), "spot", measuring_s=0.0, **{"agreement": 0.0, **options})

    return make


# readings -------------------------------------------------------------------------------------------------------------


def test_readings_of_the_sheet() -> None:
    assert parse_reading(b"OK00,   123.4", "LS-100") == LightReading(123.4, "cd/m^2", 0, over_range=False)
    assert parse_reading(b"OK00,  123.4,.3100,.3300", "CS-100A") == LightReading(123.4, "cd/m^2", 0, over_range=False)


@pytest.mark.parametrize(
    ("line", "flag", "status"),
    [
        (b"OK12,,,", "luminance_over", 12),
        (b"OK12", "luminance_over", 12),
        (b"OK12,  123.4,.3100,.3300", "luminance_over", 12),
        (b"ER10", "range_over", 110),
        (b"ER19", "display_over", 119),
        (b"OK11,  123.4,.3100,.3300", "chroma_over", 11),
        (b"OK11", "chroma_over", 11),
    ],
)
def test_over_range_is_never_a_good_value(line: bytes, flag: str, status: int) -> None:
    reading = parse_reading(line, "CS-100A")
    assert (reading.value, reading.over_range, reading.good, reading.flags, reading.status) == (math.inf, True, False, (flag,), status)


@pytest.mark.parametrize(("line", "value"), [(b"OK13,  0.005,,", 0.005), (b"OK13,,,", 0.0), (b"OK13", 0.0)])
def test_under_range_is_never_a_good_value(line: bytes, value: float) -> None:
    reading = parse_reading(line, "CS-100A")
    assert (reading.value, reading.under_range, reading.good) == (value, True, False)


def test_the_luminance_beside_a_bad_chromaticity_can_be_accepted() -> None:
    reading = parse_reading(b"OK11,  123.4,,", "CS-100A", chroma_over_is_good=True)
    assert (reading.value, reading.good, reading.status, reading.flags) == (123.4, True, 11, ("chroma_over",))


@pytest.mark.parametrize("code", ["ER00", "ER01", "ER11", "ER12", "ER20", "ER30", "ER77"])
def test_error_codes(code: str) -> None:
    with pytest.raises(DeviceFault, match=REFUSALS.get(code, "unknown code")):
        parse_reading(code.encode(), "LS-100")


@pytest.mark.parametrize(
    ("line", "model"),
    [
        (b"", "LS-100"),
        (b"OK00", "LS-100"),
        (b"OK00,", "LS-100"),
        (b"OK00,   12", "CS-100A"),
        (b"OK00,  123.4,.3100,.3300", "LS-100"),
        (b"OK00,  123.4,.3100", "CS-100A"),
        (b"OK00,  123.4,1.310,.3300", "CS-100A"),
        (b"OK00,  123.4,,.3300", "CS-100A"),
        (b"OK00,  -23.4", "LS-100"),
        (b"OK00,   1e3", "LS-100"),
        (b"OK00,   nan", "LS-100"),
        (b"OK00,   1.2.3", "LS-100"),
        (b"OK00,99999999", "LS-100"),
        (b"OK14,   123.4", "LS-100"),
        (b"OK0,   123.4", "LS-100"),
        (b"XOK00,   123.4", "LS-100"),
        (b"OK00,   12\xb3.4", "LS-100"),
    ],
)
def test_what_is_not_a_reading(line: bytes, model: Any) -> None:
    with pytest.raises(UnexpectedReply) as caught:
        parse_reading(line, model)
    assert caught.value.raw == line


# the meter ------------------------------------------------------------------------------------------------------------


def test_opening(plug: Any, script: Any) -> None:
    sensor = LuminanceMeter.open(plug(*script.dialogue(*OPENING, *READING)), "spot", serial_number="70001234", agreement=0.0)
    assert isinstance(sensor, LightSensor)
    assert (sensor.name, sensor.unit, sensor.integration_s) == ("spot", "cd/m^2", 0.4)
    assert sensor.read().value == 123.4


def test_opening_with_options(plug: Any, script: Any) -> None:
    opening = [line.replace(b"MDS,00", b"MDS,01").replace(b"MDS,07", b"MDS,06") for line in OPENING]
    colour = [b"MES\r\n", b"OK00,  123.4,.3100,.3300\r\n"]
    link = plug(*script.dialogue(*opening, *colour))
    sensor = LuminanceMeter.open(link, "spot", model="CS-100A", calibration="varied", integration_s=0.05, agreement=0.0)
    assert sensor.integration_s == 0.1
    assert sensor.read().value == 123.4


def test_identity_is_what_it_was_told(meter: Any) -> None:
    identity = meter(*SYNCHRONISED, serial_number="70001234", model="LS-110").identify()
    assert (identity.vendor, identity.model, identity.serial_number) == ("Konica Minolta", "LS-110", "70001234")


def test_a_refused_setting_is_named(meter: Any) -> None:
    with pytest.raises(DeviceFault, match=r"spot on /dev/.*setting mode 06: ER01, setting error"):
        meter(*SYNCHRONISED, b"MDS,06\r\n", b"ER01\r\n").configure(0.1)


@pytest.mark.parametrize("integration_s", [0.0, -1.0, 0.41, math.nan, math.inf])
def test_impossible_integration_times_are_not_sent(meter: Any, integration_s: float) -> None:
    with pytest.raises(InvalidSetting, match="spot"):
        meter().configure(integration_s)


def test_impossible_options_are_refused_before_anything_is_sent(meter: Any, plug: Any) -> None:
    with pytest.raises(InvalidSetting, match="range"):
        meter().configure(0.1, range=100.0)
    for options in ({"model": "LS-150"}, {"calibration": "none"}, {"integration_s": 9.0}, {"fast_s": 1.0}, {"measuring_s": math.nan}):
        with pytest.raises(InvalidSetting):
            LuminanceMeter.open(plug(), "spot", **options)


# trouble on the line --------------------------------------------------------------------------------------------------


def test_a_late_reading_never_answers_the_next_question(plug: Any, script: Any) -> None:
    """The first reading comes when the meter is being found again; it is dropped, and a fresh one taken."""
    link = plug(
        *script.dialogue(*SYNCHRONISED),
        script.expect(b"MES\r\n"),
        script.expect(b"MDS,04\r\n"),
        script.send(b"OK00,   1.000\r\nOK00\r\n"),
        *script.dialogue(b"MES\r\n", b"OK00,   2.000\r\n"),
        timeout_s=SHORT_S,
    )
    assert LuminanceMeter(link, "spot", measuring_s=0.0, agreement=0.0).read().value == 2.0


@pytest.mark.parametrize("late", [b"ER10\r\n", b"OK12\r\n", b"OK13,,,\r\n"])
def test_a_late_report_of_the_range_answers_no_setting(plug: Any, script: Any, late: bytes) -> None:
    link = plug(
        *script.dialogue(*SYNCHRONISED),
        script.expect(b"MES\r\n"),
        script.expect(b"MDS,04\r\n"),
        script.send(late + b"OK00\r\n"),
        *script.dialogue(*READING),
        timeout_s=SHORT_S,
    )
    assert LuminanceMeter(link, "spot", measuring_s=0.0, agreement=0.0).read().value == 123.4


def test_a_late_answer_to_a_setting_is_no_reading(meter: Any) -> None:
    assert meter(*SYNCHRONISED, b"MES\r\n", b"OK00\r\nOK00,   3.000\r\n").read().value == 3.0


def test_a_garbled_reading_is_taken_once_more(meter: Any) -> None:
    assert meter(*SYNCHRONISED, b"MES\r\n", b"OK00,   1#3.4\r\n", *SYNCHRONISED, *READING).read().value == 123.4


def test_a_reading_that_stays_garbled(meter: Any) -> None:
    garbled = [b"MES\r\n", b"OK00,   1#3.4\r\n"]
    with pytest.raises(UnexpectedReply, match=r"spot on /dev/.*measuring"):
        meter(*SYNCHRONISED, *garbled, *SYNCHRONISED, *garbled).read()


def test_a_fault_is_not_asked_again(meter: Any) -> None:
    with pytest.raises(DeviceFault, match="battery exhausted"):
        meter(*SYNCHRONISED, b"MES\r\n", b"ER30\r\n").read()


def test_a_silent_meter_and_its_remote_mode(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"MDS,04\r\n"), script.expect(b"MDS,04\r\n"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match=r"spot on /dev/.*F key"):
        LuminanceMeter.open(link, "spot", measuring_s=0.0)


def test_unplugged(plug: Any, script: Any) -> None:
    link = plug(*script.dialogue(*SYNCHRONISED), script.expect(b"MES\r\n"), script.unplug())
    with pytest.raises(PortClosed, match="spot on /dev/"):
        LuminanceMeter(link, "spot").read()


def test_closed(meter: Any) -> None:
    sensor = meter()
    sensor.close()
    with pytest.raises(PortClosed, match="spot"):
        sensor.read()


def test_a_reading_counts_once_the_next_one_agrees(meter: Any) -> None:
    """The first is a late answer from where the light was another."""
    late, now = (b"MES\r\n", b"OK00,    33.1\r\n"), (b"MES\r\n", b"OK00,    26.5\r\n")
    assert meter(*SYNCHRONISED, *late, *now, *now, agreement=0.05).read().value == 26.5


def test_readings_that_never_agree_are_no_reading(meter: Any) -> None:
    lines = [line for value in (b"10.0", b"20.0", b"30.0", b"40.0") for line in (b"MES\r\n", b"OK00,    " + value + b"\r\n")]
    with pytest.raises(UnexpectedReply, match=r"spot on .*measuring: readings 10, 20, 30, 40 .*is the light steady"):
        meter(*SYNCHRONISED, *lines, agreement=0.05).read()


@pytest.mark.parametrize("line", [b"OK00,   12.4", b"OK00,   123.44", b"OK00,  123.4"])
def test_a_lost_or_doubled_digit_shows_in_the_width(line: bytes) -> None:
    with pytest.raises(UnexpectedReply, match="another width"):
        parse_reading(line, "LS-100")
    assert parse_reading(line, "LS-100", fixed_width=False).good


@pytest.mark.parametrize("share", [-0.1, 1.0, math.nan])
def test_an_agreement_is_a_share(plug: Any, share: float) -> None:
    with pytest.raises(InvalidSetting, match="agreement"):
        LuminanceMeter(plug(), "spot", agreement=share)
