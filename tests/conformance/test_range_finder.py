"""What every range finder owes, whoever made it: each driver over its wire simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

from drivers import catalogue
from drivers.errors import InvalidSetting, PortClosed
from drivers.kinds import DistanceReading, RangeFinder, Stage
from drivers.modbus import ModbusLink
from drivers.motion import wait_until_idle
from drivers.rangefinders.baumer_om import BaumerOM
from drivers.rangefinders.optoncdt1420 import OptoNCDT1420, StreamLink
from rig.clock import Clock
from sim.baumer import DistanceSensor, RangeModel
from sim.clock import SimClock
from sim.modbus import ModbusBus
from sim.optoncdt import OptoNCDT, TriangulationModel
from sim.serve import Running
from tests.conformance.conftest import FINDERS, SPEED, STAGES, opened
from tests.sim.served import served

START_MM = 45.0


class Target:
    """A surface at a distance from the sensor's front, mm; None when there is none."""

    def __init__(self) -> None:
        self.distance_mm: float | None = 70.0

    def at(self, start: float = 0.0) -> float | None:
        return None if self.distance_mm is None else self.distance_mm - start


@dataclass(frozen=True)
class Bench:
    finder: RangeFinder
    target: Target


@contextmanager
def optoncdt(target: Target) -> Iterator[Callable[[], RangeFinder]]:
    def make() -> OptoNCDT:
        return OptoNCDT(SimClock(), lambda t0, t1: target.at(START_MM), np.random.default_rng(1), TriangulationModel(measuring_range=50.0))

    with served(make) as (_, ports), StreamLink.open(ports.tcp, timeout_s=5.0) as link:
        yield lambda: OptoNCDT1420.open(link, "range", start_of_range_mm=START_MM)


@contextmanager
def baumer(target: Target) -> Iterator[Callable[[], RangeFinder]]:
    def make() -> ModbusBus:
        sensor = DistanceSensor(lambda t0, t1: target.at(), np.random.default_rng(1), RangeModel(near=45.0, far=95.0))
        return ModbusBus(SimClock(), {1: sensor}, "range", "baumer-om20")

    with served(make) as (_, ports), ModbusLink.open(ports.tcp, timeout_s=5.0) as link:
        yield lambda: BaumerOM.open(link, "range")


OVER_A_TARGET = {"micro-epsilon-ild1420": optoncdt, "baumer-om20": baumer}


@pytest.fixture(scope="module", params=OVER_A_TARGET)
def port(request: pytest.FixtureRequest) -> Iterator[tuple[Callable[[], RangeFinder], Target]]:
    """What opens a range finder on its port, and what it looks at; ports are slow to close."""
    target = Target()
    with OVER_A_TARGET[request.param](target) as connect:
        yield connect, target


@pytest.fixture
def bench(port: tuple[Callable[[], RangeFinder], Target]) -> Bench:
    """A range finder, freshly opened."""
    connect, target = port
    target.distance_mm = 70.0
    finder = connect()
    assert isinstance(finder, RangeFinder)
    return Bench(finder, target)


def test_every_range_finder_of_the_catalogue_is_here() -> None:
    assert set(FINDERS) == {model.name for model in catalogue.BUILT_IN if model.kind == "range-finder"}


def test_it_says_who_it_is(bench: Bench) -> None:
    identity = bench.finder.identify()
    assert all((identity.vendor, identity.model, identity.serial_number, identity.firmware))
    assert bench.finder.name == "range"


def test_its_limits_are_in_order(bench: Bench) -> None:
    near_mm, far_mm = bench.finder.limits_mm()
    assert near_mm == pytest.approx(45.0)
    assert far_mm == pytest.approx(95.0)


def test_it_tells_the_distance_that_is_there_now(bench: Bench) -> None:
    """A reading is made after the call: never one from before the target moved."""
    for distance_mm in (*np.linspace(46.0, 94.0, 13), 46.0, 94.0):
        bench.target.distance_mm = float(distance_mm)
        reading = bench.finder.read()
        assert reading.good
        assert reading.distance_mm == pytest.approx(distance_mm, abs=0.06)


@pytest.mark.parametrize("distance_mm", [None, 43.0, 97.0, 1000.0])
def test_without_a_target_the_reading_is_flagged_and_the_next_is_good_again(bench: Bench, distance_mm: float | None) -> None:
    assert bench.finder.read().good
    bench.target.distance_mm = distance_mm
    lost = bench.finder.read()
    assert not lost.good
    assert lost.distance_mm == math.inf
    assert lost.flags
    bench.target.distance_mm = 60.0
    assert bench.finder.read().distance_mm == pytest.approx(60.0, abs=0.06)


def test_its_readings_scatter_little(bench: Bench) -> None:
    readings: list[DistanceReading] = [bench.finder.read() for _ in range(40)]
    values = [reading.distance_mm for reading in readings]
    assert all(reading.good for reading in readings)
    assert 0 < np.std(values) < 0.02


def test_closed_is_closed(finder: RangeFinder) -> None:
    assert all(vars(finder.identify()).values())
    finder.close()
    with pytest.raises(PortClosed, match="range"):
        finder.read()


@pytest.fixture
def carriage(world: Running) -> Iterator[Callable[[float], None]]:
    """Send the plate that all range finders of the world look at to a position, mm."""
    with opened(world, "zaber-x-lsm", STAGES["zaber-x-lsm"], "carriage") as stage:
        assert isinstance(stage, Stage)
        stage.set_profile(speed=100.0, acceleration=1000.0)
        if not stage.state().homed:
            stage.start_home()
            wait_until_idle(stage, 0.0, timeout_s=120.0, clock=Clock(SPEED))

        def send(position: float) -> None:
            stage.start_move(position)
            wait_until_idle(stage, 0.0, timeout_s=30.0, clock=Clock(SPEED))
            stage.check_arrival(position, 0.01)

        yield send


def test_it_sees_the_plate_go(finder: RangeFinder, carriage: Callable[[float], None], world: Running) -> None:
    near_mm, far_mm = finder.limits_mm()
    carriage(5.0)
    first = finder.read()
    assert first.good
    assert near_mm < first.distance_mm < far_mm
    for gone in (3.0, 20.0, 35.0):
        carriage(5.0 + gone)
        reading = finder.read()
        assert reading.good
        assert reading.distance_mm - first.distance_mm == pytest.approx(gone, abs=0.1)
    carriage(145.0)
    lost = finder.read()
    assert (lost.good, lost.distance_mm) == (False, math.inf)
    carriage(5.0)
    assert finder.read().distance_mm == pytest.approx(first.distance_mm, abs=0.1)


@pytest.mark.parametrize(
    ("distance_mm", "out_of_range"), [(math.nan, False), (math.nan, True), (math.inf, False), (-math.inf, True), (70.0, True)]
)
def test_a_reading_cannot_contradict_itself(distance_mm: float, out_of_range: bool) -> None:
    with pytest.raises(InvalidSetting):
        DistanceReading(distance_mm, out_of_range=out_of_range)


def test_what_makes_a_reading_good() -> None:
    assert DistanceReading(70.0).good
    assert not DistanceReading(70.0, doubtful=True).good
    assert not DistanceReading(math.inf, out_of_range=True).good
