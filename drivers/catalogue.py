"""Catalogue of instrument models: name, settings, and how to open one.

Other packages add models through the entry-point group `GROUP`; an entry point loads to a `DeviceModel` or an iterable of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, Literal

from drivers.errors import CatalogueError, InvalidSetting, UnknownModel
from drivers.kinds import LightSensor, RotaryAxis
from drivers.link import TERMINATORS, Link, Traffic

GROUP = "rig.devices"


@dataclass(frozen=True)
class Option:
    """A choice the user has when opening a device.

    Attributes
    ----------
    type : type
        ``bool``, ``int``, ``float`` or ``str``; an int will do for a float.
    default
        Of that type, or None to leave it to the driver.
    description : str
        One line, with the unit.
    """

    type: type
    default: Any
    description: str

    def check(self, value: Any) -> Any:
        """Return the value as the option's type.

        Raises
        ------
        InvalidSetting
            The value has another type, or is not finite.
        """
        if value is None and self.default is None:
            return None
        if self.type is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not self.type or (isinstance(value, float) and not math.isfinite(value)):
            kind = "finite float" if self.type is float else self.type.__name__
            raise InvalidSetting(f"{value!r}", expected=f"{kind}: {self.description}")
        return value


Device = RotaryAxis | LightSensor


@dataclass(frozen=True)
class DeviceModel:
    """A model of instrument and how to open one.

    Attributes
    ----------
    name : str
        What users write in their configuration.
    kind : str
        ``rotary-axis`` or ``light-sensor``.
    vendor, description, protocol : str
        For people.
    connect : callable
        ``connect(link, name, **options)`` gives the device.
    line : mapping
        Line settings as delivered: pyserial's ``baudrate``, ``bytesize``, ``parity``, ``stopbits``, ``xonxoff``, ``rtscts``, and
        ``terminator`` (``CR``, ``LF``, ``CRLF`` or ``LFCR``).
    options : mapping of str to Option
        Keyword arguments of `connect`.
    """

    name: str
    kind: Literal["rotary-axis", "light-sensor"]
    vendor: str
    description: str
    protocol: str
    connect: Callable[..., Device]
    line: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Option] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "line", MappingProxyType(dict(self.line)))
        object.__setattr__(self, "options", MappingProxyType(dict(self.options)))

    def open_link(self, url: str, *, timeout_s: float = 1.0, traffic: Traffic | None = None, **line: Any) -> Link:
        """Open the port with this model's line settings, each of which can be overridden.

        Raises
        ------
        TransportTimeout
            The port is absent or busy.
        InvalidSetting
            The model has no such line setting, or it cannot have that value.
        """
        self._refuse_unknown(line, self.line, "line setting")
        settings = {**self.line, **line}
        terminator = settings.pop("terminator", "CRLF")
        if terminator not in TERMINATORS:
            raise InvalidSetting(f"terminator {terminator!r}", device=self.name, port=url, expected=", ".join(TERMINATORS))
        return Link.open(url, device=self.name, timeout_s=timeout_s, terminator=TERMINATORS[terminator], traffic=traffic, **settings)

    def open_device(self, link: Link, *, name: str, **options: Any) -> Device:
        """Open a device on a link, which may carry others and stays the caller's to close.

        Raises
        ------
        InvalidSetting
            The model has no such option, or it cannot have that value.
        DeviceError
            The device does not answer as it should.
        """
        self._refuse_unknown(options, self.options, "option")
        values = {}
        for key, option in self.options.items():
            try:
                values[key] = option.check(options.get(key, option.default))
            except InvalidSetting as error:
                error.complete(device=name, port=link.url, attempt=f"option {key} of {self.name}")
                raise
        return self.connect(link, name, **values)

    def _refuse_unknown(self, given: Mapping[str, Any], known: Mapping[str, Any], what: str) -> None:
        for key in given:
            if key not in known:
                choices = ", ".join(known) or "none"
                raise InvalidSetting(f"no {what} {key!r}", device=self.name, expected=f"any of {choices}", hint=_did_you_mean(key, known))


@dataclass(frozen=True)
class Catalogue:
    """All models found, and what was wrong with those that could not be taken."""

    models: Mapping[str, DeviceModel]
    problems: tuple[CatalogueError, ...] = ()

    def lookup(self, name: str) -> DeviceModel:
        """Find a model by name.

        Raises
        ------
        UnknownModel
            There is none; the message lists those there are, and the entry points that failed.
        """
        if name in self.models:
            return self.models[name]
        hints = [_did_you_mean(name, self.models), *map(str, self.problems)]
        known = ", ".join(sorted(self.models))
        raise UnknownModel(f"unknown model {name!r}", expected=f"any of {known}", hint="; ".join(filter(None, hints)))


def load() -> Catalogue:
    """Collect the built-in models and those of installed packages.

    A package cannot take a built-in model's name. When two packages use the same name, neither has it. Either is a problem
    in the catalogue and harms no other model.
    """
    models = {model.name: model for model in BUILT_IN}
    origins = dict.fromkeys(models, "the built-in models")
    contested: set[str] = set()
    problems: list[CatalogueError] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)):
        origin = _origin(entry)
        try:
            added = _load_entry(entry)
        except Exception as error:  # whatever a stranger's import raises
            problems.append(CatalogueError(f"{origin} is broken: {type(error).__name__}: {error}", hint="mend or uninstall the package"))
            continue
        for model in added:
            if models.get(model.name) is model:
                continue
            if model.name in origins:
                clash = f"{origin} and {origins[model.name]} both name a model {model.name!r}"
                problems.append(CatalogueError(clash, hint="uninstall one of the packages"))
                contested.add(model.name)
                continue
            models[model.name] = model
            origins[model.name] = origin
    built_in = {model.name for model in BUILT_IN}
    usable = {name: model for name, model in models.items() if name in built_in or name not in contested}
    return Catalogue(MappingProxyType(usable), tuple(problems))


def lookup(name: str) -> DeviceModel:
    """Find a model by name among all there are; see `Catalogue.lookup`."""
    return load().lookup(name)


def _load_entry(entry: EntryPoint) -> list[DeviceModel]:
    loaded = entry.load()
    added = [loaded] if isinstance(loaded, DeviceModel) else list(loaded) if isinstance(loaded, Iterable) else [loaded]
    for model in added:
        if not isinstance(model, DeviceModel):
            raise TypeError(f"it holds a {type(model).__name__}, not a DeviceModel")
    return added


def _origin(entry: EntryPoint) -> str:
    package = f" of {entry.dist.name}" if entry.dist is not None else ""
    return f"entry point {entry.name} = {entry.value}{package}"


def _did_you_mean(name: str, known: Iterable[str]) -> str:
    near = get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else ""


def _connect_zaber(link: Link, name: str, **options: Any) -> RotaryAxis:
    from drivers.stages.zaber import ZaberAxis

    return ZaberAxis.open(link, name, **{key: value for key, value in options.items() if value is not None})


def _connect_keithley(link: Link, name: str, *, overflow_bit: int, zero_check_bit: int, **options: Any) -> LightSensor:
    from drivers.sensors.keithley6485 import Keithley6485, StatusBits

    return Keithley6485.open(link, name, status_bits=StatusBits(overflow=overflow_bit, zero_check=zero_check_bit), **options)


_ZABER_OPTIONS = {
    "address": Option(int, 1, "device address on the chain"),
    "axis": Option(int, 1, "axis of the device"),
    "microsteps_per_degree": Option(float, None, "scale; read from the stage when not given"),
    "speed_deg_s": Option(float, None, "speed in deg/s; the stage's own setting when not given"),
    "acceleration_deg_s2": Option(float, None, "acceleration in deg/s^2; the stage's own setting when not given"),
    "acceleration_unit": Option(float, None, "microsteps/s^2 in one unit of accel; default 10000/1.6384, not verified"),
    "checksums": Option(bool, True, "send checksums and insist on them in replies"),
}


def _zaber(name: str, description: str) -> DeviceModel:
    return DeviceModel(
        name=name,
        kind="rotary-axis",
        vendor="Zaber",
        description=description,
        protocol="Zaber ASCII",
        connect=_connect_zaber,
        line={"baudrate": 115200, "bytesize": 8, "parity": "N", "stopbits": 1, "terminator": "CRLF"},
        options=_ZABER_OPTIONS,
    )


BUILT_IN: tuple[DeviceModel, ...] = (
    _zaber("zaber-x-rsw60a", "motorised rotary stage, 60 mm"),
    # Only its existence is known: its step size is read from the stage like the other's.
    _zaber("zaber-x-rst120ak", "motorised rotary stage, 120 mm"),
    DeviceModel(
        name="keithley-6485",
        kind="light-sensor",
        vendor="Keithley",
        description="picoammeter reading a photodiode, 2 nA to 20 mA",
        protocol="SCPI over RS-232",
        connect=_connect_keithley,
        # Baud rate and terminator are set in the meter's menu; as delivered not verified.
        line={"baudrate": 9600, "bytesize": 8, "parity": "N", "stopbits": 1, "xonxoff": False, "terminator": "CR"},
        options={
            "integration_s": Option(float, 0.1, "integration time in s, up to 1"),
            "range": Option(float, None, "full scale in A; automatic when not given"),
            "line_frequency_hz": Option(int, 50, "mains frequency, 50 or 60 Hz"),
            "overflow_bit": Option(int, 0, "status bit that means overflow, -1 to ignore; not verified"),
            "zero_check_bit": Option(int, 9, "status bit that means zero check on, -1 to ignore; not verified"),
        },
    ),
)
