"""Basis functions of the reflectance over all directions, tabulated once; a cultivar is a few weights on top.

The tables made here carry the single bounce off a patch of cells, in the paper's mode or in 1/sr (`fitting.radiometric`), to all light and
view above the petal. Other models' basis functions become tables by `ReflectanceTable.from_basis`.
"""

from __future__ import annotations

import functools
import json
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.cells import Cell
from fitting.errors import DomainError, EnergyError
from fitting.paper import TERMS, flat_spongy, paper_terms
from fitting.progress import Progress, silent, stage
from fitting.reflectance import INTENSITY, MODES, PER_SR, Reflectance

if TYPE_CHECKING:
    from fitting.interpolate import Axis
    from fitting.radiometric import Sampling

PAPER = "Tachino et al., eqs. (1) to (7)"
RADIOMETRIC = "single bounce off domes and floor"

ALBEDO_MARGIN = 0.01
"""How far above 1 the albedo of a BRDF may come out before it is refused: as much as a table may be off."""

LOBE_ERROR = 0.1
"""Most that a lobe may be off between the nodes, rms, as a fraction of its mean."""

REACH = 85.0
"""Nodes of theta must come at least this near to grazing, deg; beyond the last one its value is kept."""

Array = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Grid:
    """Where the directions are tabulated.

    Parameters
    ----------
    theta_steps : int
        Steps of theta_i and of theta_r from 0 to 90 deg, 3 or more; the last two hold more nodes, ever closer, since what domes show to
        grazing light or view changes quickly: highlights on the tips of tall domes come and go within 2 deg.
    phi_steps : int
        Steps of phi from 0 to 180 deg, 3 or more.

    Raises
    ------
    DomainError
        If there are fewer.
    """

    theta_steps: int = 30
    phi_steps: int = 36

    def __post_init__(self) -> None:
        if self.theta_steps < 3 or self.phi_steps < 3:
            raise DomainError(f"a grid needs 3 steps or more of theta and of phi, not {self.theta_steps} and {self.phi_steps}")

    @property
    def theta(self) -> Array:
        """Nodes of theta_i and theta_r, deg."""
        step = 90 / self.theta_steps
        ends = 90 - step * np.array([1.5, 7 / 6, 11 / 12, 2 / 3, 1 / 2, 1 / 3, 1 / 5, 2 / 15, 1 / 15, 0])
        return np.concatenate([np.arange(self.theta_steps - 1) * step, ends])

    @property
    def phi(self) -> Array:
        """Nodes of phi, deg."""
        return np.linspace(0, 180, self.phi_steps + 1)


