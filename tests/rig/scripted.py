"""Stages and sensors that do as they were told beforehand, and a catalogue and a rig.toml for them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import pytest

from drivers import catalogue
from drivers.errors import DeviceFault, NotHomed, TransportTimeout
from drivers.kinds import AxisState, Identity, LightReading, MotionProfile, Unit
from drivers.models import DeviceModel
from rig.config import BenchConfig, parse_config

Start = Callable[["ScriptedStage", float | None], None]


def rest(position: float) -> AxisState:
    """A homed axis at rest."""
    return AxisState(position, moving=False, homed=True)


def moves(position: float, *, waiting: bool = False) -> AxisState:
    """A homed axis on its way."""
    return AxisState(position, moving=True, homed=True, waiting=waiting)


def goes(stage: ScriptedStage, goal: float | None) -> None:
    """The command is taken and answered."""
    aim = 0.0 if goal is None else goal
    here = stage.sight[-1].position
    stage.see(moves(here + 0.3 * (aim - here)), moves(here + 0.6 * (aim - here)), rest(aim))


def goes_and_the_answer_is_lost(stage: ScriptedStage, goal: float | None) -> None:
    """The command is taken, and nothing comes back."""
    goes(stage, goal)
    raise TransportTimeout("no reply", device=stage.name, attempt="starting")


def is_lost(stage: ScriptedStage, goal: float | None) -> None:
    """The command never arrives."""
    raise TransportTimeout("no reply", device=stage.name, attempt="starting")


@dataclass
class ScriptedStage:
    """A stage whose looks and answers are written down beforehand; it notes what it was told.

    Attributes
    ----------
    sight : deque of AxisState
        What the next looks will see; the last one stays.
    starts : list of callable
        What the next starts do; `goes` once there are none left.
    told : list of tuple
        Every start ('move', goal) or ('home', None) and every ('stop', None), in order.
    on_look, on_stop : callable, optional
        Called at each look, and at each stop.
    settings, closings : int
        How often it was set, and closed.
    """

    name: str = "fake"
    unit: Unit = "deg"
    sight: deque[AxisState] = field(default_factory=lambda: deque([rest(0.0)]))
    starts: list[Start] = field(default_factory=list)
    told: list[tuple[str, float | None]] = field(default_factory=list)
    on_look: Callable[[], None] = lambda: None
    on_stop: Callable[[], None] = lambda: None
    speed: float = 1000.0
    acceleration: float = 1e6
    settings: int = 0
    closings: int = 0

    def see(self, *states: AxisState) -> None:
        """Script the next looks."""
        self.sight = deque(states)

    def identify(self) -> Identity:
        """Say who it is."""
        return Identity("Nobody", "scripted", "1", "0")

    def state(self) -> AxisState:
        """Return the next of what is written down."""
        self.on_look()
        return self.sight.popleft() if len(self.sight) > 1 else self.sight[0]

    def limits(self) -> tuple[float, float]:
        """A full turn."""
        return -360.0, 360.0

    def profile(self) -> MotionProfile:
        """A quick one."""
        return MotionProfile(self.speed, self.acceleration)

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None:
        """Stay as quick as it is."""
        self.settings += 1

    def start_home(self) -> None:
        """Do what the next start does."""
        self._start("home", None)

    def start_move(self, position: float, /) -> None:
        """Do what the next start does; without a reference, refuse."""
        if not self.sight[0].homed:
            raise NotHomed("no reference", device=self.name)
        self._start("move", position)

    def _start(self, what: str, goal: float | None) -> None:
        self.told.append((what, goal))
        (self.starts.pop(0) if self.starts else goes)(self, goal)

    def stop(self) -> None:
        """Come to rest where it was last seen."""
        self.told.append(("stop", None))
        self.on_stop()
        self.see(rest(self.sight[0].position))

    def check_arrival(self, position: float, tolerance: float, /) -> None:
        """Deny what is not so."""
        if self.sight[0].moving or abs(self.sight[0].position - position) > tolerance:
            raise DeviceFault(f"rests at {self.sight[0].position}", device=self.name)

    def close(self) -> None:
        """Nothing to let go of."""
        self.closings += 1

    @property
    def motions(self) -> list[tuple[str, float | None]]:
        """What it was told but stops."""
        return [each for each in self.told if each[0] != "stop"]


@dataclass
class ScriptedEye:
    """A light sensor that always sees the same."""

    name: str = "eye"
    unit: str = "lx"
    integration_s: float = 0.1

    def identify(self) -> Identity:
        """Say who it is."""
        return Identity("Nobody", "eye", "1", "0")

    def configure(self, integration_s: float, range: float | None = None) -> None:
        """Take any."""
        self.integration_s = integration_s

    def read(self) -> LightReading:
        """See."""
        return LightReading(1.0, "lx", 0, over_range=False)

    def close(self) -> None:
        """Nothing to let go of."""


SCRIPTED = """\
[axes.source]
model = "scripted-stage"
port = "one"
limits = [0.0, 80.0]
settle = 0.0

[axes.detector]
model = "scripted-stage"
port = "two"
limits = [-85.0, 85.0]
settle = 0.0

[axes.tilt]
model = "scripted-stage"
port = "three"
limits = [-10.0, 10.0]
settle = 0.0

[sensor]
model = "scripted-eye"
port = "four"

[sensors.lamp]
model = "scripted-eye"
port = "five"
monitor = true

[sensors.other]
model = "scripted-eye"
port = "six"

[keep_out]
within = 3.0
crossing = true
"""


class _Port:
    """A port with nothing behind it."""

    def __init__(self, url: str, opened: list[str], closed: list[str]) -> None:
        self.url = url
        self._closed = closed
        opened.append(url)

    def close(self) -> None:
        """Note it."""
        self._closed.append(self.url)


@dataclass(frozen=True)
class ScriptedBench:
    """A bench of scripted instruments.

    Attributes
    ----------
    stages : dict
        By the axis they are.
    opened, closed, connected : list of str
        Ports opened and closed, and names of instruments connected, in order.
    """

    config: BenchConfig
    stages: dict[str, ScriptedStage]
    opened: list[str] = field(default_factory=list)
    closed: list[str] = field(default_factory=list)
    connected: list[str] = field(default_factory=list)


def scripted_bench(monkeypatch: pytest.MonkeyPatch, text: str = SCRIPTED) -> ScriptedBench:
    """Put scripted instruments into the catalogue, and return the bench that `text` makes of them; the arms stand apart."""
    stages = {name: ScriptedStage(name) for name in ("source", "detector", "tilt")}
    stages["source"].see(rest(45.0))
    opened: list[str] = []
    closed: list[str] = []
    connected: list[str] = []

    def stage(link: Any, name: str) -> ScriptedStage:
        connected.append(name)
        return stages[name]

    def eye(link: Any, name: str) -> ScriptedEye:
        connected.append(name)
        return ScriptedEye(name)

    def port(url: str, **settings: Any) -> Any:
        return _Port(url, opened, closed)

    models: Mapping[str, DeviceModel] = MappingProxyType(
        {
            "scripted-stage": DeviceModel("scripted-stage", "rotary-axis", "", "", "", connect=stage, open_port=port),
            "scripted-eye": DeviceModel("scripted-eye", "light-sensor", "", "", "", connect=eye, open_port=port),
        }
    )
    monkeypatch.setattr("drivers.catalogue.load", lambda: catalogue.Catalogue(models))
    return ScriptedBench(parse_config(text, "rig.toml"), stages, opened, closed, connected)
