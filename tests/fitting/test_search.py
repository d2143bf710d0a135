"""The search for a shape: recovery alone and jointly, what is held, and what is said of a shape that the readings leave open."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fitting.aperture import Aperture
from fitting.errors import DomainError, FitError, ReadingError
from fitting.fit import Fit, fit, fit_joint
from fitting.ladder import RUNGS, Directions, Traces
from fitting.measurements import Measurements
from fitting.paper import TERMS
from fitting.search import Effort, Search, Shape, usual_bounds

VIEWS = np.arange(-70.0, 71, 10)
X = [0.3, 2.0, 0.4, 0.3]
TRUTH = {"aspect": 1.2, "n_us": 40.0, "n_ss": 5.0}
PAPER = RUNGS["paper"]
ALL = usual_bounds(PAPER)


def made(
    x: list[float], theta_i: tuple[float, ...] = (45.0,), noise: float = 0, seed: int = 0, model: str = "paper", **shape: float
) -> Measurements:
    light, view = (a.ravel() for a in np.meshgrid(theta_i, VIEWS, indexing="ij"))
    numbers = {n.name: n.usual for n in RUNGS[model].shape} | (TRUTH if model == "paper" else {}) | shape
    clean = RUNGS[model].design(Directions.of(light, view), numbers, Traces()) @ x
    return Measurements(
        light, view, clean * (1 + noise * np.random.default_rng(seed).standard_normal(len(clean))), sigma=0.01 * clean, source=f"set {seed}"
    )


def x_of(found: Fit) -> list[float]:
    return [found.x[name] for name in TERMS]


@pytest.mark.slow
@pytest.mark.parametrize("shape", [{"aspect": 0.5}, {"aspect": 1.9, "n_us": 25.0, "n_ss": 8.0}])
def test_the_shape_the_readings_were_made_with_is_found(shape: dict[str, float]) -> None:
    """From readings without noise, as near as the nodes allow; twice, the second time alike to the last digit."""
    readings = made([0.3, 20.0, 0.4, 0.3], (15.0, 45.0, 60.0), **shape)
    found = fit(readings, shape=ALL)
    truth = TRUTH | shape
    assert found.shape["aspect"] == pytest.approx(truth["aspect"], rel=0.005)
    assert found.shape["n_us"] == pytest.approx(truth["n_us"], rel=0.05)
    assert found.shape["n_ss"] == pytest.approx(truth["n_ss"], rel=0.005)
    np.testing.assert_allclose(x_of(found), [0.3, 20.0, 0.4, 0.3], rtol=0.05)
    assert found.E_max < 0.5
    assert found.converged
    assert found.at_bounds == {}
    assert found.searched == ("aspect", "n_us", "n_ss")
    assert found.search is not None
    assert found.search.startswith("converged")
    assert fit(readings, shape=ALL).shape == found.shape


@pytest.mark.parametrize(("model", "truth"), [("phong", {"n": 23.0}), ("ggx", {"alpha": 0.37})])
def test_rungs_without_nodes_are_found_exactly(model: str, truth: dict[str, float]) -> None:
    found = fit(made([0.4, 0.6], model=model, **truth), model, shape=usual_bounds(RUNGS[model]))
    for name, value in truth.items():
        assert found.shape[name] == pytest.approx(value, rel=1e-5)
    np.testing.assert_allclose(list(found.x.values()), [0.4, 0.6], rtol=1e-4)


@pytest.mark.slow
def test_cultivars_share_a_shape_and_keep_their_mixtures() -> None:
    mixed = [[0.3, 20.0, 0.4, 0.3], [0.6, 20.0, 0.1, 0.1]]
    sets = [made(x, (15.0, 45.0, 60.0), seed=k) for k, x in enumerate(mixed)]
    joint = fit_joint(sets, shape={"aspect": (0.1, 4.0), "n_us": (2.0, 200.0), "n_ss": 5.0}, effort=Effort(global_evaluations=60))
    for found, x, other in zip(joint, mixed, ("set 1", "set 0"), strict=True):
        assert found.shape == joint[0].shape
        assert found.shape["aspect"] == pytest.approx(1.2, rel=0.005)
        assert found.shape["n_us"] == pytest.approx(40, rel=0.05)
        assert found.shape["n_ss"] == 5
        assert found.searched == ("aspect", "n_us")
        assert found.shared_with == (other,)
        np.testing.assert_allclose(x_of(found), x, rtol=0.05)


def test_a_shape_shared_is_better_known() -> None:
    sets = [made(x, noise=0.01, seed=k) for k, x in enumerate([[0.3, 2.0, 0.4, 0.3], [0.6, 2.0, 0.2, 0.3], [0.5, 1.0, 0.3, 0.2]])]
    bounds: dict[str, Any] = {"aspect": (0.5, 3.0)}
    effort = Effort(global_evaluations=30)
    together = fit_joint(sets, shape=bounds, weights="sigma", effort=effort)[0].shape_sigma["aspect"]
    alone = [fit(m, shape=bounds, weights="sigma", effort=effort).shape_sigma["aspect"] for m in sets]
    assert together is not None
    assert all(sigma is not None and together < sigma for sigma in alone)


@pytest.mark.parametrize("weights", ["relative", "plain", "sigma", "covariance"])
def test_one_number_searched_with_noise_lies_within_its_error(weights: Any) -> None:
    readings = made(X, (15.0, 45, 60), noise=0.01, seed=2)
    found = fit(readings, shape={"aspect": (0.3, 3.0)}, weights=weights, effort=Effort(global_evaluations=30))
    assert found.converged
    sigma = found.shape_sigma["aspect"]
    assert sigma is not None
    assert 0 < sigma < 0.1
    assert abs(found.shape["aspect"] - 1.2) < 4 * sigma
    assert f"aspect = {found.shape['aspect']:.4g} +- {sigma:.2g}" in found.statement


def test_plain_weights_count_a_dark_set_as_much_as_a_pale_one() -> None:
    """A thousand times darker it says the same of the shape."""
    pale = made(X, noise=0.01, seed=1)
    dark = made([x / 1000 for x in X], noise=0.01, seed=2, aspect=0.9)
    bright = made(X, noise=0.01, seed=2, aspect=0.9)
    bounds: dict[str, Any] = {"aspect": (0.5, 3.0)}
    effort = Effort(global_evaluations=30)
    one, other = (fit_joint([pale, second], shape=bounds, weights="plain", effort=effort)[0] for second in (dark, bright))
    assert one.shape["aspect"] == pytest.approx(other.shape["aspect"], rel=1e-3)
    assert 0.91 < one.shape["aspect"] < 1.19  # between the two


def test_a_shape_outside_the_bounds_is_said_to_lean_on_them() -> None:
    found = fit(made(X), shape={"aspect": (0.2, 0.9)}, effort=Effort(global_evaluations=20))
    assert found.at_bounds == {"aspect": "upper"}
    assert found.shape_sigma == {"aspect": None}
    assert "aspect ended at its upper bound: the best may lie beyond" in found.statement
    assert found.shape["aspect"] == pytest.approx(0.9)


def test_descents_that_disagree_are_printed() -> None:
    """Fifteen noisy readings for seven numbers: these have several minima."""
    found = fit(made(X, noise=0.05, seed=8), shape=ALL, effort=Effort(global_evaluations=0, starts=4))
    assert found.search is not None
    assert "random point 1 ended elsewhere, at " in found.search
    assert "1 of 4 descents agree" in found.search
    assert found.search in found.statement
    assert "n_ss ended at its upper bound" in found.search  # by name


def test_a_shape_that_does_nothing_has_no_standard_error() -> None:
    """The readings are all on the light's side: the mirror lobe is not among them."""
    view = np.array([40.0, 50, 60, 70, 80])
    readings = Measurements(np.full(5, 60.0), view, np.array([0.5, 0.52, 0.51, 0.5, 0.49]))
    found = fit(readings, "phong", shape=usual_bounds(RUNGS["phong"]), effort=Effort(global_evaluations=20))
    assert found.shape_sigma == {"n": None}
    assert "n = " in found.statement
    assert "(no standard error)" in found.statement
    assert "spec is NOT determined" in found.statement


