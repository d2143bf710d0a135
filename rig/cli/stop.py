"""`rig stop`."""

import json
import sys

import click

from rig.cli.settings import Settings, trace_option

PATIENCE_S = 10.0


@click.command(epilog="\b\nExample:\n  rig stop")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def command(settings: Settings, as_json: bool, trace: str | None) -> None:
    """Stop every axis of the bench at once.

    A rig command that is using the bench is told to stop all axes and to end, its run closed as aborted; then each axis is told again from
    here. What cannot be reached is named; the exit code is then 1.
    """
    from rig.cli.instruments import looking, mark, opened_config
    from rig.ownership import end_owner
    from rig.probing import stop_rows

    config = opened_config(settings)
    owner = end_owner(settings.workspace.lock, PATIENCE_S)
    with looking(settings, config, trace=trace) as papers:
        rows = stop_rows(config, papers)
    if as_json:
        click.echo(json.dumps({"ended": vars(owner) if owner else None, "axes": rows}))
    else:
        if owner:
            click.echo(f"process {owner.pid} ({owner.command}) has stopped and ended")
        for row in rows:
            click.echo(f"{mark(config)}{row['name']}: {row['error'] or 'told to stop'}")
    if any(row["error"] for row in rows):
        sys.exit(1)
