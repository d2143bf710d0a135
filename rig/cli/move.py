"""`rig move`."""

import json

import click

from rig.cli.settings import Settings, trace_option
from rig.errors import ConfigError, InterlockError


# A negative position must not look like an option.
@click.command(
    context_settings={"ignore_unknown_options": True},
    epilog="\b\nExamples:\n  rig move detector -30\n  rig move source 45 --home      find the reference first, where it has none",
)
@click.argument("axis")
@click.argument("position", metavar="DEG")
@click.option("--home", "homes", is_flag=True, help="Home the axis first where it has no reference.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def command(settings: Settings, axis: str, position: str, homes: bool, as_json: bool, trace: str | None) -> None:
    """Send AXIS to DEG: degrees of theta as in a sweep, mm for a linear axis. Limits and keep-out hold.

    The first Ctrl-C, or SIGTERM, stops all axes.
    """
    from rig.cli.instruments import chosen, follow, mark, opened_config, session, with_its_arms

    try:
        target = float(position)
    except ValueError:
        raise ConfigError(f"rig move {axis} {position}: expected a number, such as 30 or -12.5") from None
    config = opened_config(settings)
    (name,) = chosen(config, [axis], list(config.axes), "axis")
    config.interlock.check_limits(name, target)  # before anything is opened
    with session(settings, config, axes=with_its_arms(name), trace=trace) as (bench, interrupts):
        moved = bench.axes[name]
        if not moved.homed and not homes:
            raise InterlockError(f"{name} has no reference; `rig home {name}` finds it, or --home does before the move. Keep its way free")
        if not moved.homed:
            follow(interrupts, moved, moved.home(), f"{mark(config)}homing {name}")
        follow(interrupts, moved, moved.set(target), f"{mark(config)}{name} to {target:g} {moved.unit}")
        row = {"axis": name, "setpoint": target, "readback": moved.position, "unit": moved.unit}
    click.echo(json.dumps(row) if as_json else f"{mark(config)}{name} at {moved.position:.3f} {moved.unit}")
