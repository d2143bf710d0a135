"""Our instruments as bluesky sees them: structural types only, bluesky itself is not imported.

What each owes the engine: https://blueskyproject.io/bluesky/main/hardware.html
"""

import contextlib
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from drivers.errors import BadChecksum, DeviceError, DeviceFault, MoveTimeout, NotHomed, TransportTimeout, UnexpectedReply
from drivers.incidents import Incident, Report, What
from drivers.kinds import AxisState, DistanceReading, ForgetfulStage, LightReading, LightSensor, RangeFinder, Stage
from rig.axisrecord import AxisMemory, AxisRecord, recollected
from rig.brake import Brake
from rig.bus import BusWorker, Task
from rig.clock import Clock
from rig.errors import InterlockError
from rig.kinematics import AxisMap
from rig.status import Status, StatusTimeout

POLL_S = 0.004
"""How often an axis that should have arrived is asked again, s of real time."""

WATCH_S = 0.05
"""How often an axis on its way is looked at, s of the bench's time."""

OFF_ZERO = 0.1
"""How far from the origin, in its unit, an axis is left whose controller forgets that it was homed."""

LOOKS = 2
"""How often an arm that has settled is looked at before it counts as elsewhere."""

ASTRAY = 0.5
"""How far beside its way an axis may be seen, in its unit, before it is stopped."""

OUT_OF_RANGE = 9.9e37
"""Stands for a value beyond the sensor's range, as in SCPI: JSON has no infinity. Such a reading is never good."""

Reading = dict[str, dict[str, Any]]


def _reading(**values: Any) -> Reading:
    now = time.time()
    return {key: {"value": value, "timestamp": now} for key, value in values.items()}


class Configured:
    """A device that says, with every run, who it is and how it is set."""

    parent = None
    name: str
    kind: str

    def _configuration(self) -> dict[str, Any]:
        raise NotImplementedError

    def read_configuration(self) -> Reading:
        """Return the instrument's identity and settings."""
        return _reading(**{f"{self.name}_{key}": value for key, value in self._configuration().items()})

    def describe_configuration(self) -> dict[str, dict[str, Any]]:
        """Return type and source of what `read_configuration` gives."""
        return {
            f"{self.name}_{key}": {
                "source": f"{self.kind}:{self.name}",
                "dtype": "string" if isinstance(value, str) else "number",
                "shape": [],
            }
            for key, value in self._configuration().items()
        }


