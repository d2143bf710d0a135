"""Simulated Konica Minolta LS-100, LS-110 and CS-100A luminance meters in remote mode.

Source: the project's protocol sheet, section 5.2. Not verified, so settable or said here: the measuring range, the two integration times
and how long a measurement takes until it is told, the number of digits, the luminance meters' ER10 where the colour meter says OK12, OK13
or OK11, the empty field behind those three, the range of chromaticity, what a command longer than any of the meter's own gives (ER00), and
that difference readings need a target (ER01), since no target can be stored here. Left out, and answered with ER00: RCR, TDR, UCR, TDS,
TDW and UCW, whose fields the sheet does not give.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.clock import Clock
from sim.errors import SimError
from sim.wire import Line, Splitter

LONGEST_COMMAND = 64
TERMINATOR = b"\r\n"

Signal = Callable[[float, float], float]
"""Mean luminance, cd/m^2, between two simulated times, s."""
Chroma = Callable[[float, float], tuple[float, float]]
"""Mean chromaticity x, y between two simulated times, s."""


@dataclass(frozen=True)
class PhotometerModel:
    """What the meter is like.

    Parameters
    ----------
    colour : bool
        A CS-100A, which tells x and y as well.
    lowest, highest : float
        Measuring range, cd/m^2.
    fast, slow : float
        Integration time of the two responses, s.
    overhead : float
        From the end of the integration to the reply, s.
    noise : float
        rms of a reading at the fast response, as a fraction.
    varied : float
        Calibration factor in use after `MDS,01`.
    """

    colour: bool = False
    lowest: float = 0.001
    highest: float = 299_900.0
    fast: float = 0.1
    slow: float = 0.4
    overhead: float = 0.8
    noise: float = 5e-4
    varied: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.lowest < self.highest or not 0 < self.fast < self.slow or self.overhead < 0 or self.noise < 0 or self.varied <= 0:
            raise SimError(f"{self}: expected lowest below highest, fast below slow, and nothing negative")


def _daylight(begin: float, end: float) -> tuple[float, float]:
    return 0.3127, 0.3290


class Photometer:
    """A meter that looks at `signal`.

    `battery_low`, `eeprom_fault` and `remote` can be set while it runs: out of remote mode it is silent.

    Parameters
    ----------
    clock : Clock
        Simulated time.
    signal : callable
        Mean luminance, cd/m^2, between two times.
    rng : numpy.random.Generator
        Draws the noise.
    model : PhotometerModel
        What the unit is like.
    chroma : callable
        Mean chromaticity between two times; daylight if not given.
    name : str
        Of the port.
    """

    troubles = ("alarm", "over-range")

    def __init__(
        self,
        clock: Clock,
        signal: Signal,
        rng: np.random.Generator,
        model: PhotometerModel | None = None,
        *,
        chroma: Chroma = _daylight,
        name: str = "photometer",
    ) -> None:
        self.name = name
        self.unit = model or PhotometerModel()
        self.model = "konica-minolta-cs-100a" if self.unit.colour else "konica-minolta-ls-100"
        self.remote = True
        self._dazzled = False
        self.battery_low = self.eeprom_fault = False
        self._clock, self._signal, self._chroma, self._rng = clock, signal, chroma, rng
        self._varied = self._fast = False
        self._peak: float | None = None
        self._turn = asyncio.Lock()

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Run the battery down, until `battery_low` is put back, or have the next measurement go over; see `sim.troubles`."""
        if kind == "alarm":
            self.battery_low = True
            return "the battery is low"
        self._dazzled = True
        return "the next measurement goes over"

    async def serve(self, line: Line) -> None:
        """Answer commands on `line`, one after another, until the client has gone."""
        splitter = Splitter(LONGEST_COMMAND)
        while data := await line.read():
            for message in splitter.feed(data):
                await self._reply(line, message)
            if splitter.overruns:
                splitter.overruns = 0
                await self._reply(line, b"")

    async def _reply(self, line: Line, message: bytes) -> None:
        if not self.remote:
            return
        async with self._turn:
            answer = await self.answer(message)
        line.write(answer + TERMINATOR)
        await line.drain()

    async def answer(self, message: bytes) -> bytes:
        """Carry out one command, without its terminator, and return the reply without its own."""
        if self.battery_low:
            return b"ER30"
        if self.eeprom_fault:
            return b"ER20"
        command, comma, data = message.strip().partition(b",")
        if command == b"MDS":
            return self._set(data)
        if comma or command not in (b"MES", b"CLE"):
            return b"ER00"
        return b"OK00" if command == b"CLE" else await self._measure()

    def _set(self, mode: bytes) -> bytes:
        if mode in (b"00", b"01"):
            self._varied = mode == b"01"
        elif mode in (b"06", b"07"):
            self._fast = mode == b"06"
        elif mode in (b"08", b"09"):
            self._peak = 0.0 if mode == b"08" else None
        elif mode != b"04":
            return b"ER01"
        return b"OK00"

    async def _measure(self) -> bytes:
        unit, begin = self.unit, self._clock.now()
        end = begin + (unit.fast if self._fast else unit.slow)
        await self._clock.sleep_until(end + unit.overhead)
        spread = unit.noise * math.sqrt(unit.fast / (end - begin))
        luminance = self._signal(begin, end) * (1 + float(self._rng.normal(0.0, spread))) * (unit.varied if self._varied else 1.0)
        if self._peak is not None:
            self._peak = luminance = max(self._peak, luminance)
        if self._dazzled:
            self._dazzled, luminance = False, math.inf
        if not unit.colour:
            return b"ER10" if luminance > unit.highest else f"OK00,{_digits(max(luminance, 0.0)):>8}".encode("ascii")
        if luminance > unit.highest:
            return b"OK12,,,"
        if luminance < unit.lowest:
            return b"OK13,,,"
        x, y = self._chroma(begin, end)
        if not (0 < x < 1 and 0 < y < 1 and x + y <= 1):
            return f"OK11,{_digits(luminance):>7},,".encode("ascii")
        return f"OK00,{_digits(luminance):>7},{_fraction(x)},{_fraction(y)}".encode("ascii")


def _digits(luminance: float) -> str:
    """Write four digits, and three decimals at most."""
    decimals = next((3 - power for power in range(3) if luminance < 9.9995 * 10**power), 0)
    return f"{luminance:.{decimals}f}"


def _fraction(value: float) -> str:
    return f"{min(value, 0.9999):.4f}".removeprefix("0")
