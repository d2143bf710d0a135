"""The optoNCDT 1420: values and formula of the sheet, the stream cut and mixed in every way, and what goes wrong."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceError, DeviceFault, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.kinds import RangeFinder
from drivers.link import Link
from drivers.rangefinders.optoncdt1420 import (
    OptoNCDT1420,
    StreamLink,
    Value,
    ValueSplitter,
    distance_mm,
    parse_info,
    parse_value,
)
from tests.drivers.rtu import Canned

SHORT_S = 0.1
INFO = (
    b"GETINFO\r\nName:             ILD1420-50\r\nSerial:           15120012\r\nOption:           000\r\nArticle:          4120245\r\n"
    b"Cable head:       Wire\r\nMeasuring range:  50.00mm\r\nVersion:          001.018\r\nHardware-rev:     00\r\n"
    b"Boot-version:     001.007\r\n->"
)
OPENING = [b"OUTPUT NONE\r\n", b"OUTPUT NONE\r\n->", b"GETINFO\r\n", INFO, b"MEASRATE 1\r\n", b"MEASRATE 1.0\r\n->"]
START, STARTED = b"OUTPUT RS422\r\n", b"OUTPUT RS422\r\n->"
STOP, STOPPED = b"OUTPUT NONE\r\n", b"OUTPUT NONE\r\n->"
MIDDLE = b"\x38\x7f\x87"  # 000111 111111 111000 = 32760, the middle of 65520, by hand


def value(word: int, *, first: bool = True) -> bytes:
    """Three bytes as the sheet lays them out."""
    bits = f"{word:018b}"
    return bytes(int(tag + part, 2) for tag, part in (("00", bits[12:]), ("01", bits[6:12]), ("10" if first else "11", bits[:6])))


@pytest.fixture
def plug_stream(make_peer: Any, script: Any) -> Any:
    """A link that takes values apart, to a peer with this script."""
    links: list[Link] = []

    def plug(*steps: Any, timeout_s: float = 20.0) -> Link:
        links.append(StreamLink.open(make_peer(*steps).url, device="bench", timeout_s=timeout_s))
        return links[-1]

    yield plug
    for link in links:
        link.close()


@pytest.fixture
def sensor(plug_stream: Any, script: Any) -> Any:
    """A sensor of 50 mm whose other end follows the dialogue given; nothing is sent to set it up."""

    def make(*lines: bytes, timeout_s: float = 20.0, **options: Any) -> OptoNCDT1420:
        options = {"values": 1, "measuring_range_mm": 50.0} | options
        return OptoNCDT1420(plug_stream(*script.dialogue(*lines), timeout_s=timeout_s), "laser", **options)

    return make


# values ---------------------------------------------------------------------------------------------------------------


def test_a_value_by_hand() -> None:
    assert value(32760) == MIDDLE
    assert parse_value(MIDDLE) == Value(32760, first=True)
    assert parse_value(b"\x3f\x7f\xff") == Value(0x3FFFF, first=False)


@given(st.integers(0, (1 << 18) - 1), st.booleans())
def test_values_round_trip(word: int, first: bool) -> None:
    assert parse_value(value(word, first=first)) == Value(word, first)


@pytest.mark.parametrize(("word", "relative"), [(32760, 0.5), (643, 1.0e-5), (64877, 0.99999)])
def test_formula_of_the_manual(word: int, relative: float) -> None:
    assert distance_mm(word, 100.0) == pytest.approx(100 * relative, abs=1e-3)


@given(st.binary(max_size=5))
def test_random_bytes_are_values_or_named_errors(frame: bytes) -> None:
    try:
        assert 0 <= parse_value(frame).word < 1 << 18
    except UnexpectedReply:
        return


@given(
    st.lists(st.one_of(st.integers(0, (1 << 18) - 1), st.sampled_from([STARTED, STOPPED, b"E202 Access denied\r\n->", INFO]))), st.data()
)
def test_a_stream_is_taken_apart_wherever_it_is_cut(pieces: list[Any], source: st.DataObject) -> None:
    """Values and texts in any order, in chunks of any size, come out whole and in order."""
    stream = b"".join(piece if isinstance(piece, bytes) else value(piece) for piece in pieces)
    splitter, found, at = ValueSplitter(), [], 0
    while at < len(stream):
        size = source.draw(st.integers(1, 40))
        found += splitter.feed(stream[at : at + size])
        at += size
    assert found == [piece.removesuffix(b"->") if isinstance(piece, bytes) else value(piece) for piece in pieces]
    assert splitter.pending == b""


@given(st.lists(st.integers(0, 65520), min_size=3, max_size=30), st.data())
def test_a_lost_byte_costs_one_value(words: list[int], source: st.DataObject) -> None:
    stream = b"".join(map(value, words))
    at = source.draw(st.integers(0, len(stream) - 1))
    found = [parse_value(frame).word for frame in ValueSplitter().feed(stream[:at] + stream[at + 1 :]) if len(frame) == 3]
    assert found == words[: at // 3] + words[at // 3 + 1 :]


@given(st.integers(0, 65520), st.integers(1, 2))
def test_a_text_inside_a_value_costs_that_value(word: int, cut: int) -> None:
    whole = value(word)
    found = ValueSplitter().feed(whole[:cut] + STOPPED + whole[cut:] + MIDDLE)
    assert [frame for frame in found if frame[-1] >= 0x80] == [MIDDLE]
    assert any(frame.endswith(b"OUTPUT NONE\r\n") for frame in found)


@given(st.binary(max_size=200))
def test_no_bytes_upset_the_splitter(data: bytes) -> None:
    splitter = ValueSplitter()
    for frame in splitter.feed(data):
        if frame and frame[-1] >= 0x80:
            parse_value(frame)
    assert splitter.feed(b"->" + MIDDLE)[-1] == MIDDLE


def test_info_of_the_sheet() -> None:
    info = parse_info(INFO.decode())
    assert (info["name"], info["serial"], info["measuring range"], info["cable head"]) == ("ILD1420-50", "15120012", "50.00mm", "Wire")


@settings(deadline=None)
@given(st.data())
def test_a_damaged_byte_never_makes_a_wrong_reading_good(source: st.DataObject) -> None:
    whole = STARTED + 5 * MIDDLE
    at = source.draw(st.integers(0, len(whole) - 1))
    damaged = whole[:at] + source.draw(st.binary(max_size=3)) + whole[at + 1 :]
    link = StreamLink(Canned(lambda request: damaged if request == START else STOPPED), url="canned://", timeout_s=1e-9)
    try:
        reading = OptoNCDT1420(link, "laser", measuring_range_mm=50.0).read()
    except DeviceError:
        return
    assert reading.distance_mm == pytest.approx(25.0, abs=0.5) or not reading.good


@settings(deadline=None)
@given(st.binary(max_size=60), st.binary(max_size=60))
def test_whatever_is_answered_gives_readings_or_named_errors(started: bytes, stopped: bytes) -> None:
    link = StreamLink(Canned(lambda request: STARTED + started if request == START else stopped + STOPPED), url="canned://", timeout_s=1e-9)
    laser = OptoNCDT1420(link, "laser", values=1, measuring_range_mm=50.0)
    try:
        reading = laser.read()
    except DeviceError:
        return
    assert 0 <= reading.distance_mm <= 50.0 or not reading.good


# the sensor -----------------------------------------------------------------------------------------------------------


def test_opening_and_reading(plug_stream: Any, script: Any) -> None:
    link = plug_stream(*script.dialogue(*OPENING, START, STARTED + 5 * MIDDLE, STOP, 2 * MIDDLE + STOPPED, b"GETINFO\r\n", INFO))
    laser = OptoNCDT1420.open(link, "laser", start_of_range_mm=45.0)
    assert isinstance(laser, RangeFinder)
    assert laser.limits_mm() == (45.0, 95.0)
    reading = laser.read()
    assert reading.good
    assert reading.distance_mm == pytest.approx(70.0)
    identity = laser.identify()
    assert (identity.model, identity.serial_number, identity.firmware) == ("ILD1420-50", "15120012", "001.018")


def test_a_range_that_is_not_the_printed_one(plug_stream: Any, script: Any) -> None:
    with pytest.raises(UnexpectedReply, match=r"measuring range '50.00mm'.*expected 100 mm"):
        OptoNCDT1420.open(plug_stream(*script.dialogue(*OPENING[:4])), "laser", measuring_range_mm=100.0)


def test_a_range_that_is_not_told(plug_stream: Any, script: Any) -> None:
    opening = [*OPENING[:3], INFO.replace(b"50.00mm", b"")]
    with pytest.raises(UnexpectedReply, match="measuring_range_mm"):
        OptoNCDT1420.open(plug_stream(*script.dialogue(*opening)), "laser")
    link = plug_stream(*script.dialogue(*opening))
    assert OptoNCDT1420.open(link, "laser", measuring_range_mm=25.0, measuring_rate_khz=None).limits_mm() == (0.0, 25.0)


def test_only_values_after_the_start_and_first_of_their_set_count(sensor: Any) -> None:
    stream = value(1000) + STARTED + value(2000, first=False) + MIDDLE
    assert sensor(START, stream, STOP, STOPPED).read().distance_mm == pytest.approx(25.0)


def test_the_median_is_taken(sensor: Any) -> None:
    words = (32760, 32770, 32750, 32761, 32759)
    reading = sensor(START, STARTED + b"".join(map(value, words)), STOP, STOPPED, values=5).read()
    assert reading.distance_mm == pytest.approx(25.0)
    assert reading.good


def test_values_that_differ_are_doubtful(sensor: Any) -> None:
    """A bit flipped on the wire is not noticed in the value itself."""
    stream = STARTED + MIDDLE + value(32760 ^ 1 << 13) + MIDDLE
    reading = sensor(START, stream, STOP, STOPPED, values=3).read()
    assert (reading.doubtful, reading.good, reading.flags) == (True, False, ("values_differ",))


@pytest.mark.parametrize(
    ("word", "flag"),
    [(0, "too_near"), (642, "too_near"), (64878, "too_far"), (65520, "too_far"), (65521, "error_65521"), (262077, "error_262077")],
)
def test_out_of_range_is_never_a_good_value(sensor: Any, word: int, flag: str) -> None:
    reading = sensor(START, STARTED + value(word), STOP, STOPPED).read()
    assert (reading.distance_mm, reading.out_of_range, reading.good, reading.flags) == (math.inf, True, False, (flag,))
    assert reading.status == (word if word > 65520 else 0)


@pytest.mark.parametrize("word", [643, 64877])
def test_the_ends_of_the_range_are_good(sensor: Any, word: int) -> None:
    assert sensor(START, STARTED + value(word), STOP, STOPPED).read().good


def test_the_unverified_last_value_can_be_changed(sensor: Any) -> None:
    assert sensor(START, STARTED + value(64887), STOP, STOPPED, last_valid=64887).read().good


def test_one_error_among_the_values_spoils_the_reading(sensor: Any) -> None:
    assert not sensor(START, STARTED + MIDDLE + value(262077) + MIDDLE, STOP, STOPPED, values=3).read().good


def test_a_refused_command_is_named(sensor: Any) -> None:
    laser = sensor(START, b"E202 Access denied\r\n->", STOP, STOPPED)
    with pytest.raises(DeviceFault, match=r"laser on /dev/.*measuring: E202 Access denied.*log in"):
        laser.read()


@pytest.mark.parametrize(
    "options", [{"values": 0}, {"spread_mm": 0.0}, {"measuring_range_mm": math.nan}, {"last_valid": 70000}, {"start_of_range_mm": math.inf}]
)
def test_impossible_options_are_refused_before_anything_is_sent(sensor: Any, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match="laser"):
        sensor(**options)


def test_a_plain_link_is_refused(plug: Any) -> None:
    with pytest.raises(InvalidSetting, match="StreamLink"):
        OptoNCDT1420(plug(), "laser")


# trouble on the line --------------------------------------------------------------------------------------------------


def test_too_few_values(plug_stream: Any, script: Any) -> None:
    steps = [script.expect(START), script.send(STARTED + MIDDLE), script.expect(START), script.expect(STOP), script.send(STOPPED)]
    laser = OptoNCDT1420(plug_stream(*steps, timeout_s=SHORT_S), "laser", values=3, measuring_range_mm=50.0)
    with pytest.raises(TransportTimeout, match=r"laser on /dev/.*expected 3 values"):
        laser.read()


def test_a_late_answer_is_not_taken_for_another(sensor: Any) -> None:
    """The echo tells which command an answer belongs to."""
    late = b"MEASRATE 1\r\n->" + STOPPED
    assert sensor(START, late + value(1000) + STARTED + MIDDLE, STOP, STARTED + STOPPED).read().distance_mm == pytest.approx(25.0)


def test_what_was_left_on_the_line_does_not_spoil_the_next_answer(sensor: Any) -> None:
    laser = sensor(START, STARTED + MIDDLE, STOP, STOPPED + b"W3", START, STARTED + MIDDLE, STOP, STOPPED, timeout_s=2.0)
    assert [laser.read().good for _ in range(2)] == [True, True]


def test_unplugged(plug_stream: Any, script: Any) -> None:
    laser = OptoNCDT1420(plug_stream(script.expect(START), script.unplug()), "laser", measuring_range_mm=50.0)
    with pytest.raises(PortClosed, match="laser on /dev/"):
        laser.read()


def test_closed(sensor: Any) -> None:
    laser = sensor()
    laser.close()
    with pytest.raises(PortClosed, match="laser"):
        laser.read()
