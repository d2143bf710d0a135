"""Keithley 6485 picoammeter, reading the current of a photodiode, over RS-232 and SCPI.

Source: Keithley 6485 and 6487 instruction manuals. SCPI has neither ids nor checksums: replies are told apart by their shape,
and after a missing or malformed one the instrument is asked for its name, and everything before that name is dropped.

Not verified on a 6485: baud rate and terminator as delivered (settings of the link), the meaning of the status bits (the
6487's table: `StatusBits`), and the time a reading takes beyond its integration (allowed for generously).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeVar

from drivers.doubt import Doubt
from drivers.endpoint import Endpoint
from drivers.errors import DeviceFault, InvalidSetting, UnexpectedReply
from drivers.kinds import Identity, LightReading
from drivers.link import Link

T = TypeVar("T")

RANGES_A = (2e-9, 2e-8, 2e-7, 2e-6, 2e-5, 2e-4, 2e-3, 2e-2)
"""Full scales, 2 nA to 20 mA."""

OVERFLOW = 9.9e37
NOT_A_NUMBER = 9.91e37

_LARGEST_CURRENT_A = 1.0  # beyond any range, so that a garbled exponent is noticed
_MODELS = ("MODEL 6485", "MODEL 6487")
_CONVERSIONS_PER_READING = 3  # autozero adds a zero and a reference to each; unverified, hence only in time allowances
_RESET_INTEGRATION_S = 0.12  # 6 cycles at 50 Hz, what *RST leaves; a time allowance only
_NO_ERROR = '0,"No error"'
_OLD_ERRORS = 32  # more than the error queue holds

_NUMBER = r"[+-]\d\.\d{6}E[+-]\d\d"  # always that long: a byte lost or doubled shows
_NO_VALUE = r"[+-]9\.91?E\+?37"  # as the manual writes them
_READING = re.compile(rf"({_NUMBER}|{_NO_VALUE})([A-Za-z]+),({_NUMBER}),({_NUMBER})", re.ASCII)
_ERROR = re.compile(r'([+-]?\d+)(?:,\s*"?([^"]*)"?)?', re.ASCII)


@dataclass(frozen=True)
class StatusBits:
    """Which bit of the status word means what; -1 for a bit that should be ignored.

    The defaults are the 6487's table. Unverified for the 6485: an example reading in the manual has bit 7 set beside a plain
    value, so over-voltage is named in the reading's flags but does not make it over range.
    """

    overflow: int = 0
    filter: int = 1
    math: int = 2
    null: int = 3
    limit_test: int = 4
    over_voltage: int = 7
    zero_check: int = 9
    zero_correct: int = 10

    def names(self, status: int) -> tuple[str, ...]:
        """Names of the bits that are set."""
        bits = ((field.name, getattr(self, field.name)) for field in fields(self))
        return tuple(name for name, bit in bits if bit >= 0 and status >> bit & 1)


def parse_reading(line: bytes, bits: StatusBits = StatusBits()) -> LightReading:
    """Take apart a reading with the elements READ, UNIT, TIME, STAT, such as ``+1.040564E-06A,+2.236299E+02,+0.000000E+00``.

    Returns
    -------
    LightReading
        In A; the time is in s since power-on and wraps at 99 999.99. Overflow (9.9E37, or its status bit) gives an infinite
        value flagged ``over_range``.

    Raises
    ------
    UnexpectedReply
        Not such a line, another unit, or a current that no picoammeter can read.
    DeviceFault
        The instrument says not-a-number (9.91E37), or its zero check is on: the input is not connected.
    """
    expected = "a reading like +1.040564E-06A,+2.236299E+02,+0.000000E+00"
    match = _READING.fullmatch(line.decode("ascii", "replace").strip())
    if match is None:
        raise UnexpectedReply("not a reading", raw=line, expected=expected)
    value, unit, time_s, status_value = float(match[1]), match[2], float(match[3]), float(match[4])
    if unit != "A":
        raise UnexpectedReply(f"unit {unit!r}", raw=line, expected="a current in A")
    if not (status_value.is_integer() and 0 <= status_value < 2**24):
        raise UnexpectedReply(f"status word {match[4]}", raw=line, expected="a whole number of at most 24 bits")
    if not (math.isfinite(time_s) and time_s >= 0):
        raise UnexpectedReply(f"time {match[3]}", raw=line, expected="seconds since power-on")
    status = int(status_value)
    flags = bits.names(status)
    if "zero_check" in flags:
        raise DeviceFault("zero check is on, so the photodiode is disconnected", raw=line, hint="configure the meter again")
    if abs(value) == NOT_A_NUMBER:
        raise DeviceFault("the meter says not-a-number", raw=line, hint="check math functions and settings at the front panel")
    over_range = abs(value) == OVERFLOW or "overflow" in flags
    if not over_range and not abs(value) <= _LARGEST_CURRENT_A:
        raise UnexpectedReply(f"a current of {match[1]} A", raw=line, expected=f"at most {_LARGEST_CURRENT_A:g} A")
    return LightReading(
        value=math.copysign(math.inf, value) if over_range else value,
        unit="A",
        status=status,
        over_range=over_range,
        device_time_s=time_s,
        flags=flags,
    )


def parse_identity(line: bytes) -> Identity:
    """Take apart the answer to ``*IDN?``.

    Raises
    ------
    UnexpectedReply
        Not four fields, or not a 6485 or 6487.
    """
    parts = [part.strip() for part in line.decode("ascii", "replace").split(",", 3)]
    if not line.isascii() or len(parts) != 4 or parts[1] not in _MODELS:
        raise UnexpectedReply("another instrument", raw=line, expected=" or ".join(_MODELS), hint="check which port the meter is on")
    vendor, model, serial_number, firmware = parts
    return Identity(vendor=vendor, model=model.removeprefix("MODEL "), serial_number=serial_number, firmware=firmware)


class Keithley6485:
    """The picoammeter as a light sensor; satisfies `drivers.kinds.LightSensor`. It needs a link of its own.

    `Keithley6485.open` sets the meter up; the bare constructor sends nothing.

    Parameters
    ----------
    link : Link
        Its terminator must be the one chosen in the meter's menu, and is used both ways. Stays the caller's to close.
    name : str
        For messages.
    line_frequency_hz : int
        50 or 60: what the meter counts integration time in.
    status_bits : StatusBits
        Meaning of the status word.
    """

    def __init__(self, link: Link, name: str, *, line_frequency_hz: int = 50, status_bits: StatusBits | None = None) -> None:
        if line_frequency_hz not in (50, 60):
            raise InvalidSetting(f"line_frequency_hz {line_frequency_hz}", device=name, expected="50 or 60")
        self._end = Endpoint(link, name)
        self._line_frequency_hz = line_frequency_hz
        self._bits = StatusBits() if status_bits is None else status_bits
        self._doubt = Doubt(link)
        self._integration_s = _RESET_INTEGRATION_S
        self._range_a: float | None = None

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        integration_s: float = 0.1,
        range: float | None = None,
        line_frequency_hz: int = 50,
        status_bits: StatusBits | None = None,
    ) -> Keithley6485:
        """Make sure a 6485 is there, reset it, acquire the zero correction and configure it.

        Raises
        ------
        DeviceFault
            The meter puts a command into its error queue.
        """
        meter = cls(link, name, line_frequency_hz=line_frequency_hz, status_bits=status_bits)
        meter._plan(integration_s, range)  # refuse nonsense before anything is sent
        meter.identify()
        meter._empty_error_queue()
        meter._zero_correct()
        meter.configure(integration_s, range)
        return meter

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._end.name

    @property
    def unit(self) -> str:
        """Always A, of photocurrent."""
        return "A"

    @property
    def integration_s(self) -> float:
        """Integration time in s, after rounding to 0.01 line cycles."""
        return self._integration_s

    @property
    def range_a(self) -> float | None:
        """Full scale in A, or None while the meter chooses."""
        return self._range_a

    def identify(self) -> Identity:
        """Ask ``*IDN?``. Any other reply still on its way is dropped."""
        with self._doubt.lock:
            return self._resynchronise("asking for the identity")

    def configure(self, integration_s: float, range: float | None = None) -> None:
        """Set integration time and range.

        Parameters
        ----------
        integration_s : float, s
            0.01 to 50 line cycles at 50 Hz, 0.01 to 60 at 60 Hz; rounded to 0.01 cycles.
        range : float, A, optional
            Current to be held; the smallest range with that full scale or more is set. None lets the meter choose.

        Raises
        ------
        InvalidSetting
            Beyond what the meter can do; nothing was sent.
        DeviceFault
            The meter refuses.
        """
        cycles, full_scale = self._plan(integration_s, range)
        with self._doubt.lock:
            self._command(f"SENS:CURR:NPLC {cycles:.2f}")
            self._integration_s = cycles / self._line_frequency_hz
            if full_scale is None:
                self._command("CURR:RANG:AUTO ON")
            else:
                self._command("CURR:RANG:AUTO OFF")
                self._command(f"CURR:RANG {full_scale:.0e}")
            self._range_a = full_scale

    def read(self) -> LightReading:
        """Take one reading (``READ?``), in A. A missing or garbled one is taken once more.

        Raises
        ------
        TransportTimeout, UnexpectedReply
            No reading came, twice.
        DeviceFault
            The meter says not-a-number, or its zero check is on.
        """
        attempt, expected = "taking a reading", "READ,UNIT,TIME,STAT"
        return self._doubt.twice(
            lambda: self._exchange(b"READ?", self._parse_reading, attempt, expected), lambda: self._resynchronise(attempt)
        )

    def close(self) -> None:
        """Let go of the meter. The link stays open."""
        self._end.closed = True

    def _parse_reading(self, line: bytes) -> LightReading:
        return parse_reading(line, self._bits)

    def _plan(self, integration_s: float, range_a: float | None) -> tuple[float, float | None]:
        most = self._line_frequency_hz  # NPLC 60 at 60 Hz, 50 at 50 Hz: one second either way
        cycles = round(integration_s * self._line_frequency_hz, 2) if math.isfinite(integration_s) else math.nan
        if not 0.01 <= cycles <= most:
            raise InvalidSetting(
                f"integration_s {integration_s}",
                device=self._end.name,
                expected=f"{0.01 / self._line_frequency_hz:.2g} to 1 s",
                hint="average several readings",
            )
        if range_a is None:
            return cycles, None
        # A hair of room, so that 2e-6 written differently is still the 2e-6 range.
        full_scale = next((scale for scale in RANGES_A if 0 < range_a <= scale * (1 + 1e-9)), None)
        if full_scale is None:
            raise InvalidSetting(
                f"range {range_a}", device=self._end.name, expected=f"above 0 and at most {RANGES_A[-1]:g} A, or none for automatic"
            )
        return cycles, full_scale

    def _zero_correct(self) -> None:
        """Start sequence of the manual: measure the meter's own offset on the lowest range with the input shut off, and subtract it."""
        for command in (
            "*RST",
            "FORM:ELEM READ,UNIT,TIME,STAT",
            "SYST:ZCH ON",
            "CURR:RANG 2e-9",
            "INIT",
            "SYST:ZCOR:ACQ",
            "SYST:ZCOR ON",
            "CURR:RANG:AUTO ON",
            "SYST:ZCH OFF",
        ):
            self._command(command)

    def _command(self, command: str) -> None:
        """Send a command that has no reply, and make sure that the meter took it."""
        attempt = f"sending {command}"
        code, text = self._ask(command.encode("ascii") + self._end.link.terminator + b"SYST:ERR?", _parse_error, attempt, _NO_ERROR)
        if code:
            raise self._end.fault(f"error {code}, {text}", attempt, expected=_NO_ERROR, hint="check model and firmware")

    def _empty_error_queue(self) -> None:
        """Drop what earlier users left, so that the next error is ours."""
        attempt = "emptying the error queue"
        for _ in range(_OLD_ERRORS):
            code, text = self._ask(b"SYST:ERR?", _parse_error, attempt, _NO_ERROR)
            if not code:
                return
        raise self._end.fault(f"the queue never ends, last error {code}, {text}", attempt)

    def _ask(self, question: bytes, parse: Callable[[bytes], T], attempt: str, expected: str) -> T:
        """Ask once. When the reply is missing or malformed, the next question is preceded by a resynchronisation."""
        return self._doubt.once(lambda: self._exchange(question, parse, attempt, expected), lambda: self._resynchronise(attempt))

    def _resynchronise(self, attempt: str) -> Identity:
        """Ask for the name and drop all that comes before it: the meter answers in order, so nothing is owed to us afterwards."""

        def skip_to_name(line: bytes) -> Identity | None:
            return parse_identity(line) if line.lstrip().startswith(b"KEITHLEY") else None

        identity = self._exchange(b"*IDN?", skip_to_name, attempt, "KEITHLEY INSTRUMENTS INC.,MODEL 6485,...", repeatable=True)
        self._doubt.settled()
        return identity

    def _exchange(
        self, question: bytes, accept: Callable[[bytes], T | None], attempt: str, expected: str, *, repeatable: bool = False
    ) -> T:
        message = question + self._end.link.terminator
        return self._end.exchange(message, accept, attempt, expected, timeout_s=self._allowance_s(), repeatable=repeatable)

    def _allowance_s(self) -> float:
        """Time for a reply: the link's own, and a reading on every range the meter may try, for commands queue behind readings."""
        ranges = len(RANGES_A) if self._range_a is None else 1
        return self._end.link.timeout_s + self._integration_s * _CONVERSIONS_PER_READING * ranges


def _parse_error(line: bytes) -> tuple[int, str]:
    match = _ERROR.fullmatch(line.decode("ascii", "replace").strip())
    if match is None or not line.isascii():
        raise UnexpectedReply("not an entry of the error queue", raw=line, expected=_NO_ERROR)
    return int(match[1]), match[2] or ""
