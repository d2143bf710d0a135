"""Every driver over its wire simulator; one entry a model."""

from collections.abc import Iterator

import pytest

from drivers import catalogue
from drivers.kinds import LightSensor, Stage
from sim.serve import Running, Settings, in_background

SPEED = 40.0
AXES = {"zaber-x-rsw60a": ("stages", {"address": 1}), "zaber-x-rst120ak": ("stages", {"address": 2})}
SENSORS = {"keithley-6485": ("meter", {}, {"terminator": "LF"})}


@pytest.fixture(scope="module")
def world() -> Iterator[Running]:
    with in_background(Settings(specimen="lambert:0.5", seed=3, speed=SPEED)) as running:
        yield running


@pytest.fixture(params=AXES)
def axis(request: pytest.FixtureRequest, world: Running) -> Iterator[Stage]:
    """A rotary axis, fresh from its port."""
    name, options = AXES[request.param]
    model = catalogue.load().lookup(request.param)
    with model.open_link(world.url(name), timeout_s=1.0) as link:
        device = model.open_device(link, name="axis", **options)
        assert isinstance(device, Stage)
        yield device
        device.stop()


@pytest.fixture(params=SENSORS)
def sensor(request: pytest.FixtureRequest, world: Running) -> Iterator[LightSensor]:
    """A light sensor, fresh from its port."""
    name, options, line = SENSORS[request.param]
    model = catalogue.load().lookup(request.param)
    with model.open_link(world.url(name), timeout_s=1.0, **line) as link:
        device = model.open_device(link, name="sensor", **options)
        assert isinstance(device, LightSensor)
        yield device
