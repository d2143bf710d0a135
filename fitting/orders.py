"""Interreflection between the domes, by the number of bounces, for Lambert facets of any albedo.

The geometry is traced once. One period of the patch is cut into facets; what share of a beam falls on each follows from the horizons
(`fitting.surface`), what share of a facet's light falls on another from rays (`fitting.tracing.march`). Light on its way is then a vector
over facets, a bounce a matrix product, and s_k(theta_i, theta_r, phi) = (1 / pi) E(L) F^(k-1) A^-1 E(V): radiosity, with the beam as source
and the view as its own adjoint, so that light and view may be swapped exactly. An albedo afterwards is a sum, sum_k albedo^k s_k.

Single bounce is not taken from the facets, whose parts lit and seen may differ, but integrated exactly (`fitting.radiometric`).

Nothing is lost: facets and sky share a facet's light by rows made to sum to 1 and to be reciprocal, and the orders from the second on are
scaled, symmetrically in light and view, to what single bounce leaves (`closure` tells how far apart the two are). A white furnace is white.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from fitting.cells import Cell
from fitting.errors import DomainError
from fitting.tracing import DOME, ESCAPED, LOST, march

Array = NDArray[np.float64]

FINE = 3  # rows of quadrature points to a ring of facets
AROUND = 72  # azimuths of light and view
BALANCE = 200  # sweeps at most until rows sum to 1


@dataclass(frozen=True, eq=False)
class EscapeOrders:
    """Light that leaves after each number of bounces, in 1/sr for albedo 1.

    Attributes
    ----------
    cell : Cell
        The shape.
    theta_i_deg, theta_r_deg, phi_deg : ndarray, shapes (i,), (r,), (p,), deg
        Nodes.
    orders : ndarray, shape (K, i, r, p), 1/sr
        s_1 to s_K.
    rest : ndarray, shape (i, r, p), 1/sr
        Sum of all later orders.
    decay : ndarray, shape (i, r, p)
        By which later orders fall, as the first of them and their sum have it; below 1.
    closure : float
        Largest share of a beam by which single bounce between facets differs from the exact one; the scaling makes up for it.
    unclosed : float
        Largest departure from 1 of a row of form factors before it was made to sum to 1.
    seed : int
        Of the rays' places.
    """

    cell: Cell
    theta_i_deg: Array
    theta_r_deg: Array
    phi_deg: Array
    orders: Array
    rest: Array
    decay: Array
    closure: float
    unclosed: float
    seed: int

    def reflectance(self, albedo: float) -> Array:
        """Return f_r at the nodes for facets of an albedo, all orders, shape (i, r, p), 1/sr.

        Later orders are taken as a geometric row: with six orders kept and rose cells within 2 %, and exact at albedo 1.

        Raises
        ------
        DomainError
            If the albedo is not within 0 and 1.
        """
        if not 0 <= albedo <= 1:
            raise DomainError(f"an albedo must be within 0 and 1, not {albedo!r}")
        count = len(self.orders)
        known = np.tensordot(albedo ** np.arange(1, count + 1), self.orders, 1)
        # Later orders as a geometric row: exact at albedo 1, and in its first term.
        return np.asarray(known + albedo ** (count + 1) * (1 - self.decay) / (1 - albedo * self.decay) * self.rest)


def escape_orders(
    cell: Cell,
    theta_i_deg: ArrayLike,
    theta_r_deg: ArrayLike,
    phi_deg: ArrayLike,
    *,
    orders: int = 6,
    rings: int = 14,
    sectors: int = 36,
    rays: int = 4096,
    seed: int = 0,
) -> EscapeOrders:
    """Trace a cell once and return how light leaves it by the number of bounces.

    Parameters
    ----------
    cell : Cell
        The shape; domes all alike.
    theta_i_deg, theta_r_deg, phi_deg : array_like, shapes (i,), (r,), (p,), deg
        Nodes: 0 <= theta < 90, and phi, 0 on the light's side, a multiple of 5 deg.
    orders : int
        Orders kept one by one.
    rings, sectors : int
        Facets from a dome's tip to its rim and around it; sectors a multiple of 6.
    rays : int
        From each facet, a power of 2.
    seed : int
        Of their places.

    Raises
    ------
    DomainError
        If a node or a count is outside the model, or the domes differ.

    Notes
    -----
    Radiosity: Goral, Torrance, Greenberg and Battaile, Computer Graphics 18(3), 213, 1984.
    """
    from fitting.radiometric import radiometric_terms

    theta_i, theta_r, phi = (np.atleast_1d(np.asarray(a, float)) for a in (theta_i_deg, theta_r_deg, phi_deg))
    turns = phi * AROUND / 360
    if not np.allclose(turns, np.round(turns)):
        raise DomainError(f"phi must be in steps of {360 / AROUND:g} deg here, not {phi.tolist()}")
    for name, angles in (("theta_i", theta_i), ("theta_r", theta_r)):
        if not np.all((angles >= 0) & (angles < 90)):
            raise DomainError(f"{name} must be 0 or more and below 90 deg, not {angles[(angles < 0) | (angles >= 90)][0]:g}")
    if not cell.spread.is_none:
        raise DomainError("interreflection is traced for domes that are all alike: expected a cell without spread")
    if orders < 1 or rings < 2 or sectors < 6 or sectors % 6 or rays < 2 or rays & (rays - 1):
        raise DomainError(
            f"{orders} orders, {rings} rings, {sectors} sectors, {rays} rays: expected 1 order and 2 rings or more, a multiple of 6, "
            "a power of 2"
        )
    # Integrals over the hemisphere: Gauss-Legendre in cos(theta), even in azimuth.
    u, w = np.polynomial.legendre.leggauss(24)
    u, w = (u + 1) / 2, w / 2
    inner = np.degrees(np.arccos(u))
    facets = _facets(cell, rings, sectors)
    beam_i, beam_r, beam = (facets.beam(angles) for angles in (theta_i, theta_r, inner))
    escape = 2 / facets.areas * np.einsum("g,gi->i", w * u, beam.mean(1))
    form, unclosed = _form_factors(cell, facets, escape, rays, seed)

    def later(light: Array, view: Array) -> Array:
        """Sum of the orders from the second on, averaged over azimuth, 1/sr."""
        spread = np.linalg.solve(np.eye(len(form)) - form, form @ (view.mean(1) / facets.areas).T)
        return np.asarray(light.mean(1) @ spread / np.pi)

    # What single bounce does not send back, for every incidence at once.
    angles, where = np.unique(np.concatenate([inner, theta_i, theta_r]), return_inverse=True)
    even = np.arange(0, 181, 360 / AROUND)
    single = radiometric_terms(*np.meshgrid(angles, inner, even, indexing="ij"), cell=cell)[:, 0].reshape(len(angles), len(u), len(even))
    left = (1 - 2 * np.pi * np.trapezoid(single, even, axis=2) / 180 @ (w * u))[where]
    # A flat surface leaves nothing, or less than nothing by rounding.
    left = np.maximum(left, 0.0)
    wanted, *others = np.split(left, [len(u), len(u) + len(theta_i)])

    # Symmetric scaling c(theta_i) c(theta_r), so that this comes back later (Sinkhorn and Knopp).
    among = later(beam, beam)
    factor = np.ones(len(u))
    for _ in range(BALANCE):
        ratio = _over(wanted, 2 * np.pi * factor * (among @ (w * u * factor)))
        factor *= np.sqrt(ratio)
        if np.abs(ratio - 1).max() < 1e-12:
            break
    of_i, of_r = (some / (2 * np.pi * later(light, beam) @ (w * u * factor)) for some, light in zip(others, (beam_i, beam_r), strict=True))
    scale = (of_i[:, None] * of_r)[:, :, None]

    first = radiometric_terms(*np.meshgrid(theta_i, theta_r, phi, indexing="ij"), cell=cell)[:, 0]
    out = [first.reshape(len(theta_i), len(theta_r), len(phi))]
    steps = np.round(turns).astype(int)
    outward = beam_r / facets.areas
    for _ in range(1, orders):
        outward = outward @ form.T
        out.append(scale * _paired(beam_i, outward, steps))
    following: Array = outward @ form.T
    further: Any = np.linalg.solve(np.eye(len(form)) - form, following.reshape(-1, len(form)).T).T.reshape(outward.shape)
    rest, next_order = scale * _paired(beam_i, further, steps), scale * _paired(beam_i, following, steps)
    decay = 1 - np.divide(next_order, rest, out=np.ones_like(rest), where=rest > 0)
    closure = float(np.abs(wanted - (1 - beam.mean(1) @ escape)).max())
    return EscapeOrders(cell, theta_i, theta_r, phi, np.array(out), rest, decay, closure, unclosed, seed)


@dataclass(frozen=True, eq=False)
class _Facets:
    """Facets of one period: rings times sectors of the dome, then sixths of the floor in the gaps.

    `edges` are the rings' bounds in tau, r = sin(tau)^(2/p), rim last; `areas` per area of the patch; `of` is the facet of each quadrature
    point, `normals` (N, 3) and `shares` (N,) the points' normals and areas, `horizon` (N, AROUND).
    """

    edges: Array
    sectors: int
    areas: Array
    of: NDArray[np.int64]
    normals: Array
    shares: Array
    horizon: NDArray[np.float32]

    def beam(self, theta_deg: Array) -> Array:
        """Share of a beam that falls on each facet, shape (t, AROUND, P); each sums to 1 exactly, as all light falls somewhere."""
        out = np.zeros((len(theta_deg), AROUND, len(self.areas)))
        theta = np.radians(theta_deg)
        _beams(np.sin(theta), np.cos(theta), self.normals, self.shares, self.horizon, self.of, out)
        return np.asarray(out / out.sum(axis=2, keepdims=True))


def _facets(cell: Cell, rings: int, sectors: int) -> _Facets:
    from fitting.surface import strata, surface

    columns = 2 * sectors
    fine = surface(cell, FINE * rings, columns, AROUND)
    radius = np.sqrt(np.minimum(np.cumsum(strata(cell, FINE * rings).up) / np.pi, 1.0))
    edges = np.arcsin(np.concatenate([[0.0], radius[FINE - 1 :: FINE]]) ** (cell.p / 2))
    edges[-1] = np.pi / 2
    count = FINE * rings * columns
    row, column = np.divmod(np.arange(count), columns)
    of = np.concatenate([row // FINE * sectors + column // 2, rings * sectors + _sixth(fine.points[count:], cell.pitch)])
    shares = fine.areas.copy()
    # The floor's points are not alike in all sixths, the sixths are.
    floor = np.bincount(of[count:] - rings * sectors, shares[count:], 6)
    shares[count:] *= floor.sum() / 6 / floor[of[count:] - rings * sectors]
    return _Facets(edges, sectors, np.asarray(np.bincount(of, shares), float), of, fine.normals, shares, fine.horizon)


def _sixth(points: Array, pitch: float) -> NDArray[np.int64]:
    """Which sixth of the hexagon around the nearest centre each point of the floor lies in."""
    i, j = np.meshgrid(np.arange(-1, 3), np.arange(-1, 3), indexing="ij")
    centres = pitch * np.column_stack([(i + j / 2).ravel(), (j * math.sqrt(3) / 2).ravel()])
    away = points[:, None, :2] - centres
    nearest = away[np.arange(len(points)), np.argmin((away**2).sum(2), axis=1)]
    return np.asarray(np.arctan2(nearest[:, 1], nearest[:, 0]) / (2 * np.pi) % 1 * 6, dtype=np.int64) % 6


def _form_factors(cell: Cell, facets: _Facets, escape: Array, rays: int, seed: int) -> tuple[Array, float]:
    """Share of each facet's light that falls on each other, (P, P), and how far its rows and `escape` were from summing to 1."""
    from scipy.stats import qmc

    count, sectors, rings = len(facets.areas), facets.sectors, len(facets.edges) - 1
    sobol = qmc.Sobol(4, scramble=True, rng=np.random.default_rng(seed)).random(rays)
    shape = (cell.stretch, float(cell.p), float(cell.q), cell.pitch)
    # A turn by 60 deg changes nothing: facets of one sixth stand for all.
    domes = np.arange(rings * sectors).reshape(rings, sectors)
    sixth = np.append(domes[:, : sectors // 6].ravel(), rings * sectors)
    hits = _cast(facets.edges, sectors, sixth, sobol, shape)
    if hits[:, -1].any():
        raise DomainError(f"{cell}: rays between the domes did not end; a cell so tall or so flat is outside the model")
    form = np.zeros((count, count))
    for turn in range(6):
        turned = np.append(np.roll(domes, -turn * sectors // 6, axis=1).ravel(), rings * sectors + (np.arange(6) + turn) % 6)
        form[np.ix_(turned[sixth], turned)] = hits[:, :count] / rays
    unclosed = float(np.abs(form.sum(1) + escape - 1).max())
    shared = facets.areas[:, None] * form
    shared = (shared + shared.T) / 2
    wanted = facets.areas * (1 - escape)
    for _ in range(BALANCE):
        ratio = _over(wanted, shared.sum(1))
        shared *= np.sqrt(ratio[:, None] * ratio)
        if np.abs(ratio - 1).max() < 1e-13:
            break
    return shared / facets.areas[:, None], unclosed


def _over(wanted: Array, found: Array) -> Array:
    """Factor from what was found to what is wanted; 1 where nothing was found that could be scaled."""
    return np.divide(wanted, found, out=np.ones_like(found), where=found > 0)


def _paired(light: Array, outward: Array, steps: NDArray[np.int64]) -> Array:
    """Mean over the lattice's azimuth of light (i, AROUND, P) times what goes out to views (r, AROUND, P) further by steps, 1/sr."""
    out = np.empty((len(light), len(outward), len(steps)))
    flat = light.reshape(len(light), -1)
    for n, step in enumerate(steps):
        both = (np.roll(outward, -step, axis=1) + np.roll(outward, step, axis=1)) / 2
        out[:, :, n] = flat @ both.reshape(len(outward), -1).T / AROUND / np.pi
    return out


@njit(cache=True, nogil=True, parallel=True)
def _beams(sin: Array, cos: Array, normals: Array, shares: Array, horizon: NDArray[np.float32], of: NDArray[np.int64], out: Array) -> None:
    """Add to `out` (t, AROUND, P) what a beam of light casts on each facet, per light on the patch."""
    around = horizon.shape[1]
    for a in prange(around):
        psi = 2 * math.pi * a / around
        x, y = math.cos(psi), math.sin(psi)
        for t in range(len(sin)):
            slope = cos[t] / sin[t] if sin[t] > 0 else math.inf
            for n in range(len(shares)):
                facing = sin[t] * (normals[n, 0] * x + normals[n, 1] * y) + cos[t] * normals[n, 2]
                if facing > 0 and slope > horizon[n, a]:
                    out[t, a, of[n]] += shares[n] * facing / cos[t]


@njit(cache=True, nogil=True)
def _gap_azimuth(share: float, pitch: float) -> float:
    """Azimuth, 0 to 60 deg, below which lies that share of the floor between rim and hexagon."""
    far2 = pitch * pitch / 4
    # The floor up to an azimuth off a neighbour's is far2 tan(off) - off, doubled; Newton from the end, where it is steepest.
    within = min(share, 1 - share) * 2 * (far2 * math.tan(math.pi / 6) - math.pi / 6)
    off = math.pi / 6
    for _ in range(60):
        tan = math.tan(off)
        slope = far2 * (1 + tan * tan) - 1
        step = (far2 * tan - off - within) / slope if slope > 0 else 0.0
        off -= step
        if abs(step) < 1e-12:
            break
    return off if share < 0.5 else math.pi / 3 - off


@njit(cache=True, nogil=True, parallel=True)
def _cast(
    edges: Array, sectors: int, facets: NDArray[np.int64], sobol: Array, shape: tuple[float, float, float, float]
) -> NDArray[np.int64]:
    """Count where Lambert rays from some facets arrive: (f, P + 2), the last two the sky and rays that did not end."""
    h, p, q, pitch = shape
    rings = len(edges) - 1
    count = rings * sectors + 6
    out = np.zeros((len(facets), count + 2), np.int64)
    for job in prange(len(facets)):
        row, sector = facets[job] // sectors, facets[job] % sectors
        # Each facet's points are the same ones, moved around (Cranley and Patterson), or errors would add up.
        move = job * 0.6180339887498949 % 1
        for n in range(len(sobol)):
            aside = (sobol[n, 1] + move) % 1
            azimuth = 2 * math.pi * (sector + aside) / sectors if row < rings else _gap_azimuth(aside, pitch) + sector * math.pi / 3
            ca, sa = math.cos(azimuth), math.sin(azimuth)
            if row < rings:
                tau = edges[row] + (edges[row + 1] - edges[row]) * ((sobol[n, 0] + move) % 1)
                r, z = math.sin(tau) ** (2 / p), h * math.cos(tau) ** (2 / q)
                up, along = q * (max(z, 0.0) / h) ** (q - 1) / h, p * r ** (p - 1)
                length = math.hypot(up, along)
                up, along = up / length, along / length
            else:
                # The floor reaches from the rim to the hexagon's edge, wherever that is at this azimuth.
                off = (azimuth + math.pi / 6) % (math.pi / 3) - math.pi / 6
                far = pitch / 2 / math.cos(off)
                r, z = math.sqrt(1 + (far * far - 1) * ((sobol[n, 0] + move) % 1)), 0.0
                up, along = 1.0, 0.0
            sin2 = (sobol[n, 2] + move) % 1
            sin, cos, turn = math.sqrt(sin2), math.sqrt(1 - sin2), 2 * math.pi * ((sobol[n, 3] + move) % 1)
            s, t = sin * math.cos(turn), sin * math.sin(turn)
            # About the normal (along, 0, up) in the plane of azimuth: downhill (up, 0, -along), and sideways.
            radial, dz = cos * along + s * up, cos * up - s * along
            dx, dy = radial * ca - t * sa, radial * sa + t * ca
            if dz >= 0 and z >= h:
                what, x, y, height = ESCAPED, 0.0, 0.0, 0.0
            else:
                what, x, y, height = march(r * ca, r * sa, z, dx, dy, dz, h, p, q, pitch, row < rings)
            if what == ESCAPED:
                out[job, count] += 1
                continue
            if what == LOST:
                out[job, count + 1] += 1
                continue
            where = math.atan2(y, x) / (2 * math.pi) % 1
            if what == DOME:
                # From whichever coordinate is the better known there.
                flat = min(1.0, math.hypot(x, y)) ** (p / 2)
                steep = min(1.0, max(0.0, height / h)) ** (q / 2)
                angle = math.atan2(flat, steep)
                hit = 0
                while hit < rings - 1 and angle > edges[hit + 1]:
                    hit += 1
                out[job, hit * sectors + min(sectors - 1, int(where * sectors))] += 1
            else:
                out[job, rings * sectors + min(5, int(where * 6))] += 1
    return out
