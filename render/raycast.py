"""Pictures by ray-casting: one light, shadows, both faces of thin opaque petals; no light from petal to petal.

Embree (through Open3D, single precision) finds what rays meet; positions are then recomputed from the triangle in double precision.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.camera import Camera
from render.errors import RenderError
from render.light import DistantLight, Light, NearLight
from render.scene import Scene

Array = NDArray[np.float64]
Single = NDArray[np.float32]

Shading = Callable[[Array, Array, Array], Array]
"""Radiance per unit beam from theta_i, theta_r and phi, each of shape (n,) in deg, as (n,) or, in colours, (n, 3).

The cosine of incidence is part of it, as it is part of the paper's r': nothing is multiplied on but the beam's intensity.
"""

RAYS_IN_BAND = 1 << 17
BIAS = 2e-5
"""Start of shadow rays before the surface, as a fraction of the scene's size: 2 um for a flower of 100 mm."""


@dataclass(frozen=True)
class Lambert:
    """A matt surface, for comparison.

    Parameters
    ----------
    albedo : float
        Share of the light that it returns, 0 to 1.
    """

    albedo: float = 1.0

    def __call__(self, theta_i_deg: Array, theta_r_deg: Array, phi_deg: Array) -> Array:
        """Radiance per unit beam, albedo / pi cos(theta_i)."""
        return self.albedo / math.pi * np.cos(np.radians(theta_i_deg))


@dataclass(frozen=True, eq=False)
class Picture:
    """Radiance and what it came from, pixel by pixel; row 0 is at the top.

    Attributes
    ----------
    radiance : ndarray of float32, shape (h, w) or (h, w, 3)
        Linear, mean over the pixel's samples, 0 where the background is seen.
    coverage : ndarray of float32, shape (h, w)
        Share of the samples that met the scene.
    lit : ndarray of float32, shape (h, w)
        Share of those that the light reaches: neither turned away from it nor shadowed.
    normal, wi, wo : ndarray of float32, shape (h, w, 3)
        Unit vectors in the scene's frame, means over the samples: smooth normal on the viewer's side, towards light and viewer.
    distance : ndarray of float32, shape (h, w), mm
        From the eye; infinite where nothing was met.
    mesh : ndarray of int32, shape (h, w)
        Which of the scene's meshes is seen; -1 for none.
    camera : Camera
    light : DistantLight or NearLight
    samples, seed : int
        Samples a pixel, and the seed of their places.
    """

    radiance: Single
    coverage: Single
    lit: Single
    normal: Single
    wi: Single
    wo: Single
    distance: Single
    mesh: NDArray[np.int32]
    camera: Camera
    light: Light
    samples: int
    seed: int


class Raycaster:
    """A scene made ready for rays; serves any number of pictures.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        import open3d

        self.scene = scene
        # About its middle, where single precision is finest.
        self._middle = (scene.vertices.min(axis=0) + scene.vertices.max(axis=0)) / 2
        self._vertices = scene.vertices - self._middle
        self._normals, self._triangles, self._owner = scene.normals, scene.triangles, scene.owner  # found once, before threads ask
        self._tensor = open3d.core.Tensor.from_numpy
        self._embree = open3d.t.geometry.RaycastingScene()
        self._embree.add_triangles(self._tensor(self._vertices.astype(np.float32)), self._tensor(scene.triangles.astype(np.uint32)))

    def picture(
        self, camera: Camera, shading: Shading, *, light: Light | None = None, samples: int = 4, shadows: bool = True, seed: int = 0
    ) -> Picture:
        """Take a picture.

        Parameters
        ----------
        camera : Camera
        shading : callable
            See `Shading`.
        light : DistantLight or NearLight, optional
            The paper's L = (1, 1, 1) in the camera's frame, intensity 1.
        samples : int
            Samples a pixel, 1 or more: a square number divides the pixel best.
        shadows : bool
            False for a scene that casts none on itself.
        seed : int
            Of the samples' places in their pixels, 0 or more; the same picture on any number of threads.

        Raises
        ------
        RenderError
            If a number is out of range or the shading answers something else than numbers of 0 or more, one or three a point.
        """
        if samples < 1 or seed < 0:
            raise RenderError(f"a picture needs 1 or more samples a pixel and a seed of 0 or more, not {samples} and {seed}")
        light = light or DistantLight()
        rows = max(1, RAYS_IN_BAND // (camera.width * samples))
        starts = range(0, camera.height, rows)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            bands = list(
                pool.map(
                    lambda first: self._band(camera, shading, light, samples, shadows, seed, first, min(rows, camera.height - first)),
                    starts,
                )
            )
        radiance, coverage, lit, normal, wi, wo, distance, mesh = (np.concatenate(part) for part in zip(*bands, strict=True))
        return Picture(radiance, coverage, lit, normal, wi, wo, distance, mesh, camera, light, samples, seed)

    def _band(
        self, camera: Camera, shading: Shading, light: Light, samples: int, shadows: bool, seed: int, first: int, rows: int
    ) -> tuple[NDArray[Any], ...]:
        """Rows of a picture: the arrays of `Picture`, in its order."""
        from render.kernels import meet, per_pixel, view_rays  # numba

        near = isinstance(light, NearLight)
        down = max(d for d in range(1, math.isqrt(samples) + 1) if samples % d == 0)
        eye = camera.eye - self._middle
        rays = view_rays(first, rows, camera.width, camera.height, camera.window, camera.axes, eye, samples // down, down, seed)
        met = self._embree.cast_rays(self._tensor(rays))
        triangle, uv = met["primitive_ids"].numpy(), met["primitive_uvs"].numpy()
        if isinstance(light, NearLight):
            source, reference = np.asarray(light.place, float) - self._middle, light.reference or 0.0
        else:
            source, reference = light.towards(camera), 0.0
        normal, wi, angles, beam, to_light = meet(
            rays, triangle, uv, self._vertices, self._normals, self._triangles, source, near, reference, BIAS * self.scene.size
        )
        lit = beam > 0
        if shadows:
            facing = np.flatnonzero(lit)
            hidden = self._embree.test_occlusions(self._tensor(to_light[facing]), tnear=0.0, tfar=1.0 if near else np.inf)
            lit[facing[hidden.numpy()]] = False
        bright = np.flatnonzero(lit)
        theta_i, theta_r, phi = angles[bright].T
        value = _checked(shading(theta_i, theta_r, phi), len(bright))
        radiance = np.zeros((len(rays), *value.shape[1:]))
        scale = light.intensity * beam[bright]
        radiance[bright] = value * scale.reshape(-1, *[1] * (value.ndim - 1))
        vectors, shares, distance, mesh = per_pixel(samples, rays, triangle, self._owner, met["t_hit"].numpy(), normal, wi, lit)
        shape = (rows, camera.width)
        return (
            radiance.reshape(-1, samples, *value.shape[1:]).mean(axis=1).astype(np.float32).reshape(*shape, *value.shape[1:]),
            *(share.reshape(shape) for share in shares.T),
            *(vectors[:, v].reshape(*shape, 3) for v in range(3)),
            distance.reshape(shape),
            mesh.reshape(shape),
        )


def _checked(value: Array, points: int) -> Array:
    value = np.asarray(value, float)
    if value.shape not in ((points,), (points, 3)):
        raise RenderError(f"the shading answered shape {value.shape} for {points} points: expected ({points},) or ({points}, 3)")
    if not (np.isfinite(value) & (value >= 0)).all():
        raise RenderError("the shading answered radiances that are negative or not finite")
    return value
