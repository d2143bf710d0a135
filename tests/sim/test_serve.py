"""The command line `python -m sim` and the bench as a whole."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sim.bench import Misalignment
from sim.errors import SimError
from sim.serve import Running, Settings, in_background

ROOT = Path(__file__).parents[2]
Connect = Callable[[str], Any]
Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start() -> Iterator[Start]:
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        pipe = subprocess.PIPE
        command = [sys.executable, "-m", "sim", "--specimen", "lambert:0.5", *arguments]
        started.append(subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe, text=True))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def report(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    return json.loads(process.stdout.readline())


def left(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=20)
    return process.returncode, out, err


def test_one_line_tells_where_everything_is(start: Start, connect: Connect) -> None:
    process = start("--seed", "7", "--speed", "20", "--until-eof")
    told = report(process)
    stages, meter = told["devices"]
    assert told == {"simulated": True, "seed": 7, "speed": 20.0, "specimen": "lambert:0.5", "pid": process.pid, "devices": [stages, meter]}
    assert (stages["name"], stages["model"]) == ("stages", "zaber-x-rsw60a")
    assert (meter["name"], meter["model"]) == ("meter", "keithley-6485")
    for device in (stages, meter):
        assert set(device) == {"name", "model", "tcp", "pty"}
        assert device["tcp"].startswith("socket://127.0.0.1:")
        assert os.path.exists(device["pty"])
    assert connect(stages["tcp"]).ask(b"/2 0 05") == b"@02 0 05 OK IDLE WR 0\r\n"
    # The end of standard input ends it, clients or not, without a word.
    assert left(process) == (0, "", "")
    assert not os.path.exists(stages["pty"])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly_in_the_middle_of_things(start: Start, connect: Connect, number: signal.Signals) -> None:
    process = start("--speed", "1", "--no-pty")
    devices = {device["name"]: device for device in report(process)["devices"]}
    assert "pty" not in devices["meter"]
    stages, meter = connect(devices["stages"]["tcp"]), connect(devices["meter"]["tcp"])
    stages.ask(b"/0 set comm.alert 1")
    stages.line()
    assert stages.ask(b"/1 1 home").startswith(b"@01 1 OK BUSY")
    meter.send(b"*OPC?\nTRIG:COUN 2500\nREAD?\n")
    assert meter.line() == b"1\n"
    process.send_signal(number)
    assert left(process) == (0, "", "")
    assert meter.line() == b""


def test_stage_and_meter_options_arrive(start: Start, connect: Connect) -> None:
    process = start(
        "--stage-speed", "90", "--acceleration", "300", "--terminator", "CRLF", "--line-frequency", "50", "--no-pty", "--until-eof"
    )
    devices = {device["name"]: device for device in report(process)["devices"]}
    stages, meter = connect(devices["stages"]["tcp"]), connect(devices["meter"]["tcp"])
    # 90 deg/s = 384 000 usteps/s; 300 deg/s^2 = 1 280 000 usteps/s^2.
    assert stages.ask(b"/1 1 get maxspeed").split()[-1] == str(round(384000 * 1.6384)).encode()
    assert stages.ask(b"/1 1 get accel").split()[-1] == str(round(1280000 * 1.6384e-4)).encode()
    assert meter.ask(b"SYST:LFR?") == b"50\r\n"
    assert left(process) == (0, "", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--specimen", "lambert:7"), "albedo from 0 to 1"),
        (("--specimen", "no-such-petal"), "expected lambert:ALBEDO or one of"),
        (("--speed", "0"), "clock speed"),
        (("--terminator", "NUL"), "terminator"),
        (("--settle", "0.1", "0", "25"), "ringing"),
        (("--stage-speed", "-1"), "above zero"),
        (("--seed", "-1"), "seed"),
    ],
)
def test_nonsense_is_refused_in_one_line(start: Start, arguments: tuple[str, ...], message: str) -> None:
    code, out, err = left(start(*arguments))
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_in_background_gives_the_error_to_the_caller() -> None:
    with pytest.raises(SimError, match="albedo"), in_background(Settings(specimen="lambert:2")):
        pass


def settle(stages: Any, axis: int) -> None:
    while b" BUSY " in stages.ask(b"/%d 1" % axis):
        pass


def test_the_meter_sees_the_light_of_the_angles_the_stages_stand_at(running: Running, connect: Connect) -> None:
    stages, meter = connect(running.url("stages")), connect(running.url("meter"))
    for axis in (1, 2):
        stages.ask(b"/%d 1 home" % axis)
    for axis, degrees in ((1, 135), (2, 80)):
        settle(stages, axis)
        stages.ask(b"/%d 1 move abs %d" % (axis, round(degrees / 0.000234375)))
        settle(stages, axis)
    meter.send(b"*RST\nSYST:ZCH OFF\nFORM:ELEM READ\n")
    reading = float(meter.ask(b"READ?"))  # 100 ms per conversion: the ringing of 50 ms has time to die away
    reading = float(meter.ask(b"READ?"))
    bench, now = running.world.bench, running.world.clock.now()
    assert bench.angles(now) == pytest.approx((45.1, -20.08), abs=1e-4)  # misalignments of the fixture
    assert stages.ask(b"/1 1 get pos").split()[-1] == b"576000"  # which the readback does not know
    lamp = bench.lamp.level(now)
    assert reading == pytest.approx(float(bench.light(45.1, -20.08)) * lamp, rel=1e-4, abs=0)
    # The detector's arm in the beam: dark.
    stages.ask(b"/2 1 move abs %d" % round(145 / 0.000234375))
    settle(stages, 2)
    meter.ask(b"READ?")
    assert abs(float(meter.ask(b"READ?"))) < 5e-12


def test_misalignment_is_drawn_from_the_seed_unless_given() -> None:
    with in_background(Settings(specimen="lambert:1", seed=3, pty=False)) as one:
        drawn = one.world.bench.misalignment
    with in_background(Settings(specimen="lambert:1", seed=3, pty=False, misalignment=Misalignment())) as other:
        assert other.world.bench.misalignment == Misalignment(0.0, 0.0) != drawn
        assert other.world.stages.axes[0].track.nominal(0.0) == one.world.stages.axes[0].track.nominal(0.0)
