"""What light sensors owe that integrate as they please and measure light itself, not a current: with their light in our hands."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pytest

from drivers.kinds import LightSensor
from drivers.link import Link
from drivers.modbus import ModbusLink
from drivers.sensors.apogee import SQ422X
from drivers.sensors.konica_minolta import LuminanceMeter
from sim.apogee import QuantumModel, QuantumSensor
from sim.clock import SimClock
from sim.konica_minolta import Photometer, PhotometerModel
from sim.modbus import ModbusBus
from tests.sim.served import served

SPEED = 200.0


@dataclass
class Light:
    """What falls on the sensor, in its own unit."""

    level: float = 100.0
    asked: list[float] = field(default_factory=list)

    def __call__(self, begin: float, end: float) -> float:
        self.asked.append(end - begin)
        return self.level


@contextmanager
def minolta(light: Light, model: Literal["LS-100", "CS-100A"]) -> Iterator[Callable[[], LightSensor]]:
    def make() -> Photometer:
        return Photometer(SimClock(SPEED), light, np.random.default_rng(1), PhotometerModel(colour=model == "CS-100A"))

    with served(make) as (_, ports), Link.open(ports.tcp, timeout_s=5.0) as link:
        yield lambda: LuminanceMeter.open(link, "sensor", model=model)


@contextmanager
def apogee(light: Light) -> Iterator[Callable[[], LightSensor]]:
    def make() -> ModbusBus:
        sensor = QuantumSensor(light, np.random.default_rng(1), QuantumModel())
        return ModbusBus(SimClock(SPEED), {1: sensor}, "sensor", "apogee-sq-422x")

    with served(make) as (_, ports), ModbusLink.open(ports.tcp, timeout_s=5.0) as link:
        first = SQ422X.open(link, "sensor")
        while first.read().value == 0.0:  # until its first measurement has ended
            pass
        yield lambda: SQ422X.open(link, "sensor")


SENSORS = {
    "konica-minolta-ls-100": lambda light: minolta(light, "LS-100"),
    "konica-minolta-cs-100a": lambda light: minolta(light, "CS-100A"),
    "apogee-sq-422x": apogee,
}


@pytest.fixture(scope="module", params=SENSORS)
def port(request: pytest.FixtureRequest) -> Iterator[tuple[Callable[[], LightSensor], Light]]:
    """What opens a light sensor on its port, and its light; ports are slow to close."""
    light = Light()
    with SENSORS[request.param](light) as connect:
        yield connect, light


@pytest.fixture
def light(port: tuple[Callable[[], LightSensor], Light]) -> Light:
    """The light on the sensor, as it was at first."""
    port[1].level = 100.0
    return port[1]


@pytest.fixture
def sensor(port: tuple[Callable[[], LightSensor], Light], light: Light) -> LightSensor:
    """A light sensor, freshly opened."""
    device = port[0]()
    assert isinstance(device, LightSensor)
    return device


def test_it_agrees_with_the_light_that_is_there(sensor: LightSensor, light: Light) -> None:
    for level in (1.0, 30.0, 1000.0):
        light.level = level
        sensor.read()  # may have been measured before the light changed
        while not math.isclose(sensor.read().value, level, rel_tol=0.5):
            pass
        assert sensor.read().value == pytest.approx(level, rel=0.005, abs=0.3)


def test_it_integrates_at_least_as_long_as_it_was_told(sensor: LightSensor, light: Light) -> None:
    for seconds in (0.02, 0.1, 0.4):
        sensor.configure(seconds)
        assert sensor.integration_s >= seconds
        light.asked.clear()
        while not light.asked:
            sensor.read()
        assert light.asked[-1] >= seconds * (1 - 1e-9)


def test_too_bright_is_never_a_good_value(sensor: LightSensor, light: Light) -> None:
    light.level = 1e6
    while (reading := sensor.read()).value < 1e5:  # measured before the light changed
        pass
    assert reading.over_range
    assert not reading.good
    assert reading.value == math.inf
    light.level = 100.0
    while not (reading := sensor.read()).good:
        pass
    assert reading.value == pytest.approx(100.0, rel=0.005)
