"""`rig brdf`."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.settings import Settings
from rig.errors import ConfigError, RunError
from rig.progress import steps
from rig.tables import SIMULATED

if TYPE_CHECKING:
    from fitting.formats.files import Data
    from fitting.formats.grid import Function

KINDS = ("merl", "rgl", "zemax", "klems", "alta", "pab", "csv")
"""What --from and --to take; `fitting.formats.files` knows them, and is imported only to read and write."""

READING = (
    click.option("--from", "source", type=click.Choice(KINDS), help="What the file is [default: its content tells]."),
    click.option("--white", type=float, metavar="VALUE", help="A fit of relative readings: what the perfect diffuser would have read."),
    click.option("--through", is_flag=True, help="A matrix of XML: what goes through rather than what is reflected."),
    click.option("--param-out", metavar="NAME", help="ALTA: what the values are, where the file does not say, such as INV_STERADIAN."),
    click.option("--theta-r-below", type=float, metavar="DEG", help="ALTA: leave out views at this angle and beyond."),
)
CHANNEL_HELP = "The channel to take, such as G; what there is, `rig brdf info` tells."
BEYOND_HELP = "What lies beyond the end of the readings, where OUT is to hold the whole hemisphere."


def reading(command: Any) -> Any:
    """Add the options that say how a file is read, one set for both verbs."""
    for option in reversed(READING):
        command = option(command)
    return command


@click.group(
    epilog="""\b
Formats:
  merl   .binary       MERL: isotropic, R G B, reflection; read and written
  rgl    .bsdf         RGL tensors, for Mitsuba and pbrt; read and written
  klems  .xml          Klems matrices, for Radiance and WINDOW; read and written
  alta   .alta .dat    ALTA text, readings with error bars; read and written
  pab    .pab .txt     pab text, one file for each incidence; read and written
  csv    .csv          columns with names; read and written
  zemax  .zemax.bsdf   Zemax tabular BSDF; written

\b
Examples:
  rig brdf info petal.bsdf
  rig brdf convert merl/red-fabric.binary red-fabric.bsdf
  rig brdf convert 2026-05-04_RR_1a2b3c4d RR.xml --white 12.5"""
)
def command() -> None:
    """Convert files of reflectance, and fits, for other programs."""


@command.command(
    "convert",
    epilog="""\b
Examples:
  rig brdf convert red-fabric.binary red-fabric.bsdf
  rig brdf convert leaf.csv leaf.alta
  rig brdf convert leaf.alta leaf.bsdf --beyond nearest
  rig brdf convert red-fabric.binary red.xml --channel R
  rig brdf convert petal_t*.pab petal.csv
  rig brdf convert RR RR.bsdf --white 12.5         the newest fit of RR""",
)
@click.argument("sources", nargs=-1, required=True, metavar="IN...")
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False))
@reading
@click.option("--to", "kind", type=click.Choice(KINDS), help="What to write [default: OUT's ending tells; .bsdf is rgl].")
@click.option("--channel", metavar="NAME", help=CHANNEL_HELP)
@click.option("--beyond", type=click.Choice(["refuse", "nearest", "zero"]), default="refuse", show_default=True, help=BEYOND_HELP)
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_obj
def convert(
    settings: Settings,
    sources: tuple[str, ...],
    out: Path,
    kind: str | None,
    channel: str | None,
    beyond: Any,
    as_json: bool,
    **options: Any,
) -> None:
    """Write IN, a file or a fit (its file, its name, or a cultivar), as OUT. Several IN are one sample's pab files.

    What OUT cannot carry is said in one line. Readings end short of 90 deg, and MERL, RGL, Klems and Zemax files hold the whole hemisphere:
    unless --beyond says what lies there they are not written, but for a MERL file, which can mark what is missing. `nearest` goes on with
    the last value towards grazing angles; `zero` writes none and so loses light.
    """
    from fitting.formats.files import ChannelError, write_any
    from fitting.formats.hemisphere import BeyondError

    started = time.perf_counter()
    found, data, name = _found(settings, sources, options)
    try:
        with steps("writing") as progress:
            written = write_any(
                out, data, kind, channel=channel, beyond=beyond, name=name, progress=lambda share: progress(round(100 * share), 100, "%")
            )
    except BeyondError as exc:
        raise ConfigError(f"{exc} (--beyond nearest, --beyond zero)") from exc
    except ChannelError as exc:
        raise ConfigError(f"{exc} (--channel NAME)") from exc
    notes = [*written.notes, *(_of_a_fit(data, name, written.format) if found == "fit" else ())]
    if notes:
        click.echo(f"{out}: {'; '.join(notes)}", err=True)
    if as_json:
        said = {
            "in": list(sources),
            "from": found,
            "out": [str(path) for path in written.paths],
            "to": written.format,
            "bytes": sum(path.stat().st_size for path in written.paths),
            "notes": notes,
            "seconds": round(time.perf_counter() - started, 3),
        }
        click.echo(json.dumps(said))
        return
    for path in written.paths:
        click.echo(path)


@command.command(
    "info",
    epilog="""\b
