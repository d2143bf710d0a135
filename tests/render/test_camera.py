"""Where things appear in the picture."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from render import Box, Camera, DistantLight, Lambert, Raycaster, RenderError

coordinates = st.floats(-50, 50)
places = st.tuples(coordinates, coordinates, coordinates)


def test_axes_are_right_up_and_towards_the_viewer() -> None:
    camera = Camera.look_at((0, -10, 0), (0, 0, 0))
    np.testing.assert_allclose(camera.axes.T, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    column, row = camera.project([[1, 0, 2]])[0]
    assert column > 400
    assert row < 400


def test_the_light_is_in_the_cameras_frame() -> None:
    """The paper's L = (1, 1, 1): towards the viewer's upper right."""
    camera = Camera.look_at((0, -10, 0), (0, 0, 0))
    np.testing.assert_allclose(DistantLight().towards(camera), np.array([1, -1, 1]) / math.sqrt(3), atol=1e-12)


def test_looking_along_up_the_pictures_up_is_y() -> None:
    np.testing.assert_allclose(Camera.look_at((0, 0, 10), (0, 0, 0)).axes, np.eye(3), atol=1e-12)


def test_angle_of_view() -> None:
    camera = Camera.look_at((0, 0, 10), (0, 0, 0), fov=40, width=300, height=200)
    edge = 10 * math.tan(math.radians(20))
    np.testing.assert_allclose(camera.project([[0, edge, 0], [-1.5 * edge, 0, 0]]), [[150, 0], [0, 100]], atol=1e-9)


@given(points=st.lists(places, min_size=4, max_size=30), towards=places, width=st.integers(20, 2000), height=st.integers(20, 2000))
def test_framing_shows_everything_and_no_more_than_it_must(
    points: list[tuple[float, float, float]], towards: tuple[float, float, float], width: int, height: int
) -> None:
    cloud, direction = np.array(points), np.array(towards)
    if np.linalg.norm(direction) < 1e-3 or np.linalg.norm(np.ptp(cloud, axis=0)) < 1e-3:
        return
    camera = Camera.framing(cloud, direction, fov=35, margin=0.1, width=width, height=height)
    seen = camera.project(cloud) / (width, height)
    assert np.all((seen > 0.1 - 1e-6) & (seen < 0.9 + 1e-6))
    assert np.max(np.abs(seen - 0.5)) == pytest.approx(0.4, abs=1e-6)


def test_a_detail_is_the_same_view_on_more_pixels(ball: Raycaster) -> None:
    camera = Camera.look_at((30, -20, 15), (0, 0, 0), width=90, height=60)
    box = Box(left=50, top=20, width=12, height=9)
    whole = ball.picture(camera, Lambert(), samples=1)
    part = camera.detail(box, enlarge=5)
    assert (part.width, part.height) == (60, 45)
    detail = ball.picture(part, Lambert(), samples=1)
    # Of five by five pixels the middle one lies where the box's pixel does.
    np.testing.assert_allclose(detail.radiance[2::5, 2::5], whole.radiance[20:29, 50:62], atol=1e-5)


@pytest.mark.parametrize("box", [Box(-1, 0, 5, 5), Box(0, 56, 5, 5), Box(86, 0, 5, 5), Box(0, 0, 0, 5)])
def test_details_outside_the_picture(box: Box) -> None:
    with pytest.raises(RenderError):
        Camera.look_at((30, -20, 15), (0, 0, 0), width=90, height=60).detail(box, enlarge=5)


def test_cameras_that_see_nothing() -> None:
    with pytest.raises(RenderError, match="coincide"):
        Camera.look_at((1, 2, 3), (1, 2, 3))
    with pytest.raises(RenderError, match="angle of view"):
        Camera.look_at((1, 2, 3), (0, 0, 0), fov=180)
    with pytest.raises(RenderError, match="nothing to see"):
        Camera.look_at((1, 2, 3), (0, 0, 0), width=0)
    with pytest.raises(RenderError, match="0 points"):
        Camera.framing(np.zeros((0, 3)), (1, 0, 0))
    with pytest.raises(RenderError, match="one place"):
        Camera.framing(np.ones((5, 3)), (1, 0, 0))
    with pytest.raises(RenderError, match="a rotation"):
        Camera(np.zeros(3), np.diag([1.0, 1, -1]), (-1, 1, -1, 1), 10, 10)
