"""Serve the simulated bench: `python -m sim`.

Prints one line of JSON that tells where the instruments are, then serves until SIGINT, SIGTERM or, if asked, the end of standard input.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import threading

from sim.bench import Misalignment
from sim.errors import SimError
from sim.keithley import MeterModel
from sim.motion import Ringing
from sim.serve import Settings, build, serving
from sim.zaber import StageModel


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sim", description="Serve simulated instruments on TCP sockets and pseudo-terminals.")
    stage, ringing, meter = StageModel(), Ringing(), MeterModel()
    add = parser.add_argument
    add("--specimen", default="RR", help="a virtual petal, or lambert:ALBEDO (default %(default)s)")
    add("--seed", type=int, default=1, help="decides angles at power-up, misalignment, drift and noise (default %(default)s)")
    add("--speed", type=float, default=1.0, help="simulated seconds per real second (default %(default)s)")
    add("--stage-speed", type=float, default=stage.speed, metavar="DEG/S", help="default %(default)s")
    add("--acceleration", type=float, default=stage.acceleration, metavar="DEG/S2", help="default %(default)s")
    default = (ringing.amplitude, ringing.decay, ringing.frequency)
    names = ("DEG", "S", "HZ")
    add("--settle", type=float, nargs=3, default=default, metavar=names, help="ringing after a stop: amplitude, decay, frequency")
    arms = ("SOURCE", "DETECTOR")
    add("--misalignment", type=float, nargs=2, metavar=arms, help="true minus nominal angle of the arms, deg (default drawn)")
    add("--terminator", default=meter.terminator, help="end of the meter's replies: LF, CR, CRLF or LFCR (default %(default)s)")
    add("--line-frequency", type=float, default=meter.line_frequency, metavar="HZ", help="mains, 50 or 60 (default %(default)s)")
    add("--no-pty", action="store_true", help="TCP sockets only")
    add("--until-eof", action="store_true", help="stop when standard input ends, so as not to outlive a parent")
    return parser


def _settings(arguments: argparse.Namespace) -> Settings:
    if arguments.seed < 0:
        raise SimError(f"seed {arguments.seed}: expected zero or more")
    stage = StageModel(speed=arguments.stage_speed, acceleration=arguments.acceleration, ringing=Ringing(*arguments.settle))
    return Settings(
        specimen=arguments.specimen,
        seed=arguments.seed,
        speed=arguments.speed,
        stage=stage,
        meter=MeterModel(line_frequency=arguments.line_frequency, terminator=arguments.terminator),
        misalignment=Misalignment(*arguments.misalignment) if arguments.misalignment else None,
        pty=not arguments.no_pty,
    )


async def _serve(settings: Settings, until_eof: bool) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    world = build(settings)
    async with serving(world) as report:
        print(json.dumps(report), flush=True)
        if until_eof:
            threading.Thread(target=_watch_stdin, args=(loop, stop), daemon=True).start()
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
        asyncio.run(_serve(_settings(arguments), arguments.until_eof))
    except SimError as error:
        print(f"python -m sim: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
