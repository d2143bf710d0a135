"""Smooth values between the nodes of a table over (theta_i, theta_r, phi): a tensor spline through the nodes, evaluated fast.

A cubic spline follows a smooth lobe to the fourth power of the spacing and is twice continuously differentiable. Nodes may lie unevenly:
close where the values turn quickly, which for domed cells is near grazing. Its ends are free ("not-a-knot"), so that a crease across them,
as the one about the way back to the light at phi = 0, stays a crease. Over theta the spline runs in 1 - sqrt(1 - theta / 90): what grazing
light or view reaches of a dome is a cap whose radius goes as the root of the angle left to 90 deg, and values go with it.

Kernels are serial and let go of the interpreter's lock; `in_chunks` spreads them over threads. numba's own threads are not used: the layer
it falls back to ends the process when two threads of Python call it at a time, as the bands of a picture do.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
Four = tuple[np.float32, np.float32, np.float32, np.float32]

CLOSEST = 0.01
"""Nodes are at least this far apart, deg."""

CHUNK = 1 << 16
"""Directions a thread takes at a time; fewer are not worth a thread."""


class Axis(NamedTuple):
    """A cubic spline's pieces along one angle.

    Attributes
    ----------
    nodes : ndarray, shape (n,), deg
        Rising from 0; n is 4 or more.
    last : float, deg
        The last node.
    at : ndarray, shape (n,)
        Places of the nodes in the coordinate of the spline, as are all that follow: phi itself, or theta `bent`.
    breaks : ndarray, shape (n - 2,)
        Where pieces begin: the nodes but for the second and the last two; then infinity.
    per_width : ndarray, shape (n - 3,)
        One over each piece's width.
    pieces : ndarray of float32, shape (n - 3, 4, 4)
        Piece j weighs coefficients j to j + 3 by polynomials of its own coordinate, 0 to 1: powers 0 to 3, then coefficients.
    scale : float
        Buckets to a step of 1: so many that no two pieces begin within one.
    buckets : ndarray of int32, shape (b + 1,)
        Piece at the beginning of each bucket.
    """

    nodes: Array
    last: float
    at: Array
    breaks: Array
    per_width: Array
    pieces: Singles
    scale: float
    buckets: NDArray[np.int32]


def bent(theta_deg: ArrayLike) -> Array:
    """Coordinate of the spline over theta: 0 to 90 deg onto 0 to 90, as 90 (1 - sqrt(1 - theta / 90))."""
    return 90 - np.sqrt(90 * (90 - np.asarray(theta_deg, float)))


def axis(nodes_deg: ArrayLike, *, grazing: bool) -> Axis:
    """Prepare the spline along one angle.

    Parameters
    ----------
    nodes_deg : array_like, shape (n,), deg
        Rising from 0, four or more.
    grazing : bool
        Whether this is theta, whose 90 deg are grazing.

    Returns
    -------
    Axis

    Raises
    ------
    DomainError
        If these are no such nodes.
    """
    from scipy.interpolate import BSpline

    nodes, most = np.array(nodes_deg, float), 90 if grazing else 180
    if nodes.ndim != 1 or len(nodes) < 4 or nodes[0] != 0 or not np.all(np.diff(nodes) >= CLOSEST) or not nodes[-1] <= most:
        raise DomainError(
            f"a table's nodes must be four or more angles rising by {CLOSEST:g} deg or more from 0 to at most {most} deg, not {nodes_deg!r}"
        )
    at = bent(nodes) if grazing else nodes
    ends = np.concatenate([at[:1], at[2:-2], at[-1:]])
    inside = np.array([0.125, 0.375, 0.625, 0.875])
    x = ends[:-1, None] + np.diff(ends)[:, None] * inside
    knots = np.concatenate([at[[0] * 3], ends, at[[-1] * 3]])
    weights = BSpline.design_matrix(x.ravel(), knots, 3).toarray().reshape(*x.shape, len(nodes))
    taps = np.stack([weights[j, :, j : j + 4] for j in range(len(weights))])
    pieces = np.linalg.inv(np.vander(inside, increasing=True)) @ taps
    count = math.ceil(ends[-1] / np.diff(ends).min()) + 1
    starts = np.linspace(0, ends[-1], count + 1)
    buckets = np.clip(np.searchsorted(ends, starts, side="right") - 1, 0, len(pieces) - 1).astype(np.int32)
    breaks = np.append(ends[:-1], np.inf)
    return Axis(nodes, float(nodes[-1]), at, breaks, 1 / np.diff(ends), pieces.astype(np.float32), count / float(ends[-1]), buckets)


def coefficients(values: ArrayLike, axes: tuple[Axis, Axis, Axis]) -> Singles:
    """Find the spline that goes through the values at the nodes.

    Parameters
    ----------
    values : array_like, shape (i, r, p)
        At the nodes of the three axes.
    axes : tuple of Axis
        theta_i, theta_r, phi.

    Returns
    -------
    ndarray of float32, shape (i, r, p), contiguous
    """
    from scipy.interpolate import make_interp_spline

    found = np.asarray(values, float)
    for number, along in enumerate(axes):
        found = np.moveaxis(make_interp_spline(along.at, found, k=3, axis=number).c, 0, number)
    return np.ascontiguousarray(found, np.float32)


def in_chunks(count: int, task: Callable[[slice], None]) -> None:
    """Run a task over `count` directions, on all cores where there are enough of them."""
    if count <= CHUNK:
        task(slice(0, count))
        return
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(task, (slice(first, first + CHUNK) for first in range(0, count, CHUNK))))


@njit(cache=True, nogil=True, inline="always")
def _place(along: Axis, x: float) -> tuple[np.uint64, np.float32]:
    """Piece of the spline that holds an angle, and where in it, 0 to 1."""
    # Unsigned, here and below: numba need not look out for indices that count from the end.
    j = np.uint64(along.buckets[np.uint64(x * along.scale)])
    if x >= along.breaks[j + np.uint64(1)]:
        j += np.uint64(1)
    return j, np.float32((x - along.breaks[j]) * along.per_width[j])


@njit(cache=True, nogil=True, inline="always")
def _weights(pieces: Singles, j: np.uint64, u: np.float32) -> Four:
    """Weights of coefficients j to j + 3."""
    q = pieces[j]
    return (
        q[0, 0] + u * (q[1, 0] + u * (q[2, 0] + u * q[3, 0])),
        q[0, 1] + u * (q[1, 1] + u * (q[2, 1] + u * q[3, 1])),
        q[0, 2] + u * (q[1, 2] + u * (q[2, 2] + u * q[3, 2])),
        q[0, 3] + u * (q[1, 3] + u * (q[2, 3] + u * q[3, 3])),
    )


@njit(cache=True, nogil=True, inline="always")
def _row(flat: Singles, at: np.uint64, p: Four) -> np.float32:
    """Weigh four neighbours along phi."""
    return p[0] * flat[at] + p[1] * flat[at + np.uint64(1)] + p[2] * flat[at + np.uint64(2)] + p[3] * flat[at + np.uint64(3)]


@njit(cache=True, nogil=True, inline="always")
def _plane(flat: Singles, at: np.uint64, step: np.uint64, r: Four, p: Four) -> np.float32:
    """Weigh four by four neighbours along theta_r and phi."""
    return (
        r[0] * _row(flat, at, p)
        + r[1] * _row(flat, at + step, p)
        + r[2] * _row(flat, at + np.uint64(2) * step, p)
        + r[3] * _row(flat, at + np.uint64(3) * step, p)
    )


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def look_up(
    table: Singles,
    axis_i: Axis,
    axis_r: Axis,
    axis_p: Axis,
    reciprocal: bool,
    theta_i: Array,
    theta_r: Array,
    phi: Array,
    out: Array,
) -> int:
    """Evaluate a tensor spline at directions above the petal.

    Parameters
    ----------
    table : ndarray of float32, shape (i, r, p), contiguous
        `coefficients`.
    axis_i, axis_r, axis_p : Axis
        Its axes. Beyond the last node the value at the last node is taken.
    reciprocal : bool
        Whether light and view may be swapped: the lower of the two is then taken for the light, so that both ways round give the same bits.
    theta_i, theta_r, phi : ndarray, shape (n,), deg
        0 to 90; -90 to 90, below 0 being the view at -theta_r and phi + 180; any finite angle, left and right alike.
    out : ndarray, shape (n,)
        Written. What the spline takes below 0 beside a steep fall is 0: no reflection is negative.

    Returns
    -------
    int
        -1, or the first direction that is out of range, where it stopped.
    """
    flat = table.ravel()
    step_r, step_i = np.uint64(table.shape[2]), np.uint64(table.shape[1] * table.shape[2])
    for n in range(len(theta_i)):
        ti, tr, azimuth = theta_i[n], theta_r[n], phi[n]
        if not (ti >= 0 and ti <= 90 and tr >= -90 and tr <= 90 and math.isfinite(azimuth)):
            return n
        azimuth = abs(azimuth - 360 * np.floor(azimuth / 360 + 0.5))
        if tr < 0:
            tr, azimuth = -tr, 180 - azimuth
        if reciprocal:
            ti, tr = min(ti, tr), max(ti, tr)
        i, u = _place(axis_i, 90 - math.sqrt(90 * (90 - min(ti, axis_i.last))))
        j, v = _place(axis_r, 90 - math.sqrt(90 * (90 - min(tr, axis_r.last))))
        k, w = _place(axis_p, min(max(azimuth, 0.0), axis_p.last))
        a, r, p = _weights(axis_i.pieces, i, u), _weights(axis_r.pieces, j, v), _weights(axis_p.pieces, k, w)
        at = i * step_i + j * step_r + k
        total = (
            a[0] * _plane(flat, at, step_r, r, p)
            + a[1] * _plane(flat, at + step_i, step_r, r, p)
            + a[2] * _plane(flat, at + np.uint64(2) * step_i, step_r, r, p)
            + a[3] * _plane(flat, at + np.uint64(3) * step_i, step_r, r, p)
        )
        out[n] = total if total > 0 else np.float32(0)
    return -1
