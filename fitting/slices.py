"""Integrals over the lit and seen part of a dome, slice by slice (numba kernels).

Why slices. Dividing z by k = h / a turns the domes into unit hemispheres and keeps rays straight. Light and view lie in the x-z plane, so
a ray never leaves the plane y = const it starts in, and in that plane the domes are half circles standing on a line. There, what one
direction reaches of a half circle is a single interval of the polar angle psi, found exactly. Light and view together reach the overlap of
two such intervals. Over psi the diffuse term has a closed form and the specular lobe is smooth, so nothing is sampled as lit or dark.

What remains is the mean over the slice's place y = sin(eta) and the lattice's azimuth, on a two-dimensional Fibonacci lattice rule. The
lattice repeats every 60 deg, and turning a slice over (y, azimuth -> -y, -azimuth) changes nothing, so half of the nodes are enough.

All the kernels live in this one file because numba's cache notices a change only in the file of the function it cached.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.cells import CELL_AREA

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def reach(t: float, y: float, lattice: tuple[float, float, float, float], neighbours: bool) -> float:
    """Largest angle from the beam's direction at which it still reaches a slice of a unit hemisphere.

    Parameters
    ----------
    t : float, rad
        Angle of the direction from z towards +x, 0 <= t <= pi / 2.
    y : float
        Place of the slice, -1 < y < 1.
    lattice : tuple of float
        x, y of the two lattice vectors (length 2), the first within 30 deg of x, the second 60 deg further.
    neighbours : bool
        False for a dome that stands alone.

    Returns
    -------
    float, rad
        psi - t at the edge of the shadow; pi / 2 - t, the rim of the dome, where no shadow falls.

    Notes
    -----
    Seen along the direction, a slice's circle of radius rho spans -rho .. rho and the point at psi stands at rho sin(psi - t). A
    neighbour's circle, ahead at x, begins at x cos(t) - rho_x and hides all beyond: the domes stand on the ground and do not overlap.
    """
    rho = math.sqrt(1 - y * y)
    cos_t = math.cos(t)
    edge = rim = rho * cos_t
    if neighbours:
        # Column i of centres crosses the strip within 1 of the slice around x = start + i pitch, give or take the spread.
        x1, y1, x2, y2 = lattice
        pitch = CELL_AREA / y2
        start = y * x2 / y2
        spread = abs(x2) / y2
        i = math.ceil(-(start + spread) / pitch)
        while (start + i * pitch - spread) * cos_t - 1 < edge and edge > -rho:
            j = math.floor((y - 1 - i * y1) / y2) + 1
            off = i * y1 + j * y2 - y
            while off < 1:
                x = i * x1 + j * x2
                if x > 0:
                    edge = min(edge, x * cos_t - math.sqrt(max(0.0, 1 - off * off)))
                j += 1
                off += y2
            i += 1
    return math.pi / 2 - t if edge == rim else math.asin(max(-1.0, edge / rho))


@njit(cache=True, nogil=True)
def power(x: float, exponent: float) -> float:
    """Raise to a power; whole exponents, the usual ones, by squaring, several times quicker."""
    whole = int(exponent)
    if whole != exponent or whole > 4096:
        return x**exponent
    out = 1.0
    while whole:
        if whole & 1:
            out *= x
        x *= x
        whole >>= 1
    return out


@njit(cache=True, nogil=True)
def lobe_on_slice(
    low: float, high: float, y: float, k: float, light: Array, view: Array, exponent: float, nodes: Array, weights: Array
) -> float:
    """Integrate the specular lobe, eqs. (2) to (4), over the area of a dome along a slice.

    Parameters
    ----------
    low, high : float, rad
        Bounds of tau, the angle in which the lobe is smooth: that of the normal in the x-z plane for tall domes (k > 1), the polar angle
        psi for flat ones; tan(tau) = max(1, k) tan(psi).
    y : float
        Place of the slice.
    k : float
        Height over base radius of the dome.
    light, view : ndarray, shape (2,)
        x and z of unit vectors.
    exponent : float
        n of max(0, R.V)^n, R = 2 (N.L) N - L.
    nodes, weights : ndarray
        Gauss-Legendre rule on -1 .. 1.

    Returns
    -------
    float
        Per unit of y, in a^2.
    """
    rho = math.sqrt(1 - y * y)
    s = max(1.0, k)
    middle, half = (low + high) / 2, (high - low) / 2
    light_view = light[0] * view[0] + light[1] * view[1]
    total = 0.0
    for node in range(len(nodes)):
        tau = middle + half * nodes[node]
        sin, cos = math.sin(tau), s * math.cos(tau)
        square = sin * sin + cos * cos
        scale = rho / math.sqrt(square)
        # (nx, y, nz) is normal to the dome; its length times k is the dome's area per area of the unit sphere.
        nx, nz = scale * sin, scale * cos / k
        length2 = nx * nx + y * y + nz * nz
        cos_phi = 2 * (nx * light[0] + nz * light[1]) * (nx * view[0] + nz * view[1]) / length2 - light_view
        if cos_phi > 0:
            total += weights[node] * power(cos_phi, exponent) * k * math.sqrt(length2) * s / square
    return total * half


@njit(cache=True, nogil=True)
def dome_terms(
    k: float,
    towards: Array,
    pairs: NDArray[np.int64],
    windows: Array,
    exponent: float,
    slices: int,
    generator: int,
    begin: int,
    end: int,
    diffuse: bool,
    lobe: bool,
    nodes: Array,
    weights: Array,
    neighbours: bool,
) -> Array:
    """Diffuse and specular light of the domes per area of patch, eq. (7) with (1) and with (2), for pairs of directions.

    Parameters
    ----------
    k : float
        Height over base radius of the dome.
    towards : ndarray, shape (d, 2)
        x and z of unit vectors towards the light or the detector.
    pairs : ndarray of int, shape (p, 2)
        Rows of `towards`: light, view.
    windows : ndarray, shape (p, 3), rad
        Where the specular lobe counts: lowest and highest tau, largest abs(eta).
    exponent : float
        Of the specular lobe.
    slices, generator : int
        Size (odd) and generator of the Fibonacci lattice rule over (eta, azimuth).
    begin, end : int
        Share of the rule's (slices + 1) / 2 distinct nodes; shares add up.
    diffuse, lobe : bool
        Which of the two to integrate; the other is 0.
    nodes, weights : ndarray
        Gauss-Legendre rule on -1 .. 1 for the lobe along a slice.
    neighbours : bool
        False for domes that cast no shadow on one another.

    Returns
    -------
    ndarray, shape (p, 2)
    """
    s = max(1.0, k)
    t = np.arctan2(k * towards[:, 0], towards[:, 1])
    squeezed = np.hypot(k * towards[:, 0], towards[:, 1])
    low, high = t - math.pi / 2, t + math.pi / 2
    # The ends of the reach as tau; a rising function, so bounds may be compared before or after.
    tau_low = np.arctan2(s * np.sin(low), np.cos(low))
    tau_high = np.arctan2(s * np.sin(high), np.cos(high))
    out = np.zeros((len(pairs), 2))
    widest = np.max(windows[:, 2]) if len(pairs) else 0.0
    for q in range(begin, end):
        eta = math.pi * q / slices
        if not diffuse and eta > widest:
            break
        y, rho = math.sin(eta), math.cos(eta)
        turn = (q * generator % slices) / slices
        azimuth = (turn if turn < 0.5 else turn - 1) * math.pi / 3
        further = azimuth + math.pi / 3
        lattice = (2 * math.cos(azimuth), 2 * math.sin(azimuth), 2 * math.cos(further), 2 * math.sin(further))
        weight = (2 if q else 1) * rho * math.pi / slices / CELL_AREA
        for d in range(len(t)):
            # The lattice is symmetric about the dome's centre: a direction from -x is one from +x with the slice on the other side.
            if t[d] >= 0:
                high[d] = t[d] + reach(t[d], y, lattice, neighbours)
                if lobe:
                    tau_high[d] = math.atan2(s * math.sin(high[d]), math.cos(high[d]))
            else:
                low[d] = t[d] - reach(-t[d], -y, lattice, neighbours)
                if lobe:
                    tau_low[d] = math.atan2(s * math.sin(low[d]), math.cos(low[d]))
        for p in range(len(pairs)):
            i, r = pairs[p]
            first, last = max(low[i], low[r]), min(high[i], high[r])
            if first >= last:
                continue
            if diffuse:
                # N.L dA on the dome is k |L'| rho cos(psi - t) dpsi dy on the unit sphere, L' = (Lx, Lz / k).
                out[p, 0] += weight * rho * squeezed[i] * (math.sin(last - t[i]) - math.sin(first - t[i]))
            if lobe and eta <= windows[p, 2]:
                first = max(windows[p, 0], tau_low[i], tau_low[r])
                last = min(windows[p, 1], tau_high[i], tau_high[r])
                if first < last:
                    out[p, 1] += weight * lobe_on_slice(first, last, y, k, towards[i], towards[r], exponent, nodes, weights)
    return out
