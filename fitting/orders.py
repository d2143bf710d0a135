"""Interreflection between the domes, by the number of bounces, for Lambert facets of any albedo.

The geometry is traced once. One period of the patch is cut into facets; what share of a beam falls on each follows from the horizons
(`fitting.surface`), what share of a facet's light falls on another from rays (`fitting.tracing.march`). Light on its way is then a vector
over facets, a bounce a matrix product, and s_k(theta_i, theta_r, phi) = (1 / pi) E(L) F^(k-1) A^-1 E(V): radiosity, with the beam as source
and the view as its own adjoint, so that light and view may be swapped exactly. An albedo afterwards is a sum, sum_k albedo^k s_k. Between
tall domes light stays long: what leaves late is kept as one sum.

Single bounce is not taken from the facets, whose parts lit and seen may differ, but integrated exactly (`fitting.radiometric`).

Nothing is lost: facets and sky share a facet's light by rows made to sum to 1 and to be reciprocal, and the orders from the second on are
scaled, symmetrically in light and view, to what single bounce leaves (`closure` tells how far apart the two are). A white furnace is white.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from fitting.cells import Cell
from fitting.errors import DomainError
from fitting.progress import Progress, silent, stage
from fitting.tracing import Domes, cast, on_all_cores

if TYPE_CHECKING:
    from fitting.radiometric import Sampling

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
    bases : ndarray, shape (K + 1, i, r, p), 1/sr
        s_1 to s_K, and the sum of all later orders.
    decay : float
        By which later orders fall, as the first of them and their sum have it in light from the whole sky; 0 or more, below 1.
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
    bases: Array
    decay: float
    closure: float
    unclosed: float
    seed: int

    def weights(self, albedo: float) -> Array:
        """Return `order_weights` of these."""
        return order_weights(albedo, len(self.bases) - 1, self.decay)

    def reflectance(self, albedo: float) -> Array:
        """Return f_r at the nodes for facets of an albedo, all orders: `weights` times `bases`, shape (i, r, p), 1/sr; errors alike."""
        return np.asarray(np.tensordot(self.weights(albedo), self.bases, 1))


def order_weights(albedo: float, count: int, decay: float) -> Array:
    """Weigh the orders of reflection for facets of an albedo.

    Parameters
    ----------
    albedo : float
        0 to 1.
    count : int
        Orders kept one by one; then comes the sum of all later ones.
    decay : float
        By which later orders fall. They are taken as one geometric row, the same in all directions: exact at albedo 1, elsewhere as
        `escape_orders` says.

    Returns
    -------
    ndarray, shape (count + 1,)

    Raises
    ------
    DomainError
        If the albedo is not within 0 and 1.
    """
    if not 0 <= albedo <= 1:
        raise DomainError(f"an albedo must be within 0 and 1, not {albedo!r}")
    weights: Array = albedo ** np.arange(1.0, count + 2)
    weights[-1] *= (1 - decay) / (1 - albedo * decay)
    return weights


def escape_orders(
    cell: Cell,
    theta_i_deg: ArrayLike,
    theta_r_deg: ArrayLike,
    phi_deg: ArrayLike,
    *,
    orders: int = 44,
    rings: int = 14,
    sectors: int = 36,
    rays: int = 4096,
    seed: int = 0,
    sampling: Sampling | None = None,
    progress: Progress = silent,
) -> EscapeOrders:
    """Trace a cell once and return how light leaves it by the number of bounces.

    Parameters
    ----------
    cell : Cell
        The shape; domes all alike.
    theta_i_deg, theta_r_deg, phi_deg : array_like, shapes (i,), (r,), (p,), deg
        Nodes: 0 <= theta < 90 (tried up to 89.8), and phi, 0 on the light's side, a multiple of 5 deg.
    orders : int
        Orders kept one by one. What follows is one geometric row: with 44, in any direction within 0.3 % of the mean over the hemisphere
        for aspects up to 3 and albedos up to 0.95 (see `python -m tests.benchmarks light`). Hemispheres need 6.
    rings, sectors : int
        Facets from a dome's tip to its rim and around it; sectors a multiple of 6.
    rays : int
        From each facet, a power of 2.
    seed : int
        Of their places.
    sampling : Sampling, optional
        Of single bounce, as for `fitting.radiometric.radiometric_terms`.
    progress : callable
        Told the share done, 0 to 1.

    Raises
    ------
    DomainError
        If a node or a count is outside the model, or the domes differ.

    Notes
    -----
    Radiosity: Goral, Torrance, Greenberg and Battaile, Computer Graphics 18(3), 213, 1984.
    """
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
    inner, lambert = _hemisphere()
    facets = _facets(cell, rings, sectors)
    beam_i, beam_r, beam = (facets.beam(angles) for angles in (theta_i, theta_r, inner))
    escape = 2 / facets.areas * np.einsum("g,gi->i", lambert, beam.mean(1))
    form, unclosed = _form_factors(cell, facets, escape, rays, seed)
    first, (left, *others) = _single_bounce(cell, theta_i, theta_r, phi, sampling, stage(progress, 0.3, 0.8))

    still = np.eye(len(form)) - form

    def later(light: Array) -> Array:
        """Sum of the orders from the second on, from light to each direction of the sky, averaged over azimuth, 1/sr."""
        spread = np.linalg.solve(still, form @ (beam.mean(1) / facets.areas).T)
        return np.asarray(light.mean(1) @ spread / np.pi)

    # Symmetric scaling c(theta_i) c(theta_r), so that what single bounce leaves comes back later (Sinkhorn and Knopp).
    among = later(beam)
    factor = np.ones(len(inner))
    for _ in range(BALANCE):
        ratio = _over(left, 2 * np.pi * factor * (among @ (lambert * factor)))
        factor *= np.sqrt(ratio)
        if np.abs(ratio - 1).max() < 1e-12:
            break
    of_i, of_r = (some / (2 * np.pi * later(light) @ (lambert * factor)) for some, light in zip(others, (beam_i, beam_r), strict=True))
    scale = (of_i[:, None] * of_r)[:, :, None]

    bases = [first]
    steps = np.round(turns).astype(int)
    light, view = _waves(beam_i), _waves(beam_r / facets.areas)
    sky = (lambert * factor) @ beam.mean(1)
    to_sky = sky / facets.areas
    flat = light.reshape(-1, len(form))  # one large product is several times quicker than many small ones
    for _ in range(1, orders):
        flat, sky = flat @ form, sky @ form
        bases.append(scale * _paired(flat.reshape(light.shape), view, steps))
    flat, sky = flat @ form, sky @ form
    to_leave = np.asarray(np.linalg.solve(still.T, flat.T).T)
    bases.append(scale * _paired(to_leave.reshape(light.shape), view, steps))
    rest = float(np.linalg.solve(still.T, sky) @ to_sky)
    decay = 1 - float(sky @ to_sky) / rest if rest > 0 else 0.0
    closure = float(np.abs(left - (1 - beam.mean(1) @ escape)).max())
    return EscapeOrders(cell, theta_i, theta_r, phi, np.array(bases), decay, closure, unclosed, seed)


def _hemisphere() -> tuple[Array, Array]:
    """Angles (deg) and weights that integrate f cos(theta) over the hemisphere, for a mean f over azimuth, by 2 pi: Gauss and Legendre."""
    x, w = np.polynomial.legendre.leggauss(24)
    return np.degrees(np.arccos((x + 1) / 2)), w * (x + 1) / 4


def _single_bounce(
    cell: Cell, theta_i: Array, theta_r: Array, phi: Array, sampling: Sampling | None, progress: Progress
) -> tuple[Array, list[Array]]:
    """Exact single bounce at the nodes (i, r, p), 1/sr, and what share of a beam it leaves, from `_hemisphere`, theta_i and theta_r."""
    from fitting.radiometric import radiometric_terms

    inner, lambert = _hemisphere()
    angles, where = np.unique(np.concatenate([inner, theta_i, theta_r]), return_inverse=True)
    even = np.arange(0, 181, 360 / AROUND)
    grids = [np.meshgrid(*axes, indexing="ij") for axes in ((angles, inner, even), (theta_i, theta_r, phi))]
    # In one call, which then shares horizons.
    asked = (np.concatenate([some.ravel(), others.ravel()]) for some, others in zip(*grids, strict=True))
    terms = np.split(radiometric_terms(*asked, cell=cell, sampling=sampling, progress=progress)[:, 0], [grids[0][0].size])
    all_round, first = (term.reshape(grid[0].shape) for term, grid in zip(terms, grids, strict=True))
    # A flat surface leaves nothing, or less than nothing by rounding.
    left = np.maximum(0.0, 1 - 2 * np.pi * np.trapezoid(all_round, even, axis=2) / 180 @ lambert)
    return first, np.split(left[where], [len(inner), len(inner) + len(theta_i)])


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
        points = self.normals, self.shares, self.horizon, self.of
        on_all_cores(lambda a: _beams(a, np.sin(theta), np.cos(theta), *points, out), AROUND)
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
    # A turn by 60 deg changes nothing: facets of one sixth stand for all.
    domes = np.arange(rings * sectors).reshape(rings, sectors)
    sixth = np.append(domes[:, : sectors // 6].ravel(), rings * sectors)
    moves, shape = np.arange(len(sixth)) * 0.6180339887498949 % 1, Domes.of(cell)
    hits = np.array(on_all_cores(lambda k: cast(facets.edges, sectors, int(sixth[k]), float(moves[k]), sobol, shape), len(sixth)))
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


def _waves(beams: Array) -> Array:
    """Beams (t, AROUND, P) as waves around the azimuth, cosines and sines: shape (2, waves, t, P)."""
    waves = np.fft.rfft(beams, axis=1).swapaxes(0, 1)
    return np.array([waves.real, waves.imag])


def _paired(light: Array, view: Array, steps: NDArray[np.int64]) -> Array:
    """Mean over the lattice's azimuth of light times what goes out to views further by steps, left and right alike; (i, r, p), 1/sr.

    Both are `_waves`: to turn one against the other is a product there.
    """
    waves = (light @ view.swapaxes(2, 3)).sum(0)
    return np.asarray(np.fft.irfft(waves, AROUND, axis=0)[steps % AROUND].transpose(1, 2, 0) / AROUND / np.pi)


@njit(cache=True, nogil=True)
def _beams(
    a: int, sin: Array, cos: Array, normals: Array, shares: Array, horizon: NDArray[np.float32], of: NDArray[np.int64], out: Array
) -> None:
    """Add to `out` (t, AROUND, P) what a beam of light from azimuth number `a` casts on each facet, per light on the patch."""
    psi = 2 * math.pi * a / horizon.shape[1]
    x, y = math.cos(psi), math.sin(psi)
    for t in range(len(sin)):
        slope = cos[t] / sin[t] if sin[t] > 0 else math.inf
        for n in range(len(shares)):
            facing = sin[t] * (normals[n, 0] * x + normals[n, 1] * y) + cos[t] * normals[n, 2]
            if facing > 0 and slope > horizon[n, a]:
                out[t, a, of[n]] += shares[n] * facing / cos[t]
