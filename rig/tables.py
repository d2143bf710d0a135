"""Runs and fits as text, for the screen."""

from rig.fits import StoredFit
from rig.runs import Run
from rig.units import engineering

SIMULATED = "SIMULATED"


def fit_table(stored: StoredFit) -> str:
    """Return the coefficients, the errors and where they come from, as lines."""
    fit = stored.fit
    source = stored.provenance.get("run") or stored.provenance.get("file")
    lines = [
        f"{SIMULATED + ': ' if stored.simulated else ''}{stored.label}: fit of {source}",
        f"model {fit.model}, aspect {fit.aspect:g}, weights {fit.weights}, {len(fit)} geometries, {fit.quantity} in {fit.unit}",
        "",
        *(f"  x_{name:<7} {value:12.5g}{'   (at its bound 0)' if name in fit.zero else ''}" for name, value in fit.x.items()),
        "",
        f"{'theta_i':>9} {'theta_r':>9} {'measured':>11} {'model':>11} {'E %':>7}",
    ]
    columns = (fit.theta_i_deg, fit.theta_r_deg, fit.measured, fit.modelled, fit.E)
    lines += [f"{ti:>9.2f} {tr:>9.2f} {m:>11.4g} {f:>11.4g} {e:>7.2f}" for ti, tr, m, f, e in zip(*columns, strict=True)]
    lines += ["", f"E: mean {fit.E_mean:.2f} %, maximum {fit.E_max:.2f} %"]
    if not fit.determined:
        lines.append(fit.statement)
    return "\n".join(lines)


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
