"""The bench: links, workers and devices made from a configuration, closed and stopped together."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from drivers import catalogue
from drivers.errors import DeviceError
from drivers.kinds import LightSensor, Stage
from drivers.link import Link
from rig.bus import BusWorker
from rig.clock import Clock
from rig.config import ANGLES, AxisConfig, BenchConfig
from rig.devices import Axis, LightMeter
from rig.errors import ConfigError
from rig.interlock import Interlock
from rig.simulation import simulated_bench

LINK_TIMEOUT_S = 1.0


@dataclass(frozen=True)
class Bench:
    """An open bench.

    Attributes
    ----------
    config : BenchConfig
    axes : mapping of axis name to Axis
    meter : LightMeter
    simulation : mapping or None
        What the simulated bench was started with (its seed, say); None on a real one.
    """

    config: BenchConfig
    axes: Mapping[str, Axis]
    meter: LightMeter
    clock: Clock
    simulation: Mapping[str, Any] | None

    def stop(self) -> list[DeviceError]:
        """Stop every axis at once; return what could not be told to stop. Safe from any thread."""
        failures = []
        for axis in self.axes.values():
            try:
                axis.stop()
            except DeviceError as exc:
                failures.append(exc)
        return failures

    def position(self) -> dict[str, float]:
        """Return where each axis stands or is going, in degrees of theta."""
        return {name: axis.destination for name, axis in self.axes.items()}


@contextmanager
def open_bench(config: BenchConfig, specimen: str) -> Iterator[Bench]:
    """Open every instrument of `config`; leave them stopped and closed, whatever happens inside.

    Parameters
    ----------
    config : BenchConfig
    specimen : str
        The cultivar that is mounted; the simulated bench mounts it itself.

    Raises
    ------
    drivers.DeviceError
        Where an instrument is absent, silent or not what it should be; names port and device.
    ConfigError
        Where the simulated bench lacks the specimen.
    """
    with ExitStack() as stack:
        simulated = stack.enter_context(simulated_bench(config, specimen)) if config.simulated else None
        clock = Clock(config.simulation.speed if config.simulation else 1.0)
        models = catalogue.load()
        links: dict[str, tuple[Link, BusWorker]] = {}

        def connect(model: str, port: str, serial: Mapping[str, Any]) -> tuple[Link, BusWorker]:
            if port not in links:
                url = simulated.url(port) if simulated else port
                link = models.lookup(model).open_link(url, timeout_s=LINK_TIMEOUT_S, **serial)
                stack.callback(link.close)
                worker = BusWorker(port, clock)
                stack.callback(worker.close)
                links[port] = (link, worker)
            return links[port]

        sensor = config.sensor
        meter_link, meter_worker = connect(sensor.model, sensor.port, sensor.serial)
        stage_links = {name: connect(axis.model, axis.port, axis.serial) for name, axis in config.axes.items()}
        meter_driver = models.lookup(sensor.model).open_device(meter_link, name="meter", **sensor.options)
        if not isinstance(meter_driver, LightSensor):
            raise ConfigError(f"{config.source}: sensor.model: {sensor.model} is not a light sensor")
        meter_driver.configure(sensor.integration_s, sensor.range)
        axes: dict[str, Axis] = {}
        meter = LightMeter("current", meter_driver, meter_worker)
        bench = Bench(config, axes, meter, clock, simulated.parameters if simulated else None)
        stack.callback(bench.stop)
        for name, axis in config.axes.items():
            link, worker = stage_links[name]
            stage = models.lookup(axis.model).open_device(link, name=name, **axis.options)
            if not isinstance(stage, Stage):
                raise ConfigError(f"{config.source}: axes.{name}.model: {axis.model} is not a rotary axis")
            stage.set_profile(speed=axis.speed, acceleration=axis.acceleration)
            axes[name] = _axis(axis, stage, bench, worker)
        yield bench


def _axis(config: AxisConfig, stage: Stage, bench: Bench, worker: BusWorker) -> Axis:
    interlock: Interlock = bench.config.interlock

    def check(axis: str, target_deg: float) -> None:
        interlock.check_move(bench.position(), axis, target_deg)

    return Axis(
        config.name,
        ANGLES[config.name],
        stage,
        config.map,
        worker,
        bench.clock,
        settle_s=config.settle_s,
        tolerance=config.tolerance,
        check=check,
    )
