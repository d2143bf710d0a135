"""Domes and floor as quadrature points, and the horizon each point sees (numba kernels).

A dome is convex, so what faces a ray and is hidden is hidden by other domes only; and domes stand on the floor, so towards an azimuth a
point sees what is above a single slope, its horizon: the greatest slope from the point to any dome cut by that vertical plane. For
half-ellipsoids, leaning ones too, the plane cuts an ellipse and the tangent to it has a closed form; else Newton's method finds it on the
convex profile. Nothing is sampled along a ray.

All the kernels live in this one file, but for `power`, whose meaning will not change: numba's cache notices a change only in the file of
the function it cached.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.cells import Cell
from fitting.errors import DomainError
from fitting.power import power

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAST_SLOPE = 1e-3
"""Domes that rise by less than this above a point's horizontal are not looked for: 0.06 deg above the plane."""

TABLE = 20001  # nodes along a profile, from which strata are read


@njit(cache=True, nogil=True)
def steepest(z: float, ahead: float, off: float, h: float, p: float, q: float) -> float:
    """Greatest slope from a point to a dome that stands upright, in a vertical plane; 0 if that is downwards.

    Parameters
    ----------
    z : float
        Height of the point.
    ahead, off : float
        Place of the dome's axis from the point, along the plane and across it; the point is outside its base.
    h, p, q : float
        Shape of the dome.

    Notes
    -----
    The cut z(s) is concave. The tangent touches where g = z(s) - z - s z'(s) = 0; g grows with s from the near rim, where it is
    negative, to the highest point of the cut. Newton steps that leave the bracket are replaced by bisection.
    """
    square = off * off
    if square >= 1 or ahead <= 0:
        return 0.0
    top = h * (1 - square ** (p / 2)) ** (1 / q)
    if top <= z:
        return 0.0
    low, high = -math.sqrt(1 - square), 0.0
    x = 0.7 * low
    slope = 0.0
    for _ in range(80):
        r2 = square + x * x
        rp = r2 ** (p / 2)
        left = 1 - rp
        if left <= 0:
            low, x = x, (x + high) / 2
            continue
        zx = h * left ** (1 / q)
        # z' = -(h p / q) x r^(p - 2) left^(1/q - 1)
        d = -zx * p * x * rp / (q * left * r2) if r2 > 0 else 0.0
        s = ahead + x
        slope = (zx - z) / s
        g = zx - z - s * d
        if g < 0:
            low = x
        else:
            high = x
        if high - low < 1e-13 or abs(g) <= 1e-13 * h:
            break
        # z'' / z' = 1 / x + (p - 2) x / r^2 - (1/q - 1) p x r^(p-2) / left
        bend = d * (1 / x + (p - 2) * x / r2 + (1 - 1 / q) * p * x * rp / (r2 * left)) if x != 0 else 0.0
        step = g / (s * bend) if bend != 0 else 0.0  # g' = -s z''
        x = x + step if low < x + step < high and step != 0 else (low + high) / 2
    return max(0.0, slope)


@njit(cache=True, nogil=True)
def steepest_leaning(z: float, ahead: float, off: float, h: float, along: float, across: float, p: float, q: float) -> float:
    """As `steepest`, of a dome whose axis leans by (along, across) per height.

    Notes
    -----
    At each height the dome is a disc; the point's slope to it is quasi-concave over the height (the cut is convex), so golden-section
    search finds the greatest.
    """
    golden = (math.sqrt(5.0) - 1) / 2
    low, high = max(z, 0.0) / h, 1.0
    if low >= 1 or abs(off) - abs(across) * h >= 1:
        return 0.0
    # The plane cuts the discs of an interval of heights, about the one that reaches furthest over it.
    inside = low
    if _over(low, off, h, across, p, q) <= 0:
        a, b = low, high
        for _ in range(45):
            c, d = b - golden * (b - a), a + golden * (b - a)
            if _over(c, off, h, across, p, q) < _over(d, off, h, across, p, q):
                a = c
            else:
                b = d
        inside = (a + b) / 2
        if _over(inside, off, h, across, p, q) <= 0:
            return 0.0
        low = _edge(inside, low, off, h, across, p, q)
    high = _edge(inside, high, off, h, across, p, q)
    a, b = low, high
    c, d = b - golden * (b - a), a + golden * (b - a)
    at_c, at_d = _rise(c, z, ahead, off, h, along, across, p, q), _rise(d, z, ahead, off, h, along, across, p, q)
    for _ in range(45):
        if at_c < at_d:
            a, c, at_c = c, d, at_d
            d = a + golden * (b - a)
            at_d = _rise(d, z, ahead, off, h, along, across, p, q)
        else:
            b, d, at_d = d, c, at_c
            c = b - golden * (b - a)
            at_c = _rise(c, z, ahead, off, h, along, across, p, q)
    return max(0.0, at_c, at_d)


