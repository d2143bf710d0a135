"""`rig figures`."""

from pathlib import Path

import click

from rig.cli.settings import Settings
from rig.cultivars import TABLE_1
from rig.fits import latest_fit


@click.command(epilog="\b\nExamples:\n  rig figures\n  rig figures --flower rose --out paper/")
@click.option("--flower", metavar="DIR", type=click.Path(path_type=Path), help="Draw figures 11, 13 and 14 too, of this assembled flower.")
@click.option("--out", metavar="DIR", help="Where to draw [default: figures/ in the workspace].")
@click.pass_obj
def command(settings: Settings, flower: Path | None, out: str | None) -> None:
    """Draw the paper's figures 1, 2, 6, 7, 8 and 9 from the newest fit of each cultivar, as PNG and SVG."""
    from rig.figures import draw_all

    fits = {cultivar.abbreviation: latest_fit(settings.workspace.fits, cultivar.abbreviation, "paper") for cultivar in TABLE_1}
    folder = Path(out) if out else settings.workspace.figures
    for path in draw_all(fits, folder):
        click.echo(path)
    if flower is None:
        return
    from rig.flowerfigures import draw_flower
    from rig.pictures import marks_of

    written, contrasts = draw_flower(flower, fits, folder, marks=marks_of(flower, *fits.values()), workspace=settings.workspace)
    for path in written:
        click.echo(path)
    click.echo(contrasts, err=True)
