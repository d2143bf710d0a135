"""Single bounce off domes and floor for light and view from anywhere above the petal, in the paper's mode and in 1/sr.

The domes are rings of points, each ring with its own offsets, lit and seen from azimuths all round. What each point sees is decided exactly
by its horizon (`fitting.surface`), and a horizon depends on a point and an azimuth only: those that light and view meet at one phi serve
at every phi that is a whole number of steps further. All points of a ring have one normal, seen from their own side, so the ring is handled
at once, as the bits of one number.

Every pair of azimuths counts twice, the second time with light and view in each other's place; so swapping light and view changes nothing
but the order of summation, and f(i, r) = f(r, i) to rounding.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.cells import Cell
from fitting.errors import DomainError
from fitting.paper import LOBE_FLOOR, TERMS, flat_spongy
from fitting.progress import Progress, silent

if TYPE_CHECKING:
    from fitting.surface import Facets

Array = NDArray[np.float64]


AROUND = 12
"""Azimuths from which each ring is lit and seen: phi in steps of 30 deg shares all that is seen, 5 deg shares it six ways."""

LEANING = 16
"""So many times the facets where domes lean: points of a ring then differ in their normals, and each is a ring of its own."""

SHARES = 4  # of the facets, for threads; a number of its own, so that sums do not depend on the machine


@dataclass(frozen=True)
class Sampling:
    """How finely domes and floor are sampled; the cost is linear in facets, and grows more slowly with turns.

    Parameters
    ----------
    facets : int, optional
        Directions in which the normals of the dome are sampled, rings times `AROUND`; by default 3000, or what the lobe needs where that
        is more.
    turns : int
        Azimuths of the lattice at each, 1 to 64.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """

    facets: int | None = None
    turns: int = 32

    def __post_init__(self) -> None:
        if (self.facets is not None and self.facets < 1) or not 1 <= self.turns <= 64:
            raise DomainError(f"sampling needs 1 facet or more and 1 to 64 turns, not {self.facets} and {self.turns}")

    @classmethod
    def grazing(cls) -> Sampling:
        """Fine enough for light and view near grazing, up to 89.8 deg, where only the tips of domes are lit and seen.

        Rms over all pairs of directions, by projected solid angle, as a fraction of the mean: within 0.15 % in the paper's mode and 0.35 %
        in 1/sr, hemispheres and rose cells (aspect 1.9). `tests/benchmarks/bench_model.py` prints the table.
        """
        return cls(8400, 64)

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
    progress: Progress = silent,
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
    progress : callable
        Told the share done, 0 to 1.

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
    sums = _sums(cell, theta_i, theta_r, phi, n_us, sampling or Sampling(), progress, foreshortened=True)
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
    progress: Progress = silent,
) -> Array:
    """Evaluate the four distributions r' of the paper, eqs. (1) to (7), for any directions and any cell.

    Parameters
    ----------
    theta_i_deg, theta_r_deg, phi_deg, cell, n_us, sampling, progress
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
    sums = _sums(cell, theta_i, theta_r, phi, n_us, sampling or Sampling(), progress, foreshortened=False)
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
    progress: Progress = silent,
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
    n_us, n_ss, sampling, progress
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
    terms = evaluate(*directions, cell=cell, n_us=n_us, n_ss=n_ss, sampling=sampling, progress=progress)
    return {name: np.ascontiguousarray(column.reshape(shape)) for name, column in zip(TERMS, terms.T, strict=True)}


def _exponents(**exponents: float) -> None:
    for name, n in exponents.items():
        if not (math.isfinite(n) and n > 0):
            raise DomainError(f"{name} must be a finite number above 0, not {n!r}")