class Axis(Configured):
    """A positioner in degrees of theta, or in mm: Movable, Locatable, Stoppable, Readable and Checkable.

    Parameters
    ----------
    name : str
        The axis, e.g. `detector`.
    angle : str
        What it realises, e.g. the angle `theta_r`; its readback carries this name in every event.
    driver : Stage
    axis_map : AxisMap
    bus : BusWorker
        The worker of the port the stage hangs on.
    clock : Clock
    brake : Brake
        Holds motions back while the bench is stopped.
    settle_s : float
        How long the arm rings after the stage has arrived.
    tolerance : float
        How far from its target a stage that has arrived may stand.
    limits : pair of float
        Where it may be seen, in theta.
    check : callable
        `check(axis name, theta_deg)` raises InterlockError where the axis may not go.
    memory : AxisMemory, optional
        Where each command is written down before it is sent.
    report : callable, optional
        Told what was done about a motion whose start was in doubt.

    Attributes
    ----------
    notices : tuple of str
        What somebody should know before the axis moves: it is not where it was left, or was on its way when a program ended.
    """

    kind = "axis"

    def __init__(
        self,
        name: str,
        angle: str,
        driver: Stage,
        axis_map: AxisMap,
        bus: BusWorker,
        clock: Clock,
        brake: Brake,
        *,
        settle_s: float,
        tolerance: float,
        limits: tuple[float, float],
        check: Callable[[str, float], None],
        memory: AxisMemory | None = None,
        report: Report | None = None,
    ) -> None:
        self.name = name
        self.angle = angle
        self.driver = driver
        self.map = axis_map
        self.settle_s = settle_s
        self.tolerance = tolerance
        self.limits = limits
        self.homing = Homing(self)
        self._bus = bus
        self._clock = clock
        self._brake = brake
        self._check = check
        self._memory = memory
        self._report = report or (lambda incident: None)
        self._profile = driver.profile()
        self._identity = driver.identify()
        self._moving: Status | None = None
        self._stopped = threading.Event()
        self._setpoint = math.nan
        self._readback = math.nan
        self._homed = False
        self.notices = recollected(name, driver, axis_map, tolerance, self.last_command)
        self.refresh()

    # -- what it knows -------------------------------------------------------------------------------------------------

    @property
    def homed(self) -> bool:
        """True where the stage knows its position."""
        return self._homed

    @property
    def position(self) -> float:
        """The last readback in theta."""
        return self._readback

    @property
    def destination(self) -> float:
        """Where the axis is going, or else stands, in degrees of theta."""
        return self._setpoint if self._moving is not None and not self._moving.done else self._readback

    @property
    def unit(self) -> str:
        """Degrees or millimetres."""
        return self.driver.unit

    @property
    def last_command(self) -> AxisRecord | None:
        """What was written down of the stage last, as the stage counts."""
        return self._memory.get() if self._memory is not None else None

    def refresh(self) -> AxisState:
        """Ask the stage where it stands."""
        state = self.driver.state()
        self._homed = state.homed
        self._readback = self.map.to_theta(state.position)
        return state

    # -- bluesky -------------------------------------------------------------------------------------------------------

    @property
    def hints(self) -> dict[str, Any]:
        """The field worth plotting."""
        return {"fields": [self.angle]}

    def check_value(self, value: float) -> None:
        """Raise InterlockError where the axis may not go to `value` (degrees)."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InterlockError(f"axis {self.name}: expected a number in {self.unit}, got {value!r}; nothing was moved")
        self._check(self.name, float(value))

    def set(self, value: float) -> Status:
        """Go to `value` degrees; the status ends when the arm stands still there.

        Raises
        ------
        InterlockError
            Where the axis may not go there; nothing was moved.
        """
        self.check_value(value)
        target = float(value)
        return self._begin(lambda stopped: self._move(target, stopped), target)

    def home(self) -> Status:
        """Find the stage's reference; the status ends when it stands there."""
        return self._begin(self._home, math.nan)

    def stop(self, success: bool = True) -> None:
        """Stop at once, from any thread.

        A move of ours that is under way counts as ended well (the engine then repeats it when resumed);
        a stop that nobody asked for fails the move.
        """
        self._stopped.set()
        self.driver.stop()

    def await_rest(self, timeout_s: float) -> None:
        """Wait for the end of a motion that was told to stop, so that it is written down; at most so many seconds of real time."""
        if self._moving is not None:
            with contextlib.suppress(StatusTimeout):
                self._moving.exception(timeout_s)

    def locate(self) -> dict[str, float]:
        """Return setpoint and readback in degrees."""
        return {"setpoint": self._setpoint, "readback": self._readback}

    def read(self) -> Reading:
        """Return setpoint and readback as they were when the last move ended."""
        return _reading(**{self.angle: self._readback, f"{self.angle}_setpoint": self._setpoint})

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return type, unit and source of what `read` gives."""
        units = "degree" if self.unit == "deg" else self.unit
        key = {"source": f"axis:{self.name}", "dtype": "number", "shape": [], "units": units}
        return {self.angle: dict(key), f"{self.angle}_setpoint": dict(key)}

    def _configuration(self) -> dict[str, Any]:
        return {
            **vars(self._identity),
            "sign": self.map.sign,
            f"offset_{self.unit}": self.map.offset_deg,
            f"speed_{self.unit}_s": self._profile.speed,
            f"acceleration_{self.unit}_s2": self._profile.acceleration,
            "settle_s": self.settle_s,
            f"tolerance_{self.unit}": self.tolerance,
        }

    # -- motion --------------------------------------------------------------------------------------------------------

    def _begin(self, task: Callable[[threading.Event], Task], target: float) -> Status:
        return self._brake.pass_or_hold(lambda: self._launch(task, target))

    def _launch(self, task: Callable[[threading.Event], Task], target: float) -> Status:
        # A motion that was told to stop may still be under way on the bus when the next one begins: each has its own flag.
        self._stopped = threading.Event()
        self._setpoint = target
        self._moving = self._bus.start(task(self._stopped))
        return self._moving

    def _move(self, target: float, stopped: threading.Event) -> Task:
        goal = self.map.to_axis(target)
        state = self.refresh()
        if state.homed and not state.moving and abs(self._readback - target) <= self.tolerance and self._is_at(goal):
            return
        duration = self._profile.duration_s(abs(self._readback - target))
        if not self._started(lambda: self.driver.start_move(goal), goal, state, stopped):
            return
        yield from self._until_idle(f"the move to {target:g} {self.unit}", duration, stopped, way=(self._readback, target))
        if stopped.is_set():
            self._remember(goal, self.refresh(), under_way=False)
            return
        self.driver.check_arrival(goal, self.tolerance)
        yield self.settle_s
        self._remember(goal, self._settled(goal), under_way=False)

    def _home(self, stopped: threading.Event) -> Task:
        state = self.refresh()
        if not self._started(self.driver.start_home, None, state, stopped):
            return
        farthest = 360.0 if self.unit == "deg" else 2 * (self.limits[1] - self.limits[0])
        yield from self._until_idle("homing", self._profile.duration_s(farthest), stopped, way=None)
        if not stopped.is_set():
            yield self.settle_s
            if isinstance(self.driver, ForgetfulStage) and self.refresh().homed:
                yield from self._leave_zero(stopped)
        self._remember(None, self.refresh(), under_way=False)
        if not stopped.is_set() and not self._homed:
            raise NotHomed("homing ended without a reference", device=self.name, hint="look at the stage's warnings and home it again")

    def _is_at(self, goal: float) -> bool:
        """Look once more before a motion is left out: the first look may have been a late answer."""
        try:
            self.driver.check_arrival(goal, self.tolerance)
        except DeviceFault:
            return False
        return True

    def _leave_zero(self, stopped: threading.Event) -> Task:
        """Step off the origin: where a counter reads 0 it may also have been switched off, and the record could not vouch for it."""
        step = math.copysign(max(OFF_ZERO, 5 * self.tolerance), self.map.to_axis(sum(self.limits) / 2))
        state = self.refresh()
        if self._started(lambda: self.driver.start_move(step), step, state, stopped):
            here = self._readback
            duration = self._profile.duration_s(abs(step))
            yield from self._until_idle("the step off the origin", duration, stopped, way=(here, self.map.to_theta(step)))

    def _settled(self, goal: float) -> AxisState:
        """Look where the arm stands for the record: what looks different from what was made sure of may be a late answer, once."""
        for _ in range(LOOKS):
            state = self.refresh()
            if not state.moving and abs(state.position - goal) <= self.tolerance:
                return state
        raise DeviceFault(
            f"seen at {self._readback:.3f} {self.unit} after it had arrived",
            device=self.name,
            attempt="settling",
            expected=f"rest at {self.map.to_theta(goal):.3f} {self.unit}",
            hint="was it moved by hand?",
        )

    def _remember(self, goal: float | None, state: AxisState, *, under_way: bool) -> None:
        if self._memory is not None:
            self._memory.put(setpoint=goal, readback=state.position, under_way=under_way or state.moving, homed=state.homed)

    def _started(self, start: Callable[[], None], goal: float | None, before: AxisState, stopped: threading.Event) -> bool:
        """Start a motion unless a stop was asked for meanwhile; return whether it runs.

        Where no good answer comes it is unknown whether the stage took the command. It is asked for its state before anything else: if it
        moves, or is elsewhere, the motion is followed to its end, which tells whether it was the right one; if it has not stirred, the
        command is sent once more.
        """
        if stopped.is_set():
            return False
        self._remember(goal, before, under_way=True)
        try:
            try:
                start()
            except (BadChecksum, TransportTimeout, UnexpectedReply) as doubt:
                state = self.driver.state()
                if not (state.moving or abs(state.position - before.position) > self.tolerance or stopped.is_set()):
                    self._tell("motion sent again", doubt)
                    start()
                else:
                    self._tell("motion followed", doubt)
        except DeviceFault:
            self._remember(goal, before, under_way=False)
            if stopped.is_set():  # the driver would not let it follow the stop
                return False
            raise
        if stopped.is_set():  # the stop overtook the start before the driver could know
            self.driver.stop()
        return True

    def _tell(self, what: What, doubt: DeviceError) -> None:
        self._report(Incident(time.time(), doubt.port, self.name, doubt.attempt, what, str(doubt)))

    def _until_idle(self, what: str, duration: float, stopped: threading.Event, *, way: tuple[float, float] | None) -> Task:
        """Wait for the end of a motion: look now and then while it is under way, and often when it should be over."""
        speed = self._clock.speed
        started = self._clock.monotonic()
        predicted = duration if way is not None else 0.0
        look = max(WATCH_S, POLL_S * speed)
        yield min(max(predicted, POLL_S * speed), look)
        while (state := self.refresh()).moving:
            now = self._clock.monotonic()
            if state.waiting:
                started = now
            elapsed = now - started
            if elapsed > 3 * duration + 5.0:
                self.driver.stop()
                raise MoveTimeout(
                    "still moving; it was stopped", device=self.name, attempt=what, expected=f"{duration:.1f} s", elapsed_s=elapsed
                )
            if way is not None:
                self._keep_to(way, self._readback, what)
            left = 0.0 if stopped.is_set() else predicted - elapsed
            yield min(max(left, POLL_S * speed), look)

    def _keep_to(self, way: tuple[float, float], theta: float, what: str) -> None:
        """Stop the axis where it has left its way, or its limits: a command may have been damaged on a wire without checksums."""
        low, high = min(way), max(way)
        # It may have begun outside the limits, and is then on its way in.
        low, high = max(low, min(self.limits[0], way[0])) - ASTRAY, min(high, max(self.limits[1], way[0])) + ASTRAY
        if not low <= theta <= high:
            self.driver.stop()
            raise DeviceFault(
                f"at {theta:.3f} {self.unit}, which is not on its way; it was stopped",
                device=self.name,
                attempt=what,
                expected=f"{low:.3f} to {high:.3f} {self.unit}",
                hint="check the cable, then home the axis",
            )


class Homing:
    """The homing of an axis as something a plan can `set`, so that pausing and resuming hold for it too."""

    parent = None

    def __init__(self, axis: Axis) -> None:
        self.name = f"{axis.name}_homing"
        self._axis = axis

    def set(self, value: Any) -> Status:
        """Home the axis."""
        return self._axis.home()

    def stop(self, success: bool = True) -> None:
        """Stop the axis."""
        self._axis.stop(success)

    def read(self) -> Reading:
        """Return whether the axis has its reference."""
        return _reading(**{self.name: int(self._axis.homed)})

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return type and source of what `read` gives."""
        return {self.name: {"source": f"axis:{self._axis.name}", "dtype": "integer", "shape": []}}

    def read_configuration(self) -> Reading:
        """Return nothing: the axis has it."""
        return {}

    def describe_configuration(self) -> dict[str, dict[str, Any]]:
        """Return nothing: the axis has it."""
        return {}


