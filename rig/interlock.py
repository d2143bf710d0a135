"""Where the arms may stand, and in which order they may get there. Pure checks; nothing here moves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rig.errors import InterlockError


@dataclass(frozen=True)
class KeepOut:
    """The zone in which the detector's arm meets the source's arm, and the one in which it stands in the light.

    Parameters
    ----------
    within_deg : float
        No stop with `|theta_r - theta_i|` below this.
    crossing : bool
        True where the arms run at different radii, so that one may pass through the zone without stopping in it.
    shadow_deg : float
        No reading with `|theta_r - theta_i|` below this: the detector would block the lamp.
    """

    within_deg: float
    crossing: bool
    shadow_deg: float = 0.0


@dataclass(frozen=True)
class Interlock:
    """Limits of each axis and the keep-out between the arms, in degrees of theta (mm for a linear axis).

    Parameters
    ----------
    limits : mapping of axis name to (lowest, highest)
    keep_out : KeepOut
    arms : pair of axis names
        The two arms the keep-out speaks of: the source's and the detector's.
    units : mapping of axis name to unit
        Of the axes that are not in degrees.
    """

    limits: Mapping[str, tuple[float, float]]
    keep_out: KeepOut
    arms: tuple[str, str] = ("source", "detector")
    units: Mapping[str, str] = field(default_factory=dict)

    def check_limits(self, axis: str, theta_deg: float) -> None:
        """Raise InterlockError where `theta_deg` lies outside the limits of `axis`."""
        low, high = self.limits[axis]
        if not low <= theta_deg <= high:
            unit = self.units.get(axis, "deg")
            raise InterlockError(
                f"axis {axis}: {theta_deg:g} {unit} is outside its limits {low:g} to {high:g} {unit}; "
                f"nothing was moved. Choose another, or widen axes.{axis}.limits in rig.toml if the bench allows it"
            )

    def blocked(self, position: Mapping[str, float]) -> bool:
        """Tell whether the arms, at `position`, stand inside the keep-out."""
        source, detector = (position[arm] for arm in self.arms)
        return not abs(detector - source) >= self.keep_out.within_deg  # nan, not known, counts as too close

    def check_position(self, position: Mapping[str, float]) -> None:
        """Raise InterlockError where `position` (axis name to degrees) breaks a limit or lies in the keep-out."""
        for axis, theta_deg in position.items():
            self.check_limits(axis, theta_deg)
        if self.blocked(position):
            source, detector = self.arms
            raise InterlockError(
                f"{detector} at {position[detector]:g} deg is within {self.keep_out.within_deg:g} deg of the {source} arm at "
                f"{position[source]:g} deg, too close; nothing was moved. Leave this angle out"
            )

    def check_reading(self, position: Mapping[str, float]) -> None:
        """Raise InterlockError where nothing can be read at `position`: it is not allowed, or the detector would block the lamp."""
        for axis, theta_deg in position.items():
            self.check_limits(axis, theta_deg)
        source, detector = self.arms
        if not abs(position[detector] - position[source]) >= self.keep_out.shadow_deg:
            raise InterlockError(
                f"{detector} at {position[detector]:g} deg is within {self.keep_out.shadow_deg:g} deg of the {source} arm at "
                f"{position[source]:g} deg, where it blocks the light; nothing was moved. Leave this angle out"
            )
        self.check_position(position)

    def check_move(self, position: Mapping[str, float], axis: str, target_deg: float) -> None:
        """Raise InterlockError where `axis` may not go from `position` to `target_deg` while the other arm stands still."""
        self.check_limits(axis, target_deg)
        if axis in self.arms:
            self._check_pair(position, {**position, axis: target_deg})

    def _check_pair(self, before: Mapping[str, float], after: Mapping[str, float]) -> None:
        source, detector = self.arms
        if self.blocked(after):
            raise InterlockError(
                f"{detector} at {after[detector]:g} deg would stand within {self.keep_out.within_deg:g} deg of the {source} arm at "
                f"{after[source]:g} deg, too close"
            )
        gap_before, gap_after = (p[detector] - p[source] for p in (before, after))
        if not self.keep_out.crossing and gap_before * gap_after < 0:
            raise InterlockError(
                f"going to {detector} {after[detector]:g} deg, {source} {after[source]:g} deg, the arms would have to cross, "
                "which keep_out.crossing in rig.toml forbids"
            )

    def order(self, position: Mapping[str, float], target: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
        """Return the axes in groups that may move at once, first group first.

        Both arms move together where either could go first; otherwise the one that must make way goes first.

        Raises
        ------
        InterlockError
            Where neither order is allowed, or the target itself is not.
        """
        self.check_position(target)
        arms = [arm for arm in self.arms if arm in target]
        others = tuple(axis for axis in target if axis not in self.arms)
        allowed = [sequence for sequence in _orders(arms) if self._passable(position, target, sequence)]
        if not allowed:
            self._check_pair(position, {**position, **target})
            raise InterlockError(
                f"from {_say(position)} to {_say(target)} one arm would have to stop in the keep-out of the other; put an angle in between"
            )
        if len(allowed) == len(_orders(arms)):
            return ((*arms, *others),)
        first, *rest = allowed[0]
        return ((first, *others), *((axis,) for axis in rest))

    def _passable(self, position: Mapping[str, float], target: Mapping[str, float], sequence: Sequence[str]) -> bool:
        current = dict(position)
        for axis in sequence:
            after = {**current, axis: target[axis]}
            try:
                self._check_pair(current, after)
            except InterlockError:
                return False
            current = after
        return True


def _orders(arms: Sequence[str]) -> list[tuple[str, ...]]:
    return [tuple(arms), tuple(reversed(arms))] if len(arms) == 2 else [tuple(arms)]


def _say(position: Mapping[str, float]) -> str:
    return ", ".join(f"{axis} {theta:g} deg" for axis, theta in position.items())
