"""What goes along with work on a bench: its ports are ours alone, every command is written down, and on request every byte."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from drivers.incidents import Report
from rig.axisrecord import AxisRecords
from rig.bench import Paperwork
from rig.config import ANGLES, BenchConfig
from rig.ownership import claimed
from rig.trace import Trace
from rig.workspace import Workspace


def lasting(config: BenchConfig) -> bool:
    """Tell whether the bench is there before and after this program: one that starts and ends with it has no past and no other users."""
    return config.simulation is None or config.simulation.served


@contextmanager
def paperwork(
    config: BenchConfig,
    workspace: Workspace,
    *,
    devices: Iterable[str] | None = None,
    trace: str | None = None,
    report: Report | None = None,
) -> Iterator[Paperwork]:
    """Prepare the paperwork for opening instruments of `config`: those named in `devices` are ours as long as this context lasts.

    None are those that `open_bench` opens where it is told nothing: the arms, the main sensor and its monitors.
    Nothing is claimed or remembered of a simulated bench that starts and ends with this program.

    Raises
    ------
    PortInUse
        Another program has the port of one of them.
    RunError
        Ports cannot be claimed.
    ConfigError
        The trace cannot be written.
    """
    records = AxisRecords(workspace.axes) if lasting(config) else None
    with ExitStack() as stack:
        if lasting(config):
            names = (*ANGLES, *config.sweep_sensors) if devices is None else devices
            stack.enter_context(claimed(config.devices[name].port for name in names))
        yield Paperwork(stack.enter_context(_traced(config, trace, records)) if trace else None, report, records)


@contextmanager
def _traced(config: BenchConfig, path: str, records: AxisRecords | None) -> Iterator[Trace]:
    about = {"command": ["rig", *sys.argv[1:]], "bench": config.name, "simulated": config.simulated, "config": config.text}
    trace = Trace(Path(path), about, records=records.fields() if records else None)
    try:
        with trace:
            yield trace
    finally:
        if trace.broken:
            print(trace.broken, file=sys.stderr)
