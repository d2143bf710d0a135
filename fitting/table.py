"""A functional form of the reflectance: basis functions over all directions, tabulated once; a cultivar is a few weights on top.

In the plane of incidence `fitting.paper` is the reference; the paper's table carries the same model, eqs. (1) to (7) taken literally, to
the rest of the hemisphere. Other models' basis functions become tables by `ReflectanceTable.from_basis`.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import platform
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.cells import CELL_AREA, Cell
from fitting.errors import DomainError, EnergyError, TableError
from fitting.paper import LOBE_FLOOR, TERMS, paper_terms

if TYPE_CHECKING:
    from fitting.interpolate import Axis
    from fitting.lobes import Lobes

FORMAT = "petal-rig reflectance table 2"
PAPER = "Tachino et al., eqs. (1) to (7)"
INTENSITY, PER_SR = "intensity", "1/sr"
MODES = (INTENSITY, PER_SR)
"""What values mean: eq. (8)'s intensity per unit beam, which holds the cosine of incidence already, or a BRDF."""

ALBEDO_MARGIN = 0.01
"""How far above 1 the albedo of a BRDF may come out before it is refused: as much as a table may be off."""

GRAZING = 88.9
"""Beyond this few azimuths of the lattice do not stand for all, deg: what is seen along its lanes is seen far. Each point has its own."""

REACH = 85.0
"""Nodes of theta must come at least this near to grazing, deg; beyond the last one its value is kept."""

