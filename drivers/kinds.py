"""What a stage, a light sensor and a range finder can do, whoever made them, and the values they hand over."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from drivers.errors import InvalidSetting

Unit = Literal["deg", "mm"]
"""What a stage counts in."""


@dataclass(frozen=True)
class Identity:
    """Who the instrument says it is."""

    vendor: str
    model: str
    serial_number: str
    firmware: str


@dataclass(frozen=True)
class AxisState:
    """One look at an axis.

    Attributes
    ----------
    position : float
        Readback, in the stage's unit.
    moving : bool
        Whether the axis is on its way. Where the controller only tells that one of its axes is, and no motion was started on this link,
        true for each of them.
    homed : bool
        Whether the axis has a reference position, as far as its controller or, of a `ForgetfulStage`, its driver knows.
    warnings : tuple of str
        What the device complains of: flags or errors in its own spelling where it has one. Some devices tell only one of several, or
        keep them until the next motion.
    waiting : bool
        The axis has been told to move and its controller is busy with another axis; it counts as moving.
    """

    position: float
    moving: bool
    homed: bool
    warnings: tuple[str, ...] = ()
    waiting: bool = False


@dataclass(frozen=True)
class MotionProfile:
    """How fast an axis goes.

    Attributes
    ----------
    speed : float
        The stage's unit per second.
    acceleration : float
        Unit/s^2, of the ramp up and of the ramp down.

    Raises
    ------
    InvalidSetting
        If either is not finite and above 0.
    """

    speed: float
    acceleration: float

    def __post_init__(self) -> None:
        for what, value in (("speed", self.speed), ("acceleration", self.acceleration)):
            if not (math.isfinite(value) and value > 0):
                raise InvalidSetting(f"{what} {value}", expected="a finite number above 0")

    def duration_s(self, distance: float) -> float:
        """Time to travel a distance (either sign) from rest to rest, in s.

        A trapezoid of velocity, or a triangle when the distance is too short to reach full speed.
        """
        distance = abs(distance)
        ramps = self.speed**2 / self.acceleration  # travelled in the two ramps together
        if distance >= ramps:
            return distance / self.speed + self.speed / self.acceleration
        return 2 * math.sqrt(distance / self.acceleration)


@dataclass(frozen=True)
class LightReading:
    """One reading of a light sensor.

    Attributes
    ----------
    value : float
        In `unit`; +inf or -inf when over range, so that it can never pass for a good value.
    unit : str
    status : int
        The device's status word.
    over_range : bool
        The light was too strong for the range.
    under_range : bool
        The light was too weak for the range; `value` is what the device said.
    device_time_s : float, s, optional
        The device's own clock, if it has one; it may wrap.
    flags : tuple of str
        Names of the status bits that are set.

    Raises
    ------
    InvalidSetting
        If value and over_range contradict each other.
    """

    value: float
    unit: str
    status: int
    over_range: bool
    under_range: bool = False
    device_time_s: float | None = None
    flags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if math.isnan(self.value) or math.isinf(self.value) != self.over_range:
            raise InvalidSetting(f"reading {self.value} with over_range={self.over_range}", expected="infinite if and only if over range")

    @property
    def good(self) -> bool:
        """Whether the value can be used as a measurement."""
        return not (self.over_range or self.under_range)


@dataclass(frozen=True)
class DistanceReading:
    """One reading of a range finder.

    Attributes
    ----------
    distance_mm : float, mm
        From the device's zero to the target; +inf when nothing was measured, so that it can never pass for a good value.
    status : int
        The device's status or error number, 0 when all is well.
    out_of_range : bool
        There is no target within the measuring range.
    doubtful : bool
        There is a value, but the device or the driver does not vouch for it.
    device_time_s : float, s, optional
        The device's own clock, if it has one; it may wrap.
    flags : tuple of str
        What was wrong, in words.

    Raises
    ------
    InvalidSetting
        If distance and out_of_range contradict each other.
    """

    distance_mm: float
    status: int = 0
    out_of_range: bool = False
    doubtful: bool = False
    device_time_s: float | None = None
    flags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.distance_mm) or self.distance_mm == math.inf) or math.isinf(self.distance_mm) != self.out_of_range:
            contradiction = f"distance {self.distance_mm} mm with out_of_range={self.out_of_range}"
            raise InvalidSetting(contradiction, expected="+inf if and only if out of range")

    @property
    def good(self) -> bool:
        """Whether the distance can be used as a measurement."""
        return not (self.out_of_range or self.doubtful)


@runtime_checkable
class Stage(Protocol):
    """A motorised rotation or slide. Calls block for one exchange, not for a motion; any thread may call.

    Positions are in `unit`, speeds in unit/s, accelerations in unit/s^2.
    """

    @property
    def name(self) -> str:
        """What the user calls it."""
        ...

    @property
    def unit(self) -> Unit:
        """Degrees or millimetres."""
        ...

    def identify(self) -> Identity:
        """Ask the device who it is."""
        ...

    def state(self) -> AxisState:
        """Ask where the axis is and what it is doing."""
        ...

    def limits(self) -> tuple[float, float]:
        """Lower and upper limit: the device's own, or those configured where it tells none."""
        ...

    def profile(self) -> MotionProfile:
        """Speed and acceleration: the device's own, or those last set where it tells none. Sends nothing that sets anything."""
        ...

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None:
        """Set speed, acceleration or both in the device.

        With neither given, make sure that the device has what `profile` says: called before the axis is to move. Opening a stage sets
        nothing, for the axis may be moving then.
        """
        ...

    def start_home(self) -> None:
        """Start the search for the reference position and return at once."""
        ...

    def start_move(self, position: float, /) -> None:
        """Start moving to a position and return at once.

        Raises
        ------
        NotHomed
            The axis has no reference position.
        DeviceFault
            The device refuses, for instance because the position is beyond its limits.
        """
        ...

    def stop(self) -> None:
        """Stop the axis now: the bytes go out even while another thread waits on the link. Stopping twice is harmless."""
        ...

    def check_arrival(self, position: float, tolerance: float, /) -> None:
        """Make sure that the axis rests at a position because it got there.

        Raises
        ------
        DeviceFault
            Something else stopped it (a stall, a limit switch, a hand on the knob), or it rests elsewhere.
        """
        ...

    def close(self) -> None:
        """Let go of the device. The link stays open for the others on it."""
        ...


