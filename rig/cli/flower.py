"""`rig flower`."""

import importlib.resources
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.view import browser_option, port_option, serve
from rig.errors import ConfigError
from rig.progress import steps

if TYPE_CHECKING:
    from scanning.assemble import Assembly


@click.group(epilog="\b\nExamples:\n  rig flower new rose\n  rig flower check rose\n  rig flower assemble rose\n  rig flower edit rose")
def command() -> None:
    """Put scanned petals together into a flower."""


@command.command("new", epilog="\b\nExample:\n  rig flower new rose && rig scan import scans/*.abs --flower rose")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--name", help="The flower's name [default: the folder's].")
def new(folder: Path, name: str | None) -> None:
    """Make a flower's folder, with a commented placement.toml to fill in."""
    from scanning.flower import new as make

    make(folder, name or folder.resolve().name)
    text = importlib.resources.files("rig").joinpath("data/placement.toml").read_text(encoding="utf-8")
    (folder / "placement.toml").write_text(text, encoding="utf-8")
    click.echo(f"{folder}: next, rig scan import FILES --flower {folder}, and fill in {folder / 'placement.toml'}", err=True)


@command.command("check", epilog="\b\nExample:\n  rig flower check rose")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def check(folder: Path, as_json: bool) -> int:
    """List all that keeps a flower from being put together, each with its line; exit code 1 where there is anything."""
    from scanning.flower import petal_names
    from scanning.placement import examine

    _, problems = examine(folder / "placement.toml", petal_names(folder))
    if as_json:
        click.echo(json.dumps([{"file": p.source, "line": p.line, "problem": p.text} for p in problems]))
    else:
        for problem in problems:
            click.echo(str(problem))
        click.echo(f"{len(problems)} problems" if problems else "nothing wrong", err=True)
    return 1 if problems else 0


@command.command("assemble", epilog="\b\nExamples:\n  rig flower assemble rose\n  rig flower assemble rose --seed 3 --json")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the choice of vertices that are looked at.")
@click.option("--discard-edits", is_flag=True, help="Assemble although petals were moved by hand since.")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def assemble(folder: Path, seed: int, discard_edits: bool, as_json: bool) -> int:
    """Find every petal's T and alpha of eq. (14); exit code 1 where petals still pass through each other."""
    from rig.flowerpages import moved_by_hand

    if not discard_edits and (moved := moved_by_hand(folder)):
        raise ConfigError(f"{folder}: moved by hand: {', '.join(moved)}; --discard-edits assembles anew without that work")
    assembly = put_together(folder, seed)
    if as_json:
        click.echo((folder / "assembly.json").read_text(encoding="utf-8"))
    else:
        click.echo(assembly_table(assembly))
    return 0 if assembly.state == "free" else 1


@command.command("edit", epilog="\b\nExamples:\n  rig flower edit rose\n  rig flower edit rose --port 8080 --no-browser")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@port_option
@browser_option
def edit(folder: Path, port: int, no_browser: bool) -> None:
    """Move and turn petals by hand on a page of this machine, until Ctrl-C; its Save button writes assembly.json."""
    from rig.flowerpages import edit as open_editor

    page, notes = open_editor(folder, port=port)
    serve(page, notes, browser=not no_browser, unsaved=lambda: page.unsaved)


def put_together(folder: Path, seed: int = 0) -> "Assembly":
    """Assemble with a progress bar."""
    from scanning.flower import put_together as assemble_folder

    with steps("putting together") as progress:
        return assemble_folder(folder, seed=seed, progress=lambda word, share: progress(round(100 * share), 100, word))


def assembly_table(assembly: "Assembly") -> str:
    """Return what came out of an assembly, as lines."""
    from scanning.assemble import MEASUREMENTS

    lines = [f"{'petal':<8}{'stem_angle':>12}{'azimuth':>10}" + "".join(f"{name:>13}" for name in MEASUREMENTS)]
    rows = zip(assembly.names, assembly.stem_angle, assembly.azimuth, assembly.residuals, strict=True)
    lines += [
        f"{name:<8}{stem:>12.2f}{azimuth:>10.2f}" + "".join(f"{r:>13.2f}" for r in residuals) for name, stem, azimuth, residuals in rows
    ]
    lines.append("columns 4 on: assembled less measured, in standard uncertainties (base_side and roll: less 0)")
    if assembly.state == "free":
        lines.append(f"no two petals intersect; clearance {assembly.clearance:.3f} mm; {assembly.seconds:.1f} s")
    else:
        pairs = ", ".join(f"{a}-{b}" for a, b in assembly.intersecting)
        lines.append(f"NOT FREE: {pairs} still pass through each other; the best state found is kept and marked")
    lines += [f"in conflict: {conflict}" for conflict in assembly.conflicts]
    return "\n".join(lines)
