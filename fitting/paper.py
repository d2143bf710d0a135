"""The paper's reflection model: what domed epidermis and flat spongy tissue send into the plane of incidence.

Source: Tachino, Terado, Kenmochi, Kotani, eqs. (1) to (7), taken literally: no foreshortening of the view, only the domes' surfaces S_i
for the epidermis, the cosine of the lobe clamped at 0, the lattice averaged over its azimuth.
"""

from __future__ import annotations

import functools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.cells import Cell
from fitting.errors import DomainError

TERMS = ("u_diff", "u_spec", "s_diff", "s_spec")
"""Columns of `paper_terms`: upper epidermis (u) and spongy mesophyll (s), diffuse and specular."""

LOBE_FLOOR = 1e-5
"""The specular lobe is cut off where it falls below this fraction of its peak."""

SLICES_IN_LOBE = 8
"""Fewer slices than this across a lobe would miss it: trapezoid on a Gaussian cut at LOBE_FLOOR, error about 1e-4."""


LOBE_SLICES = 377
"""Slices for the specular lobe while light and view stay within LOW of the normal."""

LOW = math.radians(70) + 1e-9


@dataclass(frozen=True)
class Quadrature:
    """How finely the dome is integrated.

    Parameters
    ----------
    slices : int
        Nodes over the slice's place and the lattice's azimuth; an odd Fibonacci number from 89 on (89, 233, 377, 987, 1597, 4181, ...).
        With 1597, all values above a thousandth of their term's peak are within 0.04 % at the paper's 15 directions and within 0.2 % while
        theta_i and theta_r stay within 70 deg; at 85 deg u_diff is within 1.1 % and the faint u_spec within 8 %. With 377, within 0.3 % at
        the paper's directions in less than half of the time. `tests/benchmarks/bench_model.py` prints the table.
    lobe : int
        Gauss-Legendre nodes across the specular lobe on each slice.

    Raises
    ------
    DomainError
        If `slices` is not such a number or `lobe` is below 2.
    """

    slices: int = 1597
    lobe: int = 12

    def __post_init__(self) -> None:
        if self.lobe < 2:
            raise DomainError(f"a quadrature needs at least 2 nodes across the lobe, not {self.lobe}")
        if self._fibonacci_pair()[1] != self.slices or self.slices % 2 == 0:
            raise DomainError(f"the number of slices must be an odd Fibonacci number such as 377, 987, 1597 or 4181, not {self.slices}")

    @property
    def generator(self) -> int:
        """Fibonacci number before `slices`."""
        return self._fibonacci_pair()[0]

    def _fibonacci_pair(self) -> tuple[int, int]:
        before, number = 55, 89
        while number < self.slices:
            before, number = number, before + number
        return before, number


def paper_terms(
    theta_i_deg: ArrayLike,
    theta_r_deg: ArrayLike,
    *,
    aspect: float = 0.5,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    quadrature: Quadrature | None = None,
    neighbours: bool = True,
) -> NDArray[np.float64]:
    """Evaluate the four distributions r' of the paper, for light and view in the plane of incidence.

    Parameters
    ----------
    theta_i_deg : array_like, deg
        Incidence, 0 <= theta_i < 90.
    theta_r_deg : array_like, deg
        View, -90 to 90, positive on the light's side: retro-reflection at theta_i, mirror direction at -theta_i. Broadcast against
        `theta_i_deg`.
    aspect : float
        Height over base diameter of the domes.
    n_us, n_ss : float
        Exponents of the specular lobes of epidermis and spongy tissue, eqs. (2) and (6).
    quadrature : Quadrature, optional
        How finely to integrate.
    neighbours : bool
        False for domes that neither shade nor hide one another (for comparison with closed forms).

    Returns
    -------
    ndarray, shape (n, 4), 1/1
        Columns `TERMS`, for beam intensity 1; n readings after broadcasting.

    Raises
    ------
    DomainError
        If an angle, the aspect or an exponent is outside the model, or the lobe is too narrow for the quadrature.

    Notes
    -----
    The spongy tissue's boundary is flat, lit and seen unhindered: r'_s_diff = cos(theta_i) and
    r'_s_spec = max(0, cos(theta_i + theta_r))^n_ss.
    """
    from fitting.slices import dome_terms  # numba

    dome, rule = Cell(aspect), quadrature or Quadrature()
    for name, n in (("n_us", n_us), ("n_ss", n_ss)):
        if not (math.isfinite(n) and n > 0):
            raise DomainError(f"{name} must be a finite number above 0, not {n!r}")
    theta_i, theta_r = _in_plane(theta_i_deg, theta_r_deg)
    windows = _lobe_windows(theta_i, theta_r, dome.stretch, n_us)
    if len(windows) and 2 * windows[:, 2].min() * rule.slices / math.pi < SLICES_IN_LOBE:
        raise DomainError(f"the lobe of n_us = {n_us:g} on domes of aspect {aspect:g} falls between {rule.slices} slices: ask for more")
    angles, where = np.unique(np.concatenate([theta_i, theta_r]), return_inverse=True)
    towards, pairs = np.column_stack([np.sin(angles), np.cos(angles)]), where.reshape(2, -1).T.copy()
    lobe = _rule_for_lobe(rule, angles, windows)
    passes = [(rule, True, True)] if lobe == rule else [(rule, True, False), (lobe, False, True)]

    def half(second: bool) -> NDArray[np.float64]:
        domes = np.zeros((len(pairs), 2))
        for r, diffuse, specular in passes:
            middle, end = (r.slices + 1) // 4, (r.slices + 1) // 2
            part = (middle, end) if second else (0, middle)
            settings = (windows, float(n_us), r.slices, r.generator, *part, diffuse, specular, *_gauss_legendre(r.lobe), neighbours)
            domes += dome_terms(dome.stretch, towards, pairs, *settings)
        return domes

    other = _second_thread(os.getpid()).submit(half, True)  # always two halves, so that the sum does not depend on the machine
    domes = half(False) + other.result()
    return np.column_stack([domes, flat_spongy(np.cos(theta_i), np.cos(theta_i + theta_r), n_ss)])


