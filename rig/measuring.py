"""From a request to a stored run: checks first, then the bench, the engine and the journal together."""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rig.config import BenchConfig
from rig.errors import RunError
from rig.interlock import Interlock
from rig.interrupts import Interrupts
from rig.runs import INCIDENTS, Run, start_metadata
from rig.trajectory import Trajectory
from rig.workspace import Workspace

if TYPE_CHECKING:
    from rig.bench import Bench

OVERHEAD_S = 0.02
"""What engine, journal and wire add to a reading; only for the estimate of time."""


@dataclass(frozen=True)
class Order:
    """A sweep that has been checked: what, on which bench, and which run it belongs to."""

    config: BenchConfig
    cultivar: str
    trajectory: Trajectory
    metadata: Mapping[str, Any]


def check_trajectory(trajectory: Trajectory, interlock: Interlock) -> None:
    """Raise InterlockError where a point, or the way from one to the next, is not allowed."""
    before: dict[str, float] | None = None
    for point in trajectory.points():
        target = {"source": point.theta_i, "detector": point.theta_r}
        interlock.check_reading(target)
        if before is not None:
            interlock.order(before, target)
        before = target


def new_order(config: BenchConfig, cultivar: str, trajectory: Trajectory) -> Order:
    """Check a new sweep; raise InterlockError before anything is opened."""
    check_trajectory(trajectory, config.interlock)
    return Order(config, cultivar, trajectory, {})


def redo_order(config: BenchConfig, run: Run, trajectory: Trajectory) -> Order:
    """Check a sweep that measures points of `run` again, into the same run.

    Raises
    ------
    RunError
        Where the run has no such point, or the bench is another one than the run was measured on.
    InterlockError
        As for a new sweep.
    """
    if run.start["config_sha256"] != config.sha256:
        raise RunError(f"run {run.id} was measured with another configuration; give it by --config {run.folder / 'config.toml'}")
    known = {reading.geometry for reading in run.readings}
    for point in trajectory.points():
        if (point.theta_i, point.theta_r) not in known:
            raise RunError(f"run {run.id} has no point theta_i {point.theta_i:g}, theta_r {point.theta_r:g} deg to measure again")
    check_trajectory(trajectory, config.interlock)
    return Order(config, run.cultivar, trajectory, {"amends": run.start["uid"]})


def travel_estimate_s(order: Order) -> float:
    """Return about how many bench seconds the sweep takes, homing left out."""
    from drivers.kinds import MotionProfile

    total = 0.0
    before: dict[str, float] | None = None
    for point in order.trajectory.points():
        target = {"source": point.theta_i, "detector": point.theta_r}
        if before is not None:
            moves = [0.0]
            for name in target:
                axis = order.config.axes[name]
                distance = abs(target[name] - before[name])
                if distance:
                    profile = MotionProfile(axis.speed or 10.0, axis.acceleration or 100.0)
                    moves.append(profile.duration_s(distance) + axis.settle_s)
            total += max(moves)
        total += order.trajectory.repeat * ((order.config.sensor.integration_s or 0.0) + OVERHEAD_S)
        before = target
    return total


class Watcher(Protocol):
    """Who watches a sweep, and answers for the technician."""

    ask: bool
    """True where somebody is there to be asked."""

    def opened(self, bench: "Bench") -> None:
        """Learn that the bench is open and about to move."""

    def document(self, name: str, doc: Mapping[str, Any]) -> None:
        """Learn of a document; it is on the disk already."""

    def decide(self, interrupts: Interrupts) -> bool:
        """Answer, while the run is paused, whether to go on."""


def measure(order: Order, folder: Path, watcher: Watcher, workspace: Workspace, *, trace: str | None = None) -> None:
    """Measure `order` into the run folder `folder`, and leave the bench stopped.

    What the links did about trouble is written into the folder too; `trace` names a file for every byte.

    Raises
    ------
    Interrupted
        Ctrl-C or SIGTERM; what was measured is in the run.
    drivers.DeviceError, RunError, InterlockError
        The run is closed as failed; what was measured is in it.
    """
    from rig.bench import open_bench
    from rig.engine import run_plan
    from rig.incidents import IncidentLog
    from rig.journal import JournalWriter
    from rig.plans import sweep
    from rig.session import paperwork

    with (
        paperwork(order.config, workspace, trace=trace, report=IncidentLog(folder / INCIDENTS)) as papers,
        open_bench(order.config, order.cultivar, paperwork=papers) as bench,
    ):
        watcher.opened(bench)
        metadata = {
            **start_metadata(),
            "plan_name": "rig_sweep",
            "cultivar": order.cultivar,
            "trajectory": order.trajectory.describe(),
            "simulated": order.config.simulated,
            "simulation": dict(bench.simulation or {}),
            "bench": order.config.name,
            "config_sha256": order.config.sha256,
            "num_points": len(order.trajectory),
            "detectors": [sensor.name for sensor in (bench.meter, *bench.monitors)],
            "motors": list(bench.axes),
            **order.metadata,
        }
        with (
            Interrupts(bench.halt, bench.release, ask=watcher.ask) as interrupts,
            closing(JournalWriter(folder / "journal.jsonl", abort_reason=lambda: interrupts.reason)) as journal,
        ):
            # The journal comes first: what the watcher shows is on the disk.
            run_plan(sweep(bench, order.trajectory, metadata), interrupts, [journal, watcher.document], watcher.decide)
