"""The search for a model's shape: the coefficients are linear, so they are solved exactly inside (variable projection).

Golub and Pereyra 1973, doi:10.1137/0710036; the standard errors by Kaufman's Jacobian, BIT 15 (1975) 49.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.aperture import Aperture
from fitting.errors import DomainError, FitError
from fitting.ladder import Design, Directions, Rung, Traces
from fitting.linear import Weights, weighing
from fitting.measurements import Measurements
from fitting.minimise import Minimum, minimise

Array = NDArray[np.float64]
Range = float | tuple[float, float]
Kept = NDArray[np.bool_]

ITERATIONS = 40
"""Steps of one descent over the shape, at most."""

DIFFERENCE = 1e-3
"""Half the span of the shape's differences, as a fraction of its bounds' distance: the terms are quadratures, exact to about 1e-4."""

STATIONARY = 1e-3
"""Bates and Watts' own tolerance (Technometrics 23, 179, 1981): a thousandth of the standard errors, about; quadratures allow no less."""


@dataclass(frozen=True)
class Effort:
    """How hard a shape is searched for, see `fitting.minimise.minimise`."""

    seed: int = 0
    global_evaluations: int = 100
    starts: int = 1


@dataclass(frozen=True)
class Shape:
    """Which shape numbers are held, and which are searched for within bounds."""

    held: Mapping[str, float]
    bounds: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, rung: Rung, given: Mapping[str, Range]) -> Shape:
        """Check what is given for a rung: a value holds a number, a pair of bounds searches for it, what is left out has its usual value.

        Raises
        ------
        DomainError
            If the rung has no such number, or a value or bound is out of its range.
        """
        known = {number.name: number for number in rung.shape}
        if unknown := sorted(set(given) - set(known)):
            has = f"its shape numbers are {', '.join(known)}" if known else "it has no shape numbers"
            raise DomainError(f"the model {rung.name!r} has no {', '.join(unknown)}: {has}")
        held = {name: number.usual for name, number in known.items()}
        bounds = {}
        for name, value in given.items():
            ends = value if isinstance(value, tuple) else (value,)
            least, most = known[name].least, known[name].most
            limits = (f"{least:g} or more" if least > 0 else "above 0") + ("" if most == math.inf else f" and at most {most:g}")
            if not all(math.isfinite(v) and v > 0 and least <= v <= most for v in ends):
                raise DomainError(f"{name} ({known[name].meaning}) must be {limits}, not {value!r}")
            if isinstance(value, tuple):
                if len(value) != 2 or not value[0] < value[1]:
                    raise DomainError(f"the bounds of {name} must be a pair, the lower one first, not {value!r}")
                bounds[name] = (float(value[0]), float(value[1]))
                del held[name]
            else:
                held[name] = float(value)
        return cls(held, bounds)


def usual_bounds(rung: Rung, names: Sequence[str] | None = None) -> dict[str, Range]:
    """Return bounds to search within: of the numbers named, by default of all but the fine ones.

    Raises
    ------
    DomainError
        If the rung has no such number.
    """
    known: dict[str, Range] = {number.name: (number.low, number.high) for number in rung.shape}
    chosen = tuple(number.name for number in rung.shape if not number.fine) if names is None else tuple(names)
    Shape.of(rung, dict.fromkeys((n for n in chosen if n not in known), 1.0))
    return {name: known[name] for name in chosen}


