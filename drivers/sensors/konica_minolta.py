"""Konica Minolta luminance meters LS-100 and LS-110 and colour luminance meter CS-100A, over RS-232.

Source: the project's protocol sheet, section 5.2, which knows the instruments through other people's drivers only. The meter must be
switched on with its F key held (remote mode), else it is silent.

Replies carry neither ids nor checksums, but a reading has fields behind its code and the answer to a setting has none, so that one never
passes for the other. After a missing or malformed reply a setting is repeated, and every reading before its answer is dropped. A late
reading looks like a new one, so readings are taken until two in turn agree (`drivers.agreement`).

Not verified on an instrument: the meaning of the codes beyond their names, what stands behind the codes that report a range left (so it is
not used), how wide a reading's fields are (`fixed_width`), whether the luminance holds when the chromaticity is out of range
(`chroma_over_is_good`), the two integration times (`fast_s`, `slow_s`) and how long a measurement may take (`measuring_s`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, Literal, TypeVar

from drivers.agreement import agreed
from drivers.doubt import Doubt
from drivers.endpoint import Endpoint
from drivers.errors import DeviceError, DeviceFault, InvalidSetting, TransportTimeout, UnexpectedReply
from drivers.kinds import Identity, LightReading
from drivers.link import Link

T = TypeVar("T")
Model = Literal["LS-100", "LS-110", "CS-100A"]

UNIT = "cd/m^2"

FIELDS = {"LS-100": 1, "LS-110": 1, "CS-100A": 3}
"""Numbers in a reading: Y, or Y, x and y."""

WIDTHS = {"LS-100": (8,), "LS-110": (8,), "CS-100A": (7, 5, 5)}
"""Characters of each field, blanks included, as in the sheet's examples; not verified."""

FLOOR = 0.05
"""cd/m^2 by which two readings may differ in any case."""

CALIBRATIONS = {"preset": "00", "varied": "01"}

REFUSALS = {
    "ER00": "unknown command",
    "ER01": "setting error",
    "ER10": "measuring range over",
    "ER11": "memory value error",
    "ER12": "memory value error",
    "ER19": "display range over",
    "ER20": "EEPROM error, the meter needs repair",
    "ER30": "battery exhausted",
}
_OVER = {"OK12": "luminance_over", "ER10": "range_over", "ER19": "display_over"}
_ERROR_STATUS = 100  # added to the number of an ER code, to keep it apart from the OK codes

_ABSOLUTE, _FAST, _SLOW, _CONTINUOUS = "04", "06", "07", "09"
_BRIGHTEST = 1e7  # beyond any of these meters, so that a garbled number is noticed
_NUMBER = re.compile(r"\d*\.?\d+|\d+\.", re.ASCII)
_REPLY = re.compile(r"(OK|ER)(\d\d)((?:,[^,]*)*)", re.ASCII)


def parse_reading(line: bytes, model: Model, *, chroma_over_is_good: bool = False, fixed_width: bool = True) -> LightReading:
    """Take apart the answer to ``MES``, such as ``OK00,   123.4`` or, of a CS-100A, ``OK00,  123.4,.3100,.3300``.

    With `fixed_width` the fields must have the `WIDTHS` of the model: nothing else would show that a digit was lost on the line.

    Returns
    -------
    LightReading
        In cd/m^2; ``status`` is the number of an OK code, or 100 and the number of an ER code. Infinite and ``over_range`` when the
        luminance, the display or (unless ``chroma_over_is_good``) the chromaticity is out of range; ``under_range`` for OK13, with the
        value the meter gives, or 0 if it gives none.

    Raises
    ------
    UnexpectedReply
        Not such a line, or a reading of another model.
    DeviceFault
        The meter reports an error (ER20: needs repair, ER30: battery, ...).
    """
    expected = f"a reading of {FIELDS[model]} number{'s' if FIELDS[model] > 1 else ''} after OK00"
    code, fields = _split(line, expected)
    if code in _OVER:
        status = int(code[2:]) + (_ERROR_STATUS if code.startswith("ER") else 0)
        return LightReading(math.inf, UNIT, status, over_range=True, flags=(_OVER[code],))
    if code.startswith("ER"):
        raise _refusal(code, line)
    if code == "OK13":
        told = _number(fields[0]) if fields else None
        return LightReading(0.0 if told is None else told, UNIT, 13, over_range=False, under_range=True, flags=("luminance_under",))
    chroma_over = code == "OK11"
    if code != "OK00" and not chroma_over:
        raise UnexpectedReply(f"unknown code {code}", raw=line, expected=expected)
    if chroma_over and not chroma_over_is_good:
        return LightReading(math.inf, UNIT, 11, over_range=True, flags=("chroma_over",))
    if len(fields) != FIELDS[model]:
        hint = f"is it another model than the {model}?"
        raise UnexpectedReply(f"a reading of {len(fields)} numbers", raw=line, expected=expected, hint=hint)
    if chroma_over:
        fields = fields[:1]  # the others say nothing
    widths = WIDTHS[model][: len(fields)]
    if fixed_width and tuple(map(len, fields)) != widths:
        hint = "if the meter writes them so, give fixed_width = false"
        raise UnexpectedReply("fields of another width", raw=line, expected=f"{expected}, of {widths} characters", hint=hint)
    numbers = [_number(field) for field in fields]
    luminance = numbers[0]
    if luminance is None or None in numbers or any(number is None or number > 1 for number in numbers[1:]):
        raise UnexpectedReply("not a reading", raw=line, expected=expected)
    if luminance > _BRIGHTEST:
        raise UnexpectedReply(f"a luminance of {luminance:g} {UNIT}", raw=line, expected=f"at most {_BRIGHTEST:g}")
    return LightReading(luminance, UNIT, int(code[2:]), over_range=False, flags=("chroma_over",) if chroma_over else ())


