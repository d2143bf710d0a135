"""`rig fit`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.settings import Settings
from rig.cultivars import find_cultivar, load_cultivars
from rig.errors import ConfigError, RunError
from rig.fitjobs import Job, Specimen, fit_specimen, fit_together, specimen_of_runs, specimen_of_table
from rig.fits import StoredFit, store_fit
from rig.models import kept_traces
from rig.progress import steps
from rig.runs import Run, find_run, latest_run
from rig.tables import comparison_table, fit_table

if TYPE_CHECKING:
    from fitting.compare import Comparison
    from fitting.linear import Weights
    from fitting.measurements import Measurements
    from fitting.search import Range

MODELS = ("lambert", "phong", "ggx", "paper", "radiometric", "interreflecting", "body")
"""The ladder's names; `fitting.ladder` knows them, and is imported only to fit."""

KNOWN = ("t_u", "t_s", "k_u_diff", "k_u_spec", "k_s_diff", "k_s_spec")
TABLES = (".csv", ".txt", ".dat", ".tsv", ".alta", ".pab", ".xml", ".binary", ".bsdf")


@click.command(
    epilog="""\b
Examples:
  rig fit latest
  rig fit --cultivar RR --aspect 1.9
  rig fit --cultivar RR --compare                         the ladder of models, and which of them the data support
  rig fit --cultivar RR --model auto                      that one
  rig fit --cultivar RR --find aspect --find n_us=5:100   the cells' shape too
  rig fit --cultivar BR --cultivar RR --cultivar PR --joint --find all   one shape for all of them
  rig fit leaf.csv --theta-r-positive forward --where theta_i_deg=40 --where wavelength_nm=550
  rig fit retro-gray-tape.dat --model ggx
  rig fit latest --acceptance 1.5 --known t_u=0.4"""
)
@click.argument("sources", nargs=-1, metavar="[RUN|FILE]...")
@click.option("--cultivar", "cultivars", metavar="ABBR", multiple=True, help="Fit the newest complete run of this cultivar.")
@click.option("--model", type=click.Choice([*MODELS, "auto"]), default="paper", show_default=True, help="auto: the one the data support.")
@click.option("--compare", "compared", is_flag=True, help="Fit every model of the ladder and say which the data support.")
@click.option("--joint", is_flag=True, help="Cultivars share one shape.")
@click.option(
    "--find",
    "finds",
    multiple=True,
    metavar="NAME[=LOW:HIGH]",
    help="Search for a shape number: aspect, n_us, n_ss, albedo, mu, R_m, n, alpha; all of these: all; none: none. Profile: p, q.",
)
@click.option("--hold", "holds", multiple=True, metavar="NAME=VALUE", help="Hold a shape number.")
@click.option("--aspect", type=click.FloatRange(0.01, 10), help="Hold the height over width of the domes [usual: 0.5, hemispheres].")
@click.option(
    "--weights",
    type=click.Choice(["relative", "plain", "sigma", "covariance"]),
    default="relative",
    show_default=True,
    help="What the least squares minimise.",
)
@click.option("--acceptance", type=float, default=0.0, metavar="DEG", help="Half-angle of the detector's cone.")
@click.option("--beam", type=float, default=0.0, metavar="DEG", help="Half-angle of the lamp's cone.")
@click.option("--spot", type=float, default=0.0, metavar="MM", help="Diameter of the spot seen; needs a distance.")
@click.option("--lamp-at", type=float, metavar="MM", help="Distance of the lamp.")
@click.option("--detector-at", type=float, metavar="MM", help="Distance of the detector.")
@click.option(
    "--sees", type=click.Choice(["patch", "spot"]), default="patch", show_default=True, help="A patch in the light, or all of it."
)
@click.option(
    "--known", "knowns", multiple=True, metavar="NAME=VALUE", help=f"Solve eqs. (9) to (12) with what is known: {', '.join(KNOWN)}."
)
@click.option("--white", type=float, metavar="VALUE", help="What a perfect diffuser, lit along its normal, would have read.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the search for a shape.")
@click.option(
    "--column", "columns", multiple=True, metavar="QUANTITY=NAME", help="FILE: which column holds theta_i, theta_r, phi, value or sigma."
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
@click.option(
    "--repeats",
    type=click.Choice(["refuse", "keep", "mean"]),
    default="refuse",
    show_default=True,
    help="FILE: what to do with a geometry that is there more than once.",
)
@click.option("--covariance", type=click.Path(path_type=Path), metavar="FILE", help="FILE: the readings' covariance, a square table.")
@click.option("--channel", metavar="NAME", help="FILE of several channels: which.")
@click.option("--param-out", metavar="NAME", help="FILE in ALTA's form: what the values are, where it does not say.")
@click.option("--theta-r-below", type=float, metavar="DEG", help="FILE in ALTA's form: leave out views at this angle and beyond.")
@click.option(
    "--most", type=click.IntRange(1), default=500, show_default=True, help="FILE: fit this many readings, drawn evenly; predict the others."
)
@click.option("--in-plane", is_flag=True, help="FILE: use only readings in the plane of incidence.")
@click.option("--page/--no-page", default=True, help="Write the fit's page, with figures, beside it.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_obj
def command(
    settings: Settings, sources: tuple[str, ...], cultivars: tuple[str, ...], joint: bool, page: bool, as_json: bool, **options: Any
) -> None:
    """Fit a reflection model to RUN, to runs, or to a table of others; print it, store it, and write its page.

    Runs of one cultivar are fitted together, of several each by itself, or with --joint by one shape. The coefficients come with 95 %
    intervals and with what the readings cannot tell. A shape that was searched for comes with an account of the search.
    """
    job = _job(options)
    specimens = _specimens(settings, sources, cultivars, options)
    white, knowns = options["white"], _numbers(options["knowns"], "--known")
    if unknown := set(knowns) - set(KNOWN):
        raise ConfigError(f"--known {sorted(unknown)[0]}: expected one of {', '.join(KNOWN)}")
    for stored, comparison in _fitted(settings, specimens, job, joint):
        path = store_fit(settings.workspace.fits, stored)
        solved = _solved(stored, white, knowns)
        if as_json:
            extra = {} if comparison is None else {"comparison": comparison.to_dict()}
            click.echo(json.dumps(stored.to_dict() | extra | solved))
        else:
            if comparison is not None:
                click.echo(comparison_table(comparison) + "\n")
            click.echo(fit_table(stored) + _solved_text(solved))
        click.echo(f"stored in {path}", err=True)
        if page:
            from rig.fitpage import write_page

            click.echo(f"page: {write_page(stored, path.parent, comparison)}", err=True)


def _job(options: dict[str, Any]) -> Job:
    from fitting.aperture import Aperture

    shape: dict[str, Range] = dict(_numbers(options["holds"], "--hold"))
    if options["aspect"] is not None:
        shape["aspect"] = options["aspect"]
    searched: list[str] = []
    for find in options["finds"]:
        name, equals, ends = find.partition("=")
        searched.append(name)
        if equals:
            shape[name] = _range(find, ends)
    aperture = Aperture(
        options["acceptance"], options["beam"], options["spot"], options["lamp_at"], options["detector_at"], options["sees"]
    )
    weights: Weights = options["weights"]
    return Job(options["model"], weights, shape, tuple(searched) or None, aperture, options["seed"], options["compared"])


def _fitted(settings: Settings, specimens: list[Specimen], job: Job, joint: bool) -> "list[tuple[StoredFit, Comparison | None]]":
    traces = kept_traces(settings.workspace)
    if joint:
        if job.compared or job.model == "auto":
            raise ConfigError("--joint fits one model that is named: --compare and --model auto are for one cultivar at a time")
        return [(stored, None) for stored in fit_together(specimens, job, traces)]
    found = []
    for specimen in specimens:
        with steps(f"fitting {specimen.label}") as bar:
            found.append(fit_specimen(specimen, job, traces, lambda share: bar(round(100 * share), 100, "")))
    return found


def _specimens(settings: Settings, sources: tuple[str, ...], cultivars: tuple[str, ...], options: dict[str, Any]) -> list[Specimen]:
    """Find what was named, runs of one cultivar together."""
    if not sources and not cultivars:
        raise ConfigError("name what to fit: a run (`latest`), a table (FILE.csv), or --cultivar ABBR")
    tables = [Path(source) for source in sources if _is_table(source)]
    if not tables and (told := _table_options(options)):
        raise ConfigError(f"{', '.join(told)}: for tables (FILE.csv), not for runs")
    runs: dict[str, list[Run]] = {}
    known = load_cultivars(settings.workspace.cultivars)
    found = [find_run(settings.workspace.runs, source) for source in sources if not _is_table(source)]
    found += [latest_run(settings.workspace.runs, find_cultivar(known, cultivar).abbreviation) for cultivar in cultivars]
    for run in found:
        runs.setdefault(run.cultivar, []).append(run)
    read = [specimen_of_table(path, _read(path, options), options["most"], options["seed"]) for path in tables]
    return [specimen_of_runs(some, settings.workspace.runs) for some in runs.values()] + read


def _table_options(options: dict[str, Any]) -> list[str]:
    """Name the options given that speak of tables."""
    usual: dict[str, Any] = {
        "columns": (),
        "wheres": (),
        "theta_i": None,
        "theta_r_positive": "light",
        "quantity": "auto",
        "repeats": "refuse",
    }
    usual |= {"most": 500, "in_plane": False} | dict.fromkeys(("covariance", "channel", "param_out", "theta_r_below"))
    names = {"columns": "--column", "wheres": "--where"}
    return [names.get(name, f"--{name.replace('_', '-')}") for name, value in usual.items() if options[name] != value]


def _read(path: Path, options: dict[str, Any]) -> "Measurements":
    m = _table(path, options)
    return m.take(m.in_plane) if options["in_plane"] else m


def _table(path: Path, options: dict[str, Any]) -> "Measurements":
    from fitting.formats.files import format_of
    from fitting.formats.measured import measurements_in
    from fitting.readings import read_csv

    if format_of(path) != "csv":
        wanted = {"param_out": options["param_out"], "theta_r_below_deg": options["theta_r_below"]}
        return measurements_in(path, channel=options["channel"], **{k: v for k, v in wanted.items() if v is not None})
    return read_csv(
        path,
        columns=_pairs(options["columns"], "--column") | ({} if options["theta_i"] is None else {"theta_i": options["theta_i"]}),
        where=_pairs(options["wheres"], "--where"),
        theta_r_positive=options["theta_r_positive"],
        quantity=None if options["quantity"] == "auto" else options["quantity"],
        repeats=options["repeats"],
        covariance=options["covariance"],
    )


def _solved(stored: StoredFit, white: float | None, knowns: dict[str, float]) -> dict[str, Any]:
    """Reflectances, and eqs. (9) to (12) as far as what is known goes."""
    fit, out = stored.fit, dict[str, Any]()
    if white is not None or fit.quantity != "intensity":
        out["reflectances"] = {name: list(values) for name, values in fit.reflectances(white).items()}
    if knowns:
        from fitting.layers import mixture_from

        out["layers"] = {name: list(ends) for name, ends in mixture_from(fit.x, **knowns).items()}
    return out


def _solved_text(solved: dict[str, Any]) -> str:
    lines = []
    if "reflectances" in solved:
        lines += ["", "reflectance at normal incidence, and 95 % interval:"]
        lines += [f"  {name:<9} {value:10.4g}   {low:.4g} to {high:.4g}" for name, (value, low, high) in solved["reflectances"].items()]
    if "layers" in solved:
        lines += ["", "eqs. (9) to (12) with what is known; a range where that is too little:"]
        lines += [f"  {name:<9} {low:10.4g}" + ("" if low == high else f" to {high:.4g}") for name, (low, high) in solved["layers"].items()]
    return "\n".join(["", *lines]) if lines else ""


def _is_table(name: str) -> bool:
    path = Path(name)
    if path.is_file():
        return True
    if path.suffix.lower() in TABLES:
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


def _numbers(options: tuple[str, ...], name: str) -> dict[str, float]:
    try:
        return {key: float(value) for key, value in _pairs(options, name).items()}
    except ValueError as exc:
        raise ConfigError(f"{name}: {exc}; expected NAME=NUMBER") from exc


def _range(option: str, ends: str) -> tuple[float, float]:
    low, _, high = ends.partition(":")
    try:
        return float(low), float(high)
    except ValueError as exc:
        raise ConfigError(f"--find {option!r}: expected NAME=LOW:HIGH, such as aspect=0.3:2.5") from exc
