"""Readings made without the package: eqs. (1) to (8) point by point, and noise.

The domes' terms are summed over points of a dome, each lit and seen or not by a ray tested against every neighbour
(`tests.benchmarks.bench_model.plain_terms`, the yardstick there): another parametrisation, another quadrature, no shared code. With the
points taken here they agree with converged values to 0.1 % of each term's peak.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.bench_model import plain_terms

Array = NDArray[np.float64]

VIEWS = np.arange(-70.0, 71, 10)
"""The paper's 15 views, deg."""

POLAR, AROUND, AZIMUTHS = 300, 300, 12
CELL = 2 * math.sqrt(3)  # area of the patch for one dome of base radius 1, hexagonally packed


@functools.cache
def terms(theta_i: float, aspect: float, n_us: float, n_ss: float) -> Array:
    """Eqs. (1) to (7): u_diff, u_spec, s_diff, s_spec at the paper's views, shape (15, 4); theta_i in deg."""
    i, r = math.radians(theta_i), np.radians(VIEWS)
    domes = plain_terms(i, r, 2 * aspect, n_us, POLAR, AROUND, AZIMUTHS) / CELL
    mirrored = np.cos(i + r)  # R.V of the flat spongy tissue
    return np.column_stack([domes, np.full(len(r), math.cos(i)), np.where(mirrored > 0, mirrored, 0) ** n_ss])


@dataclass(frozen=True)
class Petal:
    """A petal whose truth is known, and how it is measured."""

    x: tuple[float, float, float, float]  # of eq. (8), I_i = 1
    aspect: float
    n_us: float = 40.0
    n_ss: float = 5.0
    incidences: tuple[float, ...] = (45.0,)
    noise: float = 0.01  # standard deviation of each reading, as a fraction of it

    @property
    def theta_i(self) -> Array:
        """One for each reading, deg."""
        return np.repeat(self.incidences, len(VIEWS))

    @property
    def theta_r(self) -> Array:
        """One for each reading, deg."""
        return np.tile(VIEWS, len(self.incidences))

    @property
    def clean(self) -> Array:
        """Eq. (8) for each reading."""
        return np.vstack([terms(i, self.aspect, self.n_us, self.n_ss) for i in self.incidences]) @ np.array(self.x)

    def readings(self, times: int, seed: int, drift: float = 0.0) -> tuple[Array, Array]:
        """Readings over and over, shape (times, n), and their covariance; they share a drift of this standard deviation, a fraction."""
        clean = self.clean
        covariance = np.diag((self.noise * clean) ** 2) + drift**2 * np.outer(clean, clean)
        noise = np.random.default_rng(seed).standard_normal((times, len(clean)))
        return clean + noise @ np.linalg.cholesky(covariance).T, covariance
