"""A model fitted to readings: coefficients by least squares, the shape found or held, and how far both can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.aperture import Aperture
from fitting.errors import FitError
from fitting.ladder import Directions, Rung, Traces, rung_of, unit_reflectances
from fitting.linear import LinearFit, Weights, fit_linear
from fitting.measurements import Measurements
from fitting.minimise import Minimum
from fitting.search import Effort, Range, Search, Shape, seen, shape_errors

if TYPE_CHECKING:
    from fitting.reflectance import Reflectance

Array = NDArray[np.float64]

TABLE_NODES = np.append(np.arange(0.0, 88.0, 3.0), 88.0), np.arange(0.0, 181.0, 5.0)
"""Where `Fit.tabulated` asks the model: theta and phi, deg."""

PREDICT_FROM = 45.0
"""The paper's incidence, from which others are predicted, deg."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Readings that were left out of a fit, against it.

    Attributes
    ----------
    what : str
        Which readings, and what was fitted.
    theta_i_deg, theta_r_deg, phi_deg : ndarray, shape (n,), deg
    measured, modelled : ndarray, shape (n,)
        Intensities, as `Measurements.intensity` converts them.
    """

    what: str
    theta_i_deg: Array
    theta_r_deg: Array
    phi_deg: Array
    measured: Array
    modelled: Array

    @property
    def E(self) -> Array:
        """Eq. (13), percent; NaN for readings of 0 or less, where it means nothing."""
        return relative_error(self.measured, self.modelled)

    @property
    def E_mean(self) -> float | None:
        """Mean of E over readings above 0, percent; None if there are none."""
        above = self.measured > 0
        return float(np.mean(self.E[above])) if above.any() else None

    @property
    def E_max(self) -> float | None:
        """Largest E, percent; None if no reading is above 0."""
        above = self.measured > 0
        return float(np.max(self.E[above])) if above.any() else None


@dataclass(frozen=True, eq=False)
class Fit:
    """Outcome of a fit.

    Attributes
    ----------
    model : str
        Name of the rung, see `fitting.ladder`.
    shape : dict of str to float
        All of its shape numbers, held or found.
    searched : tuple of str
        Those found.
    shape_sigma : dict of str to float or None
        Standard error of each number found; None where the readings leave it open or it is at a bound.
    at_bounds : dict of str to str
        Numbers found that ended at their "lower" or "upper" bound.
    linear : LinearFit
        Coefficients, errors and what can be concluded.
    measurements : Measurements
        What was fitted.
    aperture : Aperture
        How lamp and detector were taken to be.
    converged : bool
        Whether the shape is a minimum.
    search : str or None
        Account of the search; None where nothing was searched for.
    shared_with : tuple of str
        Other sets of readings that the shape was found from.
    predicted : tuple of Prediction
        Readings at other geometries, by fits without them.
    """

    model: str
    shape: dict[str, float]
    searched: tuple[str, ...]
    shape_sigma: dict[str, float | None]
    at_bounds: dict[str, str]
    linear: LinearFit
    measurements: Measurements
    aperture: Aperture = field(default_factory=Aperture)
    converged: bool = True
    search: str | None = None
    shared_with: tuple[str, ...] = ()
    predicted: tuple[Prediction, ...] = ()
    traces: Traces = field(default_factory=Traces, repr=False)

    def __len__(self) -> int:
        return len(self.measurements)

    @property
    def rung(self) -> Rung:
        """The model."""
        return rung_of(self.model)

    @property
    def x(self) -> dict[str, float]:
        """Coefficients by name."""
        return {c.name: c.value for c in self.linear.coefficients}

    @property
    def measured(self) -> Array:
        """Intensities, as `Measurements.intensity` converts them, shape (n,)."""
        return self.linear.measured

    @property
    def modelled(self) -> Array:
        """The same by the model, shape (n,)."""
        return self.linear.modelled

    @property
    def E(self) -> Array:
        """Eq. (13), percent, shape (n,); NaN for readings of 0 or less, where it means nothing."""
        return relative_error(self.measured, self.modelled)

    @property
    def E_mean(self) -> float:
        """Mean of E over the readings above 0, percent."""
        return float(np.mean(self.E[self.measured > 0]))

    @property
    def E_max(self) -> float:
        """Largest E among the readings above 0, percent."""
        return float(np.max(self.E[self.measured > 0]))

    @property
    def parameters(self) -> int:
        """Numbers taken from the readings: coefficients and shape."""
        return len(self.linear.coefficients) + len(self.searched)

    @property
    def aicc(self) -> float | None:
        """Akaike's criterion for small samples, up to a constant of the readings and weights; None with too few readings."""
        known = self.linear.weights in ("sigma", "covariance")
        return aicc(self.linear.sum_of_squares, len(self), self.parameters, known_noise=known)

    @property
    def determined(self) -> bool:
        """Whether the readings fix all coefficients."""
        return not self.linear.undetermined

    @property
    def statement(self) -> str:
        """What was found and how far to trust it, line by line."""
        lines = [self.linear.statement]
        for name in self.searched:
            sigma = self.shape_sigma[name]
            lines.append(f"{name} = {self.shape[name]:.4g}" + (f" +- {sigma:.2g}" if sigma is not None else " (no standard error)"))
        lines += [f"{name} ended at its {side} bound: the best may lie beyond" for name, side in self.at_bounds.items()]
        if self.search is not None:
            lines.append(f"search: {self.search}")
        return "\n".join(lines)

    def predict(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike = 0.0) -> Array:
        """Evaluate the fitted intensity as an ideal detector would read it, eq. (8) with I_i = 1.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            Broadcast against one another; below 90 deg.

        Returns
        -------
        ndarray, of the broadcast shape
            On the scale of `Measurements.intensity`; divide by cos(theta_i), and pi, for reflectance factor and BRDF.

        Raises
        ------
        DomainError
            If a direction is outside the model.
        """
        at = Directions.of(theta_i_deg, theta_r_deg, phi_deg)
        shape = np.broadcast_shapes(np.shape(theta_i_deg), np.shape(theta_r_deg), np.shape(phi_deg))
        return np.asarray(self.rung.design(at, self.shape, self.traces) @ self.linear.x).reshape(shape)

    def read(self, measurements: Measurements) -> Array:
        """Evaluate what the readings' own aperture would have read at the geometries of others, shape (n,); errors as `predict`."""
        at, mean = seen(self.aperture, measurements.theta_i_deg, measurements.theta_r_deg, measurements.phi_deg)
        return np.asarray(mean(self.rung.design(at, self.shape, self.traces)) @ self.linear.x)

    def brdf(self, white: float | None = None) -> Callable[[ArrayLike, ArrayLike, ArrayLike], Array]:
        """Return the fitted reflectance as a function of theta_i, theta_r and phi in deg, in 1/sr.

        Parameters
        ----------
        white : float, optional
            Reading of the perfect diffuser lit along its normal, in the unit of the readings; needed for relative ones only.

        Raises
        ------
        FitError
            If relative readings have no white, or the white is not above 0.
        """
        scale = self._scale(white)
        return lambda theta_i, theta_r, phi: self.predict(theta_i, theta_r, phi) / (math.pi * scale * np.cos(np.radians(theta_i)))

    def tabulated(self) -> Reflectance:
        """Tabulate the fitted intensity over all directions, for a renderer; up to 88 deg, beyond that as there.

        Raises
        ------
        DomainError
            If the shape is outside the model.
        """
        from fitting.reflectance import INTENSITY
        from fitting.table import ReflectanceTable

        theta, phi = TABLE_NODES
        values = self.predict(theta[:, None, None], theta[:, None], phi)
        made_from = {"model": self.model, "shape": self.shape, "x": self.x, "source": self.source}
        table = ReflectanceTable.from_basis(("fitted",), [values], nodes=(theta, theta, phi), mode=INTENSITY, provenance=made_from)
        return table.mixed({"fitted": 1.0})

    def reflectances(self, white: float | None = None) -> dict[str, tuple[float, float, float]]:
        """Normalise the coefficients: the reflectance of each term at normal incidence, and its 95 % interval.

        Parameters
        ----------
        white : float, optional
            As in `brdf`.

        Raises
        ------
        FitError
            As `brdf` does.
        """
        return self.linear.reflectances(unit_reflectances(self.rung, self.shape, self.traces), self._scale(white))

    def _scale(self, white: float | None) -> float:
        if white is None and self.quantity == "intensity":
            raise FitError(
                f"{self.source}: readings in {self.unit} have no scale in 1/sr: give the white, what a perfect diffuser lit "
                "along its normal reads"
            )
        scale = 1.0 if white is None else white
        if not (math.isfinite(scale) and scale > 0):
            raise FitError(f"the white reading must be a finite number above 0, not {white!r}")
        return scale

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, text and lists that JSON can hold; what is infinite or means nothing becomes None."""
        m = self.measurements
        assert m.rows is not None  # set when it was made
        return {
            "model": self.model,
            "x": self.x,
            **{name: self.shape[name] for name in ("aspect", "n_us", "n_ss") if name in self.shape},
            "shape": self.shape,
            "searched": list(self.searched),
            "shape_sigma": self.shape_sigma,
            "at_bounds": self.at_bounds,
            "weights": self.weights,
            "quantity": m.quantity,
            "unit": m.unit,
            "source": m.source,
            "rows": m.rows.tolist(),
            "theta_i_deg": m.theta_i_deg.tolist(),
            "theta_r_deg": m.theta_r_deg.tolist(),
            "phi_deg": m.phi_deg.tolist(),
            "value": m.value.tolist(),
            "sigma": None if m.sigma is None else m.sigma.tolist(),
            "covariance": None if m.covariance is None else m.covariance.tolist(),
            "measured": self.measured.tolist(),
            "modelled": self.modelled.tolist(),
            "E": [None if math.isnan(e) else e for e in self.E.tolist()],
            "E_mean": self.E_mean,
            "E_max": self.E_max,
            "n": len(self),
            "determined": self.determined,
            "converged": self.converged,
            "search": self.search,
            "shared_with": list(self.shared_with),
            "aicc": self.aicc,
            "statement": self.statement,
            "aperture": asdict(self.aperture),
            "linear": self.linear.to_dict(),
            "predicted": [
                {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(p).items()}
                | {"E_mean": p.E_mean, "E_max": p.E_max}
                for p in self.predicted
            ],
        }

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Fit:
        """Rebuild a fit from `to_dict`.

        Raises
        ------
        FitError
            If an entry is missing or of the wrong kind.
        """
        try:
            rung_of(stored["model"])
            m = Measurements(
                theta_i_deg=np.array(stored["theta_i_deg"], float),
                theta_r_deg=np.array(stored["theta_r_deg"], float),
                value=np.array(stored["value"], float),
                sigma=None if stored["sigma"] is None else np.array(stored["sigma"], float),
                quantity=stored["quantity"],
                unit=stored["unit"],
                source=stored["source"],
                rows=np.array(stored["rows"], np.int64),
                phi_deg=np.array(stored["phi_deg"], float),
                covariance=None if stored["covariance"] is None else np.array(stored["covariance"], float),
            )
            columns = ("theta_i_deg", "theta_r_deg", "phi_deg", "measured", "modelled")
            return cls(
                model=stored["model"],
                shape={name: float(value) for name, value in stored["shape"].items()},
                searched=tuple(stored["searched"]),
                shape_sigma=dict(stored["shape_sigma"]),
                at_bounds=dict(stored["at_bounds"]),
                linear=LinearFit.from_dict(stored["linear"]),
                measurements=m,
                aperture=Aperture.from_dict(stored["aperture"]),
                converged=bool(stored["converged"]),
                search=stored["search"],
                shared_with=tuple(stored["shared_with"]),
                predicted=tuple(Prediction(p["what"], *(np.array(p[name], float) for name in columns)) for p in stored["predicted"]),
            )
        except KeyError as error:
            raise FitError(f"a stored fit lacks {error}; it was perhaps written by something else, or by an earlier version") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise FitError(f"a stored fit cannot be read: {error}") from error

    @property
    def weights(self) -> Weights:
        """See `fit_linear`."""
        return self.linear.weights

    @property
    def quantity(self) -> str:
        """Of the readings."""
        return self.measurements.quantity

    @property
    def unit(self) -> str:
        """Of the readings."""
        return self.measurements.unit

    @property
    def source(self) -> str:
        """Of the readings."""
        return self.measurements.source

    @property
    def theta_i_deg(self) -> Array:
        """Of the readings, deg."""
        return self.measurements.theta_i_deg

    @property
    def theta_r_deg(self) -> Array:
        """Of the readings, deg."""
        return self.measurements.theta_r_deg


def fit(
    measurements: Measurements,
    model: str = "paper",
    *,
    shape: Mapping[str, Range] | None = None,
    weights: Weights = "relative",
    aperture: Aperture | None = None,
    effort: Effort | None = None,
    traces: Traces | None = None,
) -> Fit:
    """Fit a model of the ladder to readings at one or more incidences.

    Parameters
    ----------
    measurements : Measurements
        Of reflection; repeats at the same angles are welcome.
    model : str
        A rung of `fitting.ladder.RUNGS`.
    shape : mapping of str to float or (float, float), optional
        Shape numbers to hold at a value, or to search for within bounds (`fitting.search.usual_bounds`); others have their usual values.
    weights : {"relative", "plain", "sigma", "covariance"}
        As in `fit_linear`.
    aperture : Aperture, optional
        Extent of lamp, spot and detector.
    effort : Effort, optional
        Of the search for a shape.
    traces : Traces, optional
        To share between fits what is slow to trace.

    Returns
    -------
    Fit

    Raises
    ------
    ReadingError
        If a reading does not suit the weights, or is behind the petal.
    DomainError
        If there is no such model or shape number, or a number or direction is outside of it.
    FitError
        If there are no readings, none above 0, no covariance to weigh by, or fewer readings than unknowns while a shape is searched for.
    """
    return fit_joint([measurements], model, shape=shape, weights=weights, aperture=aperture, effort=effort, traces=traces)[0]


def fit_joint(
    sets: Sequence[Measurements],
    model: str = "paper",
    *,
    shape: Mapping[str, Range] | None = None,
    weights: Weights = "relative",
    aperture: Aperture | None = None,
    effort: Effort | None = None,
    traces: Traces | None = None,
) -> tuple[Fit, ...]:
    """Fit sets of readings, such as cultivars, that share one shape and have coefficients of their own.

    Parameters and errors are those of `fit`; a fit for each set is returned.
    """
    rung = rung_of(model)
    search = Search.of(rung, Shape.of(rung, shape or {}), sets, weights, aperture, traces)
    return fitted(search, *search.minimise(effort or Effort()))


def fitted(search: Search, found: dict[str, float], minimum: Minimum | None) -> tuple[Fit, ...]:
    """Return the fits of a search's sets at the shape it found."""
    rung, names = search.rung, tuple(found)
    whole = {number.name: {**search.shape.held, **found}[number.name] for number in rung.shape}
    sigma: dict[str, float | None] = dict.fromkeys(names)
    at_bounds: dict[str, str] = {}
    if minimum is not None:
        spare = sum(len(m) for m in search.sets) - len(rung.terms) * len(search.sets) - len(names)
        known = search.weights in ("sigma", "covariance")
        sigma = dict(zip(names, shape_errors(minimum, spare, known), strict=True))
        at_bounds = {names[i]: side for i, side in minimum.at_bounds}
    tangents = search.tangents(found, [name for name in names if name not in at_bounds])
    fits = []
    for m, columns in zip(search.sets, tangents, strict=True):
        at, mean = seen(search.aperture, m.theta_i_deg, m.theta_r_deg, m.phi_deg)
        linear = fit_linear(
            mean(rung.design(at, whole, search.traces)),
            m.intensity,
            covariance=m.intensity_covariance if m.sigma is not None and np.all(m.sigma > 0) else None,
            weights=search.weights,
            names=rung.terms,
            tangents=columns if columns.shape[1] else None,
            theta_r_deg=m.theta_r_deg,
            source=m.source,
            rows=m.rows,
        )
        fits.append(
            Fit(
                model=rung.name,
                shape=whole,
                searched=names,
                shape_sigma=sigma,
                at_bounds=at_bounds,
                linear=linear,
                measurements=m,
                aperture=search.aperture,
                converged=minimum is None or minimum.converged,
                search=None if minimum is None else _named(minimum.statement, names),
                shared_with=tuple(other.source for other in search.sets if other is not m),
                traces=search.traces,
            )
        )
    return tuple(fits)


