"""Interreflection: nothing is lost, light and view may be swapped, and photons on a patch of triangles do the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fitting.cells import Cell, Spread
from fitting.errors import DomainError
from fitting.orders import EscapeOrders, escape_orders
from tests.fitting.test_mesh import dome

EVEN = np.arange(0, 181, 5.0)
U, W = np.polynomial.legendre.leggauss(24)
U, W = (U + 1) / 2, W / 2
HEMISPHERE = np.degrees(np.arccos(U))


def over_hemisphere(f_r: np.ndarray) -> np.ndarray:
    """Integrate (..., r, p) at HEMISPHERE and EVEN times cos(theta_r) over the hemisphere."""
    return np.asarray(2 * np.pi * np.trapezoid(f_r, EVEN, axis=-1) / 180 @ (W * U))


@pytest.fixture(scope="module")
def traced() -> EscapeOrders:
    return escape_orders(Cell(1.0, p=1.5, q=1.2, gap=0.3), [0, 45, 75], HEMISPHERE, EVEN, rays=1024)


@pytest.mark.slow
def test_a_white_furnace_is_white(traced: EscapeOrders) -> None:
    np.testing.assert_allclose(over_hemisphere(traced.reflectance(1.0)), 1, atol=1e-9)
    assert traced.closure < 0.05  # at 0.1 deg above the horizon
    assert traced.unclosed < 0.05


@pytest.mark.slow
def test_every_order_is_fainter_over_the_hemisphere_and_none_is_negative(traced: EscapeOrders) -> None:
    albedos = over_hemisphere(traced.orders)
    assert np.all(np.diff(albedos, axis=0) < 0)
    assert traced.orders.min() >= 0
    assert np.all((traced.decay > 0) & (traced.decay < 1))


@pytest.mark.slow
def test_an_albedo_is_a_sum_and_what_is_absorbed_grows_with_darkness(traced: EscapeOrders) -> None:
    total = [float(over_hemisphere(traced.reflectance(a))[1]) for a in (0.0, 0.2, 0.5, 0.8, 1.0)]
    assert total[0] == 0
    assert np.all(np.diff(total) > 0)


@pytest.mark.slow
def test_later_orders_together_are_what_they_are_one_by_one() -> None:
    few, many = (escape_orders(Cell(1.9), [45], [0, 30, 60], [0, 90, 180], orders=n, rings=8, sectors=18, rays=256) for n in (6, 40))
    for albedo in (0.5, 0.9, 0.99, 1.0):
        np.testing.assert_allclose(few.reflectance(albedo), many.reflectance(albedo), rtol=0.001 if albedo in (0.5, 1.0) else 0.02)


@pytest.mark.slow
def test_light_and_view_may_be_swapped() -> None:
    nodes = [0.0, 20, 50, 80]
    found = escape_orders(Cell(1.9), nodes, nodes, [0, 30, 90, 180], rays=256)
    np.testing.assert_allclose(found.orders, found.orders.transpose(0, 2, 1, 3), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.rest, found.rest.transpose(1, 0, 2), rtol=1e-9)


@pytest.mark.slow
def test_nearly_flat_domes_reflect_once() -> None:
    found = escape_orders(Cell(0.005), [0, 30], [10, 40], [0, 90], rays=256)
    np.testing.assert_allclose(found.orders[0], 1 / np.pi, rtol=0.01)
    assert found.orders[1:].max() < 0.01 / np.pi


@pytest.mark.slow
def test_facets_are_fine_enough() -> None:
    nodes, azimuths = [0.0, 30, 60], np.arange(0, 181, 15.0)
    rough, usual, fine = (
        escape_orders(Cell(1.9), nodes, nodes, azimuths, rings=n, sectors=s, rays=r).reflectance(0.8)
        for n, s, r in ((7, 18, 1024), (14, 36, 2048), (21, 72, 2048))
    )
    error = np.abs(usual / fine - 1).max()
    assert error < 0.02
    assert error < np.abs(rough / fine - 1).max()


def photons(height: float, theta_i: float, count: int, bounces: int, rng: np.random.Generator) -> list[np.ndarray]:
    """cos(theta_r) of light that leaves a patch of triangulated domes, by bounces; white Lambert facets."""
    o3d: Any = pytest.importorskip("open3d", reason="Open3D needs libusb-1.0-0 on Debian", exc_type=ImportError)
    scene = o3d.t.geometry.RaycastingScene()
    vertices, triangles = dome(height, 96, 48)
    reach = 14
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            centre = np.array([2 * i + j, np.sqrt(3) * j, 0])
            if np.hypot(*centre[:2]) < 2 * reach:
                scene.add_triangles((vertices + centre).astype(np.float32), triangles.astype(np.uint32))
    side = 200.0
    floor = np.array([[-side, -side, 0], [side, -side, 0], [side, side, 0], [-side, side, 0]], np.float32)
    scene.add_triangles(floor, np.array([[0, 1, 2], [0, 2, 3]], np.uint32))
    # Any parallelogram of the two lattice vectors is a period.
    u, v = rng.random((2, count))
    p = np.column_stack([2 * u + v, np.sqrt(3) * v, np.zeros(count)])
    sine, turn = np.sin(np.radians(theta_i)), 2 * np.pi * rng.random(count)
    d = -np.column_stack([sine * np.cos(turn), sine * np.sin(turn), np.full(count, np.cos(np.radians(theta_i)))])
    p -= d * (1.01 * height / np.cos(np.radians(theta_i)))
    left = []
    for _ in range(bounces + 1):
        hit = scene.cast_rays(np.column_stack([p, d]).astype(np.float32))
        t, normal = hit["t_hit"].numpy(), hit["primitive_normals"].numpy().astype(float)
        gone = ~np.isfinite(t)
        left.append(d[gone, 2])
        p, d, normal, t = p[~gone], d[~gone], normal[~gone], t[~gone]
        normal *= -np.sign(np.einsum("ij,ij->i", normal, d))[:, None]
        p = p + t[:, None] * d + 1e-4 * normal
        # Lambert: the normal and a point of the sphere.
        z, a = rng.uniform(-1, 1, len(p)), 2 * np.pi * rng.random(len(p))
        ring = np.sqrt(1 - z * z)
        d = normal + np.column_stack([ring * np.cos(a), ring * np.sin(a), z])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
    return left[1:]


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_photons_on_a_patch_leave_as_often_after_each_bounce(aspect: float) -> None:
    count, bounces = 80_000, 3
    found = escape_orders(Cell(aspect), [50], HEMISPHERE, EVEN)
    edges = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    for k, cosines in enumerate(photons(2 * aspect, 50, count, bounces, np.random.default_rng(3))):
        around = 2 * np.pi * np.trapezoid(found.orders[k, 0], EVEN, axis=1) / 180 * U
        # Shares by cosine: the integrand is smooth, its integral taken by interpolating the running sum.
        fine = np.linspace(0, 1, 2001)
        running = np.concatenate([[0.0], np.cumsum(np.interp((fine[1:] + fine[:-1]) / 2, U, around)) / 2000])
        expected = np.diff(np.interp(edges, fine, running))
        counted = np.histogram(cosines, edges)[0] / count
        sd = np.sqrt(expected / count)
        np.testing.assert_array_less(np.abs(counted - expected), 4 * sd + 0.02 * expected + 2e-4)


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
    made = EscapeOrders(Cell(), one, one, one, np.ones((2, 1, 1, 1)), np.ones((1, 1, 1)), np.full((1, 1, 1), 0.5), 0.0, 0.0, 0)
    assert made.reflectance(0.5)[0, 0, 0] == pytest.approx(0.5 + 0.25 + 0.125 * 0.5 / 0.75)
    with pytest.raises(DomainError, match="within 0 and 1"):
        made.reflectance(1.1)
