"""From the signal to the stop on every axis's wire, on benches of every make, while a sweep runs."""

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.report import verdict
from tests.conftest import rig_environment
from tests.rig.campaign import STAGES, Bench

TIMES = 3
SEED = 20261123
TARGET_S = 0.1
SPEED = 10.0


def main() -> int:
    """Interrupt sweeps at random moments, and take the time at which each axis's stop arrived."""
    rng = random.Random(SEED)
    missed = 0
    for source, detector in zip(STAGES, [*list(STAGES)[1:], next(iter(STAGES))], strict=True):
        for number in (signal.SIGINT, signal.SIGTERM):
            worst = max(interrupted(Bench(source, detector, "meter", False), number, rng.uniform(0.0, 1.0)) for _ in range(TIMES))
            missed += verdict(f"{source} and {detector}, {number.name}, worst of {TIMES}", worst * 1e3, TARGET_S * 1e3, " ms")
    return missed


def interrupted(bench: Bench, number: signal.Signals, delay_s: float) -> float:
    """Return the seconds from a signal, sent to a sweep some time after its first reading, to the last axis's stop."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arms = [f"--{arm}={instrument}:{axis}" for arm, (instrument, axis) in bench.arms.items()]
        served = ["--instruments", ",".join(bench.instruments), "--no-pty", "--until-eof", "--speed", str(SPEED)]
        command = [sys.executable, "-m", "sim", *served, *arms, "--stop-log", str(folder / "stops")]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=rig_environment()) as sim:
            assert sim.stdout is not None
            assert sim.stdin is not None
            urls = {device["name"]: device["tcp"] for device in json.loads(sim.stdout.readline())["devices"]}
            (folder / "rig.toml").write_text(bench.toml(urls.__getitem__, SPEED), encoding="utf-8")
            at = _signalled(folder, number, delay_s)
            sim.stdin.close()
            stops = [json.loads(line) for line in (folder / "stops").read_text().splitlines()]
        first = {}
        for stop in stops:
            if stop["time"] >= at:
                first.setdefault(stop["axis"], stop["time"] - at)
        return max(first.get(f"{instrument}:{axis}", float("inf")) for instrument, axis in bench.arms.values())


def _signalled(folder: Path, number: signal.Signals, delay_s: float) -> float:
    options = ["--config", str(folder / "rig.toml"), "--workspace", str(folder)]
    command = [sys.executable, "-m", "rig", *options, "sweep", "--cultivar", "RR", "--theta-i", "10,60", "--theta-r", "-80:0:20"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=rig_environment()) as sweep:
        assert sweep.stderr is not None
        for line in sweep.stderr:
            if line.split()[:1] == ["1"]:
                break
        time.sleep(delay_s)
        at = time.monotonic()
        sweep.send_signal(number)
        sweep.communicate()
    return at
