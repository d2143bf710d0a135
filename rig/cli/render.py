"""`rig render`."""

from pathlib import Path

import click

from rig.cli.settings import Settings
from rig.errors import ConfigError
from rig.pictures import ABOVE, find_fit, frame, marked, marks_of, shade_of, show, take


@click.command(
    epilog="""\b
Examples:
  rig render rose --fit RR
  rig render rose --fit WR --size 1200x1200 --samples 9 --out white.png
  rig render rose --fit RR --light-at 100,-50,200 --from 0,-1,0.3"""
)
@click.argument("flower", metavar="FLOWER")
@click.option("--fit", "wanted", required=True, metavar="FIT", help="A cultivar (its newest fit), a fit's name, or its file.")
@click.option("--size", default="800x800", show_default=True, metavar="WxH", help="Pixels.")
@click.option("--samples", default=4, show_default=True, type=click.IntRange(1, 256), help="Samples a pixel.")
@click.option("--light", default=None, metavar="X,Y,Z", help="Towards the light, in the camera's frame [default: 1,1,1].")
@click.option("--light-at", default=None, metavar="X,Y,Z", help="Place of the light, mm in the flower's frame.")
@click.option(
    "--from", "towards", default=None, metavar="X,Y,Z", help="Direction to the viewer in the flower's frame; the picture frames itself."
)
@click.option("--out", metavar="FILE.png", help="Where to write it; the linear FILE.exr goes beside it [default: in the flower's folder].")
@click.pass_obj
def command(
    settings: Settings,
    flower: str,
    wanted: str,
    size: str,
    samples: int,
    light: str | None,
    light_at: str | None,
    towards: str | None,
    out: str | None,
) -> None:
    """Ray-cast an assembled flower with a fitted reflectance; writes a PNG and a linear EXR."""
    if light and light_at:
        raise ConfigError("--light gives a direction, --light-at a place: give one of them")
    width, height = _numbers(size.replace("x", ","), "--size", 2)
    fit = find_fit(settings.workspace.fits, wanted)
    from render.images import write_exr, write_png
    from render.light import DistantLight, NearLight
    from render.raycast import Raycaster
    from render.scene import read_flower

    raycaster = Raycaster(read_flower(flower))
    camera = frame(raycaster, int(width), int(height), _triple(towards, "--from") if towards else ABOVE)
    lamp = NearLight(_triple(light_at, "--light-at")) if light_at else DistantLight(_triple(light, "--light")) if light else DistantLight()
    picture = take(raycaster, camera, shade_of(fit, settings.workspace), light=lamp, samples=samples)
    path = Path(out) if out else Path(flower) / f"{fit.label}.png"
    marks = marks_of(Path(flower), fit)
    write_png(marked(show(picture, fit.label), marks), path)
    write_exr(picture, path.with_suffix(".exr"))
    click.echo(path)
    click.echo(path.with_suffix(".exr"))
    if marks:
        click.echo(", ".join(marks), err=True)


def _numbers(text: str, option: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise ConfigError(f"{option} {text}: expected {count} numbers")
    return numbers


def _triple(text: str, option: str) -> tuple[float, float, float]:
    x, y, z = _numbers(text, option, 3)
    return x, y, z
