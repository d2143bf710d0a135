"""Instruments of somebody else's package: installed beside ours, found, configured, probed, moved and read."""

from __future__ import annotations

import os
import re
import socketserver
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig.runs import Run
from tests.conftest import rig_environment
from tests.rig.lab import Lab

DRIVER = '''\
"""A turntable and a light sensor that answer `ADDRESS WORD NUMBER` with a line of numbers."""

from drivers.errors import DeviceFault, UnexpectedReply
from drivers.kinds import AxisState, Identity, LightReading, MotionProfile
from drivers.models import DeviceModel, Option


class Toy:
    def __init__(self, link, name, address):
        self.name, self._link, self._address = name, link, address

    def ask(self, word, *, repeatable=True, urgent=False):
        def accept(line):
            address, told, *rest = line.decode("ascii").split()
            if (address, told) != (str(self._address), word.split()[0]):
                return None
            return rest

        request = f"{self._address} {word}\\n".encode("ascii")
        how = {"repeatable": repeatable, "urgent": urgent}
        return self._link.exchange(request, accept, attempt=word, expected="an answer", device=self.name, **how)

    def identify(self):
        model, number = self.ask("WHO")
        return Identity("Toys", model, number, "1")

    def close(self):
        pass


class Turntable(Toy):
    unit = "deg"

    def state(self):
        position, homed = self.ask("AT")
        return AxisState(float(position), moving=False, homed=homed == "1")

    def limits(self):
        return -360.0, 360.0

    def profile(self):
        return MotionProfile(1000.0, 1e6)

    def set_profile(self, speed=None, acceleration=None):
        pass

    def start_home(self):
        self.ask("HOME", repeatable=False)

    def start_move(self, position):
        self.ask(f"GO {position}", repeatable=False)

    def stop(self):
        self.ask("STOP", urgent=True)

    def check_arrival(self, position, tolerance):
        if abs(self.state().position - position) > tolerance:
            raise DeviceFault("rests elsewhere", device=self.name)


class Eye(Toy):
    unit = "lx"
    integration_s = 0.1

    def configure(self, integration_s, range=None):
        self.integration_s = integration_s

    def read(self):
        (value,) = self.ask("LOOK")
        return LightReading(float(value), "lx", 0, over_range=False)


MODELS = [
    DeviceModel(
        name="toy-turntable", kind="rotary-axis", vendor="Toys", description="a turntable", protocol="toy lines",
        connect=Turntable, line={"baudrate": 1200, "terminator": "LF"}, options={"address": Option(int, 1, "number on its back")},
    ),
    DeviceModel(
        name="toy-eye", kind="light-sensor", vendor="Toys", description="an eye", protocol="toy lines",
        connect=Eye, line={"baudrate": 1200, "terminator": "LF"}, options={"address": Option(int, 9, "number on its back")},
    ),
]
'''

CONFIG = """\
[bench]
name = "toys"

[axes.source]
model = "toy-turntable"
port = "{toys}"
address = 1
limits = [0.0, 80.0]
settle = 0.0

[axes.detector]
model = "toy-turntable"
port = "{toys}"
address = 2
limits = [-85.0, 85.0]
settle = 0.0

[sensor]
model = "toy-eye"
port = "{toys}"
integration = 0.1

[keep_out]
within = 3.0
crossing = true
"""


class Toys(socketserver.StreamRequestHandler):
    """Two turntables and an eye that sees what the detector's angle is."""

    disable_nagle_algorithm = True

    def handle(self) -> None:
        """Answer line by line."""
        server = self.server
        assert isinstance(server, Server)
        for line in self.rfile:
            address, word, *rest = line.decode("ascii").split()
            server.heard.append(f"{address} {word}")
            if word == "GO":
                server.at[address] = float(rest[0])
            elif word == "HOME":
                server.at[address], server.homed[address] = 0.0, True
            answer = {
                "WHO": f"{'eye' if address == '9' else 'turntable'} {address}00",
                "AT": f"{server.at.get(address)} {int(server.homed.get(address, False))}",
                "LOOK": f"{100 + server.at['2']}",
            }.get(word, "")
            self.wfile.write(f"{address} {word} {answer}\n".encode("ascii"))


