"""`rig init`."""

from pathlib import Path

import click

from rig.config import template
from rig.errors import ConfigError


@click.command(epilog="\b\nExample:\n  rig init && nano rig.toml && rig sweep --cultivar RR --dry-run")
@click.option("--out", default="rig.toml", show_default=True, metavar="FILE", help="Where to write it.")
@click.option("--force", is_flag=True, help="Overwrite a file that is there.")
def command(out: str, force: bool) -> None:
    """Write a commented rig.toml: the way from the simulated bench to your own."""
    path = Path(out)
    if path.exists() and not force:
        raise ConfigError(f"{path} is there already; --force overwrites it")
    path.write_text(template(), encoding="utf-8")
    click.echo(f"{path}: set model and port of each axis and of the sensor, then try: rig sweep --cultivar RR --dry-run", err=True)
