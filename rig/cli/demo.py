"""`rig demo`."""

import time

import click

from rig.cli.fit import fit_run
from rig.cli.settings import Settings
from rig.cli.sweep import run_sweep
from rig.config import load_config
from rig.cultivars import TABLE_1
from rig.errors import ConfigError
from rig.fits import StoredFit, store_fit
from rig.measuring import new_order
from rig.runs import Run, new_run_path
from rig.trajectory import Trajectory, parse_angles
from rig.units import duration

ROSE_ASPECT = 1.9
"""Height over width of rose cells, about 20 um wide and a little under 40 um high."""


@click.command(epilog="\b\nExample:\n  rig --workspace /tmp/try demo")
@click.pass_obj
def command(settings: Settings) -> None:
    """Measure the four cultivars on the simulated bench, fit, draw, and say where everything lies."""
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
        run_sweep(new_order(config, label, trajectory), folder)
        runs[label] = Run(folder)
        fits[label] = fit_run(runs[label])
        store_fit(settings.workspace.fits, fits[label])
    click.echo("drawing", err=True)
    from rig.figures import draw_all

    draw_all(fits, settings.workspace.figures)
    click.echo("\n" + closing_table(fits, runs))
    click.echo(f"\nruns     {settings.workspace.runs}\nfits     {settings.workspace.fits}\nfigures  {settings.workspace.figures}")
    click.echo(f"all done in {duration(time.monotonic() - started)}")


def closing_table(fits: dict[str, StoredFit], runs: dict[str, Run]) -> str:
    """Return x, E and the texture's ratio I(+40)/I(-40) per cultivar, and E with the rose's own tall cells, as lines."""
    names = [f"x_{name}" for name in next(iter(fits.values())).fit.x]
    aspect = next(iter(fits.values())).fit.aspect
    lines = [f"SIMULATED: the paper's model (aspect {aspect:g}), fitted to the simulated bench's readings, in nA", ""]
    titles = [*names, "mean E %", "max E %", f"E, {ROSE_ASPECT:g} %"]
    lines.append(f"{'':<4}" + "".join(f"{title:>10}" for title in titles) + f"{'I(+40)/I(-40)':>15}   run")
    for label, stored in fits.items():
        measured = dict(zip(map(round, stored.fit.theta_r_deg), stored.fit.measured, strict=True))
        tall = fit_run(runs[label], aspect=ROSE_ASPECT)
        values = [*stored.fit.x.values(), stored.fit.E_mean, stored.fit.E_max, tall.fit.E_mean]
        ratio = measured[40] / measured[-40]
        lines.append(f"{label:<4}{''.join(f'{value:>10.4g}' for value in values)}{ratio:>15.2f}   {runs[label].id}")
    lines += [
        "",
        f"E, {ROSE_ASPECT:g}: mean error with cells as tall as a rose's; rig fit --cultivar ... --aspect {ROSE_ASPECT:g} fits with them",
    ]
    return "\n".join(lines)
