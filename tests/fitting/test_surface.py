"""Cells, and what each point of them sees: horizons against rays marched through an explicit patch, and sums that must close."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting.cells import CELL_AREA, Cell, Spread
from fitting.errors import DomainError
from fitting.surface import LEAST_SLOPE, Surface, floor_share, horizons, shape_of, steepest, steepest_leaning, surface, tangent

SHAPES = [Cell(), Cell(1.9), Cell(0.6, 1.2, 1.6, 0.1), Cell(1.2, 3.5, 1.0, 0.05), Cell(1.0, 1.0, 1.0, 0.3)]
SPREADS = [
    Cell(1.9, gap=0.25, spread=Spread(height=0.3, tilt=5, place=0.05, seed=3, cells=3)),
    Cell(0.8, 1.5, 1.4, gap=0.4, spread=Spread(height=0.2, tilt=12, place=0.1, seed=5, cells=2)),
    Cell(0.7, 2.5, 1.5, gap=0.1, spread=Spread(height=0.4, place=0.1, seed=1, cells=2)),
]
exponents = st.floats(1, 5)


def height_over(cell: Cell, x: np.ndarray, y: np.ndarray, z: np.ndarray, skip: tuple[int, int] | None, reach: int) -> np.ndarray:
    """How far points lie inside the domes of an explicit patch (1 at an axis, 0 at a surface, below 0 outside), the largest of all."""
    domes = cell.domes()
    cells = math.isqrt(len(domes))
    inside = np.full(x.shape, -np.inf)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            dx, dy, h, tx, ty = domes[(i % cells) * cells + j % cells]
            cx, cy = cell.pitch * (i + j / 2) + dx, cell.pitch * math.sqrt(3) / 2 * j + dy
            from_line = abs((cx - x[0]) * (y[-1] - y[0]) - (cy - y[0]) * (x[-1] - x[0])) / max(1e-12, np.hypot(x[-1] - x[0], y[-1] - y[0]))
            if (i, j) == skip or (from_line > 2.5 and np.hypot(cx - x[0], cy - y[0]) > 2.5):
                continue
            r = np.hypot(x - cx - z * tx, y - cy - z * ty)
            with np.errstate(invalid="ignore"):
                inside = np.fmax(inside, np.where(z <= h, 1 - r**cell.p - (z / h) ** cell.q, -np.inf))
    return inside


def marched(cell: Cell, point: np.ndarray, psi: float, slope: float, skip: tuple[int, int] | None, reach: int) -> bool:
    """Whether a ray from a point meets a dome, by small steps."""
    top = float(cell.domes()[:, 2].max())
    length = min((top - point[2]) / max(slope, 1e-6), (reach - 3) * cell.pitch * 0.86)
    s = np.linspace(1e-9, max(length, 1e-9), 3000)
    z = point[2] + s * slope
    return bool(np.any(height_over(cell, point[0] + s * math.cos(psi), point[1] + s * math.sin(psi), z, skip, reach) > 0))


@pytest.mark.slow
@pytest.mark.parametrize("cell", SHAPES + SPREADS, ids=str)
def test_the_horizon_is_where_marched_rays_begin_to_pass(cell: Cell) -> None:
    rng = np.random.default_rng(8)
    patch = surface(cell, 7, 9, 1)
    cells = 1 if cell.spread.is_none else cell.spread.cells
    reach = 12
    tested = 0
    for n in rng.choice(len(patch.points), 40):
        point, psi = patch.points[n], rng.uniform(0, 2 * np.pi)
        site = None
        if not patch.is_floor[n]:
            number = n // (7 * 9)
            site = (number // cells, number % cells)
        place = np.array([0.0, 0.0, 0.0])
        if site:
            place[:2] = cell.pitch * np.array([site[0] + site[1] / 2, math.sqrt(3) / 2 * site[1]])
        own = np.array([0 if site is None else n // 63])
        seen = horizons((point - place)[None], own, site is not None, np.array([psi]), cell.domes(), shape_of(cell))[0, 0]
        if math.isinf(seen):
            assert marched(cell, point, psi, 1e4, site, reach)
            continue
        if seen < 0.15:  # the patch of the test ends before such rays rise above it
            continue
        tested += 1
        assert not marched(cell, point, psi, seen * 1.002 + 1e-4, site, reach)
        assert marched(cell, point, psi, seen * 0.99 - 1e-3, site, reach)
    assert tested >= 6


@given(z=st.floats(0, 3), ahead=st.floats(1.001, 9), off=st.floats(-0.99, 0.99), h=st.floats(0.1, 4))
def test_newton_finds_the_closed_form(z: float, ahead: float, off: float, h: float) -> None:
    exact = tangent(z, ahead, off, h, 0.0, 0.0)
    assert steepest(z, ahead, off, h, 2.0, 2.0) == pytest.approx(exact, rel=1e-7, abs=1e-9)


@given(z=st.floats(0, 3), ahead=st.floats(1.001, 9), off=st.floats(-0.99, 0.99), h=st.floats(0.1, 4), p=exponents, q=exponents)
def test_newton_finds_the_steepest_of_many_points(z: float, ahead: float, off: float, h: float, p: float, q: float) -> None:
    x = math.sqrt(1 - off * off) * np.cos(np.linspace(0, np.pi, 40001))
    cut = h * np.clip(1 - np.hypot(x, off) ** p, 0, None) ** (1 / q)
    expected = max(0.0, float(np.max((cut - z) / (ahead + x))))
    found = steepest(z, ahead, off, h, p, q)
    assert found == pytest.approx(expected, rel=2e-4, abs=1e-6)
    assert found >= expected * (1 - 1e-9) - 1e-12


@given(
    z=st.floats(0, 2),
    ahead=st.floats(1.6, 9),
    off=st.floats(-0.9, 0.9),
    h=st.floats(0.3, 3),
    lean=st.floats(0, 0.15),
    way=st.floats(0, 6.3),
)
def test_leaning_ellipsoids_two_ways(z: float, ahead: float, off: float, h: float, lean: float, way: float) -> None:
    along, across = lean * math.cos(way), lean * math.sin(way)
    exact = tangent(z, ahead, off, h, along, across)
    assert steepest_leaning(z, ahead, off, h, along, across, 2.0, 2.0) == pytest.approx(exact, rel=1e-5, abs=1e-5)
    upright = steepest_leaning(z, ahead, off, h, 0.0, 0.0, 2.0, 2.0)
    assert upright == pytest.approx(steepest(z, ahead, off, h, 2.0, 2.0), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("cell", SHAPES + SPREADS, ids=str)
def test_the_surface_closes(cell: Cell) -> None:
    """What it shows to any direction, signs included, is the flat patch: areas times normals add up to (0, 0, 1)."""
    patch = surface(cell, 12, 18, 4)
    closed = (patch.areas[:, None] * patch.normals).sum(axis=0)
    # Leaning domes close exactly too; what is left is the sum over the columns of different domes.
    np.testing.assert_allclose(closed, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(patch.normals, axis=1), 1, rtol=1e-12)
    assert patch.areas[patch.is_floor].sum() == pytest.approx(floor_share(cell), rel=1e-12)
    assert np.all(patch.horizon >= 0)
    assert patch.horizon.dtype == np.float32


@pytest.mark.parametrize(("cell", "expected"), [(Cell(), 2 * math.pi), (Cell(1.0, 1.0, 1.0), math.pi * math.sqrt(5))])
def test_areas_of_hemisphere_and_cone(cell: Cell, expected: float) -> None:
    patch = surface(cell, 60, 120, 1)
    assert patch.areas[~patch.is_floor].sum() * cell.cell_area == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("cell", SHAPES, ids=str)
def test_points_lie_on_the_dome_and_normals_across_it(cell: Cell) -> None:
    patch = surface(cell, 300, 48, 1)
    x, y, z = patch.points[~patch.is_floor].T
    r = np.hypot(x, y)
    np.testing.assert_allclose(z, cell.profile(r), atol=1e-12)
    middle = (r > 0.1) & (r < 0.95)
    steep = cell.slope(r[middle])
    normals = patch.normals[~patch.is_floor][middle]
    upright = -steep / np.sqrt(1 + steep**2)
    np.testing.assert_allclose(np.hypot(normals[:, 0], normals[:, 1]), upright, atol=0.012)


@pytest.mark.parametrize("cell", SHAPES, ids=str)
def test_the_slope_is_the_profiles(cell: Cell) -> None:
    r = np.linspace(0.05, 0.9, 30)
    np.testing.assert_allclose(cell.slope(r), (cell.profile(r + 1e-6) - cell.profile(r - 1e-6)) / 2e-6, rtol=1e-5)
    assert cell.profile(0.0) == pytest.approx(2 * cell.aspect)
    assert cell.profile(1.0) == cell.profile(1.3) == 0


def test_horizons_repeat_with_the_lattice() -> None:
    """Sixty degrees on, the cell is the same: a point turned with it sees the same."""
    patch = surface(Cell(1.9), 6, 12, 12)
    domes = ~patch.is_floor
    seen = patch.horizon[domes].reshape(6, 12, 12)
    np.testing.assert_allclose(np.roll(seen, (2, 2), axis=(1, 2)), seen, rtol=1e-5, atol=2 * LEAST_SLOPE)


def test_far_domes_sink_to_the_horizon() -> None:
    patch = surface(Cell(0.5, gap=30), 5, 6, 6)
    assert patch.horizon[~patch.is_floor].max() <= 1 / 60
    assert patch.areas[patch.is_floor].sum() > 0.99


def test_spread_is_seeded_and_bounded() -> None:
    cell = SPREADS[0]
    domes = cell.domes()
    assert domes.shape == (9, 5)
    np.testing.assert_array_equal(domes, cell.domes())
    assert np.hypot(*domes[:, :2].T).max() <= 0.05
    assert np.all(np.abs(domes[:, 2] / cell.stretch - 1) <= 0.3)
    assert np.hypot(*domes[:, 3:].T).max() <= math.tan(math.radians(5))
    assert isinstance(surface(cell, 3, 6, 2), Surface)
    assert Cell(1.9).cell_area == pytest.approx(CELL_AREA)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"aspect": 0}, "aspect"),
        ({"aspect": math.nan}, "aspect"),
        ({"p": 0.9}, "not convex"),
        ({"q": math.nan}, "not convex"),
        ({"gap": -0.1}, "gap"),
        ({"gap": math.inf}, "gap"),
        ({"spread": Spread(place=0.1)}, r"gap of 0\.1 or more"),
        ({"spread": Spread(tilt=5)}, "run into one another"),
    ],
)
def test_cells_outside_the_family(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(DomainError, match=message):
        Cell(**settings)


@pytest.mark.parametrize("settings", [{"height": 1.0}, {"tilt": -1}, {"place": math.nan}, {"cells": 0}, {"seed": -1}])
def test_spreads_outside_the_model(settings: dict[str, Any]) -> None:
    with pytest.raises(DomainError, match="outside the model"):
        Spread(**settings)


def test_a_surface_needs_points() -> None:
    with pytest.raises(DomainError, match="3 columns"):
        surface(Cell(), 3, 2, 4)
