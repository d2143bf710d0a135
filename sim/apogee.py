"""Simulated Apogee SQ-422X quantum sensor: its register map, for a bus of `sim.modbus`.

Source: the project's protocol sheet, section 5.4. Not verified, so settable or said here: how often the sensor measures and for how long it
is busy with it, the range, exception 2 for registers it does not have and exception 3 for values it cannot take, and the model number. The
coefficients are guarded and cannot be written here, only reset. A new address takes effect with the save, on `address` only: on the bus the
sensor stays where it was put, until it is put elsewhere in `ModbusBus.units`. Baud rate, parity and stop bits are kept and not obeyed; the
wire of the simulators has none.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim.errors import SimError
from sim.modbus import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refusal, Unit

SAVE, RESET_COEFFICIENTS, FACTORY_RESET = 100, 190, 255

Flux = Callable[[float, float], float]
"""Mean photon flux, umol/(m^2 s), between two simulated times, s."""

_FACTORY = {16: 1.0, 22: 3.0, 24: 2.0, 26: 1.0, 36: 1.0, 38: 0.0}
_COEFFICIENTS = {28: 100.0, 30: 0.0, 32: 1.15, 34: 1.0}
_ALLOWED: dict[int, tuple[float, ...]] = {22: (0, 1, 2, 3, 4), 24: (0, 1, 2), 26: (1, 2), 38: (0, 1)}
# 16-bit registers, and what they are a multiple of.
_WHOLE = {40: (0, 10), 41: (2, 10), 42: (4, 10), 43: (6, 10), 45: (10, 1), 46: (12, 10)}


@dataclass(frozen=True)
class QuantumModel:
    """What the sensor is like.

    Parameters
    ----------
    serial_number, model_number : int
        As its registers tell them.
    firmware : float
    full_scale : float
        It tells no more than this, umol/(m^2 s).
    period : float
        It measures so often, s; the registers tell the last measurement that has ended.
    busy : float
        For so long after each it is busy, s.
    noise : float
        rms, umol/(m^2 s).
    """

    serial_number: int = 1234
    model_number: int = 422
    firmware: float = 1.0
    full_scale: float = 4000.0
    period: float = 0.5
    busy: float = 0.02
    noise: float = 0.05

    def __post_init__(self) -> None:
        if not 0 <= self.busy < self.period or self.full_scale <= 0 or self.noise < 0 or not 0 <= self.serial_number < 1 << 24:
            raise SimError(f"{self}: expected busy below period, nothing negative, and a serial number below 2^24")


class QuantumSensor(Unit):
    """A sensor that looks at `flux`; the address is told, not obeyed.

    Parameters
    ----------
    flux : callable
        Mean photon flux between two times.
    rng : numpy.random.Generator
        Draws the noise.
    model : QuantumModel
        What the unit is like.
    """

    functions = frozenset({3, 16})
    troubles = ("over-range",)

    def __init__(self, flux: Flux, rng: np.random.Generator, model: QuantumModel | None = None, *, address: int = 1) -> None:
        self.unit = model or QuantumModel()
        self._flux, self._rng = flux, rng
        self._saved = _FACTORY | _COEFFICIENTS | {16: float(address)}
        self._pending: dict[int, float] = {}
        self._measured = (-1, 0.0)
        self._dazzled = False

    @property
    def address(self) -> int:
        """What it takes its address to be."""
        return round(self._saved[16])

    def trouble(self, t: float, kind: str, rng: np.random.Generator) -> str | None:
        """Have the next measurement end at full scale; see `sim.troubles`."""
        self._dazzled = True
        return "the next measurement ends at full scale"

    def read_holding(self, t: float, address: int, count: int) -> Sequence[int]:
        """Return registers, floats as two words and whole numbers as one."""
        return [self._word(t, register) for register in range(address, address + count)]

    def write_holding(self, t: float, address: int, values: Sequence[int]) -> None:
        """Write settings, to take effect with the save."""
        if address == SAVE:
            self._saved |= self._pending
            self._pending.clear()
            if self._saved[16] == FACTORY_RESET:
                self._saved = _FACTORY | _COEFFICIENTS
            return
        if address == RESET_COEFFICIENTS:
            self._pending |= _COEFFICIENTS
            return
        if address % 2 or len(values) % 2:
            raise Refusal(ILLEGAL_ADDRESS)
        numbers = struct.unpack(f">{len(values) // 2}f", struct.pack(f">{len(values)}H", *values))
        changes = dict(zip(range(address, address + len(values), 2), numbers, strict=True))
        for register, number in changes.items():
            if register not in self._saved or register in _COEFFICIENTS:
                raise Refusal(ILLEGAL_ADDRESS)
            addresses = register == 16 and (number == FACTORY_RESET or 1 <= number <= 247) and number.is_integer()
            if not math.isfinite(number) or not (addresses or number in _ALLOWED.get(register, () if register == 16 else (number,))):
                raise Refusal(ILLEGAL_VALUE)
        self._pending |= changes

    def _word(self, t: float, register: int) -> int:
        if register in _WHOLE:
            source, factor = _WHOLE[register]
            return max(-32_768, min(32_767, round(self._number(t, source) * factor))) & 0xFFFF
        first = register - register % 2
        return int(struct.unpack(">2H", struct.pack(">f", self._number(t, first)))[register % 2])

    def _number(self, t: float, register: int) -> float:
        unit = self.unit
        match register:
            case 0:
                return self._output(t)
            case 2:
                return self._output(t) / self._saved[28]
            case 4:
                return self._output(t) * self._saved[32]
            case 6:
                return self._output(t) * self._saved[34]
            case 10:
                return float(t % unit.period < unit.busy)
            case 12:
                return unit.firmware
            case 18:
                return float(unit.model_number)
            case 20:
                return float(unit.serial_number)
        if register in self._saved:
            return self._saved[register]
        raise Refusal(ILLEGAL_ADDRESS)

    def _output(self, t: float) -> float:
        """Return the last measurement that has ended; before the first one, 0."""
        ended = math.floor(t / self.unit.period)
        if ended > self._measured[0]:
            begin, end = (ended - 1) * self.unit.period, ended * self.unit.period
            flux = self._flux(begin, end) + float(self._rng.normal(0.0, self.unit.noise)) if ended > 0 else 0.0
            if self._dazzled and ended > 0:
                self._dazzled, flux = False, math.inf
            self._measured = ended, min(flux, self.unit.full_scale)
        return self._measured[1]
