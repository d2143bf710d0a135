"""`rig stop` from outside: whoever moves the bench is told to end, and no axis waits for that, nor for another axis."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.errors import TransportTimeout
from rig import ownership, stopping
from rig.ownership import Owner
from rig.runs import Run
from rig.salvage import salvaged
from rig.session import paperwork
from rig.stopping import Ending, stop_rows
from rig.workspace import Workspace
from sim.serve import Running
from tests.conftest import rig_environment
from tests.rig.lab import INSTRUMENTS, MIXED, Lab, places, serving
from tests.rig.scripted import moves, scripted_bench

RIG = """
import sys
from rig import ownership
from rig.cli.main import main
ownership.PLACES = (sys.argv.pop(1),)
main()
"""

SLOW = MIXED.replace("limits = [0.0, 150.0]", "limits = [0.0, 150.0]\nspeed = 0.2")
"""A bench on which `x` takes more than ten seconds of the tests' time."""


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        yield running


@pytest.fixture
def lab(running: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    """A bench on a machine of its own: a stop that tells every program must not tell those of other tests."""
    place = tmp_path / "machine"
    place.mkdir()
    place.chmod(0o1777)
    monkeypatch.setattr(ownership, "PLACES", (str(place),))
    monkeypatch.setattr(ownership, "PATIENCE_S", 0.05)
    lab = Lab(tmp_path, places(running))
    lab.configure()
    return lab


@contextmanager
def beside(lab: Lab, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a command in a process of its own, with another folder and so another workspace."""
    folder = lab.folder / "elsewhere"
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-c", RIG, *ownership.PLACES, "--config", str(lab.folder / "rig.toml"), *arguments]
    nothing, pipe = subprocess.DEVNULL, subprocess.PIPE
    process = subprocess.Popen(command, cwd=folder, env=rig_environment(), stdin=nothing, stdout=nothing, stderr=pipe, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline


@contextmanager
def x_on_its_way(lab: Lab, running: Running, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`x` is at 60 mm at the most and moves towards 150, told by another program."""
    lab.rig("move", "x", "20", "--home")
    text = lab.configure(SLOW).text
    track, clock = running.world.axes["linear:1"], running.world.clock
    with beside(lab, *options, "move", "x", "150") as mover:
        until(lambda: track.nominal(clock.now())[0] > 21.0)
        assert text == (lab.folder / "rig.toml").read_text()
        yield mover


def moving(running: Running) -> bool:
    return running.world.axes["linear:1"].moving(running.world.clock.now())


def test_a_mover_with_another_workspace_is_ended_and_every_axis_told(lab: Lab, running: Running) -> None:
    seen = len(running.stops())
    with x_on_its_way(lab, running) as mover:
        lines = lab.rig("stop").out.splitlines()
        assert not moving(running)
        assert mover.wait(10) == 130
    assert lines[0] == f"process {mover.pid} (rig --config {lab.folder / 'rig.toml'} move x 150) has stopped and ended"
    assert [re.match(r"SIMULATED: (\w+): told to stop, at rest at", line)[1] for line in lines[1:]] == ["source", "detector", "x"]  # type: ignore[index]
    assert [stop.axis for stop in running.stops()[seen:]].count("linear:1") >= 3  # from here, by the mover, and from here again


def test_status_says_who_moves_an_axis_and_what_it_was_told(lab: Lab, running: Running) -> None:
    with x_on_its_way(lab, running, "--workspace", str(lab.folder / "rig-data")) as mover:
        line = lab.rig("status", "x").out
        lab.rig("stop")
        assert mover.wait(10) == 130
    assert re.fullmatch(
        rf"SIMULATED: x: in use by process {mover.pid} \(rig .* move x 150\), last told 150 mm at [-\d: ]+, on its way\n", line
    )
    after = lab.rig("status", "x").out
    assert "last told 150 mm, came to rest at " in after


def test_one_that_hangs_keeps_no_stop_from_the_wires(lab: Lab, running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.stopping.PATIENCE_S", 0.3)
    told_before: list[set[str]] = []

    def wait(ending: Ending) -> None:
        told_before.append({stop.axis for stop in running.stops()[seen:]})
        wait_for_it(ending)

    wait_for_it = Ending.wait
    monkeypatch.setattr(Ending, "wait", wait)
    with x_on_its_way(lab, running) as mover:
        mover.send_signal(signal.SIGSTOP)
        seen = len(running.stops())
        told = lab.rig("stop", "--json", code=1).json
        assert not moving(running)
        assert told_before == [{"newport:1", "stages:2", "linear:1"}]
        assert (told["simulated"], [row["error"] for row in told["axes"]]) == (True, ["", "", ""])
        (owner,) = told["owners"]
        assert (owner["pid"], owner["ended"]) == (mover.pid, False)
        assert owner["error"].endswith(f"was told to stop and is still there after 0.3 s; `kill -9 {mover.pid}` ends it")
        mover.send_signal(signal.SIGCONT)
        assert mover.wait(10) == 130


def test_the_axis_of_a_mover_that_was_killed_is_stopped_and_where_it_came_to_rest_is_known(lab: Lab, running: Running) -> None:
    with x_on_its_way(lab, running, "--workspace", str(lab.folder / "rig-data")) as mover:
        mover.kill()
        mover.wait()
        assert moving(running)
        assert "its end was not seen" in lab.rig("status", "x").out
        assert lab.rig("stop", "--json").json["owners"] == []
        assert not moving(running)
    where = running.world.axes["linear:1"].nominal(running.world.clock.now())[0]
    after = lab.rig("status", "x", "--json").json["axes"][0]
    told = re.match(r"last told 150 mm, came to rest at (\S+) mm at ", after["last_command"])
    assert told
    assert float(told[1]) == pytest.approx(where, abs=0.002)
    lab.configure()
    assert lab.rig("move", "x", "20").err == ""


BROKEN = {
    "no TOML": (lambda text: text.replace("[keep_out]", "[keep_out"), "rig: rig.toml: not TOML: "),
    "a line of an axis": (lambda text: text.replace("offset = 100.0", "offset = one hundred"), "rig: rig.toml: not TOML: "),
    "a key too many": (lambda text: text + "\n[kettle]\n", "rig: rig.toml: kettle: unknown key"),
    "no limits": (lambda text: text.replace("limits = [0.0, 150.0]", ""), "rig: rig.toml: axes.x.limits: missing"),
    "no sensor": (lambda text: text.replace("[sensor]", "[sensors.eye]"), "rig: rig.toml: sensor: missing"),
    "not UTF-8": (lambda text: text + "# \udcff\n", "rig: rig.toml: cannot be read"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_with_a_toml_that_cannot_be_used_every_axis_is_told_all_the_same(lab: Lab, running: Running, case: str) -> None:
    spoil, says = BROKEN[case]
    spoilt = spoil((lab.folder / "rig.toml").read_text())
    assert spoilt != (lab.folder / "rig.toml").read_text()
    (lab.folder / "rig.toml").write_bytes(spoilt.encode(errors="surrogateescape"))
    seen = len(running.stops())
    done = lab.rig("stop", code=2)
    assert done.out == "".join(f"SIMULATED: {name}: told to stop\n" for name in ("source", "detector", "x"))
    assert done.err.startswith(says)
    assert len(done.err.splitlines()) == 1
    assert {stop.axis for stop in running.stops()[seen:]} == {"newport:1", "stages:2", "linear:1"}


def test_with_a_toml_that_cannot_be_used_whoever_has_a_port_is_ended(lab: Lab, running: Running) -> None:
    with x_on_its_way(lab, running) as mover:
        (lab.folder / "rig.toml").write_text("[axes.x\n")
        told = lab.rig("stop", "--json", code=2)
        assert mover.wait(10) == 130
    assert ([row["pid"] for row in told.json["owners"]], told.json["axes"]) == ([mover.pid], [])
    assert not moving(running)


def test_in_the_wrong_folder_whoever_has_a_port_is_ended(lab: Lab, running: Running) -> None:
    with x_on_its_way(lab, running) as mover:
        (lab.folder / "rig.toml").rename(lab.folder / "other.toml")
        told = lab.rig("stop")
        assert mover.wait(10) == 130
    assert told.out.startswith(f"process {mover.pid} (")
    assert "nothing to stop" in lab.rig("stop").out
    assert not moving(running)


def test_a_trace_that_cannot_be_made_keeps_nothing_from_the_wires(lab: Lab, running: Running) -> None:
    (lab.folder / "wires.jsonl").write_text("an older one")
    seen = len(running.stops())
    done = lab.rig("stop", "--trace", "wires.jsonl", code=2)
    assert done.err.startswith("rig: --trace wires.jsonl: is there already")
    assert {stop.axis for stop in running.stops()[seen:]} == {"newport:1", "stages:2", "linear:1"}


@pytest.mark.slow
def test_a_sweep_is_ended_with_all_axes_stopped(lab: Lab, running: Running) -> None:
    with beside(lab, "sweep", "--cultivar", "RR", "--theta-r", "-70:40:1", "--out", "run") as process:
        assert process.stderr is not None
        for line in process.stderr:
            if re.match(r" +3 +45\.000", line):
                break
        told = lab.rig("stop", "--json").json
        rest = process.stderr.read()
        assert process.wait(10) == 130
    assert [(row["pid"], row["ended"], len(row["ports"])) for row in told["owners"]] == [(process.pid, True, 2)]
    assert [(row["name"], row["error"]) for row in told["axes"]] == [("source", ""), ("detector", ""), ("x", "")]
    assert rest.splitlines()[-1] == "rig: interrupted: interrupted by SIGTERM"
    run = Run(lab.folder / "elsewhere" / "run")
    assert (run.state, run.reason) == ("aborted", "interrupted by SIGTERM")
    assert len(run.readings) >= 3
    assert not any(row["moving"] for row in lab.rig("status", "--json").json["axes"])
    lab.rig("home", "x")  # the bench is free


# What is told, and to whom


def test_the_axes_of_one_port_do_not_wait_for_each_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    scripted = scripted_bench(monkeypatch)
    together = {name: replace(axis, port="one") for name, axis in scripted.config.axes.items()}
    config = replace(scripted.config, axes=together)
    stopped = threading.Event()

    def wait_in_vain() -> None:
        stopped.wait(5)
        raise TransportTimeout("no reply")

    scripted.stages["source"].on_stop = wait_in_vain
    scripted.stages["tilt"].on_stop = stopped.set
    with paperwork(config, Workspace(tmp_path), devices=()) as papers:
        rows = stop_rows(config, Ending([]), papers)
    assert stopped.is_set()
    assert scripted.opened.count("one") == 2  # for the stop, and to ask where they stand
    assert [row["error"] == "" for row in rows] == [False, True, True]


def test_an_axis_that_goes_on_moving_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("rig.stopping.REST_S", 0.05)
    scripted = scripted_bench(monkeypatch)
    tilt = scripted.stages["tilt"]
    tilt.on_look = lambda: tilt.see(moves(3.0))
    with paperwork(scripted.config, Workspace(tmp_path), devices=()) as papers:
        rows = stop_rows(scripted.config, Ending([]), papers)
    assert [(row["error"], row["moving"]) for row in rows] == [("", False), ("", False), ("still moving after 0.05 s", True)]


def test_one_that_belongs_to_somebody_else_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(pid: int, number: int) -> None:
        raise PermissionError

    monkeypatch.setattr("rig.ownership.os.kill", forbidden)
    monkeypatch.setattr(stopping, "owners", lambda ports: [Owner(12345, "rig sweep", ("p",))])
    monkeypatch.setattr(Owner, "await_end", lambda self, timeout_s: False)
    ending = stopping.tell_owners(["p"])
    ending.wait()
    (row,) = ending.rows()
    assert (row["ended"], row["error"]) == (False, "process 12345 (rig sweep) belongs to another user and cannot be told to end from here")


WRECK = """\
limits = [
[axes.source]
model = "newport-esp301"
port = "/dev/ttyS0"
axis = 2
baudrate = 19200
speed = = 3
[axes."detector"]  # the other
model = "zaber-x-rsw60a"
port = "/dev/ttyS1"
address = "two"
[axes.x]
model = "zaber-x-lsm"
[axes.y]
model = "a kettle"
port = "/dev/ttyS2"
[axes.z]
model = "zaber-x-lsm"
port = "sim:linear"
[sensor]
port = "/dev/ttyS3"
"""


def test_what_can_be_made_out_of_a_wreck() -> None:
    config, lost = salvaged(WRECK, "rig.toml")
    (source,) = config.axes.values()
    assert (source.model, source.port, source.options, source.serial) == ("newport-esp301", "/dev/ttyS0", {"axis": 2}, {"baudrate": 19200})
    assert not config.simulated
    assert lost == {
        "detector": "address 'two' is none, so nobody knows which axis of /dev/ttyS1 it is",
        "x": "port None is none",
        "y": "model 'a kettle' is no known stage",
        "z": "sim:linear is there only while a command runs",
    }
    assert salvaged("", "rig.toml")[0].axes == {}
    assert salvaged("axes = 1", "rig.toml")[0].axes == {}


def test_where_a_motion_ended_that_nobody_saw_is_written_down_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    scripted = scripted_bench(monkeypatch)
    workspace = Workspace(tmp_path)
    with paperwork(scripted.config, workspace, devices=()) as papers:
        assert papers.records is not None
        for name, axis in scripted.config.axes.items():
            papers.records.put(axis.identity, setpoint=60.0, readback=1.0, under_way=name != "tilt", homed=True)
        stop_rows(scripted.config, Ending([]), papers)
        found = {name: papers.records.get(axis.identity) for name, axis in scripted.config.axes.items()}
    seen = {name: (record.setpoint, record.readback, record.under_way) for name, record in found.items() if record}
    assert seen == {"source": (60.0, 45.0, False), "detector": (60.0, 0.0, False), "tilt": (60.0, 1.0, False)}
    assert json.loads(workspace.axes.read_text())["axes"]["one scripted-stage"]["homed"] is True