Examples:
  rig brdf info red-fabric.binary
  rig brdf info petal_t*.pab --json
  rig brdf info retro-gray-tape.dat --param-out INV_STERADIAN""",
)
@click.argument("sources", nargs=-1, required=True, metavar="FILE...")
@reading
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_obj
def info(settings: Settings, sources: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Say what FILE (or a fit) holds: format, size, axes, channels, range, albedo, what is negative or missing."""
    from fitting.formats.about import about

    kind, data, _ = _found(settings, sources, options)
    paths = [Path(source) for source in sources if Path(source).is_file()]
    said = {"in": list(sources), "format": kind, "bytes": sum(path.stat().st_size for path in paths), **about(data)}
    click.echo(json.dumps(said) if as_json else _text(said))


def _found(settings: Settings, sources: tuple[str, ...], options: dict[str, Any]) -> "tuple[str, Data | Function, str]":
    """Return the format of what was named, what it holds, and the name of the fit where it is one."""
    from fitting.formats.files import format_named, format_of, read_any

    white, paths = options["white"], [Path(source) for source in sources]
    missing = [path for path in paths if not path.is_file()]
    if missing and (len(paths) > 1 or format_named(missing[0]) is not None or len(missing[0].parts) > 1):
        raise RunError(f"{missing[0]}: no such file")
    if missing or (options["source"] is None and _is_json(paths[0])):
        return _fit(settings, sources[0], white)
    if white is not None:
        raise ConfigError(f"--white is for fits of relative readings, and {sources[0]} is a file in 1/sr")
    kind = options["source"] or format_of(paths[0])
    wanted = {"quantity": "btdf" if options["through"] else None}
    wanted |= {"param_out": options["param_out"], "theta_r_below_deg": options["theta_r_below"]}
    data = read_any(paths if len(paths) > 1 else paths[0], options["source"], **{k: v for k, v in wanted.items() if v is not None})
    return kind, data, ""


def _is_json(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip().startswith(b"{")
    except OSError as exc:
        raise RunError(f"{path}: cannot be read: {exc.strerror}") from exc


def _fit(settings: Settings, wanted: str, white: float | None) -> "tuple[str, Function, str]":
    from rig.brdfs import brdf_of
    from rig.pictures import find_fit

    stored = find_fit(settings.workspace.fits, wanted)
    return "fit", brdf_of(stored, settings.workspace, white), f"{f'{SIMULATED} ' if stored.simulated else ''}{stored.id}"


def _of_a_fit(fit: Any, name: str, kind: str) -> list[str]:
    """Return what must be said of a fit's file."""
    from fitting.formats.about import INCIDENCES
    from fitting.formats.hemisphere import albedo

    notes = [f"the file has no place for {SIMULATED}"] if name.startswith(SIMULATED) and kind == "merl" else []
    shares = {theta: float(albedo(fit, theta)[0]) for theta in INCIDENCES}
    most = max(shares, key=lambda theta: shares[theta])
    if shares[most] > 1:
        notes.append(f"sends back more light than falls on it, {shares[most]:.3g} times as much at theta_i {most:g} deg")
    return notes


def _text(said: dict[str, Any]) -> str:
    """Return what is known of a file, as lines."""
    names = ", ".join(said["channels"][:8]) + (f" ... ({len(said['channels'])})" if len(said["channels"]) > 8 else "")
    size = ", ".join(f"{count} {what}" for what, count in said["size"].items())
    kind = {"brdf": "reflection", "btdf": "transmission"}[said["quantity"]]
    parts = [said["format"], *([f"{said['bytes']} bytes"] if said["bytes"] else []), *([size] if size else [])]
    lines = [f"{' '.join(said['in'])}: {', '.join(parts)}"]
    lines.append(f"{kind}, channels {names}, {'with' if said['uncertainties'] else 'without'} uncertainties")
    lines += [f"  {name:<10} {a['first']:9.3f} to {a['last']:9.3f} deg, {a['count']:.0f}" for name, a in said["axes"].items()]
    theta_i, theta_r, phi = said["largest_at"]
    lines.append(
        f"values {said['least']:.4g} to {said['largest']:.4g} 1/sr, most at theta_i {theta_i:g}, theta_r {theta_r:g}, phi {phi:g} deg"
    )
    lines.append(f"{said['negative']} values below 0, {said['invalid']} missing")
    for at in said["albedo"]:
        shares = " ".join(f"{share:.4f}" for share in at["share"][:8])
        lines.append(f"  albedo at theta_i {at['theta_i']:g} deg, up to theta_r {at['to_theta_r']:g} deg: {shares}")
    if "no_albedo" in said:
        lines.append(f"no albedo: {said['no_albedo']}")
    return "\n".join(lines)
