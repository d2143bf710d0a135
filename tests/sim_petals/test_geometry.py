"""Rays and domes against brute force."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.petals import kernels
from sim.petals.structure import CULTIVARS, Petal, check, tallest

LATTICE = np.uint64(20)
ROW = math.sqrt(3) / 2


def scene(petal: Petal) -> kernels.Scene:
    return kernels.Scene(petal, LATTICE, tallest(petal), (1.0, 0.0), np.zeros((kernels.VIEWS, 3)))


def cells_near(petal: Petal, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The four lattice points (i, j) around each point: enough, for no dome reaches further than half the pitch."""
    rows = np.floor(points[:, 1] / (petal.pitch * ROW)).astype(int)
    found = []
    for j in (rows, rows + 1):
        columns = np.floor(points[:, 0] / petal.pitch - 0.5 * j).astype(int)
        found += [(columns, j), (columns + 1, j)]
    return found


def inside(petal: Petal, points: np.ndarray, shapes: dict[tuple[int, int], tuple[float, float, float]]) -> np.ndarray:
    """Whether each point lies in the petal: under the floor or in a dome."""
    result = points[:, 2] < 0
    for i, j in cells_near(petal, points):
        height, sx, sy = np.array([shapes[cell] for cell in zip(i.tolist(), j.tolist(), strict=True)]).T
        z = points[:, 2]
        x = points[:, 0] - petal.pitch * (i + 0.5 * j) - sx * z
        y = points[:, 1] - petal.pitch * ROW * j - sy * z
        result |= (z >= 0) & ((x * x + y * y) / petal.radius**2 + (z / height) ** 2 < 1)
    return result


@pytest.mark.parametrize("name", ["BR", "WR"])
def test_rays_in_the_air_meet_what_marching_finds(name: str) -> None:
    petal = check(CULTIVARS[name])
    shapes = {(i, j): kernels.cell_shape(petal, LATTICE, i, j) for i in range(-15, 16) for j in range(-15, 16)}
    ceiling = tallest(petal)
    rng = np.random.default_rng(1)
    n, step = 200, 0.03
    starts = np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.uniform(0, ceiling, n)])
    directions = rng.normal(size=(n, 3))
    directions[::2, 2] *= ceiling / 40  # low domes need flat rays to be met from the side
    directions[1::2, :2] *= 0.1  # and the floor needs steep ones
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    free = ~inside(petal, starts, shapes)
    kinds = []
    for start, d in zip(starts[free], directions[free], strict=True):
        t = np.arange(0.0, 120.0, step)
        path = start + t[:, None] * d
        above = path[:, 2] > ceiling
        path = path[: np.argmax(above)] if above.any() else path
        meets = inside(petal, path, shapes)
        i, j = kernels.cell_at(petal, start[0], start[1])
        kind, distance, i, j = kernels.next_surface(
            scene(petal), kernels.Site(start[0], start[1], start[2], i, j, False), tuple(d.tolist())
        )
        if meets.any():
            assert distance == pytest.approx(t[np.argmax(meets)], abs=1.01 * step)
            hit = start + distance * d
            on_floor = abs(hit[2]) < 1e-9
            assert kind == (kernels.HIT_FLOOR if on_floor else kernels.HIT_DOME)
            if not on_floor:
                centre = np.array(kernels.cell_centre(petal, i, j))
                assert np.hypot(*(hit[:2] - centre)) <= petal.pitch / 2 + 1e-9
        elif above.any():
            # A sliver of a dome thinner than a step can hide from the march.
            if kind != kernels.ESCAPE:
                chord = start + (distance + np.linspace(0, step, 50)[:, None]) * d
                assert inside(petal, chord, shapes).any()
            else:
                assert (start + distance * d)[2] == pytest.approx(ceiling)
        else:
            continue
        kinds.append(kind)
    assert min(kinds.count(kind) for kind in (kernels.ESCAPE, kernels.HIT_DOME, kernels.HIT_FLOOR)) >= 5


