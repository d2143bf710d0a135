"""`rig home`."""

import json

import click

from rig.cli.settings import Settings, trace_option


@click.command(
    epilog="\b\nExamples:\n  rig home                 every axis that has no reference, one after the other\n  rig home detector --again"
)
@click.argument("axes", nargs=-1, metavar="[AXIS]...")
@click.option("--again", is_flag=True, help="Home also what has its reference.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def command(settings: Settings, axes: tuple[str, ...], again: bool, as_json: bool, trace: str | None) -> None:
    """Find the reference of each AXIS, by default of all that have none. Keep their way free: homing knows no keep-out.

    The first Ctrl-C, or SIGTERM, stops all axes.
    """
    from rig.cli.instruments import chosen, follow, mark, opened_config, session

    config = opened_config(settings)
    names = chosen(config, axes, list(config.axes), "axis")
    rows = []
    with session(settings, config, axes=names, trace=trace) as (bench, interrupts):
        for name in names:
            axis = bench.axes[name]
            done = again or not axis.homed
            if done:
                follow(interrupts, axis, axis.home(), f"{mark(config)}homing {name}")
            row = {"axis": name, "homed": axis.homed, "position": axis.position, "unit": axis.unit, "moved": done}
            rows.append({**row, "simulated": config.simulated})
            if not as_json:
                how = "homed" if done else "had its reference"
                click.echo(f"{mark(config)}{name} {how}, at {axis.position:.3f} {axis.unit}")
    if as_json:
        click.echo(json.dumps(rows))
