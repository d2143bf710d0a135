"""Simulated Keithley 6485 picoammeter: its SCPI commands over RS-232.

Source: Keithley 6485 manual, as condensed in the project's protocol sheet, section 5.1, and SCPI-99 for what SCPI leaves no choice in. Not
verified, so settable or said here: the line frequency of the unit and its reply terminator, zero check on after `*RST`, zero correction
acquired only under zero check and from the last reading, one input offset for all ranges, the written form of numbers in replies, the
status bits (those of the 6487), and that the rest of a message is dropped after an error. Left out: the reading buffer (`TRACe`), limits
and math (`CALCulate`), status registers other than the standard event register, the median filter, trigger sources other than immediate.
"""

from __future__ import annotations

import asyncio
import inspect
import math
import re
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from sim.clock import Clock
from sim.errors import SimError
from sim.wire import Line, Splitter

RANGES = tuple(2.0 * 10.0**decade for decade in range(-9, -1))
"""Full scales, A: 2 nA to 20 mA."""
OVERRANGE = 1.05
"""A reading may be this much of the full scale; above, the meter ranges up or reports an overflow."""
OVERFLOW = 9.9e37
COUNTS = 2e6
"""Steps of the transmitted reading per full scale."""
NOISE = 5e-6
"""Noise of the meter at one power-line cycle, rms as a fraction of full scale (10 fA on 2 nA)."""
LONGEST_MESSAGE = 2048
ABORT = re.compile(rb"[\x03\x18]")
ELEMENTS = ("READ", "UNIT", "TIME", "STAT")

_TERMINATORS = {"LF": b"\n", "CR": b"\r", "CRLF": b"\r\n", "LFCR": b"\n\r"}
_TEXTS = {
    -101: "Invalid character",
    -102: "Syntax error",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -221: "Settings conflict",
    -222: "Parameter data out of range",
    -224: "Illegal parameter value",
    -230: "Data corrupt or stale",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
}
_UNIT = re.compile(r"(?P<root>:?)(?P<header>\*?[A-Za-z][\w:]*)(?P<query>\??)(?:\s+(?P<data>.*))?", re.DOTALL)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(E[+-]?\d{1,3})?", re.IGNORECASE | re.ASCII)

_T = TypeVar("_T")

Signal = Callable[[float, float], float]
"""Mean input current, A, between two simulated times, s."""


class _ScpiError(Exception):
    """A command that ends in the error queue."""

    def __init__(self, code: int) -> None:
        super().__init__(code, _TEXTS[code])
        self.code = code


@dataclass
class _State:
    """What `*RST` puts back."""

    cycles: float
    zero_check: bool = True
    zero_correct: bool = False
    full_scale: float = RANGES[-1]
    auto: bool = True
    highest: float = RANGES[-1]
    lowest: float = RANGES[0]
    filter: bool = False
    filter_count: float = 10
    filter_control: str = "MOV"
    elements: tuple[str, ...] = ELEMENTS
    triggers: float = 1
    arms: float = 1
    trigger_source: str = "IMM"
    arm_source: str = "IMM"
    trigger_delay: float = 0.0
    display: bool = True
    autozero: bool = True


@dataclass(frozen=True)
class _Reading:
    value: float
    time: float
    status: int


@dataclass(frozen=True)
class _Entry:
    """One header: a pattern in the manuals' spelling (capitals are the short form, brackets optional) and what asks and tells it."""

    pattern: str
    ask: Callable[[str], str | Awaitable[str]] | None = None
    tell: Callable[[str], Awaitable[None] | None] | None = None
    matcher: re.Pattern[str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "matcher", re.compile(_spelling(self.pattern), re.IGNORECASE | re.ASCII))


def _spelling(pattern: str) -> str:
    """Turn `[SENSe[1]:]CURRent[:DC]` into a regular expression that takes each mnemonic in its short or its long form."""

    def mnemonic(found: re.Match[str]) -> str:
        word = found.group()
        short = "".join(letter for letter in word if not letter.islower())
        return f"(?:{short}|{word.upper()})" if word != short else word

    escaped = pattern.replace("*", r"\*").replace("[", "(?:").replace("]", ")?")
    return re.sub(r"[A-Z][A-Za-z]*", mnemonic, escaped)


