"""`rig read`."""

import json
import math
from typing import Any

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
    from rig.cli.instruments import chosen, mark, opened_config, session
    from rig.units import engineering

    config = opened_config(settings)
    names = chosen(config, sensors, list(config.sensors), "sensor")
    with session(settings, config, sensors=names, trace=trace) as (bench, interrupts):
        for _ in range(count):
            for name in names:
                sensor = bench.sensors[name]
                interrupts.wait(sensor.trigger())
                row = _row(name, sensor)
                if as_json:
                    click.echo(json.dumps(row))
                else:
                    value = engineering(row["value"], sensor.unit) if row["good"] else f"not good ({', '.join(row['flags'])})"
                    click.echo(f"{mark(config)}{name} {value}")


def _row(name: str, sensor: Any) -> dict[str, Any]:
    reading = sensor.last
    value = sensor.value
    flags = [flag for flag in ("over_range", "under_range", "out_of_range", "doubtful") if getattr(reading, flag, False)]
    return {
        "sensor": name,
        "value": value if reading.good and math.isfinite(value) else None,
        "unit": sensor.unit,
        "good": reading.good,
        "status": reading.status,
        "flags": [*flags, *reading.flags],
    }
