"""Apogee SQ-422X: registers of the sheet, frames byte by byte, and what goes wrong."""

from __future__ import annotations

import contextlib
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import BadChecksum, DeviceFault, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.kinds import LightSensor
from drivers.modbus import ModbusLink, ModbusRefusal
from drivers.sensors.apogee import SQ422X, judge
from tests.drivers.rtu import Hurried, framed

SHORT_S = 0.2
READ_OUTPUT = bytes.fromhex("01 03 00 00 00 02 C4 0B")  # from the sheet


def floats(*values: float) -> bytes:
    """The answer with these numbers, high word first."""
    data = struct.pack(f">{len(values)}f", *values)
    return framed(bytes((1, 3, len(data))).hex() + data.hex())


STATUS = framed("01 03 00 0A 00 02")
READY, BUSY = framed("01 03 04 00 00 00 00"), framed("01 03 04 3F 80 00 00")
WHO = [framed("01 03 00 10 00 06"), floats(1, 422, 1234), framed("01 03 00 0C 00 02"), floats(1.5)]
FLUX = framed("01 03 04 44 9A 52 2B")  # 1234.5677 by hand: 0x449A522B


@pytest.fixture
def sensor(make_peer: Any, script: Any) -> Any:
    """A sensor whose other end follows the dialogue given; nothing is sent to set it up."""
    with contextlib.ExitStack() as links:

        def make(*lines: bytes, timeout_s: float = 20.0, steps: Any = None, **options: Any) -> SQ422X:
            url = make_peer(*(script.dialogue(*lines) if steps is None else steps)).url
            link = links.enter_context(ModbusLink.open(url, timeout_s=timeout_s, baudrate=19200))
            return SQ422X(link, "lamp", **{"agreement": 0.0, **options})

        yield make


def test_a_reading(sensor: Any) -> None:
    lamp = sensor(STATUS, READY, READ_OUTPUT, FLUX)
    assert isinstance(lamp, LightSensor)
    reading = lamp.read()
    assert reading.value == pytest.approx(1234.5677, rel=1e-7)
    assert (reading.unit, reading.good, lamp.unit, lamp.name) == ("umol/(m^2 s)", True, "umol/(m^2 s)", "lamp")


def test_a_reading_counts_once_the_next_one_agrees(sensor: Any) -> None:
    """The first answer is that of another register, late: nothing in it says so."""
    ask = (STATUS, READY, READ_OUTPUT)
    assert sensor(*ask, floats(1.0), *ask, FLUX, *ask, FLUX, agreement=0.05).read().value == pytest.approx(1234.5677, rel=1e-7)


def test_identity(sensor: Any) -> None:
    identity = sensor(*WHO).identify()
    assert (identity.vendor, identity.model, identity.serial_number, identity.firmware) == ("Apogee", "SQ-422", "1234", "1.5")


def test_opening_finds_out_the_order_of_the_words(make_peer: Any, script: Any) -> None:
    swapped = framed("01 03 0C 00 00 3F 80 00 00 43 D3 40 00 44 9A")
    with (
        ModbusLink.open(make_peer(*script.dialogue(WHO[0], swapped, *WHO[2:])).url, timeout_s=20.0) as link,
        pytest.raises(UnexpectedReply, match=r"lamp on /dev/.*expected address 1"),
    ):
        SQ422X.open(link, "lamp")


@pytest.mark.parametrize("numbers", [(7, 422, 1234), (1, 422.5, 1234), (1, 422, -1), (1, math.nan, 1234)])
def test_another_device_is_noticed(sensor: Any, numbers: tuple[float, ...]) -> None:
    with pytest.raises(UnexpectedReply, match="lamp"):
        sensor(WHO[0], floats(*numbers), *WHO[2:]).identify()


def test_it_waits_while_the_sensor_is_busy(sensor: Any) -> None:
    assert sensor(STATUS, BUSY, STATUS, BUSY, STATUS, READY, READ_OUTPUT, FLUX).read().good


def test_it_does_not_wait_for_ever(sensor: Any) -> None:
    lamp = sensor(*[STATUS, BUSY] * 3, busy_s=0.4, clock=Hurried(10))
    with pytest.raises(DeviceFault, match=r"lamp on /dev/.*busy for 0.4 s"):
        lamp.read()


@pytest.mark.parametrize("status", [2.0, -1.0, math.nan, 0.5])
def test_an_unknown_status_is_a_fault(sensor: Any, status: float) -> None:
    with pytest.raises(DeviceFault, match="status"):
        sensor(STATUS, floats(status)).read()


@pytest.mark.parametrize("flux", [4000.0, 39_000.0])
def test_over_range_is_never_a_good_value(flux: float) -> None:
    reading = judge(flux, 4000.0)
    assert (reading.value, reading.over_range, reading.good) == (math.inf, True, False)


@pytest.mark.parametrize(
    ("flux", "error"), [(math.nan, DeviceFault), (math.inf, DeviceFault), (1e9, UnexpectedReply), (-1e9, UnexpectedReply)]
)
def test_what_is_no_flux(sensor: Any, flux: float, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"lamp on /dev/.*reading the photon flux"):
        sensor(STATUS, READY, READ_OUTPUT, floats(flux)).read()


@given(st.integers(0, (1 << 32) - 1).map(lambda bits: struct.unpack(">f", struct.pack(">I", bits))[0]))
def test_any_bits_give_readings_or_named_errors(flux: float) -> None:
    try:
        reading = judge(flux, 4000.0)
    except (UnexpectedReply, DeviceFault):
        return
    assert abs(reading.value) < 40_000 or not reading.good


@pytest.mark.parametrize("integration_s", [0.0, -1.0, 1.1, math.nan, math.inf])
def test_impossible_integration_times(sensor: Any, integration_s: float) -> None:
    with pytest.raises(InvalidSetting, match="lamp"):
        sensor().configure(integration_s)


def test_impossible_options(sensor: Any) -> None:
    sensor().configure(0.5)
    with pytest.raises(InvalidSetting):
        sensor().configure(0.5, range=1.0)
    for options in ({"full_scale": 0.0}, {"response_s": math.inf}, {"busy_s": -1.0}, {"address": 0}):
        with pytest.raises(InvalidSetting):
            sensor(**options)


def test_a_refusal_is_named(sensor: Any) -> None:
    with pytest.raises(ModbusRefusal, match="lamp"):
        sensor(STATUS, framed("01 83 02")).read()


def test_a_wrong_checksum_is_asked_for_once_more(sensor: Any) -> None:
    broken = FLUX[:-1] + bytes((FLUX[-1] ^ 1,))
    assert sensor(STATUS, READY, READ_OUTPUT, broken, READ_OUTPUT, FLUX, timeout_s=SHORT_S).read().good
    with pytest.raises((BadChecksum, TransportTimeout)):
        sensor(STATUS, READY, READ_OUTPUT, broken, READ_OUTPUT, broken, timeout_s=SHORT_S).read()


def test_closed(sensor: Any) -> None:
    lamp = sensor()
    lamp.close()
    with pytest.raises(PortClosed, match="lamp"):
        lamp.read()
