"""Pictures against closed forms: Lambert sphere and plane, shadows, fall-off, both faces, angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fitting.cells import Cell
from fitting.table import Grid, paper_table
from render import Camera, DistantLight, Lambert, Mesh, NearLight, Raycaster, RenderError, Scene

from .conftest import sheet

Array = NDArray[np.float64]
MATT = Lambert(0.8)


def pixel_directions(camera: Camera) -> Array:
    """Unit vectors from the eye through the pixels' centres, in the scene's frame; shape (h, w, 3)."""
    left, right, bottom, top = camera.window
    x = left + (right - left) * (np.arange(camera.width) + 0.5) / camera.width
    y = top - (top - bottom) * (np.arange(camera.height) + 0.5) / camera.height
    local = np.stack([*np.meshgrid(x, y), np.full((camera.height, camera.width), -1.0)], axis=-1)
    world = local @ camera.axes.T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


@pytest.mark.parametrize("phase", [0, 40, 90, 130])
def test_lambert_sphere_gives_the_phase_function(ball: Raycaster, phase: float) -> None:
    """Seen from afar, mean radiance over the disc is 2 albedo / (3 pi^2) (sin a + (pi - a) cos a)."""
    a = math.radians(phase)
    camera = Camera.look_at((0, -30000, 0), (0, 0, 0), fov=math.degrees(2 * math.atan(11 / 30000)), width=300, height=300)
    picture = ball.picture(camera, MATT, light=DistantLight((math.sin(a), 0, math.cos(a))), samples=4)
    mean = picture.radiance.sum(dtype=float) / picture.coverage.sum(dtype=float)
    assert mean == pytest.approx(2 * 0.8 / (3 * math.pi**2) * (math.sin(a) + (math.pi - a) * math.cos(a)), rel=5e-3)


def test_lambert_sphere_pixel_by_pixel(ball: Raycaster) -> None:
    camera = Camera.look_at((30, -20, 15), (0, 0, 0), fov=40, width=160, height=120)
    light = DistantLight((1, 1, 1), intensity=2.5)
    picture = ball.picture(camera, MATT, light=light, samples=1)
    direction = pixel_directions(camera)
    b = direction @ camera.eye
    inside = b * b - (camera.eye @ camera.eye - 100)
    met = inside > 0
    distance = -b[met] - np.sqrt(inside[met])
    normal = (camera.eye + distance[:, None] * direction[met]) / 10
    towards = camera.axes @ np.ones(3) / math.sqrt(3)
    expected = 2.5 * 0.8 / math.pi * np.maximum(0, normal @ towards)
    away = inside[met] > 2  # at the outline the polygons fall short of the sphere
    np.testing.assert_allclose(picture.radiance[met][away], expected[away], atol=5e-3 * expected.max())
    np.testing.assert_allclose(picture.normal[met][away], normal[away], atol=5e-3)
    np.testing.assert_allclose(picture.distance[met][away], distance[away], rtol=1e-3)
    assert np.count_nonzero((picture.coverage > 0) != met) < 0.005 * met.size
    assert np.all(picture.radiance[~met & (picture.coverage == 0)] == 0)
    assert np.all(np.isinf(picture.distance[picture.mesh == -1]))


@pytest.mark.parametrize("angle", [0, 30, 75])
def test_lambert_plane(floor: Raycaster, angle: float) -> None:
    camera = Camera.look_at((0, 0, 50), (0, 0, 0), width=40, height=40)  # its axes are the scene's, up being y
    a = math.radians(angle)
    picture = floor.picture(camera, MATT, light=DistantLight((math.sin(a), 0, math.cos(a))))
    np.testing.assert_allclose(picture.radiance, 0.8 / math.pi * math.cos(a), rtol=5e-3)
    assert np.all(picture.lit == 1)


@pytest.mark.parametrize("reference", [None, 20.0])
def test_near_light_over_a_plane(floor: Raycaster, reference: float | None) -> None:
    camera = Camera.look_at((0, 0, 50), (0, 0, 0), width=50, height=50)
    height, intensity = 15.0, 3.0
    picture = floor.picture(camera, MATT, light=NearLight((4, -3, height), intensity, reference), samples=1)
    direction = pixel_directions(camera)
    point = camera.eye + direction * (-50 / direction[..., 2:])
    distance = np.linalg.norm(point - (4, -3, height), axis=-1)
    fall_off = (20 / distance) ** 2 if reference else 1
    np.testing.assert_allclose(picture.radiance, 0.8 / math.pi * intensity * height / distance * fall_off, rtol=5e-3)


def test_shadow_of_a_square() -> None:
    scene = Scene((sheet("floor", 0, 100), sheet("lid", 10, 5)))
    camera = Camera.look_at((0, 0, 80), (0, 0, 0), fov=60, width=400, height=400)
    # From 45 deg on +x the lid's shadow is its square moved 10 to -x: rows of x from -15 to -5, half of it under the lid's picture.
    picture = Raycaster(scene).picture(camera, MATT, light=DistantLight((1, 0, 1)), samples=4)
    bare = Raycaster(scene).picture(camera, MATT, light=DistantLight((1, 0, 1)), samples=4, shadows=False)
    assert np.all(bare.lit == 1)
    on_floor = picture.mesh == 0
    pixel_area = (2 * 80 * math.tan(math.radians(30)) / 400) ** 2
    dark = (1 - picture.lit)[on_floor].sum() * pixel_area
    # Hidden by the lid, seen from (0, 0, 80), is the square of half side 5 * 80 / 70.
    expected = 10 * (15 - 5 * 80 / 70)
    assert dark == pytest.approx(expected, rel=0.01)
    place = camera.project([[-10, 0, 0], [-10, 4.8, 0], [-10, 5.3, 0], [-15.3, 0, 0], [10, 0, 0], [0, 0, 10]]).astype(int)
    assert [float(picture.lit[row, column]) for column, row in place] == [0, 0, 1, 1, 1, 1]
    (left, top), (right, bottom) = camera.project([[-4.8, 4.8, 10], [4.8, -4.8, 10]]).astype(int)
    assert np.all(picture.lit[top:bottom, left:right] == 1)


def test_a_near_light_between_two_sheets_is_not_hidden_by_the_further() -> None:
    scene = Scene((sheet("floor", 0, 100), sheet("ceiling", 30, 100)))
    picture = Raycaster(scene).picture(Camera.look_at((0, -60, 10), (0, 0, 5), width=40, height=40), MATT, light=NearLight((0, 0, 15)))
    assert np.all(picture.lit[picture.coverage == 1] == 1)
    assert set(np.unique(picture.mesh)) >= {0, 1}


@pytest.mark.parametrize("z", [50, -50])
def test_both_faces_reflect_and_neither_transmits(floor: Raycaster, z: float) -> None:
    camera = Camera.look_at((0, 0, z), (0, 0, 0), width=10, height=10)
    lit = floor.picture(camera, MATT, light=DistantLight((0, 0, 1)))
    np.testing.assert_allclose(lit.radiance, 0.8 / math.pi, rtol=1e-5)
    np.testing.assert_allclose(lit.normal, np.broadcast_to([0, 0, math.copysign(1, z)], lit.normal.shape), atol=1e-6)
    behind = floor.picture(camera, MATT, light=DistantLight((0, 0, -1)))
    assert np.all(behind.radiance == 0)
    assert np.all(behind.lit == 0)


def test_the_shading_gets_the_angles_of_the_surface(floor: Raycaster) -> None:
    """Light and view of known directions over a plane: phi is 0 on the light's side."""
    seen: list[Array] = []

    def record(theta_i: Array, theta_r: Array, phi: Array) -> Array:
        seen.append(np.column_stack([theta_i, theta_r, phi]))
        return np.ones_like(theta_i)

    def direction(theta: float, phi: float) -> Array:
        t, p = math.radians(theta), math.radians(phi)
        return np.array([math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)])

    for theta_i, theta_r, phi in ((20, 60, 0), (50, 30, 180), (35, 70, 65), (80, 10, -120)):
        camera = Camera.look_at(1000 * direction(theta_r, 25 + phi), (0, 0, 0), fov=0.01, width=1, height=1)
        wi = direction(theta_i, 25)
        floor.picture(camera, record, light=DistantLight(tuple(camera.axes.T @ wi)), samples=1)
        found = seen.pop()
        assert not seen
        found[:, 2] = (found[:, 2] + 1) % 360 - 1
        np.testing.assert_allclose(found[0], (theta_i, theta_r, phi % 360), atol=1e-3)


