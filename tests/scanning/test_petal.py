"""Base, tip, frame and inflection of petals whose shape is known."""

import numpy as np
import pytest

from scanning.clean import clean
from scanning.errors import PetalError
from scanning.mesh import TriangleMesh
from scanning.petal import Petal, measure_petal
from scanning.rangeimage import RangeImage
from scanning.triangulate import triangulate
from tests.scanning.surfaces import BEND, INFLECTION, PETAL_LENGTH, petal_inside, petal_point, petal_scan, scan, turned


def surface(image: RangeImage) -> TriangleMesh:
    """Cleaned and triangulated."""
    cleaned = clean(image)
    return triangulate(cleaned.image, cleaned.jump)


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle of two directions, deg."""
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


@pytest.mark.parametrize("angle", [0.0, 50.0, 125.0, -90.0, 180.0])
@pytest.mark.parametrize(("noise", "quantum"), [(0.0, 0.0), (0.08, 0.3)])
def test_a_petal_is_measured_wherever_its_base_points(angle: float, noise: float, quantum: float) -> None:
    petal = measure_petal(surface(petal_scan(angle, noise=noise, quantum=quantum)))
    assert np.linalg.norm(petal.base - petal_point(angle, 0)) < 0.6
    assert np.linalg.norm(petal.tip - petal_point(angle, 1)) < 0.9
    assert petal.changes_sign
    assert np.linalg.norm(petal.inflection - petal_point(angle, INFLECTION)) < (4.0 if noise else 1.0)
    slope = BEND * 3 * INFLECTION**2 / PETAL_LENGTH
    along = petal_point(angle, 1) - petal_point(angle, 0)
    along[2] = 0
    truth = along / np.linalg.norm(along) + slope * np.array([0, 0, 1])
    assert angle_between(petal.direction, truth) < 1.0


def test_frame() -> None:
    petal = measure_petal(surface(petal_scan(30.0)))
    T = petal.T_scan_petal
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(T[:3, 3], petal.base)
    np.testing.assert_allclose(T[:3, 1], (petal.tip - petal.base) / np.linalg.norm(petal.tip - petal.base))
    assert T[2, 2] > 0.9  # the inner face looks at the sensor
    assert petal.holes == 0
    assert petal.area == pytest.approx(true_area(), rel=0.05)


def test_inflection_moves_rigidly_with_the_petal() -> None:
    mesh = surface(petal_scan(0.0))
    first = measure_petal(mesh)
    T = np.eye(4)
    a, b = np.radians([25.0, -15.0])
    T[:3, :3] = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) @ np.array(
        [[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]
    )
    T[:3, 3] = 5, -3, 40
    second = measure_petal(mesh.transformed(T))
    np.testing.assert_allclose(second.T_scan_petal, T @ first.T_scan_petal, atol=1e-6)
    # Rounding moves points between bins of the profile.
    np.testing.assert_allclose(second.inflection, T[:3, :3] @ first.inflection + T[:3, 3], atol=1e-3)
    np.testing.assert_allclose(second.direction, T[:3, :3] @ first.direction, atol=1e-3)


def test_one_way_bend_gives_the_tangent_at_mid_length() -> None:
    petal = measure_petal(surface(petal_scan(0.0, s_shaped=False, noise=0.05, quantum=0.3)))
    assert not petal.changes_sign
    t = np.linspace(0, 1, 2001)
    run = np.concatenate([[0], np.cumsum(np.hypot(np.diff(t) * PETAL_LENGTH, np.diff(BEND * t**2)))])
    middle = float(np.interp(run[-1] / 2, run, t))
    assert np.linalg.norm(petal.inflection - petal_point(0.0, middle, s_shaped=False)) < 0.6
    assert angle_between(petal.direction, np.array([0, PETAL_LENGTH, 2 * BEND * middle])) < 1.0


def true_area() -> float:
    """Area of the virtual petal by summing its slope over the window, finer than the scan; mm^2."""
    x, y = np.meshgrid(np.linspace(-20, 20, 1500), np.linspace(-20, 20, 1500))
    u, v = turned(x, y, 0.0)
    inside = petal_inside(u, v)
    t = v / PETAL_LENGTH
    slope = BEND * (6 * INFLECTION * t - 3 * t**2) / PETAL_LENGTH
    return float(np.sqrt(1 + slope**2 + (0.024 * u) ** 2)[inside].sum() * (40 / 1499) ** 2)


def ellipse() -> TriangleMesh:
    """A leaf with two ends alike."""
    return surface(scan(lambda x, y: 0.01 * x**2, lambda x, y: (x / 10) ** 2 + (y / 18) ** 2 < 1))


def test_two_ends_alike_are_not_guessed() -> None:
    with pytest.raises(PetalError, match=r"P07.*--base X,Y"):
        measure_petal(ellipse(), name="P07")


def test_a_base_can_be_given() -> None:
    petal: Petal = measure_petal(ellipse(), base=(0.5, -18.0))
    assert np.linalg.norm(petal.base[:2] - [0, -18]) < 1
    assert np.linalg.norm(petal.tip[:2] - [0, 18]) < 1.5
    with pytest.raises(PetalError, match="from the rim"):
        measure_petal(ellipse(), base=(0, 0), name="P07")
    with pytest.raises(PetalError, match="no place"):
        measure_petal(ellipse(), base=(float("nan"), 0))


def test_a_broken_midrib_is_not_bridged() -> None:
    image = petal_scan(0.0)
    y = np.nan_to_num(image.points[..., 1])
    x = np.nan_to_num(image.points[..., 0])
    valid = image.valid & ~((np.abs(y - 5) < 6) & (np.abs(x) < 3))
    holed = RangeImage(np.where(valid[..., None], image.points, np.nan), valid)
    with pytest.raises(PetalError, match="midrib is broken"):
        measure_petal(surface(holed))
    small = image.valid & ~((np.abs(y - 5) < 1) & (np.abs(x) < 1))
    assert measure_petal(surface(RangeImage(np.where(small[..., None], image.points, np.nan), small))).holes == 1
