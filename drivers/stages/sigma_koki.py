"""Sigma Koki (OptoSigma) rotary stages on the two-axis controllers SHOT-302GS and GSC-02.

Source: open drivers of these controllers; no manual was at hand. The SHOT answers set commands with ``OK`` or ``NG``, the GSC-02 not at
all, so there every command is followed by the status question ``Q:``, whose ACK1 tells. Nothing carries a name or checksum: the status
has fixed columns, a resting counter is read twice, and after a missing or malformed answer the controller is asked for its version, and
all that comes before it is dropped.

A controller takes no new motion while either of its axes moves. A motion that must wait is started by the next look at the axis' state
that finds the controller ready; until then the axis counts as moving.

Not verified on hardware: everything. In particular the step (``degrees_per_pulse``), that a return to the origin leaves the counter at
0, and the speeds a controller starts with, which it does not tell. Nor can they be set while an axis moves: opening an axis leaves them
alone, and `SigmaKokiAxis.set_profile` sets them before it is to move. The controllers know no travel limits (``low_deg``, ``high_deg``)
nor whether an axis has been homed: the driver counts it as homed after a return to the origin that it has itself seen end at 0, and
``assume_homed`` says that it was homed before.
"""

from __future__ import annotations

import math
import re
import threading
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

FULL_STEP_DEG = 0.005
"""One step of SGSP and OSMS-60YAW stages at division 1."""

PROFILE = MotionProfile(speed=12.5, acceleration=60.0)
"""What an axis is set to when nobody says otherwise, deg/s and deg/s^2."""

_READINGS = 4
_STATUS = re.compile(rb"([+ -] *\d+| *-\d+),([+ -] *\d+| *-\d+),([XK]),([KLMW]),([BR])")
_COLUMNS = 27  # two counters of ten, three letters, four commas
_DIVISIONS = re.compile(rb"\s*(\d{1,3})\s*,\s*(\d{1,3})\s*")
_VERSION = re.compile(rb"\s*[A-Za-z][ -+\--~]*\d[ -+\--~]*")  # its form is not known: letters first, a digit, no comma
_WORDS = (b"OK", b"NG", b"R", b"B")
_ON_LIMIT = {"K": (), "L": (1,), "M": (2,), "W": (1, 2)}


@dataclass(frozen=True)
class Status:
    """The answer to ``Q:``.

    Attributes
    ----------
    pulses : tuple of int
        Counters of axes 1 and 2.
    failed : bool
        ACK1: the last command was refused.
    limits : tuple of int
        ACK2: axes that a limit sensor stopped.
    busy : bool
        ACK3: an axis moves; which one is not told.
    """

    pulses: tuple[int, int]
    failed: bool
    limits: tuple[int, ...]
    busy: bool


def parse_status(line: bytes) -> Status:
    """Take a status line apart, such as ``     14000,         0,K,K,R``.

    Raises
    ------
    UnexpectedReply
        The line has other columns.
    """
    match = _STATUS.fullmatch(line)
    if match is None or len(line) != _COLUMNS or line[10:11] != b",":
        raise UnexpectedReply("not a status", raw=line, expected="a line like '     14000,         0,K,K,R'")
    one, two = (int(match[place].replace(b" ", b"")) for place in (1, 2))
    return Status((one, two), match[3] == b"X", _ON_LIMIT[match[4].decode("ascii")], match[5] == b"B")


def find_version(line: bytes) -> str | None:
    """Take the answer to ``?:V``; None for a line that cannot be it."""
    return line.decode("ascii").strip() if _VERSION.fullmatch(line) else None


@dataclass(frozen=True)
class Dialect:
    """What sets one controller apart from the other.

    Attributes
    ----------
    answers : bool
        Whether set commands are answered with ``OK`` or ``NG``.
    go : str
        Starts what is armed.
    most_pulses, most_speed : int
        Largest move, pulses, and speed, pulses/s.
    """

    model: str
    answers: bool
    go: str
    most_pulses: int
    most_speed: int


SHOT_302GS = Dialect("SHOT-302GS", answers=True, go="G:", most_pulses=268_435_455, most_speed=500_000)
GSC_02 = Dialect("GSC-02", answers=False, go="G", most_pulses=16_777_214, most_speed=20_000)
DIALECTS = {dialect.model: dialect for dialect in (SHOT_302GS, GSC_02)}