def test_the_paper_model_on_a_plane(floor: Raycaster) -> None:
    """Radiance is the mixture's intensity with no further cosine, eq. (8)."""
    table = paper_table(Cell(1.9), grid=Grid(15, 18))
    reflectance = table.mixed({"u_diff": 0.3, "u_spec": 0.5, "s_diff": 0.2, "s_spec": 0.1})
    camera = Camera.look_at((500, 0, 500), (0, 0, 0), fov=0.1, width=4, height=4)
    picture = floor.picture(camera, reflectance, light=DistantLight((0, 0, 1), intensity=2))
    assert picture.radiance.mean() == pytest.approx(2 * float(reflectance(45, 45, 0)), rel=1e-3)


def test_coverage_of_edges_is_smoothed() -> None:
    scene = Scene((sheet("tile", 0, 10),))
    camera = Camera.look_at((0, 0, 100), (0, 0, 0), fov=20, width=101, height=101)
    picture = Raycaster(scene).picture(camera, MATT, light=DistantLight((0, 0, 1)), samples=16)
    pixel = 2 * 100 * math.tan(math.radians(10)) / 101
    assert picture.coverage.sum() * pixel**2 == pytest.approx(400, rel=3e-3)
    assert 0 < np.count_nonzero((picture.coverage > 0) & (picture.coverage < 1)) < 500
    np.testing.assert_allclose(picture.radiance, picture.coverage * 0.8 / math.pi, rtol=1e-5)