def test_vertical_rays() -> None:
    petal = check(CULTIVARS["RR"])
    x, y = 0.0, petal.pitch / math.sqrt(3)  # where three cells meet: floor
    i, j = kernels.cell_at(petal, x, y)
    down = kernels.next_surface(scene(petal), kernels.Site(x, y, tallest(petal), i, j, False), (0.0, 0.0, -1.0))
    assert down[:2] == (kernels.HIT_FLOOR, tallest(petal))
    up = kernels.next_surface(scene(petal), kernels.Site(x, y, 0.0, i, j, False), (0.0, 0.0, 1.0))
    assert up[:2] == (kernels.ESCAPE, tallest(petal))


def test_cell_at_is_the_nearest_centre() -> None:
    petal = check(CULTIVARS["RR"])
    points = np.random.default_rng(2).uniform(-60, 60, (500, 2))
    lattice = [(i, j) for i in range(-8, 9) for j in range(-8, 9)]
    centres = np.array([kernels.cell_centre(petal, i, j) for i, j in lattice])
    nearest = np.argmin(((points[:, None] - centres) ** 2).sum(axis=2), axis=1)
    assert [kernels.cell_at(petal, x, y) for x, y in points.tolist()] == [lattice[k] for k in nearest]


unit = st.floats(-1, 1)


@settings(deadline=None)  # the first call compiles
@given(start=st.tuples(unit, unit, unit), aim=st.tuples(unit, unit, unit), height=st.floats(2, 40), shear=st.tuples(unit, unit))
def test_roots_lie_on_the_dome_and_the_normal_is_its_gradient(
    start: tuple[float, ...], aim: tuple[float, ...], height: float, shear: tuple[float, float]
) -> None:
    radius = 9.6
    shape = (height, 0.1 * shear[0], 0.1 * shear[1])

    def level(point: np.ndarray) -> float:
        x, y, z = point
        return ((x - shape[1] * z) ** 2 + (y - shape[2] * z) ** 2) / radius**2 + (z / height) ** 2

    origin = np.array([3 * radius * start[0], 3 * radius * start[1], 3 * height + start[2]])
    target = np.array([0.6 * radius * aim[0], 0.6 * radius * aim[1], 0.3 * height * aim[2]])  # in the dome: the ray does meet it
    d = (target - origin) / np.linalg.norm(target - origin)
    near, far = kernels.dome_roots(*origin.tolist(), *d.tolist(), radius, shape)
    assert 0 < near < far
    for t in (near, far):
        point = origin + t * d
        assert level(point) == pytest.approx(1, abs=1e-7)
        normal = np.array(kernels.dome_normal(*point.tolist(), radius, shape))
        h = 1e-5
        gradient = np.array([(level(point + h * e) - level(point - h * e)) / (2 * h) for e in np.eye(3)])
        assert normal == pytest.approx(gradient / np.linalg.norm(gradient), abs=1e-6)


def test_a_cell_keeps_its_shape_and_shapes_spread_as_told() -> None:
    petal = check(Petal(height=20.0, height_spread=0.2, lean=3.0, radius=9.6))
    cells = [(i, j) for i in range(-40, 40) for j in range(-40, 40)]
    shapes = np.array([kernels.cell_shape(petal, LATTICE, i, j) for i, j in cells])
    assert kernels.cell_shape(petal, LATTICE, -3, 17) == tuple(shapes[cells.index((-3, 17))])
    heights = shapes[:, 0]
    assert heights.min() >= 16
    assert heights.max() <= 24
    assert heights.mean() == pytest.approx(20, abs=5 * 8 / math.sqrt(12 * len(cells)))
    assert heights.std() == pytest.approx(8 / math.sqrt(12), rel=0.05)
    lean = np.hypot(shapes[:, 1], shapes[:, 2])
    assert lean.max() <= math.tan(math.radians(3.0))
    assert (lean**2).mean() == pytest.approx(math.tan(math.radians(3.0)) ** 2 / 2, rel=0.05)  # uniform over a disk
    assert abs(np.corrcoef(heights[:-1], heights[1:])[0, 1]) < 5 / math.sqrt(len(cells))
    other = np.array([kernels.cell_shape(petal, np.uint64(21), i, j)[0] for i, j in cells])
    assert abs(np.corrcoef(heights, other)[0, 1]) < 5 / math.sqrt(len(cells))