@dataclass(frozen=True)
class MeterModel:
    """What the picoammeter is like.

    Parameters
    ----------
    line_frequency : float
        Hz; the integration time is power-line cycles over this.
    terminator : str
        Of replies: LF, CR, CRLF or LFCR, a menu setting of the instrument. Messages may end in any of them.
    offset : float or None
        Input offset, A, that zero correction removes; None draws one within 0.5 pA.
    identity : str
        Answer to `*IDN?`.
    """

    line_frequency: float = 60.0
    terminator: str = "LF"
    offset: float | None = None
    identity: str = "KEITHLEY INSTRUMENTS INC.,MODEL 6485,0000000,SIMULATED"

    def __post_init__(self) -> None:
        if self.terminator not in _TERMINATORS:
            raise SimError(f"meter terminator {self.terminator!r}: expected one of {', '.join(_TERMINATORS)}")
        if self.line_frequency not in (50.0, 60.0):
            raise SimError(f"meter line frequency {self.line_frequency} Hz: expected 50 or 60")


class Keithley6485:
    """A picoammeter that reads `signal`.

    Parameters
    ----------
    clock : Clock
        Simulated time; the instrument is switched on when it is made.
    signal : callable
        Mean input current, A, between two times.
    rng : numpy.random.Generator
        Draws the meter's own noise and its offset.
    model : MeterModel
        What the unit is like.
    name : str
        Of the port.
    """

    model = "keithley-6485"
    troubles = ("over-range",)

    def __init__(
        self, clock: Clock, signal: Signal, rng: np.random.Generator, model: MeterModel | None = None, name: str = "meter"
    ) -> None:
        self.name = name
        self.meter = model or MeterModel()
        self._clock, self._signal, self._rng = clock, signal, rng
        self.offset = float(rng.uniform(-0.5e-12, 0.5e-12)) if self.meter.offset is None else self.meter.offset
        self._power_on = self._converted = clock.now()
        self._line_frequency = self.meter.line_frequency
        self._state = self._defaults()
        self._correction = 0.0
        self._filtered: deque[float] = deque(maxlen=100)
        self._readings: tuple[_Reading, ...] = ()
        self._dazzled = False
        self._errors: deque[int] = deque()
        self._events = 0x80  # power on
        self._masks = {"*ESE": 0, "*SRE": 0}
        self._turn = asyncio.Lock()
        self._entries = self._commands()

    # Wire

    async def serve(self, line: Line) -> None:
        """Answer messages on `line`, one after another, until the client has gone; ^C and ^X abort what is pending."""
        splitter = Splitter(LONGEST_MESSAGE)
        waiting: asyncio.Queue[bytes] = asyncio.Queue(1000)
        worker = asyncio.create_task(self._work(waiting, line))
        try:
            while (data := await line.read()) and not worker.done():
                for i, piece in enumerate(ABORT.split(data)):
                    if i > 0:
                        splitter.clear()
                        worker.cancel()
                        _drop_queries(waiting)
                        worker = asyncio.create_task(self._work(waiting, line))
                    overruns = splitter.overruns
                    for message in splitter.feed(piece):
                        if waiting.full():
                            self._fail(-363)
                        else:
                            waiting.put_nowait(message)
                    if splitter.overruns > overruns:
                        self._fail(-363)
        finally:
            worker.cancel()
            await asyncio.wait({worker})
            if not worker.cancelled():
                worker.result()  # whatever it failed of comes out here

    async def _work(self, waiting: asyncio.Queue[bytes], line: Line) -> None:
        while True:
            message = await waiting.get()
            async with self._turn:
                answer = await self.answer(message)
            if answer is not None:
                line.write(answer + _TERMINATORS[self.meter.terminator])
                await line.drain()

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Have the next reading of the input overflow, on whatever range; see `sim.troubles`."""
        self._dazzled = True
        return "the next reading of the input overflows"

    # Language

    async def answer(self, message: bytes) -> bytes | None:
        """Carry out one message, without its terminator; return the replies of its queries joined by `;`, or None if there are none."""
        replies: list[str] = []
        try:
            if any(not (32 <= byte < 127 or byte == 9) for byte in message):
                raise _ScpiError(-101)
            path = ""
            for unit in re.findall(r"(?:\"[^\"]*\"|'[^']*'|[^;])+", message.decode("ascii")):
                if not unit.strip():
                    continue
                parts = _UNIT.fullmatch(unit.strip())
                if parts is None:
                    raise _ScpiError(-102)
                header = parts["header"]
                if not header.startswith("*"):
                    header = header if parts["root"] else path + header
                    path = header[: header.rfind(":") + 1]
                reply = await self._unit(header, bool(parts["query"]), (parts["data"] or "").strip())
                if reply is not None:
                    replies.append(reply)
        except _ScpiError as error:
            self._fail(error.code)
        return ";".join(replies).encode("ascii") if replies else None

    async def _unit(self, header: str, query: bool, data: str) -> str | None:
        for entry in self._entries:
            handler = entry.ask if query else entry.tell
            if handler is not None and entry.matcher.fullmatch(header):
                result = handler(data)
                return await result if inspect.isawaitable(result) else result
        raise _ScpiError(-113)

    def _fail(self, code: int) -> None:
        if len(self._errors) < 10:
            self._errors.append(code)
        else:
            self._errors[-1] = -350
        self._events |= 0x20 if code > -200 else 0x10 if code > -300 else 0x08

    def _commands(self) -> tuple[_Entry, ...]:
        """Return every header the instrument knows. Source: 6485 manual, SCPI reference tables."""
        sense, current, layer = "[SENSe[1]:]", "CURRent[:DC]", "[:SEQuence[1]]"
        full = OVERRANGE * RANGES[-1]
        longest = 60.0 if self.meter.line_frequency == 60 else 50.0
        return (
            _Entry("*IDN", ask=_plain(lambda: self.meter.identity)),
            _Entry("*RST", tell=_plain(self._reset)),
            _Entry("*CLS", tell=_plain(self._clear)),
            _Entry("*OPC", ask=_plain(lambda: "1"), tell=_plain(self._complete)),
            _Entry("*ESR", ask=_plain(self._event_register)),
            _Entry("*STB", ask=_plain(lambda: str(4 * bool(self._errors)))),
            self._mask("*ESE"),
            self._mask("*SRE"),
            _Entry("*TST", ask=_plain(lambda: "0")),
            _Entry("*WAI", tell=_plain(lambda: None)),
            _Entry("SYSTem:PRESet", tell=_plain(self._reset)),
            _Entry("SYSTem:VERSion", ask=_plain(lambda: "1996.0")),
            _Entry("SYSTem:ERRor[:NEXT]", ask=_plain(self._next_error)),
            _Entry("SYSTem:ERRor:ALL", ask=_plain(self._all_errors)),
            _Entry("SYSTem:ERRor:COUNt", ask=_plain(lambda: str(len(self._errors)))),
            _Entry("SYSTem:ERRor:CODE[:NEXT]", ask=_plain(lambda: self._next_error().partition(",")[0])),
            _Entry("SYSTem:ERRor:CODE:ALL", ask=_plain(self._all_codes)),
            _Entry("SYSTem:CLEar", tell=_plain(self._errors.clear)),
            _Entry("STATus:QUEue[:NEXT]", ask=_plain(self._next_error)),
            _Entry("STATus:QUEue:CLEar", tell=_plain(self._errors.clear)),
            _Entry("STATus:PRESet", tell=_plain(lambda: None)),
            _Entry("SYSTem:LFRequency", ask=_plain(lambda: f"{self._line_frequency:.0f}"), tell=self._set_line_frequency),
            _Entry("SYSTem:TIME:RESet", tell=_plain(self._reset_time)),
            _Entry("SYSTem:REMote", tell=_plain(lambda: None)),
            _Entry("SYSTem:LOCal", tell=_plain(lambda: None)),
            _Entry("SYSTem:RWLock", tell=_plain(lambda: None)),
            self._flag("SYSTem:AZERo[:STATe]", "autozero"),
            self._flag("SYSTem:ZCHeck[:STATe]", "zero_check"),
            self._flag("SYSTem:ZCORrect[:STATe]", "zero_correct"),
            _Entry("SYSTem:ZCORrect:ACQuire", tell=_plain(self._acquire_zero)),
            self._flag("DISPlay:ENABle", "display"),
            _Entry(f"{sense}FUNCtion", ask=_plain(lambda: '"CURR:DC"'), tell=self._set_function),
            self._number(f"{sense}{current}:NPLCycles", "cycles", 0.01, longest, self._defaults().cycles),
            _Entry(f"{sense}{current}:RANGe[:UPPer]", ask=self._ask_range, tell=self._set_range),
            self._flag(f"{sense}{current}:RANGe[:UPPer]:AUTO", "auto"),
            self._number(f"{sense}{current}:RANGe[:UPPer]:AUTO:ULIMit", "highest", 0.0, full, RANGES[-1], _range_for),
            self._number(f"{sense}{current}:RANGe[:UPPer]:AUTO:LLIMit", "lowest", 0.0, full, RANGES[0], _range_for),
            self._flag(f"{sense}AVERage[:STATe]", "filter", self._filtered.clear),
            self._number(f"{sense}AVERage:COUNt", "filter_count", 2, 100, 10, round, self._filtered.clear),
            self._choice(f"{sense}AVERage:TCONtrol", "filter_control", ("MOVing", "REPeat"), self._filtered.clear),
            _Entry("FORMat[:DATA]", ask=_plain(lambda: "ASC"), tell=self._set_format),
            _Entry("FORMat:ELEMents", ask=_plain(lambda: ",".join(self._state.elements)), tell=self._set_elements),
            self._number(f"TRIGger{layer}:COUNt", "triggers", 1, 2500, 1, round),
            self._choice(f"TRIGger{layer}:SOURce", "trigger_source", ("IMMediate",)),
            self._number(f"TRIGger{layer}:DELay", "trigger_delay", 0.0, 999.9998, 0.0),
            self._number(f"ARM{layer}[:LAYer[1]]:COUNt", "arms", 1, 2500, 1, round),
            self._choice(f"ARM{layer}[:LAYer[1]]:SOURce", "arm_source", ("IMMediate",)),
            _Entry("CONFigure", ask=_plain(lambda: '"CURR:DC"')),
            _Entry(f"CONFigure:{current}", tell=_plain(self._configure)),
            _Entry("INITiate[:IMMediate]", tell=self._initiate),
            _Entry("ABORt", tell=_plain(lambda: None)),
            _Entry("READ", ask=self._read),
            _Entry("FETCh", ask=_plain(self._fetch)),
            _Entry(f"{sense}DATA[:LATest]", ask=_plain(self._latest)),
            _Entry(f"MEASure[:{current}]", ask=self._measure),
        )

    def _flag(self, pattern: str, name: str, after: Callable[[], None] = lambda: None) -> _Entry:
        def tell(data: str) -> None:
            setattr(self._state, name, _boolean(data))
            after()

        return _Entry(pattern, ask=_plain(lambda: str(int(getattr(self._state, name)))), tell=tell)

    def _number(
        self,
        pattern: str,
        name: str,
        low: float,
        high: float,
        default: float,
        form: Callable[[float], float] = float,
        after: Callable[[], None] = lambda: None,
    ) -> _Entry:
        named = {"MIN": low, "MINIMUM": low, "MAX": high, "MAXIMUM": high, "DEF": default, "DEFAULT": default}

        def ask(data: str) -> str:
            if data and data.upper() not in named:
                raise _ScpiError(-224)
            value = named[data.upper()] if data else getattr(self._state, name)
            return f"{value:d}" if isinstance(value, int) else f"{value:+.6E}"

        def tell(data: str) -> None:
            number = named[data.upper()] if data.upper() in named else _numeric(data)
            if not low <= number <= high:
                raise _ScpiError(-222)
            setattr(self._state, name, form(number))
            after()

        return _Entry(pattern, ask, tell)

    def _choice(self, pattern: str, name: str, choices: Sequence[str], after: Callable[[], None] = lambda: None) -> _Entry:
        def tell(data: str) -> None:
            _needed(data)
            for choice in choices:
                if re.fullmatch(_spelling(choice), data, re.IGNORECASE):
                    setattr(self._state, name, "".join(letter for letter in choice if letter.isupper()))
                    after()
                    return
            raise _ScpiError(-224)

        return _Entry(pattern, ask=_plain(lambda: str(getattr(self._state, name))), tell=tell)

    def _mask(self, header: str) -> _Entry:
        def tell(data: str) -> None:
            number = _numeric(data)
            if not 0 <= number <= 255:
                raise _ScpiError(-222)
            self._masks[header] = round(number)

        return _Entry(header, ask=_plain(lambda: str(self._masks[header])), tell=tell)

    # System

    def _defaults(self) -> _State:
        return _State(cycles=6.0 if self.meter.line_frequency == 60 else 5.0)

    def _reset(self) -> None:
        self._state = self._defaults()
        self._filtered.clear()
        self._readings = ()

    def _clear(self) -> None:
        self._errors.clear()
        self._events = 0

    def _complete(self) -> None:
        self._events |= 1

    def _event_register(self) -> str:
        events, self._events = self._events, 0
        return str(events)

    def _next_error(self) -> str:
        return _error_text(self._errors.popleft() if self._errors else 0)

    def _all_errors(self) -> str:
        errors = [_error_text(code) for code in self._errors or (0,)]
        self._errors.clear()
        return ",".join(errors)

    def _all_codes(self) -> str:
        codes = [str(code) for code in self._errors or (0,)]
        self._errors.clear()
        return ",".join(codes)

    def _set_line_frequency(self, data: str) -> None:
        if _numeric(data) not in (50.0, 60.0):
            raise _ScpiError(-222)
        self._line_frequency = _numeric(data)

    def _reset_time(self) -> None:
        self._power_on = self._clock.now()

    # Settings

    def _set_function(self, data: str) -> None:
        _needed(data)
        if not re.fullmatch(r"""(["'])CURR(ENT)?(:DC)?\1""", data, re.IGNORECASE):
            raise _ScpiError(-224)

    def _configure(self) -> None:
        """Back to single automatic-range readings; zero check and zero correction stay as they are."""
        defaults = self._defaults()
        ranging, triggering = ("full_scale", "auto", "highest", "lowest", "filter"), ("triggers", "arms", "trigger_delay")
        for name in (*ranging, *triggering):
            setattr(self._state, name, getattr(defaults, name))
        self._filtered.clear()

    def _ask_range(self, data: str) -> str:
        named = {"": self._state.full_scale, "MIN": RANGES[0], "MAX": RANGES[-1], "DEF": RANGES[-1]}
        if data.upper() not in named:
            raise _ScpiError(-224)
        return f"{named[data.upper()]:.6E}"

    def _set_range(self, data: str) -> None:
        """Take the smallest range that holds the expected reading; this turns automatic ranging off."""
        named = {"MIN": RANGES[0], "MAX": RANGES[-1], "DEF": RANGES[-1]}
        wanted = named[data.upper()] if data.upper() in named else abs(_numeric(data))
        if wanted > OVERRANGE * RANGES[-1]:
            raise _ScpiError(-222)
        self._change_range(_range_for(wanted))
        self._state.auto = False

    def _change_range(self, full_scale: float) -> None:
        if full_scale != self._state.full_scale:
            self._state.full_scale = full_scale
            self._filtered.clear()

    def _set_format(self, data: str) -> None:
        _needed(data)
        if data.upper() not in ("ASC", "ASCII"):  # RS-232 carries nothing else
            raise _ScpiError(-224)

    def _set_elements(self, data: str) -> None:
        _needed(data)
        spellings = {"READ": "READing", "UNIT": "UNIT[s]", "TIME": "TIME", "STAT": "STATus"}
        chosen = set()
        for word in data.split(","):
            if word.strip().upper() in ("DEF", "DEFAULT", "ALL"):
                chosen |= set(ELEMENTS)
                continue
            known = [name for name in ELEMENTS if re.fullmatch(_spelling(spellings[name]), word.strip(), re.IGNORECASE)]
            if not known:
                raise _ScpiError(-224)
            chosen |= set(known)
        self._state.elements = tuple(name for name in ELEMENTS if name in chosen)

    # Readings

    def _acquire_zero(self) -> None:
        """Take the last reading, made under zero check, as the zero of all readings to come."""
        last = self._readings[-1] if self._readings else None
        if not self._state.zero_check or last is None or not last.status & 1 << 9 or last.status & 1:
            raise _ScpiError(-221)
        self._correction = last.value + (self._correction if last.status & 1 << 10 else 0.0)

    async def _convert(self) -> float:
        """Integrate once, on the present range; infinite for an overflow."""
        state = self._state
        duration = state.cycles / self._line_frequency
        begin = self._clock.now()
        self._converted = begin + duration  # not when the sleep ends: a busy computer is late, an instrument is not
        await self._clock.sleep_until(self._converted)
        current = self.offset + (0.0 if state.zero_check else self._signal(begin, begin + duration))
        current += self._rng.normal(0.0, NOISE * state.full_scale / math.sqrt(state.cycles))
        if abs(current) > OVERRANGE * state.full_scale:
            return math.inf
        step = state.full_scale / COUNTS
        return round(current / step) * step

    async def _ranged(self) -> float:
        """Convert, and again a decade up or down as long as automatic ranging asks for it, one way only."""
        value, way = await self._convert(), 0
        while self._state.auto:
            full = self._state.full_scale
            if value == math.inf and full < self._state.highest and way >= 0:
                way = 1
            elif abs(value) < full / 10 and full > self._state.lowest and way <= 0:
                way = -1
            else:
                break
            self._change_range(RANGES[RANGES.index(full) + way])
            value = await self._convert()
        return value

    async def _one_reading(self) -> _Reading:
        state = self._state
        await self._clock.sleep(state.trigger_delay)
        value = await self._ranged()
        if self._dazzled and not state.zero_check:
            self._dazzled, value = False, math.inf
        if state.filter and value != math.inf:
            if state.filter_control == "REP":
                self._filtered.clear()
                while value != math.inf and len(self._filtered) + 1 < state.filter_count:
                    self._filtered.append(value)
                    value = await self._ranged()
            self._filtered.append(value)
            recent = list(self._filtered)[-round(state.filter_count) :]
            value = math.fsum(recent) / len(recent)
        status = 1 << 1 if state.filter else 0
        status |= 1 << 9 if state.zero_check else 0
        status |= 1 << 10 if state.zero_correct else 0
        time = (self._converted - self._power_on) % 99_999.99
        if value == math.inf:
            return _Reading(OVERFLOW, time, status | 1)
        return _Reading(value - (self._correction if state.zero_correct else 0.0), time, status)

    async def _take(self) -> None:
        readings: list[_Reading] = []
        for _ in range(round(self._state.arms * self._state.triggers)):
            readings.append(await self._one_reading())
        self._readings = tuple(readings)

    async def _initiate(self, data: str) -> None:
        _unwanted(data)
        await self._take()

    async def _read(self, data: str) -> str:
        _unwanted(data)
        await self._take()
        return self._fetch()

    async def _measure(self, data: str) -> str:
        _unwanted(data)
        self._configure()
        await self._take()
        return self._fetch()

    def _fetch(self) -> str:
        if not self._readings:
            raise _ScpiError(-230)
        return ",".join(self._written(reading) for reading in self._readings)

    def _latest(self) -> str:
        if not self._readings:
            raise _ScpiError(-230)
        return self._written(self._readings[-1])

    def _written(self, reading: _Reading) -> str:
        elements = self._state.elements
        fields = {
            "READ": f"{reading.value:+.6E}" + ("A" if "UNIT" in elements else ""),
            "TIME": f"{reading.time:+.6E}",
            "STAT": f"{reading.status:+.6E}",
        }
        return ",".join(text for name, text in fields.items() if name in elements)


def _drop_queries(waiting: asyncio.Queue[bytes]) -> None:
    kept = [message for message in (waiting.get_nowait() for _ in range(waiting.qsize())) if b"?" not in message]
    for message in kept:
        waiting.put_nowait(message)


def _range_for(current: float) -> float:
    return next(full for full in RANGES if current <= OVERRANGE * full)


def _error_text(code: int) -> str:
    return f'{code},"{_TEXTS[code] if code else "No error"}"'


def _plain(handler: Callable[[], _T]) -> Callable[[str], _T]:
    """Make a handler of one that takes no data."""

    def handle(data: str) -> _T:
        _unwanted(data)
        return handler()

    return handle


def _unwanted(data: str) -> None:
    if data:
        raise _ScpiError(-108)


def _needed(data: str) -> None:
    if not data:
        raise _ScpiError(-109)


def _numeric(data: str) -> float:
    _needed(data)
    if not _NUMBER.fullmatch(data):
        raise _ScpiError(-104)
    return float(data)


def _boolean(data: str) -> bool:
    return data.upper() == "ON" if data.upper() in ("ON", "OFF") else _numeric(data) != 0
