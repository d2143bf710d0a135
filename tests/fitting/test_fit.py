"""A fit of any rung: recovery, constraints, weights, what cannot be determined, what is stored and what is predicted."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from fitting.aperture import Aperture
from fitting.errors import DomainError, FitError, ReadingError
from fitting.fit import Fit, aicc, fit, predicted, predictions
from fitting.ladder import RUNGS, Directions, Traces
from fitting.linear import Weights
from fitting.measurements import Measurements
from fitting.paper import TERMS, paper_terms

VIEWS = np.arange(-70.0, 71, 10)
WEIGHTS: tuple[Weights, ...] = ("relative", "plain", "sigma", "covariance")
coefficient = st.floats(0.01, 5)


@pytest.fixture(scope="module")
def traces() -> Traces:
    """Tracing is what is slow."""
    return Traces()


def readings(value: np.ndarray, theta_i: Any = 45.0, theta_r: np.ndarray = VIEWS, **others: Any) -> Measurements:
    return Measurements(theta_i_deg=np.broadcast_to(theta_i, theta_r.shape), theta_r_deg=theta_r, value=value, **others)


def noisy(seed: int, x: list[float], aspect: float = 1.9) -> Measurements:
    random = np.random.default_rng(seed)
    clean = paper_terms(45, VIEWS, aspect=aspect) @ x
    sigma = 0.02 * clean * random.uniform(0.5, 3, len(VIEWS))
    return readings(clean + sigma * random.standard_normal(len(VIEWS)), sigma=sigma)


def x_of(found: Fit) -> list[float]:
    return [found.x[name] for name in TERMS]


@given(x=st.tuples(coefficient, coefficient, coefficient, coefficient), aspect=st.sampled_from([0.5, 1.9]))
def test_what_was_mixed_is_found(x: tuple[float, ...], aspect: float) -> None:
    found = fit(readings(paper_terms(45, VIEWS, aspect=aspect) @ x), shape={"aspect": aspect})
    np.testing.assert_allclose(x_of(found), x, rtol=1e-6)
    assert found.E_max < 1e-6
    assert found.linear.active == ()
    assert found.determined
    assert "15 readings fix 4 of 4 coefficients" in found.statement
    assert found.shape == {"aspect": aspect, "p": 2, "q": 2, "n_us": 40, "n_ss": 5}
    assert found.searched == ()
    assert found.search is None


@pytest.mark.parametrize("quantity", ["intensity", "reflectance-factor", "brdf"])
@pytest.mark.parametrize("weights", WEIGHTS)
def test_several_incidences_share_one_mixture(quantity: Any, weights: Weights) -> None:
    theta_i, theta_r = (a.ravel() for a in np.meshgrid([20.0, 45, 65], VIEWS))
    x = [0.3, 2.0, 0.4, 0.1]
    shape = {"aspect": 1.2, "n_us": 30, "n_ss": 6}
    intensity = paper_terms(theta_i, theta_r, **shape) @ x
    per_value = {"intensity": 1, "reflectance-factor": np.cos(np.radians(theta_i)), "brdf": math.pi * np.cos(np.radians(theta_i))}[quantity]
    value = intensity / per_value
    taken = readings(value, theta_i, theta_r, quantity=quantity, sigma=0.01 + 0.05 * value)
    found = fit(taken, shape=shape, weights=weights)
    np.testing.assert_allclose(x_of(found), x, rtol=1e-6)
    np.testing.assert_allclose(found.measured, intensity, rtol=1e-12)
    np.testing.assert_allclose(found.modelled, intensity, rtol=1e-6)
    np.testing.assert_array_equal(found.theta_i_deg, theta_i)
    assert found.quantity == quantity
    assert found.weights == weights


@pytest.mark.parametrize("model", ["lambert", "phong", "ggx", "radiometric"])
def test_out_of_the_plane_too(model: str, traces: Traces) -> None:
    """Views all round, as a rig with a third axis takes them."""
    theta_r, phi = (a.ravel() for a in np.meshgrid([20.0, 40, 60], [0.0, 60, 120, -90]))
    rung = RUNGS[model]
    shape = {number.name: number.usual for number in rung.shape}
    x = np.array([0.5, 0.2, 0.3, 0.1])[: len(rung.terms)]
    value = rung.design(Directions.of(40.0, theta_r, phi), shape, traces) @ x
    taken = readings(value, 40.0, theta_r, phi_deg=phi)
    assert not taken.in_plane.all()
    found = fit(taken, model, traces=traces)
    np.testing.assert_allclose([found.x[name] for name in rung.terms], x, rtol=1e-5)
    np.testing.assert_allclose(found.predict(40, 30, [[0.0], [90]]), found.predict(40, 30, [[0.0], [-90]]), rtol=1e-12)
    assert found.predict(40, 30, [[0.0], [90]]).shape == (2, 1)


@pytest.mark.parametrize("weights", WEIGHTS[:3])
@pytest.mark.parametrize("x", [[0.5, 3.0, 0.3, 0.1], [0.0, 0.0, 0.5, 0.2], [0.6, -4.0, 0.3, 0.2]])
def test_weights_are_those_they_claim_to_be(weights: Weights, x: list[float]) -> None:
    """Against another solver of bounded least squares, unscaled."""
    taken = noisy(3, x)
    terms = paper_terms(45, VIEWS, aspect=1.9)
    assert taken.sigma is not None
    weight = {"relative": 1 / taken.value, "plain": np.ones(len(VIEWS)), "sigma": 1 / taken.sigma}[weights]
    other = lsq_linear(terms * weight[:, None], taken.value * weight, bounds=(0, np.inf), method="bvls", tol=1e-14)
    found = fit(taken, shape={"aspect": 1.9}, weights=weights)
    np.testing.assert_allclose(x_of(found), other.x, rtol=1e-6, atol=1e-9)


def test_a_covariance_weighs_by_all_of_it() -> None:
    """A drift that half of the readings share counts once, not for each of them."""
    clean = paper_terms(45, VIEWS, aspect=1.9) @ [0.5, 6.0, 0.3, 0.1]
    drift = np.where(VIEWS > 0, 0.05 * clean, 0.0)
    covariance = np.diag((0.01 * clean) ** 2) + np.outer(drift, drift)
    taken = readings(clean + drift, covariance=covariance)
    errors = {}
    for weights in ("sigma", "covariance"):
        found = fit(taken, shape={"aspect": 1.9}, weights=weights)
        errors[weights] = abs(found.x["s_diff"] - 0.3)
        by_hand = np.sum(np.linalg.solve(np.linalg.cholesky(covariance), taken.value - found.modelled) ** 2)
        assert found.linear.chi2 == pytest.approx(by_hand, rel=1e-6)
    assert errors["covariance"] < errors["sigma"] / 3
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    other = lsq_linear(root @ paper_terms(45, VIEWS, aspect=1.9), root @ taken.value, bounds=(0, np.inf), method="bvls", tol=1e-14)
    np.testing.assert_allclose(x_of(fit(taken, shape={"aspect": 1.9}, weights="covariance")), other.x, rtol=1e-6)


def test_nothing_is_negative() -> None:
    found = fit(readings(paper_terms(45, VIEWS, aspect=1.9) @ [0.8, -10.0, 0.3, 0.2]), shape={"aspect": 1.9})
    assert found.x["u_spec"] == 0
    assert found.linear.active == ("u_spec",)
    assert "held at 0" in found.statement
    assert found.E_max > 1


def test_repeats_count_twice() -> None:
    taken = noisy(2, [0.5, 3.0, 0.3, 0.1])
    extra = np.repeat(np.arange(len(VIEWS)), np.where(VIEWS == 20, 3, 1))
    repeated = readings(taken.value[extra], theta_r=VIEWS[extra])
    weighted = readings(taken.value, sigma=taken.value / np.sqrt(np.where(VIEWS == 20, 3, 1)))
    first, second = (fit(m, shape={"aspect": 1.9}, weights=w) for m, w in ((repeated, "relative"), (weighted, "sigma")))  # type: ignore[arg-type]
    np.testing.assert_allclose(x_of(first), x_of(second), rtol=1e-8)


def test_error_is_equation_13() -> None:
    taken = noisy(1, [0.5, 3.0, 0.3, 0.1])
    found = fit(taken, shape={"aspect": 1.9})
    model = paper_terms(45, VIEWS, aspect=1.9) @ x_of(found)
    expected = 100 * abs(taken.value - model) / taken.value
    np.testing.assert_allclose(found.E, expected, rtol=1e-9)
    assert found.E_mean == pytest.approx(expected.mean())
    assert found.E_max == pytest.approx(expected.max())
    weight = np.cos(np.radians(VIEWS))
    rmse = math.sqrt(float(weight @ (taken.value - model) ** 2 / weight.sum()))
    assert found.linear.cosine_rmse == pytest.approx(rmse)
    np.testing.assert_allclose(found.predict(45, VIEWS), model, rtol=1e-12)
    assert found.predict(45, VIEWS.reshape(3, 5)).shape == (3, 5)
    assert found.predict(45, 10).shape == ()
    with pytest.raises(DomainError, match="theta_r = 100 deg"):
        found.predict(45, 100)


def test_four_readings_fix_four_coefficients() -> None:
    few, x = np.array([-60.0, -40, 10, 70]), [1.0, 3, 0.5, 0.2]
    found = fit(readings(paper_terms(45, few) @ x, theta_r=few), shape={"aspect": 0.5})
    np.testing.assert_allclose(x_of(found), x, rtol=1e-6)
    assert found.determined
    assert "no standard errors: as many coefficients as readings" in found.statement
    assert found.aicc is None


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_readings_are_fitted_and_what_is_open_is_named(count: int) -> None:
    few, x = np.array([-60.0, -40, 10])[:count], [1.0, 3, 0.5, 0.2]
    found = fit(readings(paper_terms(45, few) @ x, theta_r=few), shape={"aspect": 0.5})
    assert found.E_max < 1e-6  # what they do fix is met
    assert found.linear.rank <= count
    assert not found.determined
    for name in found.linear.undetermined:
        assert f"{name}: not determined" in found.statement
        assert math.isinf(found.linear[name].standard_error)
    assert "NOT determined" in found.statement
    assert len(found.linear.undetermined) >= 4 - count


def test_terms_that_look_alike_are_not_determined() -> None:
    """Between light and normal both diffuse terms are constant, and the mirror lobe of the spongy tissue is far."""
    between = np.array([0.0, 10, 20, 30, 40])
    found = fit(readings(np.full(5, 0.7), theta_r=between), shape={"aspect": 1.9})
    assert found.linear.rank < 4
    assert not found.determined
    assert {"u_diff", "s_diff"} <= set(found.linear.undetermined)
    assert any({"u_diff", "s_diff"} <= set(group) for group in found.linear.groups)
    assert "u_diff" in found.statement
    assert found.linear.condition > 1e3


def test_one_direction_many_times_fixes_one_combination() -> None:
    found = fit(readings(np.full(6, 0.7), theta_r=np.full(6, 10.0)), shape={"aspect": 0.5})
    assert found.linear.rank == 1
    assert not found.determined
    np.testing.assert_allclose(found.modelled, 0.7)


def test_a_term_absent_from_all_readings_is_said_to_be_undetermined() -> None:
    near = np.array([45.0, 50, 55, 60, 70])  # cos(theta_i + theta_r) <= 0
    found = fit(readings(paper_terms(45, near, aspect=0.5) @ [1, 1, 1, 0], theta_r=near), shape={"aspect": 0.5})
    assert found.x["s_spec"] == 0
    assert "s_spec" in found.linear.undetermined
    assert "s_spec is NOT determined: its term is next to nothing at every reading" in found.statement
    assert found.to_dict()["linear"]["condition"] is None


@pytest.mark.parametrize("bad", [0.0, -0.1])
def test_relative_weights_need_light(bad: float) -> None:
    value = np.ones(len(VIEWS))
    value[4] = bad
    taken = readings(value, source="bench", rows=np.arange(101, 116))
    with pytest.raises(ReadingError, match=r"bench, row 105: reading is -?0.*relative weights need it above 0"):
        fit(taken)
    found = fit(taken, weights="plain")
    assert np.flatnonzero(np.isnan(found.E)).tolist() == [4]
    assert math.isfinite(found.E_mean)
    assert found.to_dict()["E"][4] is None


def test_weights_that_cannot_be() -> None:
    with pytest.raises(FitError, match="no covariance to weigh by"):
        fit(readings(np.ones(15)), weights="sigma")
    with pytest.raises(ReadingError, match="row 1: its variance is 0"):
        fit(readings(np.ones(15), sigma=np.zeros(15)), weights="sigma")
    with pytest.raises(FitError, match="unknown weights 'chi2'"):
        fit(readings(np.ones(15)), weights="chi2")  # type: ignore[arg-type]
    with pytest.raises(FitError, match="no light to explain"):
        fit(readings(np.zeros(15)), weights="plain")
    with pytest.raises(FitError, match="no readings"):
        fit(readings(np.ones(15)).take(np.zeros(15, bool)))


def test_a_sigma_of_0_leaves_errors_to_the_residuals() -> None:
    taken = noisy(1, [0.5, 3.0, 0.3, 0.1])
    bare = fit(readings(taken.value), shape={"aspect": 1.9})
    found = fit(readings(taken.value, sigma=np.zeros(15)), shape={"aspect": 1.9})
    assert not found.linear.known_noise
    assert [c.standard_error for c in found.linear.coefficients] == [c.standard_error for c in bare.linear.coefficients]


def test_what_is_outside_the_models() -> None:
    with pytest.raises(ReadingError, match=r"row 15: theta_r = 135 deg is behind the petal"):
        fit(readings(np.ones(15), theta_r=np.append(VIEWS[:-1], 135)))
    with pytest.raises(DomainError, match=r"aspect \(.*\) must be above 0, not -1"):
        fit(readings(np.ones(15)), shape={"aspect": -1})
    with pytest.raises(DomainError, match=r"albedo \(.*\) must be above 0 and at most 1, not 2"):
        fit(readings(np.ones(15)), "interreflecting", shape={"albedo": 2.0})
    with pytest.raises(DomainError, match="the model 'phong' has no aspect: its shape numbers are n"):
        fit(readings(np.ones(15)), "phong", shape={"aspect": 1.0})
    with pytest.raises(DomainError, match="the model 'lambert' has no n: it has no shape numbers"):
        fit(readings(np.ones(15)), "lambert", shape={"n": 1.0})
    with pytest.raises(DomainError, match="no model 'torrance': expected one of lambert, phong, ggx, paper"):
        fit(readings(np.ones(15)), "torrance")


@pytest.mark.parametrize("model", RUNGS)
def test_a_stored_fit_comes_back(model: str, traces: Traces) -> None:
    """Through JSON as it is written to a file."""
    taken = noisy(1, [0.5, 3.0, 0.0, 0.1]).take(np.arange(3, 12))
    other = readings(taken.value[:2] * 1.1, theta_i=30.0, theta_r=VIEWS[3:5])
    made = fit(taken, model, weights="sigma", traces=traces)
    made = Fit(**{**vars(made), "predicted": (predicted(made, other, "30 deg"),), "aperture": Aperture(acceptance_deg=1.0)})
    stored = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    again = Fit.from_dict(stored)
    assert json.loads(json.dumps(again.to_dict())) == stored
    assert again.x == made.x == stored["x"]
    assert again.shape == made.shape
    assert again.aperture == made.aperture
    assert again.statement == made.statement
    again = Fit(**{**vars(again), "traces": traces})
    np.testing.assert_array_equal(again.predict(30, VIEWS[3:5]), made.predict(30, VIEWS[3:5]))
    np.testing.assert_array_equal(again.predicted[0].modelled, made.predict(30, VIEWS[3:5]))
    assert again.predicted[0].E_mean == made.predicted[0].E_mean == stored["predicted"][0]["E_mean"]
    assert stored["E_mean"] == made.E_mean
    assert len(stored["measured"]) == 9


def test_covariance_phi_and_what_is_not_determined_come_back() -> None:
    covariance = np.diag(np.full(3, 0.01)) + 0.001
    taken = readings(np.array([0.5, 0.4, 0.3]), theta_r=np.array([10.0, 20, 30]), phi_deg=np.array([0.0, 90, -120]), covariance=covariance)
    made = fit(taken, "phong", weights="covariance")
    again = Fit.from_dict(json.loads(json.dumps(made.to_dict(), allow_nan=False)))
    assert again.measurements.covariance is not None
    np.testing.assert_array_equal(again.measurements.covariance, taken.covariance)
    np.testing.assert_array_equal(again.measurements.phi_deg, [0, 90, -120])
    lone = fit(taken.take([1]), weights="sigma")
    again = Fit.from_dict(json.loads(json.dumps(lone.to_dict(), allow_nan=False)))
    assert again.linear.undetermined == lone.linear.undetermined != ()
    assert [c.high for c in again.linear.coefficients] == [c.high for c in lone.linear.coefficients]


def test_stored_fits_that_are_not() -> None:
    stored = fit(noisy(1, [0.5, 3.0, 0.0, 0.1])).to_dict()
    with pytest.raises(FitError, match="lacks 'shape'"):
        Fit.from_dict({k: v for k, v in stored.items() if k != "shape"})
    with pytest.raises(FitError, match="lacks 'coefficients'"):
        Fit.from_dict(stored | {"linear": {k: v for k, v in stored["linear"].items() if k != "coefficients"}})
    with pytest.raises(FitError, match="cannot be read"):
        Fit.from_dict(stored | {"value": ["a"]})
    with pytest.raises(FitError, match="cannot be read"):
        Fit.from_dict(stored | {"shape": None})
    with pytest.raises(FitError, match="no model 'torrance'"):
        Fit.from_dict(stored | {"model": "torrance"})


def test_brdf_is_the_fit_in_one_over_sr() -> None:
    """Readings of any quantity made from one BRDF give that BRDF back; relative ones need their white."""
    theta_i, theta_r = (a.ravel() for a in np.meshgrid([20.0, 45, 65], VIEWS))
    shape = {"aspect": 1.2}
    f_r = paper_terms(theta_i, theta_r, **shape) @ [0.3, 2.0, 0.4, 0.1] / (math.pi * np.cos(np.radians(theta_i)))
    white = 250.0  # lux, what the perfect diffuser reads along its normal
    taken = {
        "brdf": readings(f_r, theta_i, theta_r, quantity="brdf"),
        "reflectance-factor": readings(math.pi * f_r, theta_i, theta_r, quantity="reflectance-factor"),
        "intensity": readings(white * math.pi * f_r * np.cos(np.radians(theta_i)), theta_i, theta_r, unit="lux"),
    }
    for quantity, m in taken.items():
        evaluate = fit(m, shape=shape).brdf(white if quantity == "intensity" else None)
        np.testing.assert_allclose(evaluate(theta_i, theta_r, 0.0), f_r, rtol=1e-6)
    relative = fit(taken["intensity"], shape=shape)
    with pytest.raises(FitError, match="readings in lux have no scale in 1/sr: give the white"):
        relative.brdf()
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(FitError, match="finite number above 0"):
            relative.brdf(bad)


def test_reading_through_an_aperture_is_a_mean_over_it() -> None:
    """A cone widens the lobe that is read: the fit knows it, and predicts the sharp lobe under it."""
    sharp, views = {"n": 300.0}, np.arange(-64.0, -29, 3)
    rung, aperture = RUNGS["phong"], Aperture(acceptance_deg=4.0)
    theta_i, theta_r, phi, weight = aperture.nodes(45.0, views, 0.0)
    at = Directions.of(theta_i.ravel(), theta_r.ravel(), phi.ravel())
    terms = np.einsum("nkc,nk->nc", rung.design(at, sharp, Traces()).reshape(*weight.shape, 2), weight)
    taken = readings(terms @ [0.3, 0.02], theta_r=views)
    found = fit(taken, "phong", shape=sharp, aperture=aperture)
    np.testing.assert_allclose(list(found.x.values()), [0.3, 0.02], rtol=1e-9)
    np.testing.assert_allclose(found.read(taken), taken.value, rtol=1e-9)
    mirror = found.predict(45, -45)
    expected = (0.3 + 0.02 * 302 / 2) * math.cos(math.radians(45))
    assert mirror == pytest.approx(expected, rel=1e-9)
    ideal = fit(taken, "phong", shape=sharp)
    np.testing.assert_allclose(ideal.read(taken), ideal.predict(45, views))
    assert ideal.E_max > 3  # percent: without the aperture the model does not fit


def test_predictions_are_of_readings_left_out() -> None:
    theta_i, theta_r = (a.ravel() for a in np.meshgrid([15.0, 45, 60], VIEWS))
    side = np.array([30.0, 50.0])
    value = np.concatenate([paper_terms(theta_i, theta_r, aspect=1.2) @ [0.3, 2, 0.4, 0.1], [0.3, 0.31]])
    taken = Measurements(
        np.append(theta_i, [45.0, 45.0]), np.append(theta_r, side), value, phi_deg=np.append(np.zeros(45), [90.0, -90.0]), source="rose"
    )
    parts = predictions(taken, shape={"aspect": 1.2})
    assert [p.what for p in parts] == ["15 deg, from 45 deg", "45 deg out of the plane, from 45 deg", "60 deg, from 45 deg"]
    for p in (parts[0], parts[2]):
        np.testing.assert_allclose(p.modelled, p.measured, rtol=1e-6)
        assert p.E_max is not None
        assert p.E_max < 1e-4
    alone = fit(taken.take((theta_i_of(taken) == 45) & taken.in_plane), shape={"aspect": 1.2})
    np.testing.assert_allclose(parts[1].modelled, alone.predict(45, side, [90, -90]), rtol=1e-9)
    np.testing.assert_array_equal(parts[1].phi_deg, [90, -90])
    assert parts[1].E_mean == pytest.approx(np.mean(100 * np.abs(parts[1].modelled / [0.3, 0.31] - 1)))
    # What was predicted was not in the fit: to spoil it changes no prediction.
    spoilt = Measurements(taken.theta_i_deg, taken.theta_r_deg, np.where(taken.theta_i_deg == 60, 9.0, value), phi_deg=taken.phi_deg)
    np.testing.assert_array_equal(predictions(spoilt, shape={"aspect": 1.2})[2].modelled, parts[2].modelled)


def theta_i_of(m: Measurements) -> np.ndarray:
    return m.theta_i_deg


def test_nothing_is_predicted_without_readings_for_it() -> None:
    assert predictions(noisy(1, [0.5, 3.0, 0.3, 0.1])) == ()
    assert predictions(readings(np.ones(15), theta_i=30.0)) == ()


def test_a_prediction_of_darkness_has_no_error() -> None:
    found = fit(noisy(1, [0.5, 3.0, 0.3, 0.1]))
    dark = predicted(found, readings(np.array([0.0, 0.0]), theta_i=30.0, theta_r=np.array([10.0, 20.0])), "dark")
    assert np.isnan(dark.E).all()
    assert dark.E_mean is None
    assert dark.E_max is None


def test_aicc_is_hurvich_and_tsais() -> None:
    """With n log(RSS / n) + 2 k + 2 k (k + 1) / (n - k - 1), the noise being one of the k; chi-square instead where the noise is known."""
    taken = noisy(4, [0.5, 3.0, 0.3, 0.1])
    found = fit(taken, shape={"aspect": 1.9})
    rss = float(np.sum((found.modelled / taken.value - 1) ** 2))
    assert found.parameters == 4
    assert found.aicc == pytest.approx(15 * math.log(rss / 15) + 10 + 60 / 9)
    known = fit(taken, shape={"aspect": 1.9}, weights="sigma")
    assert known.aicc == pytest.approx(np.sum(((known.modelled - taken.value) / taken.sigma) ** 2) + 8 + 40 / 10)
    assert aicc(1.0, 5, 4, known_noise=True) is None
    assert aicc(1.0, 6, 4, known_noise=True) is not None
    assert aicc(1.0, 6, 4, known_noise=False) is None


def test_a_searched_shape_widens_the_intervals() -> None:
    """What the shape was found from tells less of the coefficients."""
    clean = paper_terms(45, VIEWS, aspect=1.2) @ [0.3, 2.0, 0.4, 0.3]
    taken = readings(clean * (1 + 0.01 * np.random.default_rng(3).standard_normal(15)), sigma=0.01 * clean)
    free = fit(taken, shape={"aspect": (0.5, 3.0)})
    held = fit(taken, shape={"aspect": free.shape["aspect"]})
    assert free.searched == ("aspect",)
    assert free.parameters == held.parameters + 1
    for name in ("u_diff", "s_diff", "s_spec"):
        assert free.linear[name].standard_error > 1.1 * held.linear[name].standard_error
        assert free.linear[name].high > held.linear[name].high
        assert free.linear[name].low < held.linear[name].low


@pytest.mark.parametrize("seed", range(4))
def test_coefficients_are_the_best_for_the_shape_found(seed: int) -> None:
    """The search's freedom widens intervals, but what is fitted is the fit at that shape, however far from straight the way there is."""
    view = np.arange(-60.0, 61, 10)[1:]
    value = np.random.default_rng(seed).uniform(0.05, 0.5, len(view)) + 0.3 * np.exp(-(((view + 45) / 12) ** 2))
    taken = readings(value, theta_r=view)
    free = fit(taken, shape={"aspect": (0.1, 4.0), "n_us": (2.0, 200.0), "n_ss": (1.0, 100.0)})
    held = fit(taken, shape=free.shape)
    np.testing.assert_allclose(x_of(free), x_of(held), rtol=1e-6)
    np.testing.assert_allclose(free.modelled, held.modelled, rtol=1e-6)
    assert free.E_mean == pytest.approx(held.E_mean)
    for c in free.linear.coefficients:
        assert c.low <= c.value <= c.high


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_intervals_hold_the_truth_also_where_the_shape_was_found() -> None:
    """300 sets of readings, the aspect found anew from each: truth inside the 95 % interval 91 to 99 times in 100, 3 sd of drawing.

    The truth is made at an aspect between nodes; the readings are of two incidences, so that aspect and mixture part company.
    """
    from fitting.fit import fitted
    from fitting.search import Effort, Search, Shape

    x, aspect = np.array([0.5, 6.0, 0.3, 0.3]), 1.3
    theta_i, theta_r = (a.ravel() for a in np.meshgrid([20.0, 60.0], VIEWS))
    clean = paper_terms(theta_i, theta_r, aspect=aspect) @ x
    random, effort = np.random.default_rng(11), Effort(global_evaluations=0, starts=1)
    inside, errors, found_aspect = np.zeros(4), np.zeros(4), 0
    rung, times = RUNGS["paper"], 300
    quick = None
    for _ in range(times):
        noise = 0.01 * clean
        taken = Measurements(theta_i, theta_r, clean + noise * random.standard_normal(len(clean)), sigma=noise)
        search = Search.of(rung, Shape.of(rung, {"aspect": (0.9, 1.8)}), [taken], "sigma", None, None)
        quick = quick or search.quick  # the nodes depend on the geometry only
        search = Search(**{**vars(search), "quick": quick})
        (one,) = fitted(search, *search.minimise(effort))
        inside += [c.low <= true <= c.high for c, true in zip(one.linear.coefficients, x, strict=True)]
        errors += [c.standard_error for c in one.linear.coefficients]
        sigma = one.shape_sigma["aspect"]
        assert sigma is not None
        found_aspect += abs(one.shape["aspect"] - aspect) < 1.96 * sigma
    assert np.all(x > 3 * errors / times), x / (errors / times)
    share = 100 * inside / times
    assert np.all((share >= 91) & (share <= 99)), dict(zip(TERMS, share, strict=True))
    assert 91 <= 100 * found_aspect / times <= 99
