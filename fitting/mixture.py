"""How much of each of the model's four terms a petal shows: the mixture x of eq. (8), found by least squares."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import FitError
from fitting.measurements import MIN_READINGS, Measurements
from fitting.paper import TERMS, paper_terms

Weights = Literal["relative", "plain", "sigma"]
Array = NDArray[np.float64]

RANK_TOLERANCE = 1e-3
"""Singular values below this fraction of the largest count as zero: the terms themselves are no better known."""

NEGLIGIBLE = 1e-6
"""A term that stays below this at every reading is taken as absent: a coefficient found from it would be noise, blown up."""


@dataclass(frozen=True, eq=False)
class MixtureFit:
    """Outcome of a mixture fit.

    Attributes
    ----------
    x : dict of str to float
        Coefficients of `TERMS`, 0 or more, in the unit of the intensities.
    model : str
        "paper".
    aspect, n_us, n_ss : float
        Cell shape and lobe exponents that were assumed.
    weights : str
        "relative", "plain" or "sigma".
    quantity, unit, source : str
        Of the readings.
    theta_i_deg, theta_r_deg : ndarray, shape (n,), deg
        Directions of the readings.
    measured, modelled : ndarray, shape (n,)
        Intensities, as `Measurements.intensity` converts them.
    E : ndarray, shape (n,), percent
        Eq. (13), abs(measured - modelled) / measured; NaN for readings of 0 or less, where it means nothing (plain and sigma weights only).
    rows : ndarray of int, shape (n,)
        Lines of the readings in their source.
    zero : tuple of str
        Coefficients that came out 0: held there by x >= 0, or not determined.
    rank : int
        Independent columns of the weighted design, each scaled to length 1; below 4 the mixture is not determined.
    condition : float
        Ratio of largest to smallest singular value of the same; infinite if a term is 0 at every reading.
    undetermined : tuple of str
        Coefficients that trade against one another, or act nowhere, when the rank is below 4.
    """

    x: dict[str, float]
    model: str
    aspect: float
    n_us: float
    n_ss: float
    weights: str
    quantity: str
    unit: str
    source: str
    theta_i_deg: Array
    theta_r_deg: Array
    measured: Array
    modelled: Array
    E: Array
    rows: NDArray[np.int64]
    zero: tuple[str, ...]
    rank: int
    condition: float
    undetermined: tuple[str, ...]

    def __len__(self) -> int:
        return self.measured.size

    @property
    def E_mean(self) -> float:
        """Mean of E over the readings above 0, percent."""
        return float(np.mean(self.E[self.measured > 0]))

    @property
    def E_max(self) -> float:
        """Largest E among the readings above 0, percent."""
        return float(np.max(self.E[self.measured > 0]))

    @property
    def determined(self) -> bool:
        """Whether the readings fix all four coefficients."""
        return self.rank == len(TERMS)

    @property
    def statement(self) -> str:
        """Whether the coefficients are determined, in one line."""
        if self.determined:
            return f"all four coefficients are determined by {len(self)} readings (condition {self.condition:.3g})"
        return (
            f"NOT determined: {len(self)} readings fix only {self.rank} combinations of the four coefficients; "
            f"{', '.join(self.undetermined)} can change without changing the fit: add readings at other angles"
        )

    def predict(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike) -> Array:
        """Evaluate the fitted intensity, eq. (8) with I_i = 1.

        Parameters
        ----------
        theta_i_deg, theta_r_deg : array_like, deg
            Broadcast against each other.

        Returns
        -------
        ndarray, of the broadcast shape
            Intensity on the scale of `Measurements.intensity`; divide by cos(theta_i), and pi, for reflectance factor and BRDF.

        Raises
        ------
        DomainError
            If a direction is outside the model.
        """
        terms = paper_terms(theta_i_deg, theta_r_deg, aspect=self.aspect, n_us=self.n_us, n_ss=self.n_ss)
        intensity = terms @ np.array([self.x[name] for name in TERMS])
        return intensity.reshape(np.broadcast_shapes(np.shape(theta_i_deg), np.shape(theta_r_deg)))

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, text and lists that JSON can hold; NaN and infinity become None."""
        out: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = [_finite_or_none(v) for v in value.tolist()]
            elif isinstance(value, tuple):
                value = list(value)
            out[field.name] = dict(value) if isinstance(value, dict) else value
        out["condition"] = _finite_or_none(self.condition)
        # For readers of the file; from_dict derives them again.
        out |= {"n": len(self), "E_mean": self.E_mean, "E_max": self.E_max, "determined": self.determined, "statement": self.statement}
        return out

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> MixtureFit:
        """Rebuild a fit from `to_dict`.

        Raises
        ------
        FitError
            If an entry is missing or of the wrong kind.
        """
        try:
            values = {field.name: stored[field.name] for field in fields(cls)}
            for name in ("theta_i_deg", "theta_r_deg", "measured", "modelled", "E"):
                values[name] = np.array(values[name], dtype=float)
            values["rows"] = np.array(values["rows"], dtype=np.int64)
            values["x"] = {name: float(values["x"][name]) for name in TERMS}
            values["condition"] = math.inf if values["condition"] is None else float(values["condition"])
            values |= {name: tuple(values[name]) for name in ("zero", "undetermined")}
        except KeyError as error:
            raise FitError(f"a stored mixture fit lacks {error}; it was perhaps written by something else") from error
        except (TypeError, ValueError) as error:
            raise FitError(f"a stored mixture fit cannot be read: {error}") from error
        if values["model"] != "paper":
            raise FitError(f"a stored fit of model {values['model']!r} is not a mixture of the paper's terms")
        return cls(**values)


