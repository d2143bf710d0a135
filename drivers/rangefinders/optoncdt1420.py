"""Micro-Epsilon optoNCDT 1420 laser triangulation sensor: ASCII commands and a binary stream of values, over RS-422.

Source: the project's protocol sheet, section 6.2 (optoNCDT 1420 manual, p65, 94, 97 and 98).

A command is answered with text and a prompt ``->``; a value is three bytes, told apart from text and from one another by their top bits. A
prompt can come between two values. For a reading the stream is switched on and off again, so that every value was measured after the call.
Nothing but those top bits protects a value: a reading is therefore the median of several, and doubtful when they do not agree.

Not verified: the error numbers above 65520 (told as they come), the last valid value (`last_valid`), what stands before the prompt, how
the values of GETINFO are written, whether a user must be logged in for OUTPUT and MEASRATE (then E202 is raised), and where the measuring
range begins (`start_of_range_mm`). Mastering must be off: it changes the meaning of the values, and nothing in them shows it.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median_low
from typing import Any, TypeVar

from drivers.endpoint import Endpoint
from drivers.errors import DeviceFault, InvalidSetting, UnexpectedReply
from drivers.kinds import DistanceReading, Identity
from drivers.link import Link

T = TypeVar("T")

PROMPT = b"->"
FIRST_VALID, LAST_VALID, LAST_VALUE = 643, 64877, 65520
"""Ends of the measuring range, and the last number that is not an error (manual p65; another driver has 64887 for the second)."""

_TOKEN = re.compile(rb"([\x00-\x3f][\x40-\x7f][\x80-\xff])|->|[\x80-\xff]")
_ERROR = re.compile(r"E(\d{2,4})\b *(.*)")
_FIELD = re.compile(r"\s*([A-Za-z][A-Za-z -]*?)\s*:\s*(.*?)\s*")
_MILLIMETRES = re.compile(r"(\d+(?:\.\d+)?)\s*mm", re.IGNORECASE)
_LONGEST = 64 * 1024  # a line that never prompts must not fill the memory


class ValueSplitter:
    """Take apart what the sensor sends: text up to a prompt, and values of three bytes anywhere in between."""

    def __init__(self) -> None:
        self._held = b""
        self._text = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the values (three bytes each) and the texts (without their prompts) that `data` completes, in order.

        A byte that can only be the end of a value whose beginning is lost is dropped.
        """
        held, at, found = self._held + data, 0, []
        for token in _TOKEN.finditer(held):
            self._text += held[at : token.start()]
            at = token.end()
            if token[1]:
                found.append(token[1])
            elif token[0] == PROMPT:
                found.append(self._text)
                self._text = b""
        # The last two bytes may be the beginning of a value or of a prompt.
        keep = max(at, len(held) - 2)
        self._text = (self._text + held[at:keep])[-_LONGEST:]
        self._held = held[keep:]
        return found

    @property
    def pending(self) -> bytes:
        """What has come and completes nothing yet."""
        return self._text + self._held

    def clear(self) -> None:
        """Forget what is pending."""
        self._held = self._text = b""


class StreamLink(Link):
    """A link whose replies are the sensor's texts and values, whatever terminator it is given."""

    def __init__(self, port: Any, **settings: Any) -> None:
        super().__init__(port, **{**settings, "terminator": PROMPT})
        self.unasked = (b"",)  # a stream goes on until it is stopped
        self._splitter = ValueSplitter()

    def _distribute(self, chunk: bytes) -> None:
        frames = self._splitter.feed(chunk)
        self._buffer = self._splitter.pending
        with self._state:
            for frame in frames:
                claimed = any(waiting.offer(frame) for waiting in self._waiting if not waiting.done)
                if claimed and len(self._waiting) > 1:
                    self._changed.notify_all()

    def _drop_stale_input(self) -> None:
        super()._drop_stale_input()
        if not self._waiting:
            self._splitter.clear()


@dataclass(frozen=True)
class Value:
    """One value of a stream: 18 bits, and whether it is the first of its set (the distance)."""

    word: int
    first: bool


def parse_value(frame: bytes) -> Value:
    """Take apart three bytes: ``00 D5..D0``, ``01 D11..D6``, then ``10 D17..D12``, or ``11 ...`` for the second and later of a set.

    Raises
    ------
    UnexpectedReply
        Not such bytes.
    """
    if len(frame) != 3 or [byte >> 6 for byte in frame] not in ([0, 1, 2], [0, 1, 3]):
        raise UnexpectedReply("not a value", raw=frame, expected="three bytes that begin with 00, 01 and 10 or 11")
    low, middle, high = (byte & 0x3F for byte in frame)
    return Value(low | middle << 6 | high << 12, frame[2] >> 6 == 2)


