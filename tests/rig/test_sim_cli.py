"""`rig sim`: simulated instruments for any software."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sim.serve import INSTRUMENTS
from tests.conftest import rig_environment
from tests.rig.lab import INSTRUMENTS as MIXED_INSTRUMENTS
from tests.rig.lab import Lab, places, serving

WORK = (("home", "source", "detector"), ("move", "detector", "-40"), ("move", "source", "30"))

Rig = Callable[..., subprocess.CompletedProcess[str]]


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    command = [sys.executable, "-m", "rig", "sim", *arguments, "--json"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=folder, env=rig_environment(), **pipes) as process:
        try:
            assert process.stdout is not None
            yield process, json.loads(process.stdout.readline())
        finally:
            process.kill()


def address(url: str) -> tuple[str, int]:
    host, _, port = url.removeprefix("socket://").rpartition(":")
    return host, int(port)


def asked(url: str, request: bytes, end: bytes) -> bytes:
    with socket.create_connection(address(url), 5) as line:
        line.sendall(request)
        answer = b""
        while not answer.endswith(end):
            data = line.recv(4096)
            assert data
            answer += data
    return answer


def end(process: subprocess.Popen[str], number: signal.Signals) -> str:
    process.send_signal(number)
    _, talk = process.communicate(timeout=20)
    assert process.returncode == 0, talk
    return talk


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_all_are_served_until_a_signal_ends_them_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    with served(tmp_path, "serve") as (process, report):
        devices = {device["name"]: device for device in report["devices"]}
        assert list(devices) == list(INSTRUMENTS)
        assert all(device["model"] for device in devices.values())
        assert asked(devices["stages"]["tcp"], b"/1 0 get deviceid\n", b"\r\n").startswith(b"@01 0 OK IDLE WR ")
        assert asked(devices["newport"]["tcp"], b"VE?\r", b"\r\n").startswith(b"ESP301")
        ptys = [Path(device["pty"]) for name, device in devices.items() if name != "camera"]
        assert all(pty.exists() for pty in ptys)
        terminal = os.open(ptys[0], os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(terminal, b"/1 0 get deviceid\n")
            assert os.read(terminal, 1) == b"@"
        finally:
            os.close(terminal)
        folder = Path(devices["camera"]["folder"])
        assert folder.is_dir()
        talk = end(process, number)
        assert "Traceback" not in talk
        assert not any(pty.exists() for pty in ptys)
        assert not folder.exists()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(address(devices["stages"]["tcp"]), 5)


def test_those_named_are_served_and_a_rig_toml_leads_there(tmp_path: Path, rig: Rig) -> None:
    with served(tmp_path, "serve", "meter", "stages", "--toml", "rig.toml", "--speed", "40") as (process, report):
        assert [device["name"] for device in report["devices"]] == ["meter", "stages"]
        assert rig("home", "detector").stdout.startswith("SIMULATED: detector homed")
        assert "SIMULATED: detector: -100.000 deg, at rest, homed" in rig("status").stdout
        end(process, signal.SIGINT)


def test_a_fault_strikes_what_it_is_said_to_strike(tmp_path: Path, rig: Rig) -> None:
    with served(tmp_path, "serve", "stages", "meter", "--toml", "rig.toml", "--fault", "stages:cut-short:3:4") as (process, _):
        done = rig("status")
        assert "NOT HOMED" in done.stdout
        end(process, signal.SIGTERM)


def test_nonsense_is_refused_in_one_line(rig: Rig, tmp_path: Path) -> None:
    for arguments, says in (
        (("serve", "theodolite"), "theodolite"),
        (("serve", "stages", "--fault", "stages:earthquake:1"), "earthquake"),
        (("serve", "newport", "--toml", "rig.toml"), "stages"),
        (("serve", "stages", "--speed", "0"), "speed"),
        (("replay", "nowhere.jsonl"), "nowhere.jsonl"),
    ):
        done = rig("sim", *arguments, check=2)
        assert says in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "rig.toml").exists()


def test_what_there_is_can_be_listed(rig: Rig) -> None:
    listed = rig("sim", "serve", "--names").stdout
    assert all(f"\n{name} " in f"\n{listed}" for name in INSTRUMENTS)
    assert "cut-short" in listed


def test_a_recorded_probe_is_answered_again_without_instruments(tmp_path: Path, rig: Rig) -> None:
    first = json.loads(rig("devices", "probe", "--json", "--trace", "wires.jsonl").stdout)
    with served(tmp_path, "replay", "wires.jsonl") as (process, report):
        places = {device["name"]: device["tcp"] for device in report["devices"]}
        text = json.loads((tmp_path / "wires.jsonl").read_text().splitlines()[0])["config"]
        for port, url in places.items():
            text = text.replace(f'"{port}"', json.dumps(url))
        (tmp_path / "rig.toml").write_text(text.replace("[simulation]\n", "[simulation]\nserved = true\n"))
        again = json.loads(rig("devices", "probe", "--json").stdout)
        talk = end(process, signal.SIGINT)
    assert [device["identity"] for device in again["devices"]] == [device["identity"] for device in first["devices"]]
    assert [device["state"] for device in again["devices"]] == [device["state"] for device in first["devices"]]
    assert talk.splitlines()[-1] == "all that was recorded has been asked"


def test_what_moved_on_a_bench_moves_again_in_a_fresh_folder(tmp_path: Path) -> None:
    recording, playing = Lab(tmp_path / "recording"), Lab(tmp_path / "playing")
    for lab in (recording, playing):
        lab.folder.mkdir()
    said = {}
    with serving(*MIXED_INSTRUMENTS, source="newport:1", detector="stages:2") as running:
        recording.urls.update(places(running))
        config = recording.configure()
        for number, work in enumerate(WORK):
            said[work] = recording.rig(*work, "--trace", f"{number}.jsonl").out
    for number, work in enumerate(WORK):
        again = Lab(playing.folder / str(number))
        again.folder.mkdir()
        trace = recording.folder / f"{number}.jsonl"
        with served(again.folder, "replay", str(trace), "--toml", "rig.toml") as (process, _):
            assert again.rig(*work).out == said[work]
            assert end(process, signal.SIGINT) == "all that was recorded has been asked\n"
        text = (again.folder / "rig.toml").read_text()
        assert not any(device.port in text for device in config.devices.values())
    # The source's controller does not know that it was homed: it moved because the record said so.
    last = recording.folder / f"{len(WORK) - 1}.jsonl"
    forgetful = Lab(playing.folder / "forgetful")
    forgetful.folder.mkdir()
    with served(forgetful.folder, "replay", str(last), "--toml", "rig.toml") as (process, _):
        (forgetful.folder / "rig-data" / "axes.json").unlink()
        assert "source has no reference" in forgetful.rig(*WORK[-1], code=None).err
        end(process, signal.SIGINT)


def test_a_trace_without_its_configuration_makes_no_bench(tmp_path: Path, rig: Rig) -> None:
    (tmp_path / "t.jsonl").write_text('{"trace": 1, "started": "2024-05-01T12:00:00+00:00"}\n')
    done = rig("sim", "replay", "t.jsonl", "--toml", "rig.toml", check=2)
    assert done.stderr == "rig: trace t.jsonl, line 1: holds no configuration to make a rig.toml of\n"
    (tmp_path / "rig.toml").write_text("mine\n")
    assert "is there already" in rig("sim", "replay", "t.jsonl", "--toml", "rig.toml", check=2).stderr
    assert (tmp_path / "rig.toml").read_text() == "mine\n"