def test_refused_shapes_are_counted_and_avoided(monkeypatch: pytest.MonkeyPatch) -> None:
    rung, whole = RUNGS["phong"], type(RUNGS["phong"]).design

    def refusing(self: Any, at: Directions, shape: Any, traces: Traces) -> np.ndarray:
        if shape["n"] > 30:
            raise DomainError("too narrow")
        return whole(self, at, shape, traces)

    readings = made([0.4, 0.6], model="phong", n=20.0)
    monkeypatch.setattr(type(rung), "design", refusing)
    found = fit(readings, "phong", shape={"n": (1.0, 500.0)})
    assert found.shape["n"] == pytest.approx(20, rel=1e-4)
    assert found.search is not None
    assert " 0 of them refused" not in found.search
    assert " refused" in found.search


def test_too_few_readings_for_the_unknowns_are_told() -> None:
    few = made(X).take(np.arange(6))
    with pytest.raises(FitError, match="set 0: 6 readings in all for 7 unknowns of the model 'paper': hold more of the shape, or add"):
        fit(few, shape=ALL)
    with pytest.raises(FitError, match="8 readings in all for 9 unknowns"):
        fit_joint([few.take([0, 1, 2, 3]), few.take([0, 1, 2, 3])], shape={"aspect": (0.5, 2.0)})
    assert fit(few).searched == ()  # nothing is searched for: fitted


