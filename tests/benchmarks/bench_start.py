"""How soon the command answers, and how long the demo takes once everything is installed."""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.report import verdict
from tests.conftest import rig_environment


def timed(*command: str, folder: str | None = None) -> float:
    """Return the wall time of a command, in s."""
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, cwd=folder, env=rig_environment())
    return time.perf_counter() - started


def main() -> int:
    """Print the times beside that of a bare Python."""
    rig = str(Path(sys.executable).with_name("rig"))
    bare = statistics.median(timed(sys.executable, "-c", "pass") for _ in range(7))
    answer = statistics.median(timed(rig, "--help") for _ in range(7))
    missed = verdict("rig --help", answer, 0.4, " s", note=f"{answer / bare:.1f} times a bare Python's {bare:.3f} s")
    with tempfile.TemporaryDirectory() as folder:
        missed += verdict("rig demo", timed(rig, "demo", folder=folder), 60, " s")
    return missed
