"""`--trace`: every byte, both ways, on the disk whatever happens, and good enough to stand in for the instruments."""

from __future__ import annotations

import importlib.resources
import json
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from rig.errors import ConfigError
from rig.runs import Reading, Run
from rig.trace import Trace
from sim import replay
from tests.conftest import ROOT
from tests.rig.lab import INSTRUMENTS, Lab, places, serving

Line = dict[str, Any]


def lines_of(path: Path) -> list[Line]:
    return [json.loads(line) for line in path.read_text(encoding="ascii").splitlines()]


class Tap:
    """A TCP port that hands on to another, and counts."""

    def __init__(self, url: str) -> None:
        self.seen = {"tx": b"", "rx": b""}
        host, port = url.removeprefix("socket://").split(":")
        self._far = (host, int(port))
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        near, _ = self._server.accept()
        with near, socket.create_connection(self._far) as far:
            ways = {near: ("tx", far), far: ("rx", near)}
            while True:
                for end in select.select(list(ways), [], [])[0]:
                    way, other = ways[end]
                    data = end.recv(65536)
                    if not data:
                        return
                    self.seen[way] += data
                    other.sendall(data)

    def close(self) -> None:
        """Wait for the client to have gone."""
        self._thread.join(10)
        self._server.close()


@contextmanager
def tapped(urls: dict[str, str]) -> Iterator[dict[str, Tap]]:
    """Put a tap in front of each."""
    with ExitStack() as stack:
        taps = {name: Tap(url) for name, url in urls.items()}
        for tap in taps.values():
            stack.callback(tap.close)
        yield taps