@njit(cache=True, nogil=True)
def _over(w: float, off: float, h: float, across: float, p: float, q: float) -> float:
    """How far the disc at height w h reaches over the plane; below 0 it falls short."""
    return (1 - w**q) ** (1 / p) - abs(off + w * h * across)


@njit(cache=True, nogil=True)
def _edge(inside: float, outside: float, off: float, h: float, across: float, p: float, q: float) -> float:
    """Last height towards `outside` whose disc the plane cuts, by bisection."""
    if _over(outside, off, h, across, p, q) > 0:
        return outside
    for _ in range(40):
        middle = (inside + outside) / 2
        if _over(middle, off, h, across, p, q) > 0:
            inside = middle
        else:
            outside = middle
    return inside


@njit(cache=True, nogil=True)
def _rise(w: float, z: float, ahead: float, off: float, h: float, along: float, across: float, p: float, q: float) -> float:
    """Slope from the point to the near edge of the disc at height w h; inf if it is overhead, 0 if it is behind."""
    radius, aside = (1 - w**q) ** (1 / p), off + w * h * across
    middle, half = ahead + w * h * along, math.sqrt(max(0.0, radius * radius - aside * aside))
    if middle - half > 0:
        return (w * h - z) / (middle - half)
    return math.inf if middle + half > 0 else 0.0


@njit(cache=True, nogil=True)
def tangent(z: float, ahead: float, off: float, h: float, along: float, across: float) -> float:
    """As `steepest_leaning`, of a half-ellipsoid: in closed form.

    Notes
    -----
    Shearing the axis upright and dividing z by h turn the dome into a unit sphere and a ray into a ray o + s (d0 + m d1) of slope m. It
    touches where (o.d)^2 = (o.o - 1) d.d, a quadratic in m.
    """
    ox, oy, oz = -ahead - z * along, -off - z * across, z / h
    beyond = ox * ox + oy * oy + oz * oz - 1
    first = oz / h - ox * along - oy * across
    a = first * first - beyond * (along * along + across * across + 1 / (h * h))
    b = ox * first + beyond * along
    c = ox * ox - beyond
    under = b * b - a * c
    if under <= 0:
        return 0.0
    root = math.sqrt(under)
    best = 0.0
    far = -(b + math.copysign(root, b))
    for m in ((far / a if a != 0 else 0.0), (c / far if far != 0 else 0.0)):
        if m > best and ox + m * first < 0:
            best = m
    return best