def fit_mixture(
    measurements: Measurements,
    *,
    aspect: float,
    n_us: float = 40.0,
    n_ss: float = 5.0,
    weights: Weights = "relative",
) -> MixtureFit:
    """Fit the four coefficients of eq. (8), none negative, to readings at one or more incidences.

    Parameters
    ----------
    measurements : Measurements
        Four readings or more; repeats at the same angles are welcome.
    aspect : float
        Height over base diameter of the cells.
    n_us, n_ss : float
        Exponents of the specular lobes.
    weights : {"relative", "plain", "sigma"}
        Minimise the sum of ((I - I_exp) / I_exp)^2, of (I - I_exp)^2, or of ((I - I_exp) / sigma)^2.

    Returns
    -------
    MixtureFit

    Raises
    ------
    ReadingError
        If a reading or sigma is not above 0 where the weights need it to be, or is behind the petal.
    DomainError
        If the cell shape or an exponent is outside the model.
    FitError
        If there are too few readings, none above 0, or no sigma to weigh by.
    """
    if len(measurements) < MIN_READINGS:
        raise FitError(f"{measurements.source}: {len(measurements)} readings, expected at least {MIN_READINGS} for four coefficients")
    if np.any(behind := np.abs(measurements.theta_r_deg) > 90):
        first = int(np.flatnonzero(behind)[0])
        theta_r = measurements.theta_r_deg[first]
        raise measurements.error(first, f"theta_r = {theta_r:g} deg is behind the petal, and the model is of reflection only: leave it out")
    measured = measurements.intensity
    weight = _weights(measurements, weights)
    terms = paper_terms(measurements.theta_i_deg, measurements.theta_r_deg, aspect=aspect, n_us=n_us, n_ss=n_ss)
    terms[:, terms.max(axis=0) < NEGLIGIBLE] = 0
    design = terms * weight[:, None]
    length = np.linalg.norm(design, axis=0)
    design /= np.where(length > 0, length, 1.0)
    x = _non_negative(design, measured * weight, measurements.source) / np.where(length > 0, length, 1.0)
    modelled = terms @ x
    error = np.full(len(measured), np.nan)
    np.divide(100 * np.abs(measured - modelled), measured, out=error, where=measured > 0)
    rank, condition, undetermined = _determination(design)
    assert measurements.rows is not None
    return MixtureFit(
        x=dict(zip(TERMS, x.tolist(), strict=True)),
        model="paper",
        aspect=float(aspect),
        n_us=float(n_us),
        n_ss=float(n_ss),
        weights=weights,
        quantity=measurements.quantity,
        unit=measurements.unit,
        source=measurements.source,
        theta_i_deg=measurements.theta_i_deg,
        theta_r_deg=measurements.theta_r_deg,
        measured=measured,
        modelled=modelled,
        E=error,
        rows=measurements.rows,
        zero=tuple(name for name, value in zip(TERMS, x, strict=True) if value == 0),
        rank=rank,
        condition=condition,
        undetermined=undetermined,
    )


def _weights(measurements: Measurements, weights: str) -> Array:
    """Return the factor of each residual."""
    measured = measurements.intensity
    if not np.any(measured > 0):
        raise FitError(f"{measurements.source}: no reading is above 0, so there is no light to explain")
    if weights == "plain":
        return np.ones(len(measured))
    if weights == "relative":
        size, what = measured, "reading"
    elif weights == "sigma":
        if measurements.intensity_sigma is None:
            raise FitError(f"{measurements.source}: there is no sigma with the readings to weigh by: name its column or use other weights")
        size, what = measurements.intensity_sigma, "sigma"
    else:
        raise FitError(f"unknown weights {weights!r}; known are relative, plain and sigma")
    if np.any(size <= 0):
        first = int(np.flatnonzero(size <= 0)[0])
        raise measurements.error(first, f"{what} is {size[first]:g}, but {weights} weights need it above 0: leave it out or use plain")
    return 1 / size


def _non_negative(design: Array, target: Array, source: str) -> Array:
    from scipy.optimize import nnls

    try:
        x, _ = nnls(design, target)
    except RuntimeError as error:
        raise FitError(f"{source}: non-negative least squares did not converge: {error}") from error
    return x


def _determination(design: Array) -> tuple[int, float, tuple[str, ...]]:
    """Rank and condition of a design of unit columns, and the coefficients its null space moves."""
    _, singular, directions = np.linalg.svd(design, full_matrices=False)
    small = singular < RANK_TOLERANCE * singular[0]
    condition = math.inf if singular[-1] == 0 else float(singular[0] / singular[-1])
    moved = np.any(np.abs(directions[small]) > 0.1, axis=0)
    return int(np.sum(~small)), condition, tuple(name for name, m in zip(TERMS, moved, strict=True) if m)


def _finite_or_none(number: float) -> float | None:
    return number if math.isfinite(number) else None