def test_same_seed_same_picture_on_any_number_of_threads(ball: Raycaster, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera.look_at((30, -20, 15), (0, 0, 0), width=90, height=70)
    first = ball.picture(camera, MATT, seed=3)
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    monkeypatch.setattr("render.raycast.RAYS_IN_BAND", 2000)
    second, other = ball.picture(camera, MATT, seed=3), ball.picture(camera, MATT, seed=4)
    np.testing.assert_array_equal(first.radiance, second.radiance)
    assert np.any(first.radiance != other.radiance)


def test_a_scene_far_from_its_frames_origin_casts_no_false_shadows(ball: Raycaster) -> None:
    far = np.array([3000.0, -2000, 700])
    mesh = ball.scene.meshes[0]
    moved = Raycaster(Scene((Mesh("far", mesh.vertices + far, mesh.triangles),)))
    here, there = (
        caster.picture(Camera.look_at(np.array([0, -40.0, 10]) + at, at, width=80, height=80), MATT)
        for caster, at in ((ball, np.zeros(3)), (moved, far))
    )
    np.testing.assert_allclose(there.radiance, here.radiance, atol=2e-3)


def test_colours_come_through(floor: Raycaster) -> None:
    def red(theta_i: Array, theta_r: Array, phi: Array) -> Array:
        return np.column_stack([np.ones_like(theta_i), 0.5 * np.ones_like(theta_i), 0 * theta_i])

    picture = floor.picture(Camera.look_at((0, 0, 50), (0, 0, 0), width=4, height=3), red)
    assert picture.radiance.shape == (3, 4, 3)
    np.testing.assert_allclose(picture.radiance[1, 1], [1, 0.5, 0])


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_shading_that_is_none(floor: Raycaster, value: float) -> None:
    camera = Camera.look_at((0, 0, 50), (0, 0, 0), width=4, height=4)
    with pytest.raises(RenderError, match="negative or not finite"):
        floor.picture(camera, lambda i, r, p: np.full_like(i, value))
    with pytest.raises(RenderError, match="answered shape"):
        floor.picture(camera, lambda i, r, p: np.zeros((len(i), 2)))


def test_pictures_of_no_samples(floor: Raycaster) -> None:
    camera = Camera.look_at((0, 0, 50), (0, 0, 0), width=4, height=4)
    for settings in ({"samples": 0}, {"seed": -1}):
        with pytest.raises(RenderError, match="samples a pixel"):
            floor.picture(camera, MATT, **settings)


def test_lights_that_are_none() -> None:
    for direction, intensity in (((0, 0, 0), 1.0), ((0, 0, math.nan), 1.0), ((0, 0, 1), -1.0)):
        with pytest.raises(RenderError, match="a light needs"):
            DistantLight(direction, intensity)
    with pytest.raises(RenderError, match="a light needs"):
        NearLight((0, 0, 1), reference=0)