@njit(cache=True, nogil=True)
def horizon(
    x: float, y: float, z: float, site: int, own: bool, psi: float, domes: Array, pitch: float, p: float, q: float, top: float, wide: float
) -> float:
    """Tangent of the elevation above which a point sees towards an azimuth; 0 or more.

    Parameters
    ----------
    x, y, z : float
        The point, from the lattice's place `site`, in the lattice's frame.
    site : int
        Row of `domes`.
    own : bool
        Whether the point lies on that dome, which then does not hide it.
    psi : float, rad
        Azimuth of the direction in the lattice's frame.
    domes : ndarray, shape (cells^2, 5)
        `Cell.domes`.
    pitch, p, q : float
        Of the cell.
    top, wide : float
        Height of the highest dome and `Cell.reach`.

    Returns
    -------
    float
        inf for floor under a leaning dome. What lies low beyond an overhang counts as hidden.
    """
    if z >= top:
        return 0.0
    cells = round(math.sqrt(len(domes)))
    cos, sin = math.cos(psi), math.sin(psi)
    # Lattice vectors: the first within 30 deg of the direction, the second 60 deg further; (ai, aj), (bi, bj) count the cell's own.
    sixth = round(psi / (math.pi / 3))
    first = sixth * math.pi / 3 - psi
    x1, y1 = pitch * math.cos(first), pitch * math.sin(first)
    x2, y2 = pitch * math.cos(first + math.pi / 3), pitch * math.sin(first + math.pi / 3)
    way = sixth % 6
    ai, aj = (1, 0, -1, -1, 0, 1)[way], (0, 1, 1, 0, -1, -1)[way]
    bi, bj = (0, -1, -1, 0, 1, 1)[way], (1, 1, 0, -1, -1, 0)[way]
    along, across = x * cos + y * sin, y * cos - x * sin
    # Column i of centres crosses the strip around the plane at start + i step, give or take the spread.
    step = pitch * pitch * math.sqrt(3.0) / 2 / y2
    start = across * x2 / y2 - along
    spread = wide * abs(x2) / y2
    best = 0.0
    i = math.ceil(-(start + spread + wide) / step)
    while True:
        nearest = start + i * step - spread - wide
        if nearest > 0 and top - z <= max(best, LEAST_SLOPE) * nearest:
            return best
        j = math.floor((across - wide - i * y1) / y2) + 1
        off = i * y1 + j * y2 - across
        while off < wide:
            if not (own and i == 0 and j == 0):
                ahead = i * x1 + j * x2 - along
                if cells == 1:
                    dome = 0
                else:
                    si, sj = site // cells + i * ai + j * bi, site % cells + i * aj + j * bj
                    dome = (si % cells) * cells + sj % cells
                dx, dy, h, tx, ty = domes[dome]
                ahead += dx * cos + dy * sin
                aside = off + dy * cos - dx * sin
                if tx != 0 or ty != 0:
                    near = ahead - wide
                    if h <= z or ahead < -wide or (near > 0 and h - z <= best * near):
                        j += 1
                        off += y2
                        continue
                    # Straight up from the floor into a leaning dome?
                    if not own and near < 0 and _above(ahead, aside, h, tx * cos + ty * sin, ty * cos - tx * sin, p, q):
                        return math.inf
                    if p == 2 and q == 2:
                        slope = tangent(z, ahead, aside, h, tx * cos + ty * sin, ty * cos - tx * sin)
                    else:
                        slope = steepest_leaning(z, ahead, aside, h, tx * cos + ty * sin, ty * cos - tx * sin, p, q)
                    best = max(best, slope)
                elif ahead > 0 and aside * aside < 1:
                    rho2 = 1 - aside * aside
                    rho = math.sqrt(rho2)
                    if ahead <= rho or (h - z) > best * (ahead - rho):
                        if p == 2 and q == 2:
                            rise = h * h * rho2 - z * z
                            if rise > 0:
                                clear = max(0.0, ahead * ahead - rho2)
                                best = max(best, rise / (z * ahead + rho * math.sqrt(z * z + h * h * clear)))
                        else:
                            best = max(best, steepest(z, ahead, aside, h, p, q))
            j += 1
            off += y2
        i += 1


@njit(cache=True, nogil=True)
def _above(ahead: float, aside: float, h: float, along: float, across: float, p: float, q: float) -> bool:
    """Whether a leaning dome is above a point of the floor: some disc of it covers the point."""
    for n in range(65):
        w = n / 64
        dx, dy = ahead + w * h * along, aside + w * h * across
        radius = (1 - w**q) ** (1 / p)
        if dx * dx + dy * dy < radius * radius:
            return True
    return False


@njit(cache=True, nogil=True)
def horizons(
    points: Array, sites: Ints, own: bool, psi: Array, domes: Array, shape: tuple[float, float, float, float, float]
) -> NDArray[np.float32]:
    """`horizon` of many points towards many azimuths; shape (points, azimuths)."""
    pitch, p, q, top, wide = shape
    out = np.empty((len(points), len(psi)), np.float32)
    for n in range(len(points)):
        x, y, z = points[n]
        for a in range(len(psi)):
            out[n, a] = horizon(x, y, z, sites[n], own, psi[a], domes, pitch, p, q, top, wide)
    return out


