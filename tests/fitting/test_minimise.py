"""The minimiser: certified minima, bounds, several minima, what the residuals leave open, and what it says of each."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from fitting import DomainError, FitError
from fitting.minimise import minimise
from tests.fitting.nist import SETS, Certified

Array = NDArray[np.float64]
CASES = [pytest.param(s, start, id=f"{s.name}-{k}") for s in SETS for k, start in enumerate(s.starts, 1)]
ABSCISSA = np.linspace(0, 4, 30)


def decay(b: Array) -> Array:
    """Residuals of 2 exp(-0.7 t) + 0.3, which b = (2, 0.7, 0.3) explains."""
    return b[0] * np.exp(-b[1] * ABSCISSA) + b[2] - (2 * np.exp(-0.7 * ABSCISSA) + 0.3)


def waves(b: Array) -> Array:
    """Many minima along b[0]; the lowest, 0, at (3.7, 1)."""
    return np.array([b[0] - 3.7, 5 * np.sin(3 * (b[0] - 3.7)), b[1] - 1])


@pytest.mark.parametrize("problem", SETS, ids=lambda s: s.name)
def test_the_table_is_the_certified_one(problem: Certified) -> None:
    found = problem.residuals(np.array(problem.b))
    assert found @ found == pytest.approx(problem.sum_of_squares, rel=2e-10, abs=0)


@pytest.mark.parametrize(("problem", "start"), CASES)
def test_certified_values_are_found_from_both_starts(problem: Certified, start: tuple[float, ...]) -> None:
    bounds = np.sort(np.outer(start, [1e-3, 1e3]), axis=1)
    found = minimise(problem.residuals, bounds, start=start, global_evaluations=1000, starts=2)
    assert problem.digits(found.x) >= 6
    assert found.cost == pytest.approx(problem.sum_of_squares, rel=1e-9, abs=0)
    assert found.converged
    assert found.at_bounds == ()
    assert found.rank == len(start)


def test_the_jacobian_is_that_of_the_parameters() -> None:
    eckerle = next(s for s in SETS if s.name == "Eckerle4")
    found = minimise(eckerle.residuals, [(0.1, 100), (0.5, 40), (400, 500)], global_evaluations=500, starts=1)
    b1, b2, b3 = found.x
    z = (eckerle.x - b3) / b2
    bell = np.exp(-(z**2) / 2)
    expected = -np.column_stack([bell / b2, b1 / b2**2 * bell * (z**2 - 1), b1 / b2**2 * bell * z])
    np.testing.assert_allclose(found.jacobian, expected, rtol=1e-5, atol=1e-8)


def test_the_lowest_of_many_minima_is_found_and_the_others_are_named() -> None:
    found = minimise(waves, [(-20, 20), (-5, 5)], start=(-17, 0), starts=3)
    np.testing.assert_allclose(found.x, [3.7, 1], atol=1e-9)
    assert found.converged
    stuck = found.restarts[0]
    assert stuck.origin == "start"
    assert stuck.converged  # a minimum, but not the lowest
    assert stuck.cost > 100
    assert stuck in found.disagreeing
    assert stuck not in found.rivals
    assert f"start ended elsewhere, at {stuck.cost:.6g}" in found.statement


def test_without_a_global_search_the_start_s_own_minimum_is_returned() -> None:
    found = minimise(waves, [(-20, 20), (-5, 5)], start=(-17, 0), global_evaluations=0, starts=0)
    assert found.x[0] < -15
    assert [r.origin for r in found.restarts] == ["start"]


def test_two_equal_minima_are_rivals() -> None:
    found = minimise(lambda b: np.array([b[0] ** 2 - 4, 0.1]), [(-5, 5)], start=[4], starts=8)
    assert abs(found.x[0]) == pytest.approx(2)
    assert any(r.x[0] == pytest.approx(-found.x[0]) for r in found.rivals)
    assert "NOT determined: other parameters fit equally well" in found.statement


def test_parameters_that_trade_against_one_another_lower_the_rank() -> None:
    found = minimise(lambda b: b[0] * b[1] * np.exp(-ABSCISSA) - 3 * np.exp(-ABSCISSA) + 0.01 * ABSCISSA, [(1, 5), (0.5, 4)], starts=3)
    assert found.rank == 1
    assert "the residuals fix only 1 combinations of 2 parameters" in found.statement


def test_a_parameter_that_does_nothing_lowers_the_rank() -> None:
    found = minimise(lambda b: decay(b[:3]), [(0.1, 9), (0.1, 9), (0, 1), (-1, 1)], starts=1)
    assert found.rank == 3
    np.testing.assert_allclose(found.x[:3], [2, 0.7, 0.3], rtol=1e-7)


@given(
    seed=st.integers(0, 10_000),
    upper=st.floats(0.05, 2),
)
@settings(max_examples=15)
def test_bounded_linear_problems_are_solved_as_exactly_as_directly(seed: int, upper: float) -> None:
    random = np.random.default_rng(seed)
    design, target = random.standard_normal((12, 3)), random.standard_normal(12)
    found = minimise(lambda b: design @ b - target, [(-0.2, upper)] * 3, start=[0, 0, 0], global_evaluations=0, starts=1)
    expected = lsq_linear(design, target, (-0.2, upper), tol=1e-14)
    assert found.cost == pytest.approx(2 * expected.cost, rel=1e-8)
    np.testing.assert_allclose(found.x, expected.x, atol=1e-5)
    assert found.converged
    clear = [(i, "lower" if side < 0 else "upper") for i, side in enumerate(expected.active_mask) if side]
    assert set(clear) <= set(found.at_bounds)


def test_a_bound_in_the_way_is_said_to_be() -> None:
    found = minimise(decay, [(0.1, 1.5), (0.1, 5), (0, 1)], starts=2)
    assert found.x[0] == 1.5
    assert found.at_bounds == ((0, "upper"),)
    assert found.converged
    assert "parameter 0 ended at its upper bound, 1.5" in found.statement


def test_negative_parameters_over_decades() -> None:
    found = minimise(lambda b: decay(np.array([-b[0], b[1], b[2]])), [(-1e4, -1e-3), (1e-3, 1e3), (1e-4, 10)])
    np.testing.assert_allclose(found.x, [-2, 0.7, 0.3], rtol=1e-8)


def test_the_same_seed_gives_the_same_minimum() -> None:
    one, two, other = (minimise(waves, [(-20, 20), (-5, 5)], seed=s, global_evaluations=200) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.x, two.x)
    assert one.evaluations == two.evaluations
    assert [r.cost for r in one.restarts] == [r.cost for r in two.restarts]
    assert not np.array_equal(one.restarts[1].begun, other.restarts[1].begun)


def test_evaluations_are_counted_and_stay_within_bounds() -> None:
    seen: list[Array] = []

    def watched(b: Array) -> Array:
        seen.append(b.copy())
        return decay(b)

    bounds = np.array([(0.01, 10), (0.1, 9), (-1, 1)])
    found = minimise(watched, bounds, start=[10, 9, -1], global_evaluations=150, starts=1)
    assert found.evaluations == len(seen)
    assert np.all(np.array(seen) >= bounds[:, 0])
    assert np.all(np.array(seen) <= bounds[:, 1])
    assert sum(r.evaluations for r in found.restarts) < found.evaluations


def test_places_without_finite_residuals_are_gone_round() -> None:
    def broken(b: Array) -> Array:
        return decay(b) if b[0] < 3 else np.full(len(ABSCISSA), math.nan)

    found = minimise(broken, [(0.1, 9), (0.1, 9), (0, 1)])
    np.testing.assert_allclose(found.x, [2, 0.7, 0.3], rtol=1e-7)
    assert found.refused > 0
    assert all(np.isfinite(r.x).all() and math.isfinite(r.cost) for r in found.restarts)
    assert f"{found.refused} of them refused" in found.statement


def test_a_minimum_hemmed_in_by_refusal_is_not_called_one() -> None:
    def only_here(b: Array) -> Array:
        return np.array([b[0], 1.0]) if b[0] == 0.5 else np.array([math.inf, 1.0])

    found = minimise(only_here, [(0, 1)], start=[0.5], global_evaluations=0, starts=0)
    assert not found.converged
    assert found.statement.startswith("NOT converged")
    assert np.isfinite(found.jacobian).all()


def test_a_descent_cut_short_is_not_called_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fitting.minimise.POLISH", 0)
    found = minimise(decay, [(0.1, 9), (0.1, 9), (0, 1)], start=[8, 8, 0.9], global_evaluations=0, starts=0, iterations=2)
    assert not found.converged
    assert found.stopped == "no evaluations left"


def test_a_valley_not_followed_to_its_end_is_not_called_a_minimum() -> None:
    bennett = next(s for s in SETS if s.name == "Bennett5")
    found = minimise(bennett.residuals, [(-1.5e6, -1.5), (0.045, 45_000), (0.00085, 850)], global_evaluations=500, starts=1, iterations=60)
    assert found.converged == (bennett.digits(found.x) >= 6)


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ([(1, 1)], "parameter 0 are 1 to 1"),
        ([(0, 1), (2, math.inf)], "parameter 1 are 2 to inf"),
        ([(math.nan, 1)], "parameter 0 are nan to 1"),
        ([1, 2], "not of shape"),
        ([], "not of shape"),
        ([("a", "b")], "pairs of numbers"),
    ],
)
def test_bounds_that_bound_nothing(bounds: list[object], said: str) -> None:
    with pytest.raises(DomainError, match=said):
        minimise(decay, bounds)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings_", "said"),
    [
        ({"start": [5.0]}, "parameter 0 is 5, outside its bounds 0 to 1"),
        ({"start": [math.nan]}, "parameter 0 is nan"),
        ({"start": [0.5, 0.5]}, "must have 1 parameters"),
        ({"starts": -1}, "starts must be 0 or more"),
        ({"global_evaluations": -1}, "global_evaluations must be 0 or more"),
        ({"iterations": 0}, "iterations must be 1 or more"),
        ({"difference": 0.0}, "difference must lie between"),
        ({"stationary": 1.0}, "stationary must lie between"),
        ({"seed": -1}, "seed must be 0 or more"),
    ],
)
def test_settings_that_make_no_sense(settings_: dict[str, object], said: str) -> None:
    with pytest.raises(DomainError, match=said):
        minimise(lambda b: b, [(0, 1)], **settings_)  # type: ignore[arg-type]


def test_nowhere_to_begin() -> None:
    with pytest.raises(FitError, match="nowhere to begin"):
        minimise(lambda b: b, [(0, 1)], global_evaluations=0, starts=0)


def test_no_finite_residuals_anywhere() -> None:
    with pytest.raises(FitError, match="none of 116 points gave finite residuals"):
        minimise(lambda b: b * math.nan, [(0, 1)], global_evaluations=100, starts=2)


def test_a_start_without_finite_residuals() -> None:
    with pytest.raises(FitError, match=r"not finite at the start \(0\.5\)"):
        minimise(lambda b: b / 0.0, [(0, 1)], start=[0.5], global_evaluations=0)


def test_residuals_that_are_no_vector_or_change_their_length() -> None:
    with pytest.raises(FitError, match="must be a vector"):
        minimise(lambda b: np.zeros((2, 2)), [(0, 1)])
    lengths = iter(range(1, 1000))
    with pytest.raises(FitError, match="changed their number from 1 to 2"):
        minimise(lambda b: np.ones(next(lengths)), [(0, 1)])


@pytest.mark.parametrize("raised", [ValueError, RuntimeError, DomainError])
@pytest.mark.parametrize("after", [5, 60])
def test_what_the_residuals_raise_is_passed_on(raised: type[Exception], after: int) -> None:
    count = 0

    def failing(b: Array) -> Array:
        nonlocal count
        count += 1
        if count > after:
            raise raised("of the model")
        return decay(b)

    with pytest.raises(raised, match="of the model"):
        minimise(failing, [(0.1, 9), (0.1, 9), (0, 1)], global_evaluations=50, starts=1)
