"""What happens to rays before and after the ray-caster meets the triangles (numba kernels).

Kernels are serial and let go of the interpreter's lock: the ray-caster spreads bands of the picture over threads.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]

MISS = np.uint32(0xFFFFFFFF)


@njit(cache=True, nogil=True)
def uniform(seed: int, a: int, b: int, c: int) -> float:
    """Random number in 0 .. 1 that depends on its arguments only, so that threads and bands change no picture (splitmix64)."""
    x = np.uint64(seed)
    for part in (a, b, c):
        x = (x ^ np.uint64(part)) + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x = x ^ (x >> np.uint64(31))
    return float(x >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True, nogil=True)
def view_rays(
    first: int, rows: int, width: int, height: int, window: Any, axes: Array, eye: Array, across: int, down: int, seed: int
) -> Single:
    """Rays through `rows` rows of pixels from row `first` on: origin and unit direction, samples of a pixel together; shape (n, 6).

    A pixel is split into `across` x `down` equal parts with a random place in each; a single sample takes its centre.
    """
    left, right, bottom, top = window
    out = np.empty((rows * width * across * down, 6), np.float32)
    n = 0
    for row in range(first, first + rows):
        for column in range(width):
            for s in range(across * down):
                u = v = 0.5
                if across * down > 1:
                    pixel = row * width + column
                    u = (s % across + uniform(seed, pixel, s, 0)) / across
                    v = (s // across + uniform(seed, pixel, s, 1)) / down
                x = left + (right - left) * (column + u) / width
                y = top - (top - bottom) * (row + v) / height
                length = math.sqrt(x * x + y * y + 1)
                for i in range(3):
                    out[n, i] = eye[i]
                    out[n, 3 + i] = (axes[i, 0] * x + axes[i, 1] * y - axes[i, 2]) / length
                n += 1
    return out


@njit(cache=True, nogil=True)
def meet(
    rays: Single,
    triangle: NDArray[np.uint32],
    uv: Single,
    vertices: Array,
    normals: Array,
    triangles: NDArray[np.int64],
    light: Array,
    near: bool,
    reference: float,
    bias: float,
) -> Any:
    """Find position, normal and angles where rays met triangles.

    Parameters
    ----------
    rays, triangle, uv : ndarray, shapes (n, 6), (n,), (n, 2)
        Rays, which triangle each met (`MISS`: none) and where on it.
    vertices, normals, triangles : ndarray
        Of the scene.
    light : ndarray, shape (3,)
        Towards the light (unit) or, if `near`, its place.
    reference : float
        Distance of unit intensity with inverse-square fall-off; 0 for none.
    bias : float, mm
        How far before the surface the ray to the light starts, so that it does not meet where it came from.

    Returns
    -------
    normal, wi : ndarray of float32, shape (n, 3)
        Shading normal on the viewer's side and unit vector towards the light; 0 where nothing was met.
    angles : ndarray, shape (n, 3), deg
        theta_i, theta_r, phi, where the light is before the surface.
    beam : ndarray, shape (n,)
        Intensity that arrives there if nothing is in the way; 0 where the light is behind the surface.
    to_light : ndarray of float32, shape (n, 6)
        Rays to the light; for a near one, of the length of its distance.
    """
    n = len(rays)
    normal = np.zeros((n, 3), np.float32)
    towards = np.zeros((n, 3), np.float32)
    angles = np.zeros((n, 3))
    beam = np.zeros(n)
    to_light = np.zeros((n, 6), np.float32)
    p, g, s, wi, wo = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for k in range(n):
        if triangle[k] == MISS:
            continue
        a, b, c = triangles[triangle[k], 0], triangles[triangle[k], 1], triangles[triangle[k], 2]
        u, v = float(uv[k, 0]), float(uv[k, 1])
        for i in range(3):
            p[i] = (1 - u - v) * vertices[a, i] + u * vertices[b, i] + v * vertices[c, i]
            s[i] = (1 - u - v) * normals[a, i] + u * normals[b, i] + v * normals[c, i]
            wo[i] = -rays[k, 3 + i]
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            g[i] = (vertices[b, j] - vertices[a, j]) * (vertices[c, m] - vertices[a, m]) - (vertices[b, m] - vertices[a, m]) * (
                vertices[c, j] - vertices[a, j]
            )
        scale = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if g[0] * wo[0] + g[1] * wo[1] + g[2] * wo[2] < 0:
            scale = -scale
        g /= scale
        if s[0] * g[0] + s[1] * g[1] + s[2] * g[2] < 0:
            s *= -1
        length = math.sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2])
        cos_r = (s[0] * wo[0] + s[1] * wo[1] + s[2] * wo[2]) / length if length > 0 else 0.0
        if cos_r > 0:
            s /= length
        else:  # at an outline the smooth normal may turn away from the viewer: there the flat one is used
            s[:] = g
            cos_r = g[0] * wo[0] + g[1] * wo[1] + g[2] * wo[2]
        distance = 1.0
        for i in range(3):
            wi[i] = light[i] - p[i] if near else light[i]
        if near:
            distance = math.sqrt(wi[0] * wi[0] + wi[1] * wi[1] + wi[2] * wi[2])
            wi /= distance
        cos_i = s[0] * wi[0] + s[1] * wi[1] + s[2] * wi[2]
        for i in range(3):
            normal[k, i] = s[i]
            towards[k, i] = wi[i]
        if cos_i <= 0 or g[0] * wi[0] + g[1] * wi[1] + g[2] * wi[2] <= 0:
            continue
        beam[k] = (reference / distance) ** 2 if near and reference > 0 else 1.0
        for i in range(3):
            to_light[k, i] = p[i] + bias * g[i]
            # To a near light t runs from 0 to 1.
            to_light[k, 3 + i] = light[i] - to_light[k, i] if near else wi[i]
        along = s[0] * (wi[1] * wo[2] - wi[2] * wo[1]) + s[1] * (wi[2] * wo[0] - wi[0] * wo[2]) + s[2] * (wi[0] * wo[1] - wi[1] * wo[0])
        across = wi[0] * wo[0] + wi[1] * wo[1] + wi[2] * wo[2] - cos_i * cos_r
        angles[k, 0] = math.degrees(math.acos(min(1.0, cos_i)))
        angles[k, 1] = math.degrees(math.acos(min(1.0, cos_r)))
        angles[k, 2] = math.degrees(math.atan2(along, across))
    return normal, towards, angles, beam, to_light


@njit(cache=True, nogil=True)
def per_pixel(
    samples: int,
    rays: Single,
    triangle: NDArray[np.uint32],
    owner: NDArray[np.int32],
    depth: Single,
    normal: Single,
    wi: Single,
    lit: NDArray[np.bool_],
) -> Any:
    """Gather samples into pixels.

    Returns
    -------
    vectors : ndarray of float32, shape (pixels, 3, 3)
        Unit means of normal, wi and wo over what was met; 0 where nothing was.
    shares : ndarray of float32, shape (pixels, 2)
        Share of the samples that met something; share of these that are lit.
    distance : ndarray of float32, shape (pixels,)
        Mean distance of what was met from the eye; infinite where nothing was.
    mesh : ndarray of int32, shape (pixels,)
        Mesh that the first sample to meet anything met; -1 for none.
    """
    pixels = len(rays) // samples
    vectors = np.zeros((pixels, 3, 3), np.float32)
    shares = np.zeros((pixels, 2), np.float32)
    distance = np.full(pixels, np.inf, np.float32)
    mesh = np.full(pixels, -1, np.int32)
    for q in range(pixels):
        met = bright = 0
        far = 0.0
        for k in range(q * samples, (q + 1) * samples):
            if triangle[k] == MISS:
                continue
            if met == 0:
                mesh[q] = owner[triangle[k]]
            met += 1
            bright += lit[k]
            far += depth[k]
            for i in range(3):
                vectors[q, 0, i] += normal[k, i]
                vectors[q, 1, i] += wi[k, i]
                vectors[q, 2, i] -= rays[k, 3 + i]
        if met:
            shares[q, 0], shares[q, 1], distance[q] = met / samples, bright / met, far / met
            for v in range(3):
                length = math.sqrt(vectors[q, v, 0] ** 2 + vectors[q, v, 1] ** 2 + vectors[q, v, 2] ** 2)
                if length > 0:
                    vectors[q, v] /= length
    return vectors, shares, distance, mesh
