"""Light and view from anywhere above the domes: which points each sees, and what eq. (7) makes of it (numba kernels).

Dividing z by k = h / a turns the domes into unit hemispheres and keeps rays straight. A point of a hemisphere is then seen from a direction
where it faces it and the ray clears the neighbouring spheres. Domes are sampled on a polar grid whose azimuths, and the lattice's, step
alike; so what is seen from one azimuth serves for all of them, turned round by whole steps, and a pair of directions needs two look-ups a
point. The answers for all azimuths of the lattice are kept as the bits of one number a point.

Kernels are serial and let go of the interpreter's lock: callers spread them over threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.cells import CELL_AREA

Array = NDArray[np.float64]
Bits = NDArray[np.uint32]


@njit(cache=True, nogil=True)
def seen_from(t: float, tau: Array, stretch: float, around: int, turns: int, centres: Array) -> Bits:
    """Which points of a hemisphere are seen from a direction above the x axis, for each azimuth of the lattice.

    Parameters
    ----------
    t : float, rad
        Angle of the direction from z among the hemispheres, 0 <= t < pi / 2.
    tau : ndarray, shape (m,), rad
        Rows of the polar grid: tan(tau) = stretch * tan(polar angle).
    stretch : float
        As above.
    around : int
        Columns of the polar grid, at azimuths (j + 1/2) 2 pi / around.
    turns : int
        Azimuths of the lattice: (n + 1/2) pi / 3 / turns, at most 32.
    centres : ndarray, shape (c, 2)
        Neighbours' centres at azimuth 0, nearest first.

    Returns
    -------
    ndarray of uint32, shape (m, around)
        Bit n is set where the point is seen with the lattice at azimuth n.
    """
    out = np.zeros((len(tau), around), np.uint32)
    dx, dz = math.sin(t), math.cos(t)
    for n in range(turns):
        azimuth = (n + 0.5) * math.pi / 3 / turns
        sin, cos = math.sin(azimuth), math.cos(azimuth)
        for m in range(len(tau)):
            polar = math.atan2(math.sin(tau[m]), stretch * math.cos(tau[m]))
            z, rho = math.cos(polar), math.sin(polar)
            reach = (1 - z) / dz * dx + 2  # beyond, the ray is above all domes
            for j in range(around):
                a = (j + 0.5) * 2 * math.pi / around
                x, y = rho * math.cos(a), rho * math.sin(a)
                if x * dx + z * dz <= 0:
                    continue
                free = True
                for c in range(len(centres)):
                    cx, cy = centres[c, 0], centres[c, 1]
                    if cx * cx + cy * cy > reach * reach:
                        break
                    ex, ey = cos * cx - sin * cy - x, sin * cx + cos * cy - y
                    ahead = ex * dx - z * dz
                    if ahead > 0 and ex * ex + ey * ey + z * z - ahead * ahead < 1:
                        free = False
                        break
                if free:
                    out[m, j] |= np.uint32(1) << np.uint32(n)
    return out


@njit(cache=True, nogil=True)
def bits_set(word: np.uint32) -> int:
    """Count the bits of a 32-bit word."""
    word = word - ((word >> np.uint32(1)) & np.uint32(0x55555555))
    word = (word & np.uint32(0x33333333)) + ((word >> np.uint32(2)) & np.uint32(0x33333333))
    word = (word + (word >> np.uint32(4))) & np.uint32(0x0F0F0F0F)
    return int(((np.uint64(word) * np.uint64(0x01010101)) >> np.uint64(24)) & np.uint64(0xFF))


@njit(cache=True, nogil=True)
def domes_at(
    theta_i: float,
    lit: Bits,
    theta_r: Array,
    seen: NDArray[np.uint32],
    steps: int,
    turns: int,
    tau: Array,
    d_tau: Array,
    stretch: float,
    k: float,
    exponent: float,
    floor: float,
) -> Array:
    """Diffuse and specular light of the domes per area of patch, eq. (7) with (1) and with (2), at one incidence.

    Parameters
    ----------
    theta_i : float, rad
        Incidence, above the x axis.
    lit : ndarray of uint32, shape (m, around)
        `seen_from` the light.
    theta_r : ndarray, shape (r,), rad
        Views.
    seen : ndarray of uint32, shape (r, m, around)
        `seen_from` each view, each taken above the x axis.
    steps : int
        The view's azimuth takes `steps + 1` values from 0 to pi, each a whole number of the grid's columns and of the lattice's turns.
    turns : int
        Azimuths of the lattice.
    tau, d_tau : ndarray, shape (m,), rad
        Rows of the polar grid and their widths.
    stretch, k : float
        Of the grid; height over base radius of the domes.
    exponent, floor : float
        Of the specular lobe; cosine of the angle from which on the lobe is taken as 0.

    Returns
    -------
    ndarray, shape (r, steps + 1, 2)
    """
    rows, around = lit.shape
    columns = around // (2 * steps)  # to a step
    beyond = np.uint32((np.int64(1) << turns) - 1)
    per_turn = (6 * turns) // (2 * steps)
    out = np.zeros((len(theta_r), steps + 1, 2))
    lx, lz = math.sin(theta_i), math.cos(theta_i)
    cosine = np.empty(around)
    sine = np.empty(around)
    for j in range(around):
        cosine[j] = math.cos((j + 0.5) * 2 * math.pi / around)
        sine[j] = math.sin((j + 0.5) * 2 * math.pi / around)
    for m in range(rows):
        tan = math.sin(tau[m]) / math.cos(tau[m]) / stretch
        z = 1 / math.sqrt(1 + tan * tan)
        rho = tan * z
        # Along the row: dpolar/dtau from tan(tau) = stretch tan(polar); (x, y, z / k) is normal to the dome, k times its length its area.
        length = math.sqrt(rho * rho + z * z / (k * k))
        d_polar = d_tau[m] * stretch / (stretch * stretch * math.cos(tau[m]) ** 2 + math.sin(tau[m]) ** 2)
        area = k * length * rho * d_polar * 2 * math.pi / around / turns / CELL_AREA
        n_rho, nz = rho / length, z / k / length
        for j in range(around):
            if lit[m, j] == 0:
                continue
            nx, ny = n_rho * cosine[j], n_rho * sine[j]
            cos_l = nx * lx + nz * lz
            rx, ry, rz = 2 * cos_l * nx - lx, 2 * cos_l * ny, 2 * cos_l * nz - lz
            for step in range(steps + 1):
                # As the view sees it: the point and the lattice are turned back by its azimuth.
                turn = (step * per_turn) % turns
                word = lit[m, j]
                word = ((word >> np.uint32(turn)) | (word << np.uint32(turns - turn))) & beyond if turn else word
                column = (j - step * columns) % around
                phi = math.pi * step / steps
                along = rx * math.cos(phi) + ry * math.sin(phi)
                for r in range(len(theta_r)):
                    both = word & seen[r, m, column]
                    if both == 0:
                        continue
                    weight = area * bits_set(both)
                    out[r, step, 0] += weight * cos_l
                    cos_phi = along * math.sin(theta_r[r]) + rz * math.cos(theta_r[r])
                    if cos_phi > floor:
                        out[r, step, 1] += weight * cos_phi**exponent
    return out
