"""`rig devices`, `home`, `move`, `status`, `stop` and `read`, as a technician and as a program meet them."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers import catalogue
from rig.axisrecord import AxisRecords
from rig.runs import Run
from rig.trace import Trace
from rig.workspace import Workspace
from sim.faults import Fault
from sim.serve import Running
from tests.rig.lab import INSTRUMENTS, MIXED, SPEED, Lab, places, serving

AXES = ["source", "detector", "x"]
SENSORS = ["sensor", "lamp", "plate"]


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        yield running


@pytest.fixture
def lab(running: Running, tmp_path: Path) -> Lab:
    """A bench of several makers, wherever its arms stand."""
    lab = Lab(tmp_path, places(running))
    lab.configure()
    return lab


@pytest.fixture
def homed(lab: Lab) -> Lab:
    """The same, homed, the arms apart."""
    lab.rig("home")
    lab.rig("move", "detector", "-20")
    lab.rig("move", "source", "45", "--home")
    return lab


def nowhere() -> str:
    """Return an address at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"socket://127.0.0.1:{server.getsockname()[1]}"


# The catalogue


def test_devices_lists_every_model(lab: Lab) -> None:
    text = lab.rig("devices").out.splitlines()
    models = lab.rig("devices", "--json").json
    names = {model["name"] for model in models["models"]}
    assert names == set(catalogue.load().models)
    assert {line.split()[0] for line in text} == names
    assert models["problems"] == []
    (keithley,) = (model for model in models["models"] if model["name"] == "keithley-6485")
    assert keithley["kind"] == "light-sensor"
    assert keithley["line"]["baudrate"] == 9600
    assert keithley["options"]["line_frequency_hz"]["type"] == "int"


def test_devices_show_tells_options_and_line(lab: Lab) -> None:
    text = lab.rig("devices", "show", "oriental-az").out
    assert re.search(r"^  steps_per_degree +50\.0 +scale", text, re.MULTILINE)
    assert re.search(r'^  parity +"E"', text, re.MULTILINE)
    shown = lab.rig("devices", "show", "oriental-az", "--json").json
    assert (shown["options"]["home_bit"]["default"], shown["line"]["parity"]) == (4, "E")
    wrong = lab.rig("devices", "show", "oriental", code=2)
    assert re.fullmatch(r"rig: .*unknown model 'oriental'.*did you mean 'oriental-az'.*\n", wrong.err)


# Looking


def test_probe_tells_identity_and_state_and_moves_nothing(lab: Lab, running: Running) -> None:
    before = {name: track.nominal(running.world.clock.now())[0] for name, track in running.world.axes.items()}
    stops = len(running.stops())
    lines = lab.rig("devices", "probe").out.splitlines()
    assert [line.split()[1] for line in lines] == [*AXES, *SENSORS]
    assert all(line.startswith("SIMULATED: ") for line in lines)
    assert "KEITHLEY INSTRUMENTS INC. 6485" in lines[3]
    told = lab.rig("devices", "probe", "--json", "--trace", "probe.jsonl").json
    assert told["simulated"] is True
    rows = {row["name"]: row for row in told["devices"]}
    assert list(rows) == [*AXES, *SENSORS]
    assert all(row["error"] == "" for row in rows.values())
    assert re.search(r"; own position \d+(\.\d+)? deg, ", lines[1])
    (detector,) = lab.rig("status", "detector", "--json").json["axes"]
    assert rows["detector"]["state"]["own_position"] == pytest.approx(detector["position"] + 100.0, abs=0.001)  # its offset
    assert all(re.search(r"; (reads -?\d|not good)", line) for line in lines[3:])
    assert rows["lamp"]["state"]["value"] == pytest.approx(float(running.world.truth(45.0, -20.0, "apogee")), rel=0.1)
    assert (rows["sensor"]["state"]["unit"], rows["sensor"]["state"]["good"]) == ("A", True)
    assert {rows[name]["identity"]["vendor"] for name in rows} == {
        "Newport",
        "Zaber",
        "KEITHLEY INSTRUMENTS INC.",
        "Apogee",
        "Baumer Electric AG",
    }
    assert rows["x"]["state"]["unit"] == "mm"
    assert rows["plate"]["state"]["near_mm"] == 50.0
    traced = {json.loads(line)["port"] for line in (lab.folder / "probe.jsonl").read_text().splitlines()[1:]}
    assert traced == {row["port"] for row in rows.values()}
    assert {name: track.nominal(running.world.clock.now())[0] for name, track in running.world.axes.items()} == before
    assert len(running.stops()) == stops


