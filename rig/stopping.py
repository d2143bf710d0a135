"""The stop of a whole bench from outside: whoever moves it is told to end, and every axis is told to stop without waiting for that."""

import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from drivers.kinds import AxisState, Stage
from rig.axisrecord import AxisRecord, AxisRecords
from rig.bench import Paperwork
from rig.config import AxisConfig, BenchConfig
from rig.errors import RunError
from rig.ownership import Owner, canonical, owners
from rig.ports import Ports, open_ports
from rig.probing import SPECIMEN, Row

PATIENCE_S = 10.0
"""How long a program that was told to end may take, s."""

REST_S = 1.0
"""How long an axis that was told to stop may take to come to rest, s."""

LOOK_S = 0.02


@dataclass
class Ending:
    """The programs that were told to end, and what became of them.

    Attributes
    ----------
    owners : list of Owner
        Those that had ports when the stop came.
    trouble : dict of int to str
        By process: why it could not be told, or that it is still there.
    """

    owners: list[Owner]
    trouble: dict[int, str] = field(default_factory=dict)
    _told: float = field(default_factory=time.monotonic)

    @property
    def ports(self) -> set[str]:
        """The ports they had."""
        return {port for owner in self.owners for port in owner.ports}

    def wait(self) -> None:
        """Give them time to stop their axes and to end."""
        for owner in self.owners:
            left = max(0.0, self._told + PATIENCE_S - time.monotonic())
            if owner.pid in self.trouble:
                left = 0.0
            if owner.await_end(left):
                self.trouble.pop(owner.pid, None)
            else:
                told = f"was told to stop and is still there after {PATIENCE_S:g} s; `kill -9 {owner.pid}` ends it"
                self.trouble.setdefault(owner.pid, f"{owner} {told}")

    def rows(self) -> list[Row]:
        """Return `pid`, `command`, `ports`, `ended` and `error` of each."""
        return [
            {
                "pid": owner.pid,
                "command": owner.command,
                "ports": list(owner.ports),
                "ended": owner.pid not in self.trouble,
                "error": self.trouble.get(owner.pid, ""),
            }
            for owner in self.owners
        ]


def tell_owners(ports: Iterable[str] | None) -> Ending:
    """Tell every program that has one of `ports` (None: any port of this machine) to stop its axes and to end; wait for none."""
    ending = Ending(owners(ports))
    for owner in ending.owners:
        try:
            owner.terminate()
        except RunError as exc:
            ending.trouble[owner.pid] = str(exc)
    return ending


def stop_rows(config: BenchConfig, ending: Ending, papers: Paperwork) -> list[Row]:
    """Stop every axis as `halt_rows` does, then write down where those came to rest whose motion nobody has seen the end of.

    Returns
    -------
    list of dict
        As of `halt_rows`, with `position` in theta, its `unit`, and `moving`; None where the axis does not tell.
    """
    rows = halt_rows(config, ending, papers)
    states = _at_rest(config, [row["name"] for row in rows if not row["error"]], papers)
    for row in rows:
        axis, state = config.axes[row["name"]], states.get(row["name"])
        row |= {"position": None, "unit": axis.unit, "moving": None}
        if state is None:
            continue
        row |= {"position": axis.map.to_theta(state.position), "moving": state.moving}
        if state.moving:
            row["error"] = f"still moving after {REST_S:g} s"
        elif papers.records is not None:
            with suppress(RunError):  # the axis stands; that its end was not seen stays in the record
                _write_down(papers.records, axis, state, watched=canonical(axis.port) in ending.ports)
    return rows


def halt_rows(config: BenchConfig, ending: Ending, papers: Paperwork) -> list[Row]:
    """Put the stop on every axis's wire at once, and again on those that other programs had, once these have ended or should have.

    Returns
    -------
    list of dict
        `name`, `port`, and `error` ('' where the stop was acknowledged, the last time it was sent).
    """
    errors = _halted(config, list(config.axes), papers)
    ending.wait()
    errors |= _halted(config, [name for name, axis in config.axes.items() if canonical(axis.port) in ending.ports], papers)
    return [{"name": name, "port": config.axes[name].port, "error": error} for name, error in errors.items()]


def _halted(config: BenchConfig, names: list[str], papers: Paperwork) -> dict[str, str]:
    """Put the stop on every wire; return what is wrong, '' where it was acknowledged."""
    errors = dict.fromkeys(names, "")

    def halt(ports: Ports, axis: AxisConfig) -> None:
        ports.halt(axis)

    def failed(name: str, exc: Exception) -> None:
        errors[name] = f"{type(exc).__name__}: {exc}"

    _everywhere(config, names, papers, halt, failed)
    return errors


def _at_rest(config: BenchConfig, names: list[str], papers: Paperwork) -> dict[str, AxisState]:
    """Ask each axis until it is at rest; return what was seen last of those that answer."""
    states: dict[str, AxisState] = {}

    def ask(ports: Ports, axis: AxisConfig) -> None:
        stage, _ = ports.open(axis)
        assert isinstance(stage, Stage)
        deadline = time.monotonic() + REST_S
        try:
            while (state := stage.state()).moving and time.monotonic() < deadline:
                time.sleep(LOOK_S)
            states[axis.name] = state
        finally:
            stage.close()

    _everywhere(config, names, papers, ask, lambda name, exc: None)
    return states


def _everywhere(
    config: BenchConfig,
    names: list[str],
    papers: Paperwork,
    do: Callable[[Ports, AxisConfig], Any],
    failed: Callable[[str, Exception], None],
) -> None:
    """Do something with every axis: all ports at once, and the axes of one port without waiting for each other.

    Whatever goes wrong with one of them must not keep the others from it.
    """
    by_port: dict[str, list[AxisConfig]] = {}
    for name in names:
        by_port.setdefault(config.axes[name].port, []).append(config.axes[name])

    def one(ports: Ports, axis: AxisConfig) -> None:
        try:
            do(ports, axis)
        except Exception as exc:
            failed(axis.name, exc)

    def all_on(ports: Ports, axes: list[AxisConfig]) -> None:
        try:
            ports.on(axes[0])  # the link, which only one of them may open
        except Exception as exc:
            for axis in axes:
                failed(axis.name, exc)
            return
        with ThreadPoolExecutor(len(axes)) as pool:
            list(pool.map(lambda axis: one(ports, axis), axes))

    if not by_port:
        return
    with open_ports(config, SPECIMEN, trace=papers.trace, report=papers.report) as ports, ThreadPoolExecutor(len(by_port)) as pool:
        list(pool.map(lambda axes: all_on(ports, axes), by_port.values()))


def _write_down(records: AxisRecords, axis: AxisConfig, state: AxisState, *, watched: bool) -> None:
    """Say where an axis came to rest whose motion was begun by a program that has not seen its end.

    Its reference counts as kept where a move was stopped that was under way when the stop came (`watched`): a controller that does not
    tell may have been switched off since an older one.
    """
    record: AxisRecord | None = records.get(axis.identity)
    if record is None or not record.under_way or state.moving:
        return
    homed = state.homed or (watched and record.homed and record.setpoint is not None)
    records.put(axis.identity, setpoint=record.setpoint, readback=state.position, under_way=False, homed=homed)
