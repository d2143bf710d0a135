"""The paper's four distributions r' for light and view from any direction, tabulated once and looked up fast.

In the plane of incidence `fitting.paper` is the reference; the table carries the same model, eqs. (1) to (7) taken literally, to the rest
of the hemisphere, which a picture needs. The domes' two terms are tabulated; the flat spongy tissue's two have closed forms.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.cells import CELL_AREA, Dome
from fitting.errors import DomainError, TableError
from fitting.paper import LOBE_FLOOR, TERMS, paper_terms

FORMAT = "petal-rig reflectance table 1"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """How finely the directions are tabulated and the dome is integrated.

    Parameters
    ----------
    theta_steps : int
        Steps of theta_i and of theta_r from 0 to 90 deg, 3 or more.
    phi_steps : int
        Steps of phi from 0 to 180 deg; a multiple of 3.
    rows, columns : int
        Points along and around the dome; `columns` a multiple of 2 * phi_steps.
    turns : int
        Azimuths of the lattice over its 60 deg: a multiple of phi_steps / 3, at most 31.

    Raises
    ------
    DomainError
        If the numbers do not fit together.
    """

    theta_steps: int = 30
    phi_steps: int = 36
    rows: int = 60
    columns: int = 144
    turns: int = 12

    def __post_init__(self) -> None:
        fits = (
            self.theta_steps >= 3
            and self.phi_steps >= 3
            and self.phi_steps % 3 == 0
            and self.rows >= 2
            and self.columns >= 1
            and self.columns % (2 * self.phi_steps) == 0
            and 1 <= self.turns <= 31
            and (3 * self.turns) % self.phi_steps == 0
        )
        if not fits:
            raise DomainError(
                f"this grid does not fit together: {self}; expected phi_steps a multiple of 3, columns one of 2 phi_steps, "
                "turns one of phi_steps / 3 and at most 31, theta_steps 3 or more"
            )


@dataclass(frozen=True, eq=False)
class Reflectance:
    """Intensity of eq. (8) for one mixture x, a callable of the three angles.

    Attributes
    ----------
    domes : ndarray, shape (i, r, p)
        Mixed terms of the domes; theta_i and theta_r from 0 to 90, phi from 0 to 180 deg, evenly.
    s_diff, s_spec : float
        Coefficients of the flat spongy tissue.
    n_ss : float
        Exponent of its lobe.
    """

    domes: Array
    s_diff: float
    s_spec: float
    n_ss: float

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Evaluate the intensity per unit beam; r' holds the cosine of incidence already.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            As in `ReflectanceTable.evaluate`.

        Returns
        -------
        ndarray, of the broadcast shape

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        theta_i, theta_r, phi, shape = _directions(theta_i_deg, theta_r_deg, phi_deg)
        domes = _interpolated(self.domes[..., None], theta_i, theta_r, phi)[:, 0]
        cosine, lobe = _spongy(theta_i, theta_r, phi, self.n_ss)
        return (domes + self.s_diff * cosine + self.s_spec * lobe).reshape(shape)


@dataclass(frozen=True, eq=False)
class ReflectanceTable:
    """The four r' over all directions above the petal.

    Attributes
    ----------
    aspect, n_us, n_ss : float
        Cell shape and lobe exponents.
    grid : Grid
        How it was computed.
    domes : ndarray, shape (theta_steps + 1, theta_steps + 1, phi_steps + 1, 2)
        u_diff and u_spec over theta_i, theta_r and phi; 0 where light or view graze the petal.
    """

    aspect: float
    n_us: float
    n_ss: float
    grid: Grid
    domes: Array

    def evaluate(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look the four distributions up.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        theta_r_deg : array_like, deg
            -90 to 90; below 0 it is the view at -theta_r and phi + 180.
        phi_deg : array_like, deg
            phi_r - phi_i, any finite angle: 0 on the light's side, left and right alike.

        Returns
        -------
        ndarray, shape (..., 4)
            Columns `fitting.paper.TERMS`; the three angles broadcast against one another.

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        theta_i, theta_r, phi, shape = _directions(theta_i_deg, theta_r_deg, phi_deg)
        domes = _interpolated(self.domes, theta_i, theta_r, phi)
        return np.column_stack([domes, *_spongy(theta_i, theta_r, phi, self.n_ss)]).reshape(*shape, len(TERMS))

    def mixed(self, x: Mapping[str, float]) -> Reflectance:
        """Mix the four terms, eq. (8), into one quick callable.

        Parameters
        ----------
        x : mapping of str to float
            Coefficients of `fitting.paper.TERMS`, 0 or more.

        Raises
        ------
        DomainError
            If a coefficient is missing, unknown, negative or not finite.
        """
        if set(x) != set(TERMS) or not all(math.isfinite(v) and v >= 0 for v in x.values()):
            raise DomainError(f"a mixture needs a number of 0 or more for each of {', '.join(TERMS)}, not {dict(x)}")
        return Reflectance(self.domes @ np.array([x["u_diff"], x["u_spec"]]), x["s_diff"], x["s_spec"], self.n_ss)

    def in_plane_error(self) -> dict[str, float]:
        """Compare with `fitting.paper` in the plane of incidence, between the nodes as well as at them.

        Returns
        -------
        dict of str to float
            For each of `fitting.paper.TERMS` the rms difference as a fraction of the term's largest value, theta_i from 2 to 82 deg in
            steps of 10 and theta_r from -86 to 86 deg in steps of 4.
        """
        theta_i, theta_r = (a.ravel() for a in np.meshgrid(np.arange(2.0, 83, 10), np.arange(-86.0, 87, 4), indexing="ij"))
        exact = paper_terms(theta_i, theta_r, aspect=self.aspect, n_us=self.n_us, n_ss=self.n_ss)
        error = np.sqrt(np.mean((self.evaluate(theta_i, theta_r, 0) - exact) ** 2, axis=0)) / exact.max(axis=0)
        return dict(zip(TERMS, error.tolist(), strict=True))


def tabulate(*, aspect: float = 0.5, n_us: float = 40.0, n_ss: float = 5.0, grid: Grid | None = None) -> ReflectanceTable:
    """Compute the four distributions over all directions, on all cores.

    Parameters
    ----------
    aspect : float
        Height over base diameter of the domes.
    n_us, n_ss : float
        Exponents of the specular lobes of epidermis and spongy tissue.
    grid : Grid, optional
        How finely.

    Returns
    -------
    ReflectanceTable

    Raises
    ------
    DomainError
        If the aspect or an exponent is outside the model, or the lobe is too narrow for the grid: less than two points of the dome within
        the half width of the lobe.

    Notes
    -----
    Against `fitting.paper` in the plane of incidence the rms error of the default grid is 0.1 % of the largest u_diff and 0.4 % of the
    largest u_spec, for hemispheres and for rose cells alike; `ReflectanceTable.in_plane_error` measures it for any table.
    """
    from fitting.hemisphere import domes_at, seen_from  # numba

    dome, grid = Dome(aspect), grid or Grid()
    for name, n in (("n_us", n_us), ("n_ss", n_ss)):
        if not (math.isfinite(n) and n > 0):
            raise DomainError(f"{name} must be a finite number above 0, not {n!r}")
    # Between even steps on the sphere (which tall domes' tops need finer) and even steps of the normal (which their flanks do).
    stretch = math.sqrt(dome.stretch)
    tau = (np.arange(grid.rows) + 0.5) * np.pi / 2 / grid.rows
    coarsest = max(math.degrees(math.pi / 2 / grid.rows) * max(stretch, 1 / stretch), 360 / grid.columns)
    half_width = math.degrees(math.acos(0.5 ** (1 / n_us)))
    if 2 * coarsest > half_width:  # of the mirrored ray, which turns twice as fast as the normal
        raise DomainError(
            f"the lobe of n_us = {n_us:g} (half width {half_width:.2g} deg) on domes of aspect {aspect:g} falls between points "
            f"{coarsest:.2g} deg apart: ask for a finer grid"
        )
    theta = np.radians(np.linspace(0, 90, grid.theta_steps + 1)[:-1])
    angles = dome.sphere_angle(theta)
    centres = _neighbours(2 + math.tan(float(angles[-1])))
    domes = np.zeros((len(theta) + 1, len(theta) + 1, grid.phi_steps + 1, 2))  # grazing light or view reaches nothing of touching domes
    floor = LOBE_FLOOR ** (1 / n_us)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seen = np.stack(list(pool.map(lambda t: seen_from(t, tau, stretch, grid.columns, grid.turns, centres), angles.tolist())))
        d_tau = np.full(grid.rows, np.pi / 2 / grid.rows)

        def incidence(i: int) -> None:
            domes[i, :-1] = domes_at(
                theta[i], seen[i], theta, seen, grid.phi_steps, grid.turns, tau, d_tau, stretch, dome.stretch, float(n_us), floor
            )

        list(pool.map(incidence, range(len(theta))))
    return ReflectanceTable(float(aspect), float(n_us), float(n_ss), grid, domes)


def save(table: ReflectanceTable, path: str | Path) -> None:
    """Write a table and how it was made to an .npz file."""
    about = {"format": FORMAT, "aspect": table.aspect, "n_us": table.n_us, "n_ss": table.n_ss, "grid": asdict(table.grid)}
    with Path(path).open("wb") as file:
        np.savez_compressed(file, domes=table.domes, about=np.array(json.dumps(about)))


def load(path: str | Path) -> ReflectanceTable:
    """Read a table that `save` wrote.

    Raises
    ------
    TableError
        If the file cannot be read or is not such a table.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as stored:
            domes, about = np.asarray(stored["domes"], float), json.loads(str(stored["about"]))
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']!r}")
        table = ReflectanceTable(Dome(about["aspect"]).aspect, float(about["n_us"]), float(about["n_ss"]), Grid(**about["grid"]), domes)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, DomainError) as error:
        raise TableError(path, f"not a reflectance table of format {FORMAT!r} ({error}): tabulate it again") from error
    expected = (table.grid.theta_steps + 1, table.grid.theta_steps + 1, table.grid.phi_steps + 1, 2)
    if domes.shape != expected or not np.isfinite(domes).all():
        raise TableError(path, f"values of shape {domes.shape}, all finite in {expected} expected: tabulate it again")
    return table


