"""The ladder of models against the same readings: which of them the data support."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.aperture import Aperture
from fitting.errors import FitError
from fitting.fit import Fit, fitted, relative_error
from fitting.ladder import RUNGS, Rung, Traces
from fitting.linear import Weights
from fitting.measurements import Measurements
from fitting.progress import Progress, silent
from fitting.search import Effort, Range, Search, Shape, usual_bounds

CLOSE = 2.0
"""Differences of AICc below this tell nothing (Burnham and Anderson, Model Selection and Multimodel Inference, 2002, section 2.6)."""


@dataclass(frozen=True, eq=False)
class RungResult:
    """One model against the readings.

    Attributes
    ----------
    model : str
        Name of the rung.
    title : str
        For people; says if the shape was found where the rung's usual shape is held.
    searched : tuple of str
        Shape numbers found.
    fit : Fit or None
    left_out : float or None
        Mean E of each incidence by a fit to the others, averaged over incidences, percent; None with one incidence or too few readings.
    left_out_by_incidence : tuple of (float, float or None)
        theta_i in deg and mean E in percent.
    problem : str or None
        Why there is no fit.
    """

    model: str
    title: str
    searched: tuple[str, ...]
    fit: Fit | None
    left_out: float | None
    left_out_by_incidence: tuple[tuple[float, float | None], ...]
    problem: str | None = None

    @property
    def parameters(self) -> int:
        """Numbers taken from the readings."""
        return len(RUNGS[self.model].terms) + len(self.searched)

    @property
    def E_mean(self) -> float | None:
        """Mean E of what was fitted, percent."""
        return None if self.fit is None else self.fit.E_mean

    @property
    def E_max(self) -> float | None:
        """Largest E of what was fitted, percent."""
        return None if self.fit is None else self.fit.E_max

    @property
    def cosine_rmse(self) -> float | None:
        """Cosine-weighted error, in the unit of the readings."""
        return None if self.fit is None else self.fit.linear.cosine_rmse

    @property
    def chi2_per_dof(self) -> float | None:
        """Chi-square per degree of freedom, where the noise is known."""
        return None if self.fit is None else self.fit.linear.chi2_per_dof

    @property
    def aicc(self) -> float | None:
        """Akaike's criterion; None where it cannot be told."""
        return None if self.fit is None else self.fit.aicc

    @property
    def trusted(self) -> bool:
        """Whether the fit may be chosen: there is one, and its shape is a minimum."""
        return self.fit is not None and self.fit.converged

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and text for JSON."""
        names = ("model", "title", "parameters", "E_mean", "E_max", "cosine_rmse", "chi2_per_dof", "aicc", "left_out", "problem")
        return {name: getattr(self, name) for name in names} | {
            "searched": list(self.searched),
            "left_out_by_incidence": [list(pair) for pair in self.left_out_by_incidence],
            "x": None if self.fit is None else self.fit.x,
            "shape": None if self.fit is None else self.fit.shape,
            "converged": None if self.fit is None else self.fit.converged,
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """The ladder against the readings.

    Attributes
    ----------
    rows : tuple of RungResult
        From the simplest on.
    supported : RungResult or None
        What the data support.
    """

    rows: tuple[RungResult, ...]
    supported: RungResult | None

    @property
    def statement(self) -> str:
        """Which model the data support, why, and what speaks against it."""
        chosen = self.supported
        if chosen is None:
            return "the readings are too few to tell one model from another"
        lines = [f"the data support {chosen.title}: " + self._reason(chosen)]
        told = [row for row in self.rows if row.trusted and row.left_out is not None]
        if told and chosen.left_out is not None:
            best = min(told, key=lambda row: row.left_out or 0.0)
            if best is not chosen and best.left_out is not None and best.left_out < 0.9 * chosen.left_out:
                lines.append(
                    f"incidences left out are predicted better by {best.title}: "
                    f"mean E {best.left_out:.1f} % against {chosen.left_out:.1f} %"
                )
        doubtful = [row.title for row in self.rows if row.fit is not None and not row.trusted]
        lines += [f"{title}: its search did not converge, so it was not chosen" for title in doubtful]
        if chosen.fit is not None and chosen.fit.at_bounds:
            lines.append(f"{', '.join(chosen.fit.at_bounds)} ended at a bound: the best may lie beyond")
        return "\n".join(lines)

    def _reason(self, chosen: RungResult) -> str:
        told = [row for row in self.rows if row.trusted and row.aicc is not None]
        least = min(told, key=lambda row: row.aicc or 0.0)
        if least is chosen:
            others = [row.aicc - chosen.aicc for row in told if row is not chosen and row.aicc is not None and chosen.aicc is not None]
            return "the lowest AICc" + (f", by {min(others):.1f}" if others else "")
        return f"AICc within {CLOSE:g} of the lowest ({least.title}), with fewer numbers"

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and text for JSON."""
        return {
            "rows": [row.to_dict() for row in self.rows],
            "supported": None if self.supported is None else self.supported.title,
            "statement": self.statement,
        }


