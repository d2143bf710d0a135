"""The ladder of reflection models, from Lambert's to light that was inside the petal; each is linear in its coefficients, given its shape.

"lambert"          one diffuse term
"phong"            Lambert and a normalised lobe about the mirror direction
"ggx"              Lambert and Cook and Torrance's microfacets with Trowbridge and Reitz's (GGX) slopes
"paper"            eqs. (1) to (8) as they stand
"radiometric"      the same four terms as a detector reads them
"interreflecting"  with light thrown on from dome to dome, all orders
"body"             clear domes over pigment and mesophyll: what they mirror, and what was inside

All are on the scale of `Measurements.intensity`: pi f_r cos(theta_i), 1 for the perfect diffuser lit along the normal.
"""

from __future__ import annotations

import contextlib
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting import archive
from fitting.cells import Cell
from fitting.errors import DomainError, TableError
from fitting.formats import replacing
from fitting.nodes import Nodes
from fitting.paper import TERMS, flat_spongy, paper_terms

if TYPE_CHECKING:
    from fitting.body import BodyTrace
    from fitting.orders import EscapeOrders
    from fitting.radiometric import Sampling

Array = NDArray[np.float64]
Design = Callable[[Mapping[str, float]], Array]
"""From shape numbers to what each reading would be for each coefficient alone at 1, shape (n, c)."""

FORMAT = "petal-rig trace 1"

REFRACTION = 1.4
"""Index of the petal's surface in "ggx" and "body" [U]."""

ORDERS_GRID = np.append(np.arange(0.0, 86.0, 5.0), 88.0), np.arange(0.0, 181.0, 30.0)
"""Nodes of theta and phi between which light of the second and later orders is interpolated: it varies slowly."""

RATIO = {"aspect": 1.4, "n_us": 1.8, "mu": 1.4, "R_m": 1.3, "p": 1.4, "q": 1.4}
"""Of neighbouring nodes while a shape is searched for.

What it costs in accuracy, rms over directions and as a fraction of a term's peak, is held by `tests/fitting/test_ladder.py`: diffuse terms
0.15 %, the lobe of the domes 0.7 %, mirror light of "body" 0.5 %, body light 1.25 %, 2 % where it is darker than a hundredth.
"""

DOME = ("aspect", "p", "q")
"""Shape numbers that make a cell."""

LEFT = 0.75
"""Of the light that the mesophyll does not reflect this share goes through it, the rest is absorbed [U]."""


class Directions(NamedTuple):
    """Light and view, deg: theta_i, and theta_r and phi = phi_r - phi_i as `fitting.radiometric_terms` takes them; shape (n,) each."""

    theta_i: Array
    theta_r: Array
    phi: Array

    @classmethod
    def of(cls, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike = 0.0) -> Directions:
        """Broadcast and flatten; raise DomainError outside of the hemisphere above the petal."""
        columns = [np.array(a, float).ravel() for a in np.broadcast_arrays(theta_i_deg, theta_r_deg, phi_deg)]
        theta_i, theta_r, phi = columns
        for name, angle, good, span in (
            ("theta_i", theta_i, (theta_i >= 0) & (theta_i < 90), "0 <= theta_i < 90 deg"),
            ("theta_r", theta_r, np.abs(theta_r) < 90, "-90 < theta_r < 90 deg"),
            ("phi", phi, np.isfinite(phi), "a finite angle"),
        ):
            if not good.all():
                raise DomainError(f"{name} = {angle[~good][0]:g} deg is outside the model: expected {span}")
        return cls(*columns)

    @property
    def cos_i(self) -> Array:
        """Cosine of theta_i."""
        return np.cos(np.radians(self.theta_i))

    @property
    def cos_r(self) -> Array:
        """Cosine of theta_r."""
        return np.cos(np.radians(self.theta_r))

    @property
    def mirrored(self) -> Array:
        """Cosine between the view and the mirror direction of the petal's plane, R.V."""
        sines = np.sin(np.radians(self.theta_i)) * np.sin(np.radians(self.theta_r))
        return np.asarray(self.cos_i * self.cos_r - sines * np.cos(np.radians(self.phi)))


