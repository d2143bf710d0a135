"""Runs and fits as text, for the screen."""

from typing import TYPE_CHECKING

from rig.fits import StoredFit
from rig.runs import Run
from rig.units import engineering

if TYPE_CHECKING:
    from fitting.compare import Comparison
    from fitting.linear import Coefficient

SIMULATED = "SIMULATED"


def fit_table(stored: StoredFit) -> str:
    """Return the coefficients, the errors, what can be concluded and where it comes from, as lines."""
    fit = stored.fit
    source = stored.provenance.get("run") or stored.provenance.get("file")
    shape = "".join(f", {name} {value:.4g}{' (found)' if name in fit.searched else ''}" for name, value in fit.shape.items())
    lines = [
        f"{SIMULATED + ': ' if stored.simulated else ''}{stored.label}: fit of {source}",
        f"model {fit.model}{shape}, weights {fit.weights}, {len(fit)} geometries, {fit.quantity} in {fit.unit}",
        "",
        *(_coefficient(c) for c in fit.linear.coefficients),
        "",
    ]
    out_of_plane = not fit.measurements.in_plane.all()
    lines.append(
        f"{'theta_i':>9} {'theta_r':>9} " + (f"{'phi':>9} " if out_of_plane else "") + f"{'measured':>11} {'model':>11} {'E %':>7}"
    )
    for theta_i, theta_r, phi, measured, modelled, E in zip(
        fit.theta_i_deg, fit.theta_r_deg, fit.measurements.phi_deg, fit.measured, fit.modelled, fit.E, strict=True
    ):
        azimuth = f"{phi:>9.2f} " if out_of_plane else ""
        lines.append(f"{theta_i:>9.2f} {theta_r:>9.2f} {azimuth}{measured:>11.4g} {modelled:>11.4g} {E:>7.2f}")
    lines += [
        "",
        f"E: mean {fit.E_mean:.2f} %, maximum {fit.E_max:.2f} %; cosine-weighted error {_in_unit(fit.linear.cosine_rmse, fit.unit)}",
    ]
    lines += [f"predicted {p.what}: E mean {_percent(p.E_mean)}, maximum {_percent(p.E_max)}" for p in fit.predicted]
    told = len(fit.linear.coefficients)  # the table above has them already
    return "\n".join([*lines, "", *fit.statement.splitlines()[told:]])


def _coefficient(c: "Coefficient") -> str:
    remark = "NOT determined" if not c.determined else "at its bound 0" if c.active else f"+- {c.standard_error:.2g}"
    return f"  x_{c.name:<7} {c.value:12.5g}   {remark:<16} 95 %: {c.low:.4g} to {c.high:.4g}"


def comparison_table(comparison: "Comparison") -> str:
    """Return the ladder of models, rung by rung, and which the data support, as lines."""
    lines = [f"{'model':<28}{'numbers':>8}{'mean E':>9}{'max E':>9}{'cos rmse':>11}{'chi2/dof':>10}{'AICc':>9}{'left out':>10}"]
    least = min((row.aicc for row in comparison.rows if row.aicc is not None), default=0.0)
    for row in comparison.rows:
        if row.problem is not None:
            lines.append(f"{row.title:<28}{row.parameters:>8}   {row.problem}")
            continue
        rmse, chi2 = (f"{v:.4g}" if v is not None else "-" for v in (row.cosine_rmse, row.chi2_per_dof))
        aicc = "-" if row.aicc is None else f"{row.aicc - least:+.1f}"
        mark = " *" if row is comparison.supported else "" if row.trusted else "  did not converge"
        errors = "".join(f"{_percent(value):>9}" for value in (row.E_mean, row.E_max))
        lines.append(f"{row.title:<28}{row.parameters:>8}{errors}{rmse:>11}{chi2:>10}{aicc:>9}{_percent(row.left_out):>10}{mark}")
    left_out = "left out: mean E of each incidence by a fit to the others"
    return "\n".join([*lines, f"AICc above the lowest; {left_out}; *: supported", "", comparison.statement])


def _in_unit(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.4g}" + ("" if unit == "1" else f" {unit}")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} %"


def run_table(run: Run) -> str:
    """Return what a run holds, as lines."""
    start = run.start
    mark = f"{SIMULATED}: " if run.simulated else ""
    state = f"{run.state}{f' ({run.reason})' if run.reason else ''}"
    lines = [
        f"{mark}{run.id}: {run.cultivar}, {state}, {len(run.readings)} readings of {run.points_planned} planned",
        f"bench {start['bench']}, operator {start['operator']}" + (f", seed {start['simulation'].get('seed')}" if run.simulated else ""),
        "",
        f"{'theta_i':>9} {'theta_r':>9} {'reading':>12}",
    ]
    for reading in run.readings:
        remark = "  out of range" if not reading.good else "  measured again" if reading.superseded else ""
        lines.append(f"{reading.theta_i:>9.3f} {reading.theta_r:>9.3f} {engineering(reading.value, reading.unit):>12}{remark}")
    lines += [f"note: {note['text']}" for note in run.notes]
    return "\n".join(lines)