@njit(cache=True, nogil=True)
def bits_set(word: np.uint64) -> np.uint64:
    """Count the bits of a 64-bit word."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


class Facets(NamedTuple):
    """Sample points in groups whose normals make the same angle with z; lengths in a.

    Attributes
    ----------
    points : ndarray, shape (b, g, 3)
        At most 64 to a group, from the lattice's place of their dome, in the lattice's frame.
    azimuths : ndarray, shape (b, g), rad
        Of their normals.
    out, up, areas : ndarray, shape (b,)
        Horizontal and vertical part of the unit normal, and the area that the group stands for, per area of patch.
    sites, own : ndarray of int and of bool, shape (b,)
        Row of `Cell.domes`, and whether the points lie on that dome or on the floor.
    offsets : ndarray, shape (b,)
        Of the directions around them, 0 to 1 step.
    """

    points: Array
    azimuths: Array
    out: Array
    up: Array
    areas: Array
    sites: Ints
    own: NDArray[np.bool_]
    offsets: Array


@njit(cache=True, nogil=True)
def _views_of(
    group: int,
    remainder: float,
    theta: Array,
    facets: Facets,
    domes: Array,
    shape: tuple[float, float, float, float, float],
    words: NDArray[np.uint64],
    cosines: Array,
) -> None:
    """Which points of a group each direction sees, as bits, and its cosine to their normals; both of shape (AROUND, t)."""
    pitch, p, q, top, wide = shape
    around, count = len(words), facets.points.shape[1]
    step = 2 * math.pi / around
    slopes = np.empty(count)
    for j in range(around):
        away = (j + facets.offsets[group]) * step - remainder
        for n in range(count):
            x, y, z = facets.points[group, n]
            psi = facets.azimuths[group, n] - away
            slopes[n] = horizon(x, y, z, facets.sites[group], facets.own[group], psi, domes, pitch, p, q, top, wide)
        ahead = facets.out[group] * math.cos(away)
        for t in range(len(theta)):
            sin, cos = math.sin(theta[t]), math.cos(theta[t])
            word = np.uint64(0)
            cosines[j, t] = ahead * sin + facets.up[group] * cos
            if cosines[j, t] > 0:
                for n in range(count):
                    word |= np.uint64(slopes[n] * sin < cos) << np.uint64(n)
            words[j, t] = word


@njit(cache=True, nogil=True)
def facet_sums(
    around: int,
    remainder: float,
    steps: Ints,
    runs: Ints,
    theta: Array,
    light: Ints,
    view: Ints,
    facets: Facets,
    domes: Array,
    shape: tuple[float, float, float, float, float],
    exponent: float,
    floor: float,
    foreshortened: bool,
) -> Array:
    """Sum what facets send from light into views, over the azimuth of the lattice, for azimuths phi a whole number of steps apart.

    Parameters
    ----------
    around : int
        Each group of facets is lit and seen from that many azimuths, even steps apart.
    remainder : float, rad
        phi = step 2 pi / around + remainder.
    steps : ndarray of int, shape (m,)
        One for each run of pairs.
    runs : ndarray of int, shape (m + 1,)
        Run n is made of the pairs runs[n] to runs[n + 1], which have the light in common.
    theta : ndarray, shape (t,), rad
        Lights and views, 0 to below pi / 2.
    light, view : ndarray of int, shape (n,)
        Pairs, as rows of `theta`. Each pair counts twice, the second time with light and view in each other's place: so that they may be
        swapped exactly.
    facets, domes, shape
        As `horizon`.
    exponent, floor : float
        Of the specular lobe; cosine of the angle from which on it is taken as 0.
    foreshortened : bool
        Whether the facets' slant to the view counts: radiometric mode.

    Returns
    -------
    ndarray, shape (n, 2)
        Sum of area x N.L (x N.V); sum of area (x N.L x N.V) x lobe; mean over the azimuths.
    """
    out = np.zeros((len(view), 2))
    here, there = np.empty((around, len(theta)), np.uint64), np.empty((around, len(theta)), np.uint64)
    cos_here, cos_there = np.empty((around, len(theta))), np.empty((around, len(theta)))
    sin, cos = np.sin(theta), np.cos(theta)
    for group in range(len(facets.areas)):
        _views_of(group, 0.0, theta, facets, domes, shape, here, cos_here)
        if remainder == 0:
            there, cos_there = here, cos_here
        else:
            _views_of(group, remainder, theta, facets, domes, shape, there, cos_there)
        weight = facets.areas[group] / (2 * around * facets.points.shape[1])
        for run in range(len(steps)):
            i = light[runs[run]]
            cos_phi = math.cos(steps[run] * 2 * math.pi / around + remainder)
            for j in range(2 * around):
                if j < around:
                    a, b = j, (j - steps[run]) % around
                    lit, seen, cos_l, cos_v = here[a], there[b], cos_here[a, i], cos_there[b]
                else:
                    a, b = (j - steps[run]) % around, j - around
                    lit, seen, cos_l, cos_v = there[a], here[b], cos_there[a, i], cos_here[b]
                if lit[i] == 0:
                    continue
                for k in range(runs[run], runs[run + 1]):
                    r = view[k]
                    both = lit[i] & seen[r]
                    if both == 0:
                        continue
                    share = weight * bits_set(both)
                    slant = cos_l * cos_v[r]
                    out[k, 0] += share * (slant if foreshortened else cos_l)
                    mirrored = 2 * slant - (sin[i] * sin[r] * cos_phi + cos[i] * cos[r])
                    if mirrored > floor:
                        out[k, 1] += share * power(mirrored, exponent) * (slant if foreshortened else 1.0)
    return out


@dataclass(frozen=True, eq=False)
class Strata:
    """A dome of radius 1 cut into rings, from its tip to its rim.

    Attributes
    ----------
    rho, z : ndarray, shape (n,)
        The middle of each ring.
    up, out : ndarray, shape (n,)
        Its area seen from above (its share of the base disc), and seen from the side and summed around: the vertical and the outward
        part of its area times normal. They add up exactly to pi and to the dome's.
    """

    rho: Array
    z: Array
    up: Array
    out: Array


def strata(cell: Cell, rings: int, tip: bool = False) -> Strata:
    """Cut a dome into rings which share evenly in its area and in the solid angle of its normals, half and half.

    So neither the flanks nor the tip of a tall dome, which makes most of its highlight, are left with few points. With `tip`, one ring
    in eleven is even in the root of the normal's angle from z: grazing light and view meet at tips only.
    """
    h, tau = cell.stretch, np.linspace(0, np.pi / 2, TABLE)
    r, z = np.sin(tau) ** (2 / cell.p), h * np.cos(tau) ** (2 / cell.q)
    r[-1], z[-1] = 1.0, 0.0
    dr, dz = np.diff(r), np.diff(z)
    ring = np.pi * (r[1:] + r[:-1])
    up, out, area = (np.concatenate([[0.0], np.cumsum(ring * d)]) for d in (dr, -dz, np.hypot(dr, dz)))
    turned = np.maximum.accumulate(np.concatenate([[0.0], 1 - dr / np.hypot(dr, dz)]))  # 1 - cos of the normal's angle from z
    measure = area / area[-1] + turned / turned[-1]
    if tip:
        measure += (turned / turned[-1]) ** 0.25 / 5  # the root of the angle, near the tip
    edges, middles = np.linspace(0, measure[-1], rings + 1), (np.arange(rings) + 0.5) * measure[-1] / rings
    rho = np.sqrt(np.interp(middles, measure, up) / np.pi)
    return Strata(rho, cell.profile(rho), *(np.diff(np.interp(edges, measure, total)) for total in (up, out)))


def gaps(cell: Cell, points: int) -> Array:
    """About that many points of the supercell's floor that no base covers, evenly; shape (n, 2), in the lattice's frame."""
    cells = 1 if cell.spread.is_none else cell.spread.cells
    domes = cell.domes()
    free = floor_share(cell)
    if free < 1e-12:
        return np.empty((0, 2))
    n = np.arange(1, math.ceil(points / free) + 1)
    u = np.column_stack([n * 0.7548776662466927 % 1, n * 0.5698402909980532 % 1]) * cells  # Kronecker's sequence of the plastic number
    places = cell.pitch * np.column_stack([u[:, 0] + u[:, 1] / 2, math.sqrt(3) / 2 * u[:, 1]])
    covered = np.zeros(len(places), bool)
    for i in range(-1, cells + 1):
        for j in range(-1, cells + 1):
            centre = cell.pitch * np.array([i + j / 2, math.sqrt(3) / 2 * j]) + domes[(i % cells) * cells + j % cells, :2]
            covered |= np.sum((places - centre) ** 2, axis=1) < 1
    return places[~covered]


def floor_share(cell: Cell) -> float:
    """Share of the patch that no base covers."""
    return 1 - math.pi / cell.cell_area


def shape_of(cell: Cell) -> tuple[float, float, float, float, float]:
    """Pitch, exponents, greatest height and reach, as the kernels take them."""
    return cell.pitch, float(cell.p), float(cell.q), float(cell.domes()[:, 2].max()), cell.reach


@dataclass(frozen=True, eq=False)
class Surface:
    """Quadrature points of one period of the patch, domes first, then floor; lengths in a, the lattice's own frame.

    Attributes
    ----------
    points, normals : ndarray, shape (n, 3)
        Outward unit normals.
    areas : ndarray, shape (n,)
        Area of the surface each stands for, per area of patch; areas times normals add up to (0, 0, 1).
    horizon : ndarray of float32, shape (n, around)
        Tangent of the elevation above which the point sees, towards the azimuths j 360 / around deg; never below 0. A direction d is
        seen where normal . d > 0 and the tangent of its elevation is greater.
    is_floor : ndarray of bool, shape (n,)
    """

    points: Array
    normals: Array
    areas: Array
    horizon: NDArray[np.float32]
    is_floor: NDArray[np.bool_]


def surface(cell: Cell, rows: int = 24, columns: int = 48, around: int = 72) -> Surface:
    """Lay quadrature points on one period of a patch, the supercell where domes differ.

    Parameters
    ----------
    cell : Cell
        The shape.
    rows, columns : int
        Points from the tip of a dome to its rim, and around it. The floor's points are about as dense as the domes' seen from above.
    around : int
        Azimuths of the horizon.

    Returns
    -------
    Surface

    Raises
    ------
    DomainError
        If a count is too small.
    """
    if rows < 1 or columns < 3 or around < 1:
        raise DomainError(f"a surface needs 1 row, 3 columns and 1 azimuth or more, not {rows}, {columns} and {around}")
    rings, domes = strata(cell, rows), cell.domes()
    cells = math.isqrt(len(domes))
    azimuth = (np.arange(columns) + 0.5) * 2 * np.pi / columns
    # A column's mean normal is a little shorter than 1 / columns of the ring's: the chord's, so that all close.
    chord = math.sin(math.pi / columns) / (math.pi / columns)
    grid = np.broadcast_arrays(
        rings.rho[:, None], rings.z[:, None], azimuth, rings.up[:, None] / columns, rings.out[:, None] / columns * chord
    )
    rho, z, a, up, out = (g.ravel() for g in grid)
    sites = np.repeat(np.arange(len(domes)), len(rho))
    dx, dy, h, tx, ty = (np.repeat(column, len(rho)) for column in domes.T)
    rho, z, a, up, out = (np.tile(g, len(domes)) for g in (rho, z, a, up, out))
    taller = h / cell.stretch
    z = z * taller
    local = np.column_stack([rho * np.cos(a) + z * tx + dx, rho * np.sin(a) + z * ty + dy, z])
    vector = sheared(np.column_stack([out * taller * np.cos(a), out * taller * np.sin(a), up]), tx, ty)
    floor = gaps(cell, max(1, round(floor_share(cell) * rows * columns * len(domes))))
    grounds = np.column_stack([floor, np.zeros(len(floor))])
    psi = np.arange(around) * 2 * np.pi / around
    seen = (domes, shape_of(cell))
    horizon = np.concatenate(
        [horizons(local, sites, True, psi, *seen), horizons(grounds, np.zeros(len(floor), np.int64), False, psi, *seen)]
    )
    i, j = sites // cells, sites % cells
    places = np.column_stack([i + j / 2, math.sqrt(3) / 2 * j, 0 * i]) * cell.pitch
    areas = np.linalg.norm(vector, axis=1)
    share = np.full(len(floor), floor_share(cell) / max(1, len(floor)))
    return Surface(
        np.concatenate([local + places, grounds]),
        np.concatenate([vector / areas[:, None], np.tile([0.0, 0.0, 1.0], (len(floor), 1))]),
        np.concatenate([areas / cell.cell_area / len(domes), share]),
        horizon,
        np.arange(len(local) + len(floor)) >= len(local),
    )


def sheared(vectors: Array, along_x: Array, along_y: Array) -> Array:
    """Areas times normals of a dome after its axis leans by dx / dz, dy / dz: turned by the cofactors of the shear."""
    out = vectors.copy()
    out[:, 2] -= along_x * vectors[:, 0] + along_y * vectors[:, 1]
    return out
