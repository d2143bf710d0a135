"""Motion profiles and readings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import InvalidSetting
from drivers.kinds import LightReading, MotionProfile

speeds = st.floats(0.01, 1000)
accelerations = st.floats(0.01, 1e5)
distances = st.floats(1e-3, 720)


@pytest.mark.parametrize(("distance", "duration"), [(0, 0), (10, 2), (-10, 2), (40, 4), (100, 7)])
def test_known_durations(distance: float, duration: float) -> None:
    """20 deg/s, 10 deg/s^2: two ramps of 20 deg each; 10 deg is a triangle."""
    assert MotionProfile(20, 10).duration_s(distance) == pytest.approx(duration)


@given(speeds, accelerations, distances)
def test_the_area_under_the_velocity_is_the_distance(speed: float, acceleration: float, distance: float) -> None:
    duration = MotionProfile(speed, acceleration).duration_s(distance)
    time_s = np.linspace(0, duration, 20001)
    velocity = np.minimum(speed, np.minimum(acceleration * time_s, acceleration * (duration - time_s)))
    assert np.trapezoid(velocity, time_s) == pytest.approx(distance, rel=1e-3)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.inf, math.nan])
def test_impossible_profiles(bad: float) -> None:
    with pytest.raises(InvalidSetting):
        MotionProfile(bad, 1)
    with pytest.raises(InvalidSetting):
        MotionProfile(1, bad)


@pytest.mark.parametrize(("value", "over_range"), [(math.nan, False), (math.nan, True), (math.inf, False), (9.9e37, True)])
def test_readings_that_contradict_themselves(value: float, over_range: bool) -> None:
    with pytest.raises(InvalidSetting):
        LightReading(value, "A", 0, over_range)


def test_good_readings() -> None:
    assert LightReading(1.0, "A", 0, False).good
    assert not LightReading(math.inf, "A", 0, True).good
    assert not LightReading(0.1, "lx", 0, False, under_range=True).good