def predictions(measurements: Measurements, model: str = "paper", **settings: Any) -> tuple[Prediction, ...]:
    """Fit the readings in the plane at 45 deg and predict all others, if both exist.

    Parameters
    ----------
    measurements : Measurements
    model, **settings
        As `fit` takes them.

    Returns
    -------
    tuple of Prediction
        For each other incidence, and each incidence out of the plane; none if there is nothing to fit or to predict.
    """
    nearest = np.abs(measurements.theta_i_deg - PREDICT_FROM) <= 1
    known = nearest & measurements.in_plane
    if not known.any() or known.all():
        return ()
    found = fit(measurements.take(known), model, **settings)
    parts = []
    for k, incidence in enumerate(measurements.incidences.tolist()):
        of = measurements.incidence_of == k
        for chosen, where in ((of & measurements.in_plane & ~known, ""), (of & ~measurements.in_plane, " out of the plane")):
            if chosen.any():
                parts.append(predicted(found, measurements.take(chosen), f"{round(incidence, 1):g} deg{where}, from {PREDICT_FROM:g} deg"))
    return tuple(parts)


def predicted(fit: Fit, measurements: Measurements, what: str) -> Prediction:
    """Compare a fit with readings that were not in it."""
    m = measurements
    return Prediction(what, m.theta_i_deg, m.theta_r_deg, m.phi_deg, m.intensity, fit.read(m))


