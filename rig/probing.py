"""Asking a bench's instruments one by one, so that one that is dead, or in use, does not hide the others. Nothing moves."""

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

from drivers import catalogue
from drivers.errors import DeviceError
from drivers.kinds import DistanceReading, LightReading, LightSensor, RangeFinder, Stage
from rig.axisrecord import AxisRecord, recollected
from rig.bench import Paperwork
from rig.config import AxisConfig, BenchConfig, SensorConfig
from rig.errors import ConfigError, RunError
from rig.ownership import Owner, PortInUse, claimed
from rig.ports import Ports, open_ports
from rig.session import lasting

SPECIMEN = "RR"
"""What the simulated bench mounts where nothing is measured."""

Row = dict[str, Any]


def probe_rows(config: BenchConfig, papers: Paperwork) -> list[Row]:
    """Return identity and state of every instrument: `name`, `port`, `configured`, `identity`, `state`, `error` ('' where all is well).

    Meters are set up as for a measurement, and read once where no more than asking is needed for that.
    """
    models = catalogue.load()

    def ask(ports: Ports, name: str) -> Row:
        configured = config.devices[name]
        device, _ = ports.open(configured)
        try:
            identity = vars(device.identify())
            return {"identity": identity, "state": _state(device, configured, reads=models.lookup(configured.model).reads_at_once)}
        finally:
            device.close()

    def in_use(name: str, busy: PortInUse) -> Row:
        return {"error": str(busy)}

    return _rows(config, list(config.devices), papers, ask, in_use)


def _state(device: Any, configured: AxisConfig | SensorConfig, *, reads: bool) -> Row:
    if isinstance(device, Stage):
        state = device.state()
        return {
            "own_position": round(state.position, 4),
            "unit": device.unit,
            "moving": state.moving,
            "homed": state.homed,
            "warnings": list(state.warnings),
        }
    if isinstance(device, LightSensor):
        assert isinstance(configured, SensorConfig)
        if configured.integration_s is not None:
            device.configure(configured.integration_s, configured.range)
        return {**(reading_row(device.read(), device.unit) if reads else {"unit": device.unit}), "integration_s": device.integration_s}
    if isinstance(device, RangeFinder):
        near_mm, far_mm = device.limits_mm()
        return {**(reading_row(device.read(), "mm") if reads else {}), "near_mm": near_mm, "far_mm": far_mm}
    return {}


def reading_row(reading: LightReading | DistanceReading, unit: str) -> Row:
    """Return a reading in JSON's types: `value` (None where it is not good), `unit`, `good`, `status` and `flags`."""
    value = reading.value if isinstance(reading, LightReading) else reading.distance_mm
    flags = [flag for flag in ("over_range", "under_range", "out_of_range", "doubtful") if getattr(reading, flag, False)]
    return {
        "value": value if reading.good and math.isfinite(value) else None,
        "unit": unit,
        "good": reading.good,
        "status": reading.status,
        "flags": [*flags, *reading.flags],
    }


def axis_rows(config: BenchConfig, names: Sequence[str], papers: Paperwork) -> list[Row]:
    """Return position in theta, state, limits and last command of each axis named, and `error` ('' where all is well).

    Of an axis that another program has, `in_use_by` says which; it is not asked, and its position and state are None.
    """

    def known(name: str) -> tuple[AxisRecord | None, list[str]]:
        try:
            return (papers.records.get(config.axes[name].identity) if papers.records else None), []
        except RunError as exc:  # to look does no harm
            return None, [str(exc)]

    def ask(ports: Ports, name: str) -> Row:
        axis = config.axes[name]
        record, notices = known(name)
        stage = _stage(ports, axis)
        try:
            notices += recollected(name, stage, axis.map, axis.tolerance, record)
            state = stage.state()
        finally:
            stage.close()
        return {
            "position": axis.map.to_theta(state.position),
            "unit": axis.unit,
            "moving": state.moving,
            "homed": state.homed,
            "warnings": list(state.warnings),
            "low": axis.limits[0],
            "high": axis.limits[1],
            "last_command": _last_command(axis, record) if record else None,
            "notices": notices,
            "in_use_by": None,
        }

    def in_use(name: str, busy: PortInUse) -> Row:
        axis = config.axes[name]
        record, notices = known(name)
        return {
            "position": None,
            "unit": axis.unit,
            "moving": None,
            "homed": None,
            "warnings": [],
            "low": axis.limits[0],
            "high": axis.limits[1],
            "last_command": _last_command(axis, record, busy.owner) if record else None,
            "notices": notices,
            "in_use_by": {"pid": busy.owner.pid, "command": busy.owner.command} if busy.owner else {"pid": None, "command": None},
            "error": "",
        }

    return _rows(config, names, papers, ask, in_use)


def _last_command(axis: AxisConfig, record: AxisRecord, owner: Owner | None = None) -> str:
    """Say what an axis was last told; `owner` is who has it now."""
    what = "homing" if record.setpoint is None else f"{axis.map.to_theta(record.setpoint):g} {axis.unit}"
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.time))
    if not record.under_way:
        return f"last told {what}, came to rest at {axis.map.to_theta(record.readback):.3f} {axis.unit} at {when}"
    if owner is not None and record.time >= owner.since:
        return f"last told {what} at {when}, on its way"
    return f"last told {what} at {when}, its end was not seen"


def _stage(ports: Ports, axis: AxisConfig) -> Stage:
    stage, _ = ports.open(axis)
    if not isinstance(stage, Stage):
        raise ConfigError(f"{ports.config.source}: axes.{axis.name}.model: {axis.model} is not a stage")
    return stage


def _rows(
    config: BenchConfig,
    names: Sequence[str],
    papers: Paperwork,
    ask: Callable[[Ports, str], Row],
    in_use: Callable[[str, PortInUse], Row],
) -> list[Row]:
    """Ask at every port at once, the devices of one port in turn; each port is ours meanwhile, or another program's."""
    by_port: dict[str, list[str]] = {}
    for name in names:
        by_port.setdefault(config.devices[name].port, []).append(name)

    def asked(claims: ExitStack, ports: Ports, port: str) -> list[Row]:
        try:
            if lasting(config):
                claims.enter_context(claimed([port]))
        except PortInUse as busy:
            return [{**_head(config, name), **in_use(name, busy)} for name in by_port[port]]
        except RunError as exc:
            return [{**_head(config, name), "error": str(exc)} for name in by_port[port]]
        return [{**_head(config, name), **_answer(ports, name, ask)} for name in by_port[port]]

    with (
        ExitStack() as claims,  # let go of after the ports are closed
        open_ports(config, SPECIMEN, trace=papers.trace, report=papers.report) as ports,
        ThreadPoolExecutor(len(by_port)) as pool,
    ):
        answers = list(pool.map(lambda port: asked(claims, ports, port), by_port))
    rows = {row["name"]: row for answer in answers for row in answer}
    return [rows[name] for name in names]


def _head(config: BenchConfig, name: str) -> Row:
    return {"name": name, "port": config.devices[name].port, "configured": config.devices[name].model}


def _answer(ports: Ports, name: str, ask: Callable[[Ports, str], Row]) -> Row:
    try:
        return {**ask(ports, name), "error": ""}
    except DeviceError as exc:
        return {"error": f"{type(exc).__name__}: {exc}"}
