"""Simulated Newport ESP301: a motion controller with up to three rotary stages, its command set over a serial line.

Source: Newport ESP300/ESP301 user's manuals and the open drivers, as condensed in the project's protocol sheet, section 2.1. Not verified,
and what is done here: each query of a joined message answers on a line of its own; a target beyond a software limit is refused, with
the limit's error, and starts nothing; a new target under way replaces the old one; `AB` brakes hard and leaves the motor power on;
`WS` and `WP` hold back all that follows on the same line; changing the units rescales every value; the written form of numbers.
General errors other than 6, 7, 9, 37 and 38 are never raised by the simulator itself.

Readback follows the commanded trajectory in whole encoder counts; the ringing of the mechanics after a stop shows in `Axis.track` only.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sim import motion
from sim.clock import Clock
from sim.errors import SimError
from sim.troubles import cut_short
from sim.wire import Line, Splitter

LONGEST_MESSAGE = 256
QUEUE = 10
"""Errors kept; later ones are lost. Source: `TB` in the manuals of Newport's command family."""
TICK = 400e-6
"""Unit of the error queue's timestamps, s."""
MOST_AXES = 3

_COMMAND = re.compile(r"(?P<axis>\d*)\s*(?P<name>[A-Za-z]{2})\s*(?P<data>.*)", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(E[+-]?\d{1,2})?", re.IGNORECASE | re.ASCII)

_GENERAL = {
    0: "NO ERROR DETECTED",
    4: "EMERGENCY STOP ACTIVATED",
    6: "COMMAND DOES NOT EXIST",
    7: "PARAMETER OUT OF RANGE",
    8: "CABLE INTERLOCK ERROR",
    9: "AXIS NUMBER OUT OF RANGE",
    37: "AXIS NUMBER MISSING",
    38: "COMMAND PARAMETER MISSING",
}
_OF_AXIS = {
    0: "MOTOR TYPE NOT DEFINED",
    1: "PARAMETER OUT OF RANGE",
    2: "AMPLIFIER FAULT DETECTED",
    3: "FOLLOWING ERROR THRESHOLD EXCEEDED",
    4: "POSITIVE HARDWARE LIMIT DETECTED",
    5: "NEGATIVE HARDWARE LIMIT DETECTED",
    6: "POSITIVE SOFTWARE LIMIT DETECTED",
    7: "NEGATIVE SOFTWARE LIMIT DETECTED",
    8: "MOTOR / STAGE NOT CONNECTED",
    9: "FEEDBACK SIGNAL FAULT DETECTED",
    10: "MAXIMUM VELOCITY EXCEEDED",
    11: "MAXIMUM ACCELERATION EXCEEDED",
    13: "MOTOR NOT ENABLED",
    20: "HOMING ABORTED",
    30: "COMMAND NOT ALLOWED DURING HOMING",
}


def text_of(code: int) -> str:
    """Return the text of an error code: axis x 100 + error, or a general one below 100."""
    return (_OF_AXIS.get(code % 100) if code >= 100 else _GENERAL.get(code)) or "RESERVED"


class _Error(Exception):
    """A command that ends in the error queue, with a general code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class _AxisError(Exception):
    """A command that ends in the error queue, with a code of the axis."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class EspStage:
    """What a rotary stage on the controller is like; angles in degrees, speeds in deg/s. All numbers are settable placeholders.

    Parameters
    ----------
    identity : str
        Answer to `ID?`.
    count : float
        Degrees in one encoder count.
    limit_min, limit_max : float
        Software limits as delivered.
    hard_min, hard_max : float
        Limit switches, in true degrees from the home switch.
    speed, acceleration, top_speed, top_acceleration : float
        `VA`, `AC` and `AG`, and the highest they may be (`VU`, `AU`).
    home_speed, creep_speed : float
        Homing runs at `OH` to just beside the switch and creeps onto it.
    abort_deceleration : float
        `AE`, deg/s^2.
    ringing : Ringing
        Of the mechanics, degrees.
    """

    identity: str = "URS75BCC, SN00000"
    count: float = 0.0002
    limit_min: float = 0.0
    limit_max: float = 360.0
    hard_min: float = -10.0
    hard_max: float = 370.0
    speed: float = 60.0
    acceleration: float = 600.0
    top_speed: float = 80.0
    top_acceleration: float = 1200.0
    home_speed: float = 30.0
    creep_speed: float = 2.0
    abort_deceleration: float = 2400.0
    ringing: motion.Ringing = field(default_factory=motion.Ringing)

    def __post_init__(self) -> None:
        positive = (self.count, self.speed, self.acceleration, self.top_speed, self.top_acceleration, self.home_speed, self.creep_speed)
        ordered = self.hard_min < self.hard_max and self.limit_min < self.limit_max
        if not (all(0 < number < math.inf for number in (*positive, self.abort_deceleration)) and ordered):
            raise SimError(f"{self}: speeds, accelerations and counts must be above zero, and each lower limit below its upper one")


class Axis:
    """One rotary axis: settings, motor power, counter, and the true angle of its arm in `track` (degrees, zero at the home switch)."""

    def __init__(self, stage: EspStage, angle: float) -> None:
        self.stage = stage
        self.track = motion.Track(angle, stage.ringing)
        self.power = False
        self.units = 7
        self._zero = angle  # where the counter reads zero: it starts at zero wherever the arm stands
        self._target = 0.0
        self._homing: float | None = None  # true angle where the counter will read zero
        self._ends_with: int | None = None  # error code that the motion under way will end in
        # Degrees inside, whatever the units outside.
        self.settings = {
            "VA": stage.speed,
            "AC": stage.acceleration,
            "AG": stage.acceleration,
            "VU": stage.top_speed,
            "AU": stage.top_acceleration,
            "AE": stage.abort_deceleration,
            "OH": stage.home_speed,
            "SL": stage.limit_min,
            "SR": stage.limit_max,
        }

    @property
    def per_unit(self) -> float:
        """Degrees in one of the units in use: counts, steps, deg, grad, rad, mrad, urad."""
        count = self.stage.count
        return {0: count, 1: count, 7: 1.0, 8: 0.9, 9: math.degrees(1), 10: math.degrees(1e-3), 11: math.degrees(1e-6)}[self.units]

    def update(self, t: float) -> int | None:
        """Take note of what ended by time `t`: a homing, or a motion onto a limit switch, whose error code is returned."""
        if t < self.track.end:
            return None
        ended, self._ends_with = self._ends_with, None
        if self._homing is not None and ended is None:
            self._zero, self._target = self._homing, 0.0
        self._homing = None
        if ended == 3:
            self.power = False
        return ended

    def busy(self, t: float) -> bool:
        """Tell whether the axis is moving; the ringing afterwards does not count."""
        return t < self.track.end

    def position(self, t: float) -> float:
        """Return the encoder's reading in degrees."""
        return self._counted(self.track.nominal(t)[0] - self._zero)

    def _counted(self, deg: float) -> float:
        return round(deg / self.stage.count) * self.stage.count

    @property
    def target(self) -> float:
        """Where the axis was sent, degrees."""
        return self._target

    def _begin(self, t: float, segments: motion.Segments) -> None:
        self._ends_with = None
        self.track.begin(t, segments)

    def _go(self, t: float, true: float, speed: float) -> None:
        """Start towards a true angle, ending early on a limit switch."""
        reachable = min(max(true, self.stage.hard_min), self.stage.hard_max)
        position, velocity = self.track.nominal(t)
        acceleration = min(self.settings["AC"], self.settings["AG"])
        self._begin(t, motion.to_target(position, velocity, reachable, speed, acceleration))
        if reachable != true:
            self._ends_with = 4 if true > reachable else 5

    def move(self, t: float, deg: float) -> None:
        """Start an absolute move: `PA`.

        Raises
        ------
        _AxisError
            The motor is off, the axis is homing, or the target lies beyond a software limit.
        """
        self._ready()
        if deg > self.settings["SR"]:
            raise _AxisError(6)
        if deg < self.settings["SL"]:
            raise _AxisError(7)
        self._target = deg
        self._go(t, self._zero + self._counted(deg), self.settings["VA"])

    def jog(self, t: float, way: float) -> None:
        """Move until stopped, or to the limit switch: `MV`."""
        self._ready()
        self._go(t, way * 1e6, self.settings["VA"])

    def _ready(self) -> None:
        if not self.power:
            raise _AxisError(13)
        if self._homing is not None:
            raise _AxisError(30)

    def home(self, t: float, search: int) -> None:
        """Search for the reference: `OR`; 0 the counter's zero, 1 and 2 the home switch, 3 and 5 the upper limit switch, 4 and 6 the lower.

        Raises
        ------
        _AxisError
            The motor is off, or the axis is homing already.
        """
        self._ready()
        if search == 0:
            self._target = 0.0
            self._go(t, self._zero, self.settings["VA"])
            return
        index = {1: 0.0, 2: 0.0, 3: self.stage.hard_max, 5: self.stage.hard_max}.get(search, self.stage.hard_min)
        beside = index - 1.0 if search in (3, 5) else index + 1.0
        position, velocity = self.track.nominal(t)
        acceleration = self.settings["AC"]
        fast = motion.to_target(position, velocity, beside, self.settings["OH"], acceleration)
        self._begin(t, (*fast, *motion.to_target(beside, 0.0, index, self.stage.creep_speed, acceleration)))
        self._homing = index

    def stop(self, t: float, deceleration: str = "AG") -> int | None:
        """Brake to rest: `ST`, `AB`; return the error a broken-off homing leaves."""
        if not self.busy(t):
            return None
        aborted = 20 if self._homing is not None else None
        self._homing = None
        self._begin(t, motion.to_rest(self.track.nominal(t)[1], self.settings[deceleration]))
        return aborted

    def halt(self, t: float, stalls: bool, rng: np.random.Generator) -> tuple[float, int]:
        """Plan that the motion under way ends dead, stalled and without power or on a limit switch; return where and the error."""
        halted, velocity = cut_short(self.track, t, rng)
        self._ends_with = 3 if stalls else 4 if velocity > 0 else 5
        return halted - self._zero, self._ends_with

    def define(self, t: float, deg: float) -> None:
        """Call the present position `deg`: `DH`."""
        self._zero = self.track.nominal(t)[0] - deg


class Esp301:
    """A controller with a stage on each of its axes 1 to N.

    `on_stop`, where set, is told each axis that `ST` or `AB` speaks to.

    Parameters
    ----------
    clock : Clock
        Simulated time; the controller is switched on when it is made.
    angles : sequence of float
        The true angle each arm stands at when power comes, degrees from its home switch.
    stage : EspStage
        All stages are alike.
    name : str
        Of the port.
    version : str
        Answer to `VE?`.
    """

    model = "newport-esp301"
    troubles = ("alarm", "stall", "limit-hit")

    def __init__(
        self,
        clock: Clock,
        angles: Sequence[float],
        stage: EspStage | None = None,
        name: str = "esp301",
        version: str = "ESP301 Version 3.10 simulated",
    ) -> None:
        if not 1 <= len(angles) <= MOST_AXES:
            raise SimError(f"a controller of {len(angles)} axes: expected 1 to {MOST_AXES}")
        self.name = name
        self.axes = tuple(Axis(stage or EspStage(), angle) for angle in angles)
        self.on_stop: Callable[[str], None] | None = None
        self._version = version
        self._clock = clock
        self._power_on = clock.now()
        self._errors: deque[tuple[int, int]] = deque()

    async def serve(self, line: Line) -> None:
        """Answer messages on `line`, one after another, until the client has gone."""
        splitter = Splitter(LONGEST_MESSAGE)
        while data := await line.read():
            for message in splitter.feed(data):
                for command in message.split(b";"):
                    held_until, reply = self.execute(command)
                    if reply is not None:
                        line.write(reply.encode("ascii") + b"\r\n")
                    if held_until is not None:
                        await line.drain()
                        await self._clock.sleep_until(held_until)
            await line.drain()

    def fail(self, axis: int, error: int) -> None:
        """Let axis `axis` (from 1) fail with an error of its own, e.g. 3, following error: it stops dead and the motor power goes."""
        now = self._clock.now()
        self._update(now)
        broken = self.axes[axis - 1]
        broken.stop(now)
        broken.track.begin(now, ())
        broken.power = False
        self._record(axis * 100 + error)

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Let the amplifier of a drawn axis fail, or have an axis that moves halt; see `sim.troubles`."""
        now = self._clock.now()
        numbers = [number for number, axis in enumerate(self.axes, 1) if kind == "alarm" or axis.busy(now)]
        if not numbers:
            return None
        number = numbers[int(rng.integers(len(numbers)))]
        if kind == "alarm":
            self.fail(number, 2)
            return f"axis {number}: error {number * 100 + 2}, motor off"
        where, error = self.axes[number - 1].halt(now, kind == "stall", rng)
        return f"axis {number} halts at {where:.4f} deg: error {number * 100 + error}"

    def emergency(self) -> None:
        """Press the red button: every axis brakes hard and loses its motor power, and error 4 is left."""
        now = self._clock.now()
        self._update(now)
        for axis in self.axes:
            axis.stop(now, "AE")
            axis.power = False
        self._record(4)

    def execute(self, command: bytes) -> tuple[float | None, str | None]:
        """Carry out one command; return until when it holds back the next (simulated s, None for not at all) and its reply, if any."""
        now = self._clock.now()
        self._update(now)
        text = command.decode("latin-1").strip()
        if not text:
            return None, None
        try:
            found = _COMMAND.fullmatch(text)
            if found is None:
                raise _Error(6)
            name, data = found["name"].upper(), found["data"].strip()
            if name in ("WS", "WP"):
                return self._wait(name, self._axis(found["axis"]), data, now), None
            whole = name in _CONTROLLER or (name == "AB" and not found["axis"])
            return None, self._controller(name, data, now) if whole else self._of_axis(found["axis"], name, data, now)
        except _Error as error:
            self._record(error.code)
        return None, None

    def _update(self, now: float) -> None:
        for number, axis in enumerate(self.axes, 1):
            if (ended := axis.update(now)) is not None:
                self._record(number * 100 + ended)

    def _record(self, code: int) -> None:
        if len(self._errors) < QUEUE:
            self._errors.append((code, self._ticks()))

    def _ticks(self) -> int:
        return int((self._clock.now() - self._power_on) / TICK)

    def _axis(self, number: str) -> Axis:
        if not number:
            raise _Error(37)
        if len(number) > 3 or not 1 <= int(number) <= MOST_AXES:
            raise _Error(9)
        if int(number) > len(self.axes):
            raise _Error(int(number) * 100 + 8)
        return self.axes[int(number) - 1]

    def _controller(self, name: str, data: str, now: float) -> str | None:
        """Carry out a command of the controller as a whole."""
        match name, data:
            case ("TE", "?" | ""):
                return str(self._errors.popleft()[0] if self._errors else 0)
            case ("TB", "?" | ""):
                code, ticks = self._errors.popleft() if self._errors else (0, self._ticks())
                return f"{code}, {ticks}, {text_of(code)}"
            case ("TS", "?" | ""):
                moving = sum(1 << place for place, axis in enumerate(self.axes) if axis.busy(now))
                return chr(0x40 | moving | 0x10 * any(axis.power for axis in self.axes))  # bit 6 is set in the manual's examples
            case ("VE", "?" | ""):
                return self._version
            case ("AB", ""):
                for number, axis in enumerate(self.axes, 1):
                    self._stop(number, axis, now, "AE")
                return None
        raise _Error(7)

    def _stop(self, number: int, axis: Axis, now: float, deceleration: str) -> None:
        self._stopped(number, axis.stop(now, deceleration))
        if self.on_stop is not None:
            self.on_stop(str(number))

    def _stopped(self, number: int, error: int | None) -> None:
        if error is not None:
            self._record(number * 100 + error)

    def _wait(self, name: str, axis: Axis, data: str, now: float) -> float:
        """Return when `WS` (motion ended, and so many ms more) or `WP` (position reached) lets go."""
        number = 0.0 if name == "WS" and not data else _number(data)
        end = axis.track.end if axis.track.end < math.inf else now
        if name == "WS":
            return max(now, end) + max(0.0, number) / 1000
        low, high = now, max(now, end)
        start, wanted = axis.position(now), number * axis.per_unit
        if (axis.position(high) - wanted) * (start - wanted) > 0:
            return high  # never passed: until the motion ends
        for _ in range(50):
            middle = (low + high) / 2
            passed = (axis.position(middle) - wanted) * (start - wanted) <= 0
            low, high = (low, middle) if passed else (middle, high)
        return high

    def _of_axis(self, number: str, name: str, data: str, now: float) -> str | None:
        if name not in _AXIS:
            raise _Error(6)
        axis = self._axis(number)
        try:
            if data == "?" or name in ("TP", "TV"):
                return self._ask(axis, name, now)
            self._tell(int(number), axis, name, data, now)
        except _AxisError as error:
            raise _Error(int(number) * 100 + error.code) from None
        return None

    @staticmethod
    def _ask(axis: Axis, name: str, now: float) -> str:
        match name:
            case "TP":
                return f"{axis.position(now) / axis.per_unit:.6f}"
            case "TV":
                return f"{axis.track.nominal(now)[1] / axis.per_unit:.6f}"
            case "DP":
                return f"{axis.target / axis.per_unit:.6f}"
            case "MD":
                return str(int(not axis.busy(now)))
            case "MO" | "MF":
                return str(int(axis.power))
            case "SN":
                return str(axis.units)
            case "ID":
                return axis.stage.identity
            case "DH":
                return "0.000000"
        if name not in axis.settings:
            raise _Error(7)
        return f"{axis.settings[name] / axis.per_unit:.6f}"

    def _tell(self, number: int, axis: Axis, name: str, data: str, now: float) -> None:
        match name:
            case "MO":
                axis.power = True
            case "MF":
                self._stopped(number, axis.stop(now, "AE"))
                axis.power = False
            case "PA":
                axis.move(now, _number(data) * axis.per_unit)
            case "PR":
                start = axis.target if axis.busy(now) else axis.position(now)
                axis.move(now, start + _number(data) * axis.per_unit)
            case "MV" if data in ("+", "-"):
                axis.jog(now, 1.0 if data == "+" else -1.0)
            case "OR":
                search = _number(data or "0")
                if search not in range(7):
                    raise _AxisError(1)
                axis.home(now, int(search))
            case "ST":
                self._stop(number, axis, now, "AG")
            case "AB":
                self._stop(number, axis, now, "AE")
            case "DH":
                axis.define(now, _number(data or "0") * axis.per_unit)
            case "SN":
                units = _number(data)
                if units not in (0, 1, 7, 8, 9, 10, 11):
                    raise _AxisError(1)
                axis.units = int(units)
            case _ if name in axis.settings:
                self._set(axis, name, _number(data) * axis.per_unit)
            case _:
                raise _Error(7)

    @staticmethod
    def _set(axis: Axis, name: str, value: float) -> None:
        settings = axis.settings | {name: value}
        if name not in ("SL", "SR") and value <= 0:
            raise _AxisError(1)
        if settings["SL"] >= settings["SR"]:
            raise _AxisError(1)
        if name in ("VA", "OH") and value > settings["VU"]:
            raise _AxisError(10)
        if name in ("AC", "AG") and value > settings["AU"]:
            raise _AxisError(11)
        axis.settings = settings


_CONTROLLER = frozenset({"TE", "TB", "TS", "VE"})
_AXIS = frozenset("MO MF MD PA PR MV TP TV DP OR ST AB DH SN ID VA AC AG VU AU AE OH SL SR".split(" "))  # noqa: SIM905


def _number(data: str) -> float:
    if not data:
        raise _Error(38)
    if not _NUMBER.fullmatch(data) or abs(float(data)) > 1e12:
        raise _Error(7)
    return float(data)
