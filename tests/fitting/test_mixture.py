"""The mixture: recovery, constraints, weights, and what cannot be determined."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from fitting import TERMS, DomainError, FitError, Measurements, MixtureFit, ReadingError, fit_mixture, paper_terms
from fitting.mixture import Weights

VIEWS = np.arange(-70.0, 71, 10)
coefficient = st.floats(0.01, 5)


def readings(value: np.ndarray, theta_i: Any = 45.0, theta_r: np.ndarray = VIEWS, **others: Any) -> Measurements:
    return Measurements(theta_i_deg=np.broadcast_to(theta_i, theta_r.shape), theta_r_deg=theta_r, value=value, **others)


def noisy(seed: int, x: list[float], aspect: float = 1.9) -> Measurements:
    random = np.random.default_rng(seed)
    clean = paper_terms(45, VIEWS, aspect=aspect) @ x
    sigma = 0.02 * clean * random.uniform(0.5, 3, len(VIEWS))
    return readings(clean + sigma * random.standard_normal(len(VIEWS)), sigma=sigma)


@given(x=st.tuples(coefficient, coefficient, coefficient, coefficient), aspect=st.sampled_from([0.5, 1.9]))
def test_what_was_mixed_is_found(x: tuple[float, ...], aspect: float) -> None:
    fit = fit_mixture(readings(paper_terms(45, VIEWS, aspect=aspect) @ x), aspect=aspect)
    np.testing.assert_allclose([fit.x[name] for name in TERMS], x, rtol=1e-6)
    assert fit.E_max < 1e-6
    assert fit.zero == ()
    assert fit.determined
    assert "all four coefficients are determined by 15 readings" in fit.statement


@pytest.mark.parametrize("quantity", ["intensity", "reflectance-factor", "brdf"])
@pytest.mark.parametrize("weights", ["relative", "plain", "sigma"])
def test_several_incidences_share_one_mixture(quantity: str, weights: Weights) -> None:
    theta_i, theta_r = (a.ravel() for a in np.meshgrid([20.0, 45, 65], VIEWS))
    x = [0.3, 2.0, 0.4, 0.1]
    intensity = paper_terms(theta_i, theta_r, aspect=1.2, n_us=30, n_ss=6) @ x
    per_value = {"intensity": 1, "reflectance-factor": np.cos(np.radians(theta_i)), "brdf": math.pi * np.cos(np.radians(theta_i))}[quantity]
    value = intensity / per_value
    taken = readings(value, theta_i, theta_r, quantity=quantity, sigma=0.01 + 0.05 * value)
    fit = fit_mixture(taken, aspect=1.2, n_us=30, n_ss=6, weights=weights)
    np.testing.assert_allclose([fit.x[name] for name in TERMS], x, rtol=1e-6)
    np.testing.assert_allclose(fit.measured, intensity, rtol=1e-12)


def test_four_readings_are_enough_and_three_are_not() -> None:
    few = np.array([-60.0, -40, 10, 70])
    x = [1.0, 3, 0.5, 0.2]
    fit = fit_mixture(readings(paper_terms(45, few) @ x, theta_r=few), aspect=0.5)
    np.testing.assert_allclose([fit.x[name] for name in TERMS], x, rtol=1e-6)
    with pytest.raises(FitError, match="3 readings, expected at least 4"):
        fit_mixture(readings(np.ones(3), theta_r=few[:3]), aspect=0.5)


@pytest.mark.parametrize("weights", ["relative", "plain", "sigma"])
@pytest.mark.parametrize("x", [[0.5, 3.0, 0.3, 0.1], [0.0, 0.0, 0.5, 0.2], [0.6, -4.0, 0.3, 0.2]])
def test_weights_are_those_they_claim_to_be(weights: Weights, x: list[float]) -> None:
    """Against another solver of bounded least squares, unscaled."""
    taken = noisy(3, x)
    terms = paper_terms(45, VIEWS, aspect=1.9)
    assert taken.sigma is not None
    weight = {"relative": 1 / taken.value, "plain": np.ones(len(VIEWS)), "sigma": 1 / taken.sigma}[weights]
    other = lsq_linear(terms * weight[:, None], taken.value * weight, bounds=(0, np.inf), method="bvls", tol=1e-14)
    fit = fit_mixture(taken, aspect=1.9, weights=weights)
    np.testing.assert_allclose([fit.x[name] for name in TERMS], other.x, rtol=1e-6, atol=1e-9)


def test_weights_differ() -> None:
    found = [fit_mixture(noisy(5, [0.5, 3.0, 0.3, 0.1]), aspect=1.9, weights=w).x["s_diff"] for w in ("relative", "plain", "sigma")]
    assert len({round(v, 6) for v in found}) == 3


def test_nothing_is_negative() -> None:
    value = paper_terms(45, VIEWS, aspect=1.9) @ [0.8, -10.0, 0.3, 0.2]
    fit = fit_mixture(readings(value), aspect=1.9)
    assert fit.x["u_spec"] == 0
    assert fit.zero == ("u_spec",)
    assert fit.E_max > 1


def test_repeats_count_twice() -> None:
    taken = noisy(2, [0.5, 3.0, 0.3, 0.1])
    extra = np.repeat(np.arange(len(VIEWS)), np.where(VIEWS == 20, 3, 1))
    repeated = readings(taken.value[extra], theta_r=VIEWS[extra])
    weighted = readings(taken.value, sigma=taken.value / np.sqrt(np.where(VIEWS == 20, 3, 1)))
    first, second = fit_mixture(repeated, aspect=1.9), fit_mixture(weighted, aspect=1.9, weights="sigma")
    np.testing.assert_allclose(list(first.x.values()), list(second.x.values()), rtol=1e-8)


def test_error_is_equation_13() -> None:
    taken = noisy(1, [0.5, 3.0, 0.3, 0.1])
    fit = fit_mixture(taken, aspect=1.9)
    model = paper_terms(45, VIEWS, aspect=1.9) @ [fit.x[name] for name in TERMS]
    expected = 100 * abs(taken.value - model) / taken.value
    np.testing.assert_allclose(fit.E, expected, rtol=1e-9)
    assert fit.E_mean == pytest.approx(expected.mean())
    assert fit.E_max == pytest.approx(expected.max())
    np.testing.assert_allclose(fit.predict(45, VIEWS), model, rtol=1e-12)
    assert fit.predict(45, VIEWS.reshape(3, 5)).shape == (3, 5)
    assert fit.predict(45, 10).shape == ()
    with pytest.raises(DomainError):
        fit.predict(45, 100)


def test_terms_that_look_alike_are_not_determined() -> None:
    """Between light and normal both diffuse terms are constant, and the mirror lobe of the spongy tissue is far."""
    between = np.array([0.0, 10, 20, 30, 40])
    fit = fit_mixture(readings(np.full(5, 0.7), theta_r=between), aspect=1.9)
    assert fit.rank < 4
    assert not fit.determined
    assert {"u_diff", "s_diff"} <= set(fit.undetermined)
    assert fit.statement.startswith("NOT determined: 5 readings")
    assert "u_diff" in fit.statement
    assert fit.condition > 1e3


def test_a_term_absent_from_all_readings_is_said_to_be_undetermined() -> None:
    near = np.array([45.0, 50, 55, 60, 70])  # cos(theta_i + theta_r) <= 0
    fit = fit_mixture(readings(paper_terms(45, near, aspect=0.5) @ [1, 1, 1, 0], theta_r=near), aspect=0.5)
    assert fit.x["s_spec"] == 0
    assert "s_spec" in fit.undetermined
    assert fit.condition == math.inf
    assert fit.to_dict()["condition"] is None


@pytest.mark.parametrize("bad", [0.0, -0.1])
def test_relative_weights_need_light(bad: float) -> None:
    value = np.ones(len(VIEWS))
    value[4] = bad
    taken = readings(value, source="bench", rows=np.arange(101, 116))
    with pytest.raises(ReadingError, match=r"bench, row 105: reading is -?0.*relative weights need it above 0"):
        fit_mixture(taken, aspect=0.5)
    fit = fit_mixture(taken, aspect=0.5, weights="plain")
    assert np.flatnonzero(np.isnan(fit.E)).tolist() == [4]
    assert math.isfinite(fit.E_mean)
    assert fit.to_dict()["E"][4] is None


def test_weights_that_cannot_be() -> None:
    with pytest.raises(FitError, match="no sigma"):
        fit_mixture(readings(np.ones(15)), aspect=0.5, weights="sigma")
    with pytest.raises(ReadingError, match="row 1: sigma is 0"):
        fit_mixture(readings(np.ones(15), sigma=np.zeros(15)), aspect=0.5, weights="sigma")
    with pytest.raises(FitError, match="unknown weights 'chi2'"):
        fit_mixture(readings(np.ones(15)), aspect=0.5, weights="chi2")  # type: ignore[arg-type]
    with pytest.raises(FitError, match="no light to explain"):
        fit_mixture(readings(np.zeros(15)), aspect=0.5, weights="plain")


def test_transmission_is_not_fitted() -> None:
    with pytest.raises(ReadingError, match=r"row 15: theta_r = 135 deg is behind the petal"):
        fit_mixture(readings(np.ones(15), theta_r=np.append(VIEWS[:-1], 135)), aspect=0.5)
    with pytest.raises(DomainError, match="aspect"):
        fit_mixture(readings(np.ones(15)), aspect=-1)


@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_a_stored_fit_comes_back(aspect: float) -> None:
    fit = fit_mixture(noisy(1, [0.5, 3.0, 0.0, 0.1]), aspect=aspect, n_us=35, weights="sigma")
    stored = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    again = MixtureFit.from_dict(stored)
    assert again.to_dict() == fit.to_dict()
    np.testing.assert_array_equal(again.predict(30, VIEWS), fit.predict(30, VIEWS))
    assert stored["x"] == fit.x
    assert stored["E_mean"] == fit.E_mean
    assert stored["n"] == 15


def test_stored_fits_that_are_not() -> None:
    stored = fit_mixture(noisy(1, [0.5, 3.0, 0.0, 0.1]), aspect=0.5).to_dict()
    with pytest.raises(FitError, match="lacks 'x'"):
        MixtureFit.from_dict({k: v for k, v in stored.items() if k != "x"})
    with pytest.raises(FitError, match="cannot be read"):
        MixtureFit.from_dict(stored | {"measured": ["a"]})
    with pytest.raises(FitError, match="'radiometric'"):
        MixtureFit.from_dict(stored | {"model": "radiometric"})