def test_what_cannot_be_searched() -> None:
    readings = made(X)
    with pytest.raises(FitError, match="no readings"):
        fit_joint([], shape=ALL)
    with pytest.raises(DomainError, match=r"aspect .* must be above 0, not \(0, 2\)"):
        fit(readings, shape={"aspect": (0, 2)})
    for bad in ((2.0, 1.0), (1.0, 1.0), (1.0, 2.0, 3.0)):
        with pytest.raises(DomainError, match="bounds of aspect must be a pair, the lower one first"):
            fit(readings, shape={"aspect": bad})  # type: ignore[dict-item]
    with pytest.raises(DomainError, match=r"aspect .* must be above 0"):
        fit(readings, shape={"aspect": (0.5, math.inf)})
    dark = Measurements(readings.theta_i_deg, VIEWS, np.where(VIEWS == 0, 0.0, readings.value))
    with pytest.raises(ReadingError, match="row 8"):
        fit(dark, shape=ALL)
    with pytest.raises(DomainError, match="has no mu"):
        usual_bounds(PAPER, ["mu"])


def test_shapes_are_held_at_what_is_given_and_else_at_the_usual() -> None:
    shape = Shape.of(PAPER, {"aspect": (0.5, 2.0), "n_us": 20})
    assert shape.held == {"p": 2.0, "q": 2.0, "n_us": 20.0, "n_ss": 5.0}
    assert shape.bounds == {"aspect": (0.5, 2.0)}
    assert usual_bounds(PAPER, ["n_us"]) == {"n_us": (2.0, 200.0)}
    assert set(ALL) == {"aspect", "n_us", "n_ss"}


def test_some_of_the_readings_can_be_left_out() -> None:
    """What is not kept has no say: spoilt readings change nothing."""
    good = made(X, (15.0, 45.0, 60.0), noise=0.01)
    kept = good.theta_i_deg != 45
    spoilt = Measurements(good.theta_i_deg, good.theta_r_deg, np.where(kept, good.value, 7.0))
    found = []
    for m in (good, spoilt):
        search = Search.of(PAPER, Shape.of(PAPER, {"aspect": (0.5, 3.0)}), [m], "relative", None, None)
        found.append(search.minimise(Effort(global_evaluations=20), [kept])[0])
    assert found[0] == found[1]
    assert found[0]["aspect"] == pytest.approx(1.2, rel=0.1)


