"""`rig read`."""

import json

import click

from rig.cli.settings import Settings, trace_option


@click.command(epilog="\b\nExamples:\n  rig read                   one reading of each sensor\n  rig read sensor --count 10 --json")
@click.argument("sensors", nargs=-1, metavar="[SENSOR]...")
@click.option("--count", default=1, show_default=True, type=click.IntRange(1, 1_000_000), help="Readings of each.")
@click.option("--json", "as_json", is_flag=True, help="For programs: one line of JSON for each reading.")
@trace_option
@click.pass_obj
def command(settings: Settings, sensors: tuple[str, ...], count: int, as_json: bool, trace: str | None) -> None:
    """Take readings from each SENSOR, by default from all of the bench. Nothing moves.

    A reading out of range, or one that the sensor does not vouch for, is marked and has no value.
    """
    from rig.cli.instruments import chosen, mark, opened_config, session, shown
    from rig.probing import reading_row

    config = opened_config(settings)
    names = chosen(config, sensors, list(config.sensors), "sensor")
    with session(settings, config, sensors=names, trace=trace) as (bench, interrupts):
        for _ in range(count):
            for name in names:
                sensor = bench.sensors[name]
                interrupts.wait(sensor.trigger())
                row = {"sensor": name, "simulated": config.simulated, **reading_row(sensor.last, sensor.unit)}
                click.echo(json.dumps(row) if as_json else f"{mark(config)}{name} {shown(row)}")
