"""Interreflection: nothing is lost, light and view may be swapped, and photons shot one by one do the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fitting.cells import Cell, Spread
from fitting.errors import DomainError
from fitting.orders import EscapeOrders, escape_orders
from fitting.radiometric import Sampling
from tests.fitting.photons import bounce

EVEN = np.arange(0, 181, 5.0)
U, W = np.polynomial.legendre.leggauss(24)
U, W = (U + 1) / 2, W / 2
HEMISPHERE = np.degrees(np.arccos(U))

QUICK = Sampling(1600, 16)
"""Where it does not matter how exactly single bounce is integrated."""


def over_hemisphere(f_r: np.ndarray) -> np.ndarray:
    """Integrate (..., r, p) at HEMISPHERE and EVEN times cos(theta_r) over the hemisphere."""
    return np.asarray(2 * np.pi * np.trapezoid(f_r, EVEN, axis=-1) / 180 @ (W * U))


@pytest.fixture(scope="module")
def traced() -> EscapeOrders:
    return escape_orders(
        Cell(1.0, p=1.5, q=1.2, gap=0.3), [0, 45, 75, 89.8], HEMISPHERE, EVEN, rings=8, sectors=18, rays=1024, sampling=QUICK
    )


@pytest.mark.slow
def test_a_white_furnace_is_white(traced: EscapeOrders) -> None:
    np.testing.assert_allclose(over_hemisphere(traced.reflectance(1.0)), 1, atol=1e-9)
    assert traced.closure < 0.05  # at 0.1 deg above the horizon
    assert traced.unclosed < 0.05


@pytest.mark.slow
def test_every_order_is_fainter_over_the_hemisphere_and_none_is_negative(traced: EscapeOrders) -> None:
    albedos = over_hemisphere(traced.bases[:-1])
    assert np.all(np.diff(albedos, axis=0) < 0)
    assert traced.bases.min() >= 0
    assert 0 < traced.decay < 1


@pytest.mark.slow
def test_an_albedo_is_a_sum_and_what_is_absorbed_grows_with_darkness(traced: EscapeOrders) -> None:
    total = [float(over_hemisphere(traced.reflectance(a))[1]) for a in (0.0, 0.2, 0.5, 0.8, 1.0)]
    assert total[0] == 0
    assert np.all(np.diff(total) > 0)


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [1.9, 3.0])
def test_later_orders_together_are_what_they_are_one_by_one(aspect: float) -> None:
    """In all directions within 0.3 % of the mean over the hemisphere: as many orders as are usual against twice as many and more."""
    rough: dict[str, Any] = {"rings": 8, "sectors": 18, "rays": 256, "sampling": QUICK}
    usual, many = (escape_orders(Cell(aspect), [0, 45, 80], HEMISPHERE, [0, 90, 180], **n, **rough) for n in ({}, {"orders": 120}))
    np.testing.assert_allclose(usual.reflectance(1.0), many.reflectance(1.0), rtol=1e-9)
    for albedo in (0.2, 0.5, 0.8, 0.95):
        exact = many.reflectance(albedo)
        mean = exact.mean(2) @ W
        assert np.abs(usual.reflectance(albedo) - exact).max() <= 0.003 * mean.min()


@pytest.mark.slow
def test_threads_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    few: dict[str, Any] = {"orders": 4, "rings": 6, "sectors": 12, "rays": 256, "sampling": QUICK}
    for cores in (1, 5):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found.append(escape_orders(Cell(1.9, gap=0.1), [0, 60], [10, 70], [0, 90], **few).bases)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)  # sums over facets may be taken in another order


@pytest.mark.slow
def test_light_and_view_may_be_swapped() -> None:
    nodes = [0.0, 20, 50, 80]
    found = escape_orders(Cell(1.9), nodes, nodes, [0, 30, 90, 180], rays=256, sampling=QUICK)
    np.testing.assert_allclose(found.bases, found.bases.transpose(0, 2, 1, 3), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_nearly_flat_domes_reflect_once() -> None:
    found = escape_orders(Cell(0.005), [0, 30], [10, 40], [0, 90], rings=8, sectors=18, rays=256, sampling=QUICK)
    np.testing.assert_allclose(found.bases[0], 1 / np.pi, rtol=0.01)
    assert found.bases[1:].max() < 0.01 / np.pi


@pytest.mark.slow
def test_facets_are_fine_enough() -> None:
    nodes, azimuths = [0.0, 30, 60], np.arange(0, 181, 30.0)
    rough, usual, fine = (
        escape_orders(Cell(1.9), nodes, nodes, azimuths, orders=8, rings=n, sectors=s, rays=r, sampling=QUICK).reflectance(0.8)
        for n, s, r in ((7, 18, 512), (14, 36, 1024), (20, 54, 1024))
    )
    error = np.abs(usual / fine - 1).max()
    assert error < 0.02
    assert error < np.abs(rough / fine - 1).max()


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "theta_i"), [(Cell(0.5), 50.0), (Cell(1.9), 50.0), (Cell(1.0, gap=0.2), 80.0)])
def test_photons_leave_as_often_after_each_bounce_and_as_far_round(cell: Cell, theta_i: float) -> None:
    count, bounces = 400_000, 6
    found = escape_orders(cell, [theta_i], HEMISPHERE, EVEN, orders=bounces, rays=1024)
    orders, ways = bounce(theta_i, count, cell.stretch, cell.pitch, bounces, 3)
    cosines, phi = ways[:, 0], np.degrees(np.abs((ways[:, 1] + np.pi) % (2 * np.pi) - np.pi))
    edges, turns = np.array([0.0, 0.25, 0.5, 0.75, 1.0]), np.array([0, 60, 120, 180])
    for k in range(bounces):
        # Shares by cosine and azimuth: the integrand is smooth, its integral taken by interpolating running sums.
        values = found.bases[k, 0] * U[:, None]
        round_ = np.concatenate([np.zeros((24, 1)), np.cumsum((values[:, 1:] + values[:, :-1]) / 2, axis=1)], axis=1) * np.radians(5) * 2
        fine = np.linspace(0, 1, 2001)
        expected = []
        for turn in turns:
            dense = np.interp((fine[1:] + fine[:-1]) / 2, U, round_[:, turn == EVEN][:, 0])
            expected.append(np.interp(edges, fine, np.concatenate([[0.0], np.cumsum(dense) / 2000])))
        shares = np.diff(np.diff(np.array(expected), axis=0), axis=1).T
        some = orders == k + 1
        counted = np.histogram2d(cosines[some], phi[some], [edges, turns])[0] / count
        np.testing.assert_array_less(np.abs(counted - shares), 4 * np.sqrt(shares / count) + 0.02 * shares + 1e-4)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"phi_deg": [0, 7]}, "steps of 5 deg"),
        ({"theta_i_deg": [90]}, "theta_i must be"),
        ({"theta_r_deg": [-5]}, "theta_r must be"),
        ({"cell": Cell(gap=0.2, spread=Spread(place=0.1))}, "all alike"),
        ({"rays": 1000}, "power of 2"),
        ({"sectors": 20}, "multiple of 6"),
        ({"orders": 0}, "1 order"),
    ],
)
def test_what_cannot_be_traced_is_refused(changes: dict[str, Any], problem: str) -> None:
    asked = {"cell": Cell(), "theta_i_deg": [0], "theta_r_deg": [0], "phi_deg": [0]} | changes
    with pytest.raises(DomainError, match=problem):
        escape_orders(asked.pop("cell"), **asked)


def test_an_albedo_is_a_share() -> None:
    one = np.ones(1)
    made = EscapeOrders(Cell(), one, one, one, np.array([1.0, 2, 5]).reshape(3, 1, 1, 1), 0.5, 0.0, 0.0, 0)
    np.testing.assert_allclose(made.weights(0.5), [0.5, 0.25, 0.125 * 0.5 / 0.75])
    np.testing.assert_array_equal(made.weights(1.0), 1)
    np.testing.assert_array_equal(made.weights(0.0), 0)
    assert made.reflectance(0.5)[0, 0, 0] == pytest.approx(0.5 + 2 * 0.25 + 5 * 0.125 * 0.5 / 0.75)
    with pytest.raises(DomainError, match="within 0 and 1"):
        made.reflectance(1.1)
