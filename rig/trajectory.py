"""The points of a sweep, as data: parsed from options, checked, described in the run."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rig.errors import ConfigError

MAX_POINTS = 1_000_000


def parse_angles(text: str, option: str) -> tuple[float, ...]:
    """Return the angles in degrees that `text` names.

    Parameters
    ----------
    text : str
        A number (`45`), a list (`15,30,45`), a range with both ends (`-70:70:10`), or a list of these.
    option : str
        The option's name, for the message.

    Raises
    ------
    ConfigError
        Where the text is none of these, a step is zero or leads away from the end, or the end is not on a step.
    """
    angles = tuple(angle for part in text.split(",") for angle in _parse_part(part.strip(), option))
    if len(angles) > MAX_POINTS:
        raise ConfigError(f"{option} {text}: {len(angles)} angles are more than the {MAX_POINTS} one sweep may have")
    return angles


def _parse_part(part: str, option: str) -> tuple[float, ...]:
    try:
        numbers = [float(word) for word in part.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 3) or not all(math.isfinite(number) for number in numbers):
        raise ConfigError(f"{option} {part!r}: expected degrees as a number (45), a list (15,30,45) or a range first:last:step (-70:70:10)")
    if len(numbers) == 1:
        return (numbers[0],)
    first, last, step = numbers
    if step == 0 or (last - first) * step < 0:
        raise ConfigError(f"{option} {part}: the step {step:g} does not lead from {first:g} to {last:g}")
    steps = (last - first) / step
    count = round(steps)
    if count > MAX_POINTS:
        raise ConfigError(f"{option} {part}: {count} angles are more than the {MAX_POINTS} one sweep may have")
    if abs(steps - count) > 1e-6:
        raise ConfigError(f"{option} {part}: steps of {step:g} from {first:g} do not reach {last:g}; the range holds both its ends")
    return tuple(round(first + i * step, 9) + 0.0 for i in range(count + 1))


@dataclass(frozen=True)
class Point:
    """One geometry of a sweep, in degrees, read `repeat` times."""

    theta_i: float
    theta_r: float


@dataclass(frozen=True)
class Trajectory:
    """A sweep in the plane of incidence: every theta_r at every theta_i, each read `repeat` times.

    theta_r runs forth at one incidence and back at the next, so that the detector never travels in vain.
    """

    theta_i: tuple[float, ...]
    theta_r: tuple[float, ...]
    repeat: int = 1

    def __post_init__(self) -> None:
        if self.repeat < 1:
            raise ConfigError(f"--repeat {self.repeat}: a point is read at least once")
        for name, angles in (("--theta-i", self.theta_i), ("--theta-r", self.theta_r)):
            doubles = sorted({angle for angle in angles if angles.count(angle) > 1}) if len(set(angles)) < len(angles) else []
            if doubles:
                raise ConfigError(f"{name} names {doubles[0]:g} deg twice; use --repeat to read a point more than once")

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.theta_i) * len(self.theta_r) * self.repeat

    def points(self) -> Iterator[Point]:
        """Yield the geometries in the order they are measured."""
        for row, theta_i in enumerate(self.theta_i):
            for theta_r in self.theta_r if row % 2 == 0 else reversed(self.theta_r):
                yield Point(theta_i, theta_r)

    def describe(self) -> dict[str, Any]:
        """Return what a run's start document says of its points."""
        return {"kind": "in-plane", "theta_i_deg": list(self.theta_i), "theta_r_deg": list(self.theta_r), "repeat": self.repeat}
