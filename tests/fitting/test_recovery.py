"""Whether the coefficients and shapes of petals that somebody else made come back within the errors that the fit gives them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fitting import TERMS, Measurements, paper_terms
from fitting.fit import fit
from fitting.ladder import rung_of
from fitting.linear import LinearFit, Weights, fit_linear
from fitting.search import usual_bounds
from tests.fitting.independent import Petal

TIMES = 1000

ROSE = Petal((0.5, 6.0, 0.3, 0.1), aspect=1.9)
DARK = Petal((0.05, 0.4, 0.02, 0.02), aspect=0.5)
THREE = Petal((0.04, 3.0, 0.02, 0.015), aspect=1.2, n_us=60, n_ss=4, incidences=(20, 45, 65), noise=0.02)

Fits = Callable[[Petal, np.ndarray, np.ndarray | None], list[LinearFit]]


def of_the_coefficients(petal: Petal, readings: np.ndarray, noise: np.ndarray | None) -> list[LinearFit]:
    terms = paper_terms(petal.theta_i, petal.theta_r, aspect=petal.aspect, n_us=petal.n_us, n_ss=petal.n_ss)
    weights: Weights = "relative" if noise is None else "covariance"
    return [fit_linear(terms, values, covariance=noise, weights=weights) for values in readings]


def of_the_model(petal: Petal, readings: np.ndarray, noise: np.ndarray | None) -> list[LinearFit]:
    shape = {"aspect": petal.aspect, "n_us": petal.n_us, "n_ss": petal.n_ss}
    weights: Weights = "relative" if noise is None else "covariance"
    tables = [Measurements(petal.theta_i, petal.theta_r, values, covariance=noise) for values in readings]
    return [fit(table, shape=shape, weights=weights).linear for table in tables]


def coverage(petal: Petal, fits: list[LinearFit]) -> np.ndarray:
    """How often each true coefficient, well above 0, lies within its interval, percent."""
    errors = np.mean([[c.standard_error for c in fit.coefficients] for fit in fits], axis=0)
    assert np.all(petal.x >= 3 * errors), "these truths are not 3 standard errors above 0"
    return np.asarray(
        100 * np.mean([[c.low <= x <= c.high for c, x in zip(fit.coefficients, petal.x, strict=True)] for fit in fits], axis=0)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("petal", "fits", "known"),
    [(DARK, of_the_coefficients, True), (THREE, of_the_coefficients, False), (ROSE, of_the_model, True)],
    ids=["hemispheres, covariance known", "three incidences, nothing known", "rose cells, by the model's fit, covariance known"],
)
def test_the_truth_lies_within_the_interval_95_times_in_100(petal: Petal, fits: Fits, known: bool) -> None:
    """Where the covariance is known, with a drift that all readings share; from their residuals nobody could tell it."""
    readings, covariance = petal.readings(TIMES, seed=20, drift=0.01 if known else 0.0)
    inside = coverage(petal, fits(petal, readings, covariance if known else None))
    assert np.all((inside >= 93) & (inside <= 97)), dict(zip(TERMS, inside, strict=True))


@pytest.mark.slow
def test_the_shape_comes_back_with_the_coefficients() -> None:
    """All seven numbers within 4 standard errors, at a minimum as deep as the noise leaves one."""
    petal = Petal((0.3, 20.0, 0.3, 0.1), aspect=1.2, n_us=30, n_ss=7, incidences=(20, 45, 65))
    truth = {"aspect": petal.aspect, "n_us": petal.n_us, "n_ss": petal.n_ss}
    readings, covariance = petal.readings(6, seed=1)
    for values in readings:
        table = Measurements(petal.theta_i, petal.theta_r, values, covariance=covariance)
        found = fit(table, shape=usual_bounds(rung_of("paper")), weights="covariance")
        assert found.converged
        assert found.at_bounds == {}
        errors = [found.shape_sigma[name] for name in truth] + [c.standard_error for c in found.linear.coefficients]
        misses = [found.shape[name] - true for name, true in truth.items()] + list(found.linear.x - petal.x)
        assert np.all(np.abs(misses) < 4 * np.array(errors, float))
        assert found.linear.chi2_per_dof is not None
        assert found.linear.chi2_per_dof < 1 + 4 * np.sqrt(2 / found.linear.dof)
