"""`rig.toml`: what the bench is made of, checked before anything is opened."""

import hashlib
import importlib.resources
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.errors import ConfigError
from rig.interlock import Interlock, KeepOut
from rig.kinematics import AxisMap

if TYPE_CHECKING:
    from drivers.catalogue import Catalogue
    from drivers.kinds import Unit
    from drivers.models import DeviceModel

SIMULATED_PORT = "sim:"
"""A port that starts so is an instrument of the simulated bench, by name."""

ANGLES = {"source": "theta_i", "detector": "theta_r"}
"""The arms, which every bench has, and the angles they realise. An axis of another name is known by that name."""

INTEGRATION_S = 0.1
"""Of a light sensor whose model says nothing of it."""

MAIN_SENSOR = "sensor"
"""What a sweep reads; it has a table of its own, the others are under [sensors]."""


@dataclass(frozen=True)
class AxisConfig:
    """One axis: which stage, where it hangs, how its angle counts, where it may go (degrees, or mm of a linear one; seconds).

    `identity` says which stage it is, whatever it is called: port, model and what tells it from the others there.
    """

    name: str
    model: str
    port: str
    identity: str
    unit: "Unit"
    map: AxisMap
    limits: tuple[float, float]
    speed: float | None
    acceleration: float | None
    settle_s: float
    tolerance: float
    options: Mapping[str, Any]
    serial: Mapping[str, Any]


@dataclass(frozen=True)
class SensorConfig:
    """A sensor: which one, where it hangs, how long it looks (seconds), its full scale (its unit; None: it chooses).

    A range finder has neither of the last two. A `monitor` is read along with every point of a sweep.
    """

    name: str
    model: str
    port: str
    integration_s: float | None
    range: float | None
    monitor: bool
    options: Mapping[str, Any]
    serial: Mapping[str, Any]


@dataclass(frozen=True)
class Simulation:
    """How the simulated bench runs: times faster than time, and its seed (None: a fresh one each time).

    Where it is `served` it runs already (`rig sim serve`), and ports are its addresses.
    """

    speed: float
    seed: int | None
    served: bool = False


@dataclass(frozen=True)
class BenchConfig:
    """All of `rig.toml`."""

    name: str
    axes: Mapping[str, AxisConfig]
    sensors: Mapping[str, SensorConfig]
    keep_out: KeepOut
    simulation: Simulation | None
    text: str = field(repr=False)
    source: str

    @property
    def simulated(self) -> bool:
        """True where the instruments are simulated."""
        return self.simulation is not None

    @property
    def sensor(self) -> SensorConfig:
        """The light sensor that a sweep reads."""
        return self.sensors[MAIN_SENSOR]

    @property
    def sweep_sensors(self) -> tuple[str, ...]:
        """Names of the sensors that a sweep reads: the main one and the monitors."""
        return tuple(name for name, sensor in self.sensors.items() if sensor.monitor or name == MAIN_SENSOR)

    @property
    def devices(self) -> dict[str, AxisConfig | SensorConfig]:
        """All instruments, by name."""
        return {**self.axes, **self.sensors}

    @property
    def interlock(self) -> Interlock:
        """Limits and keep-out."""
        limits = {name: axis.limits for name, axis in self.axes.items()}
        return Interlock(limits, self.keep_out, units={name: axis.unit for name, axis in self.axes.items()})

    @property
    def sha256(self) -> str:
        """Identity of the configuration."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def template() -> str:
    """Return the commented `rig.toml` that `rig init` writes."""
    return importlib.resources.files("rig").joinpath("data/rig.toml").read_text(encoding="utf-8")


def simulated_config() -> BenchConfig:
    """Return the configuration of the simulated bench."""
    text = importlib.resources.files("rig").joinpath("data/simulated.toml").read_text(encoding="utf-8")
    return parse_config(text, "simulated.toml")


def load_config(option: str | None) -> BenchConfig:
    """Return the configuration of `--config`, else of `./rig.toml`, else of the simulated bench.

    Raises
    ------
    ConfigError
        One line that names the file, the key and what it may be.
    """
    path = Path(option) if option else Path("rig.toml")
    if option is None and not path.exists():
        return simulated_config()
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise ConfigError(f"{path}: cannot be read: {exc}; `rig init` writes one to start from") from exc
    return parse_config(text, str(path))


def parse_config(text: str, source: str) -> BenchConfig:
    """Return the configuration that `text` (TOML) gives; `source` names it in messages.

    Raises
    ------
    ConfigError
        One line that names the source, the key and what it may be.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as exc:
        raise ConfigError(f"{source}: not TOML: {exc}") from exc
    from drivers import catalogue

    models = catalogue.load()
    top = _Table(document, source, "")
    bench = top.table("bench", required=False)
    name = bench.text("name", default="bench")
    bench.done()
    simulation = _simulation(top.table("simulation")) if "simulation" in document else None
    axes = top.table("axes")
    axis_configs = {axis: _axis(axis, axes.table(axis), models) for axis in (*ANGLES, *axes.names(but=ANGLES))}
    sensors = {MAIN_SENSOR: _sensor(MAIN_SENSOR, top.table("sensor"), models)}
    others = top.table("sensors", required=False)
    for sensor in others.names():
        if sensor in (MAIN_SENSOR, *axis_configs):
            raise others.error(sensor, "this name is taken")
        sensors[sensor] = _sensor(sensor, others.table(sensor), models)
    config = BenchConfig(
        name=name,
        axes=axis_configs,
        sensors=sensors,
        keep_out=_keep_out(top.table("keep_out")),
        simulation=simulation,
        text=text,
        source=source,
    )
    top.done()
    _check_ports(config, models)
    return config