@dataclass(frozen=True)
class ShapeNumber:
    """A number on which a model does not depend linearly.

    Attributes
    ----------
    name, unit, meaning : str
    low, high : float
        Where it is searched for unless other bounds are given.
    usual : float
        Where it is held unless told otherwise.
    most : float
        It lies above 0 and up to this.
    least : float
        And is not below this.
    fine : bool
        Whether it is searched for only where it is named.
    """

    name: str
    low: float
    high: float
    usual: float
    unit: str
    meaning: str
    most: float = math.inf
    least: float = 0.0
    fine: bool = False


ASPECT = ShapeNumber("aspect", 0.1, 4.0, 0.5, "1", "height over base diameter of the domes")
TRACED_ASPECT = replace(ASPECT, high=3.0)  # taller domes take long to trace
P = ShapeNumber("p", 1.1, 6.0, 2.0, "1", "exponent of the domes' profile z = h (1 - (r/a)^p)^(1/q)", least=1.0, fine=True)
Q = ShapeNumber("q", 1.1, 6.0, 2.0, "1", "root in the domes' profile", least=1.0, fine=True)
N_US = ShapeNumber("n_us", 2.0, 200.0, 40.0, "1", "exponent of the epidermis' lobe")
N_SS = ShapeNumber("n_ss", 1.0, 100.0, 5.0, "1", "exponent of the spongy tissue's lobe")
ALBEDO = ShapeNumber(
    "albedo", 0.02, 1.0, 0.5, "1", "reflectance of the domes' surface, by which light grows fainter from dome to dome", 1.0
)
MU = ShapeNumber("mu", 0.003, 3.0, 0.1, "1/a", "absorption of the pigment, a being the domes' base radius")
R_M = ShapeNumber("R_m", 0.1, 0.95, 0.6, "1", "reflectance of the mesophyll", 1.0)
LOBE = ShapeNumber("n", 1.0, 500.0, 40.0, "1", "exponent of the lobe")
ALPHA = ShapeNumber("alpha", 0.05, 1.0, 0.3, "1", "roughness of the microfacets", 1.0)


class Traces:
    """What is slow to trace, kept by the domes' shape while fits are made; `rays` and facets are fewer than for pictures.

    Parameters
    ----------
    folder : Path, optional
        Where traces are kept for later, too; it must be for this version of the code alone.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self.orders = functools.cache(self._orders)
        self.body = functools.cache(self._body)

    def _orders(self, cell: Cell) -> EscapeOrders:
        from fitting.orders import EscapeOrders, escape_orders

        theta, phi = ORDERS_GRID

        def trace() -> tuple[dict[str, Any], dict[str, Array]]:
            found = escape_orders(cell, theta, theta, phi, rays=1024)
            return {"decay": found.decay, "closure": found.closure, "unclosed": found.unclosed}, {"bases": found.bases}

        about, arrays = self._kept(f"orders-{_spelt(cell)}", trace)
        return EscapeOrders(cell, theta, theta, phi, arrays["bases"], **about, seed=0)

    def _body(self, cell: Cell) -> BodyTrace:
        from fitting.body import BodyTrace, Epidermis, trace_body

        def trace() -> tuple[dict[str, Any], dict[str, Array]]:
            found = trace_body(Epidermis(cell), Epidermis(None), n=REFRACTION, rays=1024)
            return dict(found.provenance), found.arrays()

        about, arrays = self._kept(f"body-{_spelt(cell)}", trace)
        return BodyTrace.from_arrays(arrays, about)

    def _kept(self, name: str, trace: Callable[[], tuple[dict[str, Any], dict[str, Array]]]) -> tuple[dict[str, Any], dict[str, Array]]:
        """Read a trace from the folder, or make it and put it there."""
        if self._folder is None:
            return trace()
        path = self._folder / f"{name}.npz"
        if path.exists():
            with contextlib.suppress(TableError):  # a damaged file is made anew
                return archive.read(path, FORMAT)
        about, arrays = trace()
        self._folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as unfinished:
            archive.write(unfinished, FORMAT, about, arrays)
        return about, arrays


def _spelt(cell: Cell) -> str:
    return "-".join(f"{number:.9g}" for number in (cell.aspect, cell.p, cell.q))


def dome(shape: Mapping[str, float]) -> Cell:
    """Return the cell of a rung's shape numbers."""
    return Cell(shape["aspect"], shape["p"], shape["q"])