def distance_mm(word: int, measuring_range_mm: float) -> float:
    """Distance from the start of the measuring range, mm: (102 x / (100 * 65520) - 0.01) MR. Source: manual p65."""
    return (word * 102 / (100 * 65520) - 0.01) * measuring_range_mm


def parse_info(text: str) -> dict[str, str]:
    """Take apart the answer to GETINFO, lines such as ``Serial: 1234``; names in lower case."""
    fields = (_FIELD.fullmatch(line) for line in text.splitlines())
    return {match[1].lower(): match[2] for match in fields if match}


class OptoNCDT1420:
    """The sensor as a range finder; satisfies `drivers.kinds.RangeFinder`. It needs a link of its own.

    `OptoNCDT1420.open` sets the sensor up; the bare constructor sends nothing.

    Parameters
    ----------
    link : StreamLink
        921600 baud, 8N1 as delivered. Stays the caller's to close.
    name : str
        For messages.
    values : int
        How many values make a reading, from 1; the reading is their median.
    spread_mm : float, mm, optional
        Values that differ by more make a reading doubtful; 1 % of the measuring range if not given.
    start_of_range_mm : float, mm
        Distance from the sensor's front to the start of its range, to be added to all distances; 0 tells them from that start.
    last_valid : int
        The last word within the measuring range; not verified.
    measuring_range_mm : float, mm, optional
        As printed on the sensor; asked from it (by `open`) when not given.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        *,
        values: int = 5,
        spread_mm: float | None = None,
        start_of_range_mm: float = 0.0,
        last_valid: int = LAST_VALID,
        measuring_range_mm: float | None = None,
    ) -> None:
        if not isinstance(link, StreamLink):
            hint = "open the port with StreamLink.open"
            raise InvalidSetting("a link that cannot take values apart", device=name, port=link.url, expected="a StreamLink", hint=hint)
        if values < 1 or not FIRST_VALID < last_valid <= LAST_VALUE or not math.isfinite(start_of_range_mm):
            given = f"values {values}, last_valid {last_valid}, start_of_range_mm {start_of_range_mm}"
            expected = f"1 value or more, {FIRST_VALID} < last_valid <= {LAST_VALUE}, a finite start"
            raise InvalidSetting(given, device=name, expected=expected)
        for what, given_mm in (("spread_mm", spread_mm), ("measuring_range_mm", measuring_range_mm)):
            if given_mm is not None and not 0 < given_mm < math.inf:
                raise InvalidSetting(f"{what} {given_mm}", device=name, expected="a finite length above 0")
        self._end = Endpoint(link, name)
        self._values, self._spread_mm, self._start_mm, self._last_valid = values, spread_mm, start_of_range_mm, last_valid
        self._range_mm = measuring_range_mm
        self._lock = threading.RLock()

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        measuring_rate_khz: float | None = 1.0,
        measuring_range_mm: float | None = None,
        values: int = 5,
        spread_mm: float | None = None,
        start_of_range_mm: float = 0.0,
        last_valid: int = LAST_VALID,
    ) -> OptoNCDT1420:
        """Stop the stream, make sure that an optoNCDT is there, learn its range and set its rate.

        Parameters
        ----------
        measuring_rate_khz : float, kHz, optional
            The sensor's own setting when not given.

        Raises
        ------
        DeviceFault
            The sensor refuses a command.
        UnexpectedReply
            It does not tell its measuring range, or tells another than it was given.
        """
        rate = measuring_rate_khz
        if rate is not None and not 0 < rate < math.inf:
            raise InvalidSetting(f"measuring_rate_khz {rate}", device=name, expected="a finite rate above 0")
        sensor = cls(
            link,
            name,
            values=values,
            spread_mm=spread_mm,
            start_of_range_mm=start_of_range_mm,
            last_valid=last_valid,
            measuring_range_mm=measuring_range_mm,
        )
        sensor._command("OUTPUT NONE")
        sensor._learn_range()
        if rate is not None:
            sensor._command(f"MEASRATE {rate:g}")
        return sensor

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._end.name

    def identify(self) -> Identity:
        """Ask GETINFO."""
        info = self._info()
        return Identity("Micro-Epsilon", info.get("name", ""), info.get("serial", ""), info.get("version", ""))

    def limits_mm(self) -> tuple[float, float]:
        """Start and end of the measuring range, mm."""
        if self._range_mm is None:
            raise InvalidSetting("the measuring range is not known", device=self._end.name, hint="give measuring_range_mm, or use open()")
        return self._start_mm, self._start_mm + self._range_mm

    def read(self) -> DistanceReading:
        """Take one reading: the median of several values, all measured after the call. Missing values are asked for once more.

        Raises
        ------
        TransportTimeout
            Too few values came.
        DeviceFault
            The sensor refuses to stream.
        """
        self.limits_mm()  # nothing is sent while the range is not known
        with self._lock:
            words: list[int] = []
            streaming = False

            def collect(frame: bytes) -> list[int] | None:
                nonlocal streaming
                if not _is_value(frame):
                    streaming = _answers("OUTPUT RS422", frame) is not None or streaming
                    return None
                value = parse_value(frame)
                if streaming and value.first:
                    words.append(value.word)
                return words if len(words) >= self._values else None

            try:
                self._exchange("OUTPUT RS422", collect, "measuring", f"{self._values} values")
            finally:
                self._command("OUTPUT NONE")
            return self._reading(words)

    def close(self) -> None:
        """Let go of the sensor. The link stays open."""
        self._end.closed = True

    def _reading(self, words: list[int]) -> DistanceReading:
        errors = [word for word in words if word > LAST_VALUE]
        if errors:
            return DistanceReading(math.inf, status=errors[0], out_of_range=True, flags=(f"error_{errors[0]}",))
        middle = median_low(words)
        if not FIRST_VALID <= middle <= self._last_valid:
            return DistanceReading(math.inf, out_of_range=True, flags=("too_near" if middle < FIRST_VALID else "too_far",))
        near_mm, far_mm = self.limits_mm()
        range_mm = far_mm - near_mm
        allowed_mm = 0.01 * range_mm if self._spread_mm is None else self._spread_mm
        doubtful = (max(words) - min(words)) * 1.02 / 65520 * range_mm > allowed_mm
        return DistanceReading(near_mm + distance_mm(middle, range_mm), doubtful=doubtful, flags=("values_differ",) if doubtful else ())

    def _learn_range(self) -> None:
        text = self._info().get("measuring range", "")
        match = _MILLIMETRES.search(text)
        told_mm = float(match[1]) if match else None
        given_mm = self._range_mm
        other = given_mm is not None and told_mm is not None and not math.isclose(given_mm, told_mm)
        if other or not (given_mm or told_mm):
            raise self._end.unexpected(
                f"measuring range {text!r}",
                "asking for the measuring range",
                "a length in mm" if given_mm is None else f"{given_mm:g} mm",
                hint="give measuring_range_mm as printed on the sensor",
            )
        self._range_mm = given_mm or told_mm

    def _info(self) -> dict[str, str]:
        def accept(frame: bytes) -> dict[str, str] | None:
            if _is_value(frame):
                return None
            _refuse_errors(frame)
            info = parse_info(frame.decode("ascii", "replace"))
            return info if "name" in info and "serial" in info else None

        with self._lock:
            return self._exchange("GETINFO", accept, "asking for the identity", "Name: ..., Serial: ...")

    def _command(self, command: str) -> None:
        """Send a command that sets something; setting it twice does no harm."""
        with self._lock:
            self._exchange(command, lambda frame: _answers(command, frame), f"sending {command}", f"{command}, then ->")

    def _exchange(self, command: str, accept: Callable[[bytes], T | None], attempt: str, expected: str) -> T:
        request = command.encode("ascii") + b"\r\n"
        return self._end.exchange(request, accept, attempt, expected, repeatable=True)


def _is_value(frame: bytes) -> bool:
    return len(frame) == 3 and frame[2] >= 0x80


def _answers(command: str, frame: bytes) -> bool | None:
    """Say whether a text echoes this command (its number may be written differently); an error is raised."""
    if _is_value(frame):
        return None
    _refuse_errors(frame)
    name, _, argument = command.partition(" ")
    for line in frame.decode("ascii", "replace").splitlines():
        told, _, value = line.strip().partition(" ")
        if told == name and (value == argument or _same_number(value, argument)):
            return True
    return None


def _same_number(one: str, other: str) -> bool:
    try:
        return "_" not in one and math.isclose(float(one), float(other))  # float() would pass over it
    except ValueError:
        return False


def _refuse_errors(frame: bytes) -> None:
    for line in frame.decode("ascii", "replace").splitlines():
        match = _ERROR.fullmatch(line.strip())
        if match:
            hint = "log in as a professional user" if match[1] == "202" else "check model and firmware"
            raise DeviceFault(f"E{match[1]} {match[2]}".strip(), raw=frame, hint=hint)
