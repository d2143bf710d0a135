"""Fits on disk: from a run or a table to the four coefficients, stored with the identity of what they came from."""

import hashlib
import json
import math
import time
import uuid
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.errors import RunError
from rig.files import write_atomically
from rig.runs import Reading, Run, good_readings

if TYPE_CHECKING:
    from fitting.fit import Fit
    from fitting.measurements import Measurements

SCHEMA_VERSION = 2
NANO = 1e-9
ANGLE_DIGITS = 3
"""Readbacks are fitted to a thousandth of a degree: below what the arms resolve."""
ROSE_ASPECT = 1.9
"""Height over width of rose cells, about 20 um wide and a little under 40 um high."""


def measurements_of(run: Run) -> "Measurements":
    """Return the good readings of `run`, one row a geometry: angles as read back, the mean current in nA, its standard error.

    The standard error comes from repeats and is NaN-free: without repeats there is none at all.

    Raises
    ------
    RunError
        Where the run has no good reading.
    """
    import numpy as np

    from fitting.measurements import Measurements

    groups: dict[tuple[float, float], list[Reading]] = defaultdict(list)
    for reading in good_readings(run):
        groups[reading.geometry].append(reading)
    if not groups:
        raise RunError(f"run {run.id} holds no good reading to fit")
    rows = list(groups.values())
    repeated = all(len(row) > 1 for row in rows)
    return Measurements(
        theta_i_deg=np.array([_mean_angle([r.theta_i for r in row]) for row in rows]),
        theta_r_deg=np.array([_mean_angle([r.theta_r for r in row]) for row in rows]),
        value=np.array([float(np.mean([r.value for r in row])) / NANO for row in rows]),
        sigma=np.array([_standard_error([r.value for r in row]) / NANO for row in rows]) if repeated else None,
        quantity="intensity",
        unit="nA",
        source=f"run {run.id}",
        rows=np.array([row[0].seq for row in rows]),
    )


def _mean_angle(angles: list[float]) -> float:
    return round(math.fsum(angles) / len(angles), ANGLE_DIGITS) + 0.0


def _standard_error(values: list[float]) -> float:
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1) / len(values))


@dataclass(frozen=True)
class StoredFit:
    """A fit and where it came from.

    Attributes
    ----------
    id : str
        The file's name without its ending.
    provenance : dict
        `run`, `run_uid` and `journal_sha256` of a run, or `file` and `file_sha256` of a table.
    """

    id: str
    time: float
    label: str
    simulated: bool
    provenance: dict[str, Any]
    fit: "Fit"

    def to_dict(self) -> dict[str, Any]:
        """Return all of it for JSON."""
        return {
            "schema_version": SCHEMA_VERSION,
            "id": self.id,
            "time": self.time,
            "label": self.label,
            "simulated": self.simulated,
            "provenance": self.provenance,
            **self.fit.to_dict(),
        }


def new_fit(label: str, simulated: bool, provenance: dict[str, Any], fit: "Fit") -> StoredFit:
    """Return `fit` with a name of its own."""
    return StoredFit(f"{time.strftime('%Y-%m-%d')}_{label}_{uuid.uuid4().hex[:8]}", time.time(), label, simulated, provenance, fit)


def refitted(stored: StoredFit, aspect: float) -> StoredFit:
    """Return the same readings fitted by the paper's model with cells of another shape, not stored."""
    from fitting.fit import fit

    old = stored.fit
    again = fit(old.measurements, "paper", shape={"aspect": aspect}, weights=old.linear.weights, aperture=old.aperture)
    return new_fit(stored.label, stored.simulated, stored.provenance, again)


def fit_run(run: Run) -> StoredFit:
    """Return the paper's fit of `run` with its usual shape, not stored."""
    from fitting.fit import fit

    return new_fit(run.cultivar, run.simulated, provenance_of_run(run), fit(measurements_of(run)))


def provenance_of_run(run: Run) -> dict[str, Any]:
    """Return what identifies `run` as it is now."""
    return {"run": run.id, "run_uid": run.start["uid"], "journal_sha256": run.journal_sha256()}


def provenance_of_file(path: Path) -> dict[str, Any]:
    """Return what identifies the table `path` as it is now."""
    return {"file": str(path), "file_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def store_fit(fits: Path, fit: StoredFit) -> Path:
    """Write `fit` into the folder `fits`; raise RunError where that cannot be."""
    path = fits / f"{fit.id}.json"
    try:
        fits.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(fit.to_dict(), indent=1, allow_nan=False) + "\n")
    except OSError as exc:
        raise RunError(f"{path}: cannot be written: {exc.strerror}") from exc
    return path


def read_fit(path: Path) -> StoredFit:
    """Read a stored fit; raise RunError where the file is not one."""
    from fitting.errors import FitError
    from fitting.fit import Fit

    try:
        doc = json.loads(path.read_text(encoding="utf-8"))
        found = _from_version_1(doc) if doc["schema_version"] == 1 else Fit.from_dict(doc)
        return StoredFit(doc["id"], doc["time"], doc["label"], doc["simulated"], doc["provenance"], found)
    except (OSError, ValueError, KeyError, TypeError, FitError) as exc:
        raise RunError(f"{path}: not a stored fit: {exc!r}") from exc


def _from_version_1(doc: dict[str, Any]) -> "Fit":
    """Fit anew what the first version stored: it kept intensities, and no sigma."""
    import numpy as np

    from fitting.fit import fit
    from fitting.measurements import Measurements

    readings = Measurements(
        theta_i_deg=np.array(doc["theta_i_deg"], float),
        theta_r_deg=np.array(doc["theta_r_deg"], float),
        value=np.array(doc["measured"], float),
        unit=doc["unit"],
        source=doc["source"],
        rows=np.array(doc["rows"]),
    )
    shape = {name: float(doc[name]) for name in ("aspect", "n_us", "n_ss")}
    return fit(readings, "paper", shape=shape, weights="plain" if doc["weights"] == "plain" else "relative")


def list_fits(fits: Path) -> list[StoredFit]:
    """Return the stored fits, oldest first."""
    return sorted((read_fit(path) for path in fits.glob("*.json")), key=lambda fit: fit.time) if fits.is_dir() else []


def latest_fit(fits: Path, label: str, model: str | None = None) -> StoredFit:
    """Return the newest fit of a run of the cultivar `label`, by `model` if one is named; raise RunError where there is none."""
    for fit in reversed(list_fits(fits)):
        if fit.label == label and "run" in fit.provenance and model in (None, fit.fit.model):
            return fit
    by = f" by the model {model}" if model else ""
    raise RunError(f"no fit of {label}{by} in {fits}; make one: rig fit --cultivar {label}")


def fit_of_run(fits: Path, run: Run) -> StoredFit | None:
    """Return the newest fit of `run`, or None."""
    uid = run.start["uid"]
    return next((fit for fit in reversed(list_fits(fits)) if fit.provenance.get("run_uid") == uid), None)
