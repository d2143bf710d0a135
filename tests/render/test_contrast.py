"""The contrast of Figure 14 on a sphere, where it has a value of its own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fitting.cells import Cell
from fitting.table import Grid, paper_table
from render import Camera, Lambert, Picture, Raycaster, RenderError, measure_contrast
from render.raycast import Shading

CAMERA = Camera.look_at((0, -2000, 0), (0, 0, 0), fov=0.7, width=400, height=400)


@pytest.fixture(scope="module")
def matt(ball: Raycaster) -> Picture:
    return ball.picture(CAMERA, Lambert())


def over_a_disc(shading: Shading) -> tuple[float, float, float]:
    """Mean radiances of both classes on a sphere seen from afar, where the normal is known from its place; share of the first."""
    x, y = np.meshgrid(np.linspace(-1, 1, 700), np.linspace(-1, 1, 700))
    inside = x * x + y * y < 1
    normal = np.column_stack([x[inside], y[inside], np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2)])
    wi, wo = np.ones(3) / np.sqrt(3), np.array([0.0, 0, 1])
    half = (wi + wo) / np.linalg.norm(wi + wo)
    means = []
    for towards, limit in ((wi, 15), (half, 10)):
        n = normal[normal @ towards >= np.cos(np.radians(limit))]
        cos_i, cos_r = n @ wi, n @ wo
        cos_phi = (wi @ wo - cos_i * cos_r) / np.sqrt((1 - cos_i**2) * (1 - cos_r**2))
        theta_i, theta_r, phi = (np.degrees(np.arccos(np.clip(c, -1, 1))) for c in (cos_i, cos_r, cos_phi))
        means.append(float(shading(theta_i, theta_r, phi).mean()))
    return means[0], means[1], np.count_nonzero(normal @ wi >= np.cos(np.radians(15))) / len(normal)


def test_of_a_lambert_sphere(matt: Picture) -> None:
    facing, mirroring, share = over_a_disc(Lambert())
    found = measure_contrast(matt)
    assert found.facing == pytest.approx(facing, rel=3e-3)
    assert found.mirroring == pytest.approx(mirroring, rel=3e-3)
    assert found.C == found.facing / found.mirroring  # noqa: SIM300
    assert abs(found.C - 1.1) < 0.03
    assert found.facing_pixels == pytest.approx(share * np.count_nonzero(matt.coverage == 1), rel=0.03)


def test_domes_against_gloss(ball: Raycaster) -> None:
    table = paper_table(Cell(1.9), grid=Grid(15, 18))
    found = {}
    for name in ("u_diff", "s_spec"):
        shading = table.mixed({"u_diff": 0.0, "u_spec": 0.0, "s_diff": 0.0, "s_spec": 0.0} | {name: 1.0})
        facing, mirroring, _ = over_a_disc(shading)
        found[name] = measure_contrast(ball.picture(CAMERA, shading)).C
        assert found[name] == pytest.approx(facing / mirroring, rel=0.01)
    assert found["u_diff"] > 4 * found["s_spec"]


def test_shadowed_and_partly_covered_pixels_do_not_count(matt: Picture) -> None:
    """What does not count may hold anything."""
    expected = measure_contrast(matt)
    for field in ("lit", "coverage"):
        mark = getattr(matt, field).copy()
        radiance = matt.radiance.copy()
        mark[::3], radiance[::3] = 0.5, 1000
        found = measure_contrast(dataclasses.replace(matt, radiance=radiance, **{field: mark}))
        assert abs(found.C - expected.C) < 2e-3
        assert found.mirroring_pixels < 0.7 * expected.mirroring_pixels


def test_too_little_to_compare(matt: Picture) -> None:
    with pytest.raises(RenderError, match="facing the light"):
        measure_contrast(matt, facing=0.1)
    with pytest.raises(RenderError, match="mirroring it"):
        measure_contrast(matt, mirroring=0.1)
    with pytest.raises(RenderError, match="all black"):
        measure_contrast(dataclasses.replace(matt, radiance=0 * matt.radiance))