class LuminanceMeter:
    """One of these meters as a light sensor; satisfies `drivers.kinds.LightSensor`. It needs a link of its own.

    `LuminanceMeter.open` sets the meter up; the bare constructor sends nothing.

    Parameters
    ----------
    link : Link
        4800 baud, 7 data bits, even parity, 2 stop bits, CR LF. Stays the caller's to close.
    name : str
        For messages.
    model : str
        ``LS-100``, ``LS-110`` or ``CS-100A``: the meter does not say which it is.
    serial_number : str
        For the record: the meter does not tell it.
    fast_s, slow_s : float, s
        Integration time of the two responses; not verified.
    measuring_s : float, s
        Time allowed for a measurement beyond the link's own; not verified.
    chroma_over_is_good : bool
        Take the luminance of a CS-100A as good though the chromaticity is out of range; not verified, hence off.
    fixed_width : bool
        Insist on the `WIDTHS` of a reading's fields, which are not verified.
    agreement : float
        Share by which two readings in turn may differ; 0 takes one on trust.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        *,
        model: Model = "LS-100",
        serial_number: str = "not told",
        fast_s: float = 0.1,
        slow_s: float = 0.4,
        measuring_s: float = 3.0,
        chroma_over_is_good: bool = False,
        fixed_width: bool = True,
        agreement: float = 0.05,
    ) -> None:
        if model not in FIELDS:
            raise InvalidSetting(f"model {model!r}", device=name, expected=", ".join(FIELDS))
        if not 0 <= agreement < 1:
            raise InvalidSetting(f"agreement {agreement}", device=name, expected="0, or a share below 1")
        if not 0 < fast_s < slow_s < math.inf or not 0 <= measuring_s < math.inf:
            given = f"fast_s {fast_s}, slow_s {slow_s}, measuring_s {measuring_s}"
            raise InvalidSetting(given, device=name, expected="finite times, slow_s longer than fast_s and that above 0")
        self._end = Endpoint(link, name)
        self._identity = Identity("Konica Minolta", model, serial_number, "not told")
        self._model = model
        self._fast_s, self._slow_s, self._measuring_s = fast_s, slow_s, measuring_s
        self._chroma_over_is_good = chroma_over_is_good
        self._fixed_width = fixed_width
        self._agreement = agreement
        self._integration_s = slow_s
        self._doubt = Doubt(link)

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        integration_s: float = 0.4,
        calibration: str = "preset",
        **options: Any,
    ) -> LuminanceMeter:
        """Make sure that a meter is there, and set calibration, absolute readings, continuous measurement and the response.

        Parameters
        ----------
        options
            The constructor's.

        Raises
        ------
        TransportTimeout
            Nobody answers.
        DeviceFault
            The meter refuses a setting.
        """
        meter = cls(link, name, **options)
        if calibration not in CALIBRATIONS:
            raise InvalidSetting(f"calibration {calibration!r}", device=name, expected=" or ".join(CALIBRATIONS))
        meter._response(integration_s, None)  # refuse nonsense before anything is sent
        meter._set(CALIBRATIONS[calibration])
        meter._set(_CONTINUOUS)
        meter.configure(integration_s)
        return meter

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._end.name

    @property
    def unit(self) -> str:
        """Always cd/m^2."""
        return UNIT

    @property
    def integration_s(self) -> float:
        """Integration time of the response chosen, s."""
        return self._integration_s

    def identify(self) -> Identity:
        """Make sure that the meter answers; who it is, it cannot say, so this is what the constructor was told."""
        with self._doubt.lock:
            self._resynchronise("looking for the meter")
            return self._identity

    def configure(self, integration_s: float, range: float | None = None) -> None:
        """Choose the fast or the slow response.

        Parameters
        ----------
        integration_s : float, s
            The faster response that integrates at least so long is set.
        range : None
            These meters choose their range themselves.

        Raises
        ------
        InvalidSetting
            Longer than the slow response, or a range; nothing was sent.
        DeviceFault
            The meter refuses.
        """
        mode, seconds = self._response(integration_s, range)
        with self._doubt.lock:
            self._set(mode)
            self._integration_s = seconds

    def read(self) -> LightReading:
        """Measure (``MES``) until two readings agree, in cd/m^2. A missing or garbled reading is taken once more.

        Raises
        ------
        TransportTimeout, UnexpectedReply
            No reading came, twice; or they do not agree.
        DeviceFault
            The meter reports an error.
        """
        attempt = "measuring"

        def accept(line: bytes) -> LightReading | None:
            if line.strip() == b"OK00":  # a late answer to a setting
                return None
            return parse_reading(line, self._model, chroma_over_is_good=self._chroma_over_is_good, fixed_width=self._fixed_width)

        def measure() -> LightReading:
            return self._doubt.twice(
                lambda: self._exchange("MES", accept, attempt, "OK00 and the reading"), lambda: self._resynchronise(attempt)
            )

        try:
            return agreed(measure, self._agreement, FLOOR)
        except DeviceError as error:
            error.complete(device=self._end.name, port=self._end.url, attempt=attempt)
            raise

    def close(self) -> None:
        """Let go of the meter. The link stays open."""
        self._end.closed = True

    def _response(self, integration_s: float, range: float | None) -> tuple[str, float]:
        if range is not None:
            raise InvalidSetting(f"range {range}", device=self._end.name, expected="none: the meter chooses its range itself")
        if not 0 < integration_s <= self._slow_s:
            raise InvalidSetting(
                f"integration_s {integration_s}",
                device=self._end.name,
                expected=f"above 0 and at most {self._slow_s:g} s",
                hint="average several readings",
            )
        return (_FAST, self._fast_s) if integration_s <= self._fast_s else (_SLOW, self._slow_s)

    def _set(self, mode: str) -> None:
        self._ask(f"MDS,{mode}", _accept_setting, f"setting mode {mode}", "OK00")

    def _ask(self, command: str, accept: Callable[[bytes], T | None], attempt: str, expected: str) -> T:
        """Ask once. When the reply is missing or malformed, the next question is preceded by a resynchronisation."""
        return self._doubt.once(lambda: self._exchange(command, accept, attempt, expected), lambda: self._resynchronise(attempt))

    def _resynchronise(self, attempt: str) -> None:
        """Set absolute readings, as they always are, and drop what comes before the answer: the meter answers in order."""
        self._exchange(f"MDS,{_ABSOLUTE}", _accept_setting, attempt, "OK00", repeatable=True)
        self._doubt.settled()

    def _exchange(self, command: str, accept: Callable[[bytes], T | None], attempt: str, expected: str, *, repeatable: bool = False) -> T:
        message, allowed_s = command.encode("ascii") + b"\r\n", self._end.link.timeout_s + self._measuring_s
        try:  # settings queue behind a measurement
            return self._end.exchange(message, accept, attempt, expected, timeout_s=allowed_s, repeatable=repeatable)
        except TransportTimeout as error:
            error.hint = "switch the meter on with its F key held, and check cable and line settings"
            raise


def _accept_setting(line: bytes) -> bool | None:
    """Claim a bare code; what has fields is a late reading, and so are the codes that only a measurement gives."""
    code, fields = _split(line, "OK00")
    if fields or code in _OVER or code in ("OK11", "OK13"):
        return None
    if code != "OK00":
        raise _refusal(code, line)
    return True


def _split(line: bytes, expected: str) -> tuple[str, list[str]]:
    match = _REPLY.fullmatch(line.strip().decode("ascii", "replace"))
    if match is None or not line.isascii():
        raise UnexpectedReply("not a reply of this meter", raw=line, expected=expected)
    return match[1] + match[2], match[3].split(",")[1:]


def _number(text: str) -> float | None:
    digits = text.strip(" ")
    return float(digits) if _NUMBER.fullmatch(digits) else None


def _refusal(code: str, line: bytes) -> DeviceFault:
    return DeviceFault(f"{code}, {REFUSALS.get(code, 'unknown code')}", raw=line, hint="look at the meter's display and battery")
