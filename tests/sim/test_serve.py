"""The command line `python -m sim` and the bench as a whole."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sim.bench import Misalignment
from sim.errors import SimError
from sim.faults import Fault
from sim.serve import INSTRUMENTS, Running, Settings, in_background

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
    assert told == {
        "simulated": True,
        "seed": 7,
        "speed": 20.0,
        "specimen": "lambert:0.5",
        "source": "stages:1",
        "detector": "stages:2",
        "pid": process.pid,
        "devices": [stages, meter],
    }
    assert (stages["name"], stages["model"]) == ("stages", "zaber-x-rsw60a")
    assert (meter["name"], meter["model"]) == ("meter", "keithley-6485")
    for device in (stages, meter):
        assert set(device) == {"name", "model", "description", "tcp", "pty", "line"}
        assert device["tcp"].startswith("socket://127.0.0.1:")
        assert os.path.exists(device["pty"])
    assert connect(stages["tcp"]).ask(b"/2 0 05") == b"@02 0 05 OK IDLE WR 0\r\n"
    # The end of standard input ends it, clients or not, without a word.
    assert left(process) == (0, "", "")


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


RAW = {
    "stages": (b"/1 1 05 get limit.cycle.dist\n", rb"@01 1 05 OK IDLE WR 1536000\r\n"),
    "linear": (b"/2 1 05 get limit.cycle.dist\n", rb"@02 1 05 RJ IDLE WR BADCOMMAND\r\n"),
    "newport": (b"1PR5\rTE?\r", rb"113\r\n"),
    "shot": (b"?:SW\r\n", rb"2,2\r\n"),
    "gsc": (b"R:W\r\nQ:\r\n", rb" {9}0, {9}0,K,K,R\r\n"),
    "oriental": (bytes.fromhex("01 03 00 7F 00 01 B5 D2"), rb"\x01\x03\x02\x40\x20.."),  # READY and IN-POS
    "meter": (b"*IDN?\r", rb"KEITHLEY INSTRUMENTS INC.,MODEL 6485,.*\n"),
    "ls-100": (b"MES\r\n", rb"OK00, *[0-9.]+\r\n"),
    "cs-100a": (b"MDS,04\r\n", rb"OK00\r\n"),
    "apogee": (bytes.fromhex("01 03 00 00 00 02 C4 0B"), rb"\x01\x03\x04.{6}"),
    "om20": (bytes.fromhex("01 04 00 CA 00 02 51 F5"), rb"\x01\x04\x04.{6}"),
    "optoncdt": (b"GETUSERLEVEL\r\n", rb"GETUSERLEVEL PROFESSIONAL\r\n->"),
}
"""One exchange with each instrument, bytes by hand: a request, and a pattern of the reply."""


def hear(take: Callable[[], bytes], pattern: bytes) -> bytes:
    """Collect bytes until they match; the test's time-out ends it if they never do."""
    heard = b""
    while not re.fullmatch(pattern, heard, re.DOTALL):
        piece = take()
        assert piece, f"hung up after {heard!r}"
        heard += piece
    return heard


def masters() -> int:
    """Count the pseudo-terminals this process serves; their names say nothing, another process may take them at once."""
    links = [f"/proc/self/fd/{number}" for number in os.listdir("/proc/self/fd")]
    return sum(os.readlink(link).endswith("ptmx") for link in links if os.path.islink(link))


def test_every_instrument_is_served_and_answers(quiet: None, connect: Connect) -> None:
    before = masters()
    settings = Settings(specimen="lambert:1", speed=20, instruments=tuple(INSTRUMENTS), source="newport:1", detector="shot:2")
    with in_background(settings) as running:
        devices = running.report["devices"]
        assert [device["name"] for device in devices] == list(INSTRUMENTS) == [*RAW, "camera"]
        assert masters() == before + len(RAW)
        assert (running.report["source"], running.report["detector"]) == ("newport:1", "shot:2")
        for device in devices:
            assert device["description"] == INSTRUMENTS[device["name"]]
            assert device["model"]
        for name, (request, pattern) in RAW.items():
            client = connect(running.url(name)).socket
            client.sendall(request)
            hear(lambda client=client: client.recv(4096), pattern)
            terminal = os.open(running.pty(name), os.O_RDWR | os.O_NOCTTY)
            try:
                os.write(terminal, request)
                hear(lambda terminal=terminal: os.read(terminal, 4096), pattern)
            finally:
                os.close(terminal)
        assert {device["line"] for device in devices if "tcp" in device} >= {"115200 8E1, Modbus RTU", "9600 8N1, LF both ways"}
        folder = running.folder("camera")
        assert devices[-1] == {"name": "camera", "model": "camera-folder", "description": INSTRUMENTS["camera"], "folder": str(folder)}
        (folder / ".shutter").touch()
        while not (pictures := list(folder.glob("*.dng"))):
            pass
        assert pictures[0].read_bytes()[:4] == b"II*\0"
    assert not folder.exists()
    assert masters() == before


def test_a_folder_that_was_there_stays_and_one_that_was_made_goes(tmp_path: Path) -> None:
    there, new = tmp_path / "there", tmp_path / "new" / "folder"
    there.mkdir()
    (there / "mine").touch()
    for folder in (there, new):
        with in_background(Settings(specimen="lambert:1", instruments=("camera",), camera_folder=str(folder))) as running:
            assert running.folder("camera") == folder
            assert folder.is_dir()
    assert (there / "mine").exists()
    assert not new.exists()
    with (
        pytest.raises(SimError, match="camera folder"),
        in_background(Settings(specimen="lambert:1", instruments=("camera",), camera_folder=str(there / "mine" / "below"))),
    ):
        pass


