"""Every driver over its wire simulator, all of them in one simulated world; one entry a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import pytest

from drivers import catalogue
from drivers.kinds import LightSensor, MotionProfile, RangeFinder, Stage
from drivers.models import Device
from drivers.motion import wait_until_idle
from rig.clock import Clock
from sim.serve import INSTRUMENTS, Running, Settings, in_background

SPEED = 40.0
SWIFT = MotionProfile(speed=45.0, acceleration=450.0)
"""As quick as the slowest of them can be."""

Entry = tuple[str, dict[str, Any], dict[str, Any]]
"""The simulated instrument, the model's options, and line settings that are not as delivered."""

STAGES: dict[str, Entry] = {
    "zaber-x-rsw60a": ("stages", {"address": 1}, {}),
    "zaber-x-rst120ak": ("stages", {"address": 2}, {}),
    "zaber-x-lsm": ("linear", {"address": 1, "microsteps_per_mm": 1000 / 0.047625}, {}),
    "newport-esp301": ("newport", {"axis": 1}, {}),
    "newport-esp300": ("newport", {"axis": 2}, {}),
    "sigma-koki-shot-302gs": ("shot", {"axis": 1, "low_deg": 0.0, "high_deg": 360.0}, {}),
    "sigma-koki-gsc-02": ("gsc", {"axis": 1, "low_deg": 0.0, "high_deg": 360.0}, {}),
    "oriental-az": ("oriental", {"address": 1}, {}),
}
SENSORS: dict[str, Entry] = {
    "keithley-6485": ("meter", {}, {}),
    "konica-minolta-ls-100": ("ls-100", {}, {}),
    "konica-minolta-ls-110": ("ls-100", {}, {}),
    "konica-minolta-cs-100a": ("cs-100a", {}, {}),
    "apogee-sq-422x": ("apogee", {}, {}),
}
FINDERS: dict[str, Entry] = {
    "baumer-om20": ("om20", {}, {}),
    "baumer-om30": ("om20", {}, {}),
    "micro-epsilon-ild1420": ("optoncdt", {}, {}),
}
WIRED = tuple(name for name in INSTRUMENTS if name != "camera")


@contextmanager
def opened(running: Running, model: str, entry: Entry, name: str) -> Iterator[Device]:
    """Open a device in a world."""
    instrument, options, line = entry
    found = catalogue.load().lookup(model)
    with found.open_link(running.url(instrument), timeout_s=1.0, **line) as link:
        yield found.open_device(link, name=name, **options)


@pytest.fixture(scope="session", autouse=True)
def ports_close_at_once() -> Iterator[None]:
    """After closing a socket pyserial sleeps for 0.3 s, lest it be opened again at once: ours may be."""
    with patch("serial.urlhandler.protocol_socket.time"):
        yield


@pytest.fixture(scope="session")
def world() -> Iterator[Running]:
    with in_background(Settings(specimen="lambert:0.5", seed=3, speed=SPEED, pty=False, instruments=WIRED)) as running:
        yield running


@pytest.fixture(scope="session")
def fresh() -> Iterator[Running]:
    """A world that was switched on just now, and in which nothing is ever homed."""
    with in_background(Settings(specimen="lambert:0.5", seed=5, speed=SPEED, pty=False, instruments=WIRED)) as running:
        yield running


Arms = Callable[[float, float], None]


@contextmanager
def _carried(running: Running) -> Iterator[Arms]:
    """Home the arms, and hand over what sends them to theta_i and theta_r, deg."""
    clock = Clock(SPEED)
    carriers = {"source": "zaber-x-rsw60a", "detector": "zaber-x-rst120ak"}
    with ExitStack() as stack:
        stages = {arm: stack.enter_context(opened(running, model, STAGES[model], arm)) for arm, model in carriers.items()}
        for stage in stages.values():
            assert isinstance(stage, Stage)
            stage.start_home()
            wait_until_idle(stage, 0.0, timeout_s=120.0, clock=clock)

        def send(*thetas: float) -> None:
            for (arm, stage), theta in zip(stages.items(), thetas, strict=True):
                assert isinstance(stage, Stage)
                stage.start_move(theta + running.world.arms[arm].zero)
                wait_until_idle(stage, 0.0, timeout_s=60.0, clock=clock)

        yield send


@pytest.fixture(scope="session")
def lit() -> Iterator[tuple[Running, Arms]]:
    """A world whose arms stand so that there is light, and what sends them elsewhere."""
    settings = Settings(specimen="lambert:0.5", seed=4, speed=SPEED, pty=False, instruments=WIRED)
    with in_background(settings) as running, _carried(running) as send:
        send(45.0, -20.0)
        yield running, send


@pytest.fixture(params=STAGES)
def stage(request: pytest.FixtureRequest, world: Running) -> Iterator[Stage]:
    """A stage, fresh from its port."""
    with opened(world, request.param, STAGES[request.param], "axis") as device:
        assert isinstance(device, Stage)
        device.set_profile(speed=SWIFT.speed, acceleration=SWIFT.acceleration)
        yield device
        device.stop()


@pytest.fixture(params=STAGES)
def unhomed(request: pytest.FixtureRequest, fresh: Running) -> Iterator[Stage]:
    """A stage that has just been switched on."""
    with opened(fresh, request.param, STAGES[request.param], "axis") as device:
        assert isinstance(device, Stage)
        yield device


@pytest.fixture(params=SENSORS)
def sensor(request: pytest.FixtureRequest, lit: tuple[Running, Arms]) -> Iterator[LightSensor]:
    """A light sensor, fresh from its port."""
    with opened(lit[0], request.param, SENSORS[request.param], "sensor") as device:
        assert isinstance(device, LightSensor)
        yield device


@pytest.fixture(params=FINDERS)
def finder(request: pytest.FixtureRequest, world: Running) -> Iterator[RangeFinder]:
    """A range finder, fresh from its port."""
    with opened(world, request.param, FINDERS[request.param], "range") as device:
        assert isinstance(device, RangeFinder)
        yield device
