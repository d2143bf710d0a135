"""Photons shot one by one at a patch of half-ellipsoids: what the traces of `fitting` are held against, and shares no code with them.

Divided by their height the domes are unit spheres, and a wall is where a quadratic says. Every choice is drawn by lot, absorption along the
way included. Lengths in base radii of the domes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

PARTS = ("mirror", "floor", "stray", "body", "scattered", "direct", "upper", "mesophyll", "lower")
"""Ends of a photon in a petal, numbered from 0; -1 is none."""
MIRROR, FLOOR, STRAY, BODY, SCATTERED, DIRECT, UPPER, MESOPHYLL, LOWER = range(9)


class Side(NamedTuple):
    """One face: height (0: flat) and distance of its domes, depth of the slab below them, absorption of both."""

    h: float
    pitch: float
    depth: float
    mu: float


class Mesophyll(NamedTuple):
    """Shares reflected on either side, let through diffusely and let through unscattered."""

    reflected: float
    reflected_below: float
    through: float
    unscattered: float


@njit(cache=True, nogil=True)
def fresnel(cos_i: float, n: float) -> float:
    """Reflected share of unpolarised light, through the angles."""
    i = math.acos(min(1.0, max(0.0, cos_i)))
    if math.sin(i) >= n:
        return 1.0
    if i < 1e-6:
        return ((n - 1) / (n + 1)) ** 2
    t = math.asin(math.sin(i) / n)
    return (math.sin(i - t) ** 2 / math.sin(i + t) ** 2 + math.tan(i - t) ** 2 / math.tan(i + t) ** 2) / 2


@njit(cache=True, nogil=True)
def anywhere(pitch: float) -> tuple[float, float]:
    """A place drawn from one period of the lattice."""
    u, v = np.random.random(), np.random.random()  # noqa: NPY002 - numba's own generator
    return pitch * (u + v / 2), pitch * v * math.sqrt(3) / 2


@njit(cache=True, nogil=True)
def fly(x: float, y: float, z: float, dx: float, dy: float, dz: float, h: float, pitch: float) -> tuple[int, float, float, float]:
    """Way outside the domes: 0 to the sky, 1 to a dome, 2 to the floor, -1 unending; and where, a dome's place as seen from its centre."""
    if h == 0:
        return (0 if dz > 0 else 2), x, y, 0.0
    flat = math.hypot(dx, dy)
    row = pitch * math.sqrt(3) / 2
    vz = dz / h
    a = flat * flat + vz * vz
    for _ in range(100_000):
        last = (h - z) / dz if dz > 0 else (-z / dz if dz < 0 else math.inf)
        end = min(last, 2 / flat) if flat > 0 else last
        # Domes that a piece two radii long can meet stand within two radii of its middle.
        mx, my = x + dx * end / 2, y + dy * end / 2
        j0 = round(my / row)
        i0 = round(mx / pitch - j0 / 2)
        best, bx, by = math.inf, 0.0, 0.0
        for i in range(i0 - 1, i0 + 2):
            for j in range(j0 - 1, j0 + 2):
                ox, oy, oz = x - pitch * (i + j / 2), y - row * j, z / h
                b = ox * dx + oy * dy + oz * vz
                under = b * b - a * (ox * ox + oy * oy + oz * oz - 1)
                if b < 0 and under > 0:
                    t = (-b - math.sqrt(under)) / a
                    if 1e-9 < t < best:
                        best, bx, by = t, ox, oy
        if best <= end:
            return 1, bx + best * dx, by + best * dy, max(0.0, z + best * dz)
        x, y, z = x + end * dx, y + end * dy, min(h, max(0.0, z + end * dz))
        if end == last:
            return (0 if dz > 0 else 2), x, y, z
    return -1, x, y, z