END = {"SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT, "end of input": None}


@pytest.mark.parametrize("end", END)
def test_all_of_them_end_cleanly_and_leave_nothing_open(start: Start, connect: Connect, tmp_path: Path, end: str) -> None:
    log = tmp_path / "stops"
    process = start("--instruments", "all", "--source", "oriental:1", "--until-eof", "--stop-log", str(log))
    devices = {device["name"]: device for device in report(process)["devices"]}
    folder = Path(devices["camera"]["folder"])
    clients = {name: connect(devices[name]["tcp"]) for name in RAW}
    # Under way: a search for home, an endless run, a stream, a measurement, a picture; a client on a terminal.
    clients["newport"].send(b"1MO\r1OR1\r1WS\rVE?\r")
    assert clients["stages"].ask(b"/1 1 move vel 1000").startswith(b"@01 1 OK BUSY")
    clients["optoncdt"].send(b"OUTPUT RS422\r\n")
    assert clients["optoncdt"].line() == b"OUTPUT RS422\r\n"
    clients["ls-100"].send(b"MES\r\n")
    (folder / ".shutter").touch()
    terminal = os.open(devices["shot"]["pty"], os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(terminal, b"L:W\r\n")
        hear(lambda: os.read(terminal, 4096), rb"OK\r\n")
        assert [json.loads(line)["axis"] for line in log.read_text().splitlines()] == ["shot:1", "shot:2"]
        if (number := END[end]) is None:
            assert process.stdin is not None
            process.stdin.close()
            process.stdin = None
        else:
            process.send_signal(number)
        assert left(process) == (0, "", "")
    finally:
        os.close(terminal)
    assert not folder.exists()
    for name, client in clients.items():
        while client.socket.recv(65536):
            pass
        with pytest.raises(ConnectionRefusedError):
            connect(devices[name]["tcp"])


def test_faults_strike_what_is_served(quiet: None, connect: Connect) -> None:
    with in_background(Settings(specimen="lambert:1", instruments=("stages", "oriental"), faults=("stages:wrong-checksum:4",))) as running:
        stages = connect(running.url("stages"))
        body, _, check = stages.ask(b"/1 0 04 get deviceid:3E").rstrip(b"\r\n").partition(b":")
        assert body == b"@01 0 04 OK IDLE WR 99999"
        assert int(check, 16) != -sum(body[1:]) & 0xFF
        (strike,) = running.struck("stages")
        assert strike.kind == "wrong-checksum"
        assert stages.ask(b"/1 1 06 get limit.min").endswith(b" 0\r\n")
        running.inject("oriental", Fault("silence", 0))
        with pytest.raises(SimError, match="no fault over-range"):
            running.inject("oriental", Fault("over-range"))
        axis, request = connect(running.url("oriental")).socket, RAW["oriental"][0]
        axis.sendall(request)
        while not running.struck("oriental"):
            pass
        axis.sendall(request)
        assert len(hear(lambda: axis.recv(4096), RAW["oriental"][1])) == 7
        assert [strike.kind for strike in running.struck("oriental")] == ["silence"]


def test_stops_are_told_to_the_onlooker(running: Running, connect: Connect) -> None:
    stages = connect(running.url("stages"))
    before = time.monotonic()
    stages.send(b"/2 1 stop\n")
    assert stages.line().startswith(b"@02 1 OK")
    (stop,) = running.stops()
    assert stop.axis == "stages:2"
    assert before <= stop.time <= time.monotonic()


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
        (("--instruments", "stages,theodolite"), "'theodolite': expected some of stages, linear"),
        (("--instruments", ""), "expected some of stages"),
        (("--source", "newport:1"), "stages:1 or stages:2"),
        (("--fault", "stages:hiccup:1"), "hiccup"),
        (("--fault", "newport:silence:1"), "expected one of stages, meter"),
        (("--stop-log", "no-such/folder/log"), "stop log no-such/folder/log"),
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
    meter.send(b"*RST\nSYST:ZCH OFF\nFORM:ELEM READ,TIME\n")
    meter.ask(b"READ?")  # 100 ms per conversion: the ringing of 50 ms has time to die away
    reading, read_at = map(float, meter.ask(b"READ?").split(b","))
    bench, now = running.world.bench, running.world.clock.now()
    assert bench.angles(now) == pytest.approx((45.1, -20.08), abs=1e-4)  # misalignments of the fixture
    assert stages.ask(b"/1 1 get pos").split()[-1] == b"576000"  # which the readback does not know
    lamp = bench.lamp.level(read_at)  # its own time: on a busy machine `now` is long after
    assert reading == pytest.approx(float(bench.light(45.1, -20.08)) * lamp, rel=1e-4, abs=0)
    # The detector's arm in the beam: dark.
    stages.ask(b"/2 1 move abs %d" % round(145 / 0.000234375))
    settle(stages, 2)
    meter.ask(b"READ?")
    assert abs(float(meter.ask(b"READ?").split(b",")[0])) < 5e-12


def test_misalignment_is_drawn_from_the_seed_unless_given() -> None:
    with in_background(Settings(specimen="lambert:1", seed=3, pty=False)) as one:
        drawn = one.world.bench.misalignment
    with in_background(Settings(specimen="lambert:1", seed=3, pty=False, misalignment=Misalignment())) as other:
        assert other.world.bench.misalignment == Misalignment(0.0, 0.0) != drawn
        assert other.world.stages.axes[0].track.nominal(0.0) == one.world.stages.axes[0].track.nominal(0.0)
