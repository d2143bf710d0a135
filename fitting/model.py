"""The petal's reflection model in four degrees of physics, each a table per cell geometry; a cultivar is a few numbers on top.

"paper"            eqs. (1) to (7) of Tachino et al. as they stand: intensities
"radiometric"      the same four terms as a detector reads them, floor and foreshortening included: 1/sr
"interreflecting"  the epidermis' diffuse term with light thrown on from dome to dome, all orders: 1/sr
"body"             clear domes over a pigmented slab and a diffusing mesophyll, both faces: 1/sr, reflected and transmitted

What is slow, geometry, is traced once by `build` and stored in one file; numbers are chosen afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting import archive
from fitting.body import BodyTrace, Epidermis, trace_body
from fitting.cells import Cell, Spread
from fitting.errors import DomainError, TableError
from fitting.paper import TERMS
from fitting.progress import Progress, silent, stage
from fitting.reflectance import PER_SR, Reflectance
from fitting.scattering import Scattering
from fitting.table import Grid, ReflectanceTable, paper_table, radiometric_table

FORMAT = "petal-rig model 1"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Number:
    """One of the numbers that make a cultivar.

    Parameters
    ----------
    name, unit, meaning : str
        What it is.
    most : float
        It lies between 0 and this.
    usual : float, str or None
        What it is where nothing is said: a value, or the name of the number it equals; None where it must be given.
    """

    name: str
    unit: str
    meaning: str
    most: float = math.inf
    usual: float | str | None = None


_SPONGY = (
    Number("s_diff", "", "reflectance of the spongy tissue, diffuse", usual=0.0),
    Number("s_spec", "", "reflectance of the spongy tissue, lobe", usual=0.0),
)
NUMBERS: Mapping[str, tuple[Number, ...]] = {
    "paper": (
        Number("u_diff", "intensity", "x of eq. (8): epidermis, diffuse"),
        Number("u_spec", "intensity", "x of eq. (8): epidermis, specular"),
        Number("s_diff", "intensity", "x of eq. (8): spongy tissue, diffuse"),
        Number("s_spec", "intensity", "x of eq. (8): spongy tissue, specular"),
    ),
    "radiometric": (
        Number("u_diff", "", "reflectance of the epidermis, diffuse"),
        Number("u_spec", "", "reflectance of the epidermis, lobe", usual=0.0),
        *_SPONGY,
    ),
    "interreflecting": (
        Number("albedo", "", "of the epidermis, diffuse, for each bounce", most=1.0),
        Number("u_spec", "", "reflectance of the epidermis, lobe, one bounce", usual=0.0),
        *_SPONGY,
    ),
    "body": (
        Number("mu", "1/a", "absorption of the pigment"),
        Number("R_m", "", "light the mesophyll reflects", most=1.0),
        Number("T_m", "", "light the mesophyll lets through, diffusely", most=1.0),
        Number("D_m", "", "light the mesophyll lets through, unscattered", most=1.0, usual=0.0),
        Number("mu_below", "1/a", "absorption of the far face's pigment", usual="mu"),
        Number("R_m_below", "", "light the mesophyll reflects to the far side", most=1.0, usual="R_m"),
    ),
}
"""What makes a cultivar, for each mode."""

MODES = tuple(NUMBERS)


@dataclass(frozen=True, eq=False)
class Model:
    """One mode for one geometry; made by `build` or `load`.

    Attributes
    ----------
    mode : str
        One of `MODES`.
    table : ReflectanceTable
        What does not depend on the cultivar: basis functions, in "body" the mirror light of both faces.
    body : BodyTrace, optional
        Of the mode "body".
    """

    mode: str
    table: ReflectanceTable
    body: BodyTrace | None = None

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Cell, exponents, grid and whatever else it was made from; when and by which versions."""
        return self.table.provenance

    @property
    def numbers(self) -> tuple[Number, ...]:
        """What makes a cultivar."""
        return NUMBERS[self.mode]

    def parts(self, **numbers: float) -> tuple[ReflectanceTable, dict[str, float]]:
        """Split a cultivar's reflectance into what it is the sum of.

        Parameters
        ----------
        **numbers : float
            The cultivar's, see `NUMBERS`.

        Returns
        -------
        table : ReflectanceTable
            Basis functions: the paper's terms, orders of reflection, or mirror, stray and body light.
        weights : dict of str to float
            Of each.

        Raises
        ------
        DomainError
            If a number is missing, unknown or out of its range.
        """
        x = chosen(self.mode, numbers)
        if self.mode == "interreflecting":
            from fitting.orders import order_weights

            traced, values = self.provenance["orders"], self.table.values
            first = traced["count"] + 1  # of the other terms
            orders = order_weights(x.pop("albedo"), traced["count"], traced["decay"])
            later = np.tensordot(orders[2:], values[2:first].astype(float), 1)
            names = ("order_1", "order_2", "order_later", *self.table.names[first:])
            table = replace(self.table, names=names, values=np.stack([*values[:2], later, *values[first:]]).astype(np.float32))
            return table, dict(zip(names, [*orders[:2].tolist(), 1.0, *x.values()], strict=True))
        if self.body is None:
            return self.table, x
        theta_i, theta_r, phi = self.table.nodes
        at = theta_i[:, None, None], theta_r[:, None], phi
        shape = len(theta_i), len(theta_r), len(phi)
        parts = {
            "mirror": self.table.values[self.table.names.index("mirror")],
            "stray": self.body.stray_reflectance(*at, mu=x["mu"]),
            "body": np.broadcast_to(self.body.body_reflectance(*at[:2], **x), shape),
        }
        table = ReflectanceTable.from_basis(tuple(parts), parts, nodes=self.table.nodes, mode=PER_SR, provenance=self._tissue(x))
        return table, dict.fromkeys(parts, 1.0)

    def reflectance(self, **numbers: float) -> Reflectance:
        """Mix a cultivar.

        Parameters
        ----------
        **numbers : float
            As in `parts`.

        Raises
        ------
        DomainError
            If a number is missing, unknown or out of its range.
        EnergyError
            If it would send back more light than falls on it; in "paper" intensities are relative, and nothing is refused.
        """
        table, weights = self.parts(**numbers)
        return table.mixed(weights)

    def transmittance(self, *, direct: bool = True, **numbers: float) -> Reflectance:
        """Mix a cultivar's light on the far side; theta_r is the angle from the far normal.

        Parameters
        ----------
        direct : bool
            Whether light that was never scattered is in it, as a lobe of the streams' width.
        **numbers : float
            As in `parts`.

        Raises
        ------
        DomainError
            If a number is missing, unknown or out of its range, or the mode knows no transmission.
        """
        x = chosen(self.mode, numbers)
        theta_i, theta_r, phi = self.table.nodes
        through = self._traced.transmittance(theta_i[:, None], theta_r - 180, direct=direct, **x)
        values = np.broadcast_to(through[:, :, None], (len(theta_i), len(theta_r), len(phi)))
        table = ReflectanceTable.from_basis(("through",), [values], nodes=self.table.nodes, mode=PER_SR, provenance=self._tissue(x))
        return table.mixed({"through": 1.0})

    def scattering(self, **numbers: float) -> Scattering:
        """Both sides as one; parameters and errors as for `reflectance` and `transmittance`."""
        return Scattering(self.reflectance(**numbers), self.transmittance(direct=True, **numbers))

    def turned_over(self) -> Model:
        """Light the other face; `mu` and `R_m` then speak of what was below.

        Raises
        ------
        DomainError
            If the mode knows no other face.
        """
        other = {"mirror": "mirror_below", "mirror_below": "mirror"}
        body = self._traced.turned_over()
        return replace(self, table=replace(self.table, names=tuple(other[name] for name in self.table.names)), body=body)

    @property
    def _traced(self) -> BodyTrace:
        if self.body is None:
            raise DomainError(f"the mode {self.mode!r} knows nothing of the petal's other side: expected the mode 'body'")
        return self.body

    def _tissue(self, x: dict[str, float]) -> dict[str, Any]:
        return dict(self.provenance) | {"tissue": x}