def _neighbours(reach: float) -> Array:
    """Centres of the hexagonal lattice of pitch 2 about a dome, within `reach` of it, nearest first; shape (c, 2)."""
    most = int(reach / math.sqrt(3)) + 2
    i, j = (a.ravel() for a in np.meshgrid(np.arange(-2 * most, 2 * most + 1), np.arange(-most, most + 1)))
    centres = np.column_stack([2.0 * i + j, math.sqrt(3) * j])
    distance = np.hypot(*centres.T)
    near = (distance > 0) & (distance <= reach)
    assert math.isclose(float(distance[near].min(initial=2.0)), CELL_AREA / math.sqrt(3))
    return centres[near][np.argsort(distance[near], kind="stable")]


def _directions(theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> tuple[Array, Array, Array, tuple[int, ...]]:
    """Check, broadcast and flatten; theta_r to 0 .. 90 and phi to 0 .. 180 deg."""
    try:
        theta_i, theta_r, phi = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i_deg, theta_r_deg, phi_deg)))
    except ValueError as error:
        raise DomainError(f"theta_i, theta_r and phi must be numbers of matching shapes: {error}") from error
    for name, angle, inside, span in (
        ("theta_i", theta_i, (theta_i >= 0) & (theta_i <= 90), "0 <= theta_i <= 90 deg"),
        ("theta_r", theta_r, np.abs(theta_r) <= 90, "-90 <= theta_r <= 90 deg (beyond is behind the petal, which has no model here)"),
        ("phi", phi, np.isfinite(phi), "a finite angle"),
    ):
        if not inside.all():
            raise DomainError(f"{name} = {angle[~inside][0]:g} deg is outside the table: expected {span}")
    turned = np.where(theta_r < 0, phi + 180, phi).ravel()
    return theta_i.ravel(), np.abs(theta_r).ravel(), np.abs((turned + 180) % 360 - 180), theta_i.shape


def _interpolated(values: Array, theta_i: Array, theta_r: Array, phi: Array) -> Array:
    """Values of a table at flat, checked directions; shape (n, c)."""
    from fitting.hemisphere import look_up  # numba

    out = np.empty((len(theta_i), values.shape[-1]))
    look_up(values, theta_i, theta_r, phi, out)
    return out


def _spongy(theta_i: Array, theta_r: Array, phi: Array, n_ss: float) -> tuple[Array, Array]:
    """Evaluate s_diff and s_spec of the flat boundary, eqs. (5) and (6); angles in deg."""
    i, r = np.radians(theta_i), np.radians(theta_r)
    cos_i = np.cos(i)
    mirror = cos_i * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(np.radians(phi))
    return cos_i, np.maximum(0.0, mirror) ** n_ss