@dataclass(frozen=True, eq=False)
class Search:
    """One rung against sets of readings that share its shape and have coefficients of their own.

    Attributes
    ----------
    rung : Rung
    shape : Shape
    sets : tuple of Measurements
        All of reflection.
    weights : str
        As in `fit_linear`.
    aperture : Aperture
    traces : Traces
    quick : callable
        From the numbers searched for to the terms of all sets, one below the other.
    """

    rung: Rung
    shape: Shape
    sets: tuple[Measurements, ...]
    weights: Weights
    aperture: Aperture
    traces: Traces
    quick: Design

    @classmethod
    def of(
        cls, rung: Rung, shape: Shape, sets: Sequence[Measurements], weights: Weights, aperture: Aperture | None, traces: Traces | None
    ) -> Search:
        """Check the readings and make ready; errors as `fitting.fit.fit`."""
        if not sets or any(len(m) == 0 for m in sets):
            raise FitError("there are no readings to fit")
        for m in sets:
            if np.any(behind := np.abs(m.theta_r_deg) > 90):
                first = int(np.flatnonzero(behind)[0])
                problem = f"theta_r = {m.theta_r_deg[first]:g} deg is behind the petal, and the model is of reflection only: leave it out"
                raise m.error(first, problem)
            if not np.any(m.intensity > 0):
                raise FitError(f"{m.source}: no reading is above 0, so there is no light to explain")
            weigh(m, weights)
        aperture, traces = aperture or Aperture(), traces or Traces()
        at, mean = seen(aperture, *(np.concatenate([getattr(m, f"{name}_deg") for m in sets]) for name in ("theta_i", "theta_r", "phi")))
        design = rung.quick_design(at, shape.held, shape.bounds, traces)
        return cls(rung, shape, tuple(sets), weights, aperture, traces, lambda found: mean(design(found)))

    def designs(self, found: Mapping[str, float]) -> list[Array]:
        """Terms of each set for a shape, quickly."""
        ends = np.cumsum([len(m) for m in self.sets])
        return np.split(self.quick(found), ends[:-1])

    def minimise(self, effort: Effort, kept: Sequence[Kept] | None = None) -> tuple[dict[str, float], Minimum | None]:
        """Find the shape; with `kept`, from some of each set's readings.

        Returns
        -------
        found : dict of str to float
            The numbers searched for.
        minimum : Minimum or None
            None where nothing is searched for.

        Raises
        ------
        FitError
            If there are fewer readings than unknowns.
        """
        names = tuple(self.shape.bounds)
        if not names:
            return {}, None
        chosen = [np.ones(len(m), bool) for m in self.sets] if kept is None else kept
        used = [m.take(k) for m, k in zip(self.sets, chosen, strict=True)]
        readings, unknowns = sum(len(m) for m in used), len(self.rung.terms) * len(used) + len(names)
        if readings < unknowns:
            raise FitError(
                f"{self.sets[0].source}: {readings} readings in all for {unknowns} unknowns of the model {self.rung.name!r}: "
                "hold more of the shape, or add readings"
            )
        scaled = [weigh(m, self.weights) for m in used]
        aims = [scale(m.intensity[:, None])[:, 0] for scale, m in zip(scaled, used, strict=True)]
        # So that plain weights count a dark set as much as a pale one.
        sizes = [float(np.sqrt(np.mean(aim**2))) if self.weights == "plain" else 1.0 for aim in aims]

        def residuals(place: Array) -> Array:
            try:
                designs = self.designs(dict(zip(names, place.tolist(), strict=True)))
            except DomainError:
                return np.full(readings, np.inf)  # such as a lobe too narrow for the quadrature: refused, and counted as such
            each = zip(designs, chosen, scaled, aims, sizes, strict=True)
            return np.concatenate([_misfit(scale(design[rows]), aim) / size for design, rows, scale, aim, size in each])

        bounds = np.array(list(self.shape.bounds.values()))
        minimum = minimise(
            residuals,
            bounds,
            seed=effort.seed,
            global_evaluations=effort.global_evaluations,
            starts=effort.starts,
            iterations=ITERATIONS,
            difference=DIFFERENCE,
            stationary=STATIONARY,
        )
        return dict(zip(names, minimum.x.tolist(), strict=True)), minimum

    def coefficients(self, design: Array, measurements: Measurements) -> Array:
        """Coefficients of one set for terms of its readings, shape (c,)."""
        scale = weigh(measurements, self.weights)
        return _solved(scale(design), scale(measurements.intensity[:, None])[:, 0])

    def tangents(self, found: Mapping[str, float], free: Sequence[str]) -> list[Array]:
        """How each set's fitted values change with some of the numbers searched for, per number: columns, by central differences."""
        if not free:
            return [np.empty((len(m), 0)) for m in self.sets]
        middle = self.designs(found)
        x = [self.coefficients(d, m) for d, m in zip(middle, self.sets, strict=True)]
        columns = [np.empty((len(m), len(free))) for m in self.sets]
        for i, name in enumerate(free):
            low, high = self.shape.bounds[name]
            ends = [min(max(found[name] * (1 + s * 10 * DIFFERENCE), low), high) for s in (-1, 1)]
            before, after = (self.designs({**found, name: end}) for end in ends)
            for k, coefficients in enumerate(x):
                columns[k][:, i] = (after[k] - before[k]) @ coefficients / (ends[1] - ends[0])
        return columns


def seen(aperture: Aperture, theta_i_deg: Array, theta_r_deg: Array, phi_deg: Array) -> tuple[Directions, Callable[[Array], Array]]:
    """Return the directions of which readings through an aperture are the mean, and the function that takes the mean of terms there."""
    if aperture.is_ideal:
        return Directions.of(theta_i_deg, theta_r_deg, phi_deg), lambda terms: terms
    theta_i, theta_r, phi, weight = aperture.nodes(theta_i_deg, theta_r_deg, phi_deg)
    at = Directions.of(theta_i.ravel(), theta_r.ravel(), phi.ravel())

    def mean(terms: Array) -> Array:
        return np.asarray(np.einsum("nkc,nk->nc", terms.reshape(*weight.shape, -1), weight))

    return at, mean


def weigh(measurements: Measurements, weights: Weights) -> Callable[[Array], Array]:
    """Return the weights of readings, see `fitting.linear.weighing`."""
    covariance = measurements.intensity_covariance if weights in ("sigma", "covariance") else None
    return weighing(measurements.intensity, covariance=covariance, weights=weights, source=measurements.source, rows=measurements.rows)


def shape_errors(minimum: Minimum, spare: int, known_noise: bool) -> list[float | None]:
    """Standard errors of the numbers found; None where the readings leave a number open, at a bound, or with no reading to spare.

    Parameters
    ----------
    minimum : Minimum
    spare : int
        Readings less unknowns.
    known_noise : bool
        Whether residuals are in standard deviations; else their scatter is taken as the noise.
    """
    p = len(minimum.x)
    pinned = {i for i, _ in minimum.at_bounds}
    free = [i for i in range(p) if i not in pinned]
    out: list[float | None] = [None] * p
    if (spare <= 0 and not known_noise) or not free or minimum.rank < p or not minimum.converged:
        return out
    level = 1.0 if known_noise else minimum.cost / spare
    covariance = np.linalg.inv(minimum.jacobian[:, free].T @ minimum.jacobian[:, free]) * level
    for i, variance in zip(free, np.diag(covariance), strict=True):
        out[i] = math.sqrt(variance) if variance >= 0 else None
    return out


def _solved(design: Array, aim: Array) -> Array:
    from scipy.optimize import nnls

    length = np.linalg.norm(design, axis=0)
    length[length == 0] = 1.0
    try:
        return np.asarray(nnls(design / length, aim)[0] / length)
    except RuntimeError as error:
        raise FitError(f"non-negative least squares did not converge: {error}") from error


def _misfit(design: Array, aim: Array) -> Array:
    """Residuals of the best coefficients."""
    return np.asarray(design @ _solved(design, aim) - aim)
