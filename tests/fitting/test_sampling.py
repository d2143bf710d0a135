"""Directions drawn from a reflectance: their density by quadrature and by counting, and what estimates made with them converge to."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats.qmc import Sobol

from fitting import DomainError
from fitting.cells import Cell
from fitting.reflectance import INTENSITY, PER_SR, Reflectance
from fitting.table import Grid, ReflectanceTable, paper_table, radiometric_table

THETA = np.concatenate([np.arange(0, 84.0, 4), [84, 86.5, 88.5, 90]])
PHI = np.linspace(0, 180, 25)
KINDS = ("lambert", "black", "mirror", "spot", "petal", "petal in 1/sr")
incidences = st.floats(0, 90)
below_one = st.floats(0, 1, exclude_max=True)


def one(values: Any, mode: str = PER_SR) -> Reflectance:
    table = ReflectanceTable.from_basis(
        ["it"], [np.broadcast_to(values, (len(THETA), len(THETA), len(PHI)))], nodes=(THETA, THETA, PHI), mode=mode, provenance={}
    )
    return table.mixed({"it": 1})


@pytest.fixture(scope="module")
def shades() -> dict[str, Reflectance]:
    i, r, p = np.radians(THETA)[:, None, None], np.radians(THETA)[:, None], np.radians(PHI)
    mirror = np.maximum(0, np.cos(i) * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(p))
    spot = np.zeros((len(THETA), len(THETA), len(PHI)))
    spot[:, 9, 14] = 1  # dark all round
    petal = paper_table(Cell(1.2), n_us=12, grid=Grid(theta_steps=12, phi_steps=12))
    tall = radiometric_table(Cell(1.9), n_us=12, grid=Grid(theta_steps=12, phi_steps=12))
    return {
        "lambert": one(0.8 / math.pi),
        "black": one(0.0),
        "mirror": one(42 / (2 * math.pi) * mirror**40),
        "spot": one(spot, INTENSITY),
        "petal": petal.mixed({"u_diff": 0.3, "u_spec": 0.8, "s_diff": 0.05, "s_spec": 0.2}),
        "petal in 1/sr": tall.mixed({"u_diff": 0.3, "u_spec": 0.3, "s_diff": 0.05, "s_spec": 0.1}),
    }


def quadrature(theta_edges: NDArray[np.float64], phi_edges: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Gauss-Legendre nodes over the hemisphere in deg, and solid angles."""
    x, w = np.polynomial.legendre.leggauss(4)

    def along(edges: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        half = np.diff(edges)[:, None] / 2
        return (edges[:-1, None] + half * (1 + x)).ravel(), np.radians(half * w).ravel()

    (theta, d_theta), (phi, d_phi) = along(theta_edges), along(phi_edges)
    return theta[:, None], phi, (np.sin(np.radians(theta)) * d_theta)[:, None] * d_phi


EVERYWHERE = quadrature(np.linspace(0, 90, 61), np.linspace(-180, 180, 121))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("theta_i", [0, 31.7, 60, 88, 90])
def test_the_density_is_1_over_the_hemisphere(kind: str, theta_i: float, shades: dict[str, Reflectance]) -> None:
    theta_r, phi, solid = EVERYWHERE
    density = shades[kind].pdf(theta_i, theta_r, phi)
    assert np.all(density > 0)
    assert np.sum(density * solid) == pytest.approx(1, abs=1e-9)


def test_lambert_is_drawn_by_the_cosine(shades: dict[str, Reflectance]) -> None:
    theta_r = np.array([0.0, 20, -50, 89])
    np.testing.assert_allclose(shades["lambert"].pdf(40, theta_r, 77), np.cos(np.radians(theta_r)) / math.pi, rtol=1e-5)
    u = np.linspace(0, 0.999, 50)
    np.testing.assert_allclose(shades["lambert"].sample(40, u, 0.3)[0], np.degrees(np.arcsin(np.sqrt(u))), rtol=1e-4)
    np.testing.assert_allclose(shades["black"].pdf(40, theta_r, 77), np.cos(np.radians(theta_r)) / math.pi, rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("theta_i", [0, 13.1, 31.7, 47, 60, 75, 86, 88.7, 89.9, 90])
def test_drawn_directions_are_as_dense_as_the_density_says(kind: str, theta_i: float, shades: dict[str, Reflectance]) -> None:
    """Chi-square over bins that are not the table's own."""
    count = 200_000
    theta_edges, phi_edges = np.linspace(0, 90, 14), np.linspace(-180, 180, 18)
    theta_r, phi = shades[kind].sample(theta_i, *np.random.default_rng(12).random((2, count)))
    seen = np.histogram2d(theta_r, phi, bins=(theta_edges, phi_edges))[0]
    # Quadrature on both cuts at once, so that the density is smooth between edges.
    fine_theta, fine_phi = (
        np.unique(np.concatenate([a, b])) for a, b in ((theta_edges, np.linspace(0, 90, 61)), (phi_edges, np.linspace(-180, 180, 121)))
    )
    at_theta, at_phi, solid = quadrature(fine_theta, fine_phi)
    share = shades[kind].pdf(theta_i, at_theta, at_phi) * solid
    rows, columns = np.searchsorted(theta_edges, at_theta[:, 0]) - 1, np.searchsorted(phi_edges, at_phi) - 1
    expected = np.zeros_like(seen)
    np.add.at(expected, (rows[:, None], columns), count * share)
    assert expected.sum() == pytest.approx(count, rel=1e-9)
    enough = expected > 10
    statistic = np.sum((seen - expected)[enough] ** 2 / expected[enough]) + (seen - expected)[~enough].sum() ** 2 / max(
        expected[~enough].sum(), 1
    )
    assert statistic < chi2.ppf(0.9999, enough.sum())


@pytest.mark.parametrize("kind", ["lambert", "mirror", "spot", "petal"])
@pytest.mark.parametrize("theta_i", [0, 31.7, 75])
def test_the_estimate_of_the_albedo_converges_to_the_quadrature_s(kind: str, theta_i: float, shades: dict[str, Reflectance]) -> None:
    shade = shades[kind]
    exact = float(shade.albedo(theta_i)) * (math.cos(math.radians(theta_i)) if shade.mode == INTENSITY else 1)
    off = []
    for power in (8, 12, 16):
        theta_r, phi = shade.sample(theta_i, *Sobol(2, seed=3).random(1 << power).T)
        part = shade(theta_i, theta_r, phi) * np.cos(np.radians(theta_r)) / shade.pdf(theta_i, theta_r, phi)
        off.append(abs(part.mean() / exact - 1))
        assert part.mean() == pytest.approx(exact, abs=5 * part.std() / 2 ** (power / 2) + 1e-5 * exact)
    assert off[-1] < 1e-3


def test_a_petal_is_drawn_nearly_as_it_sends_light(shades: dict[str, Reflectance]) -> None:
    """Every part weighs nearly the same: what importance sampling is for. Drawn by the cosine alone they spread several times as far."""
    shade, u = shades["petal"], np.random.default_rng(4).random((2, 100_000))
    for theta_i in (10, 60):
        theta_r, phi = shade.sample(theta_i, *u)
        part = shade(theta_i, theta_r, phi) * np.cos(np.radians(theta_r)) / shade.pdf(theta_i, theta_r, phi)
        even_r, even_phi = np.degrees(np.arcsin(np.sqrt(u[0]))), 360 * u[1]
        evenly = math.pi * shade(theta_i, even_r, even_phi)
        assert part.std() / part.mean() < 0.05
        assert evenly.std() / evenly.mean() > 5 * part.std() / part.mean()


@given(kind=st.sampled_from(KINDS), theta_i=incidences, u1=below_one, u2=below_one)
def test_whatever_is_drawn_is_a_view_with_a_density(
    kind: str, theta_i: float, u1: float, u2: float, shades: dict[str, Reflectance]
) -> None:
    theta_r, phi = shades[kind].sample(theta_i, u1, u2)
    assert 0 <= theta_r <= 90
    assert -180 <= phi <= 180
    assert shades[kind].pdf(theta_i, theta_r, phi) > 0


@given(theta_i=incidences, u=st.lists(below_one, min_size=2, max_size=2, unique=True), other=below_one)
def test_strata_stay_strata(theta_i: float, u: list[float], other: float, shades: dict[str, Reflectance]) -> None:
    low, high = sorted(u)
    theta_r, _ = shades["petal"].sample(theta_i, [low, high], other)
    assert theta_r[0] <= theta_r[1]
    _, phi = shades["petal"].sample(theta_i, other, [low, high])
    assert phi[0] <= phi[1] + 1e-9


@given(theta_i=incidences, theta_r=st.floats(0, 89), phi=st.floats(-180, 180))
def test_the_density_knows_no_left_and_right(theta_i: float, theta_r: float, phi: float, shades: dict[str, Reflectance]) -> None:
    pdf = shades["petal"].pdf
    # Off the edges between cells, where rounding may take either.
    theta_r, phi = round(theta_r) + 0.3, round(phi) + 0.3
    here = pdf(theta_i, theta_r, phi)
    for there in (pdf(theta_i, theta_r, -phi), pdf(theta_i, -theta_r, phi + 180), pdf(theta_i, theta_r, phi - 720)):
        assert there == pytest.approx(float(here), rel=1e-9)


def test_shapes_broadcast_and_many_are_drawn_as_few(shades: dict[str, Reflectance]) -> None:
    shade, u = shades["petal"], np.random.default_rng(5).random((2, 150_000))
    assert shade.sample([[10], [20]], [0.1, 0.2, 0.3], 0.5)[0].shape == (2, 3)
    assert shade.pdf([[10], [20]], [1, 2, 3], 5).shape == (2, 3)
    theta_r, phi = shade.sample(33, *u)
    again = shade.sample(33, *u[:, ::1009])
    np.testing.assert_array_equal(np.stack([theta_r, phi])[:, ::1009], again)


@pytest.mark.parametrize(
    "arguments", [(91, 0.5, 0.5), (-1, 0.5, 0.5), (math.nan, 0.5, 0.5), (30, 1.0, 0.5), (30, 0.5, -0.1), (30, 0.5, math.nan)]
)
def test_numbers_that_draw_nothing(arguments: tuple[float, float, float], shades: dict[str, Reflectance]) -> None:
    with pytest.raises(DomainError, match="draw nothing"):
        shades["lambert"].sample(*arguments)


@pytest.mark.parametrize(("arguments", "message"), [((91, 0, 0), "theta_i"), ((0, 95, 0), "theta_r"), ((0, 0, math.inf), "phi")])
def test_no_density_outside_the_table(arguments: tuple[float, float, float], message: str, shades: dict[str, Reflectance]) -> None:
    with pytest.raises(DomainError, match=message):
        shades["lambert"].pdf(*arguments)
