"""Runs on disk: made, listed, read, noted."""

import getpass
import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rig.errors import RunError
from rig.files import write_atomically
from rig.journal import SCHEMA_VERSION, read_documents
from rig.workspace import pick

INCIDENTS = "incidents.jsonl"
"""In a run's folder: what was done about trouble on the wires while it was measured."""

GEOMETRY = "theta_r positive on the light's side; z = specimen normal, x in the plane of incidence on the light's side"


@dataclass(frozen=True)
class Reading:
    """One stored reading: where the arms were told to stand and stood (degrees), what the meter said (its own unit).

    Attributes
    ----------
    good : bool
        False where the meter was out of its range.
    superseded : bool
        True where the same geometry was measured again later.
    """

    seq: int
    time: float
    theta_i: float
    theta_r: float
    theta_i_setpoint: float
    theta_r_setpoint: float
    value: float
    unit: str
    status: int
    good: bool
    superseded: bool = False

    @property
    def geometry(self) -> tuple[float, float]:
        """The geometry that was asked for, in degrees: (theta_i, theta_r)."""
        return round(self.theta_i_setpoint, 6), round(self.theta_r_setpoint, 6)


@dataclass(frozen=True)
class Run:
    """A run folder, read once."""

    folder: Path

    @property
    def id(self) -> str:
        """The folder's name."""
        return self.folder.name

    @cached_property
    def documents(self) -> list[tuple[str, dict[str, Any]]]:
        """All documents of the journal, oldest first."""
        return list(read_documents(self.folder / "journal.jsonl"))

    @cached_property
    def start(self) -> dict[str, Any]:
        """The start document of the sweep (not of what was measured again)."""
        for name, doc in self.documents:
            if name == "start":
                return doc
        raise RunError(f"run {self.id}: the journal holds no start; nothing was measured")

    @property
    def cultivar(self) -> str:
        """Abbreviation of the cultivar."""
        return str(self.start["cultivar"])

    @property
    def simulated(self) -> bool:
        """True where the readings come from the simulated bench."""
        return bool(self.start["simulated"])

    @cached_property
    def state(self) -> str:
        """How the sweep ended: complete, aborted, failed, or crashed (no stop was written)."""
        uid = self.start["uid"]
        for name, doc in self.documents:
            if name == "stop" and doc["run_start"] == uid:
                return {"success": "complete", "abort": "aborted", "fail": "failed"}[doc["exit_status"]]
        return "crashed"

    @property
    def reason(self) -> str:
        """Why the sweep ended early, as far as it is known."""
        return next((doc.get("reason", "") for name, doc in self.documents if name == "stop" and doc["run_start"] == self.start["uid"]), "")

    @cached_property
    def readings(self) -> tuple[Reading, ...]:
        """Every reading, in the order measured; those that were measured again later are marked superseded."""
        order: list[str] = []
        by_run: dict[str, list[Reading]] = {}
        descriptors: dict[str, dict[str, Any]] = {}
        for name, doc in self.documents:
            if name == "start":
                order.append(doc["uid"])
                by_run[doc["uid"]] = []
            elif name == "descriptor":
                descriptors[doc["uid"]] = doc
            elif name == "event":
                descriptor = descriptors[doc["descriptor"]]
                if descriptor["name"] == "primary":
                    by_run[descriptor["run_start"]].append(_reading(doc, descriptor))
        readings: list[Reading] = []
        again: set[tuple[float, float]] = set()
        for uid in reversed(order):  # what was measured last stands
            own = by_run[uid]
            readings[:0] = [Reading(**{**vars(r), "superseded": True}) if r.geometry in again else r for r in own]
            again |= {reading.geometry for reading in own if reading.good}
        return tuple(readings)

    @property
    def points_planned(self) -> int:
        """How many readings the sweep was to have."""
        plan = self.start["trajectory"]
        return len(plan["theta_i_deg"]) * len(plan["theta_r_deg"]) * plan["repeat"]

    @property
    def notes(self) -> list[dict[str, Any]]:
        """Remarks, oldest first: each with `time` and `text`."""
        path = self.folder / "notes.jsonl"
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []

    def journal_sha256(self) -> str:
        """Identity of what the journal holds now."""
        return hashlib.sha256((self.folder / "journal.jsonl").read_bytes()).hexdigest()


