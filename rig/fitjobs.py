"""What `rig fit` was asked to do: sources into tables of readings, and settings into fits."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.errors import ConfigError, RunError
from rig.fits import StoredFit, measurements_of, new_fit, provenance_of_file, provenance_of_run
from rig.runs import Run, list_runs

if TYPE_CHECKING:
    from fitting.aperture import Aperture
    from fitting.compare import Comparison
    from fitting.fit import Fit, Prediction
    from fitting.ladder import Traces
    from fitting.linear import Weights
    from fitting.measurements import Measurements
    from fitting.progress import Progress
    from fitting.search import Range


@dataclass(frozen=True)
class Specimen:
    """Readings of one thing, from one table or from runs of one cultivar.

    Attributes
    ----------
    label : str
        Cultivar, or the table's name.
    simulated : bool
    provenance : dict
        See `StoredFit`.
    measurements : Measurements
    others : tuple of (str, Measurements)
        Readings to predict: where they come from, and what they are.
    """

    label: str
    simulated: bool
    provenance: dict[str, Any]
    measurements: "Measurements"
    others: "tuple[tuple[str, Measurements], ...]" = ()


@dataclass(frozen=True)
class Job:
    """How specimens are fitted; `fitting.fit.fit` says what each means.

    Attributes
    ----------
    model : str
        A rung of the ladder, or "auto".
    shape : mapping
        Numbers held (a value) or searched for (a pair).
    searched : tuple of str or None
        Numbers to search for, "all" and "none" too, within their usual bounds where no others are told; None for those that the ladder's
        comparison searches for.
    compared : bool
        Whether the whole ladder is fitted.
    """

    model: str
    weights: "Weights"
    shape: "Mapping[str, Range]"
    searched: tuple[str, ...] | None
    aperture: "Aperture"
    seed: int
    compared: bool


def specimen_of_runs(runs: Sequence[Run], all_runs: Path) -> Specimen:
    """Put complete runs of one cultivar together; with one run at 45 deg, runs at other incidences are there to be predicted.

    Raises
    ------
    RunError
        If simulated and real runs are mixed, or a run holds no good reading.
    """
    first, ids = runs[0], [run.id for run in runs]
    if len({run.simulated for run in runs}) > 1:
        raise RunError(f"{', '.join(ids)}: simulated and real readings cannot be fitted together")
    readings = [measurements_of(run) for run in runs]
    if len(runs) == 1:
        return Specimen(first.cultivar, first.simulated, provenance_of_run(first), readings[0], _others(first, readings[0], all_runs))
    parts = [provenance_of_run(run) for run in runs]
    return Specimen(first.cultivar, first.simulated, {"run": ", ".join(ids), "runs": parts}, together(readings))


def specimen_of_table(path: Path, measurements: "Measurements", most: int, seed: int) -> Specimen:
    """Take a table, or of a long one so many readings, drawn evenly at random; the others are there to be predicted."""
    import numpy as np

    label = "".join(c if c.isalnum() or c == "-" else "-" for c in path.stem) or "table"
    provenance = provenance_of_file(path)
    if len(measurements) <= most:
        return Specimen(label, False, provenance, measurements)
    drawn = np.zeros(len(measurements), bool)
    drawn[np.random.default_rng(seed).choice(len(measurements), most, replace=False)] = True
    others = (f"the {np.count_nonzero(~drawn)} readings not drawn", measurements.take(~drawn))
    return Specimen(label, False, provenance | {"drawn": most, "of": len(measurements), "seed": seed}, measurements.take(drawn), (others,))


def together(tables: "Sequence[Measurements]") -> "Measurements":
    """Put tables of one quantity and unit below one another; raise RunError where they differ in these."""
    import numpy as np

    from fitting.measurements import Measurements

    first = tables[0]
    if any((m.quantity, m.unit) != (first.quantity, first.unit) for m in tables):
        raise RunError(f"{', '.join(m.source for m in tables)}: readings of different quantities or units cannot be fitted together")
    known = all(m.sigma is not None for m in tables)
    return Measurements(
        **{name: np.concatenate([getattr(m, name) for m in tables]) for name in ("theta_i_deg", "theta_r_deg", "phi_deg", "value")},
        sigma=np.concatenate([m.sigma for m in tables if m.sigma is not None]) if known else None,
        quantity=first.quantity,
        unit=first.unit,
        source=", ".join(m.source for m in tables),
        rows=np.concatenate([m.rows for m in tables if m.rows is not None]),
    )


def _others(run: Run, readings: "Measurements", all_runs: Path) -> "tuple[tuple[str, Measurements], ...]":
    """The newest complete run of the cultivar at each incidence that `run` lacks, if `run` is at one only."""
    if len(readings.incidences) > 1:
        return ()
    found: dict[float, tuple[str, Measurements]] = {}
    for other in reversed(list_runs(all_runs)):
        try:
            if other.id == run.id or (other.cultivar, other.simulated, other.state) != (run.cultivar, run.simulated, "complete"):
                continue
            m = measurements_of(other)
        except RunError:
            continue  # a damaged run must not hinder the fit of a good one
        for k, theta_i in enumerate(m.incidences.tolist()):
            if abs(theta_i - readings.incidences[0]) > 1 and not any(abs(theta_i - known) <= 1 for known in found):
                found[theta_i] = (f"{round(theta_i, 1):g} deg, run {other.id}", m.take(m.incidence_of == k))
    return tuple(found[theta_i] for theta_i in sorted(found))


def fit_specimen(specimen: Specimen, job: Job, traces: "Traces", progress: "Progress") -> "tuple[StoredFit, Comparison | None]":
    """Fit one specimen; not stored.

    Raises
    ------
    ConfigError
        If the readings are too few for `auto` to choose.
    fitting.errors.FitError
        As `fitting.fit.fit`.
    """
    from fitting.compare import compare
    from fitting.fit import fit

    m, comparison = specimen.measurements, None
    common: dict[str, Any] = {"weights": job.weights, "aperture": job.aperture, "effort": _effort(job), "traces": traces}
    if job.compared or job.model == "auto":
        comparison = compare(m, shape=job.shape, progress=progress, **common)
    if job.model == "auto":
        assert comparison is not None
        if comparison.supported is None or comparison.supported.fit is None:
            raise ConfigError(f"{m.source}: {comparison.statement}; name a model with --model")
        found = comparison.supported.fit
        shape: dict[str, Any] = {name: search_bounds(found.model, [name])[name] for name in found.searched} | held(job, found.model)
    else:
        shape = shape_for(job)
        found = fit(m, job.model, shape=shape, **common)
    predicted = _predicted(specimen, found, shape, common)
    return new_fit(specimen.label, specimen.simulated, specimen.provenance, replace(found, predicted=predicted)), comparison


def fit_together(specimens: Sequence[Specimen], job: Job, traces: "Traces") -> list[StoredFit]:
    """Fit specimens that share one shape; not stored. Errors as `fitting.fit.fit`."""
    from fitting.fit import fit_joint

    fits = fit_joint(
        [s.measurements for s in specimens],
        job.model,
        shape=shape_for(job),
        weights=job.weights,
        aperture=job.aperture,
        effort=_effort(job),
        traces=traces,
    )
    return [new_fit(s.label, s.simulated, s.provenance, fit) for s, fit in zip(specimens, fits, strict=True)]


def _predicted(specimen: Specimen, found: "Fit", shape: Mapping[str, Any], common: Mapping[str, Any]) -> "tuple[Prediction, ...]":
    """What the readings at 45 deg foretell of the specimen's others, and the fit of what was not in it."""
    from fitting.errors import FitError
    from fitting.fit import predicted, predictions

    try:
        inside = predictions(specimen.measurements, found.model, shape=shape, **common)
    except FitError as exc:  # the fit to all readings stands
        print(f"rig: nothing is predicted from 45 deg: {exc}", file=sys.stderr)
        inside = ()
    outside = []
    for what, other in specimen.others:
        try:
            outside.append(predicted(found, other, what))
        except FitError as exc:
            print(f"rig: {what} cannot be predicted: {exc}", file=sys.stderr)
    return (*inside, *outside)


def shape_for(job: Job) -> "dict[str, Range]":
    """Shape numbers of the job's model: held as told, searched for as told or as the ladder's comparison does."""
    from fitting.ladder import rung_of
    from fitting.search import usual_bounds

    rung = rung_of(job.model)
    names = rung.searched if job.searched is None else job.searched
    if "all" in names:
        names = (*usual_bounds(rung), *(name for name in names if name != "all"))
    return search_bounds(job.model, dict.fromkeys(name for name in names if name != "none")) | held(job, job.model, strict=True)


def held(job: Job, model: str, *, strict: bool = False) -> "dict[str, Range]":
    """Shape numbers told, of those that the model has; `strict` leaves those it has not for the fit to refuse."""
    from fitting.ladder import rung_of

    known = {number.name for number in rung_of(model).shape}
    return {name: value for name, value in job.shape.items() if strict or name in known}


def search_bounds(model: str, names: Iterable[str]) -> "dict[str, Range]":
    """Return the usual bounds of shape numbers."""
    from fitting.ladder import rung_of
    from fitting.search import usual_bounds

    return usual_bounds(rung_of(model), tuple(names))


def _effort(job: Job) -> Any:
    from fitting.search import Effort

    return Effort(seed=job.seed)
