"""`rig devices`."""

import json
import sys
from typing import Any

import click

from rig.cli.settings import Settings, trace_option
from rig.errors import ConfigError


@click.group(
    invoke_without_command=True,
    epilog="\b\nExamples:\n  rig devices\n  rig devices show zaber-x-rsw60a\n  rig devices probe",
)
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_context
def command(ctx: click.Context, as_json: bool) -> None:
    """List the supported models of instruments, those of installed packages included; show one, or probe the bench's."""
    if ctx.invoked_subcommand is not None:
        return
    from drivers import catalogue

    found = catalogue.load()
    if as_json:
        click.echo(
            json.dumps({"models": [_described(model) for model in found.models.values()], "problems": [str(p) for p in found.problems]})
        )
        return
    for model in sorted(found.models.values(), key=lambda model: (model.kind, model.name)):
        click.echo(f"{model.name:<22} {model.kind:<13} {model.vendor}: {model.description}; {model.protocol}")
    for problem in found.problems:
        click.echo(f"not usable: {problem}", err=True)


def _described(model: Any) -> dict[str, Any]:
    return {
        "name": model.name,
        "kind": model.kind,
        "vendor": model.vendor,
        "description": model.description,
        "protocol": model.protocol,
        "line": dict(model.line),
        "options": {
            key: {"type": option.type.__name__, "default": option.default, "description": option.description}
            for key, option in model.options.items()
        },
    }


@command.command("show", epilog="\b\nExample:\n  rig devices show oriental-az")
@click.argument("model")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
def show(model: str, as_json: bool) -> None:
    """Show what MODEL may be given in rig.toml: its options and line settings, with what holds when they are left out."""
    from drivers import catalogue
    from drivers.errors import UnknownModel

    try:
        found = catalogue.load().lookup(model)
    except UnknownModel as exc:
        raise ConfigError(str(exc)) from exc
    if as_json:
        click.echo(json.dumps(_described(found)))
        return
    click.echo(f"{found.vendor} {found.name}, {found.kind}: {found.description}; {found.protocol}")
    for key, option in found.options.items():
        value = "" if option.default is None else json.dumps(option.default)
        click.echo(f"  {key:<22} {value:<10} {option.description}")
    for key, value in found.line.items():
        click.echo(f"  {key:<22} {json.dumps(value):<10} of the line, as delivered")


@command.command("probe", epilog="\b\nExamples:\n  rig devices probe\n  rig devices probe --json --trace wires.jsonl")
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@trace_option
@click.pass_obj
def probe(settings: Settings, as_json: bool, trace: str | None) -> None:
    """Ask every instrument in rig.toml who it is and how it is. Nothing moves; meters are set up as for a sweep, and read once.

    The position of a stage is its own, as it counts; `rig status` says where that is on the bench.

    What does not answer is a line of the answer; the exit code is then 1.
    """
    from rig.cli.instruments import looking, mark, opened_config
    from rig.probing import probe_rows

    config = opened_config(settings)
    with looking(settings, config, trace=trace) as papers:
        rows = probe_rows(config, papers)
    if as_json:
        click.echo(json.dumps({"simulated": config.simulated, "devices": rows}))
    else:
        for row in rows:
            click.echo(f"{mark(config)}{_line(row)}")
    if any(row["error"] for row in rows):
        sys.exit(1)


def _line(row: dict[str, Any]) -> str:
    head = f"{row['name']} on {row['port']} ({row['configured']})"
    if row["error"]:
        return f"{head}: {row['error']}"
    identity = row["identity"]
    who = f"{identity['vendor']} {identity['model']}, serial number {identity['serial_number']}, firmware {identity['firmware']}"
    return f"{head}: {who}; {_state(row['state'])}"


def _state(state: dict[str, Any]) -> str:
    from rig.cli.instruments import shown

    parts = []
    if "own_position" in state:
        parts.append(f"own position {state['own_position']:g} {state['unit']}")
    elif "value" in state:
        parts.append(f"reads {shown(state)}")
    passed_over = {"own_position", "unit", "value", "good", "status", "flags"}
    return ", ".join([*parts, *(_said(key, value) for key, value in state.items() if key not in passed_over)])


def _said(key: str, value: Any) -> str:
    match value:
        case bool():
            return key if value else f"not {key}"
        case list():
            return f"{key} {' '.join(value) or 'none'}"
        case _:
            return f"{key} {value}"