def test_tangents_are_derivatives_of_the_fitted_values() -> None:
    readings = made(X, (15.0, 60.0), noise=0.01)
    search = Search.of(PAPER, Shape.of(PAPER, {"aspect": (0.5, 3.0), "n_ss": (1.0, 100.0)}), [readings], "relative", None, None)
    at = {"aspect": 1.1, "n_ss": 6.0}
    whole = {"p": 2.0, "q": 2.0} | TRUTH | at
    (columns,) = search.tangents(at, ["aspect", "n_ss"])
    x = search.coefficients(search.designs(at)[0], readings)
    step = 1e-4
    for column, name in zip(columns.T, at, strict=True):
        ends = [
            PAPER.design(Directions.of(readings.theta_i_deg, readings.theta_r_deg), whole | {name: at[name] + s}, Traces()) @ x
            for s in (-step, step)
        ]
        np.testing.assert_allclose(column, (ends[1] - ends[0]) / (2 * step), atol=0.08 * np.abs(column).max())
    assert search.tangents(at, [])[0].shape == (30, 0)


def test_the_aperture_is_in_the_search() -> None:
    """A lobe read through a wide cone looks blunter than it is; the search knows the cone."""
    sharp, views = 150.0, np.append(np.arange(-64.0, -25, 3), [0.0, 30, 60])
    aperture = Aperture(acceptance_deg=5.0)
    truth = fit(Measurements(np.full(16, 45.0), views, np.ones(16)), "phong", shape={"n": sharp}, aperture=aperture)
    theta_i, theta_r, phi, weight = aperture.nodes(45.0, views, 0.0)
    terms = RUNGS["phong"].design(Directions.of(theta_i.ravel(), theta_r.ravel(), phi.ravel()), {"n": sharp}, truth.traces)
    value = np.einsum("nkc,nk->nc", terms.reshape(*weight.shape, 2), weight) @ [0.3, 0.05]
    readings = Measurements(np.full(16, 45.0), views, value)
    knowing, naive = (fit(readings, "phong", shape={"n": (1.0, 500.0)}, aperture=a) for a in (aperture, None))
    assert knowing.shape["n"] == pytest.approx(sharp, rel=1e-4)
    assert naive.shape["n"] < 0.85 * sharp


@pytest.mark.slow
def test_the_domes_profile_is_found_where_it_is_asked_for() -> None:
    """Readings of blunt domes by the exact terms; the ladder itself leaves the profile alone."""
    rung = RUNGS["radiometric"]
    theta_i, theta_r = (a.ravel() for a in np.meshgrid([20.0, 45.0, 65.0], np.arange(-70.0, 71, 10), indexing="ij"))
    truth = {"aspect": 1.0, "p": 3.5, "q": 2.0, "n_us": 20.0, "n_ss": 5.0}
    value = rung.design(Directions.of(theta_i, theta_r), truth, Traces()) @ [0.4, 0.3, 0.1, 0.05]
    readings = Measurements(theta_i, theta_r, value)
    held = {name: truth[name] for name in ("aspect", "q", "n_us", "n_ss")}
    found = fit(readings, "radiometric", shape={**held, "p": (1.1, 6.0)}, effort=Effort(global_evaluations=30))
    assert found.converged
    assert found.shape["p"] == pytest.approx(3.5, rel=0.02)
    assert found.E_mean < 0.3 < fit(readings, "radiometric", shape=held).E_mean
    assert not {"p", "q"} & set(usual_bounds(rung))
    assert usual_bounds(rung, ["p"]) == {"p": (1.1, 6.0)}
    with pytest.raises(DomainError, match=r"p .* must be 1 or more"):
        fit(readings, "radiometric", shape={"p": 0.5})