def _axis(name: str, table: "_Table", models: "Catalogue") -> AxisConfig:
    kinds = ("rotary-axis",) if name in ANGLES else ("rotary-axis", "linear-axis")
    model, options, serial = _device(table, models, kinds, frozenset({"speed", "acceleration"}))
    unit: Unit = "mm" if model.kind == "linear-axis" else "deg"
    low, high = table.pair("limits", unit)
    if low >= high:
        raise table.error("limits", f"[{low:g}, {high:g}] are swapped: give [lowest, highest] in {unit}")
    sign = table.number("sign", default=1)
    if sign not in (1, -1):
        raise table.error("sign", f"{sign:g} may be 1 or -1")
    config = AxisConfig(
        name=name,
        model=model.name,
        port=table.text("port"),
        identity=" ".join([table.text("port"), model.name, *(f"{key}={value}" for key, value in _place(model, options).items())]),
        unit=unit,
        map=AxisMap(int(sign), table.number("offset", default=0.0)),
        limits=(low, high),
        speed=table.positive("speed", default=None),
        acceleration=table.positive("acceleration", default=None),
        settle_s=table.number("settle", default=0.1, low=0.0),
        tolerance=table.positive("tolerance", default=0.02) or 0.02,
        options=options,
        serial=serial,
    )
    table.done()
    return config


def _sensor(name: str, table: "_Table", models: "Catalogue") -> SensorConfig:
    main = name == MAIN_SENSOR
    kinds = ("light-sensor",) if main else ("light-sensor", "range-finder")
    model, options, serial = _device(table, models, kinds, frozenset({"integration_s", "range"}))
    light = model.kind == "light-sensor"
    told = model.options.get("integration_s")
    config = SensorConfig(
        name=name,
        model=model.name,
        port=table.text("port"),
        integration_s=table.positive("integration", default=told.default if told else INTEGRATION_S) if light else None,
        range=table.positive("range", default=None) if light else None,
        monitor=light and not main and table.flag("monitor", default=False),
        options=options,
        serial=serial,
    )
    table.done()
    return config


def _keep_out(table: "_Table") -> KeepOut:
    within = table.number("within", low=0.0, high=90.0)
    zone = KeepOut(within, table.flag("crossing"), table.number("shadow", default=within, low=0.0, high=90.0))
    table.done()
    return zone


def _simulation(table: "_Table") -> Simulation:
    speed = table.positive("speed", default=1.0)
    assert speed is not None
    seed = table.number("seed", default=None, low=0)
    simulation = Simulation(speed, None if seed is None else int(seed), table.flag("served", default=False))
    table.done()
    return simulation


def _device(
    table: "_Table", models: "Catalogue", kinds: tuple[str, ...], owned: frozenset[str]
) -> tuple["DeviceModel", dict[str, Any], dict[str, Any]]:
    """Return the model, its own options and the line settings that `table` gives; `owned` options have keys of ours."""
    from drivers.errors import InvalidSetting

    known = sorted(name for name, model in models.models.items() if model.kind in kinds)
    name = table.text("model")
    if name not in known:
        problems = "".join(f"; {problem}" for problem in models.problems)
        raise table.error("model", f"unknown model {name!r}; a {' or '.join(kinds)} may be {', '.join(known)}{problems}")
    model = models.models[name]
    options: dict[str, Any] = {}
    for key, option in model.options.items():
        if key in owned or not table.offers(key):
            continue
        try:
            options[key] = option.check(table.value(key))
        except InvalidSetting as exc:
            raise table.error(key, f"{exc.problem} must be {exc.expected}") from exc
    line: dict[str, Any] = {}
    for key, default in model.line.items():
        if table.offers(key):
            line[key] = table.value(key)
            if type(line[key]) is not type(default):
                raise table.error(key, f"{line[key]!r} must be like {default!r}, the setting as delivered")
    return model, options, line


