"""Triangulation on the grid: known areas, manifold whatever is missing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanning.clean import clean
from scanning.errors import EmptyScanError
from scanning.mesh import area, area_vectors, boundary_loops, loop_length, vertex_areas, vertex_normals
from scanning.rangeimage import RangeImage
from scanning.triangulate import triangulate
from tests.scanning.surfaces import STEP, Array, scan, with_depths


def test_plane() -> None:
    mesh = triangulate(scan(lambda x, y: 0.5 * x, size=20), 10.0)
    assert len(mesh.triangles) == 2 * 19**2
    side = 19 * STEP
    assert area(mesh) == pytest.approx(side**2 * np.sqrt(1.25))
    assert vertex_areas(mesh).sum() == pytest.approx(area(mesh))
    np.testing.assert_allclose(vertex_normals(mesh), np.tile(np.array([-0.5, 0, 1]) / np.sqrt(1.25), (400, 1)), atol=1e-12)
    (rim,) = boundary_loops(mesh.triangles)
    assert len(rim) == 4 * 19
    assert loop_length(mesh.vertices, rim) == pytest.approx(2 * side * (1 + np.sqrt(1.25)))


def test_cap_of_a_sphere() -> None:
    radius, rim = 25.0, 15.0
    mesh = triangulate(scan(lambda x, y: np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)), lambda x, y: x**2 + y**2 < rim**2), 3.0)
    height = radius - np.sqrt(radius**2 - rim**2)
    # The staircase of the grid takes half a step off all round.
    assert area(mesh) == pytest.approx(2 * np.pi * radius * height, rel=0.035)
    np.testing.assert_allclose(vertex_normals(mesh), mesh.vertices / radius, atol=0.03)


@pytest.mark.parametrize("flip", [(False, False), (True, False), (False, True), (True, True)])
def test_normals_look_at_the_sensor_however_the_grid_runs(flip: tuple[bool, bool]) -> None:
    image = scan(lambda x, y: 0.3 * x + 0.1 * y**2, size=30)
    points, valid = image.points, image.valid
    for axis in (0, 1):
        if flip[axis]:
            points, valid = np.flip(points, axis), np.flip(valid, axis)
    mesh = triangulate(RangeImage(np.ascontiguousarray(points), np.ascontiguousarray(valid)), 3.0)
    assert (area_vectors(mesh)[:, 2] > 0).all()


def test_the_shorter_diagonal() -> None:
    for raised in range(4):
        z = np.where(np.arange(4) == raised, 1.0, 0.0).reshape(2, 2)
        x, y = np.meshgrid([0.0, 1.0], [1.0, 0.0])
        mesh = triangulate(RangeImage(np.stack([x, y, z], axis=-1), np.ones((2, 2), dtype=bool)), 5.0)
        shared = {int(v) for v in np.intersect1d(*mesh.triangles)}
        assert shared == ({1, 2} if raised in (0, 3) else {0, 3})


def test_no_triangle_crosses_a_jump() -> None:
    image = scan(lambda x, y: np.where(x > 3, 5.0, 0.0), size=40)
    mesh = triangulate(image, 2.0)
    assert np.ptp(mesh.vertices[mesh.triangles][..., 2], axis=1).max() == 0
    assert mesh.vertices[:, 0].max() < 3  # the larger part only: one sheet


@settings(deadline=None, max_examples=200)
@given(st.integers(0, 2**32 - 1), st.integers(3, 14), st.floats(0.3, 1.0), st.floats(0.1, 3.0))
def test_always_one_manifold_sheet(seed: int, size: int, filled: float, bumpy: float) -> None:
    rng = np.random.default_rng(seed)
    image = scan(lambda x, y: bumpy * rng.standard_normal(x.shape), lambda x, y: rng.random(x.shape) < filled, size=size)
    jump = 2.0
    try:
        mesh = triangulate(image, jump)
    except EmptyScanError:
        return
    assert np.array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))
    assert np.ptp(mesh.vertices[mesh.triangles][..., 2], axis=1).max() <= jump
    loops = boundary_loops(mesh.triangles)  # raises where an edge is used twice or borders touch
    edges = np.unique(
        np.sort(np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]]), axis=1), axis=0
    )
    # A disc with holes: one sheet in the plane.
    assert len(mesh.vertices) - len(edges) + len(mesh.triangles) == 2 - len(loops)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.6), st.floats(6.0, 14.0))
def test_a_manifold_without_overturned_triangles_whatever_is_mixed(seed: int, share: float, reach: float) -> None:
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 0.4, 3)

    def inside(x: Array, y: Array) -> NDArray[np.bool_]:
        angle = np.arctan2(y, x)
        return np.asarray(np.hypot(x, y) < reach + sum(wave * np.cos((2 + k) * angle) for k, wave in enumerate(waves)))

    image = scan(lambda x, y: 0.01 * x**2, inside, size=100, noise=0.03)
    valid = image.valid
    rim = valid & ~(np.roll(valid, 1, 0) & np.roll(valid, -1, 0) & np.roll(valid, 1, 1) & np.roll(valid, -1, 1))
    changes = np.where(rim & (rng.random(valid.shape) < share), -rng.uniform(0.5, 12.0, valid.shape), 0.0)
    cleaned = clean(with_depths(image, changes))
    mesh = triangulate(cleaned.image, cleaned.jump)
    boundary_loops(mesh.triangles)
    assert area_vectors(mesh)[:, 2].min() > 0.02 * STEP**2


def test_touching_borders_are_no_manifold() -> None:
    with pytest.raises(ValueError, match="touch"):
        boundary_loops(np.array([[0, 1, 2], [0, 3, 4]], dtype=np.int32))
    with pytest.raises(ValueError, match="twice"):
        boundary_loops(np.array([[0, 1, 2], [0, 1, 3]], dtype=np.int32))
