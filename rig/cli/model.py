"""`rig model`."""

import csv
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.settings import Settings
from rig.errors import ConfigError
from rig.trajectory import parse_angles

if TYPE_CHECKING:
    from fitting.cells import Cell
    from fitting.model import Model

MODES = ("paper", "radiometric", "interreflecting", "body")
FORMATS = ("png", "svg")


class WithNumbers(click.Command):
    """Lists what `--set` takes below the options; the model is imported only for that."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the numbers, then the examples."""
        from fitting.model import NUMBERS

        with formatter.section("Numbers for --set"):
            for mode, numbers in NUMBERS.items():
                words = [f"{x.name}{f' [{x.unit}]' if x.unit else ''} {x.meaning}{_usual(x.usual)}" for x in numbers]
                formatter.write_dl([(mode, "; ".join(words))])
        super().format_epilog(ctx, formatter)


def _usual(usual: float | str | None) -> str:
    return "" if usual is None else f" (default {usual if isinstance(usual, str) else format(usual, 'g')})"


GEOMETRY = (
    click.option(
        "--aspect",
        type=click.FloatRange(0.01, 10),
        default=0.5,
        show_default=True,
        help="Height over width of the domes; 0.5 is a hemisphere.",
    ),
    click.option("--p", type=click.FloatRange(1, 100), default=2.0, show_default=True, help="Profile z = h (1 - (r/a)^p)^(1/q): p."),
    click.option("--q", type=click.FloatRange(1, 100), default=2.0, show_default=True, help="The same: q; 2 and 2 is an ellipsoid."),
    click.option("--gap", type=click.FloatRange(0, 10), default=0.0, show_default=True, help="Flat floor between domes, over their width."),
    click.option("--height-spread", type=float, default=0.0, metavar="SHARE", help="Domes differ in height by up to this share of it."),
    click.option("--tilt", type=float, default=0.0, metavar="DEG", help="Domes lean by up to this."),
    click.option("--place", type=float, default=0.0, metavar="A", help="Domes stand off their places by up to this, in base radii."),
    click.option("--spread-seed", type=click.IntRange(0), default=0, metavar="N", help="Which domes differ how."),
    click.option("--n-us", type=float, default=40.0, show_default=True, help="Exponent of the epidermis' lobe; not in body."),
    click.option("--n-ss", type=float, default=5.0, show_default=True, help="Exponent of the spongy tissue's lobe; not in body."),
    click.option(
        "--lower-aspect",
        type=click.FloatRange(0.01, 10),
        metavar="ASPECT",
        help="body: domes on the far face, too, of the same profile and gap [default: flat].",
    ),
    click.option("--depth", type=float, default=1.0, show_default=True, help="body: pigmented slab below the domes, in base radii."),
    click.option("--index", type=float, default=1.4, show_default=True, help="body: refractive index of the cells."),
    click.option(
        "--grid", default="30x36", show_default=True, metavar="THETAxPHI", help="Steps of theta to 90 deg and phi to 180 in the table."
    ),
)
NUMBER = click.option("--set", "sets", multiple=True, metavar="NAME=VALUE", help="A number of the cultivar; repeatable, see below.")


