"""The linear fit: least squares from 0 up, intervals at and off the bound, what cannot be told, and what is refused."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear, nnls
from scipy.stats import chi2, f, norm, t

from fitting import FitError, ReadingError, paper_terms
from fitting.linear import LinearFit, fit_linear

VIEWS = np.arange(-70.0, 71, 10)
POINT = norm.ppf(0.975) ** 2


@pytest.fixture(scope="module")
def terms() -> np.ndarray:
    return paper_terms(45, VIEWS, aspect=1.9)


def correlated(values: np.ndarray, fraction: float = 0.02) -> np.ndarray:
    """Noise of each reading by itself, and a drift they share."""
    return np.diag((fraction * values) ** 2) + np.outer(values, values) * (0.5 * fraction) ** 2


def drawn(seed: int, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return mean + np.linalg.cholesky(covariance) @ np.random.default_rng(seed).standard_normal(len(mean))


def excess(terms: np.ndarray, values: np.ndarray, covariance: np.ndarray, j: int, at: float) -> float:
    """Growth of chi-square when coefficient j is held, by another route: the inverse covariance's root, and nnls over the others."""
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    scale = 1e-3 if np.abs(root).max() > 1e3 else 1.0
    least = nnls(scale * root @ terms, scale * root @ values)[1] ** 2
    held = nnls(scale * root @ np.delete(terms, j, axis=1), scale * root @ (values - at * terms[:, j]))[1] ** 2
    return (held - least) / scale**2


# What is minimised


@given(x=st.lists(st.floats(0.01, 5), min_size=4, max_size=4))
@settings(max_examples=25)
def test_what_was_mixed_is_found(terms: np.ndarray, x: list[float]) -> None:
    fit = fit_linear(terms, terms @ x, theta_r_deg=VIEWS)
    np.testing.assert_allclose(fit.x, x, rtol=1e-7)
    assert (fit.rank, fit.active, fit.undetermined, fit.groups) == (4, (), (), ())
    assert fit.E_max == pytest.approx(0, abs=1e-8)
    assert fit.cosine_rmse == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("weights", ["relative", "plain", "sigma", "covariance"])
@pytest.mark.parametrize("x", [[0.5, 3.0, 0.3, 0.1], [0.0, 0.0, 0.5, 0.2], [0.6, -4.0, 0.3, 0.2]])
def test_weights_are_those_they_claim_to_be(terms: np.ndarray, weights: Any, x: list[float]) -> None:
    """Against another solver, whitened by the inverse covariance's root instead of the covariance's."""
    covariance = correlated(terms @ x)
    values = drawn(3, terms @ x, covariance)
    root = {
        "relative": np.diag(1 / values),
        "plain": np.eye(15),
        "sigma": np.diag(np.diag(covariance) ** -0.5),
        "covariance": np.linalg.cholesky(np.linalg.inv(covariance)).T,
    }[weights]
    other = lsq_linear(root @ terms, root @ values, bounds=(0, np.inf), method="bvls", tol=1e-14)
    fit = fit_linear(terms, values, covariance=covariance, weights=weights)
    np.testing.assert_allclose(fit.x, other.x, rtol=1e-6, atol=1e-8)
    residual = values - fit.modelled
    assert fit.sum_of_squares == pytest.approx(float(np.sum((root @ residual) ** 2)), rel=1e-8)
    assert fit.chi2 == pytest.approx(float(residual @ np.linalg.solve(covariance, residual)), rel=1e-8)
    gradient = 2 * (root @ terms).T @ (root @ (fit.modelled - values))
    for c, push in zip(fit.coefficients, gradient, strict=True):
        assert c.active == (c.value == 0)
        assert c.multiplier == (pytest.approx(push, rel=1e-6) if c.active else 0)
        assert c.multiplier >= 0


def test_any_number_of_columns() -> None:
    random = np.random.default_rng(8)
    for columns in (1, 2, 7):
        design, x = random.random((20, columns)), random.random(columns)
        fit = fit_linear(design, design @ x, names=[f"c{i}" for i in range(columns)])
        np.testing.assert_allclose(fit.x, x, rtol=1e-8)


# Standard errors and intervals