@dataclass(frozen=True)
class Speeds:
    """Start speed and speed, pulses/s, and the time of a ramp, ms, as in the ``D:`` command; by default as delivered, not verified."""

    slow: int = 500
    fast: int = 5000
    ramp_ms: int = 200

    def __str__(self) -> str:
        return f"S{self.slow}F{self.fast}R{self.ramp_ms}"

    @property
    def acceleration(self) -> float:
        """Pulses/s^2 with which a ramp from rest would make a long move take as long."""
        return self.fast**2 * 1000 / (self.ramp_ms * (self.fast - self.slow))

    @classmethod
    def nearest(cls, speed: float, acceleration: float, most_speed: int) -> Speeds | None:
        """The setting for a speed (pulses/s) and an acceleration (pulses/s^2), or None when there is none."""
        if not (math.isfinite(speed) and math.isfinite(acceleration) and acceleration > 0 and 2 <= round(speed) <= most_speed):
            return None
        fast = round(speed)
        slow = max(1, min(64, fast // 8))  # slow enough not to lose steps; from 8000 on the controller wants 64
        if most_speed == GSC_02.most_speed and fast > 200:
            slow = max(slow, 50)  # its upper speed range starts there
        ramp_ms = round(1000 * fast**2 / (acceleration * (fast - slow)))
        return cls(slow, fast, ramp_ms) if 1 <= ramp_ms <= 1000 else None


class SigmaKokiAxis:
    """One axis of a controller; satisfies `drivers.kinds.Stage`. Both axes share the controller's link.

    `SigmaKokiAxis.open` asks for the scale; the bare constructor sends nothing.

    Parameters
    ----------
    link : Link
        Terminator CR LF. Stays the caller's to close.
    name : str
        For messages.
    controller : str
        ``SHOT-302GS`` or ``GSC-02``.
    axis : int
        1 or 2.
    degrees_per_pulse : float
        Scale; half steps of 0.0025 deg when not given.
    low_deg, high_deg : float
        Travel; moves beyond it are refused.
    home_direction : str
        ``+`` or ``-``: where a GSC-02 looks for the origin; a SHOT decides by its own settings.
    assume_homed : bool
        The axis was homed since the controller was switched on.
    """

    def __init__(
        self,
        link: Link,
        name: str,
        *,
        controller: str = "SHOT-302GS",
        axis: int = 1,
        degrees_per_pulse: float = FULL_STEP_DEG / 2,
        low_deg: float = -180.0,
        high_deg: float = 180.0,
        home_direction: str = "-",
        assume_homed: bool = False,
    ) -> None:
        if controller not in DIALECTS or axis not in (1, 2) or home_direction not in ("+", "-"):
            given = f"controller {controller!r}, axis {axis}, home_direction {home_direction!r}"
            raise InvalidSetting(given, device=name, expected=f"controller {' or '.join(DIALECTS)}, axis 1 or 2, home_direction + or -")
        if not (math.isfinite(degrees_per_pulse) and degrees_per_pulse > 0):
            raise InvalidSetting(f"degrees_per_pulse {degrees_per_pulse}", device=name, expected="a finite number above 0")
        if not (math.isfinite(low_deg) and math.isfinite(high_deg) and low_deg < high_deg):
            raise InvalidSetting(f"travel {low_deg} to {high_deg} deg", device=name, expected="two finite angles, the lower one first")
        self._dialect = DIALECTS[controller]
        self._wire = _Wire(link, name, axis, self._dialect)
        self._axis = axis
        self._scale = degrees_per_pulse
        self._travel = (low_deg, high_deg)
        self._home_direction = home_direction
        self._homed = assume_homed
        self._homing = False
        self._waiting: _Motion | None = None  # a motion for which the controller was not ready yet
        self._stops = Stops()

    @classmethod
    def open(
        cls,
        link: Link,
        name: str,
        *,
        degrees_per_pulse: float | None = None,
        speed: float | None = None,
        acceleration: float | None = None,
        **options: Any,
    ) -> SigmaKokiAxis:
        """Meet the axis: read the division of its steps unless the scale is given, and set speed and acceleration if given. Nothing moves.

        Parameters
        ----------
        options
            The constructor's.

        Raises
        ------
        DeviceFault
            The controller refuses the speeds, for instance because an axis moves.
        """
        stage = cls(link, name, degrees_per_pulse=FULL_STEP_DEG / 2 if degrees_per_pulse is None else degrees_per_pulse, **options)
        if degrees_per_pulse is None and stage._dialect.answers:
            stage._scale = FULL_STEP_DEG / stage._wire.division("reading the division of steps")
        if speed is not None or acceleration is not None:
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
    def degrees_per_pulse(self) -> float:
        """Scale in use."""
        return self._scale

    def identify(self) -> Identity:
        """Ask the controller for its version, all it tells about itself; the model is the one configured."""
        version = self._wire.version("reading the version")
        return Identity(vendor="Sigma Koki", model=f"{self._dialect.model} axis {self._axis}", serial_number="not told", firmware=version)

    def state(self) -> AxisState:
        """Ask for the status, at rest until two answers agree; and start the motion that was waiting for the controller, if it is ready."""
        attempt = "reading the status"
        with self._wire.lock:
            status = self._steady_status(attempt)
            moving = status.busy and self._wire.controller.moving in (None, self._axis)
            if not status.busy:
                self._wire.controller.moving = None
                self._settle_homing(status)
                with self._stops.lock:
                    waiting, self._waiting = self._waiting, None
                if waiting is not None:
                    self._begin(waiting)
                    moving = True
            return AxisState(
                position=self._deg(status),
                moving=moving or self._waiting is not None,
                homed=self._homed,
                warnings=("limit sensor",) if self._axis in status.limits else (),
                waiting=self._waiting is not None,
            )

    def limits(self) -> tuple[float, float]:
        """The travel configured, deg: the controller knows none."""
        return self._travel

    def profile(self) -> MotionProfile:
        """Speed and acceleration as they were last set on this link, else as delivered: the controller does not tell."""
        speeds = self._wire.controller.speeds[self._axis - 1] or Speeds()
        return MotionProfile(speeds.fast * self._scale, speeds.acceleration * self._scale)

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None:
        """Set speed (deg/s), acceleration (deg/s^2) or both, to the nearest values the controller can express.

        What is not given stays as it was last set on this link, and is that of `PROFILE` the first time: the controller may have been
        left with anything. With nothing given, an axis that was set before is left alone. On a GSC-02 one command sets both axes, a first
        time the other one as delivered.

        Raises
        ------
        InvalidSetting
            A value is not finite, or the controller cannot express it: its ramps take 1 to 1000 ms.
        DeviceFault
            The controller refuses, for instance because an axis moves.
        """
        attempt = "setting speed and acceleration"
        with self._wire.lock:
            known = self._wire.controller.speeds
            if speed is None and acceleration is None and known[self._axis - 1] is not None:
                return
            now = self.profile() if known[self._axis - 1] else PROFILE
            speed = now.speed if speed is None else speed
            acceleration = now.acceleration if acceleration is None else acceleration
            speeds = Speeds.nearest(speed / self._scale, acceleration / self._scale, self._dialect.most_speed)
            if speeds is None:
                raise InvalidSetting(
                    f"speed {speed} deg/s, acceleration {acceleration} deg/s^2",
                    device=self.name,
                    attempt=attempt,
                    expected=f"speed above 0, at most {self._dialect.most_speed * self._scale:g} deg/s, and a ramp of 1 to 1000 ms",
                )
            one, two = (speeds, known[1]) if self._axis == 1 else (known[0], speeds)
            if self._dialect.answers:
                command = f"D:{self._axis}{speeds}"
            else:  # one command for both axes, in one of two ranges
                pair = (one or Speeds(), two or Speeds())
                command = f"D:{2 if max(each.fast for each in pair) > 200 else 1}{pair[0]}{pair[1]}"
            self._wire.act(command, attempt)
            self._wire.controller.speeds = (one, two)

    def start_home(self) -> None:
        """Start the return to the mechanical origin. When it is over, `state` says ``homed``."""
        direction = "" if self._dialect.answers else self._home_direction
        self._homed = self._homing = False
        self._start(_Motion((f"C:{self._axis}1", f"H:{self._axis}{direction}"), "starting to home", self._stops.count, homes=True))

    def start_move(self, deg: float, /) -> None:
        """Start an absolute move (deg), or have it wait until the controller's other axis rests.

        Raises
        ------
        InvalidSetting
            The angle is not a finite number, or too many pulses for one command.
        NotHomed
            The axis has not been homed.
        DeviceFault
            The angle is beyond the travel; or this axis moves; or the controller refuses. Or `stop` came between.
        TransportTimeout, UnexpectedReply
            It is unknown whether the axis moves: stop it.
        """
        if not math.isfinite(deg):
            raise InvalidSetting(f"angle {deg}", device=self.name, attempt="starting to move", expected="a finite angle in degrees")
        attempt = f"starting to move to {deg:.4f} deg"
        stops = self._stops.count
        if not self._homed:
            raise self._wire.fault("no reference position", attempt, kind=NotHomed, expected="a homed axis", hint="home the axis first")
        low, high = self._travel
        if not low <= deg <= high:
            raise self._wire.fault(f"{deg:.4f} deg is beyond the travel", attempt, expected=f"{low:g} to {high:g} deg")
        pulses = round(deg / self._scale)
        if abs(pulses) > self._dialect.most_pulses:
            raise InvalidSetting(f"{pulses} pulses", device=self.name, attempt=attempt, expected=f"at most {self._dialect.most_pulses}")
        arm = f"A:{self._axis}{'-' if pulses < 0 else '+'}P{abs(pulses)}"
        self._start(_Motion((arm, self._dialect.go), attempt, stops))

    def stop(self) -> None:
        """Tell the axis to decelerate to rest, now; forget a motion that waits. Returns when the controller has answered.

        The bytes go out at once, even while other threads wait on the link. A stop that is unanswered or refused is sent once more.
        """
        with self._stops.lock:
            self._stops.count += 1
            self._homing = False
            self._waiting = None
        self._wire.stop()

    def check_arrival(self, deg: float, tolerance: float, /) -> None:
        """Make sure that the axis rests at an angle (deg) because it got there.

        Raises
        ------
        DeviceFault
            A limit sensor stopped the axis; or it still moves; or it rests further than `tolerance` from the angle.
        """
        state = self.state()
        attempt = f"arriving at {deg:.4f} deg"
        if state.warnings:
            raise self._wire.fault(
                f"stopped by a limit sensor at {state.position:.4f} deg",
                attempt,
                expected="an undisturbed motion",
                hint="look for what is in the way, then home the axis",
            )
        require_arrival(self._wire, state, deg, tolerance, attempt)

    def trust_reference(self) -> None:
        """Take the axis as homed: somebody else saw it homed, and nothing has moved it since."""
        with self._stops.lock:
            self._homed = True

    def close(self) -> None:
        """Let go of the axis without moving it. The link stays open for the other one."""
        self._wire.closed = True

    def _deg(self, status: Status) -> float:
        return status.pulses[self._axis - 1] * self._scale

    def _steady_status(self, attempt: str) -> Status:
        """The status; of a controller at rest once two in turn agree: a digit damaged on the line must not pass for another angle."""
        statuses = [self._wire.status(attempt)]
        while statuses[-1].busy is False:
            statuses.append(self._wire.status(attempt))
            if statuses[-1] == statuses[-2]:
                break
            if len(statuses) == _READINGS:
                seen = ", ".join(f"{self._deg(status):.4f}" for status in statuses)
                raise self._wire.unexpected(f"positions {seen} deg at rest", attempt, "two in turn that agree", hint="check the cable")
        return statuses[-1]

    def _settle_homing(self, status: Status) -> None:
        with self._stops.lock:
            if self._homing:
                self._homed, self._homing = status.pulses[self._axis - 1] == 0, False

    def _start(self, motion: _Motion) -> None:
        with self._wire.lock:
            status = self._wire.status(motion.attempt)
            if status.busy and self._wire.controller.moving != 3 - self._axis:
                raise self._wire.fault("the controller is busy", motion.attempt, expected="an axis at rest", hint="wait, or stop the axis")
            if status.busy:
                with self._stops.lock:
                    if self._stops.count == motion.stops:
                        self._waiting = motion
                        return
            self._begin(motion)

    def _begin(self, motion: _Motion) -> None:
        """Send a motion's commands, unless `stop` was called since: a stop must not be followed by an older motion."""
        veto = self._stops.veto(self._wire, motion.attempt, motion.stops)
        for command in motion.commands:
            self._wire.act(command, motion.attempt, veto=veto)
        self._wire.controller.moving = self._axis
        with self._stops.lock:
            self._homing = motion.homes and self._stops.count == motion.stops


@dataclass(frozen=True)
class _Motion:
    """The commands that start a motion, and how often the axis had been stopped when it was asked for."""

    commands: tuple[str, ...]
    attempt: str
    stops: int
    homes: bool = False


class _Controller:
    """What both axes on one link have in common."""

    def __init__(self, link: Link) -> None:
        self.doubt = Doubt(link)
        self.moving: int | None = None  # the axis started last, while the controller is busy
        self.speeds: tuple[Speeds | None, Speeds | None] = (None, None)  # as this program set them


class _Wire(Endpoint):
    """Questions and answers with one axis' controller."""

    def __init__(self, link: Link, name: str, axis: int, dialect: Dialect) -> None:
        super().__init__(link, name)
        self.controller = link.shared(_Controller)
        self._doubt = self.controller.doubt
        self._axis = axis
        self._dialect = dialect

    @property
    def lock(self) -> threading.RLock:
        """Held for whole sequences, but never by a stop."""
        return self._doubt.lock

    def status(self, attempt: str) -> Status:
        """Ask for the status."""
        return self._read("Q:", _status_or_not_ours, attempt, "a status")

    def division(self, attempt: str) -> int:
        """Ask for the division of the axis' steps."""

        def accept(line: bytes) -> int | None:
            if line in _WORDS[2:] or _STATUS.fullmatch(line):
                return None
            match = _DIVISIONS.fullmatch(line)
            if match is None or not int(match[self._axis]):
                raise UnexpectedReply("no divisions", raw=line, expected="two numbers like '2,2'", hint="give degrees_per_pulse")
            return int(match[self._axis])

        return self._read("?:SW", accept, attempt, "two numbers like '2,2'")

    def version(self, attempt: str) -> str:
        """Ask for the version, dropping all that comes before: the controller answers in order, so nothing is owed us then."""
        with self.lock:
            found = self._exchange("?:V", find_version, attempt, "a version", repeatable=True)
            self._doubt.settled()
        return found

    def act(self, command: str, attempt: str, *, veto: Veto | None = None) -> None:
        """Send a command that changes something, once, and make sure that the controller took it."""
        taken = self._doubt.once(lambda: self._command(command, attempt, veto=veto), lambda: self.version(attempt))
        if not taken:
            raise self.fault(f"{command} was refused", attempt, expected="OK", hint="is an axis still moving, or its motor switched off?")

    def stop(self) -> None:
        """Send the stop, past whoever waits on the link."""
        command, attempt = f"L:{self._axis}", "stopping"
        # ACK1 does not tell of a command that was lost, so one that is not answered goes out twice.
        message = command if self._dialect.answers else f"{command}\r\n{command}"

        def taken() -> bool:
            return self._doubt.urgently(lambda: self._command(message, attempt, urgent=True))

        if taken():
            return
        self.link.tell("repeated", f"{command} was refused", device=self.name, attempt=attempt)  # it may have been damaged on the line
        if not taken() and self._dialect.answers:
            raise self.fault(f"{command} was refused", attempt, expected="OK", hint="check the controller's command mode")

    def _command(self, command: str, attempt: str, *, urgent: bool = False, veto: Veto | None = None) -> bool:
        """Send a command and say whether it was taken."""
        if self._dialect.answers:
            word: Literal["OK", "NG"] = self._exchange(command, _word_or_not_ours, attempt, "OK or NG", urgent=urgent, veto=veto)
            return word == "OK"
        status = self._exchange(f"{command}\r\nQ:", _status_or_not_ours, attempt, "a status", urgent=urgent, veto=veto)
        return not status.failed

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
        return self.exchange(message.encode("ascii") + b"\r\n", accept, attempt, expected, repeatable=repeatable, urgent=urgent, veto=veto)


def _status_or_not_ours(line: bytes) -> Status | None:
    """Leave the answer to a stop that overtook to the stop."""
    return None if line in _WORDS else parse_status(line)


def _word_or_not_ours(line: bytes) -> Literal["OK", "NG"] | None:
    if line == b"OK":
        return "OK"
    if line == b"NG":
        return "NG"
    if _STATUS.fullmatch(line) or _DIVISIONS.fullmatch(line):
        return None
    raise UnexpectedReply("no acknowledgement", raw=line, expected="OK or NG")
