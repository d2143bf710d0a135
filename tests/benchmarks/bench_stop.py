"""From the signal to the stop on every axis's wire, on benches of every make, while a sweep runs: arms on wires of their own, both on one
wire, and with the other arm's wire frozen.
"""

import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from sim.faults import Fault
from sim.serve import Running, Settings, in_background
from tests.benchmarks.report import verdict
from tests.conftest import rig_environment
from tests.rig.campaign import STAGES, Bench

SEED = 20261123
TARGET_S = 0.1
SPEED = 10.0


def main() -> int:
    """Interrupt sweeps at random moments, and take the time at which each axis's stop arrived."""
    rng = random.Random(SEED)
    missed = 0
    for bench, frozen in cases():
        worst = max(interrupted(bench, number, rng.uniform(0.0, 1.0), frozen) for number in (signal.SIGINT, signal.SIGTERM))
        what = f"{bench.source} and {bench.detector}" + (f", the wire of {frozen} frozen" if frozen else "")
        missed += verdict(f"{what}: worst of SIGINT and SIGTERM", worst * 1e3, TARGET_S * 1e3, " ms")
    return missed


def cases() -> Iterator[tuple[Bench, str]]:
    """Yield benches, and of each which instrument's wire freezes just before the signal, if any."""
    names = list(STAGES)
    for source, detector in zip(names, [*names[1:], names[0]], strict=True):
        yield Bench(source, detector, "meter", False), ""
        yield Bench(source, detector, "meter", False), detector  # that moves from each point to the next: its wire is never quiet for long
    for name in names:
        yield Bench(name, name, "meter", False), ""


def interrupted(bench: Bench, number: signal.Signals, delay_s: float, frozen: str) -> float:
    """Return the seconds from a signal, sent to a sweep some time after its first reading, to the last axis's stop.

    Of an axis behind the wire that was `frozen` at that moment no stop can arrive, and none is asked for.
    """
    arms = {arm: f"{instrument}:{axis}" for arm, (instrument, axis) in bench.arms.items()}
    settings = Settings(speed=SPEED, pty=False, instruments=bench.instruments, **arms)
    with tempfile.TemporaryDirectory() as name, in_background(settings) as running:
        folder = Path(name)
        (folder / "rig.toml").write_text(bench.toml(running.url, SPEED), encoding="utf-8")
        at = _signalled(folder, number, delay_s, running, frozen)
        first: dict[str, float] = {}
        for stop in running.stops():
            if stop.time >= at:
                first.setdefault(stop.axis, stop.time - at)
        return max(first.get(axis, float("inf")) for axis in arms.values() if not frozen or not axis.startswith(f"{frozen}:"))


def _signalled(folder: Path, number: signal.Signals, delay_s: float, running: Running, frozen: str) -> float:
    options = ["--config", str(folder / "rig.toml"), "--workspace", str(folder)]
    command = [sys.executable, "-m", "rig", *options, "sweep", "--cultivar", "RR", "--theta-i", "10,60", "--theta-r", "-80:0:4"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=rig_environment()) as sweep:
        assert sweep.stderr is not None
        for line in sweep.stderr:
            if line.split()[:1] == ["1"]:
                break
        time.sleep(delay_s)
        if frozen:
            running.inject(frozen, Fault("frozen", SEED))
            while not running.struck(frozen) and sweep.poll() is None:
                time.sleep(0.001)
        at = time.monotonic()
        sweep.send_signal(number)
        sweep.communicate()
    return at