def geometry(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that make a cell and what is tabulated of it, one set for all verbs."""
    for option in reversed(GEOMETRY):
        command = option(command)
    return command


@click.group(
    epilog="""\b
Examples:
  rig model eval --mode paper --theta-i 45 --theta-r -70:70:10
  rig model build --mode body --aspect 1.9 --out rose.npz
  rig model show"""
)
def command() -> None:
    """Evaluate, build and draw the reflection model itself."""


@command.command(
    "eval",
    cls=WithNumbers,
    epilog="""\b
Examples:
  rig model eval --mode paper --theta-i 45 --theta-r -70:70:10
  rig model eval --aspect 1.9 > r.csv
  rig model eval --mode radiometric --aspect 1.9 --phi 90 --theta-r 0:80:10
  rig model eval --mode radiometric --aspect 1.2 --p 1.3 --q 1.6 --gap 0.1
  rig model eval --mode interreflecting --set albedo=0.6 --set u_spec=0.02
  rig model eval --mode body --set mu=0.2 --set R_m=0.5 --set T_m=0.3 --theta-r -160:160:20""",
)
@click.option(
    "--mode",
    type=click.Choice(MODES),
    default="paper",
    show_default=True,
    help="The paper's four r' of eq. (7); single bounce in 1/sr, floor and foreshortening included; all bounces; or body light.",
)
@click.option("--theta-i", default="45", show_default=True, metavar="DEG", help="Angle of the light.")
@click.option(
    "--theta-r",
    default="-70:70:10",
    show_default=True,
    metavar="DEG",
    help="Angles of the view, positive on the light's side; body: beyond 90 behind the petal.",
)
@click.option("--phi", default=0.0, show_default=True, metavar="DEG", help="Azimuth of the view from the light's; 0 is in plane.")
@geometry
@NUMBER
@click.pass_obj
def evaluate(settings: Settings, mode: str, theta_i: str, theta_r: str, phi: float, sets: tuple[str, ...], **options: Any) -> None:
    """Write the model's terms as CSV to stdout: r' or 1/sr each; with --set weighted, and their sum.

    The sum is f_r, 1/sr, or in the mode paper I, the intensity of eq. (8).
    """
    import numpy as np

    incidences, views = parse_angles(theta_i, "--theta-i"), parse_angles(theta_r, "--theta-r")
    cell, build = _cell(options), _build(options)
    light, view = (np.asarray(along, float) for along in np.meshgrid(incidences, views, indexing="ij"))
    if mode in ("paper", "radiometric"):
        columns = _exact_terms(mode, cell, light, view, phi, build["n_us"], build["n_ss"])
        if sets:
            x = _numbers(mode, sets)
            columns = {name: x[name] * column for name, column in columns.items()}
            columns["I" if mode == "paper" else "f_r"] = np.sum(list(columns.values()), axis=0)
    else:
        x = _numbers(mode, sets)
        from rig.models import stored_model

        model = stored_model(settings.workspace, mode, cell, **build)
        columns = _body_parts(model, x, light, view, phi) if mode == "body" else _weighted_parts(model, x, light, view, phi)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    several = len(incidences) > 1
    writer.writerow([*(["theta_i_deg"] if several else []), "theta_r_deg", *columns])
    for i, r, *row in zip(light.ravel(), view.ravel(), *(column.ravel() for column in columns.values()), strict=True):
        writer.writerow([*([f"{i:g}"] if several else []), f"{r:g}", *(f"{value:.6g}" for value in row)])


@command.command(
    "build",
    cls=WithNumbers,
    epilog="""\b
Examples:
  rig model build --mode radiometric --out hemispheres.npz
  rig model build --mode interreflecting --aspect 1.9 --gap 0.1 --out rose.npz --set albedo=0.9
  rig model build --mode body --aspect 1.9 --lower-aspect 0.5 --depth 2 --out body.npz --json""",
)
@click.option("--mode", type=click.Choice(MODES), required=True, help="Which physics; see rig model eval.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE.npz", help="Where to write it.")
@geometry
@NUMBER
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def build(mode: str, out: Path, sets: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Work a model out and write it to one file, for any cultivar afterwards; say what came out.

    Albedo and reciprocity are those of the numbers of --set, by default of a pale petal.
    """
    x = _numbers(mode, sets)
    from rig.models import built, store_model

    started = time.perf_counter()
    model = built(mode, _cell(options), **_build(options))
    seconds = time.perf_counter() - started
    store_model(model, out)
    mixed = model.reflectance(**x)
    albedo = {str(theta): float(mixed.albedo(theta)) for theta in (0, 45, 70)}
    said: dict[str, Any] = {
        "file": str(out),
        "bytes": out.stat().st_size,
        "mode": mode,
        "seconds": round(seconds, 2),
        "numbers": x,
        "albedo": albedo,
        "reciprocity": mixed.reciprocity(),
    }
    if mode == "body":
        through = model.transmittance(direct=True, **x)
        said["transmitted"] = {theta: float(through.albedo(float(theta))) for theta in albedo}
    if as_json:
        click.echo(json.dumps(said))
        return
    click.echo(f"{out}: {mode} model, {said['bytes'] / 1e6:.1f} MB, {seconds:.1f} s")
    click.echo(f"with {_words(x)}:")
    click.echo(f"  {'albedo at 0, 45, 70 deg':<28}" + "".join(f"{value:9.4f}" for value in albedo.values()))
    if "transmitted" in said:
        click.echo(f"  {'transmitted at 0, 45, 70 deg':<28}" + "".join(f"{value:9.4f}" for value in said["transmitted"].values()))
    click.echo(f"  {'departure from reciprocity':<28}{said['reciprocity']:9.2g}  (rms, of the mean)")


@command.command(
    "show",
    cls=WithNumbers,
    epilog="""\b
Examples:
  rig model show
  rig model show --mode body --aspect 1.9 --set mu=1 --set R_m=0.4 --set T_m=0.2
  rig model show --mode interreflecting --theta-i 60 --out pages/ --json
  rig model show rose.npz --width 25 --format svg""",
)
@click.argument("file", required=False, metavar="[FILE.npz]", type=click.Path(path_type=Path))
@click.option("--mode", type=click.Choice(MODES), help="Draw this one [default: paper, and all four side by side].")
@click.option("--theta-i", type=click.FloatRange(0, 85), default=45.0, show_default=True, metavar="DEG", help="Angle of the light.")
@click.option("--width", type=click.FloatRange(0, min_open=True), default=20.0, show_default=True, metavar="UM", help="Width of a cell.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Where to draw [default: in figures/].")
@click.option("--format", "formats", type=click.Choice(FORMATS), multiple=True, help="Draw as this; repeatable [default: both].")
@geometry
@NUMBER
@click.option("--json", "as_json", is_flag=True, help="For programs: paths and the ablation's table.")
@click.pass_context
def show(
    ctx: click.Context,
    file: Path | None,
    mode: str | None,
    theta_i: float,
    width: float,
    out: Path | None,
    formats: tuple[str, ...],
    sets: tuple[str, ...],
    as_json: bool,
    **options: Any,
) -> None:
    """Draw cell, lobes, shape and ablation (what each term changes) of a model as PNG and SVG; print the ablation's table."""
    settings: Settings = ctx.obj
    from rig.models import model_path, stored_model

    if file is not None:
        given = [name for name in (*options, "mode") if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE]
        if given:
            raise ConfigError(f"{file} holds mode and geometry: leave out --{given[0].replace('_', '-')}")
        from fitting.model import load

        model = load(file)
        others, name = {}, file.stem
    else:
        cell, build = _cell(options), _build(options)
        wanted = mode or "paper"
        _numbers(wanted, sets)  # before anything is built
        model = stored_model(settings.workspace, wanted, cell, **build)
        others = {} if mode else {m: stored_model(settings.workspace, m, cell, **build) for m in MODES if m != wanted}
        name = model_path(settings.workspace, wanted, cell, **build).stem
    from rig.modelfigures import ablation_table, ablations, draw_model

    x = _numbers(model.mode, sets)
    folder = out or settings.workspace.figures / f"model-{name}"
    parts = ablations(model, x, theta_i, others)
    kinds = tuple(kind for kind in FORMATS if kind in (formats or FORMATS))
    written = draw_model(model, x, folder, theta_i=theta_i, width=width, others=others, ablations=parts, formats=kinds)
    if as_json:
        click.echo(json.dumps({"files": [str(path) for path in written], "numbers": x, "ablation": [part.to_dict() for part in parts]}))
        return
    for path in written:
        click.echo(path)
    for part in parts:
        click.echo(f"\n{ablation_table(part)}")


def _cell(options: dict[str, Any]) -> "Cell":
    """Return the cell that the options describe."""
    from fitting.cells import Cell, Spread
    from fitting.errors import DomainError

    try:
        spread = Spread(options["height_spread"], options["tilt"], options["place"], options["spread_seed"])
        return Cell(options["aspect"], options["p"], options["q"], options["gap"], spread)
    except DomainError as exc:
        raise ConfigError(str(exc)) from exc


def _build(options: dict[str, Any]) -> dict[str, Any]:
    """Return the other settings of a model that the options give."""
    from fitting.cells import Cell
    from fitting.table import Grid

    words = options["grid"].split("x")
    if len(words) != 2 or not all(word.isdecimal() and int(word) > 2 for word in words):
        raise ConfigError(f"--grid {options['grid']}: expected two whole numbers of 3 or more, such as 30x36")
    lower = options["lower_aspect"]
    return {
        "n_us": options["n_us"],
        "n_ss": options["n_ss"],
        "lower": None if lower is None else Cell(lower, options["p"], options["q"], options["gap"]),
        "depth": options["depth"],
        "n": options["index"],
        "grid": Grid(int(words[0]), int(words[1])),
    }


def _numbers(mode: str, sets: tuple[str, ...]) -> dict[str, float]:
    """Return the cultivar's numbers: those of `--set`, with the usual ones filled in; a pale petal where none is given."""
    from fitting.errors import DomainError
    from fitting.model import chosen
    from rig.models import PETAL

    given = {}
    for text in sets:
        name, _, value = text.partition("=")
        try:
            given[name] = float(value)
        except ValueError:
            raise ConfigError(f"--set {text!r}: expected NAME=VALUE with a number, such as --set {next(iter(PETAL[mode]))}=0.5") from None
    try:
        return chosen(mode, given if sets else PETAL[mode])
    except DomainError as exc:
        raise ConfigError(f"--set: {exc}") from exc


def _words(x: dict[str, float]) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in x.items())