def test_away_from_the_bound_it_is_textbook_least_squares(terms: np.ndarray) -> None:
    x = np.array([5.0, 300, 3, 2])
    covariance = correlated(terms @ x, 1e-3)
    fit = fit_linear(terms, drawn(1, terms @ x, covariance), covariance=covariance, weights="covariance")
    inverse = np.linalg.inv(terms.T @ np.linalg.solve(covariance, terms))
    deviation = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose([c.standard_error for c in fit.coefficients], deviation, rtol=1e-6)
    np.testing.assert_allclose([c.low for c in fit.coefficients], fit.x - math.sqrt(POINT) * deviation, rtol=1e-6)
    np.testing.assert_allclose([c.high for c in fit.coefficients], fit.x + math.sqrt(POINT) * deviation, rtol=1e-6)
    np.testing.assert_allclose(fit.correlation, inverse / deviation[:, None] / deviation, atol=1e-6)
    assert fit.dof == 11


@pytest.mark.parametrize("weights", ["relative", "plain"])
def test_without_a_covariance_the_residuals_tell_the_noise(terms: np.ndarray, weights: Any) -> None:
    x = np.array([5.0, 300, 3, 2])
    values = (terms @ x) * (1 + 1e-3 * np.random.default_rng(4).standard_normal(15))
    fit = fit_linear(terms, values, weights=weights)
    design = terms / values[:, None] if weights == "relative" else terms
    scale = np.linalg.norm(design @ fit.x - (1 if weights == "relative" else values)) / math.sqrt(11)
    deviation = scale * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert fit.scale == pytest.approx(scale)
    assert (fit.chi2, fit.chi2_per_dof, fit.known_noise) == (None, None, False)
    np.testing.assert_allclose([c.standard_error for c in fit.coefficients], deviation, rtol=1e-6)
    np.testing.assert_allclose([c.high for c in fit.coefficients], fit.x + t.ppf(0.975, 11) * deviation, rtol=1e-6)


@pytest.mark.parametrize("weights", ["relative", "plain", "sigma"])
def test_a_known_covariance_gives_the_errors_under_any_weights(terms: np.ndarray, weights: Any) -> None:
    """The estimate is linear in the readings (relative weights aside, held here), so its covariance is too."""
    x = np.array([5.0, 300, 3, 2])
    covariance = correlated(terms @ x, 1e-3)
    values = drawn(5, terms @ x, covariance)
    weight = {"relative": 1 / values, "plain": np.ones(15), "sigma": np.diag(covariance) ** -0.5}[weights]
    gain = np.linalg.pinv(terms * weight[:, None]) * weight
    fit = fit_linear(terms, values, covariance=covariance, weights=weights)
    deviation = np.sqrt(np.diag(gain @ covariance @ gain.T))
    np.testing.assert_allclose([c.standard_error for c in fit.coefficients], deviation, rtol=1e-6)
    np.testing.assert_allclose([c.low for c in fit.coefficients], fit.x - math.sqrt(POINT) * deviation, rtol=1e-5)


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(5, 12),
    x=st.lists(st.sampled_from([0.0, 0.02, 0.1, 0.5]), min_size=5, max_size=5),
)
@settings(max_examples=60)
def test_intervals_span_the_profile_and_plain_least_squares(seed: int, n: int, x: list[float]) -> None:
    """Near the bound, where pieces of the profile join: the profile against nnls over the other coefficients."""
    random = np.random.default_rng(seed)
    design = random.random((n, 5))
    covariance = np.diag(random.uniform(0.01, 0.1, n) ** 2) + 1e-4
    values = drawn(seed, design @ x, covariance)
    fit = fit_linear(design, values, covariance=covariance, weights="covariance", names="abcde")
    if fit.undetermined:
        return
    inverse = np.linalg.inv(design.T @ np.linalg.solve(covariance, design))
    free, reach = inverse @ design.T @ np.linalg.solve(covariance, values), np.sqrt(POINT * np.diag(inverse))
    for j, c in enumerate(fit.coefficients):
        assert c.low <= c.value <= c.high
        assert c.low <= max(0, free[j] - reach[j]) + 1e-7
        assert c.high >= free[j] + reach[j] - 1e-7
        for end, plain in ((c.low, max(0.0, free[j] - reach[j])), (c.high, free[j] + reach[j])):
            risen = excess(design, values, covariance, j, end)
            if end == 0:
                assert risen <= POINT * (1 + 1e-6) or plain == 0
            elif end == pytest.approx(plain, rel=1e-6):
                assert risen >= POINT * (1 - 1e-4)
            else:
                assert risen == pytest.approx(POINT, rel=1e-5)


