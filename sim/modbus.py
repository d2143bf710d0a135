"""Modbus RTU at the wire, for simulated devices: frames, checksums, exceptions and addresses on one bus.

Source: MODBUS Application Protocol V1.1b3 and MODBUS over Serial Line V1.02; nothing is taken from a Modbus library. A real device ends a
frame at a silence of 3.5 characters, which neither a pseudo-terminal nor a socket keeps: here the first stretch of bytes that is a whole
frame with a right checksum is a request, and what stands before it is noise.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from sim.clock import Clock
from sim.errors import SimError
from sim.troubles import TROUBLES
from sim.wire import Line

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILURE, BUSY = 1, 2, 3, 4, 6
"""Exception codes. Source: Application Protocol V1.1b3, 7."""

_DIAGNOSE = 8
_FIXED = frozenset({1, 2, 3, 4, 5, 6, _DIAGNOSE})  # functions whose requests are 8 bytes long
_COUNTED = {15: 6, 16: 6, 23: 10}  # where in the others the number of data bytes stands
_LONGEST = 256
_MOST_READ, _MOST_WRITTEN, _MOST_BITS = 125, 123, 2000


class Refusal(Exception):
    """A device says no; the only argument is the exception code."""

    @property
    def code(self) -> int:
        """The exception code."""
        return int(self.args[0])


def crc(data: bytes) -> bytes:
    """Return the CRC-16 of `data` as it goes over the wire, low byte first. Source: Serial Line V1.02, 6.2.2."""
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder >> 1) ^ 0xA001 if remainder & 1 else remainder >> 1
    return struct.pack("<H", remainder)


class Unit:
    """A simulated device without anything in it: override what it has; all else is refused as an illegal function.

    Every method gets the simulated time (s) first, and may raise `Refusal`.
    """

    functions: frozenset[int] = frozenset()
    """Function codes it knows, out of 2, 3, 4, 6, 8, 16 and 23."""
    troubles: tuple[str, ...] = ()
    """What can go wrong inside it; see `sim.troubles`."""

    def trouble(self, t: float, kind: str, rng: np.random.Generator) -> str | None:
        """Do one of `troubles` and say so, or return None while there is no opportunity."""
        return None

    def read_discrete(self, t: float, address: int, count: int) -> Sequence[bool]:
        """Return `count` inputs."""
        raise Refusal(ILLEGAL_FUNCTION)

    def read_holding(self, t: float, address: int, count: int) -> Sequence[int]:
        """Return `count` holding registers."""
        raise Refusal(ILLEGAL_FUNCTION)

    def read_input(self, t: float, address: int, count: int) -> Sequence[int]:
        """Return `count` input registers."""
        raise Refusal(ILLEGAL_FUNCTION)

    def write_holding(self, t: float, address: int, values: Sequence[int]) -> None:
        """Write holding registers."""
        raise Refusal(ILLEGAL_FUNCTION)

    def answer(self, t: float, request: bytes) -> bytes:
        """Carry out function code and data, and return those of the reply."""
        function, data = request[0], request[1:]
        try:
            if function not in self.functions:
                raise Refusal(ILLEGAL_FUNCTION)
            return bytes([function]) + self._carry_out(t, function, data)
        except Refusal as refusal:
            return bytes([function | 0x80, refusal.code])

    def _carry_out(self, t: float, function: int, data: bytes) -> bytes:
        if function == _DIAGNOSE:
            if data[:2] != b"\0\0":  # only subfunction 0, the echo
                raise Refusal(ILLEGAL_FUNCTION)
            return data
        address, number = struct.unpack(">HH", data[:4])
        match function:
            case 2:
                bits = self.read_discrete(t, address, _within(address, number, _MOST_BITS))
                packed = sum(int(bit) << place for place, bit in enumerate(bits))
                return bytes([-(-number // 8)]) + packed.to_bytes(-(-number // 8), "little")
            case 3:
                return _registers(self.read_holding(t, address, _within(address, number, _MOST_READ)))
            case 4:
                return _registers(self.read_input(t, address, _within(address, number, _MOST_READ)))
            case 6:
                self.write_holding(t, address, (number,))
                return data
            case 16:
                self.write_holding(t, _start(address, number), _values(data[4:], number))
                return data[:4]
            case 23:
                _within(address, number, _MOST_READ)
                target, count = struct.unpack(">HH", data[4:8])
                self.write_holding(t, _start(target, count), _values(data[8:], count))
                return _registers(self.read_holding(t, address, number))
        raise Refusal(ILLEGAL_FUNCTION)


def _within(address: int, count: int, most: int) -> int:
    if not 1 <= count <= most:
        raise Refusal(ILLEGAL_VALUE)
    _start(address, count)
    return count


def _start(address: int, count: int) -> int:
    if address + count > 0x10000:
        raise Refusal(ILLEGAL_ADDRESS)
    return address


def _values(counted: bytes, count: int) -> tuple[int, ...]:
    if not 1 <= count <= _MOST_WRITTEN or counted[0] != 2 * count or len(counted) != 1 + 2 * count:
        raise Refusal(ILLEGAL_VALUE)
    return struct.unpack(f">{count}H", counted[1:])


def _registers(values: Sequence[int]) -> bytes:
    return bytes([2 * len(values)]) + struct.pack(f">{len(values)}H", *values)


class ModbusBus:
    """Devices on one port.

    Parameters
    ----------
    clock : Clock
        Simulated time.
    units : mapping of int to Unit
        The devices by their addresses, 1 to 247.
    name, model : str
        Of the port.
    turnaround_s : float, s
        Simulated time between a request and its reply.
    """

    def __init__(self, clock: Clock, units: Mapping[int, Unit], name: str, model: str, turnaround_s: float = 0.0) -> None:
        if not units or not all(1 <= address <= 247 for address in units) or turnaround_s < 0:
            raise SimError(f"bus {name}: addresses {sorted(units)}, turnaround {turnaround_s} s; expected 1 to 247, and zero or more")
        self.name, self.model = name, model
        self.units = dict(units)
        self._clock = clock
        self._turnaround_s = turnaround_s

    @property
    def troubles(self) -> tuple[str, ...]:
        """What can go wrong inside one or the other device."""
        return tuple(kind for kind in TROUBLES if any(kind in unit.troubles for unit in self.units.values()))

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Do one of `troubles` to a drawn device; see `sim.troubles`."""
        able = [address for address, unit in self.units.items() if kind in unit.troubles]
        for place in rng.permutation(len(able)):
            told = self.units[able[place]].trouble(self._clock.now(), kind, rng)
            if told is not None:
                return f"device {able[place]}: {told}"
        return None

    async def serve(self, line: Line) -> None:
        """Answer requests on `line` until the client has gone."""
        held = b""
        while data := await line.read():
            held += data
            while (found := find_request(held)) is not None:
                start, end = found
                reply = self.answer(held[start:end])
                held = held[end:]
                if reply is not None:
                    if self._turnaround_s:
                        await self._clock.sleep(self._turnaround_s)
                    line.write(reply)
            held = held[-_LONGEST:]
            await line.drain()

    def answer(self, frame: bytes) -> bytes | None:
        """Carry out one whole request, and return the whole reply.

        None, silence, for a wrong length or checksum, an address nobody has, and address 0, which speaks to all.
        """
        if len(frame) < 4 or len(frame) != _length(frame) or crc(frame[:-2]) != frame[-2:]:
            return None
        now, address, request = self._clock.now(), frame[0], frame[1:-2]
        if address == 0:
            for unit in self.units.values():
                unit.answer(now, request)
            return None
        if address not in self.units:
            return None
        reply = bytes([address]) + self.units[address].answer(now, request)
        return reply + crc(reply)


def find_request(data: bytes) -> tuple[int, int] | None:
    """Return where the first whole request with a right checksum starts and ends; None if there is none yet."""
    for start in range(len(data) - 3):
        end = start + _length(data[start:])
        if end <= len(data) and crc(data[start : end - 2]) == data[end - 2 : end]:
            return start, end
    return None


def _length(data: bytes) -> int:
    """Return the length of a request beginning here; one of an unknown function is all there is."""
    function = data[1]
    if function in _FIXED:
        return 8
    if function in _COUNTED:
        place = _COUNTED[function]
        return place + 1 + data[place] + 2 if len(data) > place else _LONGEST
    return len(data)