@njit(cache=True, nogil=True)
def shoot(
    theta_deg: float, count: int, upper: Side, lower: Side, n: float, tissue: Mesophyll, seed: int
) -> tuple[NDArray[np.int64], Array]:
    """Shoot photons at a petal's upper face: how each ends, of `PARTS`, and the cosine under which it leaves (0 where it does not)."""
    np.random.seed(seed)  # noqa: NPY002
    ends, cosines = np.full(count, -1), np.zeros(count)
    for photon in range(count):
        below = False
        side = upper
        been, scattered, within = False, False, False
        first = -1
        x, y = anywhere(side.pitch)
        z = side.h
        theta, azimuth = math.radians(theta_deg), 2 * math.pi * np.random.random()  # noqa: NPY002
        dx, dy, dz = -math.sin(theta) * math.cos(azimuth), -math.sin(theta) * math.sin(azimuth), -math.cos(theta)
        left = -math.log(1 - np.random.random())  # noqa: NPY002 - optical depth it has before it
        while True:
            arrives = False
            if within:
                h = side.h
                a = dx * dx + dy * dy + dz * dz / h / h
                b = x * dx + y * dy + z * dz / h / h
                t = (math.sqrt(max(0.0, b * b - a * (x * x + y * y + z * z / h / h - 1))) - b) / a
                arrives = dz < 0 and -z / dz <= t
                t = -z / dz if arrives else t
                left -= side.mu * t
                x, y, z = x + t * dx, y + t * dy, max(0.0, z + t * dz)
                what = 1
            else:
                what, x, y, z = fly(x, y, z, dx, dy, dz, side.h, side.pitch)
            if left < 0:
                ends[photon] = LOWER if below else UPPER
                break
            if what <= 0:
                if what == 0:
                    cosines[photon] = dz
                    if below:
                        ends[photon] = SCATTERED if scattered else DIRECT
                    else:
                        ends[photon] = BODY if been else first
                break
            if not arrives:
                nx, ny, nz = 0.0, 0.0, 1.0
                if what == 1:
                    nx, ny, nz = x, y, z / side.h**2
                    length = math.sqrt(nx * nx + ny * ny + nz * nz) * (-1 if within else 1)
                    nx, ny, nz = nx / length, ny / length, nz / length
                cos_i = -(dx * nx + dy * ny + dz * nz)
                ratio = 1 / n if within else n
                if np.random.random() < fresnel(cos_i, ratio):  # noqa: NPY002
                    dx, dy, dz = dx + 2 * cos_i * nx, dy + 2 * cos_i * ny, dz + 2 * cos_i * nz
                    first = STRAY if first >= 0 else (MIRROR if what == 1 else FLOOR)
                else:
                    bend = cos_i / ratio - math.sqrt(max(0.0, 1 - (1 - cos_i * cos_i) / ratio**2))
                    dx, dy, dz = dx / ratio + bend * nx, dy / ratio + bend * ny, dz / ratio + bend * nz
                    first = STRAY
                    within = what == 1 and not within
                    arrives = what == 2
            if not arrives:
                continue
            # To the mesophyll and up from it, until it is through the floor or in a dome.
            end = -1
            while True:
                left -= side.mu * side.depth / max(1e-12, abs(dz))
                if left < 0:
                    end = LOWER if below else UPPER
                    break
                been = True
                lot = np.random.random() - (tissue.reflected_below if below else tissue.reflected)  # noqa: NPY002
                if lot >= tissue.through + tissue.unscattered:
                    end = MESOPHYLL
                    break
                cos = abs(dz)
                if lot < tissue.through:
                    scattered = True
                    cos = math.sqrt(1 - np.random.random())  # noqa: NPY002
                if lot >= 0:
                    below = not below
                    side = lower if below else upper
                sin, azimuth = math.sqrt(1 - cos * cos), 2 * math.pi * np.random.random()  # noqa: NPY002
                dx, dy, dz = sin * math.cos(azimuth), sin * math.sin(azimuth), cos
                left -= side.mu * side.depth / cos
                if left < 0:
                    end = LOWER if below else UPPER
                    break
                x, y = anywhere(side.pitch)
                z = 0.0
                row = side.pitch * math.sqrt(3) / 2
                within = False
                for i in range(2):
                    for j in range(2):
                        ox, oy = x - side.pitch * (i + j / 2), y - row * j
                        if side.h > 0 and not within and ox * ox + oy * oy < 1:
                            within, x, y = True, ox, oy
                if within:
                    break
                if np.random.random() >= fresnel(cos, 1 / n):  # noqa: NPY002
                    dx, dy = n * dx, n * dy
                    dz = math.sqrt(max(0.0, 1 - dx * dx - dy * dy))
                    break
            if end >= 0:
                ends[photon] = end
                break
    return ends, cosines


@njit(cache=True, nogil=True)
def bounce(theta_deg: float, count: int, h: float, pitch: float, bounces: int, seed: int) -> tuple[NDArray[np.int64], Array]:
    """Shoot photons at white Lambert domes and floor: after how many bounces each leaves, 0 after more than `bounces`, and which way.

    Returns
    -------
    ndarray of int, shape (count,); ndarray, shape (count, 2)
        Bounces; cos(theta_r) and phi in rad, 0 on the light's side.
    """
    np.random.seed(seed)  # noqa: NPY002
    orders, ways = np.zeros(count, np.int64), np.zeros((count, 2))
    theta = math.radians(theta_deg)
    for photon in range(count):
        x, y = anywhere(pitch)
        z = h
        turn = 2 * math.pi * np.random.random()  # noqa: NPY002
        dx, dy, dz = -math.sin(theta) * math.cos(turn), -math.sin(theta) * math.sin(turn), -math.cos(theta)
        for k in range(bounces + 1):
            what, x, y, z = fly(x, y, z, dx, dy, dz, h, pitch)
            if what <= 0:
                if what == 0:
                    orders[photon] = k
                    ways[photon, 0], ways[photon, 1] = dz, (math.atan2(dy, dx) - turn) % (2 * math.pi)
                break
            nx, ny, nz = (x, y, z / h**2) if what == 1 else (0.0, 0.0, 1.0)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            # The normal and a point of the unit sphere: Lambert.
            up, azimuth = 2 * np.random.random() - 1, 2 * math.pi * np.random.random()  # noqa: NPY002
            ring = math.sqrt(1 - up * up)
            dx, dy, dz = nx / length + ring * math.cos(azimuth), ny / length + ring * math.sin(azimuth), nz / length + up
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx / length, dy / length, dz / length
    return orders, ways
