"""The tracer against closed forms, conservation and reciprocity."""

import math

import numba
import numpy as np
import pytest

from sim.petals import PetalError
from sim.petals.structure import CULTIVARS, Petal, check
from sim.petals.tracing import Trace, mean_and_error, theta_r_nodes, trace

# Without surface, domes or epidermis: a bare scattering slab.
SLAB = Petal(radius=0.0, roughness=0.0, refraction=1.0, epidermis=0.0, lower_epidermis=0.0, anisotropy=0.0)
# All that a petal has, and nothing that absorbs.
LOSSLESS = Petal(height=15.0, roughness=0.3, mesophyll=60.0, scattering=0.03)


def deviations(batches: np.ndarray, expected: np.ndarray | float) -> np.ndarray:
    """By how many standard errors a mean over batches misses what is expected."""
    mean, error = mean_and_error(batches)
    return (mean - expected) / error


def assert_standard_normal(z: np.ndarray) -> None:
    """Mean square 1 within five of its standard deviations, as if all were independent, and no single one beyond five."""
    assert np.abs(z).max() < 5
    assert (z**2).mean() < 1 + 5 * math.sqrt(2 / z.size)


def fresnel(theta_i: float, n: float) -> float:
    """Unpolarised reflectance, from Fresnel's sine and tangent laws."""
    i = math.radians(theta_i)
    if i == 0:
        return ((n - 1) / (n + 1)) ** 2
    t = math.asin(math.sin(i) / n)
    return 0.5 * ((math.sin(i - t) / math.sin(i + t)) ** 2 + (math.tan(i - t) / math.tan(i + t)) ** 2)


@pytest.mark.parametrize("theta_i", [0.0, 45.0, 80.0])
def test_a_clear_smooth_plate_obeys_fresnel_and_beer(theta_i: float) -> None:
    # Absorbing upper epidermis, clear middle and lower layer: each crossing of the plate takes the same share a.
    petal = Petal(radius=0.0, roughness=0.0, refraction=1.42, epidermis=15.0, pigment=0.02, scattering=0.0)
    result = trace(petal, theta_i, 20_000, 1)
    f = fresnel(theta_i, 1.42)
    a = math.exp(-0.02 * 15.0 / math.sqrt(1 - (math.sin(math.radians(theta_i)) / 1.42) ** 2))
    assert abs(deviations(result.reflected, f + (1 - f) ** 2 * f * a**2 / (1 - f**2 * a**2))) < 5
    assert abs(deviations(result.transmitted, (1 - f) ** 2 * a / (1 - f**2 * a**2))) < 5
    # All of it goes to the mirror direction.
    side = np.argmin(np.abs(theta_r_nodes() + theta_i))
    cone = math.pi * math.sin(math.radians(4.0)) ** 2 * math.cos(math.radians(theta_i))
    assert result.cones[:, side].mean() * cone == pytest.approx(result.reflected.mean())


def h_function(albedo: float, cosines: np.ndarray) -> np.ndarray:
    """Chandrasekhar's H for isotropic scattering, by iteration (Radiative Transfer, 1960, chapter V)."""
    x, w = np.polynomial.legendre.leggauss(200)
    mu, w = 0.5 * (x + 1), 0.5 * w
    root = math.sqrt(1 - albedo)

    def step(h: np.ndarray, at: np.ndarray) -> np.ndarray:
        return 1 / (root + 0.5 * albedo * ((w * mu * h) / (at[:, None] + mu)).sum(axis=1))

    h = np.ones_like(mu)
    for _ in range(3000):
        h = 0.5 * (h + step(h, mu))
    return step(h, cosines)


def test_a_deep_absorbing_slab_is_chandrasekhars() -> None:
    albedo, theta_i = 0.8, 45.0
    petal = SLAB._replace(mesophyll=2000.0, scattering=0.08, absorption=0.02)  # optical depth 200
    result = trace(petal, theta_i, 300_000, 2)
    angles = np.linspace(0, 90, 10)
    rows = deviations(result.bins.mean(axis=2), 0.0)  # no azimuth in isotropic scattering
    assert rows.min() > 20
    fine = (np.arange(900) + 0.5) / 10
    mu, mu0 = np.cos(np.radians(fine)), math.cos(math.radians(theta_i))
    h, h0 = h_function(albedo, mu), h_function(albedo, np.array([mu0]))[0]
    weight = np.sin(np.radians(fine)) * mu
    f_r = albedo / (4 * math.pi) * h * h0 / (mu + mu0)
    expected = (f_r * weight).reshape(9, 100).sum(axis=1) / weight.reshape(9, 100).sum(axis=1)
    assert_standard_normal(deviations(result.bins.mean(axis=2), expected))
    assert angles.size == expected.size + 1
    assert abs(deviations(result.reflected, 2 * math.pi * (f_r * weight).sum() * math.radians(0.1))) < 5


def test_a_deep_lossless_slab_is_nearly_lambert() -> None:
    petal = SLAB._replace(mesophyll=200.0, scattering=0.1, backing=1.0)
    result = trace(petal, 0.0, 20_000, 3)
    assert result.reflected == pytest.approx(1)
    f_r = result.bins.mean(axis=(0, 2))
    assert np.abs(math.pi * f_r[:6] - 1).max() < 0.1  # the H-functions depart from Lambert by as much
    forward = trace(petal._replace(backing=0.0, mesophyll=1000.0), 0.0, 5_000, 4)
    assert (forward.reflected.mean(), forward.transmitted.mean()) == pytest.approx((0.987, 0.013), abs=0.005)  # T = 4/3 / (tau + 1.42)


