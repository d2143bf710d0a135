"""`rig status`."""

import json
import sys
from typing import Any

import click

from rig.cli.settings import Settings, trace_option


@click.command(epilog="\b\nExamples:\n  rig status\n  rig status detector --json")
@click.argument("axes", nargs=-1, metavar="[AXIS]...")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def command(settings: Settings, axes: tuple[str, ...], as_json: bool, trace: str | None) -> None:
    """Say where each AXIS stands, whether it has its reference, and what it was last told. Nothing moves, nothing is set.

    An axis that does not answer is a line of the answer; the exit code is then 1. One that another rig command is using is not asked: what
    is known of it is said.
    """
    from rig.cli.instruments import chosen, looking, mark, opened_config
    from rig.probing import axis_rows

    config = opened_config(settings)
    names = chosen(config, axes, list(config.axes), "axis")
    with looking(settings, config, trace=trace) as papers:
        rows = axis_rows(config, names, papers)
    if as_json:
        click.echo(json.dumps({"simulated": config.simulated, "axes": rows}))
    else:
        for row in rows:
            click.echo(f"{mark(config)}{_line(row)}")
            for notice in row.get("notices", ()):
                click.echo(f"note: {notice}", err=True)
    if any(row["error"] for row in rows):
        sys.exit(1)


def _line(row: dict[str, Any]) -> str:
    if row["error"]:
        return f"{row['name']}: {row['error']}"
    if row["in_use_by"]:
        told = f", {row['last_command']}" if row["last_command"] else ""
        return f"{row['name']}: in use by {_who(row['in_use_by'])}{told}"
    parts = [
        f"{row['name']}: {row['position']:.3f} {row['unit']}",
        "moving" if row["moving"] else "at rest",
        "homed" if row["homed"] else "NOT HOMED",
        f"limits {row['low']:g} to {row['high']:g}",
    ]
    if row["warnings"]:
        parts.append(f"says {' '.join(row['warnings'])}")
    if row["last_command"]:
        parts.append(str(row["last_command"]))
    return ", ".join(parts)


def _who(owner: dict[str, Any]) -> str:
    return f"process {owner['pid']} ({owner['command']})" if owner["pid"] else "another program"