def _directions(theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> tuple[Array, Array, Array]:
    """Check, broadcast and flatten; theta to rad, theta_r 0 or more; phi in 0 .. 180 deg."""
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
    return np.radians(theta_i), np.radians(np.abs(theta_r)), np.round(np.abs((turned + 180) % 360 - 180), 9)


def _mirrored(theta_i: Array, theta_r: Array, phi_deg: Array) -> Array:
    """Cosine of the angle between a view and the mirror direction of a flat patch, R.V."""
    return np.asarray(np.cos(theta_i) * np.cos(theta_r) - np.sin(theta_i) * np.sin(theta_r) * np.cos(np.radians(phi_deg)))


def _facets(cell: Cell, points: int, turns: int, floor: bool) -> Facets:
    """Rings of the domes, then groups of points of the floor."""
    from fitting.surface import Facets, floor_share, gaps, sheared, strata

    domes, count = cell.domes(), math.ceil(points / AROUND)
    n = np.arange(count)
    rings = strata(cell, count, tip=True)
    sites = np.floor(len(domes) * ((n * 0.7320508075688772) % 1)).astype(np.int64)  # each ring stands for one of the domes
    dx, dy, h, tx, ty = domes[sites].T[:, :, None]
    start, taller = (n * 0.41421356237309515 + 0.25)[:, None] % 1, h / cell.stretch
    azimuth = (np.arange(turns) + start) / turns * (np.pi / 3 if cell.spread.is_none else 2 * np.pi)
    cos, sin, z = np.cos(azimuth), np.sin(azimuth), rings.z[:, None] * taller + 0 * azimuth
    places = np.stack([rings.rho[:, None] * cos + z * tx + dx, rings.rho[:, None] * sin + z * ty + dy, z], axis=-1)
    vectors = np.stack(
        np.broadcast_arrays(rings.out[:, None] * taller * cos, rings.out[:, None] * taller * sin, rings.up[:, None]), axis=-1
    )
    if cell.spread.tilt > 0:  # turns is 1
        vectors = sheared(vectors[:, 0], tx[:, 0], ty[:, 0])[:, None]
        azimuth = np.arctan2(vectors[..., 1], vectors[..., 0])
    out, up = np.hypot(vectors[:, 0, 0], vectors[:, 0, 1]) / cell.cell_area, vectors[:, 0, 2] / cell.cell_area
    grounds = max(32, count // 4)
    ground = gaps(cell, math.ceil(1.1 * grounds * turns) + 50)[: grounds * turns] if floor else np.empty((0, 2))
    grounds = len(ground) // turns
    ground = np.column_stack([ground, np.zeros(len(ground))])
    under = np.full(grounds, floor_share(cell) / max(1, grounds))
    around = 2 * np.pi * (np.arange(grounds * turns) * 0.6180339887498949 % 1)
    areas = np.hypot(out, up)
    return Facets(
        np.concatenate([places, ground.reshape(grounds, turns, 3)]),
        np.concatenate([azimuth, around.reshape(grounds, turns)]),
        np.concatenate([out / areas, np.zeros(grounds)]),
        np.concatenate([up / areas, np.ones(grounds)]),
        np.concatenate([areas, under]),
        np.concatenate([sites, np.zeros(grounds, np.int64)]),
        np.arange(count + grounds) < count,
        np.asarray(np.arange(count + grounds) * 0.6180339887498949 % 1, float),
    )


def _sums(
    cell: Cell,
    theta_i: Array,
    theta_r: Array,
    phi_deg: Array,
    n_us: float,
    sampling: Sampling,
    progress: Progress,
    *,
    foreshortened: bool,
) -> Array:
    """Sums over facets for each direction, shape (n, 2), on all cores."""
    from fitting.surface import Facets, facet_sums, shape_of

    leaning = cell.spread.tilt > 0
    points, turns = sampling.points(n_us), sampling.turns
    facets = _facets(cell, LEANING * points if leaning else points, 1 if leaning else turns, floor=foreshortened)
    settings = (cell.domes(), shape_of(cell), float(n_us), LOBE_FLOOR ** (1 / n_us), foreshortened)
    # Angles phi that differ by whole steps share what is seen; within them, pairs of one phi and one light are a run.
    step = np.floor(phi_deg * AROUND / 360).astype(np.int64)
    remainder = np.round(phi_deg - step * 360 / AROUND, 9)
    order = np.lexsort((theta_i, step, remainder))
    batches = np.split(order, np.flatnonzero(np.diff(remainder[order])) + 1) if len(order) else []
    out = np.zeros((len(order), 2))

    def share(rows: NDArray[np.int64], part: slice) -> Array:
        theta, where = np.unique(np.concatenate([theta_i[rows], theta_r[rows]]), return_inverse=True)
        light, view = where.reshape(2, -1)
        begins = np.flatnonzero(np.diff(light, prepend=-1) | np.diff(step[rows], prepend=-1))
        runs = np.append(begins, len(rows))
        pairs = (math.radians(remainder[rows[0]]), step[rows[begins]], runs, theta, light, view)
        columns: Any = (column[part] for column in facets)
        arguments: Any = (AROUND, *pairs, Facets(*columns), *settings)
        sums: Array = facet_sums(*arguments)
        return sums

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = [(rows, pool.submit(share, rows, slice(n, None, SHARES))) for rows in batches for n in range(SHARES)]
        # In order: the sums depend neither on which thread is quicker nor on how many there are.
        for done, (rows, task) in enumerate(tasks, 1):
            out[rows] += task.result()
            progress(done / len(tasks))
    return out