def compare(
    measurements: Measurements,
    *,
    models: Sequence[str] | None = None,
    shape: Mapping[str, Range] | None = None,
    weights: Weights = "relative",
    aperture: Aperture | None = None,
    effort: Effort | None = None,
    traces: Traces | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Fit every rung of the ladder, the paper's with its usual shape and once more with its shape found.

    A rung with too few readings for its numbers is told as such, not fitted.

    Parameters
    ----------
    measurements : Measurements
    models : sequence of str, optional
        Rungs; by default all.
    shape : mapping, optional
        As in `fit`, for the rungs that have these numbers.
    weights, aperture, effort, traces
        As in `fit`.
    progress : callable
        Told the share done, 0 to 1.

    Raises
    ------
    ReadingError, FitError, DomainError
        As `fit` does of the readings, whatever the model.
    """
    traces = traces or Traces()
    candidates = [(rung, searched) for name in models or RUNGS for rung in [RUNGS[name]] for searched in _searches(rung)]
    rows = []
    for k, (rung, searched) in enumerate(candidates):
        progress(k / len(candidates))
        names = {number.name for number in rung.shape}
        ranges = usual_bounds(rung, searched) | {name: value for name, value in (shape or {}).items() if name in names}
        search = Search.of(rung, Shape.of(rung, ranges), [measurements], weights, aperture, traces)
        rows.append(_result(search, effort or Effort()))
    progress(1.0)
    return Comparison(tuple(rows), _supported(rows))


def _searches(rung: Rung) -> list[tuple[str, ...]]:
    """What of a rung's shape is searched for: what it says, and for the paper's also all."""
    all_of_it = tuple(usual_bounds(rung))
    return [rung.searched] if rung.searched or not all_of_it else [(), all_of_it]


def _result(search: Search, effort: Effort) -> RungResult:
    rung, names = search.rung, tuple(search.shape.bounds)
    title = rung.title + (", shape found" if names and not rung.searched else "")
    try:
        fit = fitted(search, *search.minimise(effort))[0]
    except FitError as error:
        return RungResult(rung.name, title, names, None, None, (), str(error))
    left_out = _left_out(search, effort)
    values = [E for _, E in left_out]
    known = [E for E in values if E is not None]
    whole = len(known) == len(values) > 0
    return RungResult(rung.name, title, names, fit, math.fsum(known) / len(known) if whole else None, left_out)


def _left_out(search: Search, effort: Effort) -> tuple[tuple[float, float | None], ...]:
    """Mean E at each incidence by the shape and coefficients of the others."""
    (measurements,) = search.sets
    incidences = measurements.incidences.tolist()
    return tuple((theta_i, _without(search, k, effort)) for k, theta_i in enumerate(incidences)) if len(incidences) > 1 else ()


def _without(search: Search, incidence: int, effort: Effort) -> float | None:
    (measurements,) = search.sets
    kept = measurements.incidence_of != incidence
    try:
        found, _ = search.minimise(effort, [kept])
        (design,) = search.designs(found)
        x = search.coefficients(design[kept], measurements.take(kept))
    except FitError:
        return None  # too few readings are left for the model
    measured = measurements.intensity[~kept]
    E = relative_error(measured, design[~kept] @ x)
    return float(np.mean(E[measured > 0])) if np.any(measured > 0) else None


def _supported(rows: Sequence[RungResult]) -> RungResult | None:
    """The simplest of those whose AICc is next to the lowest."""
    told = [(row.aicc, row) for row in rows if row.trusted and row.aicc is not None]
    if not told:
        return None
    least = min(value for value, _ in told)
    return min((row for value, row in told if value <= least + CLOSE), key=lambda row: row.parameters)
