"""Kill -9 at a random moment of a sweep: is every reading that was on the screen in the run, and does the run open?"""

import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from rig.runs import Run
from tests.benchmarks.report import verdict
from tests.conftest import rig_environment

TIMES = 50
SEED = 20260822
ROW = re.compile(r"^ +(\d+) +(-?[\d.]+) +(-?[\d.]+) +\S+ \S+$")


def main() -> int:
    """Kill so many sweeps and count what was lost."""
    rng = random.Random(SEED)
    acknowledged = lost = unreadable = orphans = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(TIMES):
            rows, run = killed_sweep(Path(folder) / f"run-{number}", rows_before=rng.randrange(0, 23), delay=rng.uniform(0, 0.06))
            try:
                stored = {(reading.seq, f"{reading.theta_r:.3f}") for reading in run.readings}
            except Exception as exc:
                print(f"   run {number} does not open: {exc!r}")
                unreadable += 1
                continue
            acknowledged += len(rows)
            lost += sum(row not in stored for row in rows)
            orphans += run.state not in ("crashed", "complete")
    print(f"   {TIMES} sweeps killed, {acknowledged} readings were on the screen")
    return (
        verdict("readings lost", lost, 0) + verdict("runs that do not open", unreadable, 0) + verdict("runs with a wrong state", orphans, 0)
    )


def killed_sweep(out: Path, rows_before: int, delay: float) -> tuple[list[tuple[int, str]], Run]:
    """Start a sweep, kill it `delay` seconds after so many rows; return the rows that were on the screen, and the run."""
    command = [sys.executable, "-m", "rig", "sweep", "--cultivar", "RR", "--theta-r", "-70:40:5", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=rig_environment())
    assert process.stderr is not None
    rows: list[tuple[int, str]] = []
    begun = False
    killer = threading.Timer(delay, os.kill, (process.pid, signal.SIGKILL))
    for line in process.stderr:
        begun = begun or line.startswith(" reading")
        if match := ROW.match(line.rstrip()):
            rows.append((int(match[1]), match[3]))
        if begun and len(rows) >= rows_before and not killer.is_alive() and not killer.finished.is_set():
            killer.start()
    process.wait()
    killer.cancel()
    return rows, Run(out)
