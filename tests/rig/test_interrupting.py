"""Ctrl-C and SIGTERM, at a terminal and without one, on the whole command."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pexpect
import pytest

from rig.runs import Run
from tests.conftest import rig_environment

pytestmark = pytest.mark.slow
SWEEP = ["-m", "rig", "sweep", "--cultivar", "RR", "--theta-r", "-70:40:5", "--out"]


def at_terminal(folder: Path) -> pexpect.spawn:
    """Start a sweep at a terminal and let it read a few points."""
    child = pexpect.spawn(sys.executable, [*SWEEP, str(folder)], env=rig_environment(), timeout=60, encoding="utf-8", dimensions=(40, 100))
    child.expect(r"  3 +45\.000")
    return child


def test_at_a_terminal_the_first_one_pauses_and_asks_and_go_on_completes_the_run(tmp_path: Path) -> None:
    child = at_terminal(tmp_path / "run")
    child.sendintr()
    child.expect("paused, all axes stopped")
    child.sendline("what")
    child.expect("g to go on, a to abort")
    child.sendline("g")
    child.expect(pexpect.EOF)
    child.close()
    assert child.exitstatus == 0
    run = Run(tmp_path / "run")
    assert run.state == "complete"
    assert [reading.theta_r_setpoint for reading in run.readings] == [float(v) for v in range(-70, 41, 5)]


@pytest.mark.parametrize("answer", ["a\n", "\x03"])
def test_at_a_terminal_aborting_or_a_second_one_ends_the_run(tmp_path: Path, answer: str) -> None:
    child = at_terminal(tmp_path / "run")
    child.sendintr()
    child.expect("paused, all axes stopped")
    child.send(answer)
    child.expect("interrupted by SIGINT")
    child.expect(pexpect.EOF)
    child.close()
    assert child.exitstatus == 130
    run = Run(tmp_path / "run")
    assert (run.state, run.reason) == ("aborted", "interrupted by SIGINT")
    assert len(run.readings) >= 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_without_a_terminal_the_run_is_closed_as_aborted(tmp_path: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, *SWEEP, str(tmp_path / "run")],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=rig_environment(),
    )
    assert process.stderr is not None
    shown = 0
    for line in process.stderr:
        shown += " nA" in line
        if shown == 3:
            process.send_signal(number)
            break
    rest = process.stderr.read()
    assert process.wait(20) == 130
    process.communicate()
    assert "Traceback" not in rest
    assert rest.splitlines()[-1] == f"rig: interrupted: interrupted by {number.name}"
    run = Run(tmp_path / "run")
    assert (run.state, run.reason) == ("aborted", f"interrupted by {number.name}")
    assert len(run.readings) >= 3 + sum(" nA" in line for line in rest.splitlines())


def test_an_interrupted_run_can_be_shown_and_fitted(tmp_path: Path, rig) -> None:
    child = at_terminal(tmp_path / "run")
    child.sendintr()
    child.expect("paused")
    child.sendline("a")
    child.expect(pexpect.EOF)
    child.close()
    shown = json.loads(rig("runs", "show", str(tmp_path / "run"), "--json").stdout)
    assert shown["state"] == "aborted"
    assert "interrupted" in rig("runs", "show", str(tmp_path / "run")).stdout
