"""Asking a bench's instruments one by one: all ports at once, a dead one hides no other, and nothing moves or is set."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from drivers.errors import TransportTimeout
from drivers.kinds import AxisState
from rig.axisrecord import AxisRecords
from rig.bench import Paperwork
from rig.probing import axis_rows, probe_rows, stop_rows
from tests.rig.scripted import SCRIPTED, ScriptedBench, rest, scripted_bench

AXES = ("source", "detector", "tilt")
ALL = [*AXES, "sensor", "lamp", "other"]


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> ScriptedBench:
    return scripted_bench(monkeypatch)


def be_silent() -> None:
    raise TransportTimeout("no reply", device="silent one")


def test_every_instrument_is_a_row_in_the_order_of_the_file(scripted: ScriptedBench) -> None:
    scripted.stages["tilt"].see(AxisState(1.23456, moving=True, homed=False, warnings=("WR", "FS")))
    rows = probe_rows(scripted.config, Paperwork())
    assert [row["name"] for row in rows] == ALL
    assert [row["error"] for row in rows] == [""] * 6
    assert rows[2]["state"] == {"position": 1.2346, "unit": "deg", "moving": True, "homed": False, "warnings": ["WR", "FS"]}
    assert rows[2]["identity"]["model"] == "scripted"
    assert rows[3]["state"] == {"unit": "lx", "integration_s": 0.1}
    assert sorted(scripted.closed) == sorted(scripted.opened) == sorted(["one", "two", "three", "four", "five", "six"])


def test_looking_moves_and_sets_nothing(scripted: ScriptedBench) -> None:
    probe_rows(scripted.config, Paperwork())
    axis_rows(scripted.config, AXES, Paperwork())
    for stage in scripted.stages.values():
        assert (stage.told, stage.settings, stage.closings) == ([], 0, 2)


def test_one_that_is_dead_hides_no_other(scripted: ScriptedBench) -> None:
    scripted.stages["detector"].on_look = be_silent
    for rows in (probe_rows(scripted.config, Paperwork()), axis_rows(scripted.config, AXES, Paperwork())):
        assert [row["name"] for row in rows if row["error"]] == ["detector"]
        assert rows[1]["error"].startswith("TransportTimeout: silent one")
    assert scripted.stages["detector"].closings == 2


def test_no_port_waits_for_another(scripted: ScriptedBench) -> None:
    together = threading.Barrier(3)

    def meet() -> None:
        together.wait(5)

    for stage in scripted.stages.values():
        stage.on_look = meet
    assert [row["error"] for row in axis_rows(scripted.config, AXES, Paperwork())] == ["", "", ""]


def test_a_stop_waits_for_no_other_port(scripted: ScriptedBench) -> None:
    stopped = threading.Event()

    def wait_in_vain() -> None:
        stopped.wait(5)
        be_silent()

    scripted.stages["source"].on_stop = wait_in_vain
    scripted.stages["tilt"].on_stop = stopped.set
    rows = stop_rows(scripted.config, Paperwork())
    assert stopped.is_set()
    assert [(row["name"], row["error"] == "") for row in rows] == [("source", False), ("detector", True), ("tilt", True)]
    assert [stage.told for stage in scripted.stages.values()] == [[("stop", None)]] * 3


def test_positions_are_in_theta_and_the_last_command_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    records = AxisRecords(tmp_path / "axes.json")
    scripted = scripted_bench(monkeypatch, SCRIPTED.replace('port = "one"', 'port = "one"\nsign = -1\noffset = 75.0'))
    scripted.stages["detector"].see(rest(-20.0))
    records.put("two scripted-stage", setpoint=-20.0, readback=-20.0, under_way=False, homed=True)
    records.put("three scripted-stage", setpoint=None, readback=3.0, under_way=True, homed=False)
    source, detector, tilt = axis_rows(scripted.config, AXES, Paperwork(records=records))
    assert (source["position"], source["last_command"], source["low"], source["high"]) == (30.0, None, 0.0, 80.0)
    assert detector["last_command"].startswith("last told -20 deg, came to rest at -20.000 deg at ")
    assert tilt["last_command"].startswith("last told homing at ")
    assert tilt["last_command"].endswith(", its end was not seen")
