"""What every light sensor owes, whoever made it."""

import math

import pytest

from drivers import catalogue
from drivers.errors import DeviceError, PortClosed
from drivers.kinds import LightSensor
from sim.faults import Fault
from sim.serve import Running
from tests.conformance.conftest import SENSORS, Arms

ADJUSTABLE = pytest.mark.parametrize("sensor", ["keithley-6485"], indirect=True)
"""What integrates as long as it is told; the others choose among what they have."""


def test_every_light_sensor_of_the_catalogue_is_here() -> None:
    # The camera has a folder in place of a port, and tests of its own.
    assert {*SENSORS, "camera-folder"} >= {model.name for model in catalogue.BUILT_IN if model.kind == "light-sensor"} >= {*SENSORS}


def test_it_says_who_it_is(sensor: LightSensor) -> None:
    identity = sensor.identify()
    assert all((identity.vendor, identity.model, identity.serial_number))


def test_a_reading_is_a_finite_number_with_a_unit(sensor: LightSensor) -> None:
    reading = sensor.read()
    assert reading.good
    assert math.isfinite(reading.value)
    assert reading.unit == sensor.unit


@ADJUSTABLE
def test_it_integrates_as_long_as_it_was_told(sensor: LightSensor) -> None:
    for seconds in (0.02, 0.1, 0.5):
        sensor.configure(seconds)
        assert sensor.integration_s == pytest.approx(seconds, rel=0.02)
        assert sensor.read().good


def test_it_never_integrates_less_than_it_was_told(sensor: LightSensor) -> None:
    for seconds in (0.02, 0.1, 0.4):
        sensor.configure(seconds)
        assert sensor.integration_s >= 0.98 * seconds
        assert sensor.read().good


@ADJUSTABLE
def test_longer_integration_is_steadier(sensor: LightSensor, lit: tuple[Running, Arms]) -> None:
    def spread(seconds: float) -> float:
        sensor.configure(seconds)
        values = [sensor.read().value for _ in range(30)]
        mean = sum(values) / len(values)
        return math.sqrt(sum((value - mean) ** 2 for value in values) / 29)

    _, send = lit
    send(120.0, -20.0)  # in the dark: the lamp's own noise is longer than any integration
    try:
        assert spread(0.5) < spread(0.001)
    finally:
        send(45.0, -20.0)


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_an_impossible_integration_time_is_refused(sensor: LightSensor, seconds: float) -> None:
    with pytest.raises(DeviceError):
        sensor.configure(seconds)
    assert sensor.read().good


def test_it_agrees_with_the_light_that_is_there(sensor: LightSensor, lit: tuple[Running, Arms], request: pytest.FixtureRequest) -> None:
    world, send = lit
    sensor.configure(0.4)
    name = SENSORS[request.node.callspec.params["sensor"]][0]
    told = []
    for theta_i, theta_r in ((45.0, -20.0), (10.0, 30.0), (70.0, 0.0)):
        send(theta_i, theta_r)
        reading = sensor.read()
        assert reading.good
        assert reading.value == pytest.approx(float(world.world.truth(theta_i, theta_r, name)), rel=0.05)
        told.append(reading.value)
    if name != "apogee":  # it faces the lamp
        assert max(told) > 1.5 * min(told)


def test_too_bright_is_never_a_good_value(sensor: LightSensor, lit: tuple[Running, Arms], request: pytest.FixtureRequest) -> None:
    world, _ = lit
    name = SENSORS[request.node.callspec.params["sensor"]][0]
    before, seen = len(world.struck(name)), []
    for _ in range(50):  # a measurement that began before the question is not read, and may be the one that is too bright
        world.inject(name, Fault("over-range"))
        seen.append(sensor.read())
        if not seen[-1].good:
            break
    bad = seen[-1]
    assert (bad.good, bad.over_range, bad.value) == (False, True, math.inf)
    while len(world.struck(name)) < before + len(seen) or not sensor.read().good:
        sensor.read()
    assert sensor.read().good


def test_closed_is_closed(sensor: LightSensor) -> None:
    sensor.close()
    with pytest.raises(PortClosed, match="sensor"):
        sensor.read()
