"""`rig scan`."""

import json
from pathlib import Path

import click

from rig.errors import ConfigError
from rig.progress import steps

UNITS = click.Choice(["mm", "cm", "m"])


@click.group(epilog="\b\nExamples:\n  rig scan import scans/*.abs --flower rose\n  rig scan register front.ply back.ply --unit m")
def command() -> None:
    """Turn range images of single petals into meshes, and bring several views together."""


@command.command(
    "import",
    epilog="\b\nExamples:\n  rig scan import scans/*.abs --flower rose\n  rig scan import P07.abs --flower rose --base P07=-12.5,30",
)
@click.argument("files", nargs=-1, required=True, type=click.Path(dir_okay=False))
@click.option("--flower", required=True, metavar="DIR", help="The flower's folder; made where it is missing.")
@click.option("--unit", type=UNITS, default="mm", show_default=True, help="Unit of the files' coordinates.")
@click.option("--base", "bases", multiple=True, metavar="PETAL=X,Y", help="Base of a petal whose claw is not recognised, mm in its scan.")
@click.option("--simulated", is_flag=True, help="The scans are of virtual petals: say so on every picture.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def import_(files: tuple[str, ...], flower: str, unit: str, bases: tuple[str, ...], simulated: bool, as_json: bool) -> None:
    """Clean, mesh and measure range images (.abs, range-grid PLY), one petal each; P01.abs becomes petal P01."""
    import_petals(files, flower, unit=unit, bases=_bases(bases), simulated=simulated, as_json=as_json)


def import_petals(
    files: tuple[str, ...], flower: str, *, unit: str = "mm", bases: dict[str, tuple[float, ...]], simulated: bool, as_json: bool = False
) -> None:
    """Import with a progress bar and print the table of quality."""
    from scanning.imports import import_scans

    with steps("importing") as progress:
        petals = import_scans(files, flower, unit=unit, bases=bases, simulated=simulated, progress=progress)
    if as_json:
        click.echo(json.dumps({petal.name: petal.quality for petal in petals}))
        return
    columns = ("points", "triangles", "holes", "roughness_mm", "area_mm2", "rim_length_mm")
    click.echo(f"{'petal':<8}" + "".join(f"{column:>15}" for column in columns))
    for petal in petals:
        click.echo(f"{petal.name:<8}" + "".join(f"{petal.quality[column]:>15.5g}" for column in columns))


def _bases(options: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    bases = {}
    for option in options:
        name, _, place = option.partition("=")
        try:
            bases[name] = tuple(float(number) for number in place.split(","))
        except ValueError:
            bases[name] = ()
        if len(bases[name]) != 2 or not name:
            raise ConfigError(f"--base {option!r}: expected PETAL=X,Y in mm, such as P07=-12.5,30")
    return bases


@command.command("register", epilog="\b\nExample:\n  rig scan register bun000.ply bun045.ply --unit m --out both.ply")
@click.argument("target", type=click.Path(dir_okay=False))
@click.argument("sources", nargs=-1, required=True, type=click.Path(dir_okay=False))
@click.option("--unit", type=UNITS, default="mm", show_default=True, help="Unit of the files' coordinates.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the search for the first pose.")
@click.option("--out", metavar="FILE.ply", type=click.Path(dir_okay=False), help="Where to write the views merged.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def register(target: str, sources: tuple[str, ...], unit: str, seed: int, out: str | None, as_json: bool) -> None:
    """Bring two or more views of one object together, without hints, and print each T_target_source (4 x 4, mm)."""
    import numpy as np

    from scanning.clean import Cleaning, clean
    from scanning.formats import read_range_image
    from scanning.formats.ply import write_mesh
    from scanning.register import merge
    from scanning.register import register as find_pose
    from scanning.triangulate import triangulate

    cleaned = [clean(read_range_image(Path(name), unit=unit), Cleaning()) for name in (target, *sources)]
    meshes = [triangulate(view.image, view.jump) for view in cleaned]
    with steps("registering") as progress:
        found = {}
        for done, (name, mesh) in enumerate(zip(sources, meshes[1:], strict=True)):
            progress(done, len(sources), name)
            found[name] = find_pose(mesh, meshes[0], seed=seed)
    if out:
        poses = [np.eye(4), *(pose.T_target_source for pose in found.values())]
        write_mesh(Path(out), merge(meshes, poses), comment=f"{len(meshes)} views merged in the frame of {target}")
        click.echo(f"merged into {out}", err=True)
    if as_json:
        keys = ("fitness", "inlier_rmse", "seed")
        rows = {
            name: {"T_target_source": pose.T_target_source.tolist()} | {k: getattr(pose, k) for k in keys} for name, pose in found.items()
        }
        click.echo(json.dumps(rows))
        return
    for name, pose in found.items():
        click.echo(f"T_target_source of {name} (mm), fitness {pose.fitness:.3f}, inlier rmse {pose.inlier_rmse:.4f} mm")
        for row in pose.T_target_source:
            click.echo("  " + "".join(f"{value:>14.6f}" for value in row))
