"""Simulated Micro-Epsilon optoNCDT 1420 laser triangulation sensor: ASCII commands, and a binary stream of distances.

Source: the project's protocol sheet, section 6.2. Not verified, so settable or said here: the word sent when there is no target, all error
numbers but E202, CR LF before the prompt, the layout of GETINFO and the texts of replies, which rates there are, which user may change
settings, and the echo of a command being the line that its answer begins with. Left out, and answered with E212: LANGUAGE, PRINT, PASSWD,
STDUSER, the trigger commands and MASTERMV.
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

LONGEST_COMMAND = 256
PROMPT = b"->"
RATES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""kHz (unverified)."""
RANGES = (10.0, 25.0, 50.0, 100.0, 200.0, 500.0)
"""mm."""

BATCH = 5e-3
"""Values go out together this often at most, s."""

_TEXTS = {
    202: "Access denied",
    210: "Unknown command",
    212: "Command not available in current context",
    214: "Entered command is too long to be processed",
    230: "Unknown parameter",
    232: "Wrong parameter count",
    236: "Value is out of range or the format is invalid",
}
_LEFT_OUT = "LANGUAGE PRINT PASSWD STDUSER TRIGGER TRIGGERAT MFILEVEL TRIGGERCOUNT TRIGGERSW MASTERMV".split(" ")  # noqa: SIM905
_KNOWN = "HELP GETINFO ECHO LOGIN LOGOUT GETUSERLEVEL OUTPUT MEASRATE RESET RESETCNT".split(" ")  # noqa: SIM905

Distance = Callable[[float, float], float | None]
"""Mean distance from the start of the measuring range, mm, between two simulated times, s; None without a target."""


class _Refused(Exception):
    """The number of an E reply."""


@dataclass(frozen=True)
class TriangulationModel:
    """What the sensor is like.

    Parameters
    ----------
    measuring_range : float
        mm, one of `RANGES`.
    noise : float
        rms of one value, mm.
    no_target : int
        Word sent without a target; any above 65520 (unverified).
    password : str
        Of the professional user.
    serial : str
        As GETINFO tells it.
    """

    measuring_range: float = 50.0
    noise: float = 0.004
    no_target: int = 262_077
    password: str = "000"
    serial: str = "00000001"

    def __post_init__(self) -> None:
        if self.measuring_range not in RANGES or self.noise < 0 or not 65_520 < self.no_target < 1 << 18:
            raise SimError(f"{self}: expected a range of {', '.join(map(str, RANGES))} mm, no negative noise, and 65520 < no_target < 2^18")


def packed(word: int) -> bytes:
    """Return an 18-bit word as the three bytes of the first value of a set."""
    return bytes((word & 0x3F, 0x40 | word >> 6 & 0x3F, 0x80 | word >> 12 & 0x3F))


