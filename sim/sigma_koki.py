"""Simulated Sigma Koki two-axis stage controllers, SHOT-302GS and GSC-02, with rotary stages.

Source: open drivers of these controllers, as condensed in the project's protocol sheet, section 3. Not verified, and what is done here:
a move of a motor without excitation is refused; the start speed of `D:` shortens the ramps and is not itself a jump; an axis on a limit
sensor is stopped there and its flag stays until it moves away; what was armed and not started is forgotten at the next arming or stop;
the written form of `?:V`. Left out: interpolation, teaching, programs, the enhanced and HIT command sets, the I/O port.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sim import motion
from sim.clock import Clock
from sim.errors import SimError
from sim.troubles import cut_short
from sim.wire import Line, Splitter

LONGEST_MESSAGE = 128
AXES = 2
COUNTER = 999_999_999

_PULSES = re.compile(r"([+-])P(\d{1,10})", re.ASCII)
_SPEEDS = re.compile(r"S(\d{1,7})F(\d{1,7})R(\d{1,5})", re.ASCII)
_DIVISIONS = (1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 80, 100, 125, 200, 250)


class _Refused(Exception):
    """A command that is answered `NG`, or leaves `X` in ACK1."""


@dataclass(frozen=True)
class Kind:
    """What sets one controller apart from the other.

    Parameters
    ----------
    model, version : str
        Catalogue name, and answer to `?:V`.
    answers : bool
        Whether set commands are answered with `OK` or `NG`.
    most_pulses : int
        Largest number in one command.
    most_speed : int
        Pulses/s.
    """

    model: str
    version: str
    answers: bool
    most_pulses: int
    most_speed: int


SHOT_302GS = Kind("sigma-koki-shot-302gs", "V1.00", True, 268_435_455, 500_000)
GSC_02 = Kind("sigma-koki-gsc-02", "V1.00", False, 16_777_214, 20_000)


@dataclass(frozen=True)
class StageModel:
    """What a rotary stage is like; angles in degrees.

    Parameters
    ----------
    full_step : float
        Degrees in one step at division 1 (SGSP and OSMS-60YAW).
    division : int
        As delivered; the GSC-02 knows half steps only.
    slow, fast, ramp : int
        Speeds as delivered, pulses/s, and the ramp, ms.
    sensor_min, sensor_max : float
        Limit sensors, in true degrees from the origin sensor.
    home_speed, creep_speed : float
        Homing runs fast to just beside the origin and creeps onto it, deg/s.
    ringing : Ringing
        Of the mechanics, degrees.
    """

    full_step: float = 0.005
    division: int = 2
    slow: int = 500
    fast: int = 5000
    ramp: int = 200
    sensor_min: float = -400.0
    sensor_max: float = 400.0
    home_speed: float = 25.0
    creep_speed: float = 2.0
    ringing: motion.Ringing = field(default_factory=motion.Ringing)

    def __post_init__(self) -> None:
        positive = all(0 < number < math.inf for number in (self.full_step, self.slow, self.home_speed, self.creep_speed))
        if not (positive and self.division in _DIVISIONS and self.slow <= self.fast and self.sensor_min < self.sensor_max):
            raise SimError(f"{self}: speeds and step must be above zero, slow at most fast, the division one of {_DIVISIONS}")


class Axis:
    """One rotary axis: counter, speeds, excitation, limit flag, and the true angle of its arm in `track` (degrees from the origin)."""

    def __init__(self, stage: StageModel, angle: float) -> None:
        self.stage = stage
        self.track = motion.Track(angle, stage.ringing)
        self.division = stage.division
        self.speeds = (stage.slow, stage.fast, stage.ramp)
        self.excited = True
        self.on_limit = False
        self.armed: Callable[[float], None] | None = None
        self._zero = angle  # where the counter reads zero: at power-up, wherever the arm stands
        self._homing = False
        self._meets_limit = False

    @property
    def per_pulse(self) -> float:
        """Degrees in one pulse."""
        return self.stage.full_step / self.division

    def update(self, t: float) -> None:
        """Take note of a homing or a run onto a limit sensor that ended by time `t`."""
        if t < self.track.end:
            return
        if self._homing:
            self._homing, self._zero = False, 0.0
        if self._meets_limit:
            self._meets_limit, self.on_limit = False, True

    def busy(self, t: float) -> bool:
        """Tell whether the axis is moving; the ringing afterwards does not count."""
        return t < self.track.end

    def pulses(self, t: float) -> int:
        """Return the counter."""
        return round((self.track.nominal(t)[0] - self._zero) / self.per_pulse)

    def acceleration(self) -> float:
        """Return what makes a long move take as long as with start speed and ramp, deg/s^2."""
        slow, fast, ramp = self.speeds
        return fast**2 / (max(ramp, 1) / 1000 * max(fast - slow, 1)) * self.per_pulse

    def _begin(self, t: float, segments: motion.Segments) -> None:
        self._homing = self._meets_limit = self.on_limit = False
        self.track.begin(t, segments)

    def run(self, t: float, true: float, speed: float) -> None:
        """Go to a true angle, or to the limit sensor before it."""
        reachable = min(max(true, self.stage.sensor_min), self.stage.sensor_max)
        self._begin(t, motion.to_target(*self.track.nominal(t), reachable, speed, self.acceleration()))
        self._meets_limit = reachable != true

    def go_to(self, t: float, pulses: int) -> None:
        """Start for a count of the counter."""
        self.run(t, self._zero + pulses * self.per_pulse, self.speeds[1] * self.per_pulse)

    def jog(self, t: float, way: int) -> None:
        """Run at start speed until stopped or on the limit sensor."""
        self.run(t, way * 1e9, self.speeds[0] * self.per_pulse)

    def home(self, t: float) -> None:
        """Return to the mechanical origin."""
        fast = motion.to_target(*self.track.nominal(t), 1.0, self.stage.home_speed, self.acceleration())
        self._begin(t, (*fast, *motion.to_target(1.0, 0.0, 0.0, self.stage.creep_speed, self.acceleration())))
        self._homing = True

    def stop(self, t: float, *, dead: bool = False) -> None:
        """Brake to rest, or stop dead; what was armed is forgotten."""
        self.armed = None
        if self.busy(t):
            self._begin(t, () if dead else motion.to_rest(self.track.nominal(t)[1], self.acceleration()))

    def halt(self, t: float, rng: np.random.Generator) -> int:
        """Plan that the motion under way ends dead on a limit sensor; return the count there."""
        halted, _ = cut_short(self.track, t, rng)
        self._homing, self._meets_limit = False, True
        return round((halted - self._zero) / self.per_pulse)

    def zero(self, t: float) -> None:
        """Call the present position zero."""
        self._zero = self.track.nominal(t)[0]

    def divide(self, t: float, division: int) -> None:
        """Change the steps' division; the counter keeps its number."""
        count = self.pulses(t)
        self.division = division
        self._zero = self.track.nominal(t)[0] - count * self.per_pulse


