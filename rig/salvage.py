"""The axes of a rig.toml that cannot be used as it is, for a stop: only their ports and models matter for that."""

import re
import tomllib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rig.config import SIMULATED_PORT, AxisConfig, BenchConfig, Simulation
from rig.interlock import KeepOut
from rig.kinematics import AxisMap

if TYPE_CHECKING:
    from drivers.models import DeviceModel

_HEADER = re.compile(r"\s*\[\s*axes\s*\.\s*[\"']?([A-Za-z0-9_-]+)[\"']?\s*\]")
_SIMULATION = re.compile(r"^\s*\[\s*simulation\s*\]", re.MULTILINE)
_PLACE = ("address", "axis")


def salvaged(text: str, source: str) -> tuple[BenchConfig, dict[str, str]]:
    """Return a bench of the axes that can be made out in `text`, good for nothing but `Ports.halt`, and of each other why it cannot be.

    Parameters
    ----------
    text : str
        What should be TOML.
    source : str
        What it is called.
    """
    from drivers import catalogue

    models = catalogue.load().models
    axes: dict[str, AxisConfig] = {}
    lost: dict[str, str] = {}
    for name, table in _tables(text).items():
        try:
            axes[name] = _axis(name, table, models)
        except _Unclear as exc:
            lost[name] = str(exc)
    simulation = Simulation(1.0, None, served=True) if _SIMULATION.search(text) else None
    return BenchConfig(source, axes, {}, KeepOut(0.0, crossing=True), simulation, text, source), lost


class _Unclear(Exception):
    """What keeps an axis from being told to stop."""


def _tables(text: str) -> dict[str, dict[str, Any]]:
    """Return what is said of each axis; where it is not TOML, line by line what can be understood."""
    try:
        axes = tomllib.loads(text).get("axes")
    except tomllib.TOMLDecodeError:
        return _by_line(text)
    return {name: table for name, table in axes.items() if isinstance(table, dict)} if isinstance(axes, dict) else {}


def _by_line(text: str) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    table: dict[str, Any] = {}
    for line in text.splitlines():
        if line.lstrip().startswith("["):
            header = _HEADER.match(line)
            table = found.setdefault(header[1], {}) if header else {}
            continue
        try:
            table.update(tomllib.loads(line))
        except tomllib.TOMLDecodeError:
            continue
    return found


def _axis(name: str, table: Mapping[str, Any], models: "Mapping[str, DeviceModel]") -> AxisConfig:
    port, model = table.get("port"), models.get(str(table.get("model")))
    if not isinstance(port, str) or not port:
        raise _Unclear(f"port {port!r} is none")
    if port.startswith(SIMULATED_PORT):
        raise _Unclear(f"{port} is there only while a command runs")
    if model is None or not model.kind.endswith("-axis"):
        raise _Unclear(f"model {table.get('model')!r} is no known stage")
    options = {}
    for key, option in model.options.items():
        try:
            if key in table:
                options[key] = option.check(table[key])
        except Exception as exc:
            if key in _PLACE:
                raise _Unclear(f"{key} {table[key]!r} is none, so nobody knows which axis of {port} it is") from exc
    line = {key: table[key] for key, default in model.line.items() if type(table.get(key)) is type(default)}
    unit: Any = "mm" if model.kind == "linear-axis" else "deg"
    nowhere = AxisMap(1, 0.0)
    return AxisConfig(name, model.name, port, "", unit, nowhere, (0.0, 0.0), None, None, 0.0, 0.02, options, line)
