"""What every light sensor owes, whoever made it."""

import math

import pytest

from drivers.errors import DeviceError
from drivers.kinds import LightSensor
from sim.serve import Running


def test_it_says_who_it_is(sensor: LightSensor) -> None:
    identity = sensor.identify()
    assert all((identity.vendor, identity.model, identity.serial_number))


def test_a_reading_is_a_finite_number_with_a_unit(sensor: LightSensor) -> None:
    reading = sensor.read()
    assert reading.good
    assert math.isfinite(reading.value)
    assert reading.unit == sensor.unit


def test_it_integrates_as_long_as_it_was_told(sensor: LightSensor) -> None:
    for seconds in (0.02, 0.1, 0.5):
        sensor.configure(seconds)
        assert sensor.integration_s == pytest.approx(seconds, rel=0.02)
        assert sensor.read().good


def test_longer_integration_is_steadier(sensor: LightSensor) -> None:
    def spread(seconds: float) -> float:
        sensor.configure(seconds)
        values = [sensor.read().value for _ in range(30)]
        mean = sum(values) / len(values)
        return math.sqrt(sum((value - mean) ** 2 for value in values) / 29)

    assert spread(0.5) < spread(0.001)


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan, math.inf, 1e6])
def test_an_impossible_integration_time_is_refused(sensor: LightSensor, seconds: float) -> None:
    with pytest.raises(DeviceError):
        sensor.configure(seconds)
    assert sensor.read().good


def test_it_agrees_with_the_light_that_is_there(sensor: LightSensor, world: Running) -> None:
    # The arms stand where they stood at power-up: whatever the light there, the meter must read the bench's own.
    sensor.configure(0.5)
    now = world.world.clock.now()
    truth = world.world.bench.signal(now, now + 0.5)
    assert sensor.read().value == pytest.approx(truth, rel=0.05, abs=2e-12)