def _reading(event: dict[str, Any], descriptor: dict[str, Any]) -> Reading:
    data = event["data"]
    return Reading(
        seq=event["seq_num"],
        time=event["time"],
        theta_i=data["theta_i"],
        theta_r=data["theta_r"],
        theta_i_setpoint=data["theta_i_setpoint"],
        theta_r_setpoint=data["theta_r_setpoint"],
        value=data["current"],
        unit=descriptor["data_keys"]["current"]["units"],
        status=data["current_status"],
        good=bool(data["current_good"]),
    )


def new_run_path(runs: Path, cultivar: str) -> Path:
    """Return the folder a new run of `cultivar` will have."""
    return runs / f"{time.strftime('%Y-%m-%d')}_{cultivar}_{uuid.uuid4().hex[:8]}"


def begin_run(folder: Path, config_text: str) -> None:
    """Make a run's folder, with the configuration in it; one that is there already stays as it is.

    Raises
    ------
    RunError
        Where it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "config.toml").exists():
            write_atomically(folder / "config.toml", config_text)
    except OSError as exc:
        raise RunError(f"{folder}: cannot be made: {exc.strerror}") from exc


def start_metadata() -> dict[str, Any]:
    """Return what every start document says of people, machine and software."""
    return {
        "schema_version": SCHEMA_VERSION,
        "geometry": GEOMETRY,
        "operator": _operator(),
        "host": platform.node(),
        "software": {name: importlib.metadata.version(name) for name in ("petal-rig", "bluesky", "numpy", "pyserial")},
        "commit": _commit(),
    }


def _operator() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"


def _commit() -> str:
    """Return the commit the software runs from, or '' for an installed one."""
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():
        return ""
    answer = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return answer.stdout.strip() if answer.returncode == 0 else ""


def list_runs(runs: Path) -> list[Run]:
    """Return the runs in `runs`, oldest first by the journal's start; a folder without a journal is none."""
    found = [Run(folder) for folder in runs.iterdir() if (folder / "journal.jsonl").exists()] if runs.is_dir() else []
    return sorted(found, key=_started)


def _started(run: Run) -> float:
    try:
        return float(run.start["time"])
    except RunError:
        return (run.folder / "journal.jsonl").stat().st_mtime


def find_run(runs: Path, wanted: str) -> Run:
    """Return the run that `wanted` means: `latest`, its name, a unique beginning of it or of its last part, or its folder.

    Raises
    ------
    RunError
        Where there is none, or more than one.
    """
    if (Path(wanted) / "journal.jsonl").exists():
        return Run(Path(wanted))
    names = [run.id for run in list_runs(runs)]
    return Run(runs / pick(runs, names, wanted, "run"))


def latest_run(runs: Path, cultivar: str) -> Run:
    """Return the newest complete run of `cultivar`; raise RunError where there is none."""
    for run in reversed(list_runs(runs)):
        if run.cultivar == cultivar and run.state == "complete":
            return run
    raise RunError(f"no complete run of {cultivar} in {runs}; measure one: rig sweep --cultivar {cultivar}")


def add_note(run: Run, text: str) -> None:
    """Add a remark to `run`, on the disk before this returns."""
    line = json.dumps({"time": time.time(), "author": _operator(), "text": text}, ensure_ascii=False) + "\n"
    try:
        with (run.folder / "notes.jsonl").open("a", encoding="utf-8") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
    except OSError as exc:
        raise RunError(f"{run.folder / 'notes.jsonl'}: cannot be written: {exc.strerror}") from exc


def good_readings(run: Run) -> Iterator[Reading]:
    """Yield the readings that count: within the meter's range and not measured again."""
    return (reading for reading in run.readings if reading.good and not reading.superseded)
