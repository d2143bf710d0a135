"""The readings of a fit in order: fitted and held out in one table, along the lines they were taken on, with the model's line beside."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from fitting.fit import Fit
    from fitting.measurements import Measurements

Array = NDArray[np.float64]

SAME = 0.5
"""Readbacks of phi this near to one another are one plane, deg."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings fitted and held out, one row each, in the quantity they were read in.

    Attributes
    ----------
    theta_i_deg, theta_r_deg, phi_deg : ndarray, shape (n,), deg
    value : ndarray, shape (n,)
        In the unit of the readings.
    modelled : ndarray, shape (n,)
        By the fit; by the fit that foretold them where they were not fitted.
    foretold : ndarray, shape (n,)
        By a fit without the reading; NaN where there is none.
    sigma : ndarray, shape (n,)
        Standard uncertainty; NaN where the readings have none.
    bar : ndarray, shape (n,)
        Half length of an error bar: sigma, else the scatter of the fit's residuals; NaN where neither is known.
    fitted : ndarray of bool, shape (n,)
    row : ndarray of int, shape (n,)
        Line in the source, 0 where it is not known.
    incidences : ndarray, deg
    incidence_of : ndarray of int, shape (n,)
        Index into `incidences`.
    """

    theta_i_deg: Array
    theta_r_deg: Array
    phi_deg: Array
    value: Array
    modelled: Array
    foretold: Array
    sigma: Array
    bar: Array
    fitted: NDArray[np.bool_]
    row: NDArray[np.int64]
    incidences: Array
    incidence_of: NDArray[np.int64]

    @property
    def residual(self) -> Array:
        """Measured less modelled."""
        return self.value - self.modelled

    @property
    def percent(self) -> Array:
        """Residuals in percent of the readings; NaN at readings of 0 or less."""
        return 100 * self.residual / self._above

    @property
    def E(self) -> Array:
        """Eq. (13), percent; NaN at readings of 0 or less."""
        return np.abs(self.percent)

    @property
    def E_foretold(self) -> Array:
        """Eq. (13) of what was foretold, percent; NaN where nothing was."""
        return 100 * np.abs(self.value - self.foretold) / self._above

    @property
    def _above(self) -> Array:
        return np.where(self.value > 0, self.value, math.nan)


@dataclass(frozen=True, eq=False)
class Cut:
    """Readings of one incidence along a line: in one plane by theta_r, or at one theta_r by phi.

    Attributes
    ----------
    theta_i_deg : float
    held : float
        The phi of the plane, or the theta_r, deg.
    by_phi : bool
        Whether phi runs.
    rows : ndarray of int
        Of the `Readings`, in the order of the running angle.
    """

    theta_i_deg: float
    held: float
    by_phi: bool
    rows: NDArray[np.int64]

    @property
    def in_plane(self) -> bool:
        """Whether the line lies in the plane of incidence."""
        return self.held == 0 and not self.by_phi

    @property
    def title(self) -> str:
        """The angles that are held, as mathtext."""
        light = f"$\\theta_i$ = {tenth(self.theta_i_deg)} deg"
        held = "\\theta_r" if self.by_phi else "\\varphi"
        return light if self.in_plane else f"{light}, ${held}$ = {tenth(self.held)} deg"

    def angles(self, readings: Readings) -> Array:
        """Return the running angle of the readings, deg."""
        return (readings.phi_deg if self.by_phi else readings.theta_r_deg)[self.rows]

    def fine(self, readings: Readings) -> Array:
        """Return a grid over the readings' angles, a degree or less apart."""
        run = self.angles(readings)
        return np.linspace(run.min(), run.max(), max(2, math.ceil(np.ptp(run)) + 1))


def readings_of(fit: "Fit") -> Readings:
    """Put what was fitted and what was foretold into one table; a reading that was both is one row."""
    m = fit.measurements
    counts = _ones(fit, m.theta_i_deg, m.theta_r_deg, m.phi_deg).intensity
    n, columns = len(m), {name: [np.asarray(getattr(m, name), float)] for name in ("theta_i_deg", "theta_r_deg", "phi_deg", "value")}
    foretold, new = np.full(n, math.nan), [np.empty(0)]
    for part in fit.predicted:
        scale = _ones(fit, part.theta_i_deg, part.theta_r_deg, part.phi_deg).intensity
        value, modelled = part.measured / scale, part.modelled / scale
        own = _rows_of(m, part.theta_i_deg, part.theta_r_deg, part.phi_deg, value)
        known = own >= 0
        foretold[own[known]] = modelled[known]
        for name, column in zip(columns, (part.theta_i_deg, part.theta_r_deg, part.phi_deg, value), strict=True):
            columns[name].append(column[~known])
        new.append(modelled[~known])
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    extra = np.concatenate(new)
    pooled = _ones(fit, joined["theta_i_deg"], joined["theta_r_deg"], joined["phi_deg"])
    blank = np.full(extra.size, math.nan)
    sigma = np.concatenate([np.full(n, math.nan) if m.sigma is None else np.asarray(m.sigma, float), blank])
    return Readings(
        **joined,
        modelled=np.concatenate([fit.modelled / counts, extra]),
        foretold=np.concatenate([foretold, extra]),
        sigma=sigma,
        bar=sigma if m.sigma is not None else _scatter(fit, joined["value"], pooled.intensity),
        fitted=np.arange(n + extra.size) < n,
        row=np.concatenate([np.asarray(m.rows, np.int64), np.zeros(extra.size, np.int64)]),
        incidences=pooled.incidences,
        incidence_of=pooled.incidence_of,
    )


