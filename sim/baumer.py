"""Simulated Baumer OM20 or OM30 laser distance sensor: its register map, for a bus of `sim.modbus`.

Source: the project's protocol sheet, section 6.1. Not verified, so settable or said here: the ranges of the variants, exception 2 for
registers that do not make up a whole parameter and exception 3 for values a parameter cannot take, the numbers of precision and trigger
mode (0 to 3 are taken, and change nothing), one register for everything the sheet gives no length for, quality 2 while the last distance
of a lost target is held and after, and the alarm with it. Left out: histograms, teaching by the wire input, hysteresis and window of the
switching output (it is on while the distance is between the switch points), and a new address or baud rate, kept and not obeyed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim.errors import SimError
from sim.modbus import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refusal, Unit

Distance = Callable[[float, float], float | None]
"""Mean distance from the sensor's front, mm, between two simulated times, s; None without a target."""

OK, WEAK, CRITICAL = 0, 1, 2
FACTORY_RESET, ZERO_TEACH, RESET_TIME = 503, 185, 1000
_WRITE_ONLY = {ZERO_TEACH: 1, FACTORY_RESET: 1, 1000: 1, 1001: 1, 1002: 1, 1003: 1}
_TAGS = (1050, 1066, 1082)
_TELL_DISTANCE = ((200, 13), (202, 2))


@dataclass(frozen=True)
class RangeModel:
    """What the sensor is like.

    Parameters
    ----------
    near, far : float
        Measuring range, mm (of no variant in particular).
    rate : float
        Measurements per second.
    noise : float
        rms of one measurement, mm.
    dropout : int
        As delivered, ms: for so long a lost target's last distance is told.
    product, serial_number : str
        As its registers tell them.
    """

    near: float = 50.0
    far: float = 150.0
    rate: float = 500.0
    noise: float = 0.01
    dropout: int = 100
    product: str = "OM20-P0100"
    serial_number: str = "700001234"

    def __post_init__(self) -> None:
        if not 0 <= self.near < self.far or self.rate <= 0 or self.noise < 0 or not 0 <= self.dropout <= 0xFFFF:
            raise SimError(f"{self}: expected near below far, a rate above zero and nothing negative")


@dataclass(frozen=True)
class _Measurement:
    """The last one that has ended: what, when, and the last distance there was, with its time."""

    number: int
    distance: float | None
    held: float
    since: float


