"""What the catalogue says of a model of instrument: its name, its settings, and how to open one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, Literal

from drivers.errors import InvalidSetting
from drivers.incidents import Report
from drivers.kinds import LightSensor, RangeFinder, Stage
from drivers.link import TERMINATORS, Link, Traffic

Device = Stage | LightSensor | RangeFinder
Kind = Literal["rotary-axis", "linear-axis", "light-sensor", "range-finder"]


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


@dataclass(frozen=True)
class DeviceModel:
    """A model of instrument and how to open one.

    Attributes
    ----------
    name : str
        What users write in their configuration.
    kind : str
        ``rotary-axis``, ``linear-axis``, ``light-sensor`` or ``range-finder``.
    vendor, description, protocol : str
        For people.
    connect : callable
        ``connect(link, name, **options)`` gives the device.
    line : mapping
        Line settings as delivered: pyserial's ``baudrate``, ``bytesize``, ``parity``, ``stopbits``, ``xonxoff``, ``rtscts``, and
        ``terminator`` (``CR``, ``LF``, ``CRLF`` or ``LFCR``).
    options : mapping of str to Option
        Keyword arguments of `connect`.
    open_port : callable
        Called as `Link.open` is; other than that for what is not made of lines: Modbus, a stream, a folder.
    halt : callable, optional
        ``halt(link, name, **options)`` stops a stage and asks it nothing first: neither who nor how it is. So it can be told while it
        moves, and after the program that moved it is gone. It is sent once more when unacknowledged. Without it, see `halt_device`.
    reads_at_once : bool
        Whether a reading comes without somebody's doing; not so where a picture must be taken.
    """

    name: str
    kind: Kind
    vendor: str
    description: str
    protocol: str
    connect: Callable[..., Device]
    line: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Option] = field(default_factory=dict)
    open_port: Callable[..., Link] = Link.open
    halt: Callable[..., None] | None = None
    reads_at_once: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "line", MappingProxyType(dict(self.line)))
        object.__setattr__(self, "options", MappingProxyType(dict(self.options)))

    def open_link(
        self, url: str, *, timeout_s: float = 1.0, traffic: Traffic | None = None, report: Report | None = None, **line: Any
    ) -> Link:
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
        if "terminator" in settings:
            name = settings["terminator"]
            if name not in TERMINATORS:
                raise InvalidSetting(f"terminator {name!r}", device=self.name, port=url, expected=", ".join(TERMINATORS))
            settings["terminator"] = TERMINATORS[name]
        return self.open_port(url, device=self.name, timeout_s=timeout_s, traffic=traffic, report=report, **settings)

    def open_device(self, link: Link, *, name: str, **options: Any) -> Device:
        """Open a device on a link, which may carry others and stays the caller's to close. Nothing is set in a stage, it may be moving.

        Raises
        ------
        InvalidSetting
            The model has no such option, or it cannot have that value.
        DeviceError
            The device does not answer as it should.
        """
        return self.connect(link, name, **self._checked(link, name, options))

    def halt_device(self, link: Link, *, name: str, **options: Any) -> None:
        """Stop a stage that nobody needs to have opened: by `halt`, or where the model has none by opening it first.

        Raises
        ------
        InvalidSetting
            The model has no such option, or it cannot have that value; or it is not a stage.
        DeviceError
            The stage has not acknowledged; it may still be moving.
        """
        if not self.kind.endswith("-axis"):
            raise InvalidSetting(f"a {self.kind} cannot be stopped", device=name, port=link.url, expected="a stage")
        values = self._checked(link, name, options)
        if self.halt is not None:
            self.halt(link, name, **values)
            return
        device = self.connect(link, name, **values)
        assert isinstance(device, Stage)
        device.stop()

    def _checked(self, link: Link, name: str, options: Mapping[str, Any]) -> dict[str, Any]:
        """All options, those not given at their defaults."""
        self._refuse_unknown(options, self.options, "option")
        values = {}
        for key, option in self.options.items():
            try:
                values[key] = option.check(options.get(key, option.default))
            except InvalidSetting as error:
                error.complete(device=name, port=link.url, attempt=f"option {key} of {self.name}")
                raise
        return values

    def _refuse_unknown(self, given: Mapping[str, Any], known: Mapping[str, Any], what: str) -> None:
        for key in given:
            if key not in known:
                choices = ", ".join(known) or "none"
                raise InvalidSetting(f"no {what} {key!r}", device=self.name, expected=f"any of {choices}", hint=did_you_mean(key, known))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a question that names what is spelt most like `name`, or nothing."""
    near = get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else ""