R = TypeVar("R", LightReading, DistanceReading)


class Sensor(Configured, Generic[R]):
    """A sensor in whatever unit: Triggerable and Readable.

    A reading that cannot be trusted is kept as read, marked by `<name>_good = 0`, and never used as good.
    """

    unit: str

    def __init__(self, name: str, bus: BusWorker, brake: Brake) -> None:
        self.name = name
        self._bus = bus
        self._brake = brake
        self._last: R | None = None
        self._time = math.nan

    @abstractmethod
    def _acquire(self) -> R:
        """Take one reading."""

    @abstractmethod
    def _value(self, reading: R) -> float:
        """Return the number a reading holds, in `unit`."""

    @property
    def last(self) -> R:
        """What the last trigger acquired."""
        if self._last is None:
            raise UnexpectedReply("read before it was triggered", device=self.name)
        return self._last

    @property
    def value(self) -> float:
        """Its number, in `unit`."""
        return self._value(self.last)

    @property
    def hints(self) -> dict[str, Any]:
        """The field worth plotting."""
        return {"fields": [self.name]}

    def trigger(self) -> Status:
        """Take one reading; the status ends when it is there."""
        return self._brake.pass_or_hold(lambda: self._bus.call(self._take))

    def _take(self) -> None:
        self._last = None
        self._last = self._acquire()
        self._time = time.time()

    def read(self) -> Reading:
        """Return what the last trigger acquired, with the time it came in."""
        reading = self.last
        value = self._value(reading)
        values = {
            self.name: float(value) if math.isfinite(value) else math.copysign(OUT_OF_RANGE, value),
            f"{self.name}_status": int(reading.status),
            f"{self.name}_good": int(reading.good),
        }
        return {key: {"value": value, "timestamp": self._time} for key, value in values.items()}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return type, unit and source of what `read` gives."""
        source = f"{self.kind}:{self.name}"
        return {
            self.name: {"source": source, "dtype": "number", "shape": [], "units": self.unit},
            f"{self.name}_status": {"source": source, "dtype": "integer", "shape": []},
            f"{self.name}_good": {"source": source, "dtype": "integer", "shape": []},
        }


class LightMeter(Sensor[LightReading]):
    """A light sensor."""

    kind = "sensor"

    def __init__(self, name: str, driver: LightSensor, bus: BusWorker, brake: Brake) -> None:
        super().__init__(name, bus, brake)
        self.driver = driver
        self.unit = driver.unit
        self._identity = driver.identify()

    def _acquire(self) -> LightReading:
        return self.driver.read()

    def _value(self, reading: LightReading) -> float:
        return reading.value

    def _configuration(self) -> dict[str, Any]:
        return {**vars(self._identity), "integration_s": self.driver.integration_s}


class Ranger(Sensor[DistanceReading]):
    """A range finder."""

    kind = "range-finder"
    unit = "mm"

    def __init__(self, name: str, driver: RangeFinder, bus: BusWorker, brake: Brake) -> None:
        super().__init__(name, bus, brake)
        self.driver = driver
        self._identity = driver.identify()
        self._limits_mm = driver.limits_mm()

    def _acquire(self) -> DistanceReading:
        return self.driver.read()

    def _value(self, reading: DistanceReading) -> float:
        return reading.distance_mm

    def _configuration(self) -> dict[str, Any]:
        near_mm, far_mm = self._limits_mm
        return {**vars(self._identity), "near_mm": near_mm, "far_mm": far_mm}
