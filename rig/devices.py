"""Our instruments as bluesky sees them: structural types only, bluesky itself is not imported.

What each owes the engine: https://blueskyproject.io/bluesky/main/hardware.html
"""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from drivers.errors import DeviceFault, MoveTimeout, NotHomed, UnexpectedReply
from drivers.kinds import LightReading, LightSensor, Stage
from rig.bus import BusWorker, Task
from rig.clock import Clock
from rig.errors import InterlockError
from rig.kinematics import AxisMap
from rig.status import Status

POLL_S = 0.004
"""How often an axis that should have arrived is asked again."""

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
    """A positioner in degrees of theta: Movable, Locatable, Stoppable, Readable and Checkable.

    Parameters
    ----------
    name : str
        The axis, e.g. `detector`.
    angle : str
        The angle it realises, e.g. `theta_r`; its readback carries this name in every event.
    driver : Stage
    axis_map : AxisMap
    bus : BusWorker
        The worker of the port the stage hangs on.
    clock : Clock
    settle_s : float
        How long the arm rings after the stage has arrived.
    tolerance : float
        How far from its target a stage that has arrived may stand.
    check : callable
        `check(axis name, theta_deg)` raises InterlockError where the axis may not go.
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
        *,
        settle_s: float,
        tolerance: float,
        check: Callable[[str, float], None],
    ) -> None:
        self.name = name
        self.angle = angle
        self.driver = driver
        self.map = axis_map
        self.settle_s = settle_s
        self.tolerance = tolerance
        self.homing = Homing(self)
        self._bus = bus
        self._clock = clock
        self._check = check
        self._profile = driver.profile()
        self._identity = driver.identify()
        self._moving: Status | None = None
        self._stopped = threading.Event()
        self._setpoint = math.nan
        self._readback = math.nan
        self._homed = False
        self.refresh()

    # -- what it knows -------------------------------------------------------------------------------------------------

    @property
    def homed(self) -> bool:
        """True where the stage knows its position."""
        return self._homed

    @property
    def position(self) -> float:
        """The last readback in degrees of theta."""
        return self._readback

    @property
    def destination(self) -> float:
        """Where the axis is going, or else stands, in degrees of theta."""
        return self._setpoint if self._moving is not None and not self._moving.done else self._readback

    def refresh(self) -> None:
        """Ask the stage where it stands."""
        state = self.driver.state()
        self._homed = state.homed
        self._readback = self.map.to_theta(state.position)

    def travel_s(self, from_deg: float, to_deg: float) -> float:
        """Return the bench seconds a move takes, settling included."""
        distance = abs(to_deg - from_deg)
        return self._profile.duration_s(distance) + self.settle_s if distance else 0.0

    # -- bluesky -------------------------------------------------------------------------------------------------------

    @property
    def hints(self) -> dict[str, Any]:
        """The field worth plotting."""
        return {"fields": [self.angle]}

    def check_value(self, value: float) -> None:
        """Raise InterlockError where the axis may not go to `value` (degrees)."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InterlockError(f"axis {self.name}: expected an angle in degrees, got {value!r}; nothing was moved")
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

    def locate(self) -> dict[str, float]:
        """Return setpoint and readback in degrees."""
        return {"setpoint": self._setpoint, "readback": self._readback}

    def read(self) -> Reading:
        """Return setpoint and readback as they were when the last move ended."""
        return _reading(**{self.angle: self._readback, f"{self.angle}_setpoint": self._setpoint})

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return type, unit and source of what `read` gives."""
        key = {"source": f"axis:{self.name}", "dtype": "number", "shape": [], "units": "degree"}
        return {self.angle: dict(key), f"{self.angle}_setpoint": dict(key)}

    def _configuration(self) -> dict[str, Any]:
        return {
            **vars(self._identity),
            "sign": self.map.sign,
            "offset_deg": self.map.offset_deg,
            "speed": self._profile.speed,
            "acceleration": self._profile.acceleration,
            "settle_s": self.settle_s,
            "tolerance": self.tolerance,
        }

    # -- motion --------------------------------------------------------------------------------------------------------

    def _begin(self, task: Callable[[threading.Event], Task], target: float) -> Status:
        # A motion that was told to stop may still be under way on the bus when the next one begins: each has its own flag.
        self._stopped = threading.Event()
        self._setpoint = target
        self._moving = self._bus.start(task(self._stopped))
        return self._moving

    def _move(self, target: float, stopped: threading.Event) -> Task:
        axis_deg = self.map.to_axis(target)
        state = self.driver.state()
        self._readback = self.map.to_theta(state.position)
        if state.homed and not state.moving and abs(self._readback - target) <= self.tolerance:
            return
        duration = self._profile.duration_s(abs(self._readback - target))
        if not self._started(lambda: self.driver.start_move(axis_deg), stopped):
            return
        yield from self._until_idle(f"the move to {target:g} deg", duration, stopped)
        if not stopped.is_set():
            self.driver.check_arrival(axis_deg, self.tolerance)
            yield self.settle_s
        self.refresh()

    def _home(self, stopped: threading.Event) -> Task:
        if not self._started(self.driver.start_home, stopped):
            return
        yield from self._until_idle("homing", self._profile.duration_s(360.0), stopped, predicted=False)
        if not stopped.is_set():
            yield self.settle_s
        self.refresh()
        if not stopped.is_set() and not self._homed:
            raise NotHomed("homing ended without a reference", device=self.name, hint="look at the stage's warnings and home it again")

    def _started(self, start: Callable[[], None], stopped: threading.Event) -> bool:
        """Start a motion unless a stop was asked for meanwhile; return whether it runs."""
        if stopped.is_set():
            return False
        try:
            start()
        except DeviceFault:
            if stopped.is_set():  # the driver would not let it follow the stop
                return False
            raise
        if stopped.is_set():  # the stop overtook the start before the driver could know
            self.driver.stop()
        return True

    def _until_idle(self, what: str, duration: float, stopped: threading.Event, *, predicted: bool = True) -> Task:
        started = self._clock.monotonic()
        if predicted:
            yield from self._watch(duration, stopped)
        while self.driver.state().moving:
            elapsed = self._clock.monotonic() - started
            if elapsed > 3 * duration + 5.0:
                self.driver.stop()
                raise MoveTimeout(
                    "still moving; it was stopped", device=self.name, attempt=what, expected=f"{duration:.1f} s", elapsed_s=elapsed
                )
            yield POLL_S * self._clock.speed

    def _watch(self, duration: float, stopped: threading.Event) -> Task:
        """Wait out a predicted travel, yet notice within 50 ms that the axis was told to stop."""
        end = self._clock.monotonic() + duration
        while not stopped.is_set() and (left := end - self._clock.monotonic()) > 0:
            yield min(left, 0.05 * self._clock.speed)


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


class LightMeter(Configured):
    """A light sensor: Triggerable and Readable.

    A reading out of the meter's range is kept as read, marked by `<name>_good = 0`, and never used as good.
    """

    kind = "sensor"

    def __init__(self, name: str, driver: LightSensor, bus: BusWorker) -> None:
        self.name = name
        self.driver = driver
        self._bus = bus
        self._identity = driver.identify()
        self._last: LightReading | None = None
        self._time = math.nan

    @property
    def hints(self) -> dict[str, Any]:
        """The field worth plotting."""
        return {"fields": [self.name]}

    def trigger(self) -> Status:
        """Take one reading; the status ends when it is there."""
        return self._bus.call(self._acquire)

    def _acquire(self) -> None:
        self._last = None
        self._last = self.driver.read()
        self._time = time.time()

    def read(self) -> Reading:
        """Return what the last trigger acquired, with the time it came in."""
        reading = self._last
        if reading is None:
            raise UnexpectedReply("read before it was triggered", device=self.name)
        values = {
            self.name: float(reading.value) if math.isfinite(reading.value) else math.copysign(OUT_OF_RANGE, reading.value),
            f"{self.name}_status": int(reading.status),
            f"{self.name}_good": int(not reading.over_range and not reading.under_range),
        }
        return {key: {"value": value, "timestamp": self._time} for key, value in values.items()}

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return type, unit and source of what `read` gives."""
        source = f"sensor:{self.name}"
        return {
            self.name: {"source": source, "dtype": "number", "shape": [], "units": self.driver.unit},
            f"{self.name}_status": {"source": source, "dtype": "integer", "shape": []},
            f"{self.name}_good": {"source": source, "dtype": "integer", "shape": []},
        }

    def _configuration(self) -> dict[str, Any]:
        return {
            **vars(self._identity),
            "integration_s": self.driver.integration_s,
        }
