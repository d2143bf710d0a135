"""`rig runs`."""

import json
import time
from dataclasses import asdict
from typing import Any

import click

from rig.cli.settings import Settings
from rig.errors import RunError
from rig.fits import fit_of_run
from rig.incidents import describe, read_incidents
from rig.runs import INCIDENTS, Run, add_note, find_run, list_runs
from rig.tables import fit_table, run_table


@click.group(
    invoke_without_command=True,
    epilog="\b\nExamples:\n  rig runs\n  rig runs show latest --json\n  rig runs note latest 'petal had a dew drop'",
)
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_context
def command(ctx: click.Context, as_json: bool) -> None:
    """List the stored runs, oldest first; show one, or add a remark. RUN is a name, a unique part of it, a folder, or `latest`."""
    if ctx.invoked_subcommand is not None:
        return
    runs = list_runs(ctx.obj.workspace.runs)
    rows = [_row(run) for run in runs]
    if as_json:
        click.echo(json.dumps(rows))
    elif not rows:
        click.echo(f"no runs in {ctx.obj.workspace.runs}; measure one: rig sweep --cultivar RR", err=True)
    else:
        for row in rows:
            when = time.strftime("%Y-%m-%d %H:%M", time.localtime(row["time"])) if row["time"] else "?"
            simulated = "SIMULATED" if row["simulated"] else ""
            click.echo(
                f"{row['run']:<28} {row['cultivar']:<6} {when}  {row['state']:<9} {row['readings']:>5} readings  {simulated}".rstrip()
            )


def _row(run: Run) -> dict[str, Any]:
    try:
        return {
            "run": run.id,
            "cultivar": run.cultivar,
            "time": run.start["time"],
            "state": run.state,
            "readings": len(run.readings),
            "simulated": run.simulated,
        }
    except RunError as exc:  # one damaged run must not hide the others
        return {"run": run.id, "cultivar": "?", "time": None, "state": "damaged", "readings": 0, "simulated": False, "error": str(exc)}


@command.command("show", epilog="\b\nExamples:\n  rig runs show latest\n  rig runs show 3f2a --json")
@click.argument("run")
@click.option("--json", "as_json", is_flag=True, help="For programs; holds the newest fit's x and E too, where there is one.")
@click.pass_obj
def show(settings: Settings, run: str, as_json: bool) -> None:
    """Show the readings, notes and newest fit of RUN."""
    found = find_run(settings.workspace.runs, run)
    fit = fit_of_run(settings.workspace.fits, found)
    if as_json:
        click.echo(json.dumps(_show_json(found) | ({"fit": fit.id, **fit.fit.to_dict()} if fit else {})))
        return
    click.echo(run_table(found))
    if incidents := read_incidents(found.folder / INCIDENTS):
        click.echo(f"\n{len(incidents)} troubles on the wires, dealt with:")
        for incident in incidents:
            click.echo(f"  {describe(incident)}")
    if fit:
        click.echo("\n" + fit_table(fit))


def _show_json(run: Run) -> dict[str, Any]:
    return _row(run) | {
        "uid": run.start["uid"],
        "reason": run.reason,
        "trajectory": run.start["trajectory"],
        "readings": [vars(reading) for reading in run.readings],
        "notes": run.notes,
        "incidents": [asdict(incident) for incident in read_incidents(run.folder / INCIDENTS)],
        "folder": str(run.folder),
    }


@command.command("note", epilog="\b\nExample:\n  rig runs note latest 'petal had a dew drop'")
@click.argument("run")
@click.argument("text")
@click.pass_obj
def note(settings: Settings, run: str, text: str) -> None:
    """Add the remark TEXT to RUN."""
    add_note(find_run(settings.workspace.runs, run), text)