def relative_error(measured: Array, modelled: Array) -> Array:
    """Eq. (13), percent; NaN where `measured` is 0 or less and it means nothing."""
    out = np.full(measured.shape, math.nan)
    np.divide(100 * np.abs(measured - modelled), measured, out=out, where=measured > 0)
    return out


def aicc(sum_of_squares: float, readings: int, parameters: int, *, known_noise: bool) -> float | None:
    """Akaike's criterion with Hurvich and Tsai's correction (Biometrika 76 (1989) 297), up to a constant.

    Parameters
    ----------
    sum_of_squares : float
        Weighted; with `known_noise` in standard deviations.
    readings, parameters : int
    known_noise : bool
        Else the noise is one more parameter.

    Returns
    -------
    float or None
        None where there are too few readings to tell.
    """
    k = parameters + (0 if known_noise else 1)
    spare = readings - k - 1
    if spare <= 0:
        return None
    misfit = sum_of_squares if known_noise else readings * math.log(max(sum_of_squares, 1e-300) / readings)
    return misfit + 2 * k + 2 * k * (k + 1) / spare


def _named(statement: str, names: tuple[str, ...]) -> str:
    """Call the parameters by their names."""
    for i, name in reversed(list(enumerate(names))):
        statement = statement.replace(f"parameter {i} ", f"{name} ")
    return statement