Array = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Grid:
    """How finely the directions are tabulated and the dome is integrated.

    Parameters
    ----------
    theta_steps : int
        Steps of theta_i and of theta_r from 0 to 90 deg, 3 or more; the last two hold more nodes, ever closer, since what domes show to
        grazing light or view changes quickly.
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
    rows: int = 80
    columns: int = 144
    turns: int = 24

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

    @property
    def theta(self) -> Array:
        """Nodes of theta_i and theta_r, deg."""
        step = 90 / self.theta_steps
        ends = 90 - step * np.array([1.5, 1, 2 / 3, 1 / 3, 1 / 6, 1 / 15, 0])
        return np.concatenate([np.arange(self.theta_steps - 1) * step, ends])

    @property
    def phi(self) -> Array:
        """Nodes of phi, deg."""
        return np.linspace(0, 180, self.phi_steps + 1)


@dataclass(frozen=True, eq=False)
class Reflectance:
    """One mixture of basis functions: a callable of the three angles that also draws directions.

    Attributes
    ----------
    mode : str
        `INTENSITY` or `PER_SR`.
    x : mapping of str to float
        Weights of the basis functions.
    axes : tuple of Axis
        theta_i, theta_r, phi.
    table : ndarray of float32, shape (i, r, p)
        Coefficients of the spline through the nodes.
    """

    mode: str
    x: Mapping[str, float]
    axes: tuple[Axis, Axis, Axis]
    table: Singles

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """The same as `evaluate`."""
        return self.evaluate(theta_i_deg, theta_r_deg, phi_deg)

    def evaluate(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look the reflectance up, on all cores where there are many directions.

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
        ndarray, of the broadcast shape
            Intensity per unit beam, 1/1, or BRDF, 1/sr, by `mode`; never below 0.

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        from fitting.interpolate import look_up  # numba

        (theta_i, theta_r, phi), shape = _flat(theta_i=theta_i_deg, theta_r=theta_r_deg, phi=phi_deg)
        out = np.empty(len(theta_i))
        bad = _spread(len(out), lambda s: look_up(self.table, *self.axes, theta_i[s], theta_r[s], phi[s], out[s]))
        if bad is not None:
            raise _outside(theta_i[bad], theta_r[bad], phi[bad])
        return out.reshape(shape)

    def sample(self, theta_i_deg: ArrayLike, u1: ArrayLike, u2: ArrayLike) -> tuple[Array, Array]:
        """Draw views as the light is sent: by value times cos(theta_r) per solid angle, nearly; `pdf` is exact for what is drawn.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        u1, u2 : array_like
            Evenly spread over 0 <= u < 1; theta_r rises with u1 and phi with u2, so that strata stay strata.

        Returns
        -------
        theta_r, phi : ndarray, of the broadcast shape, deg
            0 to 90, and -180 to 180.

        Raises
        ------
        DomainError
            If theta_i is outside the table or a u outside its range.
        """
        from fitting.lobes import draw  # numba

        (theta_i, first, second), shape = _flat(theta_i=theta_i_deg, u1=u1, u2=u2)
        theta_r, phi = np.empty(len(theta_i)), np.empty(len(theta_i))
        of = self._lobes
        bad = _spread(len(phi), lambda s: draw(of.theta_i, of.rows, of.cells, theta_i[s], first[s], second[s], theta_r[s], phi[s]))
        if bad is not None:
            raise DomainError(
                f"theta_i = {theta_i[bad]:g} deg, u1 = {first[bad]:g} and u2 = {second[bad]:g} draw nothing: "
                "expected 0 <= theta_i <= 90 deg and 0 <= u < 1"
            )
        return theta_r.reshape(shape), phi.reshape(shape)

    def pdf(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """How densely `sample` draws a view.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            As in `evaluate`.

        Returns
        -------
        ndarray, of the broadcast shape, 1/sr
            Above 0 wherever theta_r is below 90 deg; 1 over the hemisphere.

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        from fitting.lobes import density  # numba

        (theta_i, theta_r, phi), shape = _flat(theta_i=theta_i_deg, theta_r=theta_r_deg, phi=phi_deg)
        out, of = np.empty(len(theta_i)), self._lobes
        bad = _spread(len(out), lambda s: density(of.theta_i, of.rows, of.cells, theta_i[s], theta_r[s], phi[s], out[s]))
        if bad is not None:
            raise _outside(theta_i[bad], theta_r[bad], phi[bad])
        return out.reshape(shape)

    def albedo(self, theta_i_deg: ArrayLike) -> Array:
        """Share of the light that is sent back into the hemisphere, by Gauss-Legendre quadrature between the nodes.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90; as an intensity, below 90.

        Returns
        -------
        ndarray, of theta_i's shape
            Integral of f cos(theta_r) d(omega), where f is the BRDF or the intensity over cos(theta_i). The paper's intensity has no unit
            of its own: its albedo is relative and may exceed 1.

        Raises
        ------
        DomainError
            If an angle is outside the table.
        """
        (theta_i,), shape = _flat(theta_i=theta_i_deg)
        if self.mode == INTENSITY and np.any(theta_i == 90):
            raise DomainError("an intensity has no albedo at theta_i = 90 deg, where no light falls on the petal: expected below 90 deg")
        edges = self.axes[1].nodes if self.axes[1].last == 90 else np.append(self.axes[1].nodes, 90.0)
        view, d_view = _gauss(edges, 3)
        phi, d_phi = _gauss(self.axes[2].nodes, 2)
        weight = 2 * np.sin(np.radians(view)) * np.cos(np.radians(view)) * d_view
        sent = np.array([weight @ self.evaluate(t, view[:, None], phi) @ d_phi for t in theta_i]).reshape(shape)
        return sent / np.cos(np.radians(theta_i)).reshape(shape) if self.mode == INTENSITY else sent

    def reciprocity(self) -> float:
        """How far light and view are from exchangeable.

        Returns
        -------
        float
            With F(i, r) = f cos(theta_i) cos(theta_r), the light exchanged between two directions: the rms of F(i, r) - F(r, i) over all
            pairs of directions, by solid angle, as a fraction of the mean of F; 0 for what obeys Helmholtz, and for black. The paper's
            formula does not: it knows no foreshortening of the view.
        """
        theta, d_theta = _gauss(np.linspace(0, 90, 13), 2)
        phi, d_phi = _gauss(np.linspace(0, 180, 25), 2)
        cosine = np.cos(np.radians(theta))
        solid = np.sin(np.radians(theta)) * d_theta
        exchanged = self.evaluate(theta[:, None, None], theta[:, None], phi) * cosine[:, None]
        if self.mode == PER_SR:
            exchanged *= cosine[:, None, None]
        weight = solid[:, None, None] * solid[:, None] * d_phi
        mean = np.average(exchanged, weights=weight)
        return math.sqrt(np.average((exchanged - exchanged.transpose(1, 0, 2)) ** 2, weights=weight)) / mean if mean > 0 else 0.0

    @functools.cached_property
    def _lobes(self) -> Lobes:
        from fitting.lobes import lobes  # numba

        return lobes(self.evaluate, self.axes[0].nodes)


