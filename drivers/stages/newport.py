"""Newport rotary stages on an ESP300 or ESP301 motion controller.

Source: ESP300/ESP301 user's manuals; error numbers partly from open drivers. Commands have no answer and answers carry neither name nor
checksum. So every command is followed by ``TB?``, whose answer has a shape of its own; what ends at rest is read twice; and after a
missing or malformed answer the controller is asked for its version, and all that comes before it is dropped. A target is read back once the
axis is on its way.

Not verified on hardware: the line speed of an ESP301 (a setting of the link: 921600 on its own port, 19200 on RS-232), several general
error numbers, and which home search a stage needs (``home_search``). The controller does not tell whether an axis has been homed: the
driver counts it as homed after a search that it has itself seen end without error, until the motor power goes; ``assume_homed`` says
that it was homed before.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from drivers.doubt import Doubt
from drivers.endpoint import Endpoint, Veto
from drivers.errors import InvalidSetting, NotHomed, UnexpectedReply
from drivers.kinds import AxisState, Identity, MotionProfile
from drivers.link import Link
from drivers.motion import Stops, require_arrival

T = TypeVar("T")

STEADY_DEG = 0.01
"""Two readings of a resting axis, or two tellings of a target, agree when they differ by no more; a servo at rest moves by far less."""

MOST_AXES = 3

DEGREES_PER_UNIT = {7: 1.0, 8: 0.9, 9: math.degrees(1.0), 10: math.degrees(1e-3), 11: math.degrees(1e-6)}
"""By the number ``SN?`` answers: degrees, grads, radians, milliradians, microradians."""

_NOT_OF_ONE_COMMAND = frozenset({1, 4, 8, 23})
"""General errors that concern every axis: time-out inside, emergency stop, cable interlock, servo tick."""

_MOST_ERRORS = 32  # the controller keeps fewer
_READINGS = 4

_NUMBER = re.compile(rb"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:E[+-]?\d+)?)\s*", re.IGNORECASE)
_ERROR = re.compile(rb"\s*(\d{1,3})\s*,\s*(\d+)\s*,\s*([!-~][ -~]*)")
_VERSION = re.compile(rb"\s*(ESP\d{3}[!-~]*)\s+([!-~][ -~]*)", re.IGNORECASE)

_ERROR_LINE = "an error message like '0, 451322, NO ERROR DETECTED'"

_HINTS = {
    2: "look for an overloaded stage, then home the axis",
    3: "look for what blocks the stage, then home the axis",
    4: "drive it off the limit switch, or home the axis",
    5: "drive it off the limit switch, or home the axis",
    8: "check the stage's cable and the axis number",
    9: "check the stage's cable",
    10: "choose a lower speed",
    11: "choose a lower acceleration",
    13: "home the axis: that switches its motor on",
    20: "home the axis again",
}


@dataclass(frozen=True)
class EspError:
    """One entry of the controller's error queue.

    Attributes
    ----------
    code : int
        Axis times 100 plus the axis' error, or a general error below 100; 0 for none.
    text : str
        In the controller's words.
    """

    code: int
    text: str

    @property
    def axis(self) -> int:
        """The axis it is about; 0 for the controller."""
        return self.code // 100

    def __str__(self) -> str:
        return f"{self.code} {self.text}"


def parse_error(line: bytes) -> EspError:
    """Take the answer to ``TB?`` apart, such as ``0, 451322, NO ERROR DETECTED``; the number in the middle is a time stamp.

    Raises
    ------
    UnexpectedReply
        The line does not look like that.
    """
    match = _ERROR.fullmatch(line)
    if match is None:
        raise UnexpectedReply("not an error message", raw=line, expected=_ERROR_LINE)
    return EspError(int(match[1]), match[3].decode("ascii").strip())


def parse_number(line: bytes) -> float:
    """Take the answer to a question for a number.

    Raises
    ------
    UnexpectedReply
        The line is not one finite number.
    """
    match = _NUMBER.fullmatch(line)
    number = float(match[1]) if match is not None else math.nan
    if not math.isfinite(number):
        raise UnexpectedReply("not a number", raw=line, expected="one number")
    return number


def find_version(line: bytes) -> tuple[str, str] | None:
    """Take the answer to ``VE?`` apart, name and version, such as ``ESP301 Version 3.0``; None for any other line."""
    match = _VERSION.fullmatch(line)
    return (match[1].decode("ascii"), match[2].decode("ascii").strip()) if match is not None else None


class NewportAxis:
    """One axis of an ESP controller; satisfies `drivers.kinds.Stage`. All axes of a controller share its link.

    Parameters
    ----------
    link : Link
        Terminator CR LF. Stays the caller's to close.
    name : str
        For messages.
    axis : int
        1 to 3.
    degrees_per_unit : float
        Scale; `NewportAxis.open` finds it from the units the axis is set to.
    home_search : int
        Parameter of ``OR``: 1 home and index signals, 2 home signal, 3 or 4 upper or lower limit switch, 5 or 6 these with index.
        0, to the counter's zero, gives no reference and is refused.
    assume_homed : bool
        The axis was homed since the controller was switched on.
    """

    def __init__(
        self, link: Link, name: str, *, axis: int = 1, degrees_per_unit: float = 1.0, home_search: int = 1, assume_homed: bool = False
    ) -> None:
        if not 1 <= axis <= MOST_AXES:
            raise InvalidSetting(f"axis {axis}", device=name, expected=f"1 to {MOST_AXES}")
        if not 1 <= home_search <= 6:
            raise InvalidSetting(f"home_search {home_search}", device=name, expected="1 to 6")
        if not (math.isfinite(degrees_per_unit) and degrees_per_unit > 0):
            raise InvalidSetting(f"degrees_per_unit {degrees_per_unit}", device=name, expected="a finite number above 0")
        self._wire = _Wire(link, name, axis)
        self._scale = degrees_per_unit
        self._home_search = home_search
        self._homed = assume_homed
        self._homing = False
        self._seen = len(self._wire.errors)  # errors of earlier motions
        self._stops = Stops()

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        degrees_per_unit: float | None = None,
        speed: float | None = None,
        acceleration: float | None = None,
        **options: Any,
    ) -> NewportAxis:
        """Meet the axis: read its units unless the scale is given, and set speed and acceleration if given. Nothing moves.

        Parameters
        ----------
        options
            The constructor's.

        Raises
        ------
        DeviceFault
            The axis is set to units that are no angle, or refuses a setting.
        """
        stage = cls(link, name, degrees_per_unit=1.0 if degrees_per_unit is None else degrees_per_unit, **options)
        if degrees_per_unit is None:
            attempt = "reading the units"
            units = stage._wire.whole("SN?", attempt, range(12))
            if units not in DEGREES_PER_UNIT:
                raise stage._wire.fault(
                    f"units {units}",
                    attempt,
                    expected=f"an angle: any of {', '.join(map(str, DEGREES_PER_UNIT))}",
                    hint="set the units to degrees, or give degrees_per_unit in the configuration",
                )
            stage._scale = DEGREES_PER_UNIT[units]
        stage.set_profile(speed, acceleration)
        return stage

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._wire.name

    @property
    def unit(self) -> Literal["deg"]:
        """What it counts in."""
        return "deg"

    @property
    def degrees_per_unit(self) -> float:
        """Scale in use."""
        return self._scale

    def identify(self) -> Identity:
        """Ask the controller for its version and the axis for its stage."""
        controller, firmware = self._wire.version("reading the version")
        stage, _, serial_number = self._wire.text("ID?", "reading the stage's identity").partition(",")
        return Identity(
            vendor="Newport",
            model=f"{controller} axis {self._wire.axis}, {stage.strip()}",
            serial_number=serial_number.strip().removeprefix("SN").strip() or "unknown",
            firmware=firmware.removeprefix("Version").strip(),
        )

    def state(self) -> AxisState:
        """Ask for position and motion; at rest also for motor power and errors, and for the position until two readings agree."""
        attempt = "reading the state"
        position = self._position(attempt)
        if not self._wire.flag("MD?", attempt):
            return AxisState(position, moving=True, homed=self._homed, warnings=self._warnings())
        powered = self._wire.flag("MO?", attempt)
        self._wire.drain(attempt)
        warnings = self._warnings()
        position = self._steady_position(attempt)
        with self._stops.lock:
            if self._homing:
                self._homed, self._homing = not warnings, False
            if not powered:
                self._homed = False  # an arm without power can be turned by hand
        return AxisState(position, moving=False, homed=self._homed, warnings=warnings)

    def limits(self) -> tuple[float, float]:
        """Read the axis' software limits, deg."""
        low = self._wire.number("SL?", "reading the lower limit")
        high = self._wire.number("SR?", "reading the upper limit")
        return low * self._scale, high * self._scale

    def profile(self) -> MotionProfile:
        """Read speed and the smaller of acceleration and deceleration from the axis.

        Raises
        ------
        DeviceFault
            One of them reads 0, so that no arrival can be predicted.
        """
        attempt = "reading the motion profile"
        speed = self._wire.number("VA?", attempt) * self._scale
        acceleration = min(self._wire.number("AC?", attempt), self._wire.number("AG?", attempt)) * self._scale
        if speed <= 0 or acceleration <= 0:
            raise self._wire.fault(
                f"speed {speed:g} deg/s, acceleration {acceleration:g} deg/s^2",
                attempt,
                expected="both above 0",
                hint="set speed and acceleration",
            )
        return MotionProfile(speed, acceleration)

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None:
        """Set speed (deg/s), acceleration and deceleration alike (deg/s^2), or all of them.

        Raises
        ------
        InvalidSetting
            A value is not finite, or not above 0.
        DeviceFault
            The axis refuses it.
        """
        settings = (
            ("VA", speed, "speed in deg/s"),
            ("AC", acceleration, "acceleration in deg/s^2"),
            ("AG", acceleration, "deceleration in deg/s^2"),
        )
        commands = []
        for command, value, what in settings:
            if value is None:
                continue
            if not (math.isfinite(value) and value / self._scale >= 1e-6):
                expected = f"a finite number, {1e-6 * self._scale:g} or more"
                raise InvalidSetting(f"{what} {value}", device=self.name, attempt=f"setting the {what}", expected=expected)
            commands.append((f"{command}{value / self._scale:.6f}", f"setting the {what}"))
        for command, attempt in commands:  # only now that all are known to make sense
            self._wire.act(command, attempt)

    def start_home(self) -> None:
        """Switch the motor on and start the search for the reference. When it is over, `state` says ``homed``."""
        attempt = "starting to home"
        veto, stops = self._stops.veto(self._wire, attempt), self._stops.count
        self._wire.drain(attempt)
        self._seen = len(self._wire.errors)
        self._homed = self._homing = False
        self._wire.act("MO", "switching the motor on", veto=veto)
        self._wire.act(f"OR{self._home_search}", attempt, veto=veto)
        with self._stops.lock:
            self._homing = self._stops.count == stops  # only a search that nobody stopped gives a reference

    def start_move(self, deg: float, /) -> None:
        """Start an absolute move (deg).

        Raises
        ------
        InvalidSetting
            The angle is not a finite number.
        NotHomed
            The axis has not been homed, or has lost its motor power since.
        DeviceFault
            The angle is beyond the software limits, or the axis refuses. Or `stop` came between.
        TransportTimeout, UnexpectedReply
            It is unknown whether the axis moves: stop it.
        """
        attempt = f"starting to move to {deg:.4f} deg"
        if not math.isfinite(deg):
            raise InvalidSetting(f"angle {deg}", device=self.name, attempt="starting to move", expected="a finite angle in degrees")
        veto = self._stops.veto(self._wire, attempt)
        if self._homed and not self._wire.flag("MO?", attempt):
            self._homed = False
        if not self._homed:
            raise self._wire.fault(
                "no reference position", attempt, kind=NotHomed, expected="an axis homed with its motor on", hint="home the axis first"
            )
        # Whether the controller refuses a target beyond its limits or drives up to them is not verified.
        low, high = self.limits()
        if not low <= deg <= high:
            raise self._wire.fault(f"{deg:.4f} deg is beyond the software limits", attempt, expected=f"{low:g} to {high:g} deg")
        self._wire.drain(attempt)
        self._seen = len(self._wire.errors)
        self._wire.act(f"PA{deg / self._scale:+.6f}", attempt, veto=veto)
        # Neither commands nor answers carry a checksum: a lost or doubled digit would be another angle, in either of them.
        targets = (self._wire.number("DP?", attempt) * self._scale for _ in range(2))
        if all(abs(target - deg) > STEADY_DEG for target in targets):
            self.stop()
            raise self._wire.fault("it was on its way elsewhere, and was stopped", attempt, hint="check the cable, then home the axis")

    def stop(self) -> None:
        """Tell the axis to decelerate to rest, now. Returns when the controller has answered, which is before it rests.

        The bytes go out at once, even while other threads wait on the link. A stop that is unanswered, or answered with an error, is
        sent once more.
        """
        with self._stops.lock:
            self._stops.count += 1
            self._homing = False
        self._wire.stop()

    def check_arrival(self, deg: float, tolerance: float, /) -> None:
        """Make sure that the axis rests at an angle (deg) because it got there.

        Raises
        ------
        DeviceFault
            An error of the axis or of the whole controller since the last start of a motion; or the axis still moves; or it rests
            further than `tolerance` from the angle.
        """
        state = self.state()
        attempt = f"arriving at {deg:.4f} deg"
        if state.warnings:
            code = int(state.warnings[0].partition(" ")[0])
            raise self._wire.fault(
                f"{', '.join(state.warnings)} at {state.position:.4f} deg",
                attempt,
                expected="an undisturbed motion",
                hint=_HINTS.get(code % 100, "") if code >= 100 else "find the cause, then home the axis",
            )
        require_arrival(self._wire, state, deg, tolerance, attempt)

    def trust_reference(self) -> None:
        """Take the axis as homed: somebody else saw it homed, and nothing has moved it since."""
        with self._stops.lock:
            self._homed = True

    def close(self) -> None:
        """Let go of the axis without moving it. The link stays open for the others on it."""
        self._wire.closed = True

    def _position(self, attempt: str) -> float:
        return self._wire.number("TP?", attempt) * self._scale

    def _steady_position(self, attempt: str) -> float:
        """The position on which two readings agree: a digit lost on the line must not pass for another angle."""
        readings = [self._position(attempt)]
        for _ in range(_READINGS - 1):
            readings.append(self._position(attempt))
            if abs(readings[-1] - readings[-2]) <= STEADY_DEG:
                return readings[-1]
        seen = ", ".join(f"{reading:.4f}" for reading in readings)
        raise self._wire.unexpected(
            f"positions {seen} deg of an axis at rest", attempt, f"two in turn that agree to {STEADY_DEG:g} deg", hint="check the cable"
        )

    def _warnings(self) -> tuple[str, ...]:
        """What this axis or the whole controller complained of since the last start of a motion."""
        return tuple(str(error) for error in self._wire.errors[self._seen :] if error.axis in (0, self._wire.axis))


