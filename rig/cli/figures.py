"""`rig figures`."""

from pathlib import Path

import click

from rig.cli.settings import Settings
from rig.cultivars import TABLE_1
from rig.fits import latest_fit


@click.command(epilog="\b\nExamples:\n  rig figures\n  rig figures --out paper/")
@click.option("--out", metavar="DIR", help="Where to draw [default: figures/ in the workspace].")
@click.pass_obj
def command(settings: Settings, out: str | None) -> None:
    """Draw the paper's figures 1, 2, 6, 7, 8 and 9 from the newest fit of each cultivar, as PNG and SVG."""
    from rig.figures import draw_all

    fits = {cultivar.abbreviation: latest_fit(settings.workspace.fits, cultivar.abbreviation) for cultivar in TABLE_1}
    for path in draw_all(fits, Path(out) if out else settings.workspace.figures):
        click.echo(path)
