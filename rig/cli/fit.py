"""`rig fit`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from rig.cli.settings import Settings
from rig.cultivars import find_cultivar, load_cultivars
from rig.errors import ConfigError, RunError
from rig.fits import StoredFit, measurements_of, new_fit, provenance_of_file, provenance_of_run, store_fit
from rig.runs import Run, find_run, latest_run
from rig.tables import fit_table

if TYPE_CHECKING:
    from fitting.mixture import Weights


@click.command(
    epilog="""\b
Examples:
  rig fit latest
  rig fit --cultivar RR --aspect 1.9
  rig fit leaf.csv --theta-r-positive forward --where theta_i_deg=40 --where wavelength_nm=550
  rig fit table.csv --column value=counts --column theta_r=angle"""
)
@click.argument("run_or_file", required=False, metavar="[RUN|FILE.csv]")
@click.option("--cultivar", metavar="ABBR", help="Fit the newest complete run of this cultivar.")
@click.option(
    "--weights",
    type=click.Choice(["relative", "plain", "sigma"]),
    default="relative",
    show_default=True,
    help="What the least squares minimise.",
)
@click.option(
    "--aspect", type=click.FloatRange(0.01, 10), default=0.5, show_default=True, help="Height over width of the domes; 0.5 is a hemisphere."
)
@click.option(
    "--column", "columns", multiple=True, metavar="QUANTITY=NAME", help="FILE: which column holds theta_i, theta_r, value or sigma."
)
@click.option("--where", "wheres", multiple=True, metavar="COLUMN=VALUE", help="FILE: use only these rows.")
@click.option(
    "--theta-i", type=click.FloatRange(0, 90, max_open=True), metavar="DEG", help="FILE: the incidence, where no column holds it."
)
@click.option(
    "--theta-r-positive",
    type=click.Choice(["light", "forward"]),
    default="light",
    show_default=True,
    help="FILE: the side where theta_r is positive.",
)
@click.option(
    "--quantity",
    type=click.Choice(["auto", "intensity", "reflectance-factor", "brdf"]),
    default="auto",
    show_default=True,
    help="FILE: what the values are; auto: from the column's name.",
)
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_obj
def command(
    settings: Settings,
    run_or_file: str | None,
    cultivar: str | None,
    weights: "Weights",
    aspect: float,
    columns: tuple[str, ...],
    wheres: tuple[str, ...],
    theta_i: float | None,
    theta_r_positive: Literal["light", "forward"],
    quantity: Literal["auto", "intensity", "reflectance-factor", "brdf"],
    as_json: bool,
) -> None:
    """Fit the paper's four coefficients to RUN, or to a table of others; print and store them."""
    if (run_or_file is None) == (cultivar is None):
        raise ConfigError("name one thing to fit: a run (`latest`), a table (FILE.csv), or --cultivar ABBR")
    from fitting.measurements import read_csv
    from fitting.mixture import fit_mixture

    if run_or_file is not None and _is_table(run_or_file):
        path = Path(run_or_file)
        measurements = read_csv(
            path,
            columns=_pairs(columns, "--column") | ({} if theta_i is None else {"theta_i": theta_i}),
            where=_pairs(wheres, "--where"),
            theta_r_positive=theta_r_positive,
            quantity=None if quantity == "auto" else quantity,
        )
        stored = new_fit(_label(path), False, provenance_of_file(path), fit_mixture(measurements, aspect=aspect, weights=weights))
    else:
        if columns or wheres or theta_i is not None or theta_r_positive != "light" or quantity != "auto":
            raise ConfigError("--column, --where, --theta-i, --theta-r-positive and --quantity are for tables (FILE.csv), not for runs")
        run = _find(settings, run_or_file, cultivar)
        stored = fit_run(run, weights, aspect)
    path = store_fit(settings.workspace.fits, stored)
    click.echo(json.dumps(stored.to_dict()) if as_json else fit_table(stored))
    click.echo(f"stored in {path}", err=True)


def fit_run(run: Run, weights: "Weights" = "relative", aspect: float = 0.5) -> StoredFit:
    """Return the fit of `run`, not stored yet."""
    from fitting.mixture import fit_mixture

    fit = fit_mixture(measurements_of(run), aspect=aspect, weights=weights)
    return new_fit(run.cultivar, run.simulated, provenance_of_run(run), fit)


def _find(settings: Settings, wanted: str | None, cultivar: str | None) -> Run:
    if wanted is not None:
        return find_run(settings.workspace.runs, wanted)
    assert cultivar is not None
    find_cultivar(load_cultivars(settings.workspace.cultivars), cultivar)
    return latest_run(settings.workspace.runs, cultivar)


def _is_table(name: str) -> bool:
    path = Path(name)
    if path.is_file():
        return True
    if path.suffix.lower() in (".csv", ".txt", ".dat", ".tsv"):
        raise RunError(f"{name}: no such file")
    return False


def _pairs(options: tuple[str, ...], name: str) -> dict[str, str]:
    pairs = {}
    for option in options:
        key, equals, value = option.partition("=")
        if not (key and equals and value):
            raise ConfigError(f"{name} {option!r}: expected NAME=VALUE")
        pairs[key] = value
    return pairs


def _label(path: Path) -> str:
    return "".join(c if c.isalnum() or c == "-" else "-" for c in path.stem) or "table"
