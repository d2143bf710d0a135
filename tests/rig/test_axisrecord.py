"""What each axis was last told, on the disk."""

from __future__ import annotations

import fcntl
import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from drivers.kinds import AxisState
from rig.axisrecord import AxisRecord, AxisRecords
from rig.errors import RunError
from tests.conftest import ROOT


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "rig-data" / "axes.json"


def test_what_is_written_is_found_by_the_next_program(path: Path) -> None:
    assert AxisRecords(path).get("one") is None
    began = time.time()
    AxisRecords(path).put("one", setpoint=30.0, readback=29.999, under_way=False, homed=True)
    AxisRecords(path).of("two").put(setpoint=None, readback=1.0, under_way=True, homed=False)
    one, two = (AxisRecords(path).of(name).get() for name in ("one", "two"))
    assert one is not None
    assert two is not None
    assert (one.setpoint, one.readback, one.under_way, one.homed) == (30.0, 29.999, False, True)
    assert (two.setpoint, two.readback, two.under_way, two.homed) == (None, 1.0, True, False)
    assert began <= one.time <= two.time <= time.time()


def test_the_last_one_counts_and_the_others_stay(path: Path) -> None:
    records = AxisRecords(path)
    records.put("one", setpoint=1.0, readback=1.0, under_way=False, homed=True)
    records.put("two", setpoint=2.0, readback=2.0, under_way=False, homed=True)
    records.put("one", setpoint=3.0, readback=1.0, under_way=True, homed=True)
    found = {name: record.setpoint for name in ("one", "two") if (record := records.get(name))}
    assert found == {"one": 3.0, "two": 2.0}
    assert sorted(child.name for child in path.parent.iterdir()) == [".axes.json.lock", "axes.json"]


@pytest.mark.parametrize("text", ["", "{", "[]", '{"axes": 1}', '{"axes": {"one": {"setpoint": 1.0}}}', '{"schema_version": 1}'])
def test_a_damaged_file_is_named_and_nothing_is_written_over_it(path: Path, text: str) -> None:
    path.parent.mkdir()
    path.write_text(text)
    records = AxisRecords(path)
    with pytest.raises(RunError, match=r"axes\.json: not the record of the axes' last commands: .*home the axes"):
        records.get("one")
    with pytest.raises(RunError, match=r"axes\.json"):
        records.put("one", setpoint=1.0, readback=1.0, under_way=True, homed=True)
    assert path.read_text() == text


def test_what_is_no_number_is_not_written(path: Path) -> None:
    records = AxisRecords(path)
    with pytest.raises(ValueError, match="JSON"):
        records.put("one", setpoint=1.0, readback=float("nan"), under_way=True, homed=True)
    assert records.get("one") is None


def test_a_kill_leaves_the_old_or_the_new_never_half(path: Path) -> None:
    program = f"""
import itertools
from pathlib import Path
from rig.axisrecord import AxisRecords
records = AxisRecords(Path({str(path)!r}))
for number in itertools.count():
    records.put("one", setpoint=float(number), readback=float(number), under_way=True, homed=True)
    records.put("x" * 5000, setpoint=float(number), readback=float(number), under_way=True, homed=True)
    print(number, flush=True)
"""
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        last = [int(process.stdout.readline()) for _ in range(20)][-1]
        process.kill()
        process.communicate()
        record = AxisRecords(path).get("one")
        assert record is not None
        assert record.setpoint is not None
        assert record.setpoint >= last


def test_the_file_is_replaced_as_a_whole(path: Path) -> None:
    records = AxisRecords(path)
    records.put("one", setpoint=1.0, readback=1.0, under_way=False, homed=True)
    with path.open(encoding="utf-8") as old:  # whoever reads it now, reads what was there to its end
        records.put("one", setpoint=2.0, readback=2.0, under_way=False, homed=True)
        assert json.load(old)["axes"]["one"]["setpoint"] == 1.0
    assert json.loads(path.read_text())["axes"]["one"]["setpoint"] == 2.0