class OptoNCDT:
    """A sensor that looks at `distance`.

    Parameters
    ----------
    clock : Clock
        Simulated time.
    distance : callable
        Mean distance from the start of the measuring range, mm, between two times; None without a target.
    rng : numpy.random.Generator
        Draws the noise.
    model : TriangulationModel
        What the unit is like.
    name : str
        Of the port.
    """

    model = "micro-epsilon-ild1420"
    troubles = ("over-range",)

    def __init__(
        self, clock: Clock, distance: Distance, rng: np.random.Generator, model: TriangulationModel | None = None, name: str = "range"
    ) -> None:
        self.name = name
        self.unit = model or TriangulationModel()
        self._clock, self._distance, self._rng = clock, distance, rng
        self.professional = True
        self._streaming = asyncio.Event()
        self._lost = 0
        self._power_up()

    def _power_up(self) -> None:
        self._echo, self._rate = True, 1.0
        self._switch("NONE")

    def _switch(self, output: str) -> None:
        self._output, self._begun = output, self._clock.now()
        if output == "RS422":
            self._streaming.set()
        else:
            self._streaming.clear()

    async def serve(self, line: Line) -> None:
        """Answer commands on `line` and stream values to it until the client has gone."""
        splitter = Splitter(LONGEST_COMMAND)
        stream = asyncio.create_task(self._stream(line))
        try:
            while data := await line.read():
                for message in splitter.feed(data):
                    await self._reply(line, self.answer(message))
                if splitter.overruns:
                    splitter.overruns = 0
                    await self._reply(line, _error(214))
        finally:
            stream.cancel()
            await asyncio.wait({stream})
            if not stream.cancelled():
                stream.result()  # whatever it failed of comes out here

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Have the next values, 1 to 50 of them, be the error word; see `sim.troubles`."""
        self._lost = int(rng.integers(1, 51))
        return f"the next {self._lost} values are errors"

    async def _reply(self, line: Line, text: str) -> None:
        line.write(text.encode("ascii") + (b"\r\n" if text else b"") + PROMPT)
        await line.drain()

    # Values

    async def _stream(self, line: Line) -> None:
        while True:
            await self._streaming.wait()
            begun = sent = self._begun
            while self._output == "RS422" and self._begun == begun:
                period = 1e-3 / self._rate
                await self._clock.sleep_until(sent + period * math.ceil(BATCH / period))
                if self._output != "RS422" or self._begun != begun:
                    break
                count = int((self._clock.now() - sent) / period + 1e-6)
                words = [self._word(sent + i * period, sent + (i + 1) * period) for i in range(count)]
                sent += count * period
                line.write(b"".join(map(packed, words)))
                await line.drain()

    def _word(self, begin: float, end: float) -> int:
        distance = self._distance(begin, end)
        if self._lost:
            self._lost -= 1
            return self.unit.no_target
        if distance is None:
            return self.unit.no_target
        relative = (distance + float(self._rng.normal(0.0, self.unit.noise))) / self.unit.measuring_range
        word = round((relative + 0.01) * 65_520 / 1.02)
        return word if 0 <= word <= 65_520 else self.unit.no_target

    # Commands

    def answer(self, message: bytes) -> str:
        """Carry out one command, without its end; return the lines before the prompt."""
        words = message.decode("latin-1").split()
        if not words:
            return ""
        try:
            name, arguments = words[0].upper(), words[1:]
            if name in _LEFT_OUT:
                raise _Refused(212)
            if name not in _KNOWN:
                raise _Refused(210)
            told: str = getattr(self, f"_do_{name.lower()}")(arguments)
        except _Refused as refused:
            return _error(refused.args[0])
        return told if self._echo or not arguments else ""

    def _do_help(self, arguments: list[str]) -> str:
        _count(arguments, 0)
        return "\r\n".join(["HELP", *_KNOWN])

    def _do_getinfo(self, arguments: list[str]) -> str:
        _count(arguments, 0)
        size = self.unit.measuring_range
        fields = {
            "Name": f"ILD1420-{size:g}",
            "Serial": self.unit.serial,
            "Option": "000",
            "Article": "0000000",
            "Cable head": "Wire",
            "Measuring range": f"{size:.2f}mm",
            "Version": "001.000",
            "Hardware-rev": "00",
            "Boot-version": "001.000",
        }
        return "\r\n".join(["GETINFO", *(f"{key + ':':<18}{value}" for key, value in fields.items())])

    def _do_echo(self, arguments: list[str]) -> str:
        if arguments:
            self._echo = _choice(arguments, "ON", "OFF") == "ON"
        return f"ECHO {'ON' if self._echo else 'OFF'}"

    def _do_login(self, arguments: list[str]) -> str:
        _count(arguments, 1)
        if arguments[0] != self.unit.password:
            raise _Refused(202)
        self.professional = True
        return "LOGIN"

    def _do_logout(self, arguments: list[str]) -> str:
        _count(arguments, 0)
        self.professional = False
        return "LOGOUT"

    def _do_getuserlevel(self, arguments: list[str]) -> str:
        _count(arguments, 0)
        return f"GETUSERLEVEL {'PROFESSIONAL' if self.professional else 'USER'}"

    def _do_output(self, arguments: list[str]) -> str:
        if arguments:
            output = _choice(arguments, "NONE", "RS422", "ANALOG")
            self._for_professionals()
            self._switch(output)
        return f"OUTPUT {self._output}"

    def _do_measrate(self, arguments: list[str]) -> str:
        if arguments:
            _count(arguments, 1)
            self._for_professionals()
            rates = [rate for rate in RATES if arguments[0] in (f"{rate:g}", f"{rate:.1f}", f"{rate:.2f}", f"{rate:.3f}")]
            if not rates:
                raise _Refused(236)
            self._rate = rates[0]
        return f"MEASRATE {self._rate:g}"

    def _do_reset(self, arguments: list[str]) -> str:
        _count(arguments, 0)
        self._power_up()
        return "RESET"

    def _do_resetcnt(self, arguments: list[str]) -> str:
        return "RESETCNT"

    def _for_professionals(self) -> None:
        if not self.professional:
            raise _Refused(202)


def _error(number: int) -> str:
    return f"E{number} {_TEXTS[number]}"


def _count(arguments: list[str], wanted: int) -> None:
    if len(arguments) != wanted:
        raise _Refused(232)


def _choice(arguments: list[str], *choices: str) -> str:
    _count(arguments, 1)
    if arguments[0].upper() not in choices:
        raise _Refused(230)
    return arguments[0].upper()