def _rows_of(m: "Measurements", *columns: Array) -> NDArray[np.int64]:
    """Find readings among those fitted: their rows, -1 where they are not; repeats are taken in turn."""
    mine = (m.theta_i_deg, m.theta_r_deg, m.phi_deg, m.value)
    free = np.ones(len(m), bool)
    out = np.full(columns[0].size, -1)
    for k in range(out.size):
        angles = np.all([np.isclose(a, b[k], rtol=0, atol=1e-9) for a, b in zip(mine[:3], columns[:3], strict=True)], axis=0)
        same = free & angles & np.isclose(mine[3], columns[3][k], rtol=1e-9, atol=0)
        if same.any():
            out[k] = np.flatnonzero(same)[0]
            free[out[k]] = False
    return out


def _ones(fit: "Fit", theta_i_deg: Array, theta_r_deg: Array, phi_deg: Array) -> "Measurements":
    """Readings of 1, of the fit's quantity."""
    from fitting.measurements import Measurements

    return Measurements(theta_i_deg, theta_r_deg, np.ones(np.size(theta_i_deg)), quantity=fit.measurements.quantity, phi_deg=phi_deg)


def curves(fit: "Fit", cuts: Sequence[Cut], readings: Readings) -> dict[Cut, tuple[Array, Array]]:
    """Return fine angles and the model there for cuts that were fitted.

    An aperture makes the model slow. Its line is then an ideal detector's, and what the aperture adds, known at the readings, is put in
    between them linearly: where there is a reading, the line is the model.
    """
    out = {}
    for cut in cuts:
        rows = cut.rows[readings.fitted[cut.rows]]
        if not rows.size:
            continue
        grid = cut.fine(readings)
        line = _ideal(fit, cut, grid)
        if not fit.aperture.is_ideal:
            angles = (readings.phi_deg if cut.by_phi else readings.theta_r_deg)[rows]
            line = line + np.interp(grid, angles, readings.modelled[rows] - _ideal(fit, cut, angles))
        out[cut] = grid, line
    return out


def _ideal(fit: "Fit", cut: Cut, angles: Array) -> Array:
    """Evaluate the model along a cut as an ideal detector reads it, in the readings' quantity."""
    theta_i, held = np.full(angles.size, cut.theta_i_deg), np.full(angles.size, cut.held)
    theta_r, phi = (held, angles) if cut.by_phi else (angles, held)
    return fit.predict(theta_i, theta_r, phi) / _ones(fit, theta_i, theta_r, phi).intensity


def _scatter(fit: "Fit", value: Array, counts: Array) -> Array:
    """Standard deviation of the residuals as the weights see them, in the unit of the readings; NaN where it is not known."""
    scale = math.nan if fit.linear.scale is None else fit.linear.scale
    if fit.weights == "relative":
        return scale * np.abs(value)
    return scale / counts if fit.weights == "plain" else np.full(value.size, math.nan)


def cuts_of(readings: Readings) -> list[Cut]:
    """Sort the readings into lines: in plane first, then out of the plane along whichever angle needs fewer lines."""
    cuts = []
    for k, theta_i in enumerate(readings.incidences.tolist()):
        here = np.flatnonzero(readings.incidence_of == k)
        inside, outside = here[readings.phi_deg[here] == 0], here[readings.phi_deg[here] != 0]
        if inside.size:
            cuts.append(Cut(theta_i, 0.0, False, inside[np.argsort(readings.theta_r_deg[inside], kind="stable")]))
        by_theta, by_phi = (_alike(angle[outside]) for angle in (readings.phi_deg, readings.theta_r_deg))
        runs_phi = len(by_phi) < len(by_theta)
        running = readings.phi_deg if runs_phi else readings.theta_r_deg
        for held, members in by_phi if runs_phi else by_theta:
            rows = outside[members]
            cuts.append(Cut(theta_i, held, runs_phi, rows[np.argsort(running[rows], kind="stable")]))
    return cuts


def _alike(angles: Array) -> list[tuple[float, NDArray[np.int64]]]:
    """Group angles that are one readback: their mean, and which they are."""
    if not angles.size:
        return []
    order = np.argsort(angles, kind="stable")
    groups = np.split(order, 1 + np.flatnonzero(np.diff(angles[order]) > SAME))
    return [(round(float(angles[group].mean()), 3) + 0.0, group) for group in groups]


def tenth(angle: float) -> str:
    """Return an angle in deg to a tenth, as people say it."""
    return f"{round(angle, 1) + 0.0:g}"