@runtime_checkable
class ForgetfulStage(Stage, Protocol):
    """A stage whose controller does not tell whether it was homed: the driver knows only of what it has seen itself."""

    def trust_reference(self) -> None:
        """Take the axis as homed: somebody else saw it homed, and nothing has moved it since."""
        ...


@runtime_checkable
class LightSensor(Protocol):
    """Something that turns light into a number."""

    @property
    def name(self) -> str:
        """What the user calls it."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the readings."""
        ...

    @property
    def integration_s(self) -> float:
        """Integration time in s, as configured after rounding to what the device can do."""
        ...

    def identify(self) -> Identity:
        """Ask the device who it is."""
        ...

    def configure(self, integration_s: float, range: float | None = None) -> None:
        """Set the integration time (s) and the range (full scale, in `unit`; None for automatic).

        Raises
        ------
        InvalidSetting
            The device cannot do that; nothing was sent.
        DeviceFault
            The device refuses.
        """
        ...

    def read(self) -> LightReading:
        """Take one reading; blocks for the integration."""
        ...

    def close(self) -> None:
        """Let go of the device. The link stays open for the others on it."""
        ...


@runtime_checkable
class RangeFinder(Protocol):
    """Something that tells how far away a surface is."""

    @property
    def name(self) -> str:
        """What the user calls it."""
        ...

    def identify(self) -> Identity:
        """Ask the device who it is."""
        ...

    def limits_mm(self) -> tuple[float, float]:
        """Nearest and farthest distance it measures, mm, from the same zero as the readings."""
        ...

    def read(self) -> DistanceReading:
        """Take one reading, made after the call. Without a target it is flagged, not an error."""
        ...

    def close(self) -> None:
        """Let go of the device. The link stays open for the others on it."""
        ...