def test_axes_may_write_at_once(path: Path) -> None:
    records = AxisRecords(path)

    def write(name: str) -> None:
        for number in range(10):
            records.of(name).put(setpoint=float(number), readback=0.0, under_way=True, homed=True)

    threads = [threading.Thread(target=write, args=(f"axis {number}",)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    document = json.loads(path.read_text())
    assert {name: record["setpoint"] for name, record in document["axes"].items()} == {f"axis {number}": 9.0 for number in range(4)}


def test_programs_that_move_other_axes_lose_nothing_of_each_other(path: Path) -> None:
    program = """
import sys
from pathlib import Path
from rig.axisrecord import AxisRecords
for number in range(40):
    AxisRecords(Path(sys.argv[1])).put(f"{sys.argv[2]} {number}", setpoint=0.0, readback=0.0, under_way=True, homed=True)
"""
    processes = [subprocess.Popen([sys.executable, "-c", program, str(path), name], cwd=ROOT) for name in ("one", "two", "three")]
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert len(AxisRecords(path).fields()) == 120


def test_one_that_never_ends_writing_is_not_waited_for(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.axisrecord.PATIENCE_S", 0.05)
    path.parent.mkdir()
    with (path.parent / ".axes.json.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(
            RunError, match=r"axes\.json: cannot be written: another program has been writing it for 0.05 s; no motion begins"
        ):
            AxisRecords(path).put("one", setpoint=1.0, readback=1.0, under_way=True, homed=True)


@pytest.mark.parametrize(
    ("under_way", "says"), [(True, "no motion begins without it"), (False, "where the axis stands now is not on record")]
)
def test_what_cannot_be_written_is_said_as_it_is(path: Path, under_way: bool, says: str) -> None:
    path.parent.write_text("a file where a folder should be")
    records = AxisRecords(path)
    with pytest.raises(RunError, match=rf"axes\.json: cannot be written: File exists; {says}$"):
        records.put("one", setpoint=1.0, readback=1.0, under_way=under_way, homed=True)
    with pytest.raises(RunError, match=r"axes\.json: cannot be read: Not a directory$"):
        records.get("one")
    assert records.fields() == {}


def test_a_full_disk_leaves_the_old_record_and_no_rubbish(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = AxisRecords(path)
    records.put("one", setpoint=1.0, readback=1.0, under_way=False, homed=True)

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rig.files.os.fsync", full)
    with pytest.raises(RunError, match="No space left on device"):
        records.put("one", setpoint=2.0, readback=1.0, under_way=True, homed=True)
    assert records.fields()["one"]["setpoint"] == 1.0
    assert sorted(child.name for child in path.parent.iterdir()) == [".axes.json.lock", "axes.json"]


@pytest.mark.parametrize(
    ("record", "state", "vouches"),
    [
        (AxisRecord(30.0, 30.0, False, True, 0.0), AxisState(30.01, False, False), True),
        (AxisRecord(None, -30.0, False, True, 0.0), AxisState(-30.0, False, False), True),
        (AxisRecord(30.0, 30.0, True, True, 0.0), AxisState(30.0, False, False), False),
        (AxisRecord(30.0, 30.0, False, False, 0.0), AxisState(30.0, False, False), False),
        (AxisRecord(30.0, 30.0, False, True, 0.0), AxisState(30.0, True, False), False),
        (AxisRecord(30.0, 30.0, False, True, 0.0), AxisState(30.03, False, False), False),
        (AxisRecord(0.0, 0.0, False, True, 0.0), AxisState(0.0, False, False), False),
        (AxisRecord(0.0, 0.01, False, True, 0.0), AxisState(-0.01, False, False), False),
    ],
)
def test_when_a_record_vouches_for_a_reference(record: AxisRecord, state: AxisState, vouches: bool) -> None:
    assert record.vouches(state, 0.02) is vouches
