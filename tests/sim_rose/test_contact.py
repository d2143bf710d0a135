"""Crossings and clearances against what can be worked out otherwise."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sim.rose.contact import clearance, crossings, hits
from sim.rose.mesh import Mesh

ONE = np.array([[0, 1, 2]])
TRIANGLE = arrays(np.float64, (3, 3), elements=st.integers(-30, 30).map(lambda i: i / 10))


def single(corners: np.ndarray | list[list[float]]) -> Mesh:
    return Mesh(np.array(corners, dtype=float), ONE)


def area(corners: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) / 2)


def samples(corners: np.ndarray, n: int) -> np.ndarray:
    u, v = (g.ravel() / n for g in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    inside = u + v <= 1 + 1e-9
    u, v = u[inside, None], v[inside, None]
    return corners[0] + u * (corners[1] - corners[0]) + v * (corners[2] - corners[0])


def test_a_triangle_through_another_crosses_it_and_one_beside_it_does_not() -> None:
    flat = single([[0, 0, 0], [2, 0, 0], [0, 2, 0]])
    assert crossings(flat, single([[0.5, 0.5, -1], [0.5, 0.5, 1], [0.6, 0.5, 1]])) == 1
    # Its edges pass beside the first, an edge of the first passes through it.
    assert crossings(flat, single([[-1, 0.5, -3], [-1, 0.5, 3], [5, 0.5, 0.1]])) == 1
    assert crossings(flat, single([[1.5, 1.5, -1], [1.5, 1.5, 1], [1.6, 1.5, 1]])) == 0
    assert crossings(flat, single([[0.5, 0.5, 0.1], [0.5, 0.5, 1], [0.6, 0.5, 1]])) == 0


@settings(max_examples=150, deadline=None)
@given(TRIANGLE, TRIANGLE)
def test_the_distance_is_that_of_dense_samples(a: np.ndarray, b: np.ndarray) -> None:
    assume(min(area(a), area(b)) > 0.05)
    n = 24
    sampled = np.linalg.norm(samples(a, n)[:, None] - samples(b, n)[None], axis=2).min()
    coarse = max(np.linalg.norm(t - np.roll(t, 1, axis=0), axis=1).max() for t in (a, b)) / n
    found = clearance(single(a), single(b), within=100.0)
    assert found <= sampled + 1e-9
    assert found >= sampled - 2 * coarse
    assert found == pytest.approx(clearance(single(b), single(a), within=100.0), abs=1e-9)


@settings(max_examples=150, deadline=None)
@given(TRIANGLE, TRIANGLE)
def test_crossing_is_what_the_planes_say(a: np.ndarray, b: np.ndarray) -> None:
    assume(min(area(a), area(b)) > 0.05)

    def heights(of: np.ndarray, over: np.ndarray) -> np.ndarray:
        return (of - over[0]) @ np.cross(over[1] - over[0], over[2] - over[0])

    apart = any((h > 1e-9).all() or (h < -1e-9).all() for h in (heights(a, b), heights(b, a)))
    if apart:
        assert crossings(single(a), single(b)) == 0
    assert crossings(single(a), single(b)) == crossings(single(b), single(a))
    if crossings(single(a), single(b)):
        assert clearance(single(a), single(b)) == 0.0


def ball(radius: float, centre: tuple[float, float, float]) -> Mesh:
    theta, phi = np.meshgrid(np.linspace(0.05, np.pi - 0.05, 40), np.linspace(0, 2 * np.pi, 60))
    points = radius * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1) + centre
    index = np.arange(theta.size).reshape(theta.shape)
    a, b, c, d = (index[i, j].ravel() for i in (slice(0, -1), slice(1, None)) for j in (slice(0, -1), slice(1, None)))
    return Mesh(points.reshape(-1, 3), np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]))


def test_balls_are_as_far_apart_as_their_radii_say() -> None:
    one = ball(3.0, (0, 0, 0))
    assert clearance(one, ball(2.0, (5.4, 0, 0))) == pytest.approx(0.4, abs=0.01)
    assert clearance(one, ball(2.0, (5.4, 0, 0)), within=0.3) == float("inf")
    assert crossings(one, ball(2.0, (4.9, 0, 0))) > 10
    assert clearance(one, ball(2.0, (4.9, 0, 0))) == 0.0
    # One inside the other: near, not crossing.
    assert clearance(one, ball(2.5, (0.1, 0, 0))) == pytest.approx(0.4, abs=0.02)


def test_rays_meet_what_lies_ahead_only() -> None:
    flat = single([[0, 0, 0], [2, 0, 0], [0, 2, 0]])
    origins = np.array([[0.5, 0.5, 1.0], [0.5, 0.5, 1.0], [1.5, 1.5, 1.0]])
    directions = np.array([[0, 0, -1.0], [0, 0, 1.0], [0, 0, -1.0]])
    assert hits(origins, directions, flat).tolist() == [True, False, False]