def _check_ports(config: BenchConfig, models: "Catalogue") -> None:
    keys = {**{name: f"axes.{name}" for name in config.axes}, **{name: f"sensors.{name}" for name in config.sensors}, MAIN_SENSOR: "sensor"}
    simulation = config.simulation
    started = simulation is not None and not simulation.served
    for name, device in config.devices.items():
        if device.port.startswith(SIMULATED_PORT) is not started:
            if started:
                what = f"{SIMULATED_PORT}NAME, since [simulation] is there"
            else:
                what = f"a port; only a [simulation] that is not served has {SIMULATED_PORT} ports"
            raise ConfigError(f"{config.source}: {keys[name]}.port: {device.port!r} must be {what}")
    for first, second in combinations(config.devices.values(), 2):
        if first.port == second.port:
            _check_neighbours(f"{config.source}: {keys[second.name]}", keys[first.name], second, first, models)


def _check_neighbours(
    where: str, first: str, device: AxisConfig | SensorConfig, other: AxisConfig | SensorConfig, models: "Catalogue"
) -> None:
    """Raise ConfigError where two devices cannot share the port they name."""
    one, two = (models.lookup(each.model) for each in (other, device))
    if one.open_port != two.open_port or {**one.line, **other.serial} != {**two.line, **device.serial}:
        raise ConfigError(f"{where}.port: {device.port!r} is the port of {first}, whose line settings or protocol are others")
    if _place(one, other.options) == _place(two, device.options):
        key = "address" if "address" in two.options else "axis"
        raise ConfigError(f"{where}.{key}: the same instrument as {first}; give each its own address, axis or port")


def _place(model: "DeviceModel", options: Mapping[str, Any]) -> dict[str, Any]:
    """Return what tells a device from the others on its port."""
    return {key: options.get(key, model.options[key].default) for key in ("address", "axis") if key in model.options}


class _Table:
    """A TOML table that knows where it stands and which of its keys were asked for."""

    def __init__(self, values: Mapping[str, Any], source: str, path: str) -> None:
        self._values = values
        self._source = source
        self._path = path
        self._asked: set[str] = set()

    def error(self, key: str, what: str) -> ConfigError:
        return ConfigError(f"{self._source}: {self._path}{key}: {what}")

    def table(self, key: str, *, required: bool = True) -> "_Table":
        self._asked.add(key)
        value = self._values.get(key, None if required else {})
        if not isinstance(value, dict):
            raise self.error(key, "missing: expected a table" if value is None else f"expected a table [{self._path}{key}]")
        return _Table(value, self._source, f"{self._path}{key}.")

    def _get(self, key: str, default: Any, expected: str) -> Any:
        self._asked.add(key)
        if key in self._values:
            return self._values[key]
        if default is _REQUIRED:
            raise self.error(key, f"missing: expected {expected}")
        return default

    def text(self, key: str, *, default: Any = None) -> str:
        value = self._get(key, _REQUIRED if default is None else default, "text in quotes")
        if not isinstance(value, str) or not value:
            raise self.error(key, f"{value!r} must be text in quotes")
        return value

    def number(self, key: str, *, default: Any = ..., low: float = -float("inf"), high: float = float("inf")) -> Any:
        value = self._get(key, _REQUIRED if default is ... else default, "a number")
        if value is None and key not in self._values:
            return None
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not low <= value <= high
            or value in (float("inf"), -float("inf"))
        ):
            bounds = f" from {low:g} to {high:g}" if high < float("inf") else f" not below {low:g}" if low > -float("inf") else ""
            raise self.error(key, f"{value!r} must be a number{bounds}")
        return value

    def positive(self, key: str, *, default: float | None) -> float | None:
        value = self.number(key, default=default)
        if value is not None and value <= 0:
            raise self.error(key, f"{value!r} must be a number above 0")
        return None if value is None else float(value)

    def flag(self, key: str, *, default: bool | None = None) -> bool:
        value = self._get(key, _REQUIRED if default is None else default, "true or false")
        if not isinstance(value, bool):
            raise self.error(key, f"{value!r} may be true or false")
        return value

    def pair(self, key: str, unit: str) -> tuple[float, float]:
        value = self._get(key, _REQUIRED, "[lowest, highest]")
        most = 360 if unit == "deg" else 10_000
        if not isinstance(value, list) or len(value) != 2 or not all(type(v) in (int, float) and abs(v) <= most for v in value):
            raise self.error(key, f"{value!r} must be [lowest, highest] in {unit}, within {most:g}")
        return float(value[0]), float(value[1])

    def names(self, *, but: Iterable[str] = ()) -> list[str]:
        """Return the names of the tables in here, in their order; all that stands here must be one, with a name of small letters."""
        found = [key for key in self._values if key not in but]
        for key in found:
            if not re.fullmatch(r"[a-z][a-z0-9_]*", key):
                raise self.error(key, "a name is made of small letters, digits and _")
        return found

    def offers(self, key: str) -> bool:
        """Take note that `key` may stand here, and tell whether it does."""
        self._asked.add(key)
        return key in self._values

    def value(self, key: str) -> Any:
        return self._values[key]

    def done(self) -> None:
        unknown = sorted(set(self._values) - self._asked)
        if unknown:
            raise self.error(unknown[0], f"unknown key; here may stand {', '.join(sorted(self._asked))}")


_REQUIRED = object()