@pytest.mark.parametrize("truth", [0.0, 1.0, 2.0, 10.0])
def test_a_single_coefficient_is_covered_wherever_it_lies(truth: float) -> None:
    """One reading r of noise 1. Below 0 the excess is (truth - r)^2 - r^2, so that near 0 few readings or none are too low to hold it."""
    readings = norm.ppf((np.arange(400) + 0.5) / 400, truth)
    readings = readings[readings > -5]
    fits = [fit_linear([[1.0]], [r], covariance=[[1.0]], weights="covariance", names=["x"])["x"] for r in readings]
    covered = np.mean([c.low <= truth <= c.high for c in fits])
    lowest = truth - math.sqrt(POINT) if truth > math.sqrt(POINT) else (truth**2 - POINT) / (2 * truth or 1e-9)
    assert covered == pytest.approx(0.975 - norm.cdf(lowest - truth), abs=0.004)
    assert covered >= 0.95 - 0.004


@pytest.mark.slow
def test_the_truth_is_within_the_interval_as_often_as_it_says(terms: np.ndarray) -> None:
    x = np.array([0.5, 8.0, 0.3, 0.1])
    covariance = correlated(terms @ x)
    inside = np.zeros(4)
    for seed in range(400):
        fit = fit_linear(terms, drawn(seed, terms @ x, covariance), covariance=covariance, weights="covariance")
        inside += [c.low <= true <= c.high for c, true in zip(fit.coefficients, x, strict=True)]
    assert np.all(np.abs(inside / 400 - 0.95) < 3.5 * math.sqrt(0.95 * 0.05 / 400))


# What the readings cannot tell


