"""The shape of the cells and the sharpness of the lobes, found from readings together with the mixture.

The mixture is linear, so it is solved exactly inside (variable projection, Golub and Pereyra 1973): the search is over the shape alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.errors import DomainError, FitError
from fitting.measurements import Measurements
from fitting.minimise import Minimum, minimise
from fitting.mixture import MixtureFit, Weights, fit_mixture
from fitting.paper import TERMS

Array = NDArray[np.float64]
Range = float | tuple[float, float]

ITERATIONS = 40
"""Steps of one descent over the shape, at most."""

DIFFERENCE = 1e-3
"""Half the span of the shape's differences, as a fraction of its bounds' distance: the terms are quadratures, exact to about 1e-4."""

STATIONARY = 1e-3
"""Bates and Watts' own tolerance (Technometrics 23, 179, 1981): a thousandth of the standard errors, about; quadratures allow no less."""

NAMES = ("aspect", "n_us", "n_ss")
"""What may be searched for."""


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Outcome of a shape fit.

    Attributes
    ----------
    aspect, n_us, n_ss : float
        Cell shape and lobe exponents, found or held.
    searched : tuple of str
        Which of them were searched for.
    sigma : dict of str to float or None
        Standard error of each of `searched`, the scatter of the residuals taken as the readings' own; None where the readings leave it
        open, at a bound, or with no reading to spare.
    mixtures : tuple of MixtureFit
        The mixture of each set of readings with that shape.
    minimum : Minimum
        The search: whether it converged, bounds hit, descents that disagree.
    """

    aspect: float
    n_us: float
    n_ss: float
    searched: tuple[str, ...]
    sigma: dict[str, float | None]
    mixtures: tuple[MixtureFit, ...]
    minimum: Minimum

    @property
    def converged(self) -> bool:
        """Whether the shape is a minimum, inside its bounds or at them."""
        return self.minimum.converged

    @property
    def at_bounds(self) -> dict[str, str]:
        """Which of `searched` ended at their "lower" or "upper" bound."""
        return {self.searched[i]: side for i, side in self.minimum.at_bounds}

    @property
    def statement(self) -> str:
        """What was found and how far to trust it."""
        found = []
        for name in self.searched:
            sigma = self.sigma[name]
            found.append(f"{name} = {getattr(self, name):.4g}" + (f" +- {sigma:.2g}" if sigma is not None else " (no standard error)"))
        found += [f"{name} at its {side} bound" for name, side in self.at_bounds.items()]
        return "; ".join([*found, self.minimum.statement])


def fit_shape(
    measurements: Measurements | Sequence[Measurements],
    *,
    aspect: Range = (0.1, 4.0),
    n_us: Range = (2.0, 200.0),
    n_ss: Range = (1.0, 100.0),
    weights: Weights = "relative",
    seed: int = 0,
    global_evaluations: int = 100,
    starts: int = 1,
) -> ShapeFit:
    """Fit cell shape and lobe exponents, shared by all sets of readings, and a mixture for each.

    Parameters
    ----------
    measurements : Measurements or sequence of them
        Readings at one or more incidences; several sets (cultivars) share the shape and differ in their mixture.
    aspect, n_us, n_ss : float or (float, float)
        Lower and upper bound of what is searched for, or the value to hold. Half-ellipsoids only.
    weights : {"relative", "plain", "sigma"}
        As in `fit_mixture`.
    seed, global_evaluations, starts : int
        As in `minimise`.

    Returns
    -------
    ShapeFit

    Raises
    ------
    DomainError
        If a bound or held value is outside the model, or nothing is left to search for.
    ReadingError
        If a reading does not suit the weights, or is behind the petal.
    FitError
        If there are fewer readings than unknowns.
    """
    sets = (measurements,) if isinstance(measurements, Measurements) else tuple(measurements)
    given: dict[str, Range] = dict(zip(NAMES, (aspect, n_us, n_ss), strict=True))
    searched = tuple(name for name, value in given.items() if isinstance(value, tuple))
    held = {name: float(value) for name, value in given.items() if not isinstance(value, tuple)}
    bounds = np.array([given[name] for name in searched], dtype=float)
    if not sets or not searched:
        raise DomainError("a shape fit needs readings, and something to search for: give a (lower, upper) pair, or use fit_mixture")
    if np.any(bounds <= 0):
        raise DomainError(f"the bounds of {', '.join(searched)} must be above 0")
    readings, unknowns = sum(len(m) for m in sets), len(TERMS) * len(sets) + len(searched)
    if readings < unknowns:
        raise FitError(f"{sets[0].source}: {readings} readings in all for {unknowns} unknowns: hold more of the shape, or add readings")

    def mixtures(shape: Array) -> tuple[MixtureFit, ...]:
        values = held | dict(zip(searched, shape.tolist(), strict=True))
        return tuple(fit_mixture(m, weights=weights, **values) for m in sets)

    mixtures(np.sqrt(bounds[:, 0] * bounds[:, 1]))  # what is wrong with the readings is said before the search

    scale = [_scale(m, weights) for m in sets]

    def residuals(shape: Array) -> Array:
        try:
            fits = mixtures(shape)
        except DomainError:
            return np.full(readings, np.inf)  # a lobe too narrow for the quadrature: refused, and counted as such
        return np.concatenate([(fit.modelled - fit.measured) / s for fit, s in zip(fits, scale, strict=True)])

    minimum = minimise(
        residuals,
        bounds,
        seed=seed,
        global_evaluations=global_evaluations,
        starts=starts,
        iterations=ITERATIONS,
        difference=DIFFERENCE,
        stationary=STATIONARY,
    )
    shape = held | dict(zip(searched, minimum.x.tolist(), strict=True))
    return ShapeFit(
        **shape,
        searched=searched,
        sigma=dict(zip(searched, _sigma(minimum, readings - unknowns), strict=True)),
        mixtures=mixtures(minimum.x),
        minimum=minimum,
    )


def _scale(measurements: Measurements, weights: Weights) -> Array:
    """What each residual is divided by; `fit_mixture` has checked it."""
    if weights == "relative":
        return measurements.intensity
    if weights == "sigma" and measurements.intensity_sigma is not None:
        return measurements.intensity_sigma
    # The size of a typical reading, so that sums of squares are of the order of 1 in any unit.
    return np.full(len(measurements), float(np.sqrt(np.mean(measurements.intensity**2))))


def _sigma(minimum: Minimum, spare: int) -> list[float | None]:
    """Standard errors by the projected Jacobian, which has the mixture's freedom in it (Kaufman 1975)."""
    p = len(minimum.x)
    pinned = {i for i, _ in minimum.at_bounds}
    free = [i for i in range(p) if i not in pinned]
    out: list[float | None] = [None] * p
    if spare <= 0 or not free or minimum.rank < p or not minimum.converged:
        return out
    covariance = np.linalg.inv(minimum.jacobian[:, free].T @ minimum.jacobian[:, free]) * minimum.cost / spare
    for i, variance in zip(free, np.diag(covariance), strict=True):
        out[i] = math.sqrt(variance) if variance >= 0 else None
    return out
