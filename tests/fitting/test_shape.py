"""The shape fit: recovery alone and jointly, what is held, and what is said of a shape that the readings leave open."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fitting import TERMS, DomainError, FitError, Measurements, ReadingError, paper_terms
from fitting.shape import fit_shape

VIEWS = np.arange(-70.0, 71, 10)
X = [0.3, 2.0, 0.4, 0.3]


def made(x: list[float], theta_i: tuple[float, ...] = (45.0,), noise: float = 0, seed: int = 0, **shape: float) -> Measurements:
    light, view = (a.ravel() for a in np.meshgrid(theta_i, VIEWS))
    clean = paper_terms(light, view, **({"aspect": 1.2, "n_us": 40, "n_ss": 5} | shape)) @ x  # type: ignore[arg-type]
    return Measurements(
        theta_i_deg=light,
        theta_r_deg=view,
        value=clean * (1 + noise * np.random.default_rng(seed).standard_normal(len(clean))),
        sigma=0.01 * clean,
    )


@pytest.mark.slow
@pytest.mark.parametrize("shape", [{"aspect": 0.5}, {"aspect": 1.9, "n_us": 25, "n_ss": 8}])
def test_the_shape_the_readings_were_made_with_is_found(shape: dict[str, float]) -> None:
    found = fit_shape(made(X, **shape))
    truth = {"aspect": 1.2, "n_us": 40, "n_ss": 5} | shape
    for name in ("aspect", "n_us", "n_ss"):
        assert getattr(found, name) == pytest.approx(truth[name], rel=1e-4)
    np.testing.assert_allclose([found.mixtures[0].x[name] for name in TERMS], X, rtol=1e-3)
    assert found.converged
    assert found.at_bounds == {}


@pytest.mark.slow
def test_cultivars_share_a_shape_and_keep_their_mixtures() -> None:
    mixed = [[0.3, 2.0, 0.4, 0.3], [0.6, 2.0, 0.1, 0.1]]
    found = fit_shape([made(x) for x in mixed], n_ss=5.0, global_evaluations=60)
    assert found.aspect == pytest.approx(1.2, rel=1e-4)
    assert found.n_us == pytest.approx(40, rel=1e-3)
    assert found.n_ss == 5
    assert found.searched == ("aspect", "n_us")
    for fit, x in zip(found.mixtures, mixed, strict=True):
        np.testing.assert_allclose([fit.x[name] for name in TERMS], x, rtol=1e-3)


@pytest.mark.parametrize("weights", ["relative", "plain", "sigma"])
def test_one_number_searched_with_noise_lies_within_its_error(weights: Any) -> None:
    readings = made(X, (15.0, 45, 60), noise=0.01, seed=2)
    found = fit_shape(readings, aspect=(0.3, 3), n_us=40.0, n_ss=5.0, weights=weights, global_evaluations=30, starts=1)
    assert found.converged
    sigma = found.sigma["aspect"]
    assert sigma is not None
    assert 0 < sigma < 0.1
    assert abs(found.aspect - 1.2) < 4 * sigma
    assert f"aspect = {found.aspect:.4g} +- {sigma:.2g}" in found.statement


def test_a_shape_outside_the_bounds_is_said_to_lean_on_them() -> None:
    found = fit_shape(made(X), aspect=(0.2, 0.9), n_us=40.0, n_ss=5.0, global_evaluations=20)
    assert found.at_bounds == {"aspect": "upper"}
    assert found.sigma == {"aspect": None}
    assert "aspect at its upper bound" in found.statement


def test_what_cannot_be_fitted() -> None:
    readings = made(X)
    with pytest.raises(DomainError, match="something to search for"):
        fit_shape(readings, aspect=1.2, n_us=40.0, n_ss=5.0)
    with pytest.raises(DomainError, match="something to search for"):
        fit_shape([])
    with pytest.raises(DomainError, match="must be above 0"):
        fit_shape(readings, aspect=(0, 2))
    few = Measurements(theta_i_deg=np.full(5, 45.0), theta_r_deg=VIEWS[:5], value=np.ones(5))
    with pytest.raises(FitError, match="5 readings in all for 7 unknowns"):
        fit_shape(few)
    dark = Measurements(theta_i_deg=readings.theta_i_deg, theta_r_deg=VIEWS, value=np.where(VIEWS == 0, 0.0, readings.value))
    with pytest.raises(ReadingError, match="row 8"):
        fit_shape(dark)
