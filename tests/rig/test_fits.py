"""From a run's readings to the table that is fitted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig.errors import RunError
from rig.fits import measurements_of
from rig.runs import Reading


def run_of(readings: list[Reading]) -> Any:
    return SimpleNamespace(id="2026-01-01_RR", readings=readings)


def reading(seq: int, theta_r: float, value: float, **change: Any) -> Reading:
    fields: dict[str, Any] = {"theta_i": 44.9991, "theta_r": theta_r + 0.0004, "theta_i_setpoint": 45.0, "theta_r_setpoint": theta_r}
    return Reading(seq=seq, time=0.0, value=value, unit="A", status=0, **({"good": True} | fields | change))


def test_repeats_become_a_mean_with_its_standard_error() -> None:
    found = measurements_of(run_of([reading(1, -10, 2e-9), reading(2, 20, 5e-9), reading(3, -10, 4e-9), reading(4, 20, 5.5e-9)]))
    np.testing.assert_array_equal(found.theta_i_deg, [44.999, 44.999])
    np.testing.assert_array_equal(found.theta_r_deg, [-10, 20])
    np.testing.assert_allclose(found.value, [3, 5.25], rtol=1e-12)
    assert found.sigma is not None
    np.testing.assert_allclose(found.sigma, [1, 0.25], rtol=1e-12)
    np.testing.assert_array_equal(found.rows, [1, 2])
    assert (found.quantity, found.unit, found.source) == ("intensity", "nA", "run 2026-01-01_RR")
    assert found.in_plane.all()  # the rig's arms move in it


def test_without_repeats_nothing_tells_the_noise() -> None:
    readings = [reading(1, -10, 2e-9), reading(2, 20, 5e-9), reading(3, -10, 4e-9)]
    assert measurements_of(run_of(readings)).sigma is None
    spoilt = [*readings, reading(4, 20, 9e-9, good=False), reading(5, 20, 9e-9, superseded=True)]
    np.testing.assert_allclose(measurements_of(run_of(spoilt)).value, [3, 5], rtol=1e-12)
    with pytest.raises(RunError, match="2026-01-01_RR holds no good reading to fit"):
        measurements_of(run_of(spoilt[3:]))
