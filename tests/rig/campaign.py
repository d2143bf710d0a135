"""A campaign of faults: sweeps on benches of mixed make, one fault each, and what must hold whatever it is.

Whether a stored reading is right is judged by the simulated world itself: where the arms truly stand, and what light falls there.
"""

import contextlib
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import rig.ports
from drivers.errors import DeviceError
from rig.config import parse_config
from rig.errors import RigError
from rig.interrupts import Interrupts
from rig.measuring import measure, new_order
from rig.runs import INCIDENTS, begin_run
from rig.trajectory import Trajectory
from rig.workspace import Workspace
from sim.faults import KINDS, Fault, applicable
from sim.serve import Running, Settings, in_background

SPEED = 40.0
LINK_TIMEOUT_S = 0.3
HANG_S = 90.0
POINTS = Trajectory((30.0, 50.0), (-40.0, 10.0))
SLACK_DEG = 0.02
"""Beyond a limit or beside a setpoint, that much counts as there: the tolerance of every axis below."""

STAGES: Mapping[str, str] = {
    "stages": 'model = "zaber-x-rsw60a"\naddress = {number}\nspeed = 60.0\nacceleration = 600.0',
    "newport": 'model = "newport-esp301"\naxis = {number}\nspeed = 20.0\nacceleration = 80.0',
    "shot": 'model = "sigma-koki-shot-302gs"\naxis = {number}\nlow_deg = 0.0\nhigh_deg = 360.0\nspeed = 25.0\nacceleration = 120.0',
    "gsc": 'model = "sigma-koki-gsc-02"\naxis = {number}\nlow_deg = 0.0\nhigh_deg = 360.0\nspeed = 25.0\nacceleration = 120.0',
    "oriental": 'model = "oriental-az"\naddress = {number}\nspeed = 60.0\nacceleration = 600.0',
}
SENSORS: Mapping[str, str] = {
    "meter": 'model = "keithley-6485"\nintegration = 0.1\nterminator = "LF"',
    "ls-100": 'model = "konica-minolta-ls-100"\nintegration = 0.4',
    "cs-100a": 'model = "konica-minolta-cs-100a"\nintegration = 0.4',
}
OPPORTUNITIES = 250
"""Messages on a stage's wire before a fault strikes, at most; homing takes up to a hundred of them."""

MONITOR = 'model = "apogee-sq-422x"\nmonitor = true'
FLOORS = {"meter": 8e-12, "ls-100": 0.1, "cs-100a": 0.1, "apogee": 2.0}
"""Of the truth of a reading, in its unit: dark current and noise, or half of the last digit shown."""
SHARE = 0.01
"""Of the truth of a reading, relative: the lamp drifts and flickers."""


@dataclass(frozen=True)
class Bench:
    """Which instruments a trial's bench is made of."""

    source: str
    detector: str
    sensor: str
    monitored: bool

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Bench":
        """Draw one."""
        source, detector = (str(name) for name in rng.choice(list(STAGES), 2))
        return cls(source, detector, str(rng.choice(list(SENSORS))), bool(rng.random() < 0.3))

    @property
    def arms(self) -> dict[str, tuple[str, int]]:
        """Instrument and axis number of each arm."""
        return {"source": (self.source, 1), "detector": (self.detector, 2)}

    @property
    def instruments(self) -> tuple[str, ...]:
        """All that is served."""
        return tuple(dict.fromkeys([self.source, self.detector, self.sensor, *(["apogee"] if self.monitored else [])]))

    def toml(self, url: Callable[[str], str], speed: float) -> str:
        """Write the rig.toml of this bench; `url` tells where each instrument is."""
        limits, zero = {"source": "[0.0, 80.0]", "detector": "[-85.0, 85.0]"}, {"source": 90.0, "detector": 100.0}
        tables = [f'[bench]\nname = "{self}"', f"[simulation]\nspeed = {speed}\nserved = true", "[keep_out]\nwithin = 3.0\ncrossing = true"]
        for arm, (name, number) in self.arms.items():
            place = f'port = "{url(name)}"\noffset = {zero[arm]}\nlimits = {limits[arm]}\ntolerance = {SLACK_DEG}'
            tables.append(f"[axes.{arm}]\n{STAGES[name].format(number=number)}\n{place}")
        tables.append(f'[sensor]\n{SENSORS[self.sensor]}\nport = "{url(self.sensor)}"')
        if self.monitored:
            tables.append(f'[sensors.apogee]\n{MONITOR}\nport = "{url("apogee")}"')
        return "\n\n".join(tables)

    def __str__(self) -> str:
        return f"{self.source}/{self.detector}/{self.sensor}{'+apogee' if self.monitored else ''}"


@dataclass(frozen=True)
class Outcome:
    """What became of one trial.

    Attributes
    ----------
    ended : str
        ``complete``, or the name of the error it ended with.
    struck : str
        What the fault did; empty where it found no opportunity.
    dealt_with : tuple of str
        What links and axes did about it.
    wrong : tuple of str
        Everything that must not be: readings stored as good that are not true, motion outside the limits, an axis left moving, an error
        without a name, a hang.
    """

    seed: int
    kind: str
    where: str
    bench: str
    ended: str
    message: str
    struck: str
    dealt_with: tuple[str, ...]
    flagged: int
    stored: int
    wrong: tuple[str, ...]
    seconds: float


