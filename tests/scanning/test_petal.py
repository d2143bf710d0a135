"""Base, tip, frame and inflection of petals whose shape is known."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scanning.clean import clean
from scanning.errors import PetalError
from scanning.formats import read_range_image
from scanning.formats.ply import read_mesh
from scanning.mesh import TriangleMesh, area, boundary_loops, loop_length
from scanning.petal import Petal, measure_petal, narrowness_along
from scanning.rangeimage import RangeImage
from scanning.triangulate import triangulate
from sim.rose import write_specimen
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


def ragged(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A round piece with a torn rim."""
    rng = np.random.default_rng(4)
    angle = np.arctan2(y, x)
    waves = sum(rng.normal(0, 0.12 / np.sqrt(n)) * np.cos(n * angle + rng.uniform(0, 7)) for n in range(2, 25))
    return np.asarray(np.hypot(x, y) < 14 * (1 + waves))


NO_PETALS = {
    "disc": lambda x, y: np.hypot(x, y) < 16,
    "square": lambda x, y: (np.abs(x) < 14) & (np.abs(y) < 14),
    "turned square": lambda x, y: np.abs(x) + np.abs(y) < 19,
    "half disc": lambda x, y: (np.hypot(x, y) < 20) & (y > 0),
    "ellipse": lambda x, y: (x / 10) ** 2 + (y / 18) ** 2 < 1,
    "strip": lambda x, y: (np.abs(x) < 4) & (np.abs(y) < 25),
    "ragged": ragged,
}


@pytest.mark.parametrize("shape", NO_PETALS)
@pytest.mark.parametrize("noise", [0.0, 0.08])
def test_what_has_no_claw_is_not_guessed(shape: str, noise: float) -> None:
    mesh = surface(scan(lambda x, y: 0.01 * x**2, NO_PETALS[shape], noise=noise, quantum=4 * noise))
    with pytest.raises(PetalError, match=r"^P07: the base cannot be told.*--base P07=X,Y"):
        measure_petal(mesh, name="P07")


def test_the_scan_is_named_with_the_petal() -> None:
    with pytest.raises(PetalError, match=r"^scans/P07\.abs \(petal P07\): .*--base P07=X,Y"):
        measure_petal(ellipse(), name="P07", file="scans/P07.abs")


def test_narrowness_of_known_ends() -> None:
    def least_and_most(inside: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> tuple[float, float]:
        mesh = surface(scan(lambda x, y: 0.0 * x, inside))
        rim = mesh.vertices[boundary_loops(mesh.triangles)[0]]
        along = np.arange(0, len(rim), len(rim) / 240).astype(int)
        values = narrowness_along(mesh, rim[along])
        return float(values.min()), float(values.max())

    # A straight rim has 1; a quarter disc within a right angle half of that, times 1 - 90 / 360.
    least, most = least_and_most(NO_PETALS["square"])
    assert least == pytest.approx(0.5 * 0.75, rel=0.25)
    assert most == pytest.approx(1, abs=0.06)


@pytest.fixture(scope="module", params=[(12, 1, 0.0), (12, 5, 1.0)], ids=str)
def rose(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual rose, scanned."""
    petals, seed, opening = request.param
    folder = tmp_path_factory.mktemp("rose")
    write_specimen(folder, petals, opening, seed, triangles=5000)
    return folder


@pytest.mark.slow
def test_every_petal_of_a_rose_is_known_by_its_claw(rose: Path) -> None:
    truth = json.loads((rose / "truth.json").read_text())["petals"]
    assert len(truth) >= 12
    for name, petal in truth.items():
        mesh = surface(read_range_image(rose / f"{name}.abs"))
        found = measure_petal(mesh, name=name)
        assert np.linalg.norm(found.base - petal["base"]) < 1.0, name
        assert found.narrowness < 0.84, name
        # The rim is met, and no more ragged than the petal's own.
        true = read_mesh(rose / f"{name}.ply")
        border, rim = (m.vertices[boundary_loops(m.triangles)[0]] for m in (true, mesh))
        off = cKDTree(finely(border)[:, :2]).query(rim[:, :2])[0] / petal["step"]
        assert np.sqrt(np.mean(off**2)) < 0.45, name
        assert np.median(cKDTree(finely(border)).query(rim)[0]) < 0.5 * petal["step"], name
        assert 0.98 < length(rim) / length(border) < 1.05, name
        assert 0.98 < area(mesh) / area(true) < 1.01, name


def finely(loop: np.ndarray) -> np.ndarray:
    """Points along a closed line, fifty for each of its sides."""
    part = np.arange(50)[:, None, None] / 50
    return np.asarray(((1 - part) * loop + part * np.roll(loop, -1, axis=0)).reshape(-1, 3))


def length(loop: np.ndarray) -> float:
    """Length of a closed line."""
    return loop_length(loop, np.arange(len(loop), dtype=np.int32))


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
