"""Readings over a line whose answers bear neither number nor time: a late answer must not pass for a new one."""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import UnexpectedReply
from drivers.kinds import LightReading

READINGS = 4


def agreed(measure: Callable[[], LightReading], share: float, floor: float) -> LightReading:
    """Measure until two readings in turn agree, and return the second; with no `share` take the first on trust.

    A reading that is not good, out of range say, is returned at once: it will not be used. An answer that is lost, doubled or late shifts
    or repeats what follows; of two readings in turn at most one is then wrong.

    Parameters
    ----------
    measure : callable
        Takes one reading.
    share : float
        By how much of the larger one two readings may differ, beside the floor.
    floor : float
        By how much they may differ in any case, in their unit.

    Raises
    ------
    UnexpectedReply
        No two in turn agree.
    """
    readings: list[LightReading] = []
    for _ in range(READINGS):
        readings.append(measure())
        if not share or not readings[-1].good or (len(readings) > 1 and _agree(readings[-2], readings[-1], share, floor)):
            return readings[-1]
    raise UnexpectedReply(
        f"readings {', '.join(f'{reading.value:g}' for reading in readings)} {readings[0].unit}",
        expected=f"two in turn that differ by no more than {100 * share:g} %",
        hint="is the light steady? agreement = 0 takes single readings on trust",
    )


def _agree(one: LightReading, two: LightReading, share: float, floor: float) -> bool:
    return abs(one.value - two.value) <= floor + share * max(abs(one.value), abs(two.value))
