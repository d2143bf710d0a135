"""What every light sensor owes, for the camera in a folder: its driver over the simulated camera, shutter and all."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from drivers.cameras.folder import FolderCamera, FolderLink
from drivers.errors import PortClosed
from drivers.kinds import LightSensor
from sim.camera import SHUTTER, CameraModel, Scene, SimulatedCamera
from sim.clock import SimClock
from tests.conformance.test_light_sensor import (
    test_a_reading_is_a_finite_number_with_a_unit,
    test_an_impossible_integration_time_is_refused,
    test_it_says_who_it_is,
)

__all__ = [
    "test_a_reading_is_a_finite_number_with_a_unit",
    "test_an_impossible_integration_time_is_refused",
    "test_it_says_who_it_is",
]

SPEED = 5.0
Delivery = Literal["pieces", "rename"]


@contextmanager
def served(folder: Path, light: Callable[[float, float], float], delivery: Delivery) -> Iterator[SimulatedCamera]:
    """Run a camera in a thread for the length of a `with` block."""
    stop, started = threading.Event(), threading.Event()
    cameras: list[SimulatedCamera] = []

    async def main() -> None:
        scene = Scene(tilt=25, turn=10, size=0.8)
        cameras.append(SimulatedCamera(folder, SimClock(SPEED), light, np.random.default_rng(2), CameraModel(), scene, delivery=delivery))
        running = asyncio.create_task(cameras[0].run())
        started.set()
        await asyncio.to_thread(stop.wait)
        running.cancel()

    thread = threading.Thread(target=asyncio.run, args=(main(),), daemon=True)
    thread.start()
    started.wait()
    try:
        yield cameras[0]
    finally:
        stop.set()
        thread.join()


class Light:
    """A lamp that is brighter each second, and remembers how bright it was when it was asked."""

    def __init__(self) -> None:
        self.told: list[float] = []

    def __call__(self, begin: float, end: float) -> float:
        self.told.append(1.0 + 0.5 * (begin + end) / 2)
        return self.told[-1]


@dataclass(frozen=True)
class Bench:
    sensor: LightSensor
    camera: SimulatedCamera
    light: Light


@pytest.fixture(params=["pieces", "rename"])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    """A camera whose shutter the driver presses, its light, and the driver."""
    light = Light()
    with served(tmp_path, light, request.param) as camera, FolderLink.open(camera.url) as link:
        eye = FolderCamera.open(link, "eye", patch="markers", trigger_command=f"touch {SHUTTER}", settle_s=0.02)
        yield Bench(eye, camera, light)


@pytest.fixture
def sensor(bench: Bench) -> LightSensor:
    """The driver."""
    assert isinstance(bench.sensor, LightSensor)
    return bench.sensor


def test_each_reading_is_of_the_light_there_was_after_the_call(bench: Bench) -> None:
    for number, (exposure, iso) in enumerate(((0.1, 100), (0.04, 100), (0.02, 400)), start=1):
        bench.camera.model = replace(bench.camera.model, exposure=exposure, iso=iso)
        reading = bench.sensor.read()
        assert reading.good
        assert len(bench.light.told) == number
        assert reading.value == pytest.approx(bench.light.told[-1], rel=0.005)
        assert bench.sensor.integration_s == pytest.approx(exposure)


def test_too_bright_is_never_a_good_value(bench: Bench) -> None:
    bench.camera.model = replace(bench.camera.model, exposure=1.0)
    reading = bench.sensor.read()
    assert reading.over_range
    assert not reading.good
    bench.camera.model = replace(bench.camera.model, exposure=0.05)
    assert bench.sensor.read().good


def test_closed_is_closed(bench: Bench) -> None:
    bench.sensor.close()
    with pytest.raises(PortClosed, match="eye"):
        bench.sensor.read()
