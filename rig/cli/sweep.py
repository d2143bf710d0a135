"""`rig sweep`."""

from pathlib import Path

import click

from rig.cli.settings import Settings, trace_option
from rig.config import BenchConfig, load_config
from rig.cultivars import find_cultivar, load_cultivars
from rig.errors import ConfigError
from rig.measuring import Order, measure, new_order, redo_order, travel_estimate_s
from rig.runs import INCIDENTS, begin_run, find_run, new_run_path
from rig.trajectory import Trajectory, parse_angles
from rig.units import duration
from rig.workspace import Workspace

SIMULATED = "SIMULATED"


@click.command(
    epilog="""\b
Examples:
  rig sweep --cultivar RR
  rig sweep --cultivar RR --theta-i 15,30,45,60 --theta-r -70:70:5 --repeat 3
  rig sweep --cultivar RR --dry-run
  rig sweep --redo latest --theta-r 30       measure one point again, into the same run

An angle is a number, a list (15,30,45) or a range that holds both its ends (-70:70:10).
theta_r is positive on the light's side: +45 is back to the light, -45 the mirror direction."""
)
@click.option("--cultivar", metavar="ABBR", help="What is mounted: BR, RR, PR, WR or one of your own.")
@click.option("--theta-i", default=None, metavar="DEG", help="Angle of the light from the petal's normal [default: 45].")
@click.option("--theta-r", default=None, metavar="DEG", help="Angles of the view [default: -70:70:10].")
@click.option("--repeat", default=1, show_default=True, type=click.IntRange(1, 10_000), help="Readings at each point.")
@click.option("--out", metavar="DIR", help="The run's own folder [default: a new one in the workspace].")
@click.option("--redo", metavar="RUN", help="Measure points of this run again, into it; the new readings count.")
@click.option("--dry-run", is_flag=True, help="Check and print the points and the time; open and move nothing.")
@trace_option
@click.pass_obj
def command(
    settings: Settings,
    cultivar: str | None,
    theta_i: str | None,
    theta_r: str | None,
    repeat: int,
    out: str | None,
    redo: str | None,
    dry_run: bool,
    trace: str | None,
) -> None:
    """Measure how a petal reflects light by angle, and store the run."""
    config = load_config(settings.config)
    order, folder = _order(settings, config, cultivar, theta_i, theta_r, repeat, out, redo)
    if dry_run:
        _print_points(order)
        return
    folder = folder or new_run_path(settings.workspace.runs, order.cultivar)
    run_sweep(order, folder, settings.workspace, trace=trace)
    click.echo(folder.name if folder.parent == settings.workspace.runs else str(folder))


def run_sweep(order: Order, folder: Path, workspace: Workspace, *, ask: bool | None = None, trace: str | None = None) -> None:
    """Measure `order` into `folder` with the screen on; on the way out say where the readings lie."""
    from rig.incidents import read_incidents
    from rig.interrupts import at_terminal
    from rig.progress import SweepScreen

    mark = f"{SIMULATED}: " if order.config.simulated else ""
    title = f"{mark}{order.cultivar} on {order.config.name}, {len(order.trajectory)} readings"
    begin_run(folder, order.config.text)
    with SweepScreen(len(order.trajectory), title, ask=at_terminal() if ask is None else ask) as screen:
        try:
            measure(order, folder, screen, workspace, trace=trace)
        finally:
            stored = (folder / "journal.jsonl").exists()
            if log := read_incidents(folder / INCIDENTS):
                where = ", see `rig runs show`" if stored else ""
                screen.console.print(f"trouble on the wires, dealt with: {len(log)} times{where}; the last: {log[-1]}", soft_wrap=True)
            if stored:
                screen.console.print(f"{mark}stored in {folder}", soft_wrap=True)
            else:  # nothing was begun: no empty run is left behind
                for name in ("config.toml", INCIDENTS):
                    (folder / name).unlink(missing_ok=True)
                folder.rmdir()


def _order(
    settings: Settings,
    config: BenchConfig,
    cultivar: str | None,
    theta_i: str | None,
    theta_r: str | None,
    repeat: int,
    out: str | None,
    redo: str | None,
) -> tuple[Order, Path | None]:
    """Return the checked order, and the run's folder where it is known already."""
    if redo is not None:
        if theta_r is None or cultivar is not None or out is not None:
            raise ConfigError("--redo RUN takes --theta-r (which points to measure again), and neither --cultivar nor --out")
        run = find_run(settings.workspace.runs, redo)
        incidences = parse_angles(theta_i, "--theta-i") if theta_i else tuple(run.start["trajectory"]["theta_i_deg"])
        return redo_order(config, run, Trajectory(incidences, parse_angles(theta_r, "--theta-r"), repeat)), run.folder
    if cultivar is None:
        raise ConfigError("--cultivar is missing: say what is mounted, e.g. --cultivar RR (`rig cultivars` lists the known ones)")
    find_cultivar(load_cultivars(settings.workspace.cultivars), cultivar)
    trajectory = Trajectory(parse_angles(theta_i or "45", "--theta-i"), parse_angles(theta_r or "-70:70:10", "--theta-r"), repeat)
    order = new_order(config, cultivar, trajectory)
    if out is None:
        return order, None
    folder = Path(out)
    if folder.exists():
        raise ConfigError(f"--out {out}: is there already; a run gets a folder of its own")
    return order, folder


def _print_points(order: Order) -> None:
    mark = f"{SIMULATED}: " if order.config.simulated else ""
    click.echo(f"{mark}{order.cultivar} on {order.config.name}")
    click.echo(f"{'theta_i':>9} {'theta_r':>9} {'readings':>9}")
    for point in order.trajectory.points():
        click.echo(f"{point.theta_i:>9g} {point.theta_r:>9g} {order.trajectory.repeat:>9}")
    seconds = travel_estimate_s(order)
    click.echo(f"{len(order.trajectory)} readings, about {duration(seconds)} after homing; nothing was opened or moved")