@pytest.mark.parametrize("dead", ["absent", "silent"])
def test_what_does_not_answer_is_a_line_and_the_others_answer(lab: Lab, monkeypatch: pytest.MonkeyPatch, dead: str) -> None:
    monkeypatch.setattr("rig.ports.LINK_TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = nowhere() if dead == "absent" else f"socket://127.0.0.1:{silent.getsockname()[1]}"
        lab.configure(newport=url)
        probed = lab.rig("devices", "probe", "--json", code=1).json["devices"]
        status = lab.rig("status", code=1).out.splitlines()
        stopped = lab.rig("stop", "--json", code=1).json["axes"]
    assert [row["name"] for row in probed if row["error"]] == ["source"]
    assert probed[0]["error"].startswith("TransportTimeout: ")
    assert url in probed[0]["error"]
    assert status[0].startswith("SIMULATED: source: TransportTimeout: ")
    assert [re.match(r"SIMULATED: (\w+): -?\d+\.\d+ ", line) is not None for line in status] == [False, True, True]
    assert [(row["name"], row["error"] == "") for row in stopped] == [("source", False), ("detector", True), ("x", True)]


def test_status_tells_position_limits_and_last_command(homed: Lab) -> None:
    lines = homed.rig("status").out.splitlines()
    assert re.fullmatch(
        r"SIMULATED: detector: -20\.000 deg, at rest, homed, limits -85 to 85, "
        r"last told -20 deg, came to rest at -20\.000 deg at [-0-9 :]+",
        lines[1],
    )
    (row,) = homed.rig("status", "x", "--json").json["axes"]
    assert (row["name"], row["unit"], row["homed"], row["moving"], row["low"], row["high"]) == ("x", "mm", True, False, 0.0, 150.0)
    assert row["last_command"].startswith("last told homing, came to rest at 0.000 mm at ")
    assert homed.rig("status", "detector", "x", "--json").json["axes"][0]["name"] == "detector"


# Moving


def test_homing_is_done_where_it_is_needed(lab: Lab, running: Running) -> None:
    lab.rig("home", "source")
    lab.rig("home", "detector", "--again")
    lab.rig("move", "detector", "-20")
    had = lab.rig("home", "detector")
    assert had.out == "SIMULATED: detector had its reference, at -20.000 deg\n"
    again = lab.rig("home", "detector", "x", "--again", "--json").json
    assert all(row["simulated"] is True for row in again)
    assert [(row["axis"], row["homed"], row["moved"]) for row in again] == [("detector", True, True), ("x", True, True)]
    assert again[0]["position"] == pytest.approx(-100.0, abs=0.001)


def test_a_move_goes_there_negative_ones_too(homed: Lab, running: Running) -> None:
    moved = homed.rig("move", "detector", "-30")
    assert moved.out == "SIMULATED: detector at -30.000 deg\n"
    assert running.world.arms["detector"].nominal(running.world.clock.now()) == pytest.approx(-30.0, abs=0.001)
    row = homed.rig("move", "detector", "-12.5", "--json", "--trace", "move.jsonl").json
    assert row == {"axis": "detector", "setpoint": -12.5, "readback": pytest.approx(-12.5, abs=0.001), "unit": "deg", "simulated": True}
    homed.rig("move", "source", "30")
    assert running.world.arms["source"].nominal(running.world.clock.now()) == pytest.approx(30.0, abs=0.01)
    homed.rig("move", "x", "12.5")
    assert running.world.axes["linear:1"].nominal(running.world.clock.now())[0] == pytest.approx(12.5, abs=0.001)


REFUSED = {
    "beyond a limit": (("move", "detector", "-86"), 1, "axis detector: -86 deg is outside its limits -85 to 85 deg"),
    "beyond a limit in mm": (("move", "x", "150.5"), 1, "axis x: 150.5 mm is outside its limits 0 to 150 mm"),
    "not a number": (("move", "detector", "left"), 2, "expected a number"),
    "no number at all": (("move", "detector", "nan"), 1, "outside its limits"),
    "endless": (("move", "detector", "inf"), 1, "outside its limits"),
    "no such axis": (("move", "tilt", "10"), 2, "no axis 'tilt' in rig.toml; there are source, detector, x"),
    "no such axis to home": (("home", "tilt"), 2, "no axis 'tilt'"),
    "no such axis to look at": (("status", "tilt"), 2, "no axis 'tilt'"),
    "no such sensor": (("read", "ear"), 2, "no sensor 'ear' in rig.toml; there are sensor, lamp, plate"),
    "no position": (("move", "detector"), 2, "Missing argument"),
    "an option that is none": (("move", "detector", "10", "--fast"), 2, "--fast"),
    "an option mistyped": (("move", "detector", "-10", "--hom"), 2, "--hom"),
    "a number mistyped": (("move", "detector", "-1o"), 2, "-1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_one_line_before_anything_is_opened(tmp_path: Path, case: str) -> None:
    lab = Lab(tmp_path)
    lab.configure(MIXED, **{name: f"/dev/ttyNONE-{name}" for name in INSTRUMENTS})
    arguments, code, says = REFUSED[case]
    done = lab.rig(*arguments, code=code)
    assert says in done.err
    assert says[:1] != "-" or re.match(rf"rig: No such option:? '?{says}\b", done.err)
    assert re.fullmatch(r"rig: .*\n", done.err)
    assert done.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["rig.toml"]


def test_the_keep_out_is_refused_before_anything_moves(homed: Lab, running: Running) -> None:
    begun = [track.nominal(running.world.clock.now())[0] for track in running.world.axes.values()]
    for axis, target in (("detector", "44"), ("source", "-0"), ("source", "0")):
        if axis == "source":
            homed.rig("move", "detector", "-2")
            begun = [track.nominal(running.world.clock.now())[0] for track in running.world.axes.values()]
        done = homed.rig("move", axis, target, code=1)
        assert re.fullmatch(r"rig: .* would stand within 3 deg of .*, too close\n", done.err)
    assert [track.nominal(running.world.clock.now())[0] for track in running.world.axes.values()] == begun


def test_without_a_reference_it_does_not_move_unless_told_to_home(tmp_path: Path) -> None:
    with serving("newport", "stages", "linear", "meter", source="newport:1", detector="stages:2") as fresh:
        lab = Lab(tmp_path, places(fresh) | {"apogee": nowhere(), "om20": nowhere()})
        lab.configure()
        refused = lab.rig("move", "x", "10", code=1)
        assert re.fullmatch(r"rig: x has no reference; `rig home x` finds it, or --home .*\n", refused.err)
        assert not AxisRecords(Workspace(tmp_path / "rig-data").axes).get("anything")
        assert lab.rig("move", "x", "10", "--home").out == "SIMULATED: x at 10.000 mm\n"


def test_the_next_program_knows_what_the_last_one_left(homed: Lab, running: Running) -> None:
    """The controller of the source does not tell that it was homed."""
    seen = len(running.stops())
    assert homed.rig("status", "source", "--json").json["axes"][0]["homed"] is True
    done = homed.rig("move", "source", "30")
    assert done.err == ""
    assert homed.rig("home", "source").out == "SIMULATED: source had its reference, at 30.000 deg\n"
    assert len(running.stops()) > seen  # each program leaves its axes stopped

    # Somebody else turns it: then it is not trusted.
    esp = catalogue.load().lookup("newport-esp301")
    with esp.open_link(running.url("newport")) as link:
        stage = esp.open_device(link, name="by hand", axis=1)
        stage.trust_reference()  # type: ignore[union-attr]
        stage.start_move(100.0)  # type: ignore[union-attr]
        while stage.state().moving:  # type: ignore[union-attr]
            pass
    assert homed.rig("status", "source", "--json").json["axes"][0]["homed"] is False
    noted = homed.rig("move", "source", "30", code=1)
    assert re.match(r"note: source was left at 30\.000 deg and is at 10\.000 deg: .*\nrig: source has no reference", noted.err)


def test_a_program_that_was_killed_on_the_way_leaves_a_notice(homed: Lab, running: Running) -> None:
    config = homed.configure()
    records = AxisRecords(homed.folder / "rig-data" / "axes.json")
    records.put(config.axes["x"].identity, setpoint=70.0, readback=0.0, under_way=True, homed=True)
    assert "last told 70 mm at " in homed.rig("status", "x").out
    assert "its end was not seen" in homed.rig("status", "x").out
    assert homed.rig("move", "x", "5").err.startswith("note: x was on its way to 70.000 mm when the last program")
    assert homed.rig("move", "x", "6").err == ""


SLOW = MIXED.replace("speed = 60.0", "speed = 1.0")
"""A bench on which a move of 60 deg takes a minute: 1.5 s of the tests'."""


@contextmanager
def as_soon_as(condition: Callable[[], bool], then: Callable[[], None]) -> Iterator[None]:
    """Do something once from another thread."""
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            if condition():
                then()
                return

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_a_move_stops_the_axis(homed: Lab, running: Running, number: signal.Signals) -> None:
    homed.rig("move", "detector", "-20")
    homed.configure(SLOW)
    arm, clock = running.world.arms["detector"], running.world.clock
    seen = len(running.stops())
    with as_soon_as(lambda: arm.nominal(clock.now()) > -18.0, lambda: os.kill(os.getpid(), number)):
        done = homed.rig("move", "detector", "40", code=130)
    assert done.err.splitlines()[-1] == f"rig: interrupted: interrupted by {number.name}"
    assert not arm.moving(clock.now())
    assert -18.0 < arm.nominal(clock.now()) < 39.0
    assert "stages:2" in {stop.axis for stop in running.stops()[seen:]}
    where = arm.nominal(clock.now())
    homed.configure()
    (row,) = homed.rig("status", "detector", "--json").json["axes"]
    assert row["position"] == pytest.approx(where, abs=0.001)
    assert row["last_command"].startswith("last told 40 deg, came to rest at ")
    assert homed.rig("move", "detector", "-20").err == ""  # nothing to take note of: what was asked for was done


def test_a_signal_during_homing_stops_the_axis(homed: Lab, running: Running) -> None:
    track, clock = running.world.axes["linear:1"], running.world.clock
    homed.rig("move", "x", "60")
    with as_soon_as(lambda: track.nominal(clock.now())[0] < 59.0, lambda: os.kill(os.getpid(), signal.SIGINT)):
        homed.rig("home", "x", "--again", code=130)
    assert not track.moving(clock.now())
    assert track.nominal(clock.now())[0] > 1.0


def test_stop_tells_every_axis(homed: Lab, running: Running) -> None:
    seen = len(running.stops())
    lines = homed.rig("stop").out.splitlines()
    assert [re.fullmatch(r"SIMULATED: (\w+): told to stop, at rest at -?\d+\.\d{3} (deg|mm)", line)[1] for line in lines] == AXES  # type: ignore[index]
    assert {stop.axis for stop in running.stops()[seen:]} == {"newport:1", "stages:2", "linear:1"}
    told = homed.rig("stop", "--json").json
    assert (told["simulated"], told["owners"]) == (True, [])
    assert all(row["simulated"] is True for row in told["axes"])


# A disk that takes nothing


def test_a_trace_that_broke_off_is_said_at_the_end_and_spoils_nothing(
    homed: Lab, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks(self: Trace, *_: object) -> None:
        leave(self, None, None, None)
        self.broken = "--trace: the disk is full"

    leave = Trace.__exit__
    monkeypatch.setattr(Trace, "__exit__", breaks)
    homed.rig("move", "x", "22.5")
    done = homed.rig("move", "x", "21", "--trace", "wires.jsonl")
    assert done.out == "SIMULATED: x at 21.000 mm\n"
    assert done.err == "--trace: the disk is full\n"
    config = homed.configure()
    head = json.loads((homed.folder / "wires.jsonl").read_text().splitlines()[0])
    assert head["records"][config.axes["x"].identity]["setpoint"] == 22.5  # as it was when the command began


def test_without_a_workspace_that_can_be_written_nothing_moves_and_one_line_says_so(homed: Lab, running: Running) -> None:
    (homed.folder / "rig-data" / "axes.json").unlink()
    (homed.folder / "rig-data").rename(homed.folder / "elsewhere")
    (homed.folder / "rig-data").write_text("a file where a folder should be")
    before = {name: track.nominal(running.world.clock.now())[0] for name, track in running.world.axes.items()}
    for command in (("home", "x", "--again"), ("move", "detector", "-30"), ("sweep", "--cultivar", "RR", "--theta-r", "0")):
        done = homed.rig(*command, code=1)
        assert re.fullmatch(r"(note: .*\n)*rig: .*rig-data.*\n", done.err)
    assert {name: track.nominal(running.world.clock.now())[0] for name, track in running.world.axes.items()} == before
    looked = homed.rig("status", "detector")
    assert "SIMULATED: detector: -20.000 deg" in looked.out
    assert re.fullmatch(r"note: .*axes\.json: cannot be read: .*\n", looked.err)
    homed.rig("stop")
    homed.rig("read", "lamp")


def test_a_damaged_record_is_a_notice_to_who_looks_and_an_error_to_who_moves(homed: Lab, running: Running) -> None:
    (homed.folder / "rig-data" / "axes.json").write_text("{")
    looked = homed.rig("status", "x")
    assert looked.out.startswith("SIMULATED: x: ")
    assert re.fullmatch(r"note: .*axes\.json: not the record .*\n", looked.err)
    assert "not the record" in homed.rig("move", "x", "1", code=1).err
    homed.rig("stop")


def test_when_the_end_of_a_motion_cannot_be_written_it_does_not_say_that_nothing_was_moved(
    homed: Lab, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rig import files

    def fills_up(path: Path, text: str) -> None:
        if '"under_way": false' in text.split(f'"{homed.urls["linear"]}')[1]:
            raise OSError(28, "No space left on device")
        files.write_atomically(path, text)

    monkeypatch.setattr("rig.axisrecord.write_atomically", fills_up)
    done = homed.rig("move", "x", "33", code=1)
    assert re.fullmatch(
        r"rig: .*axes\.json: cannot be written: No space left on device; where the axis stands now is not on record\n", done.err
    )
    assert running.world.axes["linear:1"].nominal(running.world.clock.now())[0] == pytest.approx(33.0, abs=0.001)


# Reading


def test_read_takes_readings_of_all_sensors(homed: Lab, running: Running) -> None:
    homed.rig("move", "x", "20")
    lines = homed.rig("read").out.splitlines()
    assert [line.split()[1] for line in lines] == SENSORS
    rows = [json.loads(line) for line in homed.rig("read", "--count", "2", "--json", "--trace", "read.jsonl").out.splitlines()]
    assert [row["sensor"] for row in rows] == SENSORS * 2
    assert all(row["good"] and row["simulated"] is True for row in rows)
    current, lamp, plate = rows[:3]
    assert current["value"] == pytest.approx(float(running.world.truth(45.0, -20.0)), rel=0.05)
    assert (current["unit"], lamp["unit"], plate["unit"]) == ("A", "umol/(m^2 s)", "mm")
    assert lamp["value"] == pytest.approx(float(running.world.truth(45.0, -20.0, "apogee")), rel=0.05)
    assert plate["value"] == pytest.approx(80.0, abs=0.5)


def test_a_reading_that_is_not_good_has_no_value(homed: Lab, running: Running) -> None:
    homed.rig("move", "x", "120")  # the plate is farther away than the sensor can see
    assert re.fullmatch(r"SIMULATED: plate not good \(out_of_range.*\)\n", homed.rig("read", "plate").out)
    row = homed.rig("read", "plate", "--json").json
    assert (row["value"], row["good"]) == (None, False)
    assert "out_of_range" in row["flags"]
    homed.rig("move", "x", "20")
    assert homed.rig("read", "plate", "--json").json["good"] is True


def test_trouble_that_was_dealt_with_is_said(homed: Lab, running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.ports.LINK_TIMEOUT_S", 0.2)
    for command in (("status", "x"), ("home", "x")):
        before = len(running.struck("linear"))
        running.inject("linear", Fault("silence", seed=1))
        done = homed.rig(*command)
        assert len(running.struck("linear")) == before + 1
        assert re.fullmatch(r"trouble on the wires, dealt with: x: repeated.*\n", done.err)
    assert homed.rig("status", "x").err == ""


# A sweep with a monitor


def test_a_monitor_is_stored_at_every_point(homed: Lab, running: Running) -> None:
    homed.rig("sweep", "--cultivar", "RR", "--theta-r", "-20,0,20", "--out", "run")
    documents = Run(homed.folder / "run").documents
    (start,) = (doc for name, doc in documents if name == "start")
    assert start["detectors"] == ["current", "lamp"]
    events = [doc["data"] for name, doc in documents if name == "event"]
    assert len(events) == 3
    expected = float(running.world.truth(45.0, 0.0, "apogee"))
    for event in events:
        assert event["lamp"] == pytest.approx(expected, rel=0.1)
        assert event["lamp_good"] == 1
        assert "plate" not in event
    (descriptor,) = (doc for name, doc in documents if name == "descriptor")
    assert descriptor["data_keys"]["lamp"]["units"] == "umol/(m^2 s)"
    assert descriptor["configuration"]["lamp"]["data"]["lamp_vendor"] == "Apogee"


# The simulated bench that starts and ends with the command


def test_on_the_simulated_bench_the_commands_work_and_nothing_is_remembered(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    probed = lab.rig("devices", "probe", "--json").json
    assert [row["error"] for row in probed["devices"]] == ["", "", ""]
    assert [row["port"] for row in probed["devices"]] == ["sim:stages", "sim:stages", "sim:meter"]
    moved = lab.rig("move", "detector", "-30", "--home")
    assert moved.out == "SIMULATED: detector at -30.000 deg\n"
    assert lab.rig("read").out.startswith("SIMULATED: sensor ")
    assert list(tmp_path.iterdir()) == []


def test_the_speed_of_this_bench_is_the_tests() -> None:
    assert f"speed = {SPEED}" in MIXED.format(speed=SPEED, **dict.fromkeys(INSTRUMENTS, "p"))
