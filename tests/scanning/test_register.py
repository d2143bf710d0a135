"""Registration without a hint, against the published poses of the Stanford bunny (good to 0.2 mm and 0.2 deg themselves)."""

from pathlib import Path

import numpy as np
import pytest

from scanning.clean import Cleaning, clean
from scanning.errors import RegistrationError
from scanning.formats import read_range_image
from scanning.mesh import TriangleMesh
from scanning.register import in_free_space, merge, register
from scanning.triangulate import triangulate
from tests.scanning.surfaces import petal_scan, scan


def surface(path: Path) -> TriangleMesh:
    """Cleaned and triangulated, depths as measured."""
    cleaned = clean(read_range_image(path, unit="m"), Cleaning(smooth=0))
    return triangulate(cleaned.image, cleaned.jump)


def published(conf: Path, name: str) -> np.ndarray:
    """T_world_scan from a `.conf` file: p = R(q)^T v + t, metres."""
    for line in conf.read_text().splitlines():
        words = line.split()
        if words[:2] == ["bmesh", name]:
            t = 1000 * np.array(words[2:5], dtype=float)
            x, y, z, w = np.array(words[5:9], dtype=float)
            R = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R.T, t
            return T
    raise AssertionError(f"{name} is not in {conf}")


@pytest.fixture(scope="module")
def bunny(shared_data: Path) -> dict[str, TriangleMesh]:
    """Scans from the front, 45 degrees to the side and the back."""
    return {name: surface(shared_data / "range" / "bunny" / f"{name}.ply") for name in ("bun000", "bun045", "bun180")}


@pytest.fixture(scope="module")
def truth(shared_data: Path) -> np.ndarray:
    """T_000_045 as published."""
    conf = shared_data / "range" / "bunny" / "bun.conf"
    return np.asarray(np.linalg.inv(published(conf, "bun000.ply")) @ published(conf, "bun045.ply"))


def misfit(T: np.ndarray, truth: np.ndarray, points: np.ndarray) -> tuple[float, float]:
    """Root mean square distance of points under both poses, mm, and the angle between these, deg."""
    away = (points @ T[:3, :3].T + T[:3, 3]) - (points @ truth[:3, :3].T + truth[:3, 3])
    angle = np.arccos(np.clip((np.trace(T[:3, :3] @ truth[:3, :3].T) - 1) / 2, -1, 1))
    return float(np.sqrt((away**2).sum(axis=1).mean())), float(np.degrees(angle))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bunny(bunny: dict[str, TriangleMesh], truth: np.ndarray, seed: int) -> None:
    # From anywhere: the source is turned and moved first.
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = Q * np.sign(np.linalg.det(Q)), rng.normal(0, 200, 3)
    found = register(bunny["bun045"].transformed(moved), bunny["bun000"], seed=seed)
    rms, angle = misfit(found.T_target_source @ moved, truth, bunny["bun045"].vertices)
    assert rms < 0.15
    assert angle < 0.2
    assert found.fitness > 0.6
    assert found.inlier_rmse < 0.5
    assert found.seed == seed


@pytest.mark.slow
def test_scans_that_share_too_little_are_refused(bunny: dict[str, TriangleMesh]) -> None:
    with pytest.raises(RegistrationError, match="no pose to trust"):
        register(bunny["bun180"], bunny["bun000"], name="bun180 to bun000")


@pytest.mark.slow
def test_merging_thins_what_was_seen_twice(bunny: dict[str, TriangleMesh], truth: np.ndarray) -> None:
    front, side = bunny["bun000"], bunny["bun045"]
    both = merge([front, side], [np.eye(4), truth])
    np.testing.assert_array_equal(both.vertices[: len(front.vertices)], front.vertices)
    added = len(both.vertices) - len(front.vertices)
    assert 0.1 * len(side.vertices) < added < 0.4 * len(side.vertices)
    assert both.triangles.max() == len(both.vertices) - 1
    twice = merge([front, front], [np.eye(4), np.eye(4)])
    assert len(twice.vertices) == len(front.vertices)
    assert len(twice.triangles) == len(front.triangles)


def test_a_pose_in_front_of_what_was_seen_cannot_be() -> None:
    cleaned = clean(petal_scan())
    mesh = triangulate(cleaned.image, cleaned.jump)
    up = np.eye(4)
    assert in_free_space(mesh, mesh, up, 0.35) == 0
    up[2, 3] = 5.0
    assert in_free_space(mesh, mesh, up, 0.35) > 0.99
    assert in_free_space(mesh, mesh, np.linalg.inv(up), 0.35) == 0


def test_what_cannot_be_registered() -> None:
    small = triangulate(scan(lambda x, y: 0 * x, size=5), 1.0)
    with pytest.raises(RegistrationError, match="the source has 25 points"):
        register(small, small)
    with pytest.raises(ValueError, match="1 meshes and 0 poses"):
        merge([small], [])
