"""Asking a bench's instruments one by one, so that one that is dead does not hide the others. Nothing moves."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from drivers.errors import DeviceError
from drivers.kinds import LightSensor, RangeFinder, Stage
from rig.axisrecord import AxisRecord, recollected
from rig.bench import Paperwork
from rig.config import AxisConfig, BenchConfig, SensorConfig
from rig.errors import ConfigError
from rig.ports import Ports, open_ports

SPECIMEN = "RR"
"""What the simulated bench mounts where nothing is measured."""

Row = dict[str, Any]


def probe_rows(config: BenchConfig, papers: Paperwork) -> list[Row]:
    """Return identity and state of every instrument: `name`, `port`, `configured`, `identity`, `state`, `error` ('' where all is well)."""

    def ask(ports: Ports, name: str) -> Row:
        device, _ = ports.open(config.devices[name])
        try:
            return {"identity": vars(device.identify()), "state": _state(device)}
        finally:
            device.close()

    return _rows(config, list(config.devices), papers, ask)


def _state(device: Any) -> Row:
    if isinstance(device, Stage):
        state = device.state()
        return {
            "position": round(state.position, 4),
            "unit": device.unit,
            "moving": state.moving,
            "homed": state.homed,
            "warnings": list(state.warnings),
        }
    if isinstance(device, LightSensor):
        return {"unit": device.unit, "integration_s": device.integration_s}
    if isinstance(device, RangeFinder):
        near_mm, far_mm = device.limits_mm()
        return {"near_mm": near_mm, "far_mm": far_mm}
    return {}


def axis_rows(config: BenchConfig, names: Sequence[str], papers: Paperwork) -> list[Row]:
    """Return position in theta, state, limits and last command of each axis named, and `error` ('' where all is well)."""

    def ask(ports: Ports, name: str) -> Row:
        axis = config.axes[name]
        record = papers.records.get(axis.identity) if papers.records else None
        stage = _stage(ports, axis)
        try:
            notices = recollected(name, stage, axis.map, axis.tolerance, record)
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
            "notices": list(notices),
        }

    return _rows(config, names, papers, ask)


def _last_command(axis: AxisConfig, record: AxisRecord) -> str:
    what = "homing" if record.setpoint is None else f"{axis.map.to_theta(record.setpoint):g} {axis.unit}"
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.time))
    if record.under_way:
        return f"last told {what} at {when}, its end was not seen"
    return f"last told {what}, came to rest at {axis.map.to_theta(record.readback):.3f} {axis.unit} at {when}"


def stop_rows(config: BenchConfig, papers: Paperwork) -> list[Row]:
    """Stop every axis at once; return `axis` and `error` ('' where it acknowledged) of each."""

    def stop(ports: Ports, name: str) -> Row:
        axis = config.axes[name]
        stage = _stage(ports, axis)
        try:
            stage.stop()
        finally:
            stage.close()
        return {}

    return _rows(config, list(config.axes), papers, stop)


def _stage(ports: Ports, axis: AxisConfig) -> Stage:
    stage, _ = ports.open(axis)
    if not isinstance(stage, Stage):
        raise ConfigError(f"{ports.config.source}: axes.{axis.name}.model: {axis.model} is not a stage")
    return stage


def _rows(config: BenchConfig, names: Sequence[str], papers: Paperwork, ask: Callable[[Ports, str], Row]) -> list[Row]:
    """Ask at every port at once, the devices of one port in turn."""
    by_port: dict[str, list[str]] = {}
    for name in names:
        by_port.setdefault(config.devices[name].port, []).append(name)

    def asked(ports: Ports, each: list[str]) -> list[Row]:
        return [_row(config.devices[name], name, ports, ask) for name in each]

    with open_ports(config, SPECIMEN, trace=papers.trace, report=papers.report) as ports, ThreadPoolExecutor(len(by_port)) as pool:
        answers = list(pool.map(lambda each: asked(ports, each), by_port.values()))
    rows = {row["name"]: row for answer in answers for row in answer}
    return [rows[name] for name in names]


def _row(device: AxisConfig | SensorConfig, name: str, ports: Ports, ask: Callable[[Ports, str], Row]) -> Row:
    head = {"name": name, "port": device.port, "configured": device.model}
    try:
        return {**head, **ask(ports, name), "error": ""}
    except DeviceError as exc:
        return {**head, "error": f"{type(exc).__name__}: {exc}"}