class DistanceSensor(Unit):
    """A sensor that looks at `distance`.

    `quality` can be set while it runs (OK, WEAK or CRITICAL, with a target in range).

    Parameters
    ----------
    distance : callable
        Mean distance from the sensor's front between two times; None without a target.
    rng : numpy.random.Generator
        Draws the noise.
    model : RangeModel
        What the unit is like.
    """

    functions = frozenset({2, 3, 4, 6, 16})
    troubles = ("alarm", "over-range")

    def __init__(self, distance: Distance, rng: np.random.Generator, model: RangeModel | None = None) -> None:
        self.unit = model or RangeModel()
        self.quality = OK
        self._distance, self._rng = distance, rng
        self._last = _Measurement(-1, None, math.nan, -math.inf)
        self._stopped: float | None = None  # when the laser was switched off
        self._settings = self._factory()
        self._tags = {address: [0] * 16 for address in _TAGS}
        self._reset_time = 0.0
        self._blind = False

    def _factory(self) -> dict[int, list[int]]:
        """Return every readable parameter by its first register, as delivered."""
        unit = self.unit
        floats = {180: 0.0, 200: unit.near, 202: unit.far, 300: unit.near, 302: unit.far, 306: 0.0}
        numbers = {101: 0, 102: 1, 103: 1, 410: 1, 411: 0, 412: 0, 800: unit.dropout, 1100: 1, 1101: 1, 1102: 1}
        longs = {304: 0, 400: 0, 402: 0}
        return (
            {address: _float(value) for address, value in floats.items()}
            | {address: [value] for address, value in numbers.items()}
            | {address: _long(value) for address, value in longs.items()}
        )

    def trouble(self, t: float, kind: str, rng: np.random.Generator) -> str | None:
        """Dirty the window, until `quality` is put back, or have the next distance asked for be none; see `sim.troubles`."""
        if kind == "alarm":
            self.quality = CRITICAL
            return "quality critical, alarm on"
        self._blind = True
        return "the next distance asked for is none"

    # Tables

    def read_discrete(self, t: float, address: int, count: int) -> Sequence[bool]:
        """Return the switching output (0) and the alarm (1)."""
        if address + count > 2:
            raise Refusal(ILLEGAL_ADDRESS)
        outputs = self._measured(t)[1]
        return [bool(outputs >> bit & 1) for bit in range(address, address + count)]

    def read_input(self, t: float, address: int, count: int) -> Sequence[int]:
        """Return one parameter whole, or the block of all measurements."""
        blind = self._blind and (address, count) in _TELL_DISTANCE
        block = self._measured(t, blind)
        self._blind = self._blind and not blind
        if (address, count) == (200, len(block)):
            return block
        inputs: dict[int, list[int]] = {
            0: _text("Baumer Electric AG", 16),
            16: _text("www.baumer.com", 16),
            32: _text(self.unit.product, 26),
            58: _text("11200000", 5),
            63: _text("Laser distance sensor", 32),
            95: _text(self.unit.serial_number, 10),
            105: _text("1.0", 5),
            110: _text("1.2.3", 5),
            115: _text("00000000", 6),
            200: block[0:1],
            201: block[1:2],
            202: block[2:4],
            204: block[4:6],
            206: block[6:7],
            207: block[7:9],
            209: block[9:11],
            211: block[11:13],
            301: _long(int(t)),
            303: _long(int(t - self._reset_time)),
        }
        return _whole(inputs, address, count)

    def read_holding(self, t: float, address: int, count: int) -> Sequence[int]:
        """Return one parameter whole; one that can only be written gives 0xFFFF."""
        if _WRITE_ONLY.get(address) == count:
            return [0xFFFF] * count
        return _whole(self._settings | self._tags, address, count)

    def write_holding(self, t: float, address: int, values: Sequence[int]) -> None:
        """Write one parameter whole."""
        if _WRITE_ONLY.get(address) == len(values):
            self._command(t, address)
            return
        _whole(self._settings | self._tags, address, len(values))
        self._check(address, values)
        if address in self._tags:
            self._tags[address] = list(values)
            return
        if address == 410 and self._settings[410] != list(values):
            self._last = self._measure(t)
            self._stopped = None if values[0] else t
        self._settings[address] = list(values)

    def _check(self, address: int, values: Sequence[int]) -> None:
        unit = self.unit
        if address in (101, 400):
            allowed = _number(values) <= 3
        elif address in (180, 300, 302, 306):
            allowed = math.isfinite(_as_float(values))
        elif address in (200, 202):
            ends = {200: self._ends()[0], 202: self._ends()[1]} | {address: _as_float(values)}
            allowed = unit.near <= ends[200] < ends[202] <= unit.far
        elif address in (304, 410, 411, 412, 1102):
            allowed = _number(values) <= 1
        elif address in (1100, 1101):
            allowed = 1 <= values[0] <= 247 if address == 1100 else values[0] <= 3
        else:
            allowed = True
        if not allowed:
            raise Refusal(ILLEGAL_VALUE)

    def _command(self, t: float, address: int) -> None:
        if address == FACTORY_RESET:
            self._settings, self._stopped = self._factory(), None
        elif address == RESET_TIME:
            self._reset_time = t
        elif address == ZERO_TEACH:
            self._last = self._measure(t)
            if self._last.distance is None:
                raise Refusal(ILLEGAL_VALUE)
            self._settings[180] = _float(self._last.distance)

    # Measuring

    def _ends(self) -> tuple[float, float]:
        return _as_float(self._settings[200]), _as_float(self._settings[202])

    def _measure(self, t: float) -> _Measurement:
        """Return the last measurement that has ended by `t`, or by the time the laser was switched off."""
        last, period = self._last, 1 / self.unit.rate
        number = math.floor((t if self._stopped is None else self._stopped) / period + 1e-9) - 1
        if number <= last.number:
            return last
        end = (number + 1) * period
        distance = self._distance(number * period, end)
        if distance is not None:
            distance += float(self._rng.normal(0.0, self.unit.noise))
            if self._ends()[0] <= distance <= self._ends()[1]:
                return _Measurement(number, distance, distance, end)
        return _Measurement(number, None, last.held, last.since)

    def _measured(self, t: float, blind: bool = False) -> list[int]:
        """Return the thirteen registers from 200 on; those of a target long lost if blind."""
        self._last = last = self._measure(t)
        period = 1 / self.unit.rate
        told, quality = last.distance, self.quality
        if told is None:
            quality = CRITICAL
            told = last.held if t - last.since <= self._settings[800][0] / 1000 else math.nan
        if blind:
            told, quality = math.nan, CRITICAL
        told -= _as_float(self._settings[180])
        near, far = _as_float(self._settings[300]), _as_float(self._settings[302])
        outputs = int(near <= told <= far) | int(quality == CRITICAL) << 1
        microseconds = round(max(last.number + 1, 0) * period * 1e6)
        return [
            quality,
            outputs,
            *_float(told),
            *_float(self.unit.rate),
            0 if quality == CRITICAL else 10,
            *_long(round(period * 1e6)),
            *_long(microseconds // 1_000_000),
            *_long(microseconds % 1_000_000),
        ]


def _whole(table: dict[int, list[int]], address: int, count: int) -> list[int]:
    if len(table.get(address, ())) != count:
        raise Refusal(ILLEGAL_ADDRESS)
    return table[address]


def _swapped(packed: bytes) -> list[int]:
    high, low = struct.unpack(">2H", packed)
    return [low, high]


def _float(value: float) -> list[int]:
    return _swapped(struct.pack(">f", value))


def _long(value: int) -> list[int]:
    return _swapped(struct.pack(">I", value & 0xFFFFFFFF))


def _as_float(words: Sequence[int]) -> float:
    return float(struct.unpack(">f", struct.pack(">2H", words[1], words[0]))[0])


def _number(words: Sequence[int]) -> int:
    return sum(word << 16 * place for place, word in enumerate(words))


def _text(words: str, registers: int) -> list[int]:
    padded = words.encode("ascii").ljust(2 * registers, b"\0")
    return list(struct.unpack(f">{registers}H", padded[: 2 * registers]))
