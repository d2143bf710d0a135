"""Single bounce off domes and floor for light and view from anywhere above the petal, in the paper's mode and in 1/sr.

The domes are points along a spiral, from tip to rim, each with its own azimuth of the lattice, so that no two see the same shadows; what
each sees is decided exactly by its horizon (`fitting.surface`). All azimuths of the lattice are handled at once, as the bits of one number,
and all lights and views at the same phi share their horizons: a table costs little more per direction than the sum itself.

Light stands at -phi / 2 and view at phi / 2, and every facet counts with its mirror image; so swapping light and view changes nothing but
the order of summation, and f(i, r) = f(r, i) to rounding.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.cells import Cell
from fitting.errors import DomainError
from fitting.paper import LOBE_FLOOR, TERMS, flat_spongy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sampling:
    """How finely domes and floor are sampled; the cost is linear in facets x turns.

    Parameters
    ----------
    facets : int, optional
        Points of the dome; by default 3000, or what the lobe needs where that is more.
    turns : int
        Azimuths of the lattice at each, 1 to 64.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """

    facets: int | None = None
    turns: int = 16

    def __post_init__(self) -> None:
        if (self.facets is not None and self.facets < 1) or not 1 <= self.turns <= 64:
            raise DomainError(f"sampling needs 1 facet or more and 1 to 64 turns, not {self.facets} and {self.turns}")

    def points(self, n_us: float) -> int:
        """Facets for an exponent of the lobe: its normals are about 1 / (2 sqrt(n)) wide, and half of the facets are even over normals."""
        return self.facets or max(3000, math.ceil(48 * n_us))


def radiometric_terms(
    theta_i_deg: ArrayLike,
    theta_r_deg: ArrayLike,
    phi_deg: ArrayLike,
    *,
    cell: Cell | None = None,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    sampling: Sampling | None = None,
) -> Array:
    """Evaluate the single-bounce reflectance of tissues that are diffuse (1 / pi) or a lobe ((n + 2) / (2 pi) max(0, R.V)^n).

    Parameters
    ----------
    theta_i_deg : array_like, deg
        0 <= theta_i < 90.
    theta_r_deg : array_like, deg
        -90 < theta_r < 90; below 0 it is the view at -theta_r and phi + 180.
    phi_deg : array_like, deg
        phi_r - phi_i, 0 on the light's side. The three broadcast against one another.
    cell : Cell, optional
        Shape of the domes.
    n_us, n_ss : float
        Exponents of the lobes of the epidermis, domes and floor, and of the flat spongy tissue.
    sampling : Sampling, optional
        How finely.

    Returns
    -------
    ndarray, shape (n, 4), 1/sr
        Columns `fitting.paper.TERMS`, seen by a detector that sees the patch only.

    Raises
    ------
    DomainError
        If a direction or an exponent is outside the model.

    Notes
    -----
    f_r = (1 / alpha) Int l v f max(0, N.L) max(0, N.V) dp / (cos theta_i cos theta_r), the lattice averaged over its azimuth.
    """
    cell = cell or Cell()
    _exponents(n_us=n_us, n_ss=n_ss)
    theta_i, theta_r, phi = _directions(theta_i_deg, theta_r_deg, phi_deg)
    sums = _sums(cell, theta_i, theta_r, phi, n_us, sampling or Sampling(), foreshortened=True)
    sums *= [1 / np.pi, (n_us + 2) / (2 * np.pi)] / (np.cos(theta_i) * np.cos(theta_r))[:, None]
    return np.column_stack([sums, flat_spongy_per_sr(_mirrored(theta_i, theta_r, phi), n_ss)])


def paper_terms_any(
    theta_i_deg: ArrayLike,
    theta_r_deg: ArrayLike,
    phi_deg: ArrayLike,
    *,
    cell: Cell | None = None,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    sampling: Sampling | None = None,
) -> Array:
    """Evaluate the four distributions r' of the paper, eqs. (1) to (7), for any directions and any cell.

    Parameters
    ----------
    theta_i_deg, theta_r_deg, phi_deg, cell, n_us, sampling
        As in `radiometric_terms`.
    n_ss : float
        Exponent of the flat spongy tissue's lobe.

    Returns
    -------
    ndarray, shape (n, 4), 1/1
        Columns `fitting.paper.TERMS`; in the plane of incidence what `fitting.paper.paper_terms` gives. Only the domes' surfaces are
        integrated, not the floor.

    Raises
    ------
    DomainError
        If a direction or an exponent is outside the model.
    """
    cell = cell or Cell()
    _exponents(n_us=n_us, n_ss=n_ss)
    theta_i, theta_r, phi = _directions(theta_i_deg, theta_r_deg, phi_deg)
    sums = _sums(cell, theta_i, theta_r, phi, n_us, sampling or Sampling(), foreshortened=False)
    return np.column_stack([sums, flat_spongy(np.cos(theta_i), _mirrored(theta_i, theta_r, phi), n_ss)])


def flat_spongy_per_sr(mirrored: Array, n_ss: float) -> Array:
    """s_diff and s_spec of a flat boundary, lit and seen unhindered.

    Parameters
    ----------
    mirrored : ndarray, shape (n,)
        R.V, below 0 away from the mirror direction.
    n_ss : float
        Exponent of the lobe.

    Returns
    -------
    ndarray, shape (n, 2), 1/sr
    """
    return np.column_stack([np.full(len(mirrored), 1 / np.pi), (n_ss + 2) / (2 * np.pi) * np.maximum(0.0, mirrored) ** n_ss])


def basis_tables(
    cell: Cell,
    theta_i_deg: ArrayLike,
    theta_r_deg: ArrayLike,
    phi_deg: ArrayLike,
    mode: str = "radiometric",
    *,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    sampling: Sampling | None = None,
) -> dict[str, Array]:
    """Evaluate all bases at all combinations of nodes.

    Parameters
    ----------
    cell : Cell
        Shape of the domes.
    theta_i_deg, theta_r_deg, phi_deg : array_like, shapes (i,), (r,), (p,), deg
        Nodes, as in `radiometric_terms`.
    mode : str
        "radiometric" (1/sr) or "paper".
    n_us, n_ss, sampling
        As in `paper_terms_any`.

    Returns
    -------
    dict of str to ndarray, shape (i, r, p)
        `fitting.paper.TERMS`.

    Raises
    ------
    DomainError
        If a node, an exponent or the mode is outside the model.
    """
    nodes = [np.atleast_1d(np.asarray(a, float)) for a in (theta_i_deg, theta_r_deg, phi_deg)]
    directions = np.meshgrid(*nodes, indexing="ij")
    shape = directions[0].shape
    if mode == "radiometric":
        evaluate = radiometric_terms
    elif mode == "paper":
        evaluate = paper_terms_any
    else:
        raise DomainError(f"mode must be 'radiometric' or 'paper', not {mode!r}")
    terms = evaluate(*directions, cell=cell, n_us=n_us, n_ss=n_ss, sampling=sampling)
    return {name: np.ascontiguousarray(column.reshape(shape)) for name, column in zip(TERMS, terms.T, strict=True)}


def _exponents(**exponents: float) -> None:
    for name, n in exponents.items():
        if not (math.isfinite(n) and n > 0):
            raise DomainError(f"{name} must be a finite number above 0, not {n!r}")


def _directions(theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> tuple[Array, Array, Array]:
    """Check, broadcast and flatten; to rad, theta_r 0 or more and phi in 0 .. pi."""
    try:
        theta_i, theta_r, phi = (
            a.ravel() for a in np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i_deg, theta_r_deg, phi_deg)))
        )
    except ValueError as error:
        raise DomainError(f"theta_i, theta_r and phi must be numbers of matching shapes: {error}") from error
    for name, angle, inside, span in (
        ("theta_i", theta_i, (theta_i >= 0) & (theta_i < 90), "0 <= theta_i < 90 deg"),
        ("theta_r", theta_r, np.abs(theta_r) < 90, "-90 < theta_r < 90 deg (beyond is behind the petal)"),
        ("phi", phi, np.isfinite(phi), "a finite angle"),
    ):
        if not inside.all():
            raise DomainError(f"{name} = {angle[~inside][0]:g} deg is outside the model: expected {span}")
    turned = np.where(theta_r < 0, phi + 180, phi)
    # Rounded, so that one phi written in two ways shares its horizons; left and right are alike.
    return np.radians(theta_i), np.radians(np.abs(theta_r)), np.radians(np.round(np.abs((turned + 180) % 360 - 180), 10))


def _mirrored(theta_i: Array, theta_r: Array, phi: Array) -> Array:
    """Cosine of the angle between a view and the mirror direction of a flat patch, R.V."""
    return np.asarray(np.cos(theta_i) * np.cos(theta_r) - np.sin(theta_i) * np.sin(theta_r) * np.cos(phi))


def _facets(cell: Cell, points: int, turns: int, floor: bool) -> tuple[tuple[NDArray[Any], ...], float]:
    """Domes as a spiral of points, then floor, and the period of the lattice's azimuth; as `fitting.surface.facet_sums` takes them."""
    from fitting.surface import floor_share, gaps, sheared, strata

    domes = cell.domes()
    period = np.pi / 3 if cell.spread.is_none else 2 * np.pi
    n = np.arange(points)
    rings = strata(cell, points)
    around = 2 * np.pi * ((n * 0.6180339887498949 + 0.5) % 1)
    offsets = (n * 0.41421356237309515 + 0.25) % 1
    sites = np.floor(len(domes) * ((n * 0.7320508075688772) % 1)).astype(np.int64)  # each facet stands for one of the domes
    _, _, h, tx, ty = domes[sites].T
    turn = offsets * period / turns  # a leaning dome turns with the lattice
    tx, ty = np.cos(turn) * tx - np.sin(turn) * ty, np.sin(turn) * tx + np.cos(turn) * ty
    taller = h / cell.stretch
    z = rings.z * taller
    cos, sin = np.cos(around), np.sin(around)
    vector = sheared(np.column_stack([rings.out * taller * cos, rings.out * taller * sin, rings.up]), tx, ty)
    places = np.column_stack([rings.rho * cos + z * tx, rings.rho * sin + z * ty, z])
    ground = gaps(cell, max(200, points // 4)) if floor else np.empty((0, 2))
    count = len(ground)
    vector = np.concatenate([vector / cell.cell_area, np.tile([0.0, 0.0, floor_share(cell) / max(1, count)], (count, 1))])
    areas = np.linalg.norm(vector, axis=1)
    facets = (
        np.concatenate([places, np.column_stack([ground, np.zeros(count)])]),
        vector / areas[:, None],
        areas,  # per area of patch
        np.concatenate([sites, np.zeros(count, np.int64)]),
        np.arange(points + count) < points,
        np.concatenate([offsets, (np.arange(count) * 0.41421356237309515 + 0.25) % 1]),
    )
    return facets, period


def _sums(cell: Cell, theta_i: Array, theta_r: Array, phi: Array, n_us: float, sampling: Sampling, *, foreshortened: bool) -> Array:
    """Sums over facets for each direction, shape (n, 2), on all cores."""
    from fitting.surface import facet_sums, shape_of

    leaning = cell.spread.tilt > 0
    turns = 1 if leaning else sampling.turns
    points = sampling.points(n_us) * (sampling.turns if leaning else 1)
    facets, period = _facets(cell, points, turns, floor=foreshortened)
    domes, shape = cell.domes(), shape_of(cell)
    least = LOBE_FLOOR ** (1 / n_us)
    out = np.zeros((len(phi), 2))
    workers = os.cpu_count() or 1

    def share(rows: NDArray[np.int64], part: slice) -> tuple[NDArray[np.int64], Array]:
        lights, i = np.unique(theta_i[rows], return_inverse=True)
        seen, r = np.unique(theta_r[rows], return_inverse=True)
        order = np.argsort(i, kind="stable")
        begins = np.searchsorted(i[order], np.arange(len(lights) + 1))
        light_and_view = (phi[rows[0]], lights, seen, begins, r[order])
        settings = (turns, period, domes, shape, float(n_us), least, foreshortened)
        arguments: Any = (*light_and_view, *(column[part] for column in facets), *settings)
        sums: Array = facet_sums(*arguments)
        return rows[order], sums

    by_phi = np.argsort(phi, kind="stable")
    groups = np.split(by_phi, np.nonzero(np.diff(phi[by_phi]))[0] + 1) if len(phi) else []
    with ThreadPoolExecutor(workers) as pool:
        tasks = [pool.submit(share, rows, slice(w, None, workers)) for rows in groups for w in range(workers)]
        for task in tasks:  # in order, so that the sums do not depend on which thread is quicker
            rows, sums = task.result()
            out[rows] += sums
    return out
