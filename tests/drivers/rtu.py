"""Modbus frames, a port made of them without a wire, and time that passes only when waited for."""

from __future__ import annotations

import io
from collections.abc import Callable

from drivers.modbus import ModbusLink


def framed(body: str) -> bytes:
    """Append the checksum, reckoned in another way than pymodbus does: by the generator, bit by bit, without a table."""
    data = bytes.fromhex(body)
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder // 2 ^ (0xA001 * (remainder % 2))
    return data + bytes((remainder % 256, remainder // 256))


class Canned:
    """A port without descriptor that has an answer ready to every request."""

    baudrate = 115200
    timeout = 0.0

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._answer = answer
        self._there = b""

    def fileno(self) -> int:
        """Say that there is none."""
        raise io.UnsupportedOperation

    @property
    def in_waiting(self) -> int:
        """How many bytes are there."""
        return len(self._there)

    def read(self, size: int) -> bytes:
        """Hand over bytes."""
        taken, self._there = self._there[:size], self._there[size:]
        return taken

    def write(self, data: bytes) -> None:
        """Take a request."""
        self._there = self._answer(data)


def link_to(answer: Callable[[bytes], bytes]) -> ModbusLink:
    """A link without patience to an other end that has the answers ready."""
    return ModbusLink(Canned(answer), url="canned://", timeout_s=1e-9)


class Hurried:
    """Time that passes only when somebody waits, and then a lot.

    Parameters
    ----------
    pace : float
        How many times what is waited for.
    """

    def __init__(self, pace: float) -> None:
        self._pace, self._now = pace, 0.0

    def monotonic(self) -> float:
        """Seconds since it was made."""
        return self._now

    def sleep(self, seconds: float, /) -> None:
        """Let time pass."""
        self._now += self._pace * seconds
