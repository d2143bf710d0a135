"""What goes along with work on a bench: it is ours alone, every command is written down, and on request every byte."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from drivers.incidents import Report
from rig.axisrecord import AxisRecords
from rig.bench import Paperwork
from rig.config import BenchConfig
from rig.ownership import owned
from rig.trace import Trace
from rig.workspace import Workspace


@contextmanager
def paperwork(
    config: BenchConfig, workspace: Workspace, *, trace: str | None = None, report: Report | None = None, moves: bool = True
) -> Iterator[Paperwork]:
    """Prepare the paperwork for opening the bench of `config`.

    A simulated bench that starts and ends with this program has no past and no other users: nothing is locked or remembered for it.

    Raises
    ------
    RunError
        `moves`, and another program has the bench.
    ConfigError
        The trace cannot be written.
    """
    lasting = config.simulation is None or config.simulation.served
    with ExitStack() as stack:
        if moves and lasting:
            stack.enter_context(owned(workspace.lock))
        about = {"command": ["rig", *sys.argv[1:]], "bench": config.name, "simulated": config.simulated, "config": config.text}
        opened = stack.enter_context(Trace(Path(trace), about)) if trace else None
        yield Paperwork(opened, report, AxisRecords(workspace.axes) if lasting else None)