class Rung(ABC):
    """A reflection model that is linear in its coefficients, given its shape.

    Attributes
    ----------
    name, title : str
    terms : tuple of str
        Of its coefficients, none negative.
    shape : tuple of ShapeNumber
        What it depends on otherwise.
    searched : tuple of str
        Shape numbers that the ladder's comparison finds; the others keep their usual values.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    terms: ClassVar[tuple[str, ...]]
    shape: ClassVar[tuple[ShapeNumber, ...]] = ()
    searched: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        """Evaluate the terms.

        Parameters
        ----------
        at : Directions
            n of them.
        shape : mapping of str to float
            All shape numbers.
        traces : Traces
            Where slow parts are kept.

        Returns
        -------
        ndarray, shape (n, c), on the scale of `Measurements.intensity`
        """

    def quick_design(self, at: Directions, held: Mapping[str, float], bounds: Mapping[str, tuple[float, float]], traces: Traces) -> Design:
        """Return the terms as a function of the numbers that are searched for, fast after the first few calls.

        Parameters
        ----------
        at, traces
            As in `design`.
        held : mapping of str to float
            Numbers that do not change.
        bounds : mapping of str to (float, float)
            The others.
        """
        return lambda found: self.design(at, {**held, **found}, traces)


class _Lambert(Rung):
    name, title = "lambert", "Lambert"
    terms = ("diff",)

    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        return at.cos_i[:, None]


class _Phong(Rung):
    name, title = "phong", "Phong"
    terms = ("diff", "spec")
    shape = (LOBE,)
    searched = ("n",)

    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        n = shape["n"]
        return np.column_stack([at.cos_i, (n + 2) / 2 * np.maximum(0.0, at.mirrored) ** n * at.cos_i])


class _Ggx(Rung):
    """Cook and Torrance 1982, doi:10.1145/357290.357293, with the slopes of Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206."""

    name, title = "ggx", "Cook-Torrance, GGX"
    terms = ("diff", "spec")
    shape = (ALPHA,)
    searched = ("alpha",)

    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        a2 = shape["alpha"] ** 2
        cos_i, cos_r = at.cos_i, np.maximum(at.cos_r, 1e-9)
        # wi.wo = cos(2 d), and the half vector's z is (cos_i + cos_r) / (2 cos d).
        between = 2 * cos_i * at.cos_r - at.mirrored
        cos_d = np.sqrt(np.maximum(0.0, (1 + between) / 2))
        cos_h = np.minimum(1.0, (cos_i + cos_r) / np.maximum(2 * cos_d, 1e-12))
        slopes = a2 / (math.pi * (cos_h**2 * (a2 - 1) + 1) ** 2)
        shadows = np.prod([2 * c / (c + np.sqrt(a2 + (1 - a2) * c * c)) for c in (cos_i, cos_r)], axis=0)
        f_r = slopes * shadows * fresnel(cos_d, REFRACTION) / (4 * cos_i * cos_r)
        return np.column_stack([cos_i, math.pi * f_r * cos_i])


def fresnel(cosine: Array, n: float) -> Array:
    """Reflectance of a smooth dielectric for unpolarised light from outside; `cosine` of the angle of incidence, `n` its index."""
    g = np.sqrt(n * n - 1 + cosine**2)
    return np.asarray(0.5 * ((g - cosine) / (g + cosine)) ** 2 * (1 + ((cosine * (g + cosine) - 1) / (cosine * (g - cosine) + 1)) ** 2))


class _Domed(Rung):
    """Two terms of the domed epidermis, two of the flat spongy tissue."""

    terms: ClassVar[tuple[str, ...]] = TERMS
    shape: ClassVar[tuple[ShapeNumber, ...]] = (ASPECT, P, Q, N_US, N_SS)
    searched: ClassVar[tuple[str, ...]] = ("aspect", "n_us", "n_ss")

    @abstractmethod
    def _domes(self, at: Directions, quick: bool, *, n_us: float, **shape: float) -> Array:
        """u_diff and u_spec, shape (n, 2)."""

    @abstractmethod
    def _spongy(self, at: Directions, n_ss: float) -> Array:
        """s_diff and s_spec, shape (n, 2)."""

    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        return np.column_stack([self._domes(at, False, **{name: shape[name] for name in (*DOME, "n_us")}), self._spongy(at, shape["n_ss"])])

    def quick_design(self, at: Directions, held: Mapping[str, float], bounds: Mapping[str, tuple[float, float]], traces: Traces) -> Design:
        domes = _interpolated(functools.partial(self._domes, at, True), (*DOME, "n_us"), held, bounds)
        return lambda found: np.column_stack([domes(found), self._spongy(at, {**held, **found}["n_ss"])])


def _interpolated(
    function: Callable[..., Array], names: tuple[str, ...], held: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> Design:
    """Put nodes over those of a function's numbers that are searched for."""
    fixed, free = {n: held[n] for n in names if n in held}, {n: bounds[n] for n in names if n in bounds}
    nodes = Nodes(functools.partial(function, **fixed), free, RATIO)
    return lambda found: nodes(**{name: found[name] for name in free})


