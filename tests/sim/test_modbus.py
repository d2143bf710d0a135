"""The Modbus bus at the wire: checksums, frames among noise, exceptions, addresses."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.modbus import BUSY, ILLEGAL_ADDRESS, ModbusBus, Refusal, Unit, crc, find_request
from tests.sim.lines import Recorder

VECTORS = [
    ("01 06 00 7D 00 10", "18 1E"),
    ("01 06 00 7D 00 00", "19 D2"),
    ("01 06 00 7D 00 20", "18 0A"),
    ("01 03 00 7F 00 01", "B5 D2"),
    ("01 03 00 CC 00 02", "04 34"),
    ("01 04 00 CA 00 02", "51 F5"),
    ("01 03 00 00 00 02", "C4 0B"),
]


class Shelf(Unit):
    """Sixteen holding registers, and inputs that tell their own addresses."""

    functions = frozenset({2, 3, 4, 6, 8, 16, 23})

    def __init__(self) -> None:
        self.kept = [0] * 16
        self.busy = False

    def read_discrete(self, t: float, address: int, count: int) -> Sequence[bool]:
        return [place % 3 == 0 for place in range(address, address + count)]

    def read_input(self, t: float, address: int, count: int) -> Sequence[int]:
        return list(range(address, address + count))

    def read_holding(self, t: float, address: int, count: int) -> Sequence[int]:
        if address + count > 16:
            raise Refusal(ILLEGAL_ADDRESS)
        return self.kept[address : address + count]

    def write_holding(self, t: float, address: int, values: Sequence[int]) -> None:
        if self.busy:
            raise Refusal(BUSY)
        if address + len(values) > 16:
            raise Refusal(ILLEGAL_ADDRESS)
        self.kept[address : address + len(values)] = values


class OnlyInputs(Shelf):
    functions = frozenset({4})


@pytest.fixture
def bus() -> ModbusBus:
    return ModbusBus(ManualClock(), {1: Shelf(), 7: OnlyInputs()}, "shelf", "shelf")


def request(text: str) -> bytes:
    data = bytes.fromhex(text)
    return data + crc(data)


def ask(bus: ModbusBus, text: str) -> str:
    reply = bus.answer(request(text))
    assert reply is not None
    assert crc(reply[:-2]) == reply[-2:]
    return reply[:-2].hex(" ").upper()


@pytest.mark.parametrize(("data", "check"), VECTORS)
def test_checksums_of_the_sheet(data: str, check: str) -> None:
    assert crc(bytes.fromhex(data)) == bytes.fromhex(check)


@pytest.mark.parametrize(
    ("text", "reply"),
    [
        ("01 03 00 00 00 02", "01 03 04 00 00 00 00"),
        ("01 04 01 00 00 02", "01 04 04 01 00 01 01"),
        ("01 02 00 00 00 0A", "01 02 02 49 02"),
        ("01 06 00 03 12 34", "01 06 00 03 12 34"),
        ("01 10 00 03 00 02 04 12 34 56 78", "01 10 00 03 00 02"),
        ("01 17 00 03 00 02 00 04 00 01 02 AB CD", "01 17 04 00 00 AB CD"),
        ("01 08 00 00 A5 37", "01 08 00 00 A5 37"),
        ("07 04 00 05 00 01", "07 04 02 00 05"),
    ],
)
def test_every_function(bus: ModbusBus, text: str, reply: str) -> None:
    assert ask(bus, text) == reply


@pytest.mark.parametrize(
    ("text", "reply"),
    [
        ("07 03 00 00 00 01", "07 83 01"),
        ("01 01 00 00 00 01", "01 81 01"),
        ("01 05 00 00 FF 00", "01 85 01"),
        ("01 2B 0E 01 00", "01 AB 01"),
        ("01 08 00 01 00 00", "01 88 01"),
        ("01 03 00 0F 00 02", "01 83 02"),
        ("01 04 FF FF 00 02", "01 84 02"),
        ("01 03 00 00 00 00", "01 83 03"),
        ("01 03 00 00 00 7E", "01 83 03"),
        ("01 02 00 00 07 D1", "01 82 03"),
        ("01 10 00 00 00 02 02 00 01", "01 90 03"),
        ("01 10 00 00 00 00 00", "01 90 03"),
        ("01 10 00 0F 00 02 04 00 01 00 02", "01 90 02"),
    ],
)
def test_exceptions(bus: ModbusBus, text: str, reply: str) -> None:
    assert ask(bus, text) == reply
    assert ask(bus, "01 03 00 00 00 02") == "01 03 04 00 00 00 00"


def test_a_busy_device_keeps_what_it_has(bus: ModbusBus) -> None:
    shelf = bus.units[1]
    assert isinstance(shelf, Shelf)
    shelf.busy = True
    assert ask(bus, "01 06 00 03 12 34") == "01 86 06"
    assert shelf.kept == [0] * 16


@pytest.mark.parametrize(
    "frame", [b"", b"\x01", request("01 03 00 00 00 02")[:-1] + b"\0", request("02 03 00 00 00 02"), request("01 03 00")]
)
def test_silence(bus: ModbusBus, frame: bytes) -> None:
    assert bus.answer(frame) is None


def test_all_hear_address_0_and_nobody_answers(bus: ModbusBus) -> None:
    assert bus.answer(request("00 06 00 03 12 34")) is None
    assert ask(bus, "01 03 00 03 00 01") == "01 03 02 12 34"


@given(st.binary(max_size=40), st.binary(max_size=40))
def test_a_request_is_found_among_noise(before: bytes, after: bytes) -> None:
    noise = before.replace(b"\x01", b"")
    frame = request("01 03 00 00 00 02")
    found = find_request(noise + frame + after)
    assert found is not None
    start, end = found
    assert end <= len(noise + frame)
    assert crc((noise + frame)[start : end - 2]) == (noise + frame)[end - 2 : end]


@given(st.binary(max_size=300))
def test_no_bytes_break_the_bus(data: bytes) -> None:
    bus = ModbusBus(ManualClock(), {1: Shelf()}, "shelf", "shelf")
    bus.answer(data)
    bus.answer(data + crc(data))
    find_request(data)


def served(bus: ModbusBus, *pieces: bytes) -> list[bytes]:
    async def run() -> list[bytes]:
        line = Recorder()
        for piece in (*pieces, b""):
            line.said.put_nowait(piece)
        await bus.serve(line)
        return line.heard

    return asyncio.run(run())


def test_a_request_in_pieces_two_at_once_and_one_after_a_torn_one(bus: ModbusBus) -> None:
    frame, reply = request("01 04 00 05 00 01"), request("01 04 02 00 05")
    assert served(bus, *(bytes([byte]) for byte in frame)) == [reply]
    assert served(bus, frame + frame) == [reply, reply]
    assert served(bus, frame[:5], frame) == [reply]
    assert served(bus, frame[:3] + b"\xff" + frame[4:], frame) == [reply]
    assert served(bus, bytes(1000), frame) == [reply]


def test_the_reply_takes_its_time() -> None:
    clock = ManualClock(eager=True)
    bus = ModbusBus(clock, {1: Shelf()}, "shelf", "shelf", turnaround_s=0.003)
    assert served(bus, request("01 03 00 00 00 01")) == [request("01 03 02 00 00")]
    assert clock.now() == 0.003


@pytest.mark.parametrize(("addresses", "turnaround_s"), [((), 0.0), ((0,), 0.0), ((248,), 0.0), ((1,), -1.0)])
def test_buses_that_cannot_be(addresses: tuple[int, ...], turnaround_s: float) -> None:
    with pytest.raises(SimError):
        ModbusBus(ManualClock(), {address: Shelf() for address in addresses}, "shelf", "shelf", turnaround_s)