def flat_spongy(cos_i: NDArray[np.float64], mirrored: NDArray[np.float64], n_ss: float) -> NDArray[np.float64]:
    """r'_s_diff and r'_s_spec, eqs. (5) and (6), of a flat boundary, lit and seen unhindered.

    Parameters
    ----------
    cos_i, mirrored : ndarray, shape (n,)
        cos(theta_i), and R.V, below 0 away from the mirror direction.
    n_ss : float
        Exponent of the lobe.

    Returns
    -------
    ndarray, shape (n, 2), 1/1
    """
    return np.column_stack([cos_i, np.maximum(0.0, mirrored) ** n_ss])


@functools.cache
def _second_thread(process: int) -> ThreadPoolExecutor:
    """Thread that takes half of the slices; kept, since starting one takes as long as 377 slices. A forked process starts its own."""
    return ThreadPoolExecutor(1, f"slices-{process}")


def _rule_for_lobe(rule: Quadrature, angles: NDArray[np.float64], windows: NDArray[np.float64]) -> Quadrature:
    """Rule that suffices for the specular lobe, which needs fewer slices than the diffuse term's kinks unless light or view are low."""
    if len(angles) == 0 or rule.slices <= LOBE_SLICES or np.abs(angles).max() > LOW:
        return rule
    few = Quadrature(LOBE_SLICES, rule.lobe)
    return few if 2 * windows[:, 2].min() * few.slices / math.pi >= 3 * SLICES_IN_LOBE else rule


@functools.cache
def _gauss_legendre(nodes: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights on -1 .. 1; kept, since finding them takes about a quarter of a call at 377 slices."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return x, w


def _in_plane(theta_i_deg: ArrayLike, theta_r_deg: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check, broadcast and flatten directions; deg to rad."""
    try:
        theta_i, theta_r = np.broadcast_arrays(np.asarray(theta_i_deg, float), np.asarray(theta_r_deg, float))
    except ValueError as error:
        raise DomainError(f"theta_i and theta_r must be numbers of matching shapes: {error}") from error
    for name, angles, inside, span in (
        ("theta_i", theta_i, (theta_i >= 0) & (theta_i < 90), "0 <= theta_i < 90 deg"),
        ("theta_r", theta_r, np.abs(theta_r) <= 90, "-90 <= theta_r <= 90 deg (beyond is behind the petal, which has no model here)"),
    ):
        if not inside.all():
            raise DomainError(f"{name} = {angles[~inside][0]:g} deg is outside the model: expected {span}")
    return np.radians(theta_i.ravel()), np.radians(theta_r.ravel())


def _lobe_windows(theta_i: NDArray[np.float64], theta_r: NDArray[np.float64], k: float, exponent: float) -> NDArray[np.float64]:
    """Bound the part of a dome whose specular lobe exceeds LOBE_FLOOR; columns lowest psi, highest psi, largest abs(eta), rad.

    With the normal at chi from the half direction in the plane and at beta out of it, and D = theta_i - theta_r, eqs. (3) and (4) give
    R.V = cos^2(beta) cos(2 chi) - sin^2(beta) cos(D).
    """
    half, cos_d = (theta_i + theta_r) / 2, np.cos(theta_i - theta_r)
    least = LOBE_FLOOR ** (1 / exponent)
    # Near the grazing mirror the lobe stays high however far the normal turns out of the plane: no bound in chi there.
    width = np.where(-cos_d < least, 0.5 * math.acos(least), np.pi / 2)
    low, high = np.maximum(half - width, -np.pi / 2), np.minimum(half + width, np.pi / 2)
    tilt = np.minimum(1.0, (1 - least) / np.maximum(1 + cos_d, 1 - least))  # largest sin^2(beta), reached at chi = 0
    # On the dome tan(eta) = tan(beta) / sqrt(k^2 cos^2 + sin^2) of the normal's angle in the plane: extreme where cos^2 is.
    ends = np.cos(np.stack([low, high])) ** 2
    most = np.where((low < 0) & (high > 0), 1.0, ends.max(axis=0))
    squash = np.sqrt(np.minimum(*(k * k * c + 1 - c for c in (most, ends.min(axis=0)))))
    eta = np.arctan2(np.sqrt(tilt), squash * np.sqrt(1 - tilt))
    return np.column_stack([*(np.arctan2(np.sin(chi), k * np.cos(chi)) for chi in (low, high)), eta])