def test_every_byte_is_in_it_both_ways(tmp_path: Path) -> None:
    with serving(*INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        used = ("newport", "stages", "meter", "apogee")
        with tapped({name: url for name, url in places(running).items() if name in used}) as taps:
            lab = Lab(tmp_path, places(running) | {name: tap.url for name, tap in taps.items()})
            config = lab.configure()
            began = datetime.now(UTC)
            lab.rig("sweep", "--cultivar", "RR", "--theta-r", "-20,20", "--trace", "sweep.jsonl")
    head, *lines = lines_of(tmp_path / "sweep.jsonl")
    assert {line["port"] for line in lines} == {tap.url for tap in taps.values()}
    for tap in taps.values():
        for way in ("tx", "rx"):
            traced = b"".join(bytes.fromhex(line["hex"]) for line in lines if (line["port"], line["way"]) == (tap.url, way))
            assert traced == tap.seen[way]
            assert len(traced) >= 50
    for tap in taps.values():
        times = [line["t"] for line in lines if line["port"] == tap.url]
        assert times == sorted(times)
        assert times[0] >= 0
    assert head["trace"] == 1
    assert abs((datetime.fromisoformat(head["started"]) - began).total_seconds()) < 60
    assert (head["bench"], head["simulated"], head["config"]) == ("mixed", True, config.text)
    assert head["command"][0] == "rig"


def test_an_older_trace_is_never_overwritten(tmp_path: Path) -> None:
    old = tmp_path / "old.jsonl"
    old.write_text("all my work\n")
    lab = Lab(tmp_path)
    lab.configure((importlib.resources.files("rig") / "data/rig.toml").read_text().replace("{", "{{").replace("}", "}}"))
    for command in (("read",), ("status",), ("devices", "probe"), ("home",), ("move", "detector", "10"), ("stop",)):
        done = lab.rig(*command, "--trace", "old.jsonl", code=2)  # and no port was opened: there is none
        assert re.fullmatch(r"rig: --trace old\.jsonl: is there already; .*\n", done.err)
    assert old.read_text() == "all my work\n"
    with pytest.raises(ConfigError, match="cannot be made"):
        Trace(tmp_path / "nowhere" / "t.jsonl", {})


def test_it_is_on_the_disk_though_the_program_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "t.jsonl"
    program = f"""
import os, signal, time
from pathlib import Path
from rig.trace import Trace
trace = Trace(Path({str(path)!r}), {{"bench": "b"}})
listen = trace.traffic("p")
for number in range(100):
    listen(time.monotonic(), "tx", b"%d" % number)
until = time.monotonic() + 10
while '"3939"' not in Path({str(path)!r}).read_text() and time.monotonic() < until:
    time.sleep(0.001)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    trace = replay.load(path)
    assert [event.data for event in trace.events] == [b"%d" % number for number in range(100)]
    assert trace.about["bench"] == "b"


def test_ports_may_write_at_once_and_after_the_end(tmp_path: Path) -> None:
    with Trace(tmp_path / "t.jsonl", {}) as trace:
        listeners = [trace.traffic(f"port {number}") for number in range(4)]

        def babble(number: int) -> None:
            for count in range(200):
                listeners[number](time.monotonic(), "rx", bytes([number, count]) * 50)

        threads = [threading.Thread(target=babble, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    listeners[0](time.monotonic(), "tx", b"too late")
    events = replay.load(tmp_path / "t.jsonl").events
    assert len(events) == 800
    for number in range(4):
        assert [event.data for event in events if event.port == f"port {number}"] == [bytes([number, count]) * 50 for count in range(200)]


class StuckFile:
    """A file on a disk that takes nothing until it is let."""

    def __init__(self, file: Any) -> None:
        self.let = threading.Event()
        self._file = file

    def write(self, data: bytes) -> int:
        assert self.let.wait(30)
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def test_a_disk_that_takes_its_time_does_not_hold_up_the_wires(tmp_path: Path) -> None:
    path = tmp_path / "t.jsonl"
    with Trace(path, {}) as trace:
        stuck = StuckFile(trace._file)
        trace._file = stuck  # type: ignore[assignment]
        listen = trace.traffic("p")
        for number in range(1000):  # and none of them waits
            listen(time.monotonic(), "tx", b"%d" % number)
        assert len(lines_of(path)) == 1
        stuck.let.set()
    assert [event.data for event in replay.load(path).events] == [b"%d" % number for number in range(1000)]
    assert trace.broken == ""


def test_what_a_disk_cannot_keep_up_with_is_said_to_be_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.trace.MOST_WAITING", 50)
    monkeypatch.setattr("rig.trace.CLOSING_S", 0.01)
    path = tmp_path / "t.jsonl"
    with Trace(path, {}) as trace:
        stuck = StuckFile(trace._file)
        trace._file = stuck  # type: ignore[assignment]
        listen = trace.traffic("p")
        for number in range(100):
            listen(time.monotonic(), "tx", b"%d" % number)
        assert trace.broken == f"--trace {path}: the disk is too slow: what came later is missing"
    stuck.let.set()
    trace._writer.join(10)
    kept = [event.data for event in replay.load(path).events]
    assert 50 <= len(kept) <= 100
    assert kept == [b"%d" % number for number in range(len(kept))]

    with Trace(tmp_path / "u.jsonl", {}) as trace:
        stuck = StuckFile(trace._file)
        trace._file = stuck  # type: ignore[assignment]
        trace.traffic("p")(time.monotonic(), "rx", b"a")
    assert trace.broken == f"--trace {tmp_path / 'u.jsonl'}: the disk has not taken all of it within 0.01 s"
    stuck.let.set()
    trace._writer.join(10)


def test_a_disk_that_is_full_is_said_at_the_end_and_breaks_nothing(tmp_path: Path) -> None:
    path = tmp_path / "t.jsonl"
    program = f"""
import resource, time
from pathlib import Path
from rig.trace import Trace
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
with Trace(Path({str(path)!r}), {{}}) as trace:
    listen = trace.traffic("p")
    for number in range(100):
        listen(time.monotonic(), "tx", b"%d" % number)
    until = time.monotonic() + 10
    while not trace.broken and time.monotonic() < until:
        time.sleep(0.001)
    listen(time.monotonic(), "rx", b"later")
print(trace.broken)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == (f"--trace {path}: cannot be written any more: File too large\n", "")
    events = replay.load(path).events  # its beginning, without gaps
    assert len(events) > 10
    assert [event.data for event in events] == [b"%d" % number for number in range(len(events))]


def test_what_was_known_of_the_axes_is_in_the_first_line(tmp_path: Path) -> None:
    known = {
        "socket://somewhere:1 newport-esp301 axis=1": {"setpoint": 3.0, "readback": 3.0, "under_way": False, "homed": True, "time": 1.0}
    }
    with Trace(tmp_path / "t.jsonl", {"bench": "b"}, known):
        pass
    assert replay.load(tmp_path / "t.jsonl").about["records"] == known


# Record and replay

POINTS = ("--cultivar", "RR", "--theta-i", "30,45", "--theta-r", "-20,0,20", "--out", "run")


def simulated_toml() -> str:
    text = importlib.resources.files("rig").joinpath("data/simulated.toml").read_text(encoding="utf-8")
    return text.replace("speed = 10.0", "speed = 40.0\nseed = 7", 1)


def replayed_toml(text: str, replayed: replay.Replayed, ports: tuple[str, ...]) -> str:
    for port in ports:
        text = text.replace(f'"{port}"', json.dumps(replayed.url(port)))
    return text.replace("seed = 7", "served = true", 1)


def said(run: Path) -> list[tuple[float, float, float, int, bool]]:
    def key(reading: Reading) -> tuple[float, float, float, int, bool]:
        return reading.theta_i, reading.theta_r, reading.value, reading.status, reading.good

    return [key(reading) for reading in Run(run).readings]


@pytest.mark.slow
def test_a_sweep_is_replayed_to_the_last_digit(tmp_path: Path) -> None:
    recording, playing = Lab(tmp_path / "recording"), Lab(tmp_path / "playing")
    for lab in (recording, playing):
        lab.folder.mkdir()
    (recording.folder / "rig.toml").write_text(simulated_toml())
    recording.rig("sweep", *POINTS, "--trace", "t.jsonl")
    measured = said(recording.folder / "run")
    assert len(measured) == 6

    trace = replay.load(recording.folder / "t.jsonl")
    assert trace.ports == ("sim:meter", "sim:stages")
    assert trace.about["config"] == simulated_toml()
    with replay.in_background(trace) as replayed:
        (playing.folder / "rig.toml").write_text(replayed_toml(simulated_toml(), replayed, trace.ports))
        playing.rig("sweep", *POINTS)
        assert replayed.divergences == {}
        assert replayed.finished
    assert said(playing.folder / "run") == measured

    # It is the recording that speaks: another reading in it is another reading out of it.
    text = (recording.folder / "t.jsonl").read_text()
    old = format(abs(measured[-1][2]), ".6E").encode()
    assert text.count(old.hex()) == 1
    (recording.folder / "u.jsonl").write_text(text.replace(old.hex(), b"1.234500E-08".hex()))
    with replay.in_background(replay.load(recording.folder / "u.jsonl")) as replayed:
        (playing.folder / "rig.toml").write_text(replayed_toml(simulated_toml(), replayed, trace.ports))
        playing.rig("sweep", *POINTS[:-1], "again")
    assert [value for _, _, value, _, _ in said(playing.folder / "again")] == [*(value for _, _, value, _, _ in measured[:-1]), 1.2345e-8]


def test_a_replay_that_is_asked_something_else_ends_in_a_named_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig.ports.LINK_TIMEOUT_S", 0.3)
    lab = Lab(tmp_path)
    with serving("stages", "meter") as running:
        urls = places(running)
        lab.configure(ZABERS, **urls)
        lab.rig("status", "--trace", "t.jsonl")
    trace = replay.load(tmp_path / "t.jsonl")
    with replay.in_background(trace) as replayed:
        lab.configure(ZABERS.replace("address = 2", "address = 3"), **(urls | {"stages": replayed.url(urls["stages"])}))
        source, detector = lab.rig("status", "--json", code=1).json["axes"]
        assert source["error"] == ""
        assert re.match(r"TransportTimeout: detector on .*no reply", detector["error"])
        assert replayed.divergences
        assert not replayed.finished


ZABERS = """\
[simulation]
speed = {speed}
served = true

[axes.source]
model = "zaber-x-rsw60a"
port = "{stages}"
offset = 90.0
limits = [0.0, 80.0]

[axes.detector]
model = "zaber-x-rsw60a"
port = "{stages}"
address = 2
offset = 100.0
limits = [-85.0, 85.0]

[sensor]
model = "keithley-6485"
port = "{meter}"
integration = 0.1
terminator = "LF"

[keep_out]
within = 3.0
crossing = true
"""