class Watcher:
    """Holds each stored event against the world at that moment."""

    ask = False

    def __init__(self, running: Running, bench: Bench) -> None:
        self._world = running.world
        self._bench = bench
        self.stored = self.flagged = 0
        self.wrong: list[str] = []

    def opened(self, bench: Any) -> None:
        """Nothing has moved yet."""

    def decide(self, interrupts: Interrupts) -> bool:
        """Nobody is there."""
        return False

    def document(self, name: str, doc: Mapping[str, Any]) -> None:
        """Look at a document that is on the disk."""
        if name != "event":
            return
        data, now = doc["data"], self._world.clock.now()
        self.stored += 1
        true = {arm: self._world.arms[arm].nominal(now) for arm in self._bench.arms}
        for arm, angle in (("source", "theta_i"), ("detector", "theta_r")):
            for key in (angle, f"{angle}_setpoint"):
                if not abs(data[key] - true[arm]) <= SLACK_DEG + 0.005:
                    self.wrong.append(f"{key} {data[key]:.3f} stored while {arm} stood at {true[arm]:.3f}")
        self._judge(data, "current", self._bench.sensor, true)
        if self._bench.monitored:
            self._judge(data, "apogee", "apogee", true)

    def _judge(self, data: Mapping[str, Any], key: str, sensor: str, true: Mapping[str, float]) -> None:
        if not data[f"{key}_good"]:
            self.flagged += 1
            return
        truth = float(self._world.truth(true["source"], true["detector"], sensor))
        if not abs(data[key] - truth) <= FLOORS[sensor] + SHARE * truth:
            self.wrong.append(f"{sensor} {data[key]:.4g} stored as good where {truth:.4g} was true")


class Hang(Exception):
    """A trial did not end."""


@contextlib.contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise Hang in the main thread after so many seconds."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hang(f"not over after {seconds:g} s")

    old = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)


def trial(seed: int, kind: str | None = None) -> Outcome:
    """Sweep a drawn bench while a drawn fault strikes; `kind` None: no fault at all."""
    rng = np.random.default_rng([20261123, seed])
    bench = Bench.drawn(rng)
    arms = {arm: f"{name}:{number}" for arm, (name, number) in bench.arms.items()}
    settings = Settings(seed=seed, speed=SPEED, pty=False, instruments=bench.instruments, **arms)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, in_background(settings) as running:
        where = ""
        if kind is not None:
            able = [name for name in bench.instruments if kind in applicable(running.world.devices[name])]
            if not able:
                return Outcome(seed, kind, "", str(bench), "not applicable", "", "", (), 0, 0, (), 0.0)
            where = str(rng.choice(able))
            running.inject(where, Fault(kind, seed, int(rng.integers(OPPORTUNITIES if where in STAGES else 30))))
        watcher = Watcher(running, bench)
        ended, message, wrong = _swept(running, bench, watcher, Path(folder))
        wrong += watcher.wrong
        struck = running.struck(where) if where else ()
        wrong += _left(running, bench, arms)
        incidents = Path(folder) / "run" / INCIDENTS
        dealt = tuple(line.split('"what": "')[1].split('"')[0] for line in incidents.read_text().splitlines()) if incidents.exists() else ()
    if kind is None and ended != "complete":
        wrong.append(f"ended with {ended} though nothing was wrong: {message}")
    did = str(struck[0]) if struck else ""
    seconds = time.monotonic() - began
    return Outcome(
        seed, kind or "none", where, str(bench), ended, message, did, dealt, watcher.flagged, watcher.stored, tuple(wrong), seconds
    )


def _swept(running: Running, bench: Bench, watcher: Watcher, folder: Path) -> tuple[str, str, list[str]]:
    """Sweep; return how it ended, and what is wrong with that."""
    rig.ports.LINK_TIMEOUT_S = LINK_TIMEOUT_S
    try:
        with limited(HANG_S):
            config = parse_config(bench.toml(running.url, SPEED), "campaign.toml")
            begin_run(folder / "run", config.text)
            measure(new_order(config, "RR", POINTS), folder / "run", watcher, Workspace(folder))
    except (DeviceError, RigError) as exc:
        return type(exc).__name__, str(exc), []
    except Hang as exc:
        return "Hang", str(exc), [f"hang: {exc}"]
    except Exception as exc:  # whatever it is, it has no name of ours
        return type(exc).__name__, str(exc), [f"an error without a name of ours: {exc!r}"]
    return "complete", "", []


def _left(running: Running, bench: Bench, arms: Mapping[str, str]) -> list[str]:
    """Return what is wrong with the motion: outside the limits since the axis was homed, or not at rest soon after the end."""
    world, wrong = running.world, []
    limits = {"source": (0.0, 80.0), "detector": (-85.0, 85.0)}
    deadline = time.monotonic() + 2.0
    while any(arm.moving(world.clock.now()) for arm in world.arms.values()) and time.monotonic() < deadline:
        time.sleep(0.005)
    for name, arm in world.arms.items():
        if arm.moving(world.clock.now()):
            wrong.append(f"{name} still moves at the end")
        low, high = arm.reach
        origin = -{"source": 90.0, "detector": 100.0}[name]
        # Homing leads from wherever it stood to the origin, and from there the first motion into the limits.
        begin = arm.track.nominal(0.0)[0] - arm.zero
        least, most = min(begin, origin, limits[name][0]), max(begin, origin, limits[name][1])
        if low < least - SLACK_DEG or high > most + SLACK_DEG:
            wrong.append(f"{name} was at {low:.2f} to {high:.2f} deg, beyond {least:g} to {most:g}")
    return wrong


def kinds() -> tuple[str, ...]:
    """All kinds of faults."""
    return KINDS
