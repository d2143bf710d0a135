"""`rig stop`."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.settings import Settings, trace_option
from rig.errors import ConfigError

if TYPE_CHECKING:
    from rig.bench import Paperwork
    from rig.config import BenchConfig
    from rig.probing import Row
    from rig.stopping import Ending


@click.command(epilog="\b\nExample:\n  rig stop")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def command(settings: Settings, as_json: bool, trace: str | None) -> None:
    """Stop every axis of the bench at once.

    Every rig command that has the port of an axis, wherever it was started, is told to stop all axes and to end, its run closed as
    aborted. Without waiting for it each axis is told from here, and again when that command has ended. What cannot be reached is named; the
    exit code is then 1.

    Where rig.toml cannot be used, or is not here, every rig command of this machine that has an instrument is told to end, and each axis
    whose port and model can be made out is told to stop.
    """
    from rig.cli.instruments import opened_config
    from rig.session import lasting
    from rig.stopping import halt_rows, stop_rows, tell_owners

    troubles: list[ConfigError] = []
    try:
        config = opened_config(settings)
    except Exception as exc:  # whatever it is, the arms must stop
        ending = tell_owners(None)
        troubles.append(exc if isinstance(exc, ConfigError) else ConfigError(f"rig.toml cannot be used: {type(exc).__name__}: {exc}"))
        config, lost = _salvaged(settings)
        rows = _recorded(settings, config, trace, lambda papers: halt_rows(config, ending, papers), troubles)
        rows += [{"name": name, "port": None, "error": why} for name, why in lost.items()]
    else:
        if lasting(config):
            ending = tell_owners(axis.port for axis in config.axes.values())
            rows = _recorded(settings, config, trace, lambda papers: stop_rows(config, ending, papers), troubles)
        else:  # it ends with the command that started it; but somebody may have typed this in the wrong folder
            ending = tell_owners(() if _toml(settings).exists() else None)
            ending.wait()
            rows = []
    _say(config, ending, rows, as_json)
    if troubles:
        raise troubles[0]
    if any(row["error"] for row in (*rows, *ending.rows())):
        sys.exit(1)


def _toml(settings: Settings) -> Path:
    return Path(settings.config or "rig.toml")


def _salvaged(settings: Settings) -> tuple["BenchConfig", dict[str, str]]:
    from rig.salvage import salvaged

    path = _toml(settings)
    try:
        text = path.read_bytes().decode(errors="replace")
    except OSError:
        text = ""
    return salvaged(text, str(path))


def _recorded(
    settings: Settings,
    config: "BenchConfig",
    trace: str | None,
    stop: Callable[["Paperwork"], list["Row"]],
    troubles: list[ConfigError],
) -> list["Row"]:
    """Stop with a trace being written, and without it where it cannot be."""
    from rig.cli.instruments import looking

    if trace is not None:
        try:
            with looking(settings, config, trace=trace) as papers:
                return stop(papers)
        except ConfigError as exc:
            troubles.append(exc)
    with looking(settings, config, trace=None) as papers:
        return stop(papers)


def _say(config: "BenchConfig", ending: "Ending", rows: list["Row"], as_json: bool) -> None:
    from rig.cli.instruments import mark

    if as_json:
        simulated = {"simulated": config.simulated}
        click.echo(json.dumps({**simulated, "owners": ending.rows(), "axes": [{**simulated, **row} for row in rows]}))
        return
    for row in ending.rows():
        click.echo(row["error"] or f"process {row['pid']} ({row['command']}) has stopped and ended")
    for row in rows:
        click.echo(f"{mark(config)}{row['name']}: {_outcome(row)}")
    if not (rows or ending.owners):
        click.echo(f"{mark(config)}nothing to stop: this bench begins and ends with a command, and none has an instrument")


def _outcome(row: "Row") -> str:
    if row.get("moving"):
        return f"told to stop, {row['error']}, at {row['position']:.3f} {row['unit']}"
    if row["error"]:
        return f"could not be reached: {row['error']}"
    if row.get("position") is None:
        return "told to stop"
    return f"told to stop, at rest at {row['position']:.3f} {row['unit']}"
