"""Asking a bench's instruments one by one: all ports at once, a dead one hides no other, and nothing moves or is set."""

from __future__ import annotations

import math
import os
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from drivers import catalogue
from drivers.errors import TransportTimeout
from drivers.kinds import AxisState, LightReading
from rig.axisrecord import AxisRecords
from rig.bench import Paperwork
from rig.ownership import claimed, owners
from rig.probing import axis_rows, probe_rows
from rig.stopping import Ending, stop_rows
from tests.rig.scripted import SCRIPTED, ScriptedBench, ScriptedEye, rest, scripted_bench

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
    assert rows[2]["state"] == {"own_position": 1.2346, "unit": "deg", "moving": True, "homed": False, "warnings": ["WR", "FS"]}
    assert rows[2]["identity"]["model"] == "scripted"
    assert rows[3]["state"] == {"value": 1.0, "unit": "lx", "good": True, "status": 0, "flags": [], "integration_s": 0.1}
    assert sorted(scripted.closed) == sorted(scripted.opened) == sorted(["one", "two", "three", "four", "five", "six"])


def test_what_needs_somebody_to_take_a_picture_is_not_read(scripted: ScriptedBench, monkeypatch: pytest.MonkeyPatch) -> None:
    known = dict(catalogue.load().models)
    known["scripted-eye"] = replace(known["scripted-eye"], reads_at_once=False)
    monkeypatch.setattr("drivers.catalogue.load", lambda: catalogue.Catalogue(known))
    monkeypatch.setattr(ScriptedEye, "read", lambda self: pytest.fail("was read"))
    assert probe_rows(scripted.config, Paperwork())[3]["state"] == {"unit": "lx", "integration_s": 0.1}


def test_a_reading_that_is_not_good_is_told_as_such(scripted: ScriptedBench, monkeypatch: pytest.MonkeyPatch) -> None:
    over = LightReading(math.inf, "lx", 4, over_range=True, flags=("overflow",))
    monkeypatch.setattr(ScriptedEye, "read", lambda self: over)
    state = probe_rows(scripted.config, Paperwork())[3]["state"]
    assert (state["value"], state["good"], state["status"], state["flags"]) == (None, False, 4, ["over_range", "overflow"])


def test_what_another_program_has_is_not_opened(scripted: ScriptedBench, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("rig.ownership.PLACES", ())
    monkeypatch.setattr("rig.ownership.tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr("rig.ownership.PATIENCE_S", 0.0)
    records = AxisRecords(tmp_path / "axes.json")
    with claimed(["two", "five"]):
        since = owners(["two"])[0].since
        records.put("two scripted-stage", setpoint=-20.0, readback=0.0, under_way=True, homed=True)
        rows = axis_rows(scripted.config, AXES, Paperwork(records=records))
        probed = probe_rows(scripted.config, Paperwork())
        monkeypatch.setattr("rig.axisrecord.time.time", lambda: since - 1.0)  # an older program's
        records.put("two scripted-stage", setpoint=-20.0, readback=0.0, under_way=True, homed=True)
        older = axis_rows(scripted.config, AXES, Paperwork(records=records))
    assert not {"two", "five"} & set(scripted.opened)
    assert [row["error"] for row in rows] == ["", "", ""]
    assert [row["in_use_by"] and row["in_use_by"]["pid"] for row in rows] == [None, os.getpid(), None]
    assert rows[1]["last_command"].endswith(", on its way")
    assert older[1]["last_command"].endswith(", its end was not seen")
    assert [row["name"] for row in probed if "in use by process" in row["error"]] == ["detector", "lamp"]


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
    rows = stop_rows(scripted.config, Ending([]), Paperwork())
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