def chosen(mode: str, numbers: Mapping[str, float]) -> dict[str, float]:
    """Check a cultivar's numbers and fill in the usual ones.

    Parameters
    ----------
    mode : str
        One of `MODES`.
    numbers : mapping of str to float
        Some of `NUMBERS`.

    Returns
    -------
    dict of str to float
        All of them, in their order.

    Raises
    ------
    DomainError
        If the mode is unknown, or a number missing, unknown or out of its range.
    """
    if mode not in NUMBERS:
        raise DomainError(f"no mode {mode!r}: expected one of {', '.join(MODES)}")
    known = {number.name: number for number in NUMBERS[mode]}
    if unknown := set(numbers) - set(known):
        raise DomainError(f"the mode {mode!r} has no {', '.join(sorted(unknown))}: its numbers are {', '.join(known)}")
    found: dict[str, float] = {}
    for name, number in known.items():
        value = numbers.get(name, found[number.usual] if isinstance(number.usual, str) else number.usual)
        if value is None:
            raise DomainError(f"the mode {mode!r} needs {name} ({number.meaning})")
        if not (math.isfinite(value) and 0 <= value <= number.most):
            limits = "0 or more" if number.most == math.inf else f"0 to {number.most:g}"
            raise DomainError(f"{name} ({number.meaning}) must be a number of {limits}, not {value!r}")
        found[name] = float(value)
    return found


