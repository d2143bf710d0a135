"""`rig sim`."""

import json
from pathlib import Path
from typing import Any

import click

from rig.cli.settings import Settings
from rig.errors import ConfigError


@click.group(epilog="\b\nExamples:\n  rig sim serve\n  rig sim serve newport apogee --json\n  rig sim replay wires.jsonl")
def command() -> None:
    """Serve simulated instruments to any software, over their own protocols."""


@command.command(
    "serve",
    epilog="""\b
Examples:
  rig sim serve                             all instruments
  rig sim serve stages meter --toml rig.toml   and in another window: rig home
  rig sim serve shot --fault shot:cut-short:7  one damaged reply or request, decided by the seed 7
  rig sim serve --names                     what there is""",
)
@click.argument("names", nargs=-1, metavar="[NAME]...")
@click.option("--names", "list_names", is_flag=True, help="List the instruments and the faults there are, and serve nothing.")
@click.option("--json", "as_json", is_flag=True, help="For programs: one line of JSON once all ports are open.")
@click.option("--specimen", default="RR", show_default=True, metavar="NAME", help="What lies on the bench: a cultivar, or lambert:ALBEDO.")
@click.option("--speed", default=1.0, show_default=True, metavar="X", help="Simulated seconds per second.")
@click.option("--seed", default=1, show_default=True, type=click.IntRange(0), help="Decides positions at power-up, drift and noise.")
@click.option("--source", metavar="NAME:AXIS", help="Which axis carries the lamp's arm [default: stages:1].")
@click.option("--detector", metavar="NAME:AXIS", help="Which axis carries the detector's arm [default: stages:2].")
@click.option(
    "--fault", "faults", multiple=True, metavar="NAME:KIND:SEED[:AFTER]", help="A fault that strikes once, after so many messages."
)
@click.option("--toml", metavar="FILE", help="Write a rig.toml for this bench, of stages and meter; all made with it says SIMULATED.")
@click.option("--no-pty", is_flag=True, help="TCP ports only.")
def serve(
    names: tuple[str, ...],
    list_names: bool,
    as_json: bool,
    specimen: str,
    speed: float,
    seed: int,
    source: str | None,
    detector: str | None,
    faults: tuple[str, ...],
    toml: str | None,
    no_pty: bool,
) -> None:
    """Start all simulated instruments, or those named, and say where each listens, until Ctrl-C or SIGTERM.

    Each has a socket and a pseudo-terminal. A pseudo-terminal takes any speed, parity and number of bits when it is opened, again and
    again, and ignores them. It cannot be asked for another parity or number of bits alone once it is open (EINVAL: give them together with
    the speed, when opening), nor opened again within a hundredth of a second by a client that said nothing, and has no modem lines.
    """
    from rig.replays import write_toml
    from sim.errors import SimError
    from sim.faults import KINDS
    from sim.serve import INSTRUMENTS, Settings, build, serving
    from sim.wire import beside

    if list_names:
        for name, description in INSTRUMENTS.items():
            click.echo(f"{name:<10} {description}")
        click.echo(f"faults: {', '.join(KINDS)}")
        return
    if toml is not None and Path(toml).exists():
        raise ConfigError(f"--toml {toml}: is there already")
    try:
        world = build(
            Settings(
                specimen=specimen,
                seed=seed,
                speed=speed,
                pty=not no_pty,
                instruments=names or tuple(INSTRUMENTS),
                source=source,
                detector=detector,
                faults=faults,
            )
        )
        with beside(serving(world), "simulated instruments") as report:
            if toml is not None:
                write_toml(Path(toml), _config(report, toml))
            _announce(report, as_json)
    except SimError as exc:
        raise ConfigError(str(exc)) from exc


@command.command(
    "replay",
    epilog="""\b
Examples:
  rig sim replay wires.jsonl --json
  rig --workspace again sim replay wires.jsonl --toml again.toml
      and in another window what was recorded: rig --workspace again --config again.toml home""",
)
@click.argument("trace", metavar="FILE")
@click.option("--json", "as_json", is_flag=True, help="For programs: one line of JSON once all ports are open.")
@click.option(
    "--toml", metavar="FILE", help="Write a rig.toml with the ports of the replay, and what was known of the axes into the workspace."
)
@click.pass_obj
def replay(settings: Settings, trace: str, as_json: bool, toml: str | None) -> None:
    """Stand in for the instruments of a trace (`--trace FILE` wrote it): who asks what was asked hears what was answered.

    At the end it says what was asked that is not in the trace.
    """
    from rig.replays import recorded_config, write_bench
    from sim.errors import SimError
    from sim.replay import in_background, load

    if toml is not None and Path(toml).exists():
        raise ConfigError(f"--toml {toml}: is there already")
    try:
        loaded = load(trace)
    except SimError as exc:
        raise ConfigError(str(exc)) from exc
    config = None if toml is None else recorded_config(loaded.about, trace)
    others = () if config is None else tuple(device.port for device in config.devices.values())
    with in_background(loaded, silent=others) as replayed:
        if toml is not None and config is not None:
            write_bench(Path(toml), config, loaded.about, replayed.url, settings.workspace)
        _announce(replayed.report, as_json)
        for port, divergences in replayed.divergences.items():
            for divergence in divergences:
                click.echo(f"{port}: {divergence}", err=True)
        click.echo("all that was recorded has been asked" if replayed.finished else "not all that was recorded has been asked", err=True)


def _announce(report: dict[str, Any], as_json: bool) -> None:
    """Say where the instruments are, and wait for a signal."""
    from rig.interrupts import Interrupts

    with Interrupts(list, ask=False) as interrupts:
        if as_json:
            click.echo(json.dumps(report))
        else:
            click.echo("SIMULATED instruments; Ctrl-C ends them")
            for device in report["devices"]:
                places = "  ".join(device[kind] for kind in ("tcp", "pty", "folder") if kind in device)
                click.echo(f"{device['name']:<10} {device['model']:<22} {places}")
        interrupts.pausing.wait()


def _config(report: dict[str, Any], path: str) -> str:
    """Return the simulated bench's configuration with the ports of instruments that are served already."""
    from rig.config import SIMULATED_PORT, simulated_config
    from rig.replays import served_toml

    places = {f"{SIMULATED_PORT}{device['name']}": device.get("tcp") for device in report["devices"]}
    config = simulated_config()
    needed = sorted({device.port for device in config.devices.values()})
    if not set(needed) <= set(places):
        raise ConfigError(f"--toml {path}: wants {' and '.join(port.removeprefix(SIMULATED_PORT) for port in needed)} to be served")
    return served_toml(config, places.__getitem__, speed=report["speed"])
