"""The package's integrals against plain sampling of eq. (7), with another parametrisation and rays tested one by one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from fitting import CELL_AREA, paper_terms


def unblocked(points: np.ndarray, directions: np.ndarray, height: float) -> np.ndarray:
    """Whether rays miss all the ellipsoids of the lattice but the one they start on; the roots of the quadratic decide."""
    slope = np.max(np.hypot(directions[:, 0], directions[:, 1]) / directions[:, 2])
    extent = height * slope + 2  # a ray has then risen above the domes
    m = int(extent / np.sqrt(3)) + 2
    i, j = (n.ravel() for n in np.meshgrid(np.arange(-2 * m, 2 * m + 1), np.arange(-m, m + 1)))
    centres = np.column_stack([2 * i + j, np.sqrt(3) * j])
    distance = np.hypot(*centres.T)
    left = np.arange(len(points))  # rays not yet stopped
    for n in np.argsort(distance):
        if 0.1 < distance[n] < extent:
            x, y, z = (points[left] - np.append(centres[n], 0)).T
            dx, dy, dz = directions[left].T
            a = dx * dx + dy * dy + (dz / height) ** 2
            b = x * dx + y * dy + z * dz / height**2
            c = x * x + y * y + (z / height) ** 2 - 1
            left = left[(b >= 0) | (b * b <= a * c)]
    free = np.zeros(len(points), bool)
    free[left] = True
    return free


def directions(theta: float, azimuth: np.ndarray) -> np.ndarray:
    theta = np.radians(theta)
    return np.column_stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.full(len(azimuth), np.cos(theta))])


def brute_force(theta_i: float, theta_r: float, height: float, *, cone: float, log2: int = 15, n: float = 40) -> tuple[float, float]:
    """u_diff from points spread over the dome, u_spec from normals spread in a cone (deg) about the half vector."""
    u = qmc.Sobol(3, seed=7).random_base2(log2)
    azimuth = 2 * np.pi * u[:, 2]
    light, view = directions(theta_i, azimuth), directions(theta_r, azimuth)

    polar, around = u[:, 0] * np.pi / 2, 2 * np.pi * u[:, 1]
    sin, cos = np.sin(polar), np.cos(polar)
    points = np.column_stack([sin * np.cos(around), sin * np.sin(around), height * cos])
    normals = np.column_stack([height * sin * np.cos(around), height * sin * np.sin(around), cos])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    area = sin * np.sqrt((height * sin) ** 2 + cos**2) * np.pi**2
    seen = lit_and_seen(points, normals, light, view, height)
    diffuse = np.mean(area * seen * np.sum(normals * light, axis=1))

    half = light + view
    half /= np.linalg.norm(half, axis=1)[:, None]
    across = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(u))])
    along = np.cross(across, half)
    c = 1 - u[:, 0] * (1 - np.cos(np.radians(cone)))
    s = np.sqrt(1 - c * c)
    normals = c[:, None] * half + (s * np.cos(around))[:, None] * along + (s * np.sin(around))[:, None] * across
    support = np.sqrt(normals[:, 0] ** 2 + normals[:, 1] ** 2 + (height * normals[:, 2]) ** 2)
    points = normals * [1, 1, height**2] / support[:, None]
    per_normal = height**2 / support**4 * 2 * np.pi * (1 - np.cos(np.radians(cone)))
    mirrored = 2 * np.sum(normals * light, 1)[:, None] * normals - light
    lobe = np.maximum(0, np.sum(mirrored * view, 1)) ** n
    seen = np.zeros(len(u), bool)
    on_dome = normals[:, 2] > 0
    seen[on_dome] = lit_and_seen(points[on_dome], normals[on_dome], light[on_dome], view[on_dome], height)
    return diffuse / CELL_AREA, np.mean(per_normal * lobe * seen) / CELL_AREA


def lit_and_seen(points: np.ndarray, normals: np.ndarray, light: np.ndarray, view: np.ndarray, height: float) -> np.ndarray:
    facing = (np.sum(normals * light, 1) > 0) & (np.sum(normals * view, 1) > 0)
    out = np.zeros(len(points), bool)
    out[facing] = unblocked(points[facing], light[facing], height) & unblocked(points[facing], view[facing], height)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [0.5, 1.9])
@pytest.mark.parametrize("theta_r", [-70, -40, 0, 40, 70])
def test_at_the_papers_incidence(aspect: float, theta_r: float) -> None:
    cone = 25 if theta_r > -45 else 45  # about a grazing mirror the lobe of normals is long
    expected = brute_force(45, theta_r, 2 * aspect, cone=cone, log2=17)
    np.testing.assert_allclose(paper_terms(45, theta_r, aspect=aspect)[0, :2], expected, rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("theta_i", "theta_r", "aspect", "n", "cone"),
    [(10, -50, 1.0, 40, 25), (60, 65, 0.3, 40, 25), (30, 5, 1.2, 8, 45), (65, -80, 0.5, 40, 90)],
)
def test_elsewhere(theta_i: float, theta_r: float, aspect: float, n: float, cone: float) -> None:
    expected = brute_force(theta_i, theta_r, 2 * aspect, cone=cone, log2=16, n=n)
    np.testing.assert_allclose(paper_terms(theta_i, theta_r, aspect=aspect, n_us=n)[0, :2], expected, rtol=1e-2)
