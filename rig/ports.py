"""The links of a bench: one per port, opened when first asked for, each with a worker of its own, closed together."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from drivers import catalogue
from drivers.errors import DeviceError
from drivers.incidents import Report
from drivers.link import Link
from drivers.models import Device
from rig.bus import BusWorker
from rig.clock import Clock
from rig.config import AxisConfig, BenchConfig, SensorConfig
from rig.simulation import SimulatedBench, simulated_bench
from rig.trace import Trace

LINK_TIMEOUT_S = 1.0


@dataclass(frozen=True)
class Ports:
    """The ports of a bench.

    Attributes
    ----------
    config : BenchConfig
    clock : Clock
    simulation : mapping or None
        What the simulated bench was started with (its seed, say); None on a real one.
    """

    config: BenchConfig
    clock: Clock
    simulation: Mapping[str, Any] | None
    _models: catalogue.Catalogue
    _simulated: SimulatedBench | None
    _stack: ExitStack
    _trace: Trace | None
    _report: Report | None
    _open: dict[str, tuple[Link, BusWorker]]

    def on(self, device: AxisConfig | SensorConfig) -> tuple[Link, BusWorker]:
        """Return the link a device hangs on, and the worker that owns its traffic.

        Raises
        ------
        drivers.DeviceError
            The port cannot be opened.
        ConfigError
            The simulated bench has no such port.
        """
        port = device.port
        if port not in self._open:
            url = self._simulated.url(port) if self._simulated else port
            try:
                link = self._models.lookup(device.model).open_link(
                    url,
                    timeout_s=LINK_TIMEOUT_S,
                    traffic=self._trace.traffic(port) if self._trace else None,
                    report=self._report,
                    **device.serial,
                )
            except DeviceError as exc:
                exc.device = device.name  # as the user calls it
                raise
            worker = BusWorker(port, self.clock)
            self._stack.callback(worker.close)
            self._stack.callback(link.close)  # before the worker: it may be waiting for an answer, of a camera for a minute
            self._open[port] = (link, worker)
        return self._open[port]

    def open(self, device: AxisConfig | SensorConfig) -> tuple[Device, BusWorker]:
        """Return the driver of a device, and the worker of its port. Nothing moves.

        Raises
        ------
        drivers.DeviceError
            The port cannot be opened, or the device does not answer as it should.
        """
        link, worker = self.on(device)
        return self._models.lookup(device.model).open_device(link, name=device.name, **device.options), worker

    def halt(self, axis: AxisConfig) -> None:
        """Put the stop on an axis's wire, whatever state it is in; nothing is asked or set first.

        Raises
        ------
        drivers.DeviceError
            The port cannot be opened, or the stop is not acknowledged.
        """
        link, _ = self.on(axis)
        self._models.lookup(axis.model).halt_device(link, name=axis.name, **axis.options)


@contextmanager
def open_ports(config: BenchConfig, specimen: str, *, trace: Trace | None = None, report: Report | None = None) -> Iterator[Ports]:
    """Give access to the ports of `config`, starting the simulated bench where that is the bench.

    Parameters
    ----------
    config : BenchConfig
    specimen : str
        The cultivar that is mounted; the simulated bench mounts it itself.
    trace : Trace, optional
        Where all bytes are written.
    report : callable, optional
        Told what the links did about trouble.
    """
    with ExitStack() as stack:
        simulation = config.simulation
        simulated = stack.enter_context(simulated_bench(config, specimen)) if simulation and not simulation.served else None
        clock = Clock(simulation.speed if simulation else 1.0)
        yield Ports(config, clock, simulated.parameters if simulated else None, catalogue.load(), simulated, stack, trace, report, {})