class _Controller:
    """What all axes on one link have in common."""

    def __init__(self, link: Link) -> None:
        self.doubt = Doubt(link)
        self.errors: list[EspError] = []  # all that were read, but those that answer a command


class _Wire(Endpoint):
    """Questions and answers with one axis."""

    def __init__(self, link: Link, name: str, axis: int) -> None:
        super().__init__(link, name)
        self.axis = axis
        self._controller = link.shared(_Controller)
        self._doubt = self._controller.doubt

    @property
    def errors(self) -> list[EspError]:
        """Errors read from the queue so far that no command was answered with, of all axes."""
        return self._controller.errors

    def number(self, question: str, attempt: str) -> float:
        """Ask the axis for a number."""
        return self._read(f"{self.axis}{question}", _or_not_ours(parse_number, _ERROR), attempt, "one number")

    def whole(self, question: str, attempt: str, allowed: range) -> int:
        """Ask the axis for one of a few whole numbers."""
        expected = f"a whole number {allowed[0]} to {allowed[-1]}"

        def parse(line: bytes) -> int:
            number = parse_number(line)
            if number not in allowed:
                raise UnexpectedReply(f"{number:g}", raw=line, expected=expected)
            return int(number)

        return self._read(f"{self.axis}{question}", _or_not_ours(parse, _ERROR), attempt, expected)

    def flag(self, question: str, attempt: str) -> bool:
        """Ask the axis for yes or no, 1 or 0."""
        return bool(self.whole(question, attempt, range(2)))

    def text(self, question: str, attempt: str) -> str:
        """Ask the axis for a line of text."""

        def parse(line: bytes) -> str:
            if not line.strip() or not line.isascii():
                raise UnexpectedReply("no text", raw=line, expected="printable text")
            return line.decode("ascii").strip()

        return self._read(f"{self.axis}{question}", _or_not_ours(parse, _ERROR, _NUMBER), attempt, "text")

    def version(self, attempt: str) -> tuple[str, str]:
        """Ask the controller for its name and version, dropping all that comes before: it answers in order, so nothing is owed us then."""
        with self._doubt.lock:
            found = self._exchange("VE?", find_version, attempt, "a version like 'ESP301 Version 3.0'", repeatable=True)
            self._doubt.settled()
        return found

    def drain(self, attempt: str) -> None:
        """Read the controller's error queue until it is empty, and keep what it held."""
        self.errors.extend(self._rest_of_queue(self._next_error(attempt), attempt))

    def act(self, command: str, attempt: str, *, veto: Veto | None = None) -> None:
        """Send a command that changes something, once, and make sure that the controller took it."""
        with self._doubt.lock:
            message = f"{self.axis}{command};TB?"
            first = self._doubt.once(
                lambda: self._exchange(message, _error_or_not_ours, attempt, _ERROR_LINE, veto=veto), lambda: self.version(attempt)
            )
            errors = self._rest_of_queue(first, attempt)
        refusals = [error for error in errors if error.axis in (0, self.axis) and error.code not in _NOT_OF_ONE_COMMAND]
        # What happened to other axes, or to all of them, is theirs to find.
        self.errors.extend(error for error in errors if error not in refusals)
        if refusals:
            raise self.fault(
                f"refused with error {', '.join(map(str, refusals))}",
                attempt,
                expected="no error",
                hint=_HINTS.get(refusals[0].code % 100, "") if refusals[0].axis else "check axis number and firmware",
            )

    def stop(self) -> None:
        """Send the stop, past whoever waits on the link; errors that the answers bring are kept."""
        message, attempt = f"{self.axis}ST;TB?", "stopping"

        def error() -> EspError:
            return self._doubt.urgently(lambda: self._exchange(message, _error_or_not_ours, attempt, _ERROR_LINE, urgent=True))

        if (first := error()).code:  # of earlier making, or because the stop was damaged on the line
            self.errors.append(first)
            self.link.tell("repeated", f"answered with error {first}", device=self.name, attempt=attempt)
            if (second := error()).code:
                self.errors.append(second)

    def _next_error(self, attempt: str) -> EspError:
        return self._read("TB?", _error_or_not_ours, attempt, _ERROR_LINE)

    def _rest_of_queue(self, error: EspError, attempt: str) -> list[EspError]:
        """Collect this entry of the error queue and all that follow."""
        errors: list[EspError] = []
        while error.code:
            if len(errors) == _MOST_ERRORS:
                hint = "switch the controller off and on"
                raise self.fault(f"the error queue never ends, last {error}", attempt, expected="an end of it", hint=hint)
            errors.append(error)
            error = self._next_error(attempt)
        return errors

    def _read(self, question: str, accept: Callable[[bytes], T | None], attempt: str, expected: str) -> T:
        """Ask something that may safely be asked twice."""
        return self._doubt.twice(lambda: self._exchange(question, accept, attempt, expected), lambda: self.version(attempt))

    def _exchange(
        self,
        message: str,
        accept: Callable[[bytes], T | None],
        attempt: str,
        expected: str,
        *,
        repeatable: bool = False,
        urgent: bool = False,
        veto: Veto | None = None,
    ) -> T:
        return self.exchange(message.encode("ascii") + b"\r", accept, attempt, expected, repeatable=repeatable, urgent=urgent, veto=veto)


def _or_not_ours(parse: Callable[[bytes], T], *others: re.Pattern[bytes]) -> Callable[[bytes], T | None]:
    """Leave lines of another shape, late answers or those to a stop that overtook, to whom they belong."""

    def accept(line: bytes) -> T | None:
        return None if any(shape.fullmatch(line) for shape in (*others, _VERSION)) else parse(line)

    return accept


def _error_or_not_ours(line: bytes) -> EspError | None:
    return _or_not_ours(parse_error, _NUMBER)(line)
