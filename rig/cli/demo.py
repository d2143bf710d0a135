"""`rig demo`."""

import shutil
import time
from pathlib import Path

import click

from rig.cli.flower import assembly_table, put_together
from rig.cli.scan import import_petals
from rig.cli.settings import Settings
from rig.cli.sweep import run_sweep
from rig.config import load_config
from rig.cultivars import TABLE_1
from rig.errors import ConfigError
from rig.fits import ROSE_ASPECT, StoredFit, fit_run, refitted, store_fit
from rig.measuring import new_order
from rig.progress import steps
from rig.runs import Run, new_run_path
from rig.trajectory import Trajectory, parse_angles
from rig.units import duration
from rig.workspace import Workspace

PETALS, OPENING, SEED = 25, 0.45, 3
POINTS = 11_000
"""The virtual rose, and of each petal's scan."""

SIDE, SAMPLES = 800, 9
"""Pixels of its picture along a side, and samples of each."""

FIGURES = 0.8
"""Side of the pictures in figures, as a part of that."""


@click.command(epilog="\b\nExamples:\n  rig --workspace /tmp/try demo\n  rig demo --petals 12 --size 400 --samples 4")
@click.option("--petals", default=PETALS, show_default=True, type=click.IntRange(5, 45), help="Of the virtual rose.")
@click.option("--points", default=POINTS, show_default=True, type=click.IntRange(2000, 20_000), help="Of each petal's scan, about.")
@click.option("--size", default=SIDE, show_default=True, type=click.IntRange(100, 4000), help="Pixels of its picture along a side.")
@click.option("--samples", default=SAMPLES, show_default=True, type=click.IntRange(1, 256), help="Of each pixel.")
@click.pass_obj
def command(settings: Settings, petals: int, points: int, size: int, samples: int) -> int:
    """Measure four cultivars on the simulated bench, fit, scan a virtual rose, put it together, draw, and say where everything lies."""
    started = time.monotonic()
    config = load_config(settings.config)
    if not config.simulated:
        raise ConfigError("the demo is for the simulated bench; run it in a folder without a rig.toml")
    trajectory = Trajectory((45.0,), parse_angles("-70:70:10", "--theta-r"))
    fits: dict[str, StoredFit] = {}
    runs: dict[str, Run] = {}
    for cultivar in TABLE_1:
        label = cultivar.abbreviation
        folder = new_run_path(settings.workspace.runs, label)
        run_sweep(new_order(config, label, trajectory), folder, settings.workspace)
        runs[label] = Run(folder)
        fits[label] = fit_run(runs[label])
        store_fit(settings.workspace.fits, fits[label])
    click.echo("drawing", err=True)
    from rig.figures import draw_all

    draw_all(fits, settings.workspace.figures)
    click.echo("\n" + closing_table(fits, runs))
    flower = settings.workspace.flowers / "demo"
    free = build_rose(flower, petals, points)
    picture = picture_rose(flower, fits, settings.workspace, size, samples)
    click.echo(f"\nruns     {settings.workspace.runs}\nfits     {settings.workspace.fits}\nflower   {flower}")
    click.echo(f"figures  {settings.workspace.figures}\npicture  {picture}")
    click.echo(f"all done in {duration(time.monotonic() - started)}")
    return 0 if free else 1


def build_rose(flower: Path, petals: int, points: int) -> bool:
    """Scan a virtual rose petal by petal and put it together from the scans; return whether no two petals intersect."""
    from sim.rose import RangeFinder, write_specimen

    # The folder is the demo's own: what an earlier one left would be mixed with the new petals.
    shutil.rmtree(flower, ignore_errors=True)
    scans = flower / "scans"
    click.echo(f"\na virtual rose of {petals} petals is measured, taken apart and scanned", err=True)
    write_specimen(scans, petals, OPENING, SEED, finder=RangeFinder(points=points), meshes=False)
    import_petals(tuple(map(str, sorted(scans.glob("*.abs")))), str(flower), bases={}, simulated=True)
    shutil.copy(scans / "placement.toml", flower / "placement.toml")
    assembly = put_together(flower)
    click.echo("\n" + assembly_table(assembly))
    return assembly.state == "free"


def picture_rose(flower: Path, fits: dict[str, StoredFit], workspace: Workspace, size: int, samples: int) -> Path:
    """Draw the flower's figures and take its picture with the reflectance of Rote Rose; return the picture."""
    from render.images import write_exr, write_png
    from render.raycast import Raycaster
    from render.scene import read_flower
    from rig.flowerfigures import draw_flower
    from rig.pictures import frame, marked, marks_of, shade_of, show, take

    folder, marks = workspace.figures, marks_of(flower, *fits.values())
    for fit in (fits["RR"], refitted(fits["RR"], ROSE_ASPECT)):  # models first: one bar at a time
        shade_of(fit, workspace)
    with steps("ray-casting") as progress:
        progress(0, 2, "figures 11, 13, 14")
        _, contrasts = draw_flower(flower, fits, folder, marks=marks, workspace=workspace, side=round(FIGURES * size))
        progress(1, 2, "the rose")
        raycaster = Raycaster(read_flower(flower))
        picture = take(raycaster, frame(raycaster, size, size), shade_of(fits["RR"], workspace), samples=samples)
    click.echo("\n" + contrasts)
    path = folder / "rose.png"
    write_png(marked(show(picture, "RR"), marks), path)
    write_exr(picture, path.with_suffix(".exr"))
    return path


def closing_table(fits: dict[str, StoredFit], runs: dict[str, Run]) -> str:
    """Return x, E and the texture's ratio I(+40)/I(-40) per cultivar, and E with the rose's own tall cells, as lines."""
    names = [f"x_{name}" for name in next(iter(fits.values())).fit.x]
    aspect = next(iter(fits.values())).fit.shape["aspect"]
    lines = [f"SIMULATED: the paper's model (aspect {aspect:g}), fitted to the simulated bench's readings, in nA", ""]
    titles = [*names, "mean E %", "max E %", f"E, {ROSE_ASPECT:g} %"]
    lines.append(f"{'':<4}" + "".join(f"{title:>10}" for title in titles) + f"{'I(+40)/I(-40)':>15}   run")
    for label, stored in fits.items():
        measured = dict(zip(map(round, stored.fit.theta_r_deg), stored.fit.measured, strict=True))
        tall = refitted(stored, ROSE_ASPECT)
        values = [*stored.fit.x.values(), stored.fit.E_mean, stored.fit.E_max, tall.fit.E_mean]
        ratio = measured[40] / measured[-40]
        lines.append(f"{label:<4}{''.join(f'{value:>10.4g}' for value in values)}{ratio:>15.2f}   {runs[label].id}")
    lines += [
        "",
        f"E, {ROSE_ASPECT:g}: mean error with cells as tall as a rose's; rig fit --cultivar ... --aspect {ROSE_ASPECT:g} fits with them",
    ]
    return "\n".join(lines)
