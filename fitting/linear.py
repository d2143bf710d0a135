"""The linear fit: coefficients that are never negative, how far each can be trusted, and what the readings cannot tell.

The interval of a coefficient spans two. One is that of plain least squares, cut off at 0, which holds the truth 95 times in 100 whatever
the truth is. The other is profiled: those values at which the weighted sum of squares, minimised over all other coefficients from 0 up,
exceeds its least by no more than the 95 % point. Well above 0 they are the same. The first alone may be empty or miss the estimate; the
second alone is too short where other coefficients are truly 0 (right 87 times in 100 with three of them, as drawn in
`tests/benchmarks/bench_linear.py`). For coefficients the readings do not fix the first does not exist; the second then takes the 95 % point
of all directions together, which is enough for any of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import FitError, ReadingError
from fitting.measurements import NOISE
from fitting.paper import TERMS

Weights = Literal["relative", "plain", "sigma", "covariance"]
Array = NDArray[np.float64]
Solver = Callable[[Array, Array], Array]
MaskedArray = np.ma.MaskedArray[Any, np.dtype[np.float64]]

RANK_TOLERANCE = 1e-3
"""Singular values below this fraction of the largest count as zero: the terms themselves are no better known."""

NEGLIGIBLE = 1e-6
"""A term that stays below this fraction of the largest at every reading is taken as absent: its coefficient would be noise, blown up."""

MOVED = 0.01
"""A coefficient counts as not determined when the directions the data cannot see hold this share of it (0.1 squared)."""

ALIKE = 0.95
"""From this correlation on, two coefficients are said to be hard to tell apart."""

CONFIDENCE = 0.95

ROUNDING = 1e-10
"""Curvatures and slopes of columns of unit length below this are zero."""


@dataclass(frozen=True)
class Coefficient:
    """One coefficient of a linear fit.

    Attributes
    ----------
    name : str
        Of its term.
    value : float
        0 or more, in the unit of values / terms.
    standard_error : float
        Of the estimate were it free to be negative; infinite where not determined or where nothing tells the noise.
    low, high : float
        95 % interval; `low` is 0 where the data do not exclude 0, `high` may be infinite. Given the noise and the model, it holds the truth
        at least that often, and about 97 times in 100 where it or another truth is within two standard errors of 0.
    active : bool
        Whether the value is 0 because the constraint holds it there.
    multiplier : float
        Of an active constraint: growth of the weighted sum of squares for each unit of the coefficient; else 0.
    determined : bool
        Whether the readings fix it; if not, the value is one of many that fit equally well, all within the interval.
    """

    name: str
    value: float
    standard_error: float
    low: float
    high: float
    active: bool
    multiplier: float
    determined: bool

    def __str__(self) -> str:
        if not self.determined:
            return f"{self.name}: not determined, {self.low:.4g} to {self.high:.4g}"
        held = f", held at 0 (multiplier {self.multiplier:.3g})" if self.active else ""
        return f"{self.name} = {self.value:.4g} +- {self.standard_error:.2g}, 95 %: {self.low:.4g} to {self.high:.4g}{held}"


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Outcome of `fit_linear`.

    Attributes
    ----------
    coefficients : tuple of Coefficient
        In the order of the columns.
    weights : str
        "relative", "plain", "sigma" or "covariance".
    measured, modelled : ndarray, shape (n,)
        Values given and fitted.
    E : masked ndarray, shape (n,), percent
        Eq. (13), abs(measured - modelled) / measured; masked at readings of 0 or less, where it means nothing.
    cosine_rmse : float or None
        Root of the mean of (measured - modelled)^2 weighted by abs(cos(theta_r)), in the unit of the values; None without theta_r.
    sum_of_squares : float
        What was minimised.
    chi2 : float or None
        Residuals against their covariance, whatever the weights; None if there is none.
    dof : int
        Readings less coefficients above 0.
    scale : float or None
        Standard deviation of the weighted residuals (of relative weights: a fraction); None without degrees of freedom.
    known_noise : bool
        Whether standard errors come from a covariance that was given, or else from `scale`.
    rank : int
        Combinations of coefficients that the readings fix.
    condition : float
        Ratio of largest to smallest singular value of the weighted design, columns scaled to length 1; infinite if a term is absent.
    groups : tuple of tuple of str
        Coefficients that trade against one another without changing the fit, a group for each independent direction or several; a term
        absent from all readings is a group of its own.
    correlation : ndarray, shape (c, c)
        Of the coefficients were they free to be negative; within a group, of the direction the data cannot see.
    """

    coefficients: tuple[Coefficient, ...]
    weights: Weights
    measured: Array
    modelled: Array
    E: MaskedArray
    cosine_rmse: float | None
    sum_of_squares: float
    chi2: float | None
    dof: int
    scale: float | None
    known_noise: bool
    rank: int
    condition: float
    groups: tuple[tuple[str, ...], ...]
    correlation: Array

    def __len__(self) -> int:
        return self.measured.size

    def __getitem__(self, name: str) -> Coefficient:
        for coefficient in self.coefficients:
            if coefficient.name == name:
                return coefficient
        raise KeyError(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return tuple(c.name for c in self.coefficients)

    @property
    def x(self) -> Array:
        """Values of the coefficients, shape (c,)."""
        return np.array([c.value for c in self.coefficients])

    @property
    def E_mean(self) -> float | None:
        """Mean of E over the readings above 0, percent; None if there are none."""
        return float(self.E.mean()) if self.E.count() else None

    @property
    def E_max(self) -> float | None:
        """Largest E among the readings above 0, percent; None if there are none."""
        return float(self.E.max()) if self.E.count() else None

    @property
    def chi2_per_dof(self) -> float | None:
        """Chi-square per degree of freedom; None without a covariance or without degrees of freedom."""
        return None if self.chi2 is None or self.dof == 0 else self.chi2 / self.dof

    @property
    def active(self) -> tuple[str, ...]:
        """Coefficients that a constraint holds at 0."""
        return tuple(c.name for c in self.coefficients if c.active)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Coefficients that the readings do not fix."""
        return tuple(c.name for c in self.coefficients if not c.determined)

    @property
    def alike(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs that are hard to tell apart or cannot be, with their correlation."""
        pairs = combinations(range(len(self.coefficients)), 2)
        return tuple((self.names[i], self.names[j], float(r)) for i, j in pairs if abs(r := self.correlation[i, j]) >= ALIKE)

    @property
    def statement(self) -> str:
        """What can and what cannot be concluded, line by line."""
        lines = [str(c) for c in self.coefficients]
        lines.append(f"{len(self)} readings fix {self.rank} of {len(self.coefficients)} coefficients (condition {self.condition:.3g})")
        for group in self.groups:
            if len(group) == 1:
                lines.append(f"{group[0]} is NOT determined: its term is next to nothing at every reading")
            else:
                named = f"{', '.join(group[:-1])} and {group[-1]}"
                lines.append(f"{named} are NOT determined: they can change together without changing the fit; add readings at other angles")
        apart = [(a, b, r) for a, b, r in self.alike if self[a].determined and self[b].determined]
        lines += [f"{a} and {b} are hard to tell apart: correlation {r:.3f}" for a, b, r in apart]
        if self.chi2_per_dof is not None:
            lines.append(f"chi-square per degree of freedom {self.chi2_per_dof:.3g} ({self.dof})")
            if self.chi2_per_dof > 1 + 3 * math.sqrt(2 / self.dof):
                lines.append("the model does not describe the readings within their uncertainty: the intervals leave that misfit out")
        elif self.scale is None:
            lines.append("no standard errors: as many coefficients as readings, and no covariance that tells the noise")
        return "\n".join(lines)

    def reflectances(self, unit: ArrayLike, white: float = 1.0) -> dict[str, tuple[float, float, float]]:
        """Normalise the coefficients to reflectances.

        Parameters
        ----------
        unit : array_like, shape (c,)
            Reflectance of each term with coefficient 1, as `fitting.ladder.unit_reflectances` gives.
        white : float
            Reading of the perfect diffuser at normal incidence in the unit of the values; 1 for reflectance factors and for BRDF, as
            `Measurements.intensity` converts them.

        Returns
        -------
        dict of str to (float, float, float)
            Reflectance and its 95 % interval.

        Raises
        ------
        FitError
            If the white reading is not above 0, or there is not one unit for each coefficient.
        """
        per = np.asarray(unit, float)
        if not (math.isfinite(white) and white > 0):
            raise FitError(f"the white reading must be a finite number above 0, not {white!r}")
        if per.shape != (len(self.coefficients),) or not np.all(np.isfinite(per) & (per > 0)):
            raise FitError(f"expected {len(self.coefficients)} unit reflectances above 0, one for each coefficient, not {unit!r}")
        return {
            c.name: (c.value * u / white, c.low * u / white, c.high * u / white)
            for c, u in zip(self.coefficients, per.tolist(), strict=True)
        }

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, text and lists that JSON can hold; what is infinite or means nothing becomes None."""
        return {
            "coefficients": [{k: _plain(v) for k, v in asdict(c).items()} for c in self.coefficients],
            "x": {c.name: c.value for c in self.coefficients},
            "weights": self.weights,
            "measured": self.measured.tolist(),
            "modelled": self.modelled.tolist(),
            "E": self.E.tolist(),
            "E_mean": self.E_mean,
            "E_max": self.E_max,
            "cosine_rmse": self.cosine_rmse,
            "sum_of_squares": self.sum_of_squares,
            "chi2": self.chi2,
            "dof": self.dof,
            "chi2_per_dof": self.chi2_per_dof,
            "scale": self.scale,
            "known_noise": self.known_noise,
            "rank": self.rank,
            "condition": _plain(self.condition),
            "groups": [list(group) for group in self.groups],
            "active": list(self.active),
            "undetermined": list(self.undetermined),
            "alike": [list(pair) for pair in self.alike],
            "correlation": self.correlation.tolist(),
            "statement": self.statement,
        }

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> LinearFit:
        """Rebuild a fit from `to_dict`.

        Raises
        ------
        FitError
            If an entry is missing or of the wrong kind.
        """
        try:
            values: dict[str, Any] = {field.name: stored[field.name] for field in fields(cls)}
            values["coefficients"] = tuple(_coefficient(c) for c in values["coefficients"])
            values |= {name: np.array(values[name], float) for name in ("measured", "modelled", "correlation")}
            values["E"] = np.ma.masked_invalid(np.array(values["E"], float))
            values["condition"] = math.inf if values["condition"] is None else float(values["condition"])
            values["groups"] = tuple(tuple(group) for group in values["groups"])
        except KeyError as error:
            raise FitError(f"a stored fit lacks {error}; it was perhaps written by something else") from error
        except (TypeError, ValueError) as error:
            raise FitError(f"a stored fit cannot be read: {error}") from error
        return cls(**values)


def _coefficient(stored: Mapping[str, Any]) -> Coefficient:
    unbounded = {name: math.inf for name in ("standard_error", "high") if stored[name] is None}
    return Coefficient(**{**stored, **unbounded})


def fit_linear(
    terms: ArrayLike,
    values: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    weights: Weights = "relative",
    names: Sequence[str] = TERMS,
    tangents: ArrayLike | None = None,
    theta_r_deg: ArrayLike | None = None,
    source: str = "readings",
    rows: ArrayLike | None = None,
) -> LinearFit:
    """Fit values = terms @ x with no x below 0.

    Parameters
    ----------
    terms : array_like, shape (n, c)
        What each reading would be for each coefficient alone at 1.
    values : array_like, shape (n,)
        Readings.
    covariance : array_like, shape (n, n), optional
        Of the readings. Standard errors and intervals follow from it under any weights; without it, from the residuals, by Student's t.
    weights : {"relative", "plain", "sigma", "covariance"}
        Minimise the residuals over the readings, as they are, over the covariance's diagonal, or over all of it. Relative weights favour
        readings that happen to be low: with noise of a fraction f the coefficients come out low by about f^2.
    names : sequence of str
        Of the columns.
    tangents : array_like, shape (n, q), optional
        How the fitted values change with numbers that were found from the same readings, such as a shape. These may change too, either
        way, in the intervals, which grow wider, and they take q degrees of freedom. The coefficients are those best with the numbers found.
    theta_r_deg : array_like, shape (n,), optional, deg
        Views, for the cosine-weighted error.
    source : str
        Where the readings come from, for errors.
    rows : array_like of int, shape (n,), optional
        Row of each in its source; 1, 2, ... if not given.

    Returns
    -------
    LinearFit
        Also for too few or collinear readings: what they fix is found, and what not is said.

    Raises
    ------
    ReadingError
        Naming the row: a value or term is not finite; a reading is not above 0 with relative weights, or further below 0 than noise goes;
        a variance is not above 0; the covariance is not positive definite from this row on.
    FitError
        If the shapes do not match, there are no readings, no term acts on any of them, or there is no covariance to weigh by.
    """
    design, target, views, lines, names = _checked(terms, values, theta_r_deg, source, rows, names)
    noise, root, whiten = _weighing(target, covariance, weights, source, lines)
    size = np.abs(design).max(axis=0)
    present = size > NEGLIGIBLE * size.max()
    if not present.any():
        raise FitError(
            f"{source}: every term is 0 at every reading, so no coefficient can be found: choose readings where the model is not 0"
        )

    weighted, aim = whiten(design[:, present]), whiten(target[:, None])[:, 0]
    length = np.linalg.norm(weighted, axis=0)
    weighted /= length
    traded, best = 0, None
    if tangents is not None:
        best, pull = _non_negative(weighted, aim, source)
        along = _directions(whiten(_checked_tangents(tangents, len(target), source)))
        weighted, aim, traded = weighted - along @ (along.T @ weighted), aim - along @ (along.T @ aim), along.shape[1]
    u, singular, v = _seen(weighted)
    x, gradient = _non_negative(singular[:, None] * v, u.T @ aim, source)
    if best is None:
        best, pull = x, gradient
    modelled = design[:, present] @ (best / length)
    sum_of_squares = float(np.sum((whiten((target - modelled)[:, None])) ** 2))

    dof = max(0, len(target) - int(np.sum(best > 0)) - traded)
    scale = math.sqrt(sum_of_squares / dof) if dof > 0 else None
    spread = _spread(u, weights, whiten, noise)
    level = 1.0 if noise is not None else math.inf if scale is None else scale
    moved, hidden = _hidden(v)
    inverse = v.T / singular
    variance = inverse @ spread @ inverse.T
    deviation = np.where(moved, math.inf, level * np.sqrt(np.diag(variance)))
    slope = np.where(x > 0, 0.0, gradient)

    single, joint = _quantiles(len(singular), None if noise is not None else dof)
    # The sum of squares may rise by this before a value is excluded.
    least = np.diag(variance) / np.sum(inverse**2, axis=1) * single
    rise = level**2 * np.where(moved, np.linalg.eigvalsh(spread)[-1] * joint, least)
    low, high = _profiled((v.T * singular**2) @ v, slope, x, rise, _shortest if moved.any() else _solve)
    if math.isfinite(level):
        free, reach = inverse @ (u.T @ aim), math.sqrt(single) * deviation
        low = np.where(moved, low, np.minimum(low, np.maximum(0.0, free - reach)))
        high = np.where(moved, high, np.maximum(high, free + reach))
    low, high = np.minimum(low, best), np.maximum(high, best)

    def spelt(name: str, i: int) -> Coefficient:
        unseen = bool(moved[i])
        held = bool(best[i] == 0) and not unseen
        value, error, lowest, highest = (float(a[i] / length[i]) for a in (best, deviation, low, high))
        push = 2 * max(0.0, float(pull[i] * length[i])) if held else 0.0
        return Coefficient(name, value, error, lowest, highest, active=held, multiplier=push, determined=not unseen)

    place = np.cumsum(present) - 1
    absent = partial(
        Coefficient, value=0.0, standard_error=math.inf, low=0.0, high=math.inf, active=False, multiplier=0.0, determined=False
    )
    coefficients = tuple(spelt(name, int(i)) if here else absent(name) for name, here, i in zip(names, present, place, strict=True))
    smallest = np.linalg.svd(weighted, compute_uv=False)
    full = bool(present.all()) and len(smallest) == len(names) and smallest[-1] > 0
    percent = np.ma.masked_where(target <= 0, 100 * np.abs(target - modelled) / np.where(target > 0, target, 1.0))
    return LinearFit(
        coefficients=coefficients,
        weights=weights,
        measured=target,
        modelled=modelled,
        E=percent,
        cosine_rmse=_cosine_rmse(target - modelled, views),
        sum_of_squares=sum_of_squares,
        chi2=None if root is None else float(np.sum(_solve_root(root, (target - modelled)[:, None]) ** 2)),
        dof=dof,
        scale=scale,
        known_noise=noise is not None,
        rank=len(singular),
        condition=float(smallest[0] / smallest[-1]) if full else math.inf,
        groups=_groups(names, present, moved, hidden),
        correlation=_correlation(present, moved, variance, hidden),
    )


def weighing(
    values: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    weights: Weights = "relative",
    source: str = "readings",
    rows: ArrayLike | None = None,
) -> Callable[[Array], Array]:
    """Return what multiplies residuals before `fit_linear` squares them, as a function of columns of shape (n, c).

    Parameters and errors are those of `fit_linear`.
    """
    _, target, _, lines, _ = _checked(np.ones((np.size(values), 1)), values, None, source, rows, ("",))
    return _weighing(target, covariance, weights, source, lines)[2]


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _checked(
    terms: ArrayLike, values: ArrayLike, theta_r_deg: ArrayLike | None, source: str, rows: ArrayLike | None, names: Sequence[str]
) -> tuple[Array, Array, Array | None, NDArray[np.int64], tuple[str, ...]]:
    """Return design, readings, views, rows and names as they should be."""
    try:
        design, target = np.array(terms, float), np.array(values, float)
        views = None if theta_r_deg is None else np.array(theta_r_deg, float)
        lines = np.arange(1, target.size + 1) if rows is None else np.array(rows, dtype=np.int64)
    except (TypeError, ValueError) as error:
        raise FitError(f"{source}: terms, values, views and rows must be numbers: {error}") from error
    if target.ndim != 1 or target.size == 0:
        raise FitError(f"{source}: expected one or more readings in one column, not shape {target.shape}")
    if design.shape != (target.size, len(names)) or not names:
        raise FitError(
            f"{source}: terms have shape {design.shape}, expected ({target.size}, {len(names)}): a row a reading, a column a name"
        )
    if len(set(names)) < len(names):
        raise FitError(f"{source}: two columns have the same name among {', '.join(names)}")
    for what, column in (("theta_r", views), ("rows", lines)):
        if column is not None and column.shape != target.shape:
            raise FitError(f"{source}: {what} has shape {column.shape}, expected {target.shape}")
    for what, column in (("the reading", target), ("a term", np.where(np.isfinite(design).all(axis=1), 0.0, math.nan)), ("theta_r", views)):
        if column is not None and not np.all(good := np.isfinite(column)):
            first = int(np.flatnonzero(~good)[0])
            raise ReadingError(source, int(lines[first]), f"{what} is not a finite number: leave the row out or mend it")
    target.flags.writeable = False
    return design, target, views, lines, tuple(names)


def _checked_covariance(covariance: ArrayLike, n: int, source: str, rows: NDArray[np.int64]) -> Array:
    try:
        noise = np.array(covariance, float)
    except (TypeError, ValueError) as error:
        raise FitError(f"{source}: the covariance must be numbers: {error}") from error
    if noise.shape != (n, n):
        raise FitError(f"{source}: the covariance has shape {noise.shape}, expected ({n}, {n}) for {n} readings")
    variance = np.diag(noise)
    if np.any(bad := ~(np.isfinite(variance) & (variance > 0))):
        first = int(np.flatnonzero(bad)[0])
        raise ReadingError(source, int(rows[first]), f"its variance is {variance[first]:g}, expected a finite number above 0")
    allowed = 1e-9 * np.sqrt(variance[:, None] * variance)
    if not np.all(good := np.abs(noise - noise.T) <= allowed):  # also False for NaN
        first, second = (int(i) for i in np.argwhere(~good)[0])
        raise ReadingError(source, int(rows[first]), f"its covariance with row {rows[second]} is not finite or not symmetric")
    return (noise + noise.T) / 2


def _cholesky(noise: Array, source: str, rows: NDArray[np.int64]) -> Array:
    """Lower root of the covariance, or an error that names the first row others leave no variance."""
    from scipy.linalg.lapack import dpotrf

    deviation = np.sqrt(np.diag(noise))
    root, stopped = dpotrf(noise / deviation[:, None] / deviation, lower=1, clean=1)
    own = np.diag(root)[: stopped - 1] if stopped else np.diag(root)
    if np.any(exhausted := own < 1e-7):  # of 1: what is left of the standard deviation is rounding
        stopped = int(np.flatnonzero(exhausted)[0]) + 1
    if stopped:
        raise ReadingError(
            source,
            int(rows[stopped - 1]),
            "the covariance is not positive definite: the rows before would foretell this one exactly; give it noise of its own or drop it",
        )
    return np.asarray(root) * deviation[:, None]


def _solve_root(root: Array, columns: Array) -> Array:
    from scipy.linalg.blas import dtrsm  # solve_triangular wakes a second thread even for these few numbers

    return np.asarray(dtrsm(1.0, root, columns, lower=1))


def _require_light(target: Array, noise: Array | None, weights: str, source: str, rows: NDArray[np.int64]) -> None:
    """Refuse readings that cannot be light, or cannot be divided by."""
    if weights == "relative" and np.any(dark := target <= 0):
        first = int(np.flatnonzero(dark)[0])
        problem = f"reading is {target[first]:g}, but relative weights need it above 0: leave it out or use other weights"
        raise ReadingError(source, int(rows[first]), problem)
    if noise is not None and np.any(negative := target < -NOISE * np.sqrt(np.diag(noise))):
        first = int(np.flatnonzero(negative)[0])
        times = -target[first] / math.sqrt(noise[first, first])
        problem = f"reading is {target[first]:g}, {times:.3g} standard deviations below 0, which no light can be: look at the dark reading"
        raise ReadingError(source, int(rows[first]), problem)


def _weighing(
    target: Array, covariance: ArrayLike | None, weights: str, source: str, rows: NDArray[np.int64]
) -> tuple[Array | None, Array | None, _Scaled | _Rooted]:
    """Covariance, its root and the weights, all checked."""
    noise = None if covariance is None else _checked_covariance(covariance, len(target), source, rows)
    root = None if noise is None else _cholesky(noise, source, rows)
    _require_light(target, noise, weights, source, rows)
    return noise, root, _whitener(weights, target, noise, root, source)


class _Scaled:
    """Multiplies the rows of a matrix."""

    def __init__(self, factor: Array) -> None:
        self.factor = factor[:, None]

    def __call__(self, columns: Array) -> Array:
        return columns * self.factor


class _Rooted:
    """Applies the inverse of the covariance's root."""

    def __init__(self, root: Array) -> None:
        self.root = root

    def __call__(self, columns: Array) -> Array:
        return _solve_root(self.root, columns)


def _whitener(weights: str, target: Array, noise: Array | None, root: Array | None, source: str) -> _Scaled | _Rooted:
    if weights == "plain":
        return _Scaled(np.ones(len(target)))
    if weights == "relative":
        return _Scaled(1 / target)
    if weights not in ("sigma", "covariance"):
        raise FitError(f"unknown weights {weights!r}; known are relative, plain, sigma and covariance")
    if noise is None or root is None:
        raise FitError(f"{source}: there is no sigma and no covariance to weigh by: give one or use other weights")
    return _Rooted(root) if weights == "covariance" else _Scaled(1 / np.sqrt(np.diag(noise)))


def _checked_tangents(tangents: ArrayLike, n: int, source: str) -> Array:
    found = np.array(tangents, float)
    if found.ndim != 2 or len(found) != n or not np.all(np.isfinite(found)):
        raise FitError(f"{source}: tangents must be finite and of shape ({n}, q), a row a reading, not {found.shape}")
    return found


def _directions(columns: Array) -> Array:
    """Unit vectors that span some columns."""
    length = np.linalg.norm(columns, axis=0)
    u, singular, _ = np.linalg.svd(columns[:, length > 0] / length[length > 0], full_matrices=False)
    return u[:, singular > RANK_TOLERANCE * singular.max(initial=0.0)]


def _seen(design: Array) -> tuple[Array, Array, Array]:
    """Singular values and directions of the design that count."""
    u, singular, v = np.linalg.svd(design, full_matrices=False)
    counts = singular >= RANK_TOLERANCE * singular[0]
    return u[:, counts], singular[counts], v[counts]


def _non_negative(design: Array, target: Array, source: str) -> tuple[Array, Array]:
    """Least squares from 0 up, and half the gradient there."""
    from scipy.optimize import nnls

    try:
        x, _ = nnls(design, target)
    except RuntimeError as error:
        raise FitError(f"{source}: non-negative least squares did not converge: {error}") from error
    return x, design.T @ (design @ x - target)


def _spread(u: Array, weights: str, whiten: _Scaled | _Rooted, noise: Array | None) -> Array:
    """Covariance of the weighted readings along the directions that count; without a covariance of theirs, up to a factor."""
    if noise is None or weights == "covariance":
        return np.eye(u.shape[1])
    back = whiten(u)  # the whitener is diagonal here
    return back.T @ noise @ back


def _quantiles(rank: int, dof: int | None) -> tuple[float, float]:
    """95 % points of the rise in one direction and in all: of chi-square, or of F where the noise was estimated."""
    from scipy.special import chdtri, fdtri

    if dof is None:
        return float(chdtri(1, 1 - CONFIDENCE)), float(chdtri(rank, 1 - CONFIDENCE))
    return float(fdtri(1, max(dof, 1), CONFIDENCE)), rank * float(fdtri(rank, max(dof, 1), CONFIDENCE))


def _hidden(v: Array) -> tuple[NDArray[np.bool_], Array]:
    """Coefficients that the unseen directions move, and the projector onto those directions."""
    rank, columns = v.shape
    hidden = np.eye(columns) - v.T @ v if rank < columns else np.zeros((columns, columns))
    return np.diag(hidden) > MOVED, hidden


def _profiled(normal: Array, slope: Array, x: Array, rise: Array, solve: Solver) -> tuple[Array, Array]:
    """Ends of the profiled intervals; all of 0 and up where the rise has no bound."""
    low, high = np.zeros(len(x)), np.full(len(x), math.inf)
    for j in np.flatnonzero(np.isfinite(rise)):
        if x[j] > 0:
            low[j] = _end(normal, slope, x, j, -1.0, float(rise[j]), solve)
        high[j] = _end(normal, slope, x, j, 1.0, float(rise[j]), solve)
    return low, high


def _end(normal: Array, slope: Array, x: Array, j: np.intp, way: float, rise: float, solve: Solver) -> float:
    """Follow the least sum of squares as x[j] moves away from the best fit, until it has risen by `rise` or x[j] is 0.

    It is a parabola between places where another coefficient reaches 0 or leaves it. `normal` is the normal matrix of columns of unit
    length and `slope` half the gradient at `x`.
    """
    x, slope, free = x.copy(), slope.copy(), x > 0
    free[j] = False
    size = math.sqrt(float(x @ normal @ x)) + math.sqrt(rise)
    for _ in range(20 * len(x) + 20):
        step = np.zeros(len(x))
        step[j] = way
        if free.any():
            step[free] = solve(normal[free][:, free], -way * normal[free, j])
        turn = normal @ step
        bend, climb = way * turn[j], max(0.0, way * slope[j])
        flat = bend < ROUNDING and climb <= ROUNDING * size
        reach = math.inf if flat else max(0.0, rise) / (climb + math.sqrt(climb**2 + max(bend, 0.0) * max(0.0, rise)) or math.inf)
        if way < 0:
            reach = min(reach, x[j])
        bound = np.full(len(x), math.inf)
        falling, freed = free & (step < -ROUNDING), ~free & (turn < -ROUNDING)
        freed[j] = False
        bound[falling] = x[falling] / -step[falling]
        bound[freed] = np.maximum(0.0, slope[freed]) / -turn[freed]
        i = int(np.argmin(bound))
        if reach <= bound[i]:
            return max(0.0, float(x[j] + way * reach))
        x = x + bound[i] * step
        slope = slope + bound[i] * turn
        rise -= bound[i] * (2 * climb + bound[i] * bend)
        free[i] = not free[i]
        x[i] = max(0.0, x[i]) if free[i] else 0.0
        slope[free] = 0.0
    raise FitError("the interval of a coefficient was not found: its profile has more pieces than it should")


def _solve(normal: Array, aim: Array) -> Array:
    return np.asarray(np.linalg.solve(normal, aim), np.float64)


def _shortest(normal: Array, aim: Array) -> Array:
    """Solve the normal equations; where they are singular, for the shortest solution."""
    values, vectors = np.linalg.eigh(normal)
    seen = values > ROUNDING * values[-1]
    vectors = vectors[:, seen]
    return vectors @ ((vectors.T @ aim) / values[seen])


def _groups(names: tuple[str, ...], present: NDArray[np.bool_], moved: NDArray[np.bool_], hidden: Array) -> tuple[tuple[str, ...], ...]:
    """Split coefficients that are not determined into those that move together."""
    here = np.flatnonzero(present)
    linked = np.abs(hidden) > MOVED
    left = [int(i) for i in np.flatnonzero(moved)]
    groups = []
    while left:
        group = {left[0]}
        while more := {k for k in left if k not in group and any(linked[i, k] for i in group)}:
            group |= more
        groups.append(tuple(names[here[i]] for i in sorted(group)))
        left = [i for i in left if i not in group]
    return (*groups, *((name,) for name, there in zip(names, present, strict=True) if not there))


def _correlation(present: NDArray[np.bool_], moved: NDArray[np.bool_], variance: Array, hidden: Array) -> Array:
    out = np.eye(len(present))
    here = np.flatnonzero(present)
    for chosen, matrix in ((~moved, variance), (moved, hidden)):
        part = matrix[np.ix_(chosen, chosen)]
        if part.size and np.all(np.isfinite(part)) and np.all(np.diag(part) > 0):
            deviation = np.sqrt(np.diag(part))
            out[np.ix_(here[chosen], here[chosen])] = np.clip(part / deviation[:, None] / deviation, -1, 1)
    return out


def _cosine_rmse(residual: Array, theta_r_deg: Array | None) -> float | None:
    if theta_r_deg is None:
        return None
    weight = np.abs(np.cos(np.radians(theta_r_deg)))
    return math.sqrt(float(weight @ residual**2 / weight.sum()))