def build(
    mode: str,
    cell: Cell | None = None,
    *,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    grid: Grid | None = None,
    lower: Cell | None = None,
    depth: float = 1.0,
    n: float = 1.4,
    seed: int = 0,
    progress: Progress = silent,
) -> Model:
    """Work out what does not depend on the cultivar: some seconds on two cores.

    Parameters
    ----------
    mode : str
        One of `MODES`.
    cell : Cell, optional
        Shape of the upper epidermis' cells.
    n_us, n_ss : float
        Exponents of the lobes of epidermis and spongy tissue; not in "body".
    grid : Grid, optional
        Directions of the table.
    lower : Cell, optional
        Shape of the lower epidermis' cells, flat where None; "body" only, as are the rest.
    depth : float
        Pigmented slab below the domes of both faces, a.
    n : float
        Refractive index of cells and mesophyll.
    seed : int
        Of the rays' places; in "interreflecting" too.
    progress : callable
        Told the share done, 0 to 1.

    Raises
    ------
    DomainError
        If the mode is unknown, or the geometry outside of what it describes.
    """
    cell, grid = cell or Cell(), grid or Grid()
    if mode == "paper":
        return Model(mode, paper_table(cell, n_us=n_us, n_ss=n_ss, grid=grid, progress=progress))
    if mode == "radiometric":
        return Model(mode, radiometric_table(cell, n_us=n_us, n_ss=n_ss, grid=grid, progress=progress))
    if mode == "interreflecting":
        return _interreflecting(cell, n_us, n_ss, grid, seed, progress)
    if mode == "body":
        return _body(cell, lower, depth, n, grid, seed, progress)
    raise DomainError(f"no mode {mode!r}: expected one of {', '.join(MODES)}")


def _interreflecting(cell: Cell, n_us: float, n_ss: float, grid: Grid, seed: int, progress: Progress) -> Model:
    from fitting.orders import escape_orders

    single = radiometric_table(cell, n_us=n_us, n_ss=n_ss, grid=grid, progress=stage(progress, 0, 0.4))
    traced = escape_orders(cell, *single.nodes, seed=seed, progress=stage(progress, 0.4, 1))
    count = len(traced.bases) - 1
    names = (*(f"order_{k + 1}" for k in range(count)), "order_rest", *TERMS[1:])
    others = [single.values[single.names.index(name)] for name in TERMS[1:]]
    about = {"count": count, "decay": traced.decay, "closure": traced.closure, "unclosed": traced.unclosed, "seed": seed}
    table = ReflectanceTable.from_basis(
        names,
        [*traced.bases, *others],
        nodes=single.nodes,
        mode=PER_SR,
        provenance=single.provenance | {"model": "interreflecting", "orders": about},
    )
    return Model("interreflecting", table)


def _body(cell: Cell, lower: Cell | None, depth: float, n: float, grid: Grid, seed: int, progress: Progress) -> Model:
    body = trace_body(Epidermis(cell, depth), Epidermis(lower, depth), n=n, seed=seed, progress=stage(progress, 0, 0.9))
    theta, phi = grid.theta[:-1], grid.phi
    at = theta[:, None, None], theta[:, None], phi
    mirror = {"mirror": body.mirror_reflectance(*at), "mirror_below": body.turned_over().mirror_reflectance(*at)}
    provenance = {
        "model": "body",
        "cell": asdict(cell),
        "lower": asdict(lower) if lower else None,
        "depth": depth,
        "trace": dict(body.provenance),
        "grid": asdict(grid),
    }
    table = ReflectanceTable.from_basis(tuple(mirror), mirror, nodes=(theta, theta, phi), mode=PER_SR, provenance=provenance)
    return Model("body", table, body)


def cell_of(model: Model) -> Cell:
    """Shape of the cells a model was built for."""
    about = dict(model.provenance["cell"])
    return Cell(**about | {"spread": Spread(**about["spread"])})


def save(model: Model, path: str | Path) -> None:
    """Write a model, where it comes from and the sum of its content to one .npz file."""
    about, arrays = model.table.stored()
    if model.body is not None:
        arrays = arrays | {f"body.{name}": array for name, array in model.body.arrays().items()}
    archive.write(path, FORMAT, about | {"mode": model.mode}, arrays)


def load(path: str | Path) -> Model:
    """Read a model that `save` wrote.

    Raises
    ------
    TableError
        If the file cannot be read, is not a model, or its content is not what was saved.
    """
    about, arrays = archive.read(path, FORMAT)
    try:
        table = ReflectanceTable.from_stored(about, arrays)
        traced = {name.removeprefix("body."): array for name, array in arrays.items() if name.startswith("body.")}
        if about["mode"] not in MODES or (about["mode"] == "body") != bool(traced):
            raise ValueError(f"its mode is {about['mode']!r}")
        return Model(about["mode"], table, BodyTrace.from_arrays(traced, table.provenance["trace"]) if traced else None)
    except (KeyError, ValueError, TypeError, DomainError) as error:
        raise TableError(path, f"not a model that this version reads ({error}): build it again") from error
