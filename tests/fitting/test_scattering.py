"""Reflection and transmission as one thing: looked up and sampled over the whole sphere."""

import numpy as np
import pytest
from scipy.stats import chi2

from fitting.errors import DomainError
from fitting.reflectance import INTENSITY, PER_SR, Reflectance
from fitting.scattering import Scattering
from fitting.table import ReflectanceTable

THETA, PHI = np.append(np.arange(0.0, 90, 7.5), 89.0), np.arange(0.0, 181, 15)


def side(shape: np.ndarray, mode: str = PER_SR) -> Reflectance:
    return ReflectanceTable.from_basis(("f",), [shape], nodes=(THETA, THETA, PHI), mode=mode, provenance={}).mixed({"f": 1.0})


@pytest.fixture(scope="module")
def both() -> Scattering:
    """A lobe towards the light above, a broad one straight through below: known in closed form at the nodes."""
    i, r, p = np.meshgrid(np.radians(THETA), np.radians(THETA), np.radians(PHI), indexing="ij")
    towards = np.cos(i) * np.cos(r) + np.sin(i) * np.sin(r) * np.cos(p)
    through = np.cos(i) * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(p)
    return Scattering(side(0.1 * np.maximum(0, towards) ** 4), side(0.02 + 0.05 * np.maximum(0, through) ** 2))


def test_each_view_sees_its_own_side(both: Scattering) -> None:
    assert both.evaluate(45.0, 45.0, 0.0) == pytest.approx(0.1, rel=1e-3)  # back to the light
    assert both.evaluate(45.0, -135.0, 0.0) == pytest.approx(0.07, rel=1e-3)  # straight through is theta_i - 180
    assert both.evaluate(45.0, 135.0, 180.0) == pytest.approx(0.07, rel=1e-3)  # the same, written the other way
    assert both.evaluate(30.0, 180.0, 77.0) == pytest.approx(0.02 + 0.05 * np.cos(np.radians(30)) ** 2, rel=1e-3)
    mixed = both.evaluate(30.0, [20.0, 170.0], 0.0)
    assert mixed.tolist() == [both.reflected(30.0, 20.0, 0.0), both.transmitted(30.0, 10.0, 0.0)]


def test_density_is_one_over_the_sphere_and_what_is_drawn_follows_it(both: Scattering) -> None:
    rings, sectors, draws = 36, 24, 200_000
    # Views even in cos(theta_r): each bin has the same solid angle.
    edges = np.degrees(np.arccos(np.linspace(1, -1, rings + 1)))
    fine = np.degrees(np.arccos(1 - 2 * (np.arange(rings * 8) + 0.5) / (rings * 8)))
    azimuth = -180 + 360 * (np.arange(sectors * 8) + 0.5) / (sectors * 8)
    rng = np.random.default_rng(5)
    for theta_i in (0.0, 40.0, 75.0):
        density = both.pdf(theta_i, fine[:, None], azimuth)
        expected = 4 * np.pi * density.reshape(rings, 8, sectors, 8).mean(axis=(1, 3)) / rings / sectors
        assert expected.sum() == pytest.approx(1, abs=2e-3)
        theta_r, phi = both.sample(theta_i, *rng.random((2, draws)))
        seen, _, _ = np.histogram2d(theta_r, phi, bins=(edges, np.linspace(-180, 180, sectors + 1)))
        enough = draws * expected > 20
        statistic = np.sum((seen - draws * expected)[enough] ** 2 / (draws * expected)[enough])
        assert statistic < chi2.ppf(1 - 1e-6, enough.sum()) * 1.05  # bins are known to a few parts in a thousand only


def test_sides_are_drawn_by_their_light(both: Scattering) -> None:
    above, below = both.reflected.albedo(45.0), both.transmitted.albedo(45.0)
    theta_r, _ = both.sample(45.0, np.linspace(0, 1, 10_001)[:-1], 0.5)
    assert np.mean(theta_r < 90) == pytest.approx(float(above / (above + below)), abs=2e-3)


def test_a_black_side_is_never_drawn(both: Scattering) -> None:
    opaque = Scattering(both.reflected, side(np.zeros((len(THETA), len(THETA), len(PHI)))))
    theta_r, _ = opaque.sample(30.0, np.linspace(0, 1, 1001)[:-1], 0.3)
    assert theta_r.max() < 90
    assert opaque.pdf(30.0, 150.0, 0.0) == 0


@pytest.mark.parametrize(
    ("theta_i", "theta_r", "says"),
    [(95.0, 0.0, "theta_i"), (30.0, 181.0, "theta_r"), (30.0, float("nan"), "theta_r"), ([1.0, 2.0], [1.0] * 3, "shape")],
)
def test_directions_that_are_none_are_refused(both: Scattering, theta_i: object, theta_r: object, says: str) -> None:
    with pytest.raises(DomainError, match=says):
        both.evaluate(theta_i, theta_r, 0.0)  # type: ignore[arg-type]


def test_light_from_below_and_bad_numbers_are_refused(both: Scattering) -> None:
    with pytest.raises(DomainError, match="turn the petal over"):
        both.sample(120.0, 0.5, 0.5)
    with pytest.raises(DomainError, match="u1"):
        both.sample(20.0, 1.0, 0.5)


def test_intensities_do_not_mix_with_transmission(both: Scattering) -> None:
    with pytest.raises(DomainError, match="1/sr"):
        Scattering(side(np.ones((len(THETA), len(THETA), len(PHI))), INTENSITY), both.transmitted)