def _exact_terms(mode: str, cell: "Cell", light: Any, view: Any, phi: float, n_us: float, n_ss: float) -> dict[str, Any]:
    """Return the four terms, integrated for each direction."""
    from fitting.cells import Cell
    from fitting.paper import TERMS, paper_terms
    from fitting.radiometric import paper_terms_any, radiometric_terms

    if mode == "radiometric":
        terms = radiometric_terms(light.ravel(), view.ravel(), phi, cell=cell, n_us=n_us, n_ss=n_ss)
    elif phi == 0 and cell == Cell(cell.aspect):  # in plane there is a sharper rule
        terms = paper_terms(light.ravel(), view.ravel(), aspect=cell.aspect, n_us=n_us, n_ss=n_ss)
    else:
        terms = paper_terms_any(light.ravel(), view.ravel(), phi, cell=cell, n_us=n_us, n_ss=n_ss)
    return {name: column.reshape(light.shape) for name, column in zip(TERMS, terms.T, strict=True)}


def _weighted_parts(model: "Model", x: dict[str, float], light: Any, view: Any, phi: float) -> dict[str, Any]:
    """Return the basis functions times their weights, and the mixture."""
    table, weights = model.parts(**x)
    found = {name: weights[name] * table.alone(name)(light, view, phi) for name in table.names}
    return found | {"f_r": model.reflectance(**x)(light, view, phi)}


def _body_parts(model: "Model", x: dict[str, float], light: Any, view: Any, phi: float) -> dict[str, Any]:
    """Return what is reflected on the light's side and what is sent through behind, not interpolated."""
    import numpy as np

    assert model.body is not None
    body, tissue = model.body, x
    behind = np.abs(view) > 90
    parts = {name: np.zeros(view.shape) for name in ("mirror", "stray", "body", "scattered", "direct")}
    i, r = light[~behind], view[~behind]
    parts["mirror"][~behind] = body.mirror_reflectance(i, r, phi)
    parts["stray"][~behind] = body.stray_reflectance(i, r, phi, mu=tissue["mu"])
    parts["body"][~behind] = body.body_reflectance(i, r, **tissue)
    i, r = light[behind], view[behind]
    parts["scattered"][behind] = body.transmittance(i, r, direct=False, **tissue)
    parts["direct"][behind] = body.transmittance(i, r, direct=True, **tissue) - parts["scattered"][behind]
    return parts | {"f_r": np.sum(list(parts.values()), axis=0)}
