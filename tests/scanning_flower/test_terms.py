"""The terms of the cost: their derivatives, and the solver against an independent one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear, minimize
from scipy.sparse import csr_matrix

from scanning.contact import Gaps
from scanning.placement import PetalPlacement, Placement
from scanning.poses import Array, moved, petal_poses
from scanning.terms import Habit, Terms, apart_and_nestled, inner_nearer, measured, on_receptacle, step_down

K = 3
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25)  # each holds hundreds of derivatives at a random place


def somewhere(rng: np.random.Generator) -> Array:
    """Return coordinates (K, 6) of petals in all directions."""
    low, high = [-3, 1, -2, 0.2, -1, -0.5], [3, 8, 2, 1.2, 1, 0.5]
    return rng.uniform(low, high, (K, 6))


def slope(residual: object, q: Array) -> Array:
    """Return d residual / d q by differences, (M, 6 K)."""
    columns = []
    for index in range(q.size):
        step = np.zeros(q.size)
        step[index] = 1e-6
        columns.append((residual(q + step.reshape(q.shape)) - residual(q - step.reshape(q.shape))) / 2e-6)  # type: ignore[operator]
    return np.array(columns).T


@few
@given(seeds)
def test_the_measurements_rows_are_their_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    petals = {f"P{i}": PetalPlacement(f"P{i}", None, None, 40.0, 120.0 * i, 4.0, 0.0) for i in range(K)}
    direction = np.array([[0.1, 0.9, 0.2]] * K) / np.linalg.norm([0.1, 0.9, 0.2])
    m = measured(Placement("three", petals), list(petals), direction, Habit())
    q = somewhere(rng)
    np.testing.assert_allclose(m.terms(q).rows.toarray(), slope(lambda at: m.terms(at).residual, q), rtol=1e-4, atol=1e-4)


@few
@given(seeds)
def test_bases_on_a_cone_are_on_the_receptacle_and_the_rows_say_how_they_leave_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = somewhere(rng)
    q[:, 2] = rng.uniform(-2, 2)  # all at one height: the slope that is held near 0 is 0
    terms = on_receptacle(q, 0.3)
    np.testing.assert_allclose(terms.residual, 0, atol=1e-9)
    np.testing.assert_allclose(terms.rows.toarray(), slope(lambda at: on_receptacle(at, 0.3).residual, q), atol=1e-4)


def test_a_base_off_the_cone_of_the_others_is_off_the_receptacle() -> None:
    q = np.zeros((9, 6))
    q[:, 1] = np.arange(9) + 2.0
    q[:, 2] = 3 - 0.25 * q[:, 1]
    assert np.abs(on_receptacle(q, 0.3).residual[:-1]).max() < 0.05
    q[4, 2] += 0.9
    assert on_receptacle(q, 0.3).residual[4] == pytest.approx(3 * (1 - 1 / 9), abs=0.05)


def test_inner_bases_count_only_where_they_are_farther_out() -> None:
    q = np.zeros((K, 6))
    q[:, 1] = 3.0, 4.0, 3.7
    pairs = [(0, 1), (1, 2), (0, 2)]
    terms = inner_nearer(q, pairs, 0.3)
    np.testing.assert_allclose(terms.residual, [1 / 0.3, -0.3 / 0.3, 0.7 / 0.3])
    assert terms.cost == pytest.approx(1.0)
    np.testing.assert_allclose(terms.rows.toarray(), slope(lambda at: inner_nearer(at, pairs, 0.3).residual, q), atol=1e-6)
    assert inner_nearer(q, [], 0.3).cost == 0


@few
@given(seeds)
def test_the_gaps_rows_are_their_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, m = somewhere(rng), 12
    i, j = rng.integers(0, K, m), rng.integers(0, K, m)
    j[i == j] = (j[i == j] + 1) % K
    p, c = rng.normal(0, 5, (2, m, 3))
    n = rng.normal(size=(m, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    sign = rng.choice([-1.0, 1.0], m)
    frames = petal_poses(q)
    back = np.linalg.inv(frames)

    def carried(at: Array) -> Gaps:
        # A petal's points go with it; the normal is held, as in one linear step.
        to = petal_poses(at) @ back
        ps, cs = (np.array([moved(to[k], x[None])[0] for k, x in zip(of, points, strict=True)]) for of, points in ((i, p), (j, c)))
        return Gaps(i, j, ps, cs, n)

    wide = Habit(nestle=-100.0, nestle_u=0.5)
    for part in (0, 1):
        found = apart_and_nestled(q, carried(q), sign, wide, 100.0, 7.0)[part]
        by_hand = slope(lambda at, part=part: apart_and_nestled(at, carried(at), sign, wide, 100.0, 7.0)[part].residual, q)
        np.testing.assert_allclose(found.rows.toarray(), by_hand, rtol=1e-4, atol=1e-3)


@given(seeds)
def test_the_step_is_the_least_cost_that_another_solver_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior = Terms(rng.normal(size=8), csr_matrix(rng.normal(size=(8, 5)) + np.vstack([np.eye(5), np.zeros((3, 5))])))
    springs = Terms(rng.normal(size=20), csr_matrix(3 * rng.normal(size=(20, 5))), one_sided=True)

    def cost(step: Array) -> float:
        moved = [Terms(t.residual + t.rows @ step, t.rows, t.one_sided) for t in (prior, springs)]
        return sum(t.cost for t in moved)

    step = step_down([prior, springs])
    other = minimize(cost, lsq_linear(prior.rows.toarray(), -prior.residual).x, method="BFGS", options={"gtol": 1e-8})
    assert cost(step) <= other.fun * (1 + 1e-6) + 1e-9
