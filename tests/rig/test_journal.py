import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rig.errors import RunError
from rig.journal import JournalWriter, read_documents


def written(path: Path, *documents: tuple[str, dict]) -> Path:
    with closing(JournalWriter(path)) as journal:
        for name, doc in documents:
            journal(name, doc)
    return path


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    documents = [("start", {"uid": "a", "angles": [1.5, 2]}), ("event", {"data": {"x": 1e-9}})]
    assert list(read_documents(written(tmp_path / "j", *documents))) == documents


def test_numpy_of_any_kind_is_written(tmp_path: Path) -> None:
    doc = {"a": np.linspace(0, 1, 3), "b": np.float32(0.5), "c": np.int16(3), "d": np.bool_(True), "e": (1, 2), "f": tmp_path}
    ((_, read),) = read_documents(written(tmp_path / "j", ("start", doc)))
    assert read == {"a": [0, 0.5, 1], "b": 0.5, "c": 3, "d": True, "e": [1, 2], "f": str(tmp_path)}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), np.float64("nan"), np.array([1.0, np.nan]), object()])
def test_what_json_cannot_say_is_refused_by_name(tmp_path: Path, value: object) -> None:
    with pytest.raises(RunError, match=r"event\.data\.current"):
        written(tmp_path / "j", ("event", {"data": {"current": value}}))


def test_each_document_is_on_the_disk_before_the_call_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr("os.fsync", lambda handle: synced.append((tmp_path / "j").stat().st_size))
    journal = JournalWriter(tmp_path / "j")
    journal("start", {"uid": "a"})
    journal("event", {"x": 1})
    assert synced[-2:] == [len(line) for line in ((tmp_path / "j").read_bytes().split(b"\n")[0] + b"\n", (tmp_path / "j").read_bytes())]
    journal.close()


def test_a_torn_last_line_is_passed_over_and_what_comes_after_is_read(tmp_path: Path) -> None:
    path = written(tmp_path / "j", ("start", {"uid": "a"}), ("event", {"n": 1}))
    whole = path.read_bytes()
    for cut in range(len(whole) - 1, len(whole.split(b"\n")[0]) + 1, -1):
        path.write_bytes(whole[:cut])
        assert [name for name, _ in read_documents(path)] in (["start"], ["start", "event"])
    path.write_bytes(whole + b'{"name": "event", "doc": {"n"')
    written(path, ("start", {"uid": "b"}), ("event", {"n": 2}))
    assert [doc for _, doc in read_documents(path)] == [{"uid": "a"}, {"n": 1}, {"uid": "b"}, {"n": 2}]


def test_damage_in_the_middle_is_named_by_line(tmp_path: Path) -> None:
    path = written(tmp_path / "j", ("start", {"uid": "a"}), ("event", {"n": 1}), ("event", {"n": 2}))
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([lines[0], lines[1][:-5], lines[2], b""]))
    with pytest.raises(RunError, match=r"j:2: not a document"):
        list(read_documents(path))


def test_the_reason_of_an_abort_is_kept(tmp_path: Path) -> None:
    journal = JournalWriter(tmp_path / "j", abort_reason=lambda: "interrupted by SIGINT")
    journal("stop", {"exit_status": "abort", "reason": ""})
    journal("stop", {"exit_status": "fail", "reason": "unplugged"})
    journal.close()
    reasons = [json.loads(line)["doc"]["reason"] for line in (tmp_path / "j").read_text().splitlines()]
    assert reasons == ["interrupted by SIGINT", "unplugged"]


def test_a_full_disk_ends_the_run_by_name(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    with closing(JournalWriter(Path("/dev/full"))) as journal, pytest.raises(RunError, match=r"/dev/full: .*No space left"):
        journal("start", {"uid": "a"})
