"""The package's integrals against a patch of triangulated domes, ray-cast with Open3D."""

from __future__ import annotations

import numpy as np
import pytest

from fitting import CELL_AREA, paper_terms

N_US = 40


def dome(height: float, around: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a dome of base radius 1, on rings of equal steps of the polar angle."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi / 2, up + 1), np.linspace(0, 2 * np.pi, around, endpoint=False), indexing="ij")
    vertices = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), height * np.cos(polar)], axis=-1).reshape(-1, 3)
    ring, step = (n.ravel() for n in np.meshgrid(np.arange(up), np.arange(around), indexing="ij"))
    a, b = ring * around + step, ring * around + (step + 1) % around
    quads = np.column_stack([a, a + around, b + around, a, b + around, b]).reshape(-1, 3)
    sides = vertices[quads]
    area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    return vertices, quads[area > 1e-12]  # the first ring is a point


def mesh_terms(theta_i: float, theta_r: float, height: float, azimuths: int = 24) -> np.ndarray:
    """u_diff and u_spec of the innermost dome of a patch, averaged over the azimuth of light and view."""
    o3d = pytest.importorskip("open3d", reason="Open3D needs libusb-1.0-0 on Debian", exc_type=ImportError)
    reach = height * np.tan(np.radians(max(abs(theta_i), abs(theta_r)))) + 2
    # The measured dome is fine enough for the lobe, which is narrow on the tip of a tall dome; its neighbours only cast shadows.
    vertices, triangles = dome(height, 96, 160)
    others = dome(height, 96, 48)
    scene = o3d.t.geometry.RaycastingScene()
    m = int(reach) + 1
    for i in range(-2 * m, 2 * m + 1):
        for j in range(-m, m + 1):
            centre = np.array([2 * i + j, np.sqrt(3) * j, 0])
            corners, faces = (vertices, triangles) if i == j == 0 else others
            if np.linalg.norm(centre) < reach:
                scene.add_triangles((corners + centre).astype(np.float32), faces.astype(np.uint32))
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    normals = cross / (2 * area[:, None])
    starts = corners.mean(axis=1) + 1e-4 * normals

    def free(towards: np.ndarray) -> np.ndarray:
        rays = np.column_stack([starts, np.broadcast_to(towards, starts.shape)]).astype(np.float32)
        return (normals @ towards > 0) & ~scene.test_occlusions(rays).numpy()

    total = np.zeros(2)
    for azimuth in np.radians((np.arange(azimuths) + 0.5) * 60 / azimuths):
        light, view = (
            np.array([np.sin(t) * np.cos(azimuth), np.sin(t) * np.sin(azimuth), np.cos(t)]) for t in np.radians([theta_i, theta_r])
        )
        cos_light = normals @ light
        lobe = np.maximum(0, 2 * cos_light * (normals @ view) - light @ view) ** N_US
        seen = area * (free(light) & free(view))
        total += [seen @ cos_light, seen @ lobe]
    return total / azimuths / CELL_AREA


@pytest.mark.slow
@pytest.mark.parametrize(("aspect", "theta_r"), [(0.5, -60), (0.5, 50), (1.9, -30), (1.9, 60)])
def test_domes_of_triangles(aspect: float, theta_r: float) -> None:
    np.testing.assert_allclose(mesh_terms(45, theta_r, 2 * aspect), paper_terms(45, theta_r, aspect=aspect)[0, :2], rtol=1e-2)
