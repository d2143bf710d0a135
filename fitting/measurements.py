"""Readings of reflected light, and the tables they come from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import FitError, ReadingError

Quantity = Literal["intensity", "reflectance-factor", "brdf"]
Array = NDArray[np.float64]
QUANTITIES: tuple[Quantity, ...] = ("intensity", "reflectance-factor", "brdf")

UNITS: Mapping[str, str] = {"intensity": "relative", "reflectance-factor": "1", "brdf": "1/sr"}
"""Quantities a reading may have, with the unit a table is taken to be in unless another is named."""

INCIDENCE_STEP_DEG = 0.5
"""Incidences read back within this are one."""

PHI_TOLERANCE_DEG = 1e-6
"""An azimuth this near to 0 or 180 deg is in the plane of incidence: differences of azimuths are rounded."""

SIGMA_TOLERANCE = 1e-6
"""How far, relatively, a sigma may be from the root of its covariance's diagonal."""

NOISE = 5.0
"""A reading may lie this many standard uncertainties below 0 before it is an error and not noise."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Readings of reflected light.

    In the plane of incidence the side is said by theta_r's sign and phi is 0; out of it theta_r is 0 or more and phi is not 0.

    Parameters
    ----------
    theta_i_deg, theta_r_deg : ndarray, shape (n,), deg
        Light, 0 <= theta_i < 90, and view, -180 to 180, positive on the light's side.
    value : ndarray, shape (n,)
        Readings.
    sigma : ndarray, shape (n,), optional
        Standard uncertainty of `value`, in its unit; by default the root of the covariance's diagonal.
    quantity : {"intensity", "reflectance-factor", "brdf"}
        What `value` is: radiance under a constant beam (any unit), pi f_r, or f_r.
    unit : str
        Label of the unit; by default that of the quantity.
    source : str
        Where the readings come from, for messages.
    rows : ndarray of int, shape (n,), optional
        Line of each reading in its source; by default 1, 2, ...
    phi_deg : ndarray, shape (n,), optional, deg
        phi_r - phi_i, -180 to 180, 0 on the light's side; by default 0. Readings at +-180 become readings in the plane with theta_r
        turned negative, and those along the normal, where azimuth means nothing, get 0.
    covariance : ndarray, shape (n, n), optional
        Of `value`, in its unit squared. Whether it is positive definite is for the fit to say.

    Raises
    ------
    ReadingError
        If a number is not finite, an angle is out of range, theta_r is below 0 out of the plane, a sigma is negative or not that of the
        covariance, or the covariance is not symmetric.
    FitError
        If shapes do not match or the quantity is unknown.
    """

    theta_i_deg: Array
    theta_r_deg: Array
    value: Array
    sigma: Array | None = None
    quantity: Quantity = "intensity"
    unit: str = ""
    source: str = "readings"
    rows: NDArray[np.int64] = None  # type: ignore[assignment]  # an array once made
    phi_deg: Array = field(default=None, kw_only=True)  # type: ignore[arg-type]  # an array once made
    covariance: Array | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.quantity not in UNITS:
            raise FitError(f"{self.source}: unknown quantity {self.quantity!r}; known are {', '.join(UNITS)}")
        rows = _column(np.arange(1, np.size(self.value) + 1) if self.rows is None else self.rows, "rows", self.source, np.int64)
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "unit", self.unit or UNITS[self.quantity])
        if self.phi_deg is None:
            object.__setattr__(self, "phi_deg", np.zeros(rows.size))
        for name in ("theta_i_deg", "theta_r_deg", "phi_deg", "value", "sigma"):
            given = getattr(self, name)
            if given is None:
                continue
            column = _column(given, name, self.source, np.float64)
            object.__setattr__(self, name, column)
            if column.size != rows.size:
                raise FitError(f"{self.source}: {name} has {column.size} entries, expected {rows.size}, one for each row")
            self._require(np.isfinite(column), name, column, "a finite number")
        self._require((self.theta_i_deg >= 0) & (self.theta_i_deg < 90), "theta_i", self.theta_i_deg, "0 <= theta_i < 90 deg")
        self._require(np.abs(self.theta_r_deg) <= 180, "theta_r", self.theta_r_deg, "-180 <= theta_r <= 180 deg")
        self._lay_into_plane()
        if self.sigma is not None:
            self._require(self.sigma >= 0, "sigma", self.sigma, "0 or more")
        if self.covariance is not None:
            self._take_sigma_from(self.covariance)

    def _lay_into_plane(self) -> None:
        """Give each direction one name: a signed theta_r in the plane of incidence, a theta_r from 0 up out of it."""
        theta_r, phi = self.theta_r_deg, self.phi_deg
        self._require(np.abs(phi) <= 180, "phi", phi, "-180 <= phi <= 180 deg")
        light = (np.abs(phi) <= PHI_TOLERANCE_DEG) | (theta_r == 0) | (np.abs(theta_r) == 180)
        self._require(light | (theta_r > 0), "theta_r", theta_r, "0 or more where phi is not 0: the side is said by one of the two")
        forward = ~light & (180 - np.abs(phi) <= PHI_TOLERANCE_DEG)
        object.__setattr__(self, "theta_r_deg", _frozen(np.where(forward, -theta_r, theta_r)))
        object.__setattr__(self, "phi_deg", _frozen(np.where(light | forward, 0.0, phi)))

    def _take_sigma_from(self, given: object) -> None:
        covariance = _column(given, "covariance", self.source, np.float64, ndim=2)
        if covariance.shape != (len(self), len(self)):
            raise FitError(f"{self.source}: the covariance has shape {covariance.shape}, expected {(len(self), len(self))}")
        variance = covariance.diagonal()
        self._require(np.isfinite(variance) & (variance >= 0), "variance", variance, "a finite number, 0 or more")
        sigma = np.sqrt(variance)
        with np.errstate(over="ignore", invalid="ignore"):
            good = np.abs(covariance - covariance.T) <= 1e-9 * sigma[:, None] * sigma  # False for NaN
        if not good.all():
            first, second = (int(k) for k in np.argwhere(~good)[0])
            raise self.error(first, f"its covariance with row {self.rows[second]} is not finite or not symmetric")
        if self.sigma is not None:
            agreed = np.abs(self.sigma - sigma) <= SIGMA_TOLERANCE * sigma
            self._require(agreed, "sigma", self.sigma, "the root of its variance in the covariance")
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "sigma", _frozen(sigma))

    def __len__(self) -> int:
        return self.value.size

    def _require(self, good: NDArray[np.bool_], name: str, column: Array, expected: str) -> None:
        if not good.all():
            bad = int(np.flatnonzero(~good)[0])
            raise self.error(bad, f"{name} is {column[bad]:g}, expected {expected}")

    def error(self, index: int, problem: str) -> ReadingError:
        """Return an error that names reading `index` (from 0) by its source and row."""
        return ReadingError(self.source, int(self.rows[index]), problem)

    def take(self, kept: ArrayLike) -> Measurements:
        """Return some of the readings, with their rows and their part of the covariance.

        Parameters
        ----------
        kept : array_like of bool, shape (n,), or of int
            A mask, or which readings, from 0, in the order wanted.

        Returns
        -------
        Measurements

        Raises
        ------
        FitError
            If a mask is not as long as the readings, or there is no reading of an index.
        """
        try:
            chosen = np.atleast_1d(np.arange(len(self))[np.asarray(kept)])
        except IndexError as error:
            raise FitError(f"{self.source}: of {len(self)} readings those cannot be taken: {error}") from error
        return replace(
            self,
            theta_i_deg=self.theta_i_deg[chosen],
            theta_r_deg=self.theta_r_deg[chosen],
            value=self.value[chosen],
            sigma=None if self.sigma is None else self.sigma[chosen],
            rows=self.rows[chosen],
            phi_deg=self.phi_deg[chosen],
            covariance=None if self.covariance is None else self.covariance[np.ix_(chosen, chosen)],
        )

    @property
    def in_plane(self) -> NDArray[np.bool_]:
        """Which readings are in the plane of incidence, shape (n,)."""
        return self.phi_deg == 0

    @property
    def incidences(self) -> Array:
        """Distinct theta_i, ndarray of shape (k,), deg, rising.

        Readbacks no more than `INCIDENCE_STEP_DEG` above the lowest of a group count as one: their mean, to a thousandth.
        """
        return np.round(np.bincount(self.incidence_of, self.theta_i_deg) / np.bincount(self.incidence_of), 3)

    @property
    def incidence_of(self) -> NDArray[np.int64]:
        """Which of `incidences` each reading belongs to, shape (n,)."""
        distinct, which = np.unique(self.theta_i_deg, return_inverse=True)
        group = np.zeros(distinct.size, dtype=np.int64)
        first = 0
        while first < distinct.size:
            group[first:] += first > 0
            first = int(np.searchsorted(distinct, distinct[first] + INCIDENCE_STEP_DEG, side="right"))
        return group[which]

    @property
    def _per_intensity(self) -> Array:
        if self.quantity == "intensity":
            return np.ones(len(self))
        return np.cos(np.radians(self.theta_i_deg)) * (math.pi if self.quantity == "brdf" else 1.0)

    @property
    def intensity(self) -> Array:
        """The readings as the paper's model sees them: radiance under a beam of constant strength, ndarray of shape (n,).

        A surface of BRDF f_r under a beam of irradiance E across itself has radiance f_r E cos(theta_i). With E = pi, a reflectance factor
        counts rho cos(theta_i) and a BRDF pi f_r cos(theta_i): several incidences then share one scale, on which r'_s_diff = cos(theta_i)
        with x_s_diff = 1 is the perfect diffuser. Readings given as intensity are taken as they are.
        """
        return self.value * self._per_intensity

    @property
    def intensity_sigma(self) -> Array | None:
        """Standard uncertainty of `intensity`, or None."""
        return None if self.sigma is None else self.sigma * self._per_intensity

    @property
    def intensity_covariance(self) -> Array | None:
        """Covariance of `intensity`, ndarray of shape (n, n): from `covariance`, else from `sigma` as a diagonal, else None."""
        if self.covariance is not None:
            return self.covariance * self._per_intensity[:, None] * self._per_intensity
        return None if self.intensity_sigma is None else np.diag(self.intensity_sigma**2)


def wrapped(phi_deg: Array) -> Array:
    """Bring azimuths to -180 to 180 deg; those that are there already stay as they are, to the last digit."""
    return np.where(np.abs(phi_deg) <= 180, phi_deg, np.remainder(phi_deg + 180, 360) - 180)


def _column(values: object, name: str, source: str, dtype: type[np.generic], ndim: int = 1) -> NDArray[Any]:
    """Copy to a read-only array, so that a frozen table stays what it was when it was checked."""
    try:
        column = np.array(values, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise FitError(f"{source}: {name} must be numbers: {error}") from error
    if column.ndim != ndim:
        raise FitError(f"{source}: {name} must be one {'column' if ndim == 1 else 'matrix'} of numbers, not of shape {column.shape}")
    return _frozen(column)


def _frozen(column: NDArray[Any]) -> NDArray[Any]:
    column.flags.writeable = False
    return column
