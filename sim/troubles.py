"""What goes wrong inside an instrument rather than on its line: the names, and how a motion is cut short.

A simulator that knows some of these lists them in `troubles`, and `trouble(kind, rng)` does one: it returns in words what was done, or None
while there is no opportunity, a stall without a motion, and is then asked again later.
"""

from __future__ import annotations

import math

import numpy as np

from sim.motion import Track

TROUBLES = ("alarm", "stall", "limit-hit", "over-range")

_ENDLESS = 1.0  # a motion without an end is cut as if it ended so late, s


def cut_short(track: Track, t: float, rng: np.random.Generator) -> tuple[float, float]:
    """Plan that the motion under way ends dead, at a drawn fraction of what is left of it.

    Parameters
    ----------
    track : Track
        Of an axis that moves.
    t : float
        Now, s.
    rng : numpy.random.Generator
        Draws the fraction, 0.1 to 0.9.

    Returns
    -------
    position, velocity : float
        Where it will halt, and how fast it will have been.
    """
    left = track.end - t if track.end < math.inf else _ENDLESS
    at = t + float(rng.uniform(0.1, 0.9)) * left
    position, velocity = track.nominal(at)
    track.begin(at, ())
    return position, velocity
