"""A bench for the tests of this room: simulated instruments, forty times faster than time."""

import dataclasses
from collections.abc import Iterator

import pytest

from rig.bench import Bench, open_bench
from rig.config import BenchConfig, Simulation, load_config

SPEED = 40.0


@pytest.fixture(scope="session")
def bench_config(tmp_path_factory: pytest.TempPathFactory) -> BenchConfig:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("nothing"))
        return dataclasses.replace(load_config(None), simulation=Simulation(SPEED, seed=7))


@pytest.fixture(scope="module")
def open_simulated_bench(bench_config: BenchConfig) -> Iterator[Bench]:
    with open_bench(bench_config, "RR") as bench:
        yield bench


@pytest.fixture
def bench(open_simulated_bench: Bench) -> Bench:
    """The bench, homed, source at 45 deg, detector at 0."""
    for axis in open_simulated_bench.axes.values():
        if not axis.homed:
            axis.home().wait(20)
    for name, theta in (("source", 45.0), ("detector", 0.0)):
        open_simulated_bench.axes[name].set(theta).wait(20)
    return open_simulated_bench
