"""The events along a photon's path, each against its formula."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.petals import kernels


def generator(seed: int) -> np.ndarray:
    return np.array([seed], np.uint64)


@settings(deadline=None)  # the first call compiles
@given(n=st.floats(1.1, 2.0))
def test_fresnel_at_normal_brewster_and_total(n: float) -> None:
    assert kernels.fresnel(1.0, n)[0] == pytest.approx(((n - 1) / (n + 1)) ** 2)
    brewster = math.atan(n)
    rs = math.sin(brewster - (math.pi / 2 - brewster))  # no p reflection; Fresnel's sine law for s
    assert kernels.fresnel(math.cos(brewster), n)[0] == pytest.approx(rs**2 / 2)
    critical = math.asin(1 / n)
    assert kernels.fresnel(math.cos(min(critical + 0.01, math.pi / 2)), 1 / n) == (1.0, 0.0)
    assert kernels.fresnel(math.cos(critical - 0.01), 1 / n)[0] < 1


@settings(deadline=None)  # the first call compiles
@given(n=st.floats(1.1, 2.0), theta=st.floats(0, 1.5))
def test_fresnel_is_the_same_from_both_sides(n: float, theta: float) -> None:
    reflectance, cos_out = kernels.fresnel(math.cos(theta), n)
    assert math.sqrt(1 - cos_out**2) == pytest.approx(math.sin(theta) / n, abs=1e-7)
    assert kernels.fresnel(cos_out, 1 / n)[0] == pytest.approx(reflectance, abs=1e-9)


@pytest.mark.parametrize("theta", [0.0, 60.0, 85.0, 110.0])
def test_visible_facets_follow_ggx(theta: float) -> None:
    """From above and from below the horizon: mean normal of the facets seen from w, by quadrature of D(m) max(0, w.m)."""
    alpha, n = 0.3, 20_000
    w = np.array([math.sin(math.radians(theta)), 0.0, math.cos(math.radians(theta))])
    cos = (np.arange(2000) + 0.5) / 2000
    phi = (np.arange(360) + 0.5) / 360 * 2 * math.pi
    c, p = np.meshgrid(cos, phi, indexing="ij")
    m = np.stack([np.sqrt(1 - c * c) * np.cos(p), np.sqrt(1 - c * c) * np.sin(p), c])
    seen = alpha**2 / (math.pi * (1 + c * c * (alpha**2 - 1)) ** 2) * np.maximum(0, np.tensordot(w, m, 1))
    expected = (m * seen).sum(axis=(1, 2)) / seen.sum()
    rng = generator(3)
    drawn = np.array([kernels.visible_facet(*w.tolist(), alpha, rng) for _ in range(n)])
    assert np.linalg.norm(drawn, axis=1) == pytest.approx(1)
    assert (drawn @ w > 0).all()
    error = drawn.std(axis=0) / math.sqrt(n)
    assert np.abs(drawn.mean(axis=0) - expected).max() < 5 * error.max()


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.7])
def test_mean_cosine_of_scattering(g: float) -> None:
    rng = generator(4)
    d = (0.6, 0.0, -0.8)
    cos = np.array([np.dot(kernels.deflect(d, g, rng), d) for _ in range(20_000)])
    assert cos.mean() == pytest.approx(g, abs=5 * cos.std() / math.sqrt(cos.size))
    # Second Legendre moment of Henyey and Greenstein: g^2.
    second = 1.5 * cos**2 - 0.5
    assert second.mean() == pytest.approx(g * g, abs=5 * second.std() / math.sqrt(cos.size))


def test_roulette_is_fair_and_the_books_balance() -> None:
    rng, energy = generator(5), np.zeros(6)
    n, weight, depth = 20_000, 0.03, 1.5
    left = np.array([kernels.spend(weight, depth, energy, rng) for _ in range(n)])
    assert set(left.tolist()) == {0.0, kernels.ROULETTE_WEIGHT}
    assert left.mean() == pytest.approx(weight * math.exp(-depth), abs=5 * left.std() / math.sqrt(n))
    assert energy[kernels.ABSORBED] == pytest.approx(n * weight * (1 - math.exp(-depth)))
    assert left.sum() + energy.sum() == pytest.approx(n * weight)


def test_random_numbers_are_uniform_and_uncorrelated() -> None:
    rng = generator(6)
    u = np.array([kernels.uniform(rng) for _ in range(100_000)])
    assert u.min() >= 0
    assert u.max() < 1
    counts = np.histogram(u, 100, (0, 1))[0]
    assert abs(((counts - 1000) ** 2 / 1000).sum() - 99) < 5 * math.sqrt(2 * 99)
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 5 / math.sqrt(u.size)
