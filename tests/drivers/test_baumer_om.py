"""Baumer OM20 and OM30: registers and the distance of the sheet, frames byte by byte, and what goes wrong."""

from __future__ import annotations

import contextlib
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceFault, InvalidSetting, PortClosed, UnexpectedReply
from drivers.kinds import RangeFinder
from drivers.modbus import ModbusLink, ModbusRefusal
from drivers.rangefinders.baumer_om import BaumerOM, judge
from tests.drivers.rtu import Hurried, framed

MEASURE = "01 04 00 C8 00 0D"  # 200, 13 registers


def block(microseconds: int, *, quality: int = 0, outputs: int = 1, distance: str = "7C37 428B") -> bytes:
    """The thirteen registers; the distance as in the sheet, low word first: 0x428B7C37 is 69.7426 mm."""
    return framed(f"01 04 1A {quality:04X} {outputs:04X} {distance} 0000 43FA 000A 07D0 0000 0005 0000 {microseconds:04X} 0000")


def words(text: str, registers: int) -> bytes:
    """The answer with this text."""
    return framed(f"01 04 {2 * registers:02X} {text.encode().ljust(2 * registers, bytes(1)).hex()}")


ASK = framed(MEASURE)
WHO = [
    framed("01 04 00 00 00 10"), words("Baumer Electric AG", 16),
    framed("01 04 00 20 00 1A"), words("OM20-P0100", 26),
    framed("01 04 00 5F 00 0A"), words("700001234", 10),
    framed("01 04 00 6E 00 05"), words("1.2.3", 5),
]  # fmt: skip
LIMITS = [
    framed("01 03 00 C8 00 02"), framed("01 03 04 0000 4248"),  # 50.0
    framed("01 03 00 CA 00 02"), framed("01 03 04 0000 4316"),  # 150.0
]  # fmt: skip
NO_DROPOUT = [framed("01 06 03 20 00 00"), framed("01 06 03 20 00 00"), framed("01 03 03 20 00 01"), framed("01 03 02 00 00")]


@pytest.fixture
def link(make_peer: Any, script: Any) -> Any:
    """A Modbus link whose other end follows the dialogue given."""
    with contextlib.ExitStack() as links:

        def make(*lines: bytes, timeout_s: float = 20.0) -> ModbusLink:
            url = make_peer(*script.dialogue(*lines)).url
            return links.enter_context(ModbusLink.open(url, timeout_s=timeout_s, baudrate=57600))

        yield make


def test_opening_and_reading(link: Any) -> None:
    spot = BaumerOM.open(link(*WHO, *LIMITS, *NO_DROPOUT, ASK, block(1), ASK, block(2)), "range")
    assert isinstance(spot, RangeFinder)
    assert spot.limits_mm() == (50.0, 150.0)
    reading = spot.read()
    assert reading.good
    assert reading.distance_mm == pytest.approx(69.74261, abs=1e-5)
    assert reading.device_time_s == pytest.approx(5.000002)


def test_identity(link: Any) -> None:
    identity = BaumerOM(link(*WHO), "range").identify()
    assert (identity.vendor, identity.model, identity.serial_number, identity.firmware) == (
        "Baumer Electric AG", "OM20-P0100", "700001234", "1.2.3",
    )  # fmt: skip


def test_another_device_is_noticed(link: Any) -> None:
    with pytest.raises(UnexpectedReply, match=r"range on /dev/.*vendor 'Apogee'"):
        BaumerOM.open(link(WHO[0], words("Apogee", 16), *WHO[2:]), "range")


def test_an_old_measurement_is_not_told(link: Any) -> None:
    """Asked again until its timestamp is another."""
    later = block(9, distance="0000 4296")  # 75.0
    assert BaumerOM(link(*[ASK, block(8)] * 3, ASK, later), "range").read().distance_mm == 75.0