@pytest.mark.parametrize("petal", [LOSSLESS, CULTIVARS["BR"], CULTIVARS["WR"]], ids=["lossless", "BR", "WR"])
def test_energy_is_conserved(petal: Petal) -> None:
    result = trace(petal, 60.0, 20_000, 5)
    assert result.reflected + result.transmitted + result.absorbed + result.roulette == pytest.approx(1, abs=1e-12)
    if petal is LOSSLESS:
        assert (result.absorbed == 0).all()
        assert result.reflected.mean() + result.transmitted.mean() == pytest.approx(1, abs=1e-5)  # a few grazing photons play roulette
        assert result.transmitted.mean() > 0.2
    else:
        assert abs(deviations(result.roulette, 0.0)) < 5


def test_white_furnace() -> None:
    """A lossless closed petal under a uniformly bright sky is as bright as the sky, whichever way one looks."""
    petal = LOSSLESS._replace(backing=1.0)
    result = trace(petal, (0.0, 90.0), 60_000, 6)
    assert result.reflected.mean() == pytest.approx(1, abs=1e-5)
    assert_standard_normal(deviations(result.bins.mean(axis=2), 1 / math.pi))


@pytest.mark.parametrize("name", ["BR", "WR"])
def test_light_and_view_can_change_places(name: str) -> None:
    """Bins of one ring lit from another, azimuth by azimuth: the estimator has no bias here, unlike point against cone."""
    there = trace(CULTIVARS[name], (20.0, 30.0), 60_000, 7).bins[:, 6]
    back = trace(CULTIVARS[name], (60.0, 70.0), 60_000, 8).bins[:, 2]
    assert_standard_normal(deviations(there - back, 0.0))
    assert np.abs(deviations(there, back.mean() * 1.5)).mean() > 5  # fine enough to see such a difference


ROUGH_FLAT = Petal(radius=0.0, roughness=0.6, mesophyll=60.0)


@pytest.mark.parametrize(
    ("petal", "photons"),
    [
        (CULTIVARS["BR"], 60_000),
        (CULTIVARS["PR"], 60_000),
        (CULTIVARS["WR"], 60_000),
        (ROUGH_FLAT._replace(pigment=0.3), 600_000),
        (ROUGH_FLAT, 100_000),
    ],
    ids=["BR", "PR", "WR", "flat dark", "flat pale"],
)
def test_scored_light_agrees_with_counted_light(petal: Petal, photons: int) -> None:
    """The lobe formulas against plain counting of photons, at the grazing incidence where most facets hide each other."""
    result = trace(petal, 70.0, photons, 9)
    inner = np.abs(theta_r_nodes()) <= 70
    assert_standard_normal(deviations((result.cones - result.f_r)[:, inner], 0.0))
    assert (result.surface > 0).any()
    assert (result.body > 0).any()


def test_same_seed_same_numbers_however_many_threads() -> None:
    def numbers(result: Trace) -> list[bytes]:
        return [array.tobytes() for array in (result.surface, result.body, result.cones, result.bins, result.reflected, result.roulette)]

    first = trace(CULTIVARS["PR"], 45.0, 500, 10)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        again = trace(CULTIVARS["PR"], 45.0, 500, 10)
    finally:
        numba.set_num_threads(threads)
    assert numbers(first) == numbers(again)
    assert numbers(first) != numbers(trace(CULTIVARS["PR"], 45.0, 500, 11))
    assert len({batch.tobytes() for batch in first.f_r}) == len(first.f_r)  # no two batches alike


def test_standard_errors_tell_the_scatter_between_seeds() -> None:
    runs = [mean_and_error(trace(CULTIVARS["WR"], 45.0, 2_000, seed).f_r) for seed in range(12)]
    told = np.sqrt(np.mean([error**2 for _, error in runs], axis=0))
    seen = np.std([mean for mean, _ in runs], axis=0, ddof=1)
    assert np.exp(np.log(seen / told).mean()) == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"radius": 9.9, "height": 36.0}, "half the pitch"),
        ({"scattering": -1.0}, "scattering = -1"),
        ({"height": math.nan}, "height = nan"),
        ({"anisotropy": 1.0}, "anisotropy"),
        ({"refraction": 1.0}, "refraction"),
        ({"roughness": 0.01}, "roughness"),
    ],
)
def test_impossible_petals_are_refused(change: dict[str, float], words: str) -> None:
    with pytest.raises(PetalError, match=words):
        check(Petal()._replace(**change))


def test_impossible_questions_are_refused() -> None:
    for theta_i in (-1.0, 90.0, (50.0, 40.0)):
        with pytest.raises(PetalError, match="theta_i"):
            trace(Petal(), theta_i, 100, 1)
    with pytest.raises(PetalError, match="photons"):
        trace(Petal(), 45.0, 0, 1)
    with pytest.raises(PetalError, match="roughness 0"):
        _ = trace(Petal(radius=0.0, roughness=0.0), 45.0, 100, 1).f_r
