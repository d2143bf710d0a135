"""Surfaces of known shape, as a scanner would grid them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scanning.rangeimage import RangeImage

Array = NDArray[np.float64]

STEP = 0.35  # mm, the paper's 70 mm over 200 points
PETAL_LENGTH = 36.0
CLAW_WIDTH = 5.0
INFLECTION = 0.6  # of the petal's length
BEND = 8.0  # mm


def scan(
    height: Callable[[Array, Array], Array],
    inside: Callable[[Array, Array], NDArray[np.bool_]] = lambda x, y: np.ones_like(x, dtype=bool),
    *,
    size: int = 200,
    noise: float = 0.0,
    quantum: float = 0.0,
    seed: int = 0,
) -> RangeImage:
    """Grid z = height(x, y), rows from the top down, with normal noise and then quantised, mm."""
    x = (np.arange(size) - (size - 1) / 2) * STEP
    x, y = np.meshgrid(x, -x)
    z = height(x, y) + noise * np.random.default_rng(seed).standard_normal(x.shape)
    if quantum:
        z = np.round(z / quantum) * quantum
    valid = inside(x, y)
    return RangeImage(np.where(valid[..., None], np.stack([x, y, z], axis=-1), np.nan), valid)


def with_depths(image: RangeImage, changes: Array, valid: NDArray[np.bool_] | None = None) -> RangeImage:
    """Return the image with depths changed, and with other points valid."""
    points = image.points.copy()
    points[..., 2] += changes
    return RangeImage(points, image.valid if valid is None else valid)


def turned(x: Array, y: Array, angle: float) -> tuple[Array, Array]:
    """Across and along a petal whose axis is turned by an angle (deg) from y, its base half a length below the window's centre."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return c * x + s * y, -s * x + c * y + PETAL_LENGTH / 2


def petal_scan(angle: float = 0.0, *, s_shaped: bool = True, noise: float = 0.0, quantum: float = 0.0, seed: int = 0) -> RangeImage:
    """Scan of a petal: a claw that widens to a round blade, cupped across; along, cupped below and reflexed above, or cupped throughout."""

    def inside(x: Array, y: Array) -> NDArray[np.bool_]:
        return petal_inside(*turned(x, y, angle))

    def height(x: Array, y: Array) -> Array:
        u, v = turned(x, y, angle)
        return petal_height(v / PETAL_LENGTH, s_shaped) + 0.012 * u**2

    return scan(height, inside, noise=noise, quantum=quantum, seed=seed)


def petal_inside(u: Array, v: Array) -> NDArray[np.bool_]:
    """Whether points u mm across and v mm along lie on the petal."""
    t = np.clip(v / PETAL_LENGTH, 0, 1)
    half = (CLAW_WIDTH / 2 + 15 * np.sin(np.pi / 2 * t**1.3)) * np.sqrt(1 - np.clip((t - 0.6) / 0.4, 0, 1) ** 2)
    return np.asarray((np.abs(u) < half) & (v >= 0) & (v <= PETAL_LENGTH))


def petal_height(t: Array | float, s_shaped: bool = True) -> Array:
    """Height of the midrib at a part t of its length, mm; the second derivative changes sign at INFLECTION."""
    t = np.asarray(t, dtype=float)
    return BEND * (3 * INFLECTION * t**2 - t**3) if s_shaped else BEND * t**2


def petal_point(angle: float, t: float, s_shaped: bool = True) -> Array:
    """Point of the midrib in the scan frame, mm."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    v = (t - 0.5) * PETAL_LENGTH
    return np.array([-s * v, c * v, float(petal_height(t, s_shaped))])