@dataclass(frozen=True, eq=False)
class ReflectanceTable:
    """Basis functions over all directions above the petal, at nodes; made by `tabulate` or `from_basis`.

    Attributes
    ----------
    names : tuple of str
        The basis functions.
    nodes : tuple of three ndarray, deg
        theta_i, theta_r and phi.
    values : ndarray of float32, shape (c, i, r, p)
        The basis functions at the nodes, 0 or more.
    mode : str
        `INTENSITY` or `PER_SR`.
    provenance : mapping
        What it was made from and how: what the maker gave, and `made` (UTC) and `versions`.
    """

    names: tuple[str, ...]
    nodes: tuple[Array, Array, Array]
    values: Singles
    mode: str
    provenance: Mapping[str, Any]

    @classmethod
    def from_basis(
        cls,
        names: Sequence[str],
        arrays: Sequence[ArrayLike] | Mapping[str, ArrayLike],
        *,
        nodes: tuple[ArrayLike, ArrayLike, ArrayLike],
        mode: str,
        provenance: Mapping[str, Any],
    ) -> ReflectanceTable:
        """Make a table of any model's basis functions.

        Parameters
        ----------
        names : sequence of str
            The basis functions.
        arrays : sequence of array_like of shape (i, r, p), or mapping of name to such
            Their values at the nodes, 0 or more.
        nodes : tuple of array_like, deg
            theta_i and theta_r, rising from 0 to between `REACH` and 90; phi, rising from 0 to 180; four or more each, uneven if need be.
        mode : str
            `INTENSITY` or `PER_SR`.
        provenance : mapping
            What JSON can hold: cell, exponents, grid and whatever else made the arrays. `made` and `versions` are added where missing.

        Raises
        ------
        DomainError
            If these do not fit together, or a value is negative or not finite.
        EnergyError
            If a BRDF among them sends back more light than falls on the petal.
        """
        from fitting.interpolate import axis  # numba

        axes = tuple(axis(along, grazing=name != "phi") for name, along in zip(("theta_i", "theta_r", "phi"), nodes, strict=True))
        shape = tuple(len(along.nodes) for along in axes)
        for name, along, ends in (("theta_i", axes[0], (REACH, 90)), ("theta_r", axes[1], (REACH, 90)), ("phi", axes[2], (180, 180))):
            if not ends[0] <= along.last <= ends[1]:
                raise DomainError(f"a table's nodes of {name} must end within {ends[0]:g} to {ends[1]:g} deg, not at {along.last:g}")
        if mode not in MODES:
            raise DomainError(f"a table's mode must be one of {', '.join(map(repr, MODES))}, not {mode!r}")
        if isinstance(arrays, Mapping):
            if set(arrays) != set(names):
                raise DomainError(f"a table needs an array for each of {', '.join(names)}, not for {', '.join(arrays)}")
            arrays = [arrays[name] for name in names]
        if not names or len(set(names)) != len(names) or len(names) != len(arrays) or not all(isinstance(n, str) and n for n in names):
            raise DomainError(f"a table needs a name of its own for each of its arrays: {len(arrays)} arrays, names {list(names)}")
        for name, values in zip(names, arrays, strict=True):
            found = np.asarray(values, float)
            if found.shape != shape:
                raise DomainError(f"{name} has shape {found.shape}, but the nodes of theta_i, theta_r and phi make {shape}")
            if not (np.isfinite(found) & (found >= 0)).all():
                raise DomainError(f"{name} has values that are negative or not finite; a reflectance is 0 or more everywhere")
        try:
            known = json.loads(json.dumps({"made": _now(), "versions": _versions()} | dict(provenance)))
        except (TypeError, ValueError) as error:
            raise DomainError(f"a table's provenance must be what JSON can hold: {error}") from error
        single = np.ascontiguousarray([np.asarray(values, np.float32) for values in arrays])
        table = cls(tuple(names), (axes[0].nodes, axes[1].nodes, axes[2].nodes), single, mode, known)
        for name in names:
            table.alone(name)  # raises where it creates light
        return table

    def evaluate(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look all basis functions up.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            As in `Reflectance.evaluate`.

        Returns
        -------
        ndarray, shape (..., c)
            Columns `names`; the three angles broadcast against one another.

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        return np.stack([self.alone(name)(theta_i_deg, theta_r_deg, phi_deg) for name in self.names], axis=-1)

    def mixed(self, x: Mapping[str, float]) -> Reflectance:
        """Mix the basis functions, eq. (8), into one quick callable.

        Parameters
        ----------
        x : mapping of str to float
            Weights of `names`, 0 or more.

        Raises
        ------
        DomainError
            If a weight is missing, unknown, negative or not finite.
        EnergyError
            If the mixture is a BRDF and sends back more light than falls on the petal.
        """
        from fitting.interpolate import coefficients

        if set(x) != set(self.names) or not all(math.isfinite(v) and v >= 0 for v in x.values()):
            raise DomainError(f"a mixture needs a number of 0 or more for each of {', '.join(self.names)}, not {dict(x)}")
        weights = np.array([x[name] for name in self.names])
        axes = self._axes
        mixture = Reflectance(self.mode, dict(x), axes, coefficients(np.tensordot(weights, self.values.astype(float), 1), axes))
        if self.mode == PER_SR:
            albedo = mixture.albedo(self.nodes[0])
            most = int(np.argmax(albedo))
            if albedo[most] > 1 + ALBEDO_MARGIN:
                what = ", ".join(f"{name} = {weight:g}" for name, weight in x.items() if weight)
                raise EnergyError(
                    f"{what} at theta_i = {self.nodes[0][most]:g} deg has an albedo of {albedo[most]:.4g}: it would send back more light "
                    "than falls on it. Lower the weights, or look into what made the basis functions"
                )
        return mixture

    def alone(self, name: str) -> Reflectance:
        """Return one basis function by itself.

        Raises
        ------
        DomainError
            If the table has none of this name.
        """
        if name not in self.names:
            raise DomainError(f"this table has no {name!r}: expected one of {', '.join(self.names)}")
        if name not in self._terms:
            self._terms[name] = self.mixed({other: float(other == name) for other in self.names})
        return self._terms[name]

    def in_plane_error(self) -> dict[str, float]:
        """Compare a table of the paper's model with `fitting.paper` in the plane of incidence, between the nodes as well as at them.

        Returns
        -------
        dict of str to float
            For each of `fitting.paper.TERMS` the rms difference as a fraction of the term's largest value, theta_i from 2 to 82 deg in
            steps of 10 and theta_r from -86 to 86 deg in steps of 4.

        Raises
        ------
        DomainError
            If the table is another model's.
        """
        if self.names != TERMS or self.provenance.get("model") != PAPER:
            raise DomainError(f"only a table of the model {PAPER!r} can be compared with it, not one of {', '.join(self.names)}")
        theta_i, theta_r = (a.ravel() for a in np.meshgrid(np.arange(2.0, 83, 10), np.arange(-86.0, 87, 4), indexing="ij"))
        settings = {"aspect": self.provenance["cell"]["aspect"]} | self.provenance["exponents"]
        exact = paper_terms(theta_i, theta_r, **settings)
        error = np.sqrt(np.mean((self.evaluate(theta_i, theta_r, 0) - exact) ** 2, axis=0)) / exact.max(axis=0)
        return dict(zip(TERMS, error.tolist(), strict=True))

    @functools.cached_property
    def _axes(self) -> tuple[Axis, Axis, Axis]:
        from fitting.interpolate import axis

        return axis(self.nodes[0], grazing=True), axis(self.nodes[1], grazing=True), axis(self.nodes[2], grazing=False)

    @functools.cached_property
    def _terms(self) -> dict[str, Reflectance]:
        return {}


def tabulate(*, aspect: float = 0.5, n_us: float = 40.0, n_ss: float = 5.0, grid: Grid | None = None) -> ReflectanceTable:
    """Compute the paper's four distributions over all directions, on all cores.

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
        Of `fitting.paper.TERMS`, as intensities.

    Raises
    ------
    DomainError
        If the aspect or an exponent is outside the model, or a lobe too narrow for the grid: less than two points of the dome within the
        half width of the epidermis' lobe, or more than 1 % rms of the spongy tissue's mean between the nodes.

    Notes
    -----
    `tests/benchmarks/bench_form.py` prints how far the default grid is from direct integration for all directions;
    `ReflectanceTable.in_plane_error` measures any table against `fitting.paper` in the plane of incidence.
    """
    from fitting.hemisphere import domes_at, seen_from  # numba
    from fitting.radiometric import paper_terms_any

    dome, grid = Cell(aspect), grid or Grid()
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
    theta = np.radians(grid.theta[:-1])
    angles = dome.sphere_angle(theta)
    centres = _neighbours(2 + math.tan(float(angles[-1])))
    domes = np.zeros((2, len(theta) + 1, len(theta) + 1, grid.phi_steps + 1))  # grazing light or view reaches nothing of touching domes
    floor = LOBE_FLOOR ** (1 / n_us)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seen = np.stack(list(pool.map(lambda t: seen_from(t, tau, stretch, grid.columns, grid.turns, centres), angles.tolist())))
        d_tau = np.full(grid.rows, np.pi / 2 / grid.rows)

        def incidence(i: int) -> None:
            found = domes_at(
                theta[i], seen[i], theta, seen, grid.phi_steps, grid.turns, tau, d_tau, stretch, dome.stretch, float(n_us), floor
            )
            domes[:, i, :-1] = np.moveaxis(found, 2, 0)

        list(pool.map(incidence, range(len(theta))))
    near = np.flatnonzero(grid.theta[:-1] > GRAZING)
    for i, r in ((near, np.arange(len(theta))), (np.arange(len(theta)), near)):
        directions = grid.theta[i][:, None, None], grid.theta[r][:, None], grid.phi
        exact = paper_terms_any(*directions, cell=dome, n_us=n_us, n_ss=n_ss)
        domes[:, i[:, None], r] = np.moveaxis(exact[:, :2].reshape(len(i), len(r), -1, 2), 3, 0)
    once = np.where((grid.phi == 0) | (grid.phi == 180), 0.5, 1.0)
    for zenith in (domes[:, 0], domes[:, :, 0]):  # light or view from there has no azimuth: what differs is how the points fall
        zenith[:] = np.average(zenith, axis=-1, weights=once)[..., None]
    table = ReflectanceTable.from_basis(
        TERMS,
        [*domes, *_spongy(grid.theta, grid.phi, n_ss)],
        nodes=(grid.theta, grid.theta, grid.phi),
        mode=INTENSITY,
        provenance={
            "model": PAPER,
            "cell": {"shape": "touching half-ellipsoids, hexagonally packed", "aspect": float(aspect)},
            "exponents": {"n_us": float(n_us), "n_ss": float(n_ss)},
            "grid": asdict(grid),
        },
    )
    between = [(along[:-1] + along[1:]) / 2 for along in (grid.theta, grid.phi)]
    lobe = _spongy(between[0], between[1], n_ss)[1]
    off = table.evaluate(between[0][:, None, None], between[0][:, None], between[1])[..., TERMS.index("s_spec")] - lobe
    solid = np.broadcast_to(np.sin(np.radians(between[0]))[:, None], lobe.shape)
    if (error := math.sqrt(np.average(off**2, weights=solid)) / np.average(lobe, weights=solid)) > 0.01:
        raise DomainError(f"the lobe of n_ss = {n_ss:g} is {100 * error:.2g} % rms off between the grid's nodes: ask for a finer grid")
    return table


def save(table: ReflectanceTable, path: str | Path) -> None:
    """Write a table, where it comes from and the sum of its content (SHA-256) to one .npz file."""
    about = {"format": FORMAT, "names": table.names, "mode": table.mode, "provenance": table.provenance, "sha256": _digest(table)}
    theta_i, theta_r, phi = table.nodes
    with Path(path).open("wb") as file:
        np.savez_compressed(
            file, values=table.values, theta_i=theta_i, theta_r=theta_r, phi=phi, about=np.array(json.dumps(about, ensure_ascii=False))
        )


def load(path: str | Path) -> ReflectanceTable:
    """Read a table that `save` wrote.

    Raises
    ------
    TableError
        If the file cannot be read, is not such a table, or its content is not what was saved.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as stored:
            values, about = stored["values"], json.loads(str(stored["about"]))
            nodes = (stored["theta_i"], stored["theta_r"], stored["phi"])
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']!r}")
        table = ReflectanceTable.from_basis(about["names"], values, nodes=nodes, mode=about["mode"], provenance=about["provenance"])
        if _digest(table) != about["sha256"]:
            raise ValueError("its content is not what was saved: the sums (SHA-256) differ")
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, DomainError, EnergyError) as error:
        raise TableError(path, f"not a reflectance table of format {FORMAT!r} ({error}): tabulate it again") from error
    return table


def _digest(table: ReflectanceTable) -> str:
    """SHA-256 of all a table holds."""
    known = json.dumps([table.names, table.mode, table.provenance], sort_keys=True)
    found = hashlib.sha256(known.encode())
    for array in (*(n.astype("<f8") for n in table.nodes), table.values.astype("<f4")):
        found.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _versions() -> dict[str, str]:
    """Software that a table was made with."""
    found = {"python": platform.python_version()}
    for name in ("petal-rig", "numpy", "scipy", "numba"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def _neighbours(reach: float) -> Array:
    """Centres of the hexagonal lattice of pitch 2 about a dome, within `reach` of it, nearest first; shape (c, 2)."""
    most = int(reach / math.sqrt(3)) + 2
    i, j = (a.ravel() for a in np.meshgrid(np.arange(-2 * most, 2 * most + 1), np.arange(-most, most + 1)))
    centres = np.column_stack([2.0 * i + j, math.sqrt(3) * j])
    distance = np.hypot(*centres.T)
    near = (distance > 0) & (distance <= reach)
    assert math.isclose(float(distance[near].min(initial=2.0)), CELL_AREA / math.sqrt(3))
    return centres[near][np.argsort(distance[near], kind="stable")]


def _spongy(theta: Array, phi: Array, n_ss: float) -> Array:
    """s_diff and s_spec of the flat boundary, eqs. (5) and (6), over nodes in deg; shape (2, i, r, p)."""
    t, p = np.radians(theta), np.radians(phi)
    cos_i, cos_r, sin_i, sin_r = np.cos(t)[:, None, None], np.cos(t)[:, None], np.sin(t)[:, None, None], np.sin(t)[:, None]
    lobe = np.maximum(0.0, cos_i * cos_r - sin_i * sin_r * np.cos(p)) ** n_ss
    return np.stack([np.broadcast_to(cos_i, lobe.shape), lobe])


def _flat(**numbers: ArrayLike) -> tuple[list[Array], tuple[int, ...]]:
    """Broadcast named numbers against one another and flatten them."""
    try:
        found = np.broadcast_arrays(*(np.asarray(a, float) for a in numbers.values()))
    except (TypeError, ValueError) as error:
        raise DomainError(f"{', '.join(numbers)} must be numbers of matching shapes: {error}") from error
    return [np.ascontiguousarray(a).reshape(-1) for a in found], found[0].shape


def _spread(count: int, kernel: Callable[[slice], int]) -> int | None:
    """Run a kernel over directions on all cores; the first direction that it refused, if any."""
    from fitting.interpolate import in_chunks

    refused: list[int] = []

    def task(part: slice) -> None:
        if (at := kernel(part)) >= 0:
            refused.append(part.start + at)

    in_chunks(count, task)
    return min(refused, default=None)


def _outside(theta_i: float, theta_r: float, phi: float) -> DomainError:
    """Say which angle is outside the table."""
    for name, angle, inside, span in (
        ("theta_i", theta_i, 0 <= theta_i <= 90, "0 <= theta_i <= 90 deg"),
        ("theta_r", theta_r, abs(theta_r) <= 90, "-90 <= theta_r <= 90 deg (beyond is behind the petal, which has no model here)"),
    ):
        if not inside:
            return DomainError(f"{name} = {angle:g} deg is outside the table: expected {span}")
    return DomainError(f"phi = {phi:g} deg is outside the table: expected a finite angle")


def _gauss(edges: Array, points: int) -> tuple[Array, Array]:
    """Gauss-Legendre between edges in deg: nodes in deg, weights in rad."""
    x, w = np.polynomial.legendre.leggauss(points)
    half = np.diff(edges)[:, None] / 2
    return (edges[:-1, None] + half * (1 + x)).ravel(), np.radians(half * w).ravel()
