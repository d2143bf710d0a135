"""`rig cultivars`."""

import json
from dataclasses import asdict

import click

from rig.cli.settings import Settings
from rig.cultivars import TEXTURES, Cultivar, add_cultivar, load_cultivars


@click.group(invoke_without_command=True, epilog="\b\nExample:\n  rig cultivars add YR --name 'Gold Strike' --colour yellow --texture weak")
@click.pass_context
def command(ctx: click.Context) -> None:
    """List the known cultivars, or add one. BR, RR, PR and WR are built in (Table 1 of the paper)."""
    if ctx.invoked_subcommand is None:
        ctx.invoke(list_)


@command.command("list")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_obj
def list_(settings: Settings, as_json: bool = False) -> None:
    """List abbreviation, name, colour and strength of texture."""
    known = load_cultivars(settings.workspace.cultivars)
    if as_json:
        click.echo(json.dumps([asdict(cultivar) for cultivar in known.values()]))
        return
    for cultivar in known.values():
        click.echo(f"{cultivar.abbreviation:<6} {cultivar.name:<20} {cultivar.colour:<10} {cultivar.texture}")


@command.command("add", epilog="\b\nExample:\n  rig cultivars add YR --name 'Gold Strike' --colour yellow --texture weak")
@click.argument("abbreviation")
@click.option("--name", required=True, help="The cultivar's name.")
@click.option("--colour", required=True, help="Its colour.")
@click.option(
    "--texture", type=click.Choice(TEXTURES), default="unknown", show_default=True, help="How strongly the peculiar texture shows."
)
@click.pass_obj
def add(settings: Settings, abbreviation: str, name: str, colour: str, texture: str) -> None:
    """Add the lab's own cultivar."""
    add_cultivar(settings.workspace.cultivars, Cultivar(abbreviation, name, colour, texture))
    click.echo(f"added {abbreviation}: rig sweep --cultivar {abbreviation}", err=True)