def test_terms_that_look_alike_are_named_and_bounded() -> None:
    """Between light and normal both diffuse terms are constant: only their sum is known, and each lies from 0 to it."""
    between = np.array([0.0, 10, 20, 30, 40])
    alike = paper_terms(45, between, aspect=1.9)[:, [0, 2]]
    fit = fit_linear(alike, np.full(5, 0.7), names=("u_diff", "s_diff"), covariance=1e-6 * np.eye(5), weights="covariance")
    assert fit.groups == (("u_diff", "s_diff"),)
    assert fit.rank == 1
    assert [c.low for c in fit.coefficients] == [0, 0]
    assert [c.high for c in fit.coefficients] == pytest.approx([0.7 / alike[0, 0], 0.7 / alike[0, 1]], rel=5e-3)
    assert [c.standard_error for c in fit.coefficients] == [math.inf, math.inf]
    assert fit.alike == (("u_diff", "s_diff", pytest.approx(-1)),)
    assert "u_diff and s_diff are NOT determined" in fit.statement
    np.testing.assert_allclose(fit.modelled, 0.7, rtol=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_where_terms_are_alike_the_point_is_that_of_all_directions(known: bool) -> None:
    random = np.random.default_rng(6)
    a, b = random.random((2, 12))
    values = 2 * a + b + 0.02 * random.standard_normal(12)
    fit = fit_linear(np.column_stack([a, b, a]), values, weights="plain", names="abc", covariance=4e-4 * np.eye(12) if known else None)
    assert fit.scale is not None
    rest = np.column_stack([b, a])
    risen = nnls(rest, values - fit["a"].high * a)[1] ** 2 - fit.sum_of_squares
    assert risen == pytest.approx(4e-4 * chi2.ppf(0.95, 2) if known else fit.scale**2 * 2 * f.ppf(0.95, 2, fit.dof), rel=1e-6)


def test_separate_ambiguities_are_separate_groups_and_the_rest_is_found() -> None:
    a, b, c = np.random.default_rng(2).random((3, 10))
    fit = fit_linear(np.column_stack([a, b, 2 * a, c, b]), a + 2 * b + 3 * c, names="abcde", covariance=1e-8 * np.eye(10))
    assert fit.groups == (("a", "c"), ("b", "e"))
    assert fit.undetermined == ("a", "b", "c", "e")
    assert fit["d"].value == pytest.approx(3)
    assert fit["d"].low < 3 < fit["d"].high < 3.01
    assert fit["a"].high == pytest.approx(1, abs=0.01)
    assert fit["b"].high == pytest.approx(2, abs=0.01)
    assert not np.isnan(fit.correlation).any()


def test_an_absent_term_is_not_determined_and_the_rest_is() -> None:
    near = np.array([45.0, 50, 55, 60, 70])  # cos(theta_i + theta_r) <= 0
    design = paper_terms(45, near, aspect=0.5)
    fit = fit_linear(design, design @ [1, 1, 1, 0])
    np.testing.assert_allclose(fit.x, [1, 1, 1, 0], rtol=1e-6)
    assert (fit["s_spec"].low, fit["s_spec"].high, fit["s_spec"].active) == (0, math.inf, False)
    assert fit.groups == (("s_spec",),)
    assert fit.condition == math.inf
    assert "s_spec is NOT determined: its term is next to nothing" in fit.statement


@pytest.mark.parametrize("n", [1, 2, 3])
def test_too_few_readings_are_fitted_and_said_to_be_too_few(terms: np.ndarray, n: int) -> None:
    values = terms[:n] @ [0.5, 3, 0.3, 0.1]
    for covariance in (None, 1e-4 * np.eye(n)):
        fit = fit_linear(terms[:n], values, covariance=covariance)
        assert fit.rank <= n < 4
        assert fit.undetermined
        assert "NOT determined" in fit.statement
        np.testing.assert_allclose(fit.modelled, values, rtol=0.05)
        assert "NaN" not in json.dumps(fit.to_dict())


def test_as_many_readings_as_coefficients_leave_no_noise_to_see() -> None:
    few = np.array([-60.0, -40, 10, 70])
    design = paper_terms(45, few)
    fit = fit_linear(design, design @ [1, 3, 0.5, 0.2])
    np.testing.assert_allclose(fit.x, [1, 3, 0.5, 0.2], rtol=1e-6)
    assert (fit.dof, fit.scale, fit.undetermined) == (0, None, ())
    assert {(c.low, c.high, c.standard_error) for c in fit.coefficients} == {(0, math.inf, math.inf)}
    assert "no standard errors" in fit.statement
    known = fit_linear(design, design @ [1, 3, 0.5, 0.2], covariance=1e-6 * np.eye(4), weights="covariance")
    assert all(math.isfinite(c.high) for c in known.coefficients)
    assert known.chi2_per_dof is None


def test_misfit_beyond_the_noise_is_said(terms: np.ndarray) -> None:
    values = 0.5 + 0.4 * np.cos(np.radians(4 * VIEWS))
    fit = fit_linear(terms, values, covariance=1e-4 * np.eye(15), weights="covariance")
    assert fit.chi2_per_dof is not None
    assert fit.chi2_per_dof > 10
    assert "does not describe the readings" in fit.statement


def test_measures_of_misfit(terms: np.ndarray) -> None:
    values = drawn(1, terms @ [0.5, 3, 0.3, 0.1], correlated(terms @ [0.5, 3, 0.3, 0.1]))
    fit = fit_linear(terms, values, theta_r_deg=VIEWS)
    E = 100 * np.abs(values - fit.modelled) / values
    np.testing.assert_allclose(fit.E, E)
    assert (fit.E_mean, fit.E_max) == (pytest.approx(E.mean()), pytest.approx(E.max()))
    cosine = np.cos(np.radians(VIEWS))
    assert fit.cosine_rmse == pytest.approx(math.sqrt(np.average((values - fit.modelled) ** 2, weights=cosine)))
    assert fit_linear(terms, values).cosine_rmse is None
    stored = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert stored["x"]["u_diff"] == fit["u_diff"].value
    assert stored["E_mean"] == fit.E_mean
    assert stored["coefficients"][1]["low"] == fit["u_spec"].low
    with pytest.raises(KeyError):
        fit["albedo"]


def test_e_is_left_out_where_there_is_no_light(terms: np.ndarray) -> None:
    values = np.append(0.0, (terms @ [0.5, 3, 0.3, 0.1])[1:])
    fit = fit_linear(terms, values, weights="plain")
    assert fit.E.mask.tolist() == [True] + 14 * [False]
    assert fit.E_mean == pytest.approx(np.mean(100 * np.abs(values - fit.modelled)[1:] / values[1:]))
    assert fit.to_dict()["E"][0] is None


# What is refused


@pytest.mark.parametrize("bad", [0.0, -0.1])
def test_relative_weights_need_light(terms: np.ndarray, bad: float) -> None:
    values = np.ones(15)
    values[4] = bad
    with pytest.raises(ReadingError, match=r"bench, row 105: reading is -?0.*relative weights need it above 0"):
        fit_linear(terms, values, source="bench", rows=np.arange(101, 116))


def test_a_reading_may_be_below_0_by_noise_only(terms: np.ndarray) -> None:
    values = np.ones(15)
    values[4] = -0.1
    fit_linear(terms, values, covariance=0.1**2 * np.eye(15), weights="covariance")
    with pytest.raises(ReadingError, match=r"row 5: reading is -0.1, 10 standard deviations below 0"):
        fit_linear(terms, values, covariance=0.01**2 * np.eye(15), weights="covariance")


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_named(terms: np.ndarray, bad: float) -> None:
    values, spoilt, covariance = np.ones(15), terms.copy(), np.eye(15)
    values[2], spoilt[3, 1], covariance[6, 6] = bad, bad, bad
    with pytest.raises(ReadingError, match="row 3: the reading is not a finite number"):
        fit_linear(terms, values)
    with pytest.raises(ReadingError, match="row 4: a term is not a finite number"):
        fit_linear(spoilt, np.ones(15))
    with pytest.raises(ReadingError, match="row 7: its variance is"):
        fit_linear(terms, np.ones(15), covariance=covariance)
    covariance = np.eye(15)
    covariance[1, 8] = bad
    with pytest.raises(ReadingError, match="row 2: its covariance with row 9 is not finite or not symmetric"):
        fit_linear(terms, np.ones(15), covariance=covariance)


def test_a_covariance_that_is_none(terms: np.ndarray) -> None:
    values, twins = np.ones(15), np.eye(15)
    twins[3, 8] = twins[8, 3] = 1
    with pytest.raises(ReadingError, match="row 9: the covariance is not positive definite"):
        fit_linear(terms, values, covariance=twins)
    twins[3, 8] = twins[8, 3] = 1.5
    with pytest.raises(ReadingError, match="row 9: the covariance is not positive definite"):
        fit_linear(terms, values, covariance=twins * 1e-8)
    with pytest.raises(ReadingError, match="row 15: its variance is 0"):
        fit_linear(terms, values, covariance=np.diag(np.arange(14.0, -1, -1)))
    with pytest.raises(FitError, match=r"shape \(14, 14\), expected \(15, 15\)"):
        fit_linear(terms, values, covariance=np.eye(14))
    for weights in ("sigma", "covariance"):
        with pytest.raises(FitError, match="no covariance to weigh by"):
            fit_linear(terms, values, weights=weights)
    with pytest.raises(FitError, match="unknown weights 'chi2'"):
        fit_linear(terms, values, weights="chi2")  # type: ignore[arg-type]


def test_shapes_that_do_not_match(terms: np.ndarray) -> None:
    for design, values, others, problem in (
        (terms, np.ones(14), {}, "expected .14, 4."),
        (terms, np.ones(15), {"names": "abc"}, "expected .15, 3."),
        (terms, np.ones(15), {"names": "abca"}, "same name"),
        (terms, np.ones((15, 1)), {}, "one column"),
        (terms[:0], np.ones(0), {}, "one or more readings"),
        (terms, ["a"] * 15, {}, "must be numbers"),
        (terms, np.ones(15), {"theta_r_deg": VIEWS[:3]}, "theta_r has shape"),
        (0 * terms, np.ones(15), {}, "every term is 0"),
    ):
        with pytest.raises(FitError, match=problem):
            fit_linear(design, values, **others)


@given(
    terms=st.lists(st.lists(st.floats(width=32), min_size=2, max_size=2), min_size=1, max_size=4),
    values=st.lists(st.floats(width=32), min_size=1, max_size=4),
    weights=st.sampled_from(["relative", "plain", "sigma", "covariance"]),
    noise=st.none() | st.floats(1e-6, 1e6),
)
def test_anything_is_fitted_without_nan_or_refused(terms: Any, values: Any, weights: Any, noise: float | None) -> None:
    covariance = None if noise is None else noise * np.eye(len(values))
    try:
        fit = fit_linear(terms, values, weights=weights, covariance=covariance, names="ab")
    except FitError:
        return
    assert isinstance(fit, LinearFit)
    json.dumps(fit.to_dict(), allow_nan=False)
    for c in fit.coefficients:
        assert 0 <= c.low <= c.value * (1 + 1e-9) + 1e-300
        assert c.value <= c.high * (1 + 1e-9) + 1e-300
        assert c.standard_error >= 0


# Reflectances


def test_reflectances_are_coefficients_on_the_white_standards_scale(terms: np.ndarray) -> None:
    fit = fit_linear(terms, 40 * terms @ [0.5, 3, 0.3, 0.1], covariance=0.1 * np.eye(15))
    found = fit.reflectances([0.7, 0.01, 1, 0.3], white=40)
    assert [v for v, _, _ in found.values()] == pytest.approx([0.35, 0.03, 0.3, 0.03])
    assert found["s_diff"][1:] == (fit["s_diff"].low / 40, fit["s_diff"].high / 40)
    with pytest.raises(FitError, match="white"):
        fit.reflectances([1, 1, 1, 1], white=0)
    with pytest.raises(FitError, match="4 unit reflectances"):
        fit.reflectances([1, 1, 1])
