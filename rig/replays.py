"""A rig.toml for instruments that are served already: simulated ones, or those of a trace with what was known of its axes then."""

import json
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rig.axisrecord import AxisRecord, AxisRecords
from rig.config import BenchConfig, parse_config
from rig.errors import ConfigError
from rig.workspace import Workspace


def recorded_config(about: Mapping[str, Any], trace: str) -> BenchConfig:
    """Return the configuration that a trace was recorded with.

    Parameters
    ----------
    about : mapping
        The trace's first line.
    trace : str
        Names it in messages.

    Raises
    ------
    ConfigError
        It holds none, or one that cannot be used here.
    """
    text = about.get("config")
    if not isinstance(text, str):
        raise ConfigError(f"trace {trace}, line 1: holds no configuration to make a rig.toml of")
    return parse_config(text, f"trace {trace}, config")


def served_toml(config: BenchConfig, url: Callable[[str], str], speed: float | None = None) -> str:
    """Return `config` as a served simulation whose ports are at `url` of what they were, and whose `speed` may be another.

    No port of `config` is left in it: nothing that works with it can reach a real instrument.
    """
    document = tomllib.loads(config.text)
    document["simulation"] = {key: value for key, value in document.get("simulation", {}).items() if key != "seed"} | {"served": True}
    if speed is not None:
        document["simulation"]["speed"] = speed
    for table in (*document["axes"].values(), document["sensor"], *document.get("sensors", {}).values()):
        table["port"] = url(table["port"])
    return "# Instruments that are served already.\n" + "".join(_tables("", document))


def write_bench(path: Path, config: BenchConfig, about: Mapping[str, Any], url: Callable[[str], str], workspace: Workspace) -> None:
    """Write the rig.toml of a replay, and the records of its axes into the workspace.

    Raises
    ------
    ConfigError
        The file cannot be written, or the trace holds no records of axes where they should be.
    RunError
        The workspace cannot be written, or holds something else in their place.
    """
    text = served_toml(config, url)
    replayed = parse_config(text, str(path))
    known = about.get("records", {})
    try:
        records = {axis.identity: AxisRecord(**known[axis.identity]) for axis in config.axes.values() if axis.identity in known}
    except TypeError as exc:
        raise ConfigError(f"the trace's records of the axes are not what they should be: {exc}") from exc
    kept = AxisRecords(workspace.axes)
    for name, axis in config.axes.items():
        record = records.get(axis.identity)
        if record is not None:
            kept.put(
                replayed.axes[name].identity,
                setpoint=record.setpoint,
                readback=record.readback,
                under_way=record.under_way,
                homed=record.homed,
            )
    write_toml(path, text)


def write_toml(path: Path, text: str) -> None:
    """Write a rig.toml; raise ConfigError where that is not possible."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as exc:
        raise ConfigError(f"--toml {path}: cannot be written: {exc.strerror or exc}") from exc


def _tables(name: str, table: Mapping[str, Any]) -> list[str]:
    """Return the lines of a TOML table: its own keys first, then the tables in it."""
    own = [f"{_key(key)} = {_value(value)}\n" for key, value in table.items() if not isinstance(value, dict)]
    head = [f"\n[{name}]\n"] if name and (own or not table) else []
    inner = ((f"{name}.{_key(key)}".lstrip("."), value) for key, value in table.items() if isinstance(value, dict))
    return [*head, *own, *(line for key, value in inner for line in _tables(key, value))]


def _key(key: str) -> str:
    return key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else _text(key)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    match value:
        case str():
            return _text(value)
        case bool():
            return str(value).lower()
        case list():
            return f"[{', '.join(map(_value, value))}]"
        case dict():
            return "{" + ", ".join(f"{_key(key)} = {_value(each)}" for key, each in value.items()) + "}"
        case _:  # numbers and times, as Python writes them
            return str(value)
