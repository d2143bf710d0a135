"""Modbus RTU: frames of the sheets byte by byte, damage on the wire, and who goes first."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu.register_message import ReadInputRegistersRequest

from drivers.errors import (
    BadChecksum,
    DeviceError,
    DeviceFault,
    InvalidSetting,
    PortClosed,
    TransportTimeout,
    UnexpectedReply,
)
from drivers.incidents import Incident
from drivers.link import Link
from drivers.modbus import ModbusLink, ModbusRefusal, ModbusUnit, text
from tests.drivers.rtu import framed, link_to

SHORT_S = 0.05
READ_DISTANCE = bytes.fromhex("01 04 00 CA 00 02 51 F5")  # from the sheet
READ_STATUS = bytes.fromhex("01 03 00 7F 00 01 B5 D2")  # from the sheet
STOP = bytes.fromhex("01 06 00 7D 00 20 18 0A")  # from the sheet


DISTANCE = framed("01 04 04 7C 37 42 8B")


@pytest.mark.parametrize("frame", ["01 06 00 7D 00 10 18 1E", "01 06 00 7D 00 00 19 D2", "01 03 00 CC 00 02 04 34"])
def test_this_file_reckons_checksums_as_the_sheet_does(frame: str) -> None:
    assert framed(frame[:-6]) == bytes.fromhex(frame)


Plug = Callable[..., ModbusUnit]


@pytest.fixture
def unit(make_peer: Any) -> Any:
    """A device at address 1 whose other end follows the steps given."""
    with contextlib.ExitStack() as links:

        def make(*steps: Any, timeout_s: float = 20.0, report: Any = None, **options: Any) -> ModbusUnit:
            opened = ModbusLink.open(make_peer(*steps).url, device="bench", timeout_s=timeout_s, report=report, baudrate=115200)
            link = links.enter_context(opened)
            return ModbusUnit(link, "probe", **options)

        yield make


# frames ---------------------------------------------------------------------------------------------------------------


def test_the_sheet_s_float_low_word_first(unit: Plug, script: Any) -> None:
    probe = unit(*script.dialogue(READ_DISTANCE, DISTANCE), high_word_first=False)
    words = probe.input(202, 2, "reading the distance")
    assert words == (0x7C37, 0x428B)
    assert probe.float32(words) == (pytest.approx(69.74261, abs=1e-5),)


def test_every_request(unit: Plug, script: Any) -> None:
    probe = unit(
        *script.dialogue(
            *(READ_STATUS, framed("01 03 02 20 30")),
            *(framed("01 02 00 05 00 0A"), framed("01 02 02 05 02")),
            *(STOP, STOP),
            *(framed("01 10 00 10 00 02 04 00 01 FF FF"), framed("01 10 00 10 00 02")),
            *(framed("01 08 00 00 A5 37"), framed("01 08 00 00 A5 37")),
        )
    )
    assert probe.holding(0x7F, 1, "reading the status") == (0x2030,)
    assert probe.discrete(5, 10, "reading inputs") == tuple(number in (0, 2, 9) for number in range(10))
    probe.write_one(0x7D, 0x20, "stopping")
    probe.write(0x10, (1, 0xFFFF), "setting")
    probe.echo()


def test_the_sheet_s_direct_operation_in_one_write(unit: Plug, script: Any) -> None:
    frame = "01 10 00 58 00 10 20 00000000 00000002 00002134 000007D0 000005DC 000005DC 000003E8 00000001 1C 08"
    probe = unit(*script.dialogue(bytes.fromhex(frame), framed("01 10 00 58 00 10")))
    probe.write(0x58, probe.words_of_int32(0, 2, 8500, 2000, 1500, 1500, 1000, 1), "starting")


@given(st.lists(st.integers(-(2**31), 2**31 - 1), max_size=5), st.booleans())
def test_numbers_come_back_in_either_order(values: list[int], high_word_first: bool) -> None:
    probe = ModbusUnit(link_to(lambda _: b""), "probe", high_word_first=high_word_first)
    words = probe.words_of_int32(*values)
    assert probe.int32(words) == tuple(values)
    assert probe.uint32(words) == tuple(value % 2**32 for value in values)
    assert all((words[2 * place] == value % 2**32 >> 16) == high_word_first for place, value in enumerate(values) if value in (1, -2))


@given(st.floats(width=32))
def test_floats_come_back_nan_included(value: float) -> None:
    probe = ModbusUnit(link_to(lambda _: b""), "probe")
    (back,) = probe.float32(probe.words_of_float32(value))
    assert back == value or (math.isnan(back) and math.isnan(value))


def test_text() -> None:
    assert text((0x4261, 0x756D, 0x6572, 0x2000, 0)) == "Baumer"
    with pytest.raises(UnexpectedReply):
        text((0x42FF,))


@pytest.mark.parametrize(
    "ask",
    [
        lambda probe: probe.holding(0, 0, "reading"),
        lambda probe: probe.holding(0, 126, "reading"),
        lambda probe: probe.holding(-1, 1, "reading"),
        lambda probe: probe.input(0xFFFF, 2, "reading"),
        lambda probe: probe.discrete(0, 2001, "reading"),
        lambda probe: probe.write(0, (), "writing"),
        lambda probe: probe.write(0, (0,) * 124, "writing"),
        lambda probe: probe.write_one(0, 0x10000, "writing"),
        lambda probe: probe.write_one(0, -1, "writing"),
        lambda probe: probe.words_of_int32(2**31),
        lambda probe: probe.words_of_float32(1e39),
        lambda probe: probe.int32((1, 2, 3)),
        lambda probe: ModbusUnit(probe.link, "probe", 0),
        lambda probe: ModbusUnit(probe.link, "probe", 248),
    ],
)
def test_what_cannot_be_asked_is_not_sent(unit: Plug, ask: Callable[[ModbusUnit], object]) -> None:
    with pytest.raises(InvalidSetting):
        ask(unit())


def test_a_link_of_lines_is_refused(make_peer: Any) -> None:
    with Link.open(make_peer().url) as link, pytest.raises(InvalidSetting, match="does not speak Modbus"):
        ModbusUnit(link, "probe")


# refusals and damage --------------------------------------------------------------------------------------------------


def test_an_exception_reply_names_its_meaning_and_is_not_repeated(unit: Plug, script: Any) -> None:
    probe = unit(*script.dialogue(READ_STATUS, framed("01 83 02")))
    with pytest.raises(
        ModbusRefusal, match=r"probe on /dev/.*reading the status: refused with exception 02h \(illegal data address\)"
    ) as caught:
        probe.holding(0x7F, 1, "reading the status")
    assert caught.value.code == 2
    assert isinstance(caught.value, DeviceFault)


REPLY = framed("01 03 02 20 30")
SPOILT = [
    pytest.param(b"", TransportTimeout, "no reply", id="silence"),
    pytest.param(REPLY[:4], TransportTimeout, "broke off", id="cut short"),
    pytest.param(REPLY[:2] + REPLY[3:], TransportTimeout, "broke off", id="a byte lost"),
    pytest.param(REPLY[:-1] + b"\0", BadChecksum, "checksum", id="wrong checksum"),
    pytest.param(REPLY[:3] + REPLY[3:4] + REPLY[3:], BadChecksum, "checksum", id="a byte doubled"),
    pytest.param(framed("01 83 02")[:-1] + b"\0", BadChecksum, "checksum", id="a refusal with a wrong checksum"),
    pytest.param(bytes(range(40)), BadChecksum, "checksum", id="garbage"),
    pytest.param(framed("02 03 02 20 30"), UnexpectedReply, "a reply from address 2", id="another device"),
    pytest.param(framed("01 06 00 7D 00 20"), UnexpectedReply, "another request", id="another function"),
    pytest.param(framed("01 03 04 20 30 00 00"), UnexpectedReply, "another request", id="another length"),
    pytest.param(framed("01 03 03 20 30 00"), UnexpectedReply, "another request", id="an odd length"),
]


@pytest.mark.parametrize(("reply", "error", "says"), SPOILT)
def test_a_spoilt_reply_to_a_read_is_asked_for_once_more(unit: Plug, script: Any, reply: bytes, error: type[Exception], says: str) -> None:
    spoilt = (script.expect(READ_STATUS), *([script.send(reply)] if reply else []))
    assert unit(*spoilt, *script.dialogue(READ_STATUS, REPLY), timeout_s=SHORT_S * 4).holding(0x7F, 1, "reading") == (0x2030,)
    with pytest.raises(error, match=says) as caught:
        unit(*spoilt, *spoilt, timeout_s=SHORT_S).holding(0x7F, 1, "reading")
    assert isinstance(caught.value, DeviceError)
    assert (caught.value.sent, caught.value.raw, caught.value.device) == (READ_STATUS, reply, "probe")


@pytest.mark.parametrize(
    "reply", [b"", STOP[:-1] + b"\0", framed("02 06 00 7D 00 20"), framed("01 06 00 7C 00 20"), framed("01 06 00 7D 00 21")]
)
def test_a_write_is_sent_once_whatever_comes_back(unit: Plug, script: Any, reply: bytes) -> None:
    probe = unit(script.expect(STOP), *([script.send(reply)] if reply else []), timeout_s=SHORT_S)
    with pytest.raises((TransportTimeout, BadChecksum, UnexpectedReply)):
        probe.write_one(0x7D, 0x20, "starting")


@pytest.mark.parametrize(
    "before",
    [
        b"\0",
        b"\x01",
        b"\x01\x03",
        REPLY[:5],
        framed("02 03 02 11 11"),
        framed("01 06 00 7D 00 20"),
        framed("01 03 04 20 30 00 00"),
        READ_STATUS,
    ],
)
def test_noise_a_stale_reply_or_an_echo_before_the_reply_is_passed_over(unit: Plug, script: Any, before: bytes) -> None:
    probe = unit(script.expect(READ_STATUS), script.send(before + REPLY))
    assert probe.holding(0x7F, 1, "reading") == (0x2030,)


def test_what_came_before_the_question_is_not_the_answer(unit: Plug, script: Any) -> None:
    answered, late = threading.Event(), threading.Event()
    again = (script.wait(answered), script.send(framed("01 03 02 66 66")), script.tell(late), *script.dialogue(READ_STATUS, REPLY))
    probe = unit(*script.dialogue(READ_STATUS, REPLY), *again)
    probe.holding(0x7F, 1, "reading")
    answered.set()
    assert late.wait(20)
    assert probe.holding(0x7F, 1, "reading") == (0x2030,)


def test_a_reply_in_single_bytes(unit: Plug, script: Any) -> None:
    probe = unit(script.expect(READ_STATUS), *(script.send(bytes([byte])) for byte in REPLY))
    assert probe.holding(0x7F, 1, "reading") == (0x2030,)


def test_unplugged(unit: Plug, script: Any) -> None:
    with pytest.raises(PortClosed):
        unit(script.expect(READ_STATUS), script.unplug()).holding(0x7F, 1, "reading")


def test_a_closed_device_and_a_closed_link(unit: Plug) -> None:
    probe = unit()
    probe.closed = True
    with pytest.raises(PortClosed, match="open it again"):
        probe.echo()
    other = unit()
    other.link.close()
    with pytest.raises(PortClosed):
        other.echo()


# turns ----------------------------------------------------------------------------------------------------------------


def test_a_stop_goes_before_a_reply_that_does_not_come(unit: Plug, script: Any) -> None:
    asked = threading.Event()
    probe = unit(script.expect(READ_STATUS), script.tell(asked), *script.dialogue(STOP, STOP, READ_STATUS, REPLY))
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(probe.holding, 0x7F, 1, "reading")
        assert asked.wait(20)
        probe.write_one(0x7D, 0x20, "stopping", urgent=True, repeatable=True)
        assert reading.result() == (0x2030,)  # gave way, and was asked again


def test_a_stop_leaves_a_reply_that_is_coming_alone(unit: Plug, script: Any) -> None:
    asked = threading.Event()
    probe = unit(script.expect(READ_STATUS), script.tell(asked), script.send(REPLY), *script.dialogue(STOP, STOP))
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(probe.holding, 0x7F, 1, "reading")
        assert asked.wait(20)
        probe.write_one(0x7D, 0x20, "stopping", urgent=True)
        assert reading.result() == (0x2030,)


def test_a_start_that_gave_way_to_a_stop_is_not_repeated(unit: Plug, script: Any) -> None:
    start, asked = framed("01 06 00 7D 00 10"), threading.Event()
    probe = unit(script.expect(start), script.tell(asked), *script.dialogue(STOP, STOP))
    with ThreadPoolExecutor(1) as pool:
        starting = pool.submit(probe.write_one, 0x7D, 0x10, "starting")
        assert asked.wait(20)
        probe.write_one(0x7D, 0x20, "stopping", urgent=True)
        with pytest.raises(TransportTimeout, match="before a stop had to go out"):
            starting.result()


def test_a_veto_keeps_the_bytes_back(unit: Plug) -> None:
    with pytest.raises(DeviceFault, match="too late"):
        unit().write_one(0x7D, 0x10, "starting", veto=lambda: DeviceFault("too late"))


def test_many_threads_on_one_link(unit: Plug, script: Any) -> None:
    probe = unit(*script.dialogue(*(READ_STATUS, REPLY) * 40))
    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(lambda _: probe.holding(0x7F, 1, "reading"), range(40))) == {(0x2030,)}


def test_a_log_that_fails_is_no_matter(make_peer: Any, script: Any) -> None:
    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    peer = make_peer(*script.dialogue(READ_STATUS, REPLY, READ_STATUS, REPLY))
    with ModbusLink.open(peer.url, timeout_s=20, baudrate=115200, traffic=full) as link:
        probe = ModbusUnit(link, "probe")
        assert [probe.holding(0x7F, 1, "reading") for _ in range(2)] == [(0x2030,)] * 2


def test_every_byte_is_traced(make_peer: Any, script: Any) -> None:
    traffic: list[tuple[str, bytes]] = []
    late = threading.Event()
    again = (script.send(b"\x55"), script.tell(late), *script.dialogue(READ_STATUS, b"\0" + REPLY))
    peer = make_peer(*script.dialogue(READ_STATUS, REPLY), *again)
    with ModbusLink.open(peer.url, timeout_s=20, baudrate=115200, traffic=lambda _, way, data: traffic.append((way, data))) as link:
        probe = ModbusUnit(link, "probe")
        probe.holding(0x7F, 1, "reading")
        assert late.wait(20)
        probe.holding(0x7F, 1, "reading")
    assert [data for way, data in traffic if way == "tx"] == [READ_STATUS] * 2
    assert b"".join(data for way, data in traffic if way == "rx") == REPLY + b"\x55\0" + REPLY


# what is reported -----------------------------------------------------------------------------------------------------


def told(incidents: list[Incident]) -> list[tuple[str, str]]:
    """What was done and why; all by the same device."""
    assert {(incident.device, incident.attempt) for incident in incidents} <= {("probe", "reading")}
    return [(incident.what, incident.detail) for incident in incidents]


def test_nothing_is_reported_when_nothing_was_wrong(unit: Plug, script: Any) -> None:
    incidents: list[Incident] = []
    echoing = [script.expect(READ_STATUS), script.send(READ_STATUS + REPLY)]  # an adapter that hears itself
    probe = unit(*script.dialogue(*(READ_STATUS, REPLY) * 20), *echoing, report=incidents.append)
    for _ in range(21):
        probe.holding(0x7F, 1, "reading")
    assert incidents == []


def test_a_repeat_and_the_silence_before_it_are_reported(unit: Plug, script: Any) -> None:
    incidents: list[Incident] = []
    spoilt = REPLY[:-1] + b"\0"
    probe = unit(*script.dialogue(READ_STATUS, spoilt, READ_STATUS, REPLY), timeout_s=SHORT_S * 4, report=incidents.append)
    assert probe.holding(0x7F, 1, "reading") == (0x2030,)
    why = f"BadChecksum: no reply with a right checksum, got {spoilt.hex(' ')}"
    assert told(incidents) == [("repeated", why), ("resynchronised", f"by silence on the line after {why}")]


def test_a_write_that_fails_is_not_reported_but_the_silence_after_it_is(unit: Plug, script: Any) -> None:
    incidents: list[Incident] = []
    probe = unit(script.expect(STOP), *script.dialogue(READ_STATUS, REPLY), timeout_s=SHORT_S, report=incidents.append)
    with pytest.raises(TransportTimeout):
        probe.write_one(0x7D, 0x20, "starting")
    assert incidents == []
    probe.holding(0x7F, 1, "reading")
    assert told(incidents) == [("resynchronised", "by silence on the line after TransportTimeout: no reply")]


def test_what_is_dropped_or_passed_over_is_reported(unit: Plug, script: Any) -> None:
    """Noise before a reply, and its double behind it or before the next question."""
    incidents: list[Incident] = []
    answered, late = threading.Event(), threading.Event()
    noisy = [script.expect(READ_STATUS), script.send(b"\x55" + REPLY + REPLY)]
    doubled = [script.wait(answered), script.send(REPLY), script.tell(late)]
    probe = unit(*noisy, *doubled, *script.dialogue(READ_STATUS, REPLY), report=incidents.append)
    assert probe.holding(0x7F, 1, "reading") == (0x2030,)
    answered.set()
    assert late.wait(20)
    assert probe.holding(0x7F, 1, "reading") == (0x2030,)
    details = dict(told(incidents))
    assert len(incidents) == 2
    assert bytes.fromhex(details["foreign line passed over"] + details["stale bytes dropped"]) == b"\x55" + REPLY + REPLY


# the decoder ----------------------------------------------------------------------------------------------------------


def distance(answer: bytes) -> list[int]:
    request = ReadInputRegistersRequest(dev_id=1, address=202, count=2)
    return list(link_to(lambda _: answer).ask(request, attempt="reading the distance").registers)


@given(st.integers(0, len(DISTANCE) - 1))
def test_any_truncation_is_noticed(length: int) -> None:
    with pytest.raises(TransportTimeout):
        distance(DISTANCE[:length])


@given(st.binary(max_size=20).filter(lambda noise: 1 not in noise), st.binary(max_size=20))
def test_the_reply_is_found_among_noise(before: bytes, after: bytes) -> None:
    assert distance(before + DISTANCE + after) == [0x7C37, 0x428B]
