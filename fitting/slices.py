"""Integrals over the lit and seen part of a dome, slice by slice (numba kernels).

Why slices. Dividing z by k = h / a turns the domes into unit hemispheres and keeps rays straight. Light and view lie in the x-z plane, so
a ray never leaves the plane y = const it starts in, and in that plane the domes are half circles standing on a line. There, what one
direction reaches of a half circle is a single interval of the polar angle psi, found exactly. Light and view together reach the overlap of
two such intervals. Over psi the diffuse term has a closed form and the specular lobe is smooth, so nothing is sampled as lit or dark.
All ends of intervals lie within -pi / 2 .. pi / 2, where the sine rises: angles are kept as sine and cosine, and no slice needs a
trigonometric function.

What remains is the mean over the slice's place y = sin(eta) and the lattice's azimuth, on a two-dimensional Fibonacci lattice rule. The
lattice repeats every 60 deg, and turning a slice over (y, azimuth -> -y, -azimuth) changes nothing, so half of the nodes are enough.

All the kernels live in this one file, but for `power`, whose meaning will not change: numba's cache notices a change only in the file of
the function it cached.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.cells import CELL_AREA
from fitting.power import power

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def reach(sin_t: float, cos_t: float, y: float, lattice: tuple[float, float, float, float], neighbours: bool) -> float:
    """Largest angle from the beam's direction at which it still reaches a slice of a unit hemisphere, as its sine.

    Parameters
    ----------
    sin_t, cos_t : float
        Of the direction's angle from z towards +x, 0 <= t <= pi / 2.
    y : float
        Place of the slice, -1 < y < 1.
    lattice : tuple of float
        x, y of the two lattice vectors (length 2), the first within 30 deg of x, the second 60 deg further.
    neighbours : bool
        False for a dome that stands alone.

    Returns
    -------
    float
        sin(psi - t) at the edge of the shadow; cos(t), the rim of the dome, where no shadow falls.

    Notes
    -----
    Seen along the direction, a slice's circle of radius rho spans -rho .. rho and the point at psi stands at rho sin(psi - t). A
    neighbour's circle, ahead at x, begins at x cos(t) - rho_x and hides all beyond: the domes stand on the ground and do not overlap.
    """
    rho = math.sqrt(1 - y * y)
    edge = rim = rho * cos_t
    if neighbours and sin_t > 0:
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
                over = x * cos_t - edge  # what must be less than the neighbour's half width
                if x > 0 and (over <= 0 or over * over < 1 - off * off):
                    edge = x * cos_t - math.sqrt(max(0.0, 1 - off * off))
                j += 1
                off += y2
            i += 1
    return cos_t if edge == rim else max(-1.0, edge / rho)


@njit(cache=True, nogil=True)
def lobe_on_slice(
    sin_1: float,
    cos_1: float,
    sin_2: float,
    cos_2: float,
    y: float,
    k: float,
    light: Array,
    view: Array,
    exponent: float,
    nodes: Array,
    weights: Array,
) -> float:
    """Integrate the specular lobe, eqs. (2) to (4), over the area of a dome along a slice.

    Parameters
    ----------
    sin_1, cos_1, sin_2, cos_2 : float
        Of the polar angle psi where the integral begins and ends, within -pi / 2 .. pi / 2.
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

    Notes
    -----
    The lobe is smooth over tau, the angle of the normal in the x-z plane for tall domes (k > 1), psi for flat ones:
    tan(tau) = max(1, k) tan(psi). The rule runs over u = tan((tau - middle) / 2), of which sine and cosine are rational.
    """
    s = max(1.0, k)
    long_1, long_2 = math.sqrt(s * s * sin_1 * sin_1 + cos_1 * cos_1), math.sqrt(s * s * sin_2 * sin_2 + cos_2 * cos_2)
    sin_1, cos_1, sin_2, cos_2 = s * sin_1 / long_1, cos_1 / long_1, s * sin_2 / long_2, cos_2 / long_2
    # Sum and difference of the two unit vectors: along the middle and across it, 2 cos and 2 sin of half the angle between them.
    along, across = math.hypot(sin_1 + sin_2, cos_1 + cos_2), math.hypot(sin_2 - sin_1, cos_2 - cos_1)
    if along > across:
        sin_m, cos_m = (sin_1 + sin_2) / along, (cos_1 + cos_2) / along
    else:
        sin_m, cos_m = (cos_1 - cos_2) / across, (sin_2 - sin_1) / across
    span = across / (2 + along)
    rho2, y2 = 1 - y * y, y * y
    light_view = light[0] * view[0] + light[1] * view[1]
    total = 0.0
    for node in range(len(nodes)):
        u = span * nodes[node]
        whole = 1 / (1 + u * u)
        sin_d, cos_d = 2 * u * whole, (1 - u * u) * whole
        sin, cos = sin_m * cos_d + cos_m * sin_d, s * (cos_m * cos_d - sin_m * sin_d)
        square = sin * sin + cos * cos
        up = cos / k
        # rho / sqrt(square) (sin, ., up) and y are normal to the dome; its length times k is the dome's area per area of the unit sphere.
        scale2 = rho2 / square
        length2 = scale2 * (sin * sin + up * up) + y2
        cos_phi = 2 * scale2 * (sin * light[0] + up * light[1]) * (sin * view[0] + up * view[1]) / length2 - light_view
        if cos_phi > 0:
            total += weights[node] * whole * power(cos_phi, exponent) * math.sqrt(length2) / square
    return 2 * span * k * s * total


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
        Where the specular lobe counts: lowest and highest psi, largest abs(eta).
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
    squeezed = np.hypot(k * towards[:, 0], towards[:, 1])
    sin_t, cos_t = k * towards[:, 0] / squeezed, towards[:, 1] / squeezed
    # Sine and cosine of the ends of the reach. On the side away from the direction the dome itself ends it.
    sin_low, cos_low, sin_high, cos_high = -cos_t, np.maximum(0.0, sin_t), cos_t.copy(), np.maximum(0.0, -sin_t)
    window = np.empty((len(pairs), 4))
    for p in range(len(pairs)):
        window[p] = math.sin(windows[p, 0]), math.cos(windows[p, 0]), math.sin(windows[p, 1]), math.cos(windows[p, 1])
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
        for d in range(len(sin_t)):
            # The lattice is symmetric about the dome's centre: a direction from -x is one from +x with the slice on the other side.
            side = 1.0 if sin_t[d] >= 0 else -1.0
            edge = reach(side * sin_t[d], cos_t[d], side * y, lattice, neighbours)
            beside = math.sqrt(1 - edge * edge)
            sin = edge * cos_t[d] + beside * side * sin_t[d]
            cos = max(0.0, beside * cos_t[d] - edge * side * sin_t[d])
            if side > 0:
                sin_high[d], cos_high[d] = sin, cos
            else:
                sin_low[d], cos_low[d] = -sin, cos
        for p in range(len(pairs)):
            i, r = pairs[p]
            first, last = (i if sin_low[i] > sin_low[r] else r), (i if sin_high[i] < sin_high[r] else r)
            sin_1, cos_1, sin_2, cos_2 = sin_low[first], cos_low[first], sin_high[last], cos_high[last]
            if sin_1 >= sin_2:
                continue
            if diffuse:
                # N.L dA on the dome is k |L'| rho cos(psi - t) dpsi dy on the unit sphere, L' = (Lx, Lz / k).
                out[p, 0] += weight * rho * squeezed[i] * ((sin_2 - sin_1) * cos_t[i] - (cos_2 - cos_1) * sin_t[i])
            if lobe and eta <= windows[p, 2]:
                if window[p, 0] > sin_1:
                    sin_1, cos_1 = window[p, 0], window[p, 1]
                if window[p, 2] < sin_2:
                    sin_2, cos_2 = window[p, 2], window[p, 3]
                if sin_1 < sin_2:
                    light, view = towards[i], towards[r]
                    out[p, 1] += weight * lobe_on_slice(sin_1, cos_1, sin_2, cos_2, y, k, light, view, exponent, nodes, weights)
    return out
