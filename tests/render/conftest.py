"""Shapes with closed forms, and the settings of the property tests."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings

from render import Mesh, Raycaster, Scene

# The first example of a test may load or compile a numba kernel: no example is held to a time.
settings.register_profile("kernels", deadline=None)
settings.load_profile("kernels")


def sheet(name: str, z: float, half: float, steps: int = 2, centre: tuple[float, float] = (0, 0)) -> Mesh:
    """Square of side 2 * half at height z, facing +z."""
    line = np.linspace(-half, half, steps)
    x, y = np.meshgrid(line + centre[0], line + centre[1])
    index = np.arange(steps * steps).reshape(steps, steps)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Mesh(name, np.column_stack([x.ravel(), y.ravel(), np.full(x.size, float(z))]), triangles)


def sphere(radius: float = 10.0, rows: int = 300) -> Mesh:
    """Sphere about the origin, outside outwards."""
    polar, around = np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1)
    t, p = np.meshgrid(polar, around[:-1], indexing="ij")
    vertices = radius * np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    index = np.arange(t.size).reshape(t.shape)
    further = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1].ravel(), index[1:].ravel(), further[1:].ravel(), further[:-1].ravel()
    return Mesh("sphere", vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


@pytest.fixture(scope="session")
def ball() -> Raycaster:
    """Sphere of radius 10 about the origin."""
    return Raycaster(Scene((sphere(),)))


@pytest.fixture(scope="session")
def floor() -> Raycaster:
    """Square of side 200 in the plane z = 0."""
    return Raycaster(Scene((sheet("floor", 0, 100),)))
