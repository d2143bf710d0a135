"""Serve simulated instruments: `python -m sim`.

Prints one line of JSON that tells where the instruments are, then serves until SIGINT, SIGTERM or, if asked, the end of standard input.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import sys
import threading

from sim.bench import Misalignment
from sim.errors import SimError
from sim.faults import KINDS
from sim.keithley import MeterModel
from sim.motion import Ringing
from sim.serve import INSTRUMENTS, Settings, World, build, serving
from sim.zaber import StageModel


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sim",
        description="Serve simulated instruments on TCP sockets and pseudo-terminals.",
        epilog="instruments:\n" + "\n".join(f"  {name:<10}{description}" for name, description in INSTRUMENTS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    stage, ringing, meter = StageModel(), Ringing(), MeterModel()
    add = parser.add_argument
    served = ",".join(Settings().instruments)
    add("--instruments", default=served, metavar="all|NAME,NAME...", help="what to serve (default %(default)s)")
    add("--source", metavar="NAME:AXIS", help="rotary axis that carries the lamp's arm, such as newport:1 (default stages:1)")
    add("--detector", metavar="NAME:AXIS", help="rotary axis that carries the detector's arm (default stages:2)")
    add("--specimen", default="RR", help="a virtual petal, or lambert:ALBEDO (default %(default)s)")
    add("--seed", type=int, default=1, help="decides positions at power-up, misalignment, drift and noise (default %(default)s)")
    add("--speed", type=float, default=1.0, help="simulated seconds per real second (default %(default)s)")
    add("--stage-speed", type=float, default=stage.speed, metavar="DEG/S", help="of the Zaber rotary stages (default %(default)s)")
    add("--acceleration", type=float, default=stage.acceleration, metavar="DEG/S2", help="of the same (default %(default)s)")
    default = (ringing.amplitude, ringing.decay, ringing.frequency)
    names = ("DEG", "S", "HZ")
    add("--settle", type=float, nargs=3, default=default, metavar=names, help="their ringing after a stop: amplitude, decay, frequency")
    arms = ("SOURCE", "DETECTOR")
    add("--misalignment", type=float, nargs=2, metavar=arms, help="true minus nominal angle of the arms, deg (default drawn)")
    add("--terminator", default=meter.terminator, help="end of the meter's replies: LF, CR, CRLF or LFCR (default %(default)s)")
    add("--line-frequency", type=float, default=meter.line_frequency, metavar="HZ", help="mains, 50 or 60 (default %(default)s)")
    add("--fault", action="append", default=[], metavar="NAME:KIND:SEED[:AFTER]", help=f"strikes once; kinds: {', '.join(KINDS)}")
    add("--camera-folder", metavar="DIR", help="where the camera drops its pictures (default a new folder, which goes at the end)")
    add("--stop-log", metavar="FILE", help="write when a stop command arrived for which axis: JSON lines, time.monotonic() in s")
    add("--no-pty", action="store_true", help="TCP sockets only")
    add("--until-eof", action="store_true", help="stop when standard input ends, so as not to outlive a parent")
    return parser


def _settings(arguments: argparse.Namespace) -> Settings:
    stage = StageModel(speed=arguments.stage_speed, acceleration=arguments.acceleration, ringing=Ringing(*arguments.settle))
    return Settings(
        specimen=arguments.specimen,
        seed=arguments.seed,
        speed=arguments.speed,
        stage=stage,
        meter=MeterModel(line_frequency=arguments.line_frequency, terminator=arguments.terminator),
        misalignment=Misalignment(*arguments.misalignment) if arguments.misalignment else None,
        pty=not arguments.no_pty,
        instruments=tuple(INSTRUMENTS) if arguments.instruments == "all" else tuple(arguments.instruments.split(",")),
        source=arguments.source,
        detector=arguments.detector,
        camera_folder=arguments.camera_folder,
        faults=tuple(arguments.fault),
    )


async def _serve(settings: Settings, until_eof: bool, stop_log: str | None) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    world = build(settings)
    with world.stops.written_to(stop_log) if stop_log else contextlib.nullcontext():
        await _serve_until(stop, world, until_eof)


async def _serve_until(stop: asyncio.Event, world: World, until_eof: bool) -> None:
    async with serving(world) as report:
        print(json.dumps(report), flush=True)
        if until_eof:
            threading.Thread(target=_watch_stdin, args=(asyncio.get_running_loop(), stop), daemon=True).start()
        await stop.wait()


def _watch_stdin(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    # A thread, since the loop cannot wait for a file; os.read, since a buffered reader would hold its lock at exit.
    while True:
        try:
            if not os.read(0, 4096):
                break
        except OSError:  # closed from the start
            break
    try:
        loop.call_soon_threadsafe(stop.set)
    except RuntimeError:  # the loop has ended for another reason
        pass


def main() -> int:
    """Run the command line; return the exit code."""
    arguments = _parser().parse_args()
    try:
        asyncio.run(_serve(_settings(arguments), arguments.until_eof, arguments.stop_log))
    except SimError as error:
        print(f"python -m sim: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