class SigmaKoki:
    """A two-axis controller. It has no way to tell of a stall or an alarm.

    `on_stop`, where set, is told each axis that `L:` speaks to.

    Parameters
    ----------
    clock : Clock
        Simulated time; the controller is switched on when it is made.
    angles : sequence of float
        The true angle of each arm when power comes, degrees from its origin sensor.
    kind : Kind
        `SHOT_302GS` or `GSC_02`.
    stage : StageModel
        Both stages are alike.
    name : str
        Of the port.
    """

    troubles = ("limit-hit",)

    def __init__(
        self, clock: Clock, angles: Sequence[float], kind: Kind = SHOT_302GS, stage: StageModel | None = None, name: str = "sigma"
    ) -> None:
        if len(angles) != AXES:
            raise SimError(f"a controller of {len(angles)} axes: expected {AXES}")
        self.name = name
        self.model = kind.model
        self.axes = tuple(Axis(stage or StageModel(), angle) for angle in angles)
        self.on_stop: Callable[[str], None] | None = None
        self._kind = kind
        self._clock = clock
        self._failed = False  # ACK1

    async def serve(self, line: Line) -> None:
        """Answer commands on `line` until the client has gone."""
        splitter = Splitter(LONGEST_MESSAGE)
        while data := await line.read():
            for message in splitter.feed(data):
                if (reply := self.answer(message)) is not None:
                    line.write(reply + b"\r\n")
            await line.drain()

    def limit(self, axis: int) -> None:
        """Let axis `axis` (from 1) touch a limit sensor where it is: it stops dead."""
        now = self._clock.now()
        self.axes[axis - 1].stop(now, dead=True)
        self.axes[axis - 1].on_limit = True

    def trouble(self, kind: str, rng: np.random.Generator) -> str | None:
        """Let an axis that moves touch a limit sensor on its way; see `sim.troubles`."""
        now = self._clock.now()
        numbers = [number for number, axis in enumerate(self.axes, 1) if axis.busy(now)]
        if not numbers:
            return None
        number = numbers[int(rng.integers(len(numbers)))]
        return f"axis {number} halts at {self.axes[number - 1].halt(now, rng)} pulses on a limit sensor"

    def answer(self, message: bytes) -> bytes | None:
        """Carry out one command; return its reply without the line end, or None."""
        now = self._clock.now()
        for axis in self.axes:
            axis.update(now)
        text = message.decode("latin-1").strip()
        if text == "Q:":
            return self._status(now).encode("ascii")
        if text == "!:":
            return b"B" if self._busy(now) else b"R"
        try:
            if text == "?:V":
                return self._kind.version.encode("ascii")
            if text == "?:SW" and self._kind.answers:
                return ",".join(str(axis.division) for axis in self.axes).encode("ascii")
            self._execute(text, now)
            self._failed = False
        except _Refused:
            self._failed = True
            return b"NG" if self._kind.answers or text.startswith("?") else None
        return b"OK" if self._kind.answers else None

    def _busy(self, now: float) -> bool:
        return any(axis.busy(now) for axis in self.axes)

    def _status(self, now: float) -> str:
        counts = [axis.pulses(now) for axis in self.axes]
        fields = [f"{'-' if count < 0 else ' '}{min(abs(count), COUNTER):9d}" for count in counts]
        limits = {(False, False): "K", (True, False): "L", (False, True): "M", (True, True): "W"}
        on = limits[self.axes[0].on_limit, self.axes[1].on_limit]
        return f"{fields[0]},{fields[1]},{'X' if self._failed else 'K'},{on},{'B' if self._busy(now) else 'R'}"

    def _execute(self, text: str, now: float) -> None:
        letter, colon, rest = text[:1], text[1:2], text[2:]
        if letter == "G" and colon in ("", ":") and not rest:
            self._refuse_while_busy(now)
            self._go(now)
            return
        if colon != ":":
            raise _Refused
        if letter == "L":
            self._stop(rest, now)
            return
        self._refuse_while_busy(now)
        match letter:
            case "H":
                self._home(rest, now)
            case "M" | "A":
                self._arm_moves(rest, absolute=letter == "A", now=now)
            case "J":
                self._arm_jogs(rest)
            case "R":
                for axis in self._chosen(rest):
                    axis.zero(now)
            case "D":
                self._set_speeds(rest)
            case "C" if rest[1:] in ("0", "1"):
                for axis in self._chosen(rest[:1]):
                    axis.excited = rest[1:] == "1"
            case "S" if self._kind.answers:
                if not (rest[1:].isascii() and rest[1:].isdecimal() and len(rest) < 6 and int(rest[1:]) in _DIVISIONS):
                    raise _Refused
                for axis in self._chosen(rest[:1]):
                    axis.divide(now, int(rest[1:]))
            case _:
                raise _Refused

    def _refuse_while_busy(self, now: float) -> None:
        if self._busy(now):
            raise _Refused

    def _chosen(self, which: str) -> tuple[Axis, ...]:
        chosen = {"1": self.axes[:1], "2": self.axes[1:], "W": self.axes}.get(which)
        if chosen is None:
            raise _Refused
        return chosen

    def _go(self, now: float) -> None:
        armed = [axis for axis in self.axes if axis.armed is not None]
        if not all(axis.excited for axis in armed):
            raise _Refused
        for axis in armed:
            assert axis.armed is not None
            axis.armed(now)
            axis.armed = None

    def _home(self, rest: str, now: float) -> None:
        axes = self._chosen(rest[:1])
        # The GSC-02 wants a direction for each axis, the SHOT none.
        if not _signs(rest[1:], 0 if self._kind.answers else len(axes)) or not all(axis.excited for axis in axes):
            raise _Refused
        for axis in axes:
            axis.home(now)

    def _arm(self, axes: Sequence[Axis], actions: Sequence[Callable[[float], None]]) -> None:
        for axis in self.axes:
            axis.armed = None
        for axis, action in zip(axes, actions, strict=True):
            axis.armed = action

    def _arm_moves(self, rest: str, *, absolute: bool, now: float) -> None:
        axes = self._chosen(rest[:1])
        found = _PULSES.findall(rest[1:])
        if len(found) != len(axes) or "".join(f"{sign}P{digits}" for sign, digits in found) != rest[1:]:
            raise _Refused
        numbers = [int(sign + digits) for sign, digits in found]
        if any(abs(number) > self._kind.most_pulses for number in numbers):
            raise _Refused
        targets = [number if absolute else axis.pulses(now) + number for axis, number in zip(axes, numbers, strict=True)]
        self._arm(axes, [_towards(axis, target) for axis, target in zip(axes, targets, strict=True)])

    def _arm_jogs(self, rest: str) -> None:
        axes = self._chosen(rest[:1])
        if not _signs(rest[1:], len(axes)):
            raise _Refused
        self._arm(axes, [_jogging(axis, 1 if sign == "+" else -1) for axis, sign in zip(axes, rest[1:], strict=True)])

    def _set_speeds(self, rest: str) -> None:
        # The GSC-02's first character is a speed range, and both axes always follow.
        gsc_range = None if self._kind.answers else {"1": (1, 200), "2": (50, self._kind.most_speed)}.get(rest[:1])
        if not self._kind.answers and gsc_range is None:
            raise _Refused
        axes = self._chosen(rest[:1]) if gsc_range is None else self.axes
        low, high = gsc_range or (1, self._kind.most_speed)
        texts = _SPEEDS.findall(rest[1:])
        if len(texts) != len(axes) or "".join(f"S{s}F{f}R{r}" for s, f, r in texts) != rest[1:]:
            raise _Refused
        found = [(int(slow), int(fast), int(ramp)) for slow, fast, ramp in texts]
        for slow, fast, ramp in found:
            if not (low <= slow <= fast <= high and 0 <= ramp <= 1000) or (self._kind.answers and fast >= 8000 and slow < 64):
                raise _Refused
        for axis, (slow, fast, ramp) in zip(axes, found, strict=True):
            axis.speeds = (slow, fast, ramp)

    def _stop(self, rest: str, now: float) -> None:
        for axis in self.axes if rest == "E" else self._chosen(rest):
            axis.stop(now, dead=rest == "E")
            if self.on_stop is not None:
                self.on_stop(str(self.axes.index(axis) + 1))


def _signs(text: str, count: int) -> bool:
    return len(text) == count and set(text) <= {"+", "-"}


def _towards(axis: Axis, pulses: int) -> Callable[[float], None]:
    return lambda t: axis.go_to(t, pulses)


def _jogging(axis: Axis, way: int) -> Callable[[float], None]:
    return lambda t: axis.jog(t, way)