class Server(socketserver.ThreadingTCPServer):
    """The toys on a port."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Toys)
        self.at = {"1": 30.0, "2": -10.0}
        self.homed: dict[str, bool] = {}
        self.heard: list[str] = []

    @property
    def url(self) -> str:
        """Where they are."""
        return f"socket://127.0.0.1:{self.server_address[1]}"


@pytest.fixture
def toys() -> Iterator[Server]:
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the package in it, as an installer leaves it."""
    site = tmp_path / "site"
    (site / "toylab").mkdir(parents=True)
    (site / "toylab" / "__init__.py").write_text(DRIVER)
    info = site / "toylab-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toylab\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rig.devices]\ntoys = toylab:MODELS\n")
    return site


def devices(site: Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run `rig devices` with the folder on the path."""
    environment = rig_environment()
    environment["PYTHONPATH"] += os.pathsep + str(site)
    command = [sys.executable, "-m", "rig", "devices"]
    return subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=True)


def test_a_model_of_another_package_is_listed(site: Path, tmp_path: Path) -> None:
    listed = devices(site, tmp_path)
    assert re.search(r"^toy-eye +light-sensor +Toys: an eye; toy lines$", listed.stdout, re.MULTILINE)
    assert re.search(r"^toy-turntable +rotary-axis +Toys: a turntable; toy lines$", listed.stdout, re.MULTILINE)
    assert listed.stderr == ""


def test_a_package_that_is_broken_is_named_and_harms_no_other(site: Path, tmp_path: Path) -> None:
    (site / "toylab" / "__init__.py").write_text("import a_module_that_is_not_there\n")
    listed = devices(site, tmp_path)
    assert "keithley-6485" in listed.stdout
    assert re.fullmatch(
        r"not usable: entry point toys = toylab:MODELS of toylab is broken: ModuleNotFoundError: .*; mend or uninstall the package\n",
        listed.stderr,
    )


def test_its_instruments_are_configured_probed_moved_and_read(
    site: Path, toys: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab(tmp_path, {"toys": toys.url})
    (tmp_path / "rig.toml").write_text(CONFIG.format(toys=toys.url))
    unknown = lab.rig("status", code=2)
    assert "axes.source.model: unknown model 'toy-turntable'" in unknown.err

    monkeypatch.syspath_prepend(str(site))
    monkeypatch.delitem(sys.modules, "toylab", raising=False)
    shown = lab.rig("devices", "show", "toy-turntable").out
    assert re.search(r"^  address +1 +number on its back$", shown, re.MULTILINE)
    rows = lab.rig("devices", "probe", "--json").json["devices"]
    assert [(row["identity"]["model"], row["identity"]["serial_number"], row["error"]) for row in rows] == [
        ("turntable", "100", ""),
        ("turntable", "200", ""),
        ("eye", "900", ""),
    ]
    assert not any(heard.endswith(("GO", "HOME", "STOP")) for heard in toys.heard)
    assert lab.rig("home").out.splitlines() == ["source homed, at 0.000 deg", "detector homed, at 0.000 deg"]
    assert lab.rig("move", "detector", "-30").out == "detector at -30.000 deg\n"
    assert toys.at["2"] == -30.0
    assert lab.rig("move", "detector", "2", code=1).err.startswith("rig: detector at 2 deg would stand within 3 deg")
    assert lab.rig("read").out == "sensor 70 lx\n"
    assert "detector: -30.000 deg, at rest, homed" in lab.rig("status").out
    assert lab.rig("stop").out == "source: told to stop, at rest at 0.000 deg\ndetector: told to stop, at rest at -30.000 deg\n"
    lab.rig("sweep", "--cultivar", "RR", "--theta-r", "-20,20", "--out", "run")
    run = Run(tmp_path / "run")
    assert [(reading.theta_r, reading.value, reading.unit) for reading in run.readings] == [(-20.0, 80.0, "lx"), (20.0, 120.0, "lx")]
    assert not run.simulated
    monkeypatch.delitem(sys.modules, "toylab")