class _Paper(_Domed):
    name, title = "paper", "the paper"
    searched = ()

    def _domes(self, at: Directions, quick: bool, *, n_us: float, **shape: float) -> Array:
        from fitting.radiometric import paper_terms_any

        cell = dome(shape)
        if cell.is_ellipsoid and not at.phi.any():
            return paper_terms(at.theta_i, at.theta_r, aspect=cell.aspect, n_us=n_us)[:, :2]
        return paper_terms_any(*at, cell=cell, n_us=n_us, sampling=_sampling(quick, n_us))[:, :2]

    def _spongy(self, at: Directions, n_ss: float) -> Array:
        return flat_spongy(at.cos_i, at.mirrored, n_ss)


class _Radiometric(_Domed):
    name, title = "radiometric", "radiometric"

    def _domes(self, at: Directions, quick: bool, *, n_us: float, **shape: float) -> Array:
        from fitting.radiometric import radiometric_terms

        terms = radiometric_terms(*at, cell=dome(shape), n_us=n_us, sampling=_sampling(quick, n_us))
        return np.asarray(math.pi * at.cos_i[:, None] * terms[:, :2])

    def _spongy(self, at: Directions, n_ss: float) -> Array:
        from fitting.radiometric import flat_spongy_per_sr

        return np.asarray(math.pi * at.cos_i[:, None] * flat_spongy_per_sr(at.mirrored, n_ss))


class _Interreflecting(_Radiometric):
    """The coefficient u_diff is as in "radiometric"; the albedo is of the domes alone and holds for readings of any scale."""

    name, title = "interreflecting", "interreflecting"
    shape = (TRACED_ASPECT, P, Q, N_US, N_SS, ALBEDO)
    searched = ("aspect", "n_us", "albedo")

    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        terms = super().design(at, shape, traces)
        terms[:, 0] += _later(self._orders(at, traces, **{name: shape[name] for name in DOME}), shape["albedo"])
        return terms

    def quick_design(self, at: Directions, held: Mapping[str, float], bounds: Mapping[str, tuple[float, float]], traces: Traces) -> Design:
        first = super().quick_design(at, held, bounds, traces)
        orders = _interpolated(functools.partial(self._orders, at, traces), DOME, held, bounds)

        def both(found: Mapping[str, float]) -> Array:
            terms = first(found)
            terms[:, 0] += _later(orders(found), {**held, **found}["albedo"])
            return terms

        return both

    @staticmethod
    def _orders(at: Directions, traces: Traces, **shape: float) -> Array:
        """Light of the second and later orders for albedo 1, an order a row, and in a last row their decay."""
        orders = traces.orders(dome(shape))
        later = _between(np.moveaxis(orders.bases[1:], 0, -1), at).T
        return np.vstack([math.pi * at.cos_i * later, np.full(later.shape[1], orders.decay)])


