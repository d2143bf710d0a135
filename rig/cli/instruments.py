"""What the commands that talk to instruments have in common."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import click

from rig.bench import Bench, Paperwork, open_bench
from rig.cli.settings import Settings
from rig.config import ANGLES, BenchConfig, load_config
from rig.devices import Axis
from rig.errors import ConfigError
from rig.incidents import IncidentLog
from rig.interrupts import Interrupts
from rig.probing import SPECIMEN
from rig.session import paperwork
from rig.status import Status


def chosen(config: BenchConfig, names: Sequence[str], known: Sequence[str], what: str) -> list[str]:
    """Return `names`, or all that are known where none is given; raise ConfigError at a name the bench does not have."""
    for name in names:
        if name not in known:
            raise ConfigError(f"no {what} {name!r} in {config.source}; there are {', '.join(known)}")
    return list(names or known)


@contextmanager
def session(
    settings: Settings, config: BenchConfig, *, axes: Sequence[str] = (), sensors: Sequence[str] = (), trace: str | None = None
) -> Iterator[tuple[Bench, Interrupts]]:
    """Open instruments for a command; a signal stops all axes at once. What was done about trouble is said at the end."""
    log = IncidentLog()
    with paperwork(config, settings.workspace, devices=[*axes, *sensors], trace=trace, report=log) as papers:
        try:
            with open_bench(config, SPECIMEN, axes=axes, sensors=sensors, paperwork=papers) as bench:
                for notice in bench.notices:
                    click.echo(f"note: {notice}", err=True)
                with Interrupts(bench.halt, bench.release, ask=False) as interrupts:
                    yield bench, interrupts
        finally:
            _tell(log)


@contextmanager
def looking(settings: Settings, config: BenchConfig, *, trace: str | None) -> Iterator[Paperwork]:
    """Prepare a command that asks instruments one by one and moves nothing: it has each port only while it asks there.

    What was done about trouble is said at the end.
    """
    log = IncidentLog()
    with paperwork(config, settings.workspace, devices=(), trace=trace, report=log) as papers:
        try:
            yield papers
        finally:
            _tell(log)


def _tell(log: IncidentLog) -> None:
    if log.summary:
        click.echo(f"trouble on the wires, dealt with: {log.summary}", err=True)


def with_its_arms(name: str) -> list[str]:
    """Return the axes that must be known to move one: an arm's keep-out is about the other arm too."""
    return list(ANGLES) if name in ANGLES else [name]


def follow(interrupts: Interrupts, axis: Axis, motion: Status, what: str) -> None:
    """Wait for a motion with the position on the screen; raise what went wrong."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True, highlight=False)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(what)
        interrupts.wait(motion, meanwhile=lambda: progress.update(task, description=f"{what}: {axis.position:.2f} {axis.unit}"))


def mark(config: BenchConfig) -> str:
    """Return what every line about simulated instruments begins with."""
    return "SIMULATED: " if config.simulated else ""


def shown(row: Mapping[str, Any]) -> str:
    """Return a reading (`reading_row`) as people read it."""
    from rig.units import engineering

    return engineering(row["value"], row["unit"]) if row["good"] else f"not good ({', '.join(row['flags'])})"


def opened_config(settings: Settings) -> BenchConfig:
    """Return the configuration of the bench."""
    return load_config(settings.config)
