"""The bench: devices made from a configuration, interlocked, closed and stopped together."""

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

from drivers.errors import DeviceError
from drivers.incidents import Report
from drivers.kinds import LightSensor, RangeFinder, Stage
from rig.axisrecord import AxisRecords
from rig.brake import Brake
from rig.clock import Clock
from rig.config import ANGLES, MAIN_SENSOR, AxisConfig, BenchConfig, SensorConfig
from rig.devices import Axis, LightMeter, Ranger
from rig.errors import ConfigError, InterlockError, RigError
from rig.ports import Ports, open_ports
from rig.trace import Trace

READING = "current"
"""What events call the reading of the main sensor."""

REST_S = 1.0
"""How long an axis that was told to stop may take to come to rest before the bench is closed, s of real time."""


@dataclass(frozen=True)
class Paperwork:
    """What is written while a bench is open: all bytes, what was done about trouble, what each axis was told. All may be left out."""

    trace: Trace | None = None
    report: Report | None = None
    records: AxisRecords | None = None


@dataclass(frozen=True)
class Bench:
    """An open bench.

    Attributes
    ----------
    config : BenchConfig
    axes : mapping of axis name to Axis
    sensors : mapping of sensor name to LightMeter or Ranger
    simulation : mapping or None
        What the simulated bench was started with (its seed, say); None on a real one.
    """

    config: BenchConfig
    clock: Clock
    simulation: Mapping[str, Any] | None
    brake: Brake = field(default_factory=Brake)
    axes: dict[str, Axis] = field(default_factory=dict)
    sensors: dict[str, LightMeter | Ranger] = field(default_factory=dict)

    @property
    def meter(self) -> LightMeter:
        """The light sensor that a sweep reads."""
        meter = self.sensors[MAIN_SENSOR]
        assert isinstance(meter, LightMeter)
        return meter

    @property
    def monitors(self) -> tuple[LightMeter | Ranger, ...]:
        """The sensors that are read along with it."""
        return tuple(sensor for name, sensor in self.sensors.items() if self.config.sensors[name].monitor)

    @property
    def notices(self) -> list[str]:
        """What somebody should know before anything moves."""
        return [notice for axis in self.axes.values() for notice in axis.notices]

    def halt(self) -> list[Exception]:
        """Let nothing begin any more, and stop every axis; return what could not be told to stop. Safe from any thread."""
        self.brake.apply()
        return self.stop()

    def release(self) -> None:
        """Let motions and readings begin again."""
        self.brake.release()

    def stop(self) -> list[Exception]:
        """Stop every axis at once; return what could not be told to stop. Safe from any thread.

        No axis waits for another's answer: a silent wire must not delay the stop on the next one.
        """
        if not self.axes:
            return []
        with ThreadPoolExecutor(len(self.axes), thread_name_prefix="stop") as pool:
            return [failure for failure in pool.map(_stop, self.axes.values()) if failure is not None]

    def position(self) -> dict[str, float]:
        """Return where each axis stands or is going, in theta."""
        return {name: axis.destination for name, axis in self.axes.items()}


def _stop(axis: Axis) -> Exception | None:
    try:
        axis.stop()
    except Exception as exc:  # whatever is wrong with one axis must not keep the stop from the others
        return exc
    return None


@contextmanager
def open_bench(
    config: BenchConfig,
    specimen: str,
    *,
    axes: Iterable[str] | None = None,
    sensors: Iterable[str] | None = None,
    paperwork: Paperwork | None = None,
) -> Iterator[Bench]:
    """Open instruments of `config`; leave them stopped and closed, whatever happens inside.

    Parameters
    ----------
    config : BenchConfig
    specimen : str
        The cultivar that is mounted; the simulated bench mounts it itself.
    axes, sensors : iterable of str, optional
        Which ones; by default the two arms, and the main sensor with its monitors.
    paperwork : Paperwork, optional

    Raises
    ------
    drivers.DeviceError
        Where an instrument is absent, silent or not what it should be; names port and device.
    ConfigError
        Where the simulated bench lacks the specimen.
    """
    paperwork = paperwork or Paperwork()
    chosen = tuple(ANGLES) if axes is None else tuple(axes)
    wanted = config.sweep_sensors if sensors is None else tuple(sensors)
    with ExitStack() as stack:
        ports = stack.enter_context(open_ports(config, specimen, trace=paperwork.trace, report=paperwork.report))
        bench = Bench(config, ports.clock, ports.simulation)
        for name in (*wanted, *chosen):  # a port that cannot be opened is found before any instrument is set
            ports.on(config.devices[name])
        for name in wanted:
            bench.sensors[name] = _sensor(ports, config.sensors[name], bench.brake)
        stack.push(lambda kind, exc, trace: _leave_stopped(bench, exc))
        for name in chosen:
            bench.axes[name] = _axis(ports, config.axes[name], bench, paperwork)
        yield bench


def _leave_stopped(bench: Bench, exc: BaseException | None) -> None:
    failures = bench.stop()
    for axis in bench.axes.values():
        axis.await_rest(REST_S)
    if not failures:
        return
    warning = f"AND NOT EVERY AXIS COULD BE STOPPED, it may still be moving: {'; '.join(map(str, failures))}"
    if exc is None:
        raise RigError(warning) from failures[0]
    if isinstance(exc, DeviceError):
        exc.hint = f"{exc.hint}; {warning}" if exc.hint else warning
    else:
        exc.add_note(warning)


def _sensor(ports: Ports, config: SensorConfig, brake: Brake) -> LightMeter | Ranger:
    driver, worker = ports.open(config)
    name = READING if config.name == MAIN_SENSOR else config.name
    if isinstance(driver, LightSensor):
        assert config.integration_s is not None
        driver.configure(config.integration_s, config.range)
        return LightMeter(name, driver, worker, brake)
    if isinstance(driver, RangeFinder):
        return Ranger(name, driver, worker, brake)
    raise ConfigError(f"{ports.config.source}: {config.name}: {config.model} is no sensor")


def _axis(ports: Ports, config: AxisConfig, bench: Bench, paperwork: Paperwork) -> Axis:
    stage, worker = ports.open(config)
    if not isinstance(stage, Stage):
        raise ConfigError(f"{ports.config.source}: axes.{config.name}.model: {config.model} is not a stage")
    stage.set_profile(speed=config.speed, acceleration=config.acceleration)
    interlock = ports.config.interlock

    def check(axis: str, target: float) -> None:
        interlock.check_limits(axis, target)
        for other in interlock.arms if axis in interlock.arms else ():
            if other != axis and not bench.axes[other].homed:
                unknown = f"{other} has no reference, so nobody knows how close {axis} would come to it"
                raise InterlockError(f"{unknown}; nothing was moved. `rig home {other}` first")
        interlock.check_move(bench.position(), axis, target)

    return Axis(
        config.name,
        ANGLES.get(config.name, config.name),
        stage,
        config.map,
        worker,
        ports.clock,
        bench.brake,
        settle_s=config.settle_s,
        tolerance=config.tolerance,
        limits=config.limits,
        check=check,
        memory=paperwork.records.of(config.identity) if paperwork.records else None,
        report=paperwork.report,
    )
