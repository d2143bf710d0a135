"""What was done about trouble on the wires, beside the run."""

from __future__ import annotations

import threading
from pathlib import Path

from drivers.incidents import Incident, What
from rig.incidents import IncidentLog, describe, read_incidents
from sim.faults import Fault
from tests.rig.lab import INSTRUMENTS, Lab, places, serving


def incident(number: int = 0, device: str = "meter", what: What = "repeated") -> Incident:
    return Incident(1.7e9 + number, "/dev/ttyUSB0", device, "reading", what, f"no reply {number}")


def test_they_are_written_as_they_come_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "incidents.jsonl"
    log = IncidentLog(path)
    assert not path.exists()
    assert read_incidents(path) == []
    log(incident(1))
    assert read_incidents(path) == [incident(1)]
    log(incident(2, "", "resynchronised"))
    assert read_incidents(path) == log.incidents == [incident(1), incident(2, "", "resynchronised")]
    assert IncidentLog(path).incidents == []
    IncidentLog(path)(incident(3))  # measured again, into the same run
    assert len(read_incidents(path)) == 3


def test_a_line_that_a_crash_cut_off_ends_them(tmp_path: Path) -> None:
    path = tmp_path / "incidents.jsonl"
    log = IncidentLog(path)
    log(incident(1))
    log(incident(2))
    whole = path.read_text()
    for text, left in ((whole[:-5], 1), (whole + '{"time_s": 1.0}\n', 2), (whole + "\0\0\0", 2)):
        path.write_text(text)
        assert read_incidents(path) == [incident(1), incident(2)][:left]


def test_the_summary_counts_by_device_and_kind() -> None:
    log = IncidentLog()
    assert log.summary == ""
    for each in (incident(1), incident(2), incident(3, "detector", "motion followed"), incident(4, "", "stale bytes dropped")):
        log(each)
    assert log.summary == "meter: repeated 2 times, detector: motion followed, /dev/ttyUSB0: stale bytes dropped"


def test_links_may_report_at_once(tmp_path: Path) -> None:
    log = IncidentLog(tmp_path / "incidents.jsonl")

    def babble() -> None:
        for number in range(100):
            log(incident(number))

    threads = [threading.Thread(target=babble) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(read_incidents(tmp_path / "incidents.jsonl")) == 400


def test_a_line_for_people_has_time_device_and_reason() -> None:
    line = describe(incident())
    assert line[2] == line[5] == ":"
    assert line.endswith("meter on /dev/ttyUSB0: reading: repeated (no reply 0)")


def test_a_sweep_keeps_them_beside_the_run_and_shows_them(tmp_path: Path) -> None:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        lab = Lab(tmp_path, places(running))
        lab.configure()
        lab.rig("home")
        running.inject("apogee", Fault("silence", seed=1, after=6))
        swept = lab.rig("sweep", "--cultivar", "RR", "--theta-r", "-20,0,20")
        (struck,) = running.struck("apogee")
        assert struck.kind == "silence"
        run_id = swept.out.strip()
        found = read_incidents(tmp_path / "rig-data" / "runs" / run_id / "incidents.jsonl")
        assert {each.device for each in found} == {"lamp"}
        assert "repeated" in {each.what for each in found}
        assert f"trouble on the wires, dealt with: {len(found)} times, see `rig runs show`; the last: lamp on " in swept.err
        shown = lab.rig("runs", "show", "latest").out
        assert f"{len(found)} troubles on the wires, dealt with:" in shown
        assert "lamp on " in shown
        assert lab.rig("runs", "show", "latest", "--json").json["incidents"] == [vars(each) for each in found]
        assert all(reading["good"] for reading in lab.rig("runs", "show", "latest", "--json").json["readings"])

        lab.rig("sweep", "--cultivar", "RR", "--theta-r", "0", "--out", "quiet")
        assert not (tmp_path / "quiet" / "incidents.jsonl").exists()
