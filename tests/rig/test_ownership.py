"""One program at a time has a port of this machine, whatever its workspace and whatever it calls the port."""

from __future__ import annotations

import json
import os
import re
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig import ownership
from rig.errors import RunError
from rig.ownership import PortInUse, canonical, claimed, owners
from tests.conftest import ROOT
from tests.rig.lab import INSTRUMENTS, MIXED, Lab, places, serving

HOLD = """
import sys
from rig import ownership
ownership.PLACES = (sys.argv[1],)
with ownership.claimed(sys.argv[2:]):
    print("mine", flush=True)
    sys.stdin.readline()
"""

PORT = "socket://127.0.0.1:4001"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of our own."""
    folder = tmp_path / "machine"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr(ownership, "PLACES", (str(folder),))
    monkeypatch.setattr(ownership, "PATIENCE_S", 0.05)
    return folder


def holder(place: Path, *ports: str, program: str = HOLD) -> subprocess.Popen[str]:
    """Start a program that has ports."""
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    command = [sys.executable, "-c", program, str(place), *ports]
    process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=nothing, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "mine\n"
    return process


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


@pytest.fixture
def held(place: Path) -> Iterator[subprocess.Popen[str]]:
    """Another program that has `PORT`."""
    process = holder(place, PORT)
    yield process
    end(process)


def test_a_second_program_is_refused_and_told_who_has_it(held: subprocess.Popen[str]) -> None:
    with (
        pytest.raises(PortInUse, match=rf"in use by process {held.pid} \(rig .*\), which has {PORT}; wait for it, or `rig stop`") as busy,
        claimed(["socket://localhost:4001"]),
    ):
        raise AssertionError("both have it")
    assert busy.value.owner is not None
    assert busy.value.owner.pid == held.pid
    with claimed(["socket://127.0.0.1:4002"]):  # another port is free
        assert {owner.pid for owner in owners(None)} == {held.pid, os.getpid()}
    assert [owner.pid for owner in owners(None)] == [held.pid]
    assert owners(["socket://127.0.0.1:4002"]) == []


def test_of_several_ports_all_or_none_are_had(held: subprocess.Popen[str]) -> None:
    with pytest.raises(PortInUse), claimed(["socket://127.0.0.1:3999", PORT, "socket://127.0.0.1:4100"]):
        raise AssertionError("both have it")
    assert [owner.pid for owner in owners(None)] == [held.pid]


def test_after_a_kill_it_is_free(place: Path) -> None:
    process = holder(place, PORT)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    (path,) = (place / ownership.FOLDER).iterdir()
    assert json.loads(path.read_text())["pid"] == process.pid
    assert owners([PORT]) == owners(None) == []  # the pid that is still written there is nobody's
    with claimed([PORT]):
        assert json.loads(path.read_text())["pid"] == os.getpid()
    assert not path.exists()  # nothing is left behind


def test_it_is_free_again_after_an_error(place: Path) -> None:
    with pytest.raises(ValueError, match="trouble"), claimed([PORT]):
        raise ValueError("trouble")
    with claimed([PORT, "socket://localhost:4001"]):  # twice the same is one
        assert [(owner.pid, owner.ports) for owner in owners(None)] == [(os.getpid(), (PORT,))]


def test_a_look_that_lasts_no_longer_than_patience_is_waited_for(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ownership, "PATIENCE_S", 10.0)
    process = holder(place, PORT)
    looks = iter(range(100))

    def look(s: float) -> None:
        if next(looks) == 2:
            end(process)

    monkeypatch.setattr("rig.ownership.time.sleep", look)
    with claimed([PORT]):
        assert [owner.pid for owner in owners(None)] == [os.getpid()]


def test_many_that_want_it_have_it_one_after_the_other(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file of a lock goes with its owner, perhaps between another's opening and locking it."""
    monkeypatch.setattr(ownership, "PATIENCE_S", 30.0)
    monkeypatch.setattr(ownership, "LOOK_S", 0.0)
    having: list[int] = []
    most: list[int] = []

    def take(number: int) -> None:
        for _ in range(50):
            with claimed([PORT]):
                having.append(number)
                most.append(len(having))
                having.remove(number)

    threads = [threading.Thread(target=take, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1] * 200


def test_ending_who_has_it_waits_for_the_end(held: subprocess.Popen[str]) -> None:
    (owner,) = owners([PORT])
    assert not owner.await_end(0.0)
    owner.terminate()
    assert owner.await_end(10.0)
    held.communicate()
    assert held.returncode == -signal.SIGTERM
    owner.terminate()  # gone already: nothing to do


def test_one_that_does_not_end_is_known_to_be_there(place: Path) -> None:
    stubborn = HOLD.replace("import sys", "import signal, sys\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)", 1)
    process = holder(place, PORT, program=stubborn)
    try:
        (owner,) = owners(None)
        owner.terminate()
        assert not owner.await_end(0.1)
    finally:
        end(process)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("socket://localhost:4001", "socket://127.0.0.1:4001"),
        ("socket://LOCALHOST:4001/", "SOCKET://127.0.1.1:4001?logging=debug"),
        ("socket://[::1]:4001", "socket://127.0.0.1:4001"),
        ("rfc2217://Gateway.lab:2217", "rfc2217://gateway.lab:2217?ign_set_control"),
        ("spy:///dev/null?file=log.txt", "/dev/null"),
        ("/dev/../dev/null", "/dev/null"),
        ("folder:/tmp/../tmp/pictures", "folder:/tmp/pictures"),
    ],
)
def test_names_of_one_port(one: str, other: str) -> None:
    assert canonical(one) == canonical(other)