def _later(orders: Array, albedo: float) -> Array:
    """Light of the second and later orders for u_diff = 1: one factor of the albedo is in the coefficient already."""
    from fitting.orders import order_weights

    decay = min(max(float(orders[-1, 0]), 0.0), 1 - 1e-9)  # interpolated, it may be a hair outside
    return np.asarray(order_weights(albedo, len(orders) - 1, decay)[1:] / albedo @ orders[:-1])


class _Body(Rung):
    name, title = "body", "body light"
    terms = ("mirror", "body")
    shape = (TRACED_ASPECT, P, Q, MU, R_M)
    searched = ("aspect", "mu")

    def design(self, at: Directions, shape: Mapping[str, float], traces: Traces) -> Array:
        trace, R_m = traces.body(dome(shape)), shape["R_m"]
        mirror = trace.mirror_reflectance(*at)
        body = trace.body_reflectance(at.theta_i, at.theta_r, mu=shape["mu"], R_m=R_m, T_m=LEFT * (1 - R_m))
        return np.asarray(math.pi * at.cos_i[:, None] * np.column_stack([mirror, np.broadcast_to(body, mirror.shape)]))

    def quick_design(self, at: Directions, held: Mapping[str, float], bounds: Mapping[str, tuple[float, float]], traces: Traces) -> Design:
        def columns(**numbers: float) -> Array:
            return self.design(at, numbers, traces)

        return _interpolated(columns, tuple(number.name for number in self.shape), held, bounds)


def _sampling(quick: bool, n_us: float) -> Sampling | None:
    from fitting.radiometric import Sampling

    return Sampling(max(1200, math.ceil(24 * n_us)), 32) if quick else None


def _between(table: Array, at: Directions) -> Array:
    """Look a table over `ORDERS_GRID` up, linearly; beyond its last theta the value there is kept."""
    from scipy.interpolate import RegularGridInterpolator

    theta, phi = ORDERS_GRID
    turned = np.abs((at.phi + np.where(at.theta_r < 0, 180, 0) + 180) % 360 - 180)
    place = np.column_stack([np.minimum(at.theta_i, theta[-1]), np.minimum(np.abs(at.theta_r), theta[-1]), turned])
    return np.asarray(RegularGridInterpolator((theta, theta, phi), table)(place))


_LADDER = (_Lambert(), _Phong(), _Ggx(), _Paper(), _Radiometric(), _Interreflecting(), _Body())
RUNGS: Mapping[str, Rung] = {rung.name: rung for rung in _LADDER}
"""From the simplest on."""


def rung_of(name: str) -> Rung:
    """Find a rung; raise DomainError where there is none."""
    if name not in RUNGS:
        raise DomainError(f"no model {name!r}: expected one of {', '.join(RUNGS)}")
    return RUNGS[name]


def unit_reflectances(rung: Rung, shape: Mapping[str, float], traces: Traces, *, nodes: int = 32) -> Array:
    """Reflectance of each term with coefficient 1, at normal incidence into the hemisphere.

    On the scale of `Measurements.intensity` it is the integral of the term at theta_i = 0 over sin^2(theta_r): 1 for Lambert's,
    2 / (n_ss + 2) for the paper's s_spec.

    Parameters
    ----------
    rung, shape, traces
        As in `Rung.design`.
    nodes : int
        Gauss-Legendre nodes over sin^2(theta_r).

    Returns
    -------
    ndarray, shape (c,), 1/1

    Raises
    ------
    DomainError
        If a shape number is outside the model.
    """
    z, w = np.polynomial.legendre.leggauss(nodes)
    at = Directions.of(0.0, np.degrees(np.arcsin(np.sqrt((z + 1) / 2))))
    return np.asarray(w / 2 @ rung.design(at, shape, traces))
