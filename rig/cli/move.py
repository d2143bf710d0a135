"""`rig move`."""

import json

import click

from rig.cli.settings import Settings, trace_option
from rig.errors import ConfigError, InterlockError


class Numbers(click.Command):
    """A command that takes a negative number for an argument, and anything else that begins with a dash for an option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put a space before negative numbers, which then do not look like options."""
        return super().parse_args(ctx, [f" {each}" if each.startswith("-") and _is_number(each) else each for each in args])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@click.command(
    cls=Numbers,
    epilog="\b\nExamples:\n  rig move detector -30\n  rig move source 45 --home      find the reference first, where it has none",
)
@click.argument("axis")
@click.argument("position", metavar="DEG")
@click.option("--home", "homes", is_flag=True, help="Home the axis first where it has no reference; with an arm, the other arm too.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def command(settings: Settings, axis: str, position: str, homes: bool, as_json: bool, trace: str | None) -> None:
    """Send AXIS to DEG: degrees of theta as in a sweep, mm for a linear axis. Limits and keep-out hold.

    The first Ctrl-C, or SIGTERM, stops all axes.
    """
    from rig.cli.instruments import chosen, follow, mark, opened_config, session, with_its_arms

    if not _is_number(position):
        raise ConfigError(f"rig move {axis} {position}: expected a number, such as 30 or -12.5")
    target = float(position)
    config = opened_config(settings)
    (name,) = chosen(config, [axis], list(config.axes), "axis")
    config.interlock.check_limits(name, target)  # before anything is opened
    with session(settings, config, axes=with_its_arms(name), trace=trace) as (bench, interrupts):
        moved = bench.axes[name]
        lost = [each for each in bench.axes.values() if not each.homed]  # an arm's keep-out needs to know where the other one is
        if lost and not homes:
            first = lost[0].name
            found = f"`rig home {first}` finds it, or --home does before the move"
            raise InterlockError(f"{first} has no reference; {found}. Keep its way free")
        for each in lost:
            follow(interrupts, each, each.home(), f"{mark(config)}homing {each.name}")
        follow(interrupts, moved, moved.set(target), f"{mark(config)}{name} to {target:g} {moved.unit}")
        row = {"axis": name, "setpoint": target, "readback": moved.position, "unit": moved.unit, "simulated": config.simulated}
    click.echo(json.dumps(row) if as_json else f"{mark(config)}{name} at {moved.position:.3f} {moved.unit}")