def test_names_of_two_ports(tmp_path: Path) -> None:
    names = [
        "socket://127.0.0.1:4001",
        "socket://127.0.0.1:4002",
        "socket://10.0.0.1:4001",
        "rfc2217://127.0.0.1:4001",
        "/dev/null",
        "COM3",
    ]
    assert len({canonical(name) for name in names}) == len(names)
    link = tmp_path / "by-id"
    link.symlink_to("/dev/null")
    assert canonical(str(link)) == "/dev/null"


def test_the_locks_are_everybodys(place: Path) -> None:
    before = os.umask(0o077)
    try:
        with claimed([PORT]):
            folder = place / ownership.FOLDER
            (path,) = folder.iterdir()
            assert stat.S_IMODE(folder.stat().st_mode) == 0o1777
            assert stat.S_IMODE(path.stat().st_mode) == 0o666
    finally:
        os.umask(before)


def test_where_no_lock_can_be_written_nothing_is_claimed_and_nobody_owns_anything(place: Path) -> None:
    (place / ownership.FOLDER).write_text("a file where a folder should be")
    with (
        pytest.raises(RunError, match=rf"{ownership.FOLDER}: other programs cannot be kept off .*: Not a directory"),
        claimed([PORT]),
    ):
        raise AssertionError("claimed without a lock")
    assert owners(None) == owners([PORT]) == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"pid": 0, "command": "rig", "port": "p", "since": 0}', '{"pid": "x"}'])
def test_a_file_that_says_nothing_names_nobody(place: Path, text: str) -> None:
    with claimed([PORT]):
        (path,) = (place / ownership.FOLDER).iterdir()
        path.write_text(text)
        assert owners(None) == []
        with pytest.raises(PortInUse, match="in use by another program, which has"), claimed([PORT]):
            raise AssertionError("both have it")


def test_what_opens_an_instrument_is_refused_while_another_has_it_and_status_says_who(tmp_path: Path, place: Path) -> None:
    """The other program has another workspace, and calls the ports by other names."""
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        lab = Lab(tmp_path, places(running))
        lab.configure()
        lab.rig("home", "x")
        names = [running.url(name).replace("127.0.0.1", "localhost") for name in ("linear", "om20")]
        process = holder(place, *names)
        try:
            for command in (("home",), ("move", "x", "10"), ("read", "plate")):
                refused = lab.rig(*command, code=1)
                assert re.fullmatch(rf"rig: the bench is in use by process {process.pid} \(.*\n", refused.err)
            status = lab.rig("status", code=0)
            assert status.err == ""
            assert re.fullmatch(
                rf"SIMULATED: x: in use by process {process.pid} \(rig .*\), last told homing, came to rest at 0\.000 mm at .*",
                status.out.splitlines()[2],
            )
            x = lab.rig("status", "x", "--json").json["axes"][0]
            assert (x["in_use_by"]["pid"], x["position"], x["error"]) == (process.pid, None, "")
            probed = {row["name"]: row["error"] for row in lab.rig("devices", "probe", "--json", code=1).json["devices"]}
            assert [name for name, error in probed.items() if error] == ["x", "plate"]
            assert f"in use by process {process.pid} " in probed["plate"]
            lab.rig("read", "lamp")  # nobody's
        finally:
            end(process)
        lab.rig("move", "x", "10")
        assert not any(track.moving(running.world.clock.now()) for track in running.world.axes.values())


def test_a_sweep_has_its_arms_and_sensors_and_no_more(tmp_path: Path, place: Path) -> None:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        lab = Lab(tmp_path, places(running))
        lab.configure(MIXED)
        sweep = ("sweep", "--cultivar", "RR", "--theta-r", "0", "--out", "run")
        for name in ("newport", "stages", "meter", "apogee"):
            process = holder(place, running.url(name))
            refused = lab.rig(*sweep, code=None)
            end(process)
            assert refused.code == 1
            assert f"in use by process {process.pid} " in refused.err
            assert not (tmp_path / "run").exists()
        process = holder(place, running.url("linear"))
        lab.rig(*sweep)
        end(process)
