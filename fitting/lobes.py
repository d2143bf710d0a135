"""Directions drawn as a reflectance sends light: tabulated inversion, first theta_r, then phi.

For each tabulated theta_i the hemisphere of views is cut into cells, even in theta_r and phi, with a share of the light each; between two
theta_i the shares go over linearly. Within a cell directions are spread evenly over the projected solid angle cos(theta_r) d(omega) =
d(sin^2 theta_r) d(phi) / 2. Pharr, Jakob, Humphreys, Physically Based Rendering, 4th ed., A.4 and A.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

CELLS = 60
"""Cells along theta_r over 90 deg, and along phi over 180 deg."""

EVERYWHERE = 0.02
"""Share drawn evenly over the projected hemisphere: no direction that sends light is left out where a cell's samples saw none."""

POINTS = 2
"""Points along each side of a cell that its share is taken from."""


@dataclass(frozen=True, eq=False)
class Lobes:
    """Shares of light in cells of views, cumulated.

    Attributes
    ----------
    theta_i : ndarray, shape (i,), deg
        Tabulated incidences.
    rows : ndarray, shape (i, CELLS + 1)
        Share of the light below each edge of theta_r.
    cells : ndarray, shape (i, CELLS, CELLS + 1)
        Within each row, share of all light below each edge of phi.
    """

    theta_i: Array
    rows: Array
    cells: Array


def lobes(value: Callable[[Array, Array, Array], Array], theta_i: Array) -> Lobes:
    """Cut the light sent from some incidences into cells.

    Parameters
    ----------
    value : callable
        Radiance or BRDF from theta_i, theta_r, phi in deg, 0 or more.
    theta_i : ndarray, shape (i,), deg
        Rising.

    Returns
    -------
    Lobes
    """
    middle = (np.arange(CELLS * POINTS) + 0.5) / (CELLS * POINTS)
    area = np.diff(np.sin(np.linspace(0, np.pi / 2, CELLS + 1)) ** 2)[:, None] / CELLS  # projected, of a cell; all together 1
    cells = np.zeros((len(theta_i), CELLS, CELLS + 1))
    for n, incidence in enumerate(theta_i):
        sent = value(np.array(incidence), 90 * middle[:, None], 180 * middle[None, :])
        share = sent.reshape(CELLS, POINTS, CELLS, POINTS).mean(axis=(1, 3)) * area
        total = share.sum()
        mixed = (1 - EVERYWHERE) * share / total + EVERYWHERE * area if total > 0 else np.broadcast_to(area, share.shape)
        np.cumsum(mixed, axis=1, out=cells[n, :, 1:])
    rows = np.zeros((len(theta_i), CELLS + 1))
    np.cumsum(cells[:, :, -1], axis=1, out=rows[:, 1:])
    last = rows[:, -1:]  # 1 but for rounding
    return Lobes(np.array(theta_i), rows / last, cells / last[:, :, None])


@njit(cache=True, nogil=True)
def _between(nodes: Array, x: float) -> tuple[int, float]:
    """First of the two nodes about x, and how far x lies towards the other; beyond the ends the ends."""
    low, high = 0, len(nodes) - 1
    if x <= nodes[0]:
        return 0, 0.0
    if x >= nodes[high]:
        return high - 1, 1.0
    while high - low > 1:
        middle = (low + high) // 2
        if nodes[middle] <= x:
            low = middle
        else:
            high = middle
    return low, (x - nodes[low]) / (nodes[high] - nodes[low])


@njit(cache=True, nogil=True)
def _invert(below: Array, above: Array, t: float, u: float) -> tuple[int, float, float]:
    """Cell of a mixed cumulation that holds u, how far u is into it, and the cell's share."""
    low, high = 0, len(below) - 1
    at_low = (1 - t) * below[0] + t * above[0]
    at_high = (1 - t) * below[high] + t * above[high]
    while high - low > 1:
        middle = (low + high) // 2
        at = (1 - t) * below[middle] + t * above[middle]
        if at <= u:
            low, at_low = middle, at
        else:
            high, at_high = middle, at
    return low, min(max((u - at_low) / (at_high - at_low), 0.0), 1.0), at_high - at_low


@njit(cache=True, nogil=True)
def draw(nodes: Array, rows: Array, cells: Array, theta_i: Array, u1: Array, u2: Array, theta_r: Array, phi: Array) -> int:
    """Turn two even numbers into a view.

    Parameters
    ----------
    nodes, rows, cells : ndarray
        `Lobes`.
    theta_i : ndarray, shape (n,), deg
        0 to 90.
    u1, u2 : ndarray, shape (n,)
        0 or more, below 1: theta_r rises with u1, phi with u2.
    theta_r, phi : ndarray, shape (n,), deg
        Written: 0 to 90, -180 to 180.

    Returns
    -------
    int
        -1, or the first that is out of range, where it stopped.
    """
    step = math.pi / 2 / CELLS
    for n in range(len(theta_i)):
        if not (theta_i[n] >= 0 and theta_i[n] <= 90 and u1[n] >= 0 and u1[n] < 1 and u2[n] >= 0 and u2[n] < 1):
            return n
        i, t = _between(nodes, theta_i[n])
        k, x, _ = _invert(rows[i], rows[i + 1], t, u1[n])
        low, high = math.sin(k * step) ** 2, math.sin((k + 1) * step) ** 2
        side = 2 * u2[n] - 1
        total = (1 - t) * cells[i, k, CELLS] + t * cells[i + 1, k, CELLS]
        m, y, _ = _invert(cells[i, k], cells[i + 1, k], t, abs(side) * total)
        theta_r[n] = math.degrees(math.asin(math.sqrt(low + x * (high - low))))
        phi[n] = math.copysign(180.0 * (m + y) / CELLS, side)
    return -1


@njit(cache=True, nogil=True)
def density(nodes: Array, rows: Array, cells: Array, theta_i: Array, theta_r: Array, phi: Array, out: Array) -> int:
    """How densely `draw` draws views, 1/sr.

    Parameters
    ----------
    nodes, rows, cells : ndarray
        `Lobes`.
    theta_i, theta_r, phi : ndarray, shape (n,), deg
        As for `fitting.interpolate.look_up`.
    out : ndarray, shape (n,)
        Written.

    Returns
    -------
    int
        -1, or the first that is out of range, where it stopped.
    """
    step = math.pi / 2 / CELLS
    for n in range(len(theta_i)):
        if not (theta_i[n] >= 0 and theta_i[n] <= 90 and abs(theta_r[n]) <= 90 and math.isfinite(phi[n])):
            return n
        azimuth = abs(phi[n] - 360 * np.floor(phi[n] / 360 + 0.5))
        if theta_r[n] < 0:
            azimuth = 180 - azimuth
        i, t = _between(nodes, theta_i[n])
        view = math.radians(abs(theta_r[n]))
        k, m = min(int(view / step), CELLS - 1), min(max(int(azimuth * CELLS / 180), 0), CELLS - 1)
        share = (1 - t) * (cells[i, k, m + 1] - cells[i, k, m]) + t * (cells[i + 1, k, m + 1] - cells[i + 1, k, m])
        area = (math.sin((k + 1) * step) ** 2 - math.sin(k * step) ** 2) * math.pi / CELLS  # projected, left and right
        out[n] = share * math.cos(view) / area
    return -1