@dataclass(frozen=True, eq=False)
class ReflectanceTable:
    """Basis functions over all directions above the petal, at nodes; made by `paper_table`, `radiometric_table` or `from_basis`.

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
    provenance : dict
        What it was made from and how: what the maker gave, and `made` (UTC) and `versions`.
    """

    names: tuple[str, ...]
    nodes: tuple[Array, Array, Array]
    values: Singles
    mode: str
    provenance: dict[str, Any]

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
            If these do not fit together, or a value is negative or not finite. Whether a BRDF sends back more light than falls on the
            petal is found out by `mixed`.
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
        return cls(tuple(names), (axes[0].nodes, axes[1].nodes, axes[2].nodes), single, mode, known)

    def stored(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Everything as what JSON can hold and as named arrays, for `fitting.archive`; `from_stored` reads both."""
        theta_i, theta_r, phi = self.nodes
        arrays: dict[str, NDArray[Any]] = {"theta_i": theta_i, "theta_r": theta_r, "phi": phi, "values": self.values}
        return {"names": list(self.names), "quantity": self.mode, "provenance": self.provenance}, arrays

    @classmethod
    def from_stored(cls, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> ReflectanceTable:
        """Undo `stored`; what else the two hold is left alone.

        Raises
        ------
        DomainError
            If something is missing or does not fit together.
        """
        try:
            names, mode, provenance = list(about["names"]), about["quantity"], dict(about["provenance"])
            theta_i, theta_r, phi, values = (arrays[name] for name in ("theta_i", "theta_r", "phi", "values"))
        except (KeyError, TypeError, ValueError) as error:
            raise DomainError(f"not a reflectance table ({type(error).__name__}: {error}): tabulate it again") from error
        return cls.from_basis(names, list(values), nodes=(theta_i, theta_r, phi), mode=mode, provenance=provenance)

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
        axes, values = self._axes, np.tensordot(weights, self.values.astype(float), 1)
        mixture = Reflectance(self.mode, dict(x), axes, coefficients(values, axes), self._swaps(values))
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
            If the table is another model's or its cells are no touching half-ellipsoids.
        """
        cell = self.provenance.get("cell", {})
        if self.provenance.get("model") != PAPER or cell != _plain(Cell(cell["aspect"])):
            raise DomainError(
                f"only a table of the model {PAPER!r} for touching half-ellipsoids can be compared with it in plane, not one of "
                f"{', '.join(self.names)} for {cell or 'no cell'}"
            )
        theta_i, theta_r = (a.ravel() for a in np.meshgrid(np.arange(2.0, 83, 10), np.arange(-86.0, 87, 4), indexing="ij"))
        exact = paper_terms(theta_i, theta_r, aspect=cell["aspect"], **self.provenance["exponents"])
        error = np.sqrt(np.mean((self.evaluate(theta_i, theta_r, 0) - exact) ** 2, axis=0)) / exact.max(axis=0)
        return dict(zip(TERMS, error.tolist(), strict=True))

    def _swaps(self, values: Array) -> bool:
        """Whether these are the same, but for single precision, when light and view are swapped."""
        theta_i, theta_r, _ = self.nodes
        swapped = values.transpose(1, 0, 2)
        return self.mode == PER_SR and np.array_equal(theta_i, theta_r) and bool(np.allclose(values, swapped, 1e-6, 1e-7 * values.max()))

    @functools.cached_property
    def _axes(self) -> tuple[Axis, Axis, Axis]:
        from fitting.interpolate import axis

        return axis(self.nodes[0], grazing=True), axis(self.nodes[1], grazing=True), axis(self.nodes[2], grazing=False)

    @functools.cached_property
    def _terms(self) -> dict[str, Reflectance]:
        return {}


def paper_table(
    cell: Cell | None = None,
    *,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    grid: Grid | None = None,
    sampling: Sampling | None = None,
    progress: Progress = silent,
) -> ReflectanceTable:
    """Compute the paper's four distributions over all directions, on all cores.

    Parameters
    ----------
    cell : Cell, optional
        Shape of the domes.
    n_us, n_ss : float
        Exponents of the specular lobes of epidermis and spongy tissue.
    grid : Grid, optional
        Where.
    sampling : fitting.radiometric.Sampling, optional
        How finely the surface is integrated; by default `Sampling.grazing()`.
    progress : callable
        Told the share done, 0 to 1.

    Returns
    -------
    ReflectanceTable
        Of `fitting.paper.TERMS`, as intensities.

    Raises
    ------
    DomainError
        If an exponent is outside the model, or a lobe too narrow for the grid or the sampling.

    Notes
    -----
    `tests/benchmarks/bench_form.py` prints how far tables are from direct integration for all directions;
    `ReflectanceTable.in_plane_error` measures one against `fitting.paper` in the plane of incidence.
    """
    return _tabulated(cell or Cell(), "paper", n_us, n_ss, grid or Grid(), sampling, progress)


def radiometric_table(
    cell: Cell | None = None,
    *,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    grid: Grid | None = None,
    sampling: Sampling | None = None,
    progress: Progress = silent,
) -> ReflectanceTable:
    """Compute the single-bounce reflectance of `fitting.radiometric.radiometric_terms` over all directions, on all cores.

    Parameters
    ----------
    cell, n_us, n_ss, grid, sampling, progress
        As for `paper_table`.

    Returns
    -------
    ReflectanceTable
        Of `fitting.paper.TERMS`, in 1/sr.

    Raises
    ------
    DomainError
        As `paper_table`.
    """
    return _tabulated(cell or Cell(), "radiometric", n_us, n_ss, grid or Grid(), sampling, progress)


def _tabulated(
    cell: Cell, mode: str, n_us: float, n_ss: float, grid: Grid, sampling: Sampling | None, progress: Progress
) -> ReflectanceTable:
    """Integrate at the nodes, and between some to see how far off the table is there."""
    from fitting.radiometric import LEANING, Sampling, basis_tables, radiometric_terms

    exponents = {"n_us": n_us, "n_ss": n_ss}
    fine = Sampling.grazing()
    rule = sampling or replace(fine, facets=max(fine.points(n_us), Sampling().points(n_us)))

    def integrate(theta: Array, phi: Array, progress: Progress) -> Mapping[str, Array]:
        if mode == "paper":
            return basis_tables(cell, theta, theta, phi, mode, **exponents, sampling=rule, progress=progress)
        i, r = np.triu_indices(len(theta))  # light and view may be swapped
        half = radiometric_terms(theta[i][:, None], theta[r][:, None], phi, cell=cell, **exponents, sampling=rule, progress=progress)
        terms = np.empty((len(TERMS), len(theta), len(theta), len(phi)))
        terms[:, i, r] = terms[:, r, i] = half.reshape(len(i), len(phi), -1).transpose(2, 0, 1)
        return dict(zip(TERMS, terms, strict=True))

    points = rule.points(n_us) * (LEANING if cell.spread.tilt > 0 else 1)
    apart = 2 * math.sqrt(4 * math.pi / points)  # of mirrored rays; half of the facets are even over the normals' hemisphere
    if n_us > 0 and apart > math.acos(0.5 ** (1 / n_us)):
        raise DomainError(f"u_spec, the lobe of n_us = {n_us:g}, falls between {points} facets: ask for finer sampling")
    theta = grid.theta[:-1]
    bases = integrate(theta, grid.phi, stage(progress, 0, 0.8))
    once = np.where((grid.phi == 0) | (grid.phi == 180), 0.5, 1.0)
    for values in bases.values():  # light or view from the zenith has no azimuth: what differs is how the points fall
        for zenith in (values[0], values[:, 0]):
            zenith[:] = np.average(zenith, axis=-1, weights=once)[..., None]
    if mode == "paper":
        theta = grid.theta
        bases = _with_grazing(bases, theta, grid.phi, n_ss)
    provenance = {
        "model": PAPER if mode == "paper" else RADIOMETRIC,
        "cell": asdict(cell),
        "exponents": {name: float(n) for name, n in exponents.items()},
        "grid": asdict(grid),
        "sampling": asdict(rule),
    }
    unit = INTENSITY if mode == "paper" else PER_SR
    table = ReflectanceTable.from_basis(TERMS, bases, nodes=(theta, theta, grid.phi), mode=unit, provenance=provenance)
    try:
        off = _between(table, lambda theta, phi: integrate(theta, phi, stage(progress, 0.8, 1)))
    except EnergyError as error:  # physics has none to give: a lobe between the nodes is drawn too wide
        raise DomainError(f"the grid is too coarse for what is reflected ({error}): ask for a finer grid") from error
    for name, exponent in (("u_spec", f"n_us = {n_us:g}"), ("s_spec", f"n_ss = {n_ss:g}")):
        if off[name] > LOBE_ERROR:
            raise DomainError(
                f"{name}, the lobe of {exponent}, is {100 * off[name]:.2g} % rms of its mean off between the grid's nodes: ask for a "
                "finer grid"
            )
    return replace(table, provenance=table.provenance | {"error_between_nodes": off})


def _between(table: ReflectanceTable, integrate: Callable[[Array, Array], Mapping[str, Array]]) -> dict[str, float]:
    """Rms departure of each term from direct integration midway between nodes, as a fraction of its mean there."""
    theta, phi = ((along[:-1] + along[1:]) / 2 for along in table.nodes[1:])
    around = phi[np.unique(np.linspace(0, len(phi) - 1, 6).astype(int))]
    found = table.evaluate(theta[:, None, None], theta[:, None], around)
    solid = np.sin(np.radians(2 * theta)) * np.diff(table.nodes[1])  # projected: what light and view there count for
    weight = np.broadcast_to((solid[:, None] * solid)[..., None], found.shape[:-1])
    return {
        name: math.sqrt(np.average((found[..., n] - exact) ** 2, weights=weight)) / float(np.average(exact, weights=weight))
        for n, (name, exact) in enumerate(integrate(theta, around).items())
    }


def _with_grazing(bases: Mapping[str, Array], theta: Array, phi: Array, n_ss: float) -> dict[str, Array]:
    """Add the paper's terms at 90 deg to those below.

    There light reaches, and a view sees, no share of any patch of domes: of a lattice's azimuths only the few along its lanes look far
    between the domes, and the tallest domes show no more than their tips. The flat spongy tissue's terms are eqs. (5) and (6).
    """
    shape = (len(theta), len(theta), len(phi))
    out = {name: np.zeros(shape) for name in TERMS}
    t, p = np.radians(theta), np.radians(phi)
    cos_i = np.broadcast_to(np.cos(t)[:, None, None], shape)
    mirrored = cos_i * np.cos(t)[:, None] - np.sin(t)[:, None, None] * np.sin(t)[:, None] * np.cos(p)
    out["s_diff"], out["s_spec"] = (term.reshape(shape) for term in flat_spongy(cos_i.ravel(), mirrored.ravel(), n_ss).T)
    for name, values in bases.items():
        out[name][:-1, :-1] = values
    return out


def _plain(cell: Cell) -> Any:
    """A cell as a table's provenance has it."""
    return json.loads(json.dumps(asdict(cell)))


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
