"""One program at a time moves a bench; `rig stop` ends it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from rig.errors import RunError
from rig.ownership import end_owner, owned
from rig.runs import Run
from tests.conftest import ROOT, rig_environment
from tests.rig.lab import INSTRUMENTS, Lab, places, serving

HOLD = """
import sys
from pathlib import Path
from rig.ownership import owned
with owned(Path(sys.argv[1])):
    print("mine", flush=True)
    sys.stdin.readline()
"""


def holder(lock: Path, program: str = HOLD) -> subprocess.Popen[str]:
    """Start a program that has the bench."""
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    command = [sys.executable, "-c", program, str(lock)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=nothing, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "mine\n"
    return process


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def test_a_second_program_is_refused_and_told_who_has_it(tmp_path: Path) -> None:
    lock = tmp_path / "data" / "bench.lock"
    process = holder(lock)
    try:
        with pytest.raises(RunError, match=rf"in use by process {process.pid} \(rig .*\); wait for it, or `rig stop`"), owned(lock):
            raise AssertionError("both have it")
    finally:
        end(process)


def test_after_a_kill_it_is_free(tmp_path: Path) -> None:
    lock = tmp_path / "bench.lock"
    process = holder(lock)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert end_owner(lock, 1.0) is None  # the pid that is still written there is nobody's
    with owned(lock):
        assert json.loads(lock.read_text())["pid"] == os.getpid()
    assert lock.read_text() == ""


def test_it_is_free_again_after_an_error(tmp_path: Path) -> None:
    lock = tmp_path / "bench.lock"
    with pytest.raises(ValueError, match="trouble"), owned(lock):
        raise ValueError("trouble")
    with owned(lock):
        pass


def test_ending_who_has_it_waits_for_the_end(tmp_path: Path) -> None:
    lock = tmp_path / "bench.lock"
    assert end_owner(lock, 1.0) is None
    process = holder(lock)
    owner = end_owner(lock, 10.0)
    assert owner is not None
    assert owner.pid == process.pid
    process.communicate()
    assert process.returncode == -signal.SIGTERM


def test_one_that_does_not_end_is_named(tmp_path: Path) -> None:
    lock = tmp_path / "bench.lock"
    stubborn = HOLD.replace("import sys", "import signal, sys\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)", 1)
    process = holder(lock, stubborn)
    try:
        with pytest.raises(RunError, match=rf"process {process.pid} .* was told to stop and still has the bench after 0.1 s"):
            end_owner(lock, 0.1)
    finally:
        end(process)


def test_what_moves_is_refused_while_another_has_the_bench_and_what_looks_is_not(tmp_path: Path) -> None:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        lab = Lab(tmp_path, places(running))
        lab.configure()
        process = holder(tmp_path / "rig-data" / "bench.lock")
        try:
            for command in (("home",), ("move", "x", "10"), ("sweep", "--cultivar", "RR", "--theta-r", "0")):
                refused = lab.rig(*command, code=1)
                assert re.search(rf"^rig: the bench is in use by process {process.pid} \(.*\n\Z", refused.err, re.MULTILINE)
                assert "Traceback" not in refused.err
            lab.rig("status")
            lab.rig("read", "plate")
        finally:
            end(process)
        assert not any(track.moving(running.world.clock.now()) for track in running.world.axes.values())
        assert running.stops() == ()


@pytest.mark.slow
def test_rig_stop_ends_a_sweep_with_all_axes_stopped(tmp_path: Path) -> None:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        lab = Lab(tmp_path, places(running))
        lab.configure()
        process = subprocess.Popen(
            [sys.executable, "-m", "rig", "sweep", "--cultivar", "RR", "--theta-r", "-70:40:1", "--out", "run"],
            cwd=tmp_path,
            env=rig_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        for line in process.stderr:
            if re.match(r" +3 +45\.000", line):
                break
        watchdog = threading.Timer(30, process.kill)  # a sweep that does not end must not hold up the test
        watchdog.start()
        told = lab.rig("stop", "--json").json
        rest = process.stderr.read()
        assert process.wait(10) == 130
        watchdog.cancel()
        process.communicate()
        assert told["ended"]["pid"] == process.pid
        assert [(row["name"], row["error"]) for row in told["axes"]] == [("source", ""), ("detector", ""), ("x", "")]
        assert rest.splitlines()[-1] == "rig: interrupted: interrupted by SIGTERM"
        run = Run(tmp_path / "run")
        assert (run.state, run.reason) == ("aborted", "interrupted by SIGTERM")
        assert len(run.readings) >= 3
        assert {"newport:1", "stages:2", "linear:1"} <= {stop.axis for stop in running.stops()}
        assert not any(row["moving"] for row in lab.rig("status", "--json").json["axes"])
        lab.rig("move", "detector", "0")  # the bench is free