def test_no_new_measurement_is_a_fault(link: Any) -> None:
    with pytest.raises(DeviceFault, match=r"range on /dev/.*no new measurement within 1 s.*laser"):
        BaumerOM(link(*[ASK, block(8)] * 4), "range", clock=Hurried(250)).read()


@pytest.mark.parametrize("distance", ["0000 7FC0", "0001 7F80", "0000 FFC0"])
def test_nan_is_no_target(link: Any, distance: str) -> None:
    reading = BaumerOM(link(ASK, block(1), ASK, block(2, quality=2, outputs=2, distance=distance)), "range").read()
    assert (reading.distance_mm, reading.out_of_range, reading.good) == (math.inf, True, False)
    assert reading.flags == ("critical", "alarm", "no_target")


@pytest.mark.parametrize(
    ("quality", "outputs", "weak_is_good", "good"),
    [(0, 0, False, True), (0, 1, False, True), (1, 0, False, False), (1, 0, True, True), (2, 0, True, False), (0, 2, True, False)],
)
def test_only_what_the_sensor_vouches_for_is_good(quality: int, outputs: int, weak_is_good: bool, good: bool) -> None:
    reading = judge(quality, outputs, 70.0, 0.0, weak_is_good=weak_is_good)
    assert (reading.good, reading.distance_mm, reading.status) == (good, 70.0, quality)


@pytest.mark.parametrize(("quality", "distance"), [(3, "7C37 428B"), (65535, "7C37 428B"), (0, "0000 7F80"), (0, "428B 7C37")])
def test_registers_that_make_no_sense(link: Any, quality: int, distance: str) -> None:
    with pytest.raises(UnexpectedReply, match=r"range on /dev/.*measuring"):
        BaumerOM(link(ASK, block(1), ASK, block(2, quality=quality, distance=distance)), "range").read()


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF), st.integers(0, (1 << 32) - 1), st.booleans())
def test_any_registers_give_readings_or_named_errors(quality: int, outputs: int, bits: int, weak_is_good: bool) -> None:
    (distance_mm,) = struct.unpack(">f", struct.pack(">I", bits))
    try:
        reading = judge(quality % 5, outputs, distance_mm, 0.0, weak_is_good=weak_is_good)
    except UnexpectedReply:
        return
    assert abs(reading.distance_mm) < 1e4 or not reading.good


@pytest.mark.parametrize(("near", "far"), [("0000 4316", "0000 4248"), ("0000 7FC0", "0000 4316"), ("0000 4248", "0000 7F80")])
def test_a_range_that_makes_no_sense(link: Any, near: str, far: str) -> None:
    answers = [LIMITS[0], framed("01 03 04" + near), LIMITS[2], framed("01 03 04" + far)]
    with pytest.raises(UnexpectedReply, match="measuring range"):
        BaumerOM(link(*answers), "range").limits_mm()


def test_a_dropout_time_that_is_not_kept(link: Any) -> None:
    kept = [*NO_DROPOUT[:3], framed("01 03 02 00 64")]
    with pytest.raises(UnexpectedReply, match="dropout time of 100 ms"):
        BaumerOM.open(link(*WHO, *LIMITS, *kept), "range")


def test_a_refused_dropout_time_is_named_and_can_be_left_alone(link: Any) -> None:
    with pytest.raises(ModbusRefusal, match="dropout"):
        BaumerOM.open(link(*WHO, *LIMITS, NO_DROPOUT[0], framed("01 86 03")), "range")
    BaumerOM.open(link(*WHO, *LIMITS), "range", dropout_ms=None)


@pytest.mark.parametrize("options", [{"dropout_ms": -1}, {"dropout_ms": 70000}, {"fresh_s": 0.0}, {"fresh_s": math.inf}, {"address": 300}])
def test_impossible_options_are_refused_before_anything_is_sent(link: Any, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match="range"):
        BaumerOM.open(link(), "range", **options)


def test_closed(link: Any) -> None:
    spot = BaumerOM(link(), "range")
    spot.close()
    with pytest.raises(PortClosed, match="range"):
        spot.read()
