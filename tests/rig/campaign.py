"""A campaign of faults: sweeps on benches of mixed make and readings along a linear axis, one fault each, some of the sweeps interrupted,
and what must hold whatever it is.

Whether a stored reading is right is judged by the simulated world itself: where the arms truly stand, and what light falls there.
"""

import contextlib
import math
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import rig.ports
from drivers.errors import DeviceError
from rig.bench import Paperwork, open_bench
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

LIMITS: Mapping[str, tuple[float, float]] = {"source": (0.0, 80.0), "detector": (-85.0, 85.0)}
ZEROS: Mapping[str, float] = {"source": 90.0, "detector": 100.0}

INTERRUPT = "interrupt"
"""In place of a fault: Ctrl-C at a drawn moment, and nothing else is wrong."""
INTERRUPTED, BESIDE = 0.25, 0.2
"""Shares of the trials with a fault: sweeps that are interrupted too, and readings along the linear axis instead of a sweep."""
SWEEP_S = 2.0
"""About what a sweep takes, s."""
GRACE_S = 0.1
"""What was on its way to an axis when the signal came may still begin so much later, if a stop follows as soon."""

LINEAR = """\
[axes.x]
model = "zaber-x-lsm"
microsteps_per_mm = 20997.375328083987
limits = [0.0, 150.0]"""
READERS: Mapping[str, str] = {
    "om20": 'model = "baumer-om20"',
    "optoncdt": 'model = "micro-epsilon-ild1420"',
    "camera": 'model = "camera-folder"\ntrigger_command = "touch .shutter"\nsettle_s = 0.02\npatience_s = 20.0',
}
FRONTS = {"om20": 60.0, "optoncdt": 0.0}
"""What the sensor tells with the plate at 0, mm."""
NEAREST_MM, FARTHEST_MM, PLACES = 2.0, 45.0, 4
NOISE_MM = 0.06
CAMERA_SHARE = 0.05
"""By which pictures of the same light may differ: the lamp drifts."""

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
        tables = [f'[bench]\nname = "{self}"', f"[simulation]\nspeed = {speed}\nserved = true", "[keep_out]\nwithin = 3.0\ncrossing = true"]
        for arm, (name, number) in self.arms.items():
            place = f'port = "{url(name)}"\noffset = {ZEROS[arm]}\nlimits = {list(LIMITS[arm])}\ntolerance = {SLACK_DEG}'
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
    work : str
        ``sweep``, ``interrupted sweep``, or the sensor that was read along the linear axis.
    ended : str
        ``complete``, or the name of the error it ended with.
    struck : str
        What the fault did; empty where it found no opportunity.
    dealt_with : tuple of str
        What links and axes did about it.
    wrong : tuple of str
        Everything that must not be: readings stored as good that are not true, motion outside the limits, an axis left moving, a motion
        begun after an interrupt, an error without a name, a hang.
    """

    seed: int
    kind: str
    work: str
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
        self.first = math.inf  # simulated time of the first event
        self.interrupted = math.inf  # simulated time of the signal
        self.signalled_s = math.inf  # the same, time.monotonic()

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
        self.first = min(self.first, now)
        moving = [arm for arm in self._bench.arms if self._world.arms[arm].moving(now)]
        if moving and now > self.interrupted:
            self.wrong.append(f"stored after the interrupt, with {' and '.join(moving)} moving")
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


@contextlib.contextmanager
def interrupting(watcher: Watcher, running: Running, delay_s: float, after: str) -> Iterator[None]:
    """Send this process SIGINT, once somebody takes it as what it is, `delay_s` later or that long after a fault has struck `after`."""
    over = threading.Event()

    def taken() -> bool:
        return signal.getsignal(signal.SIGINT) is not dull

    def interrupt() -> None:
        while not over.wait(0.002):
            if taken() and (not after or running.struck(after)):
                break
        if not over.wait(delay_s) and taken():
            watcher.interrupted, watcher.signalled_s = running.world.clock.now(), time.monotonic()
            os.kill(os.getpid(), signal.SIGINT)

    def dull(number: int, frame: FrameType | None) -> None:
        """Nobody is interrupted: the sweep is just over."""

    old = signal.signal(signal.SIGINT, dull)
    thread = threading.Thread(target=interrupt, name="interrupter")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        signal.signal(signal.SIGINT, old)


def trial(seed: int, kind: str | None = None) -> Outcome:
    """Put a drawn bench to work while a drawn fault strikes; `kind` None: no fault and no interrupt at all."""
    rng = np.random.default_rng([20261123, seed])
    share = float(np.random.default_rng([20261124, seed]).random())
    if kind != INTERRUPT and share < BESIDE:
        return _read_along(seed, kind, rng)
    return _swept_trial(seed, kind, rng, interrupted=kind == INTERRUPT or (kind is not None and share < BESIDE + INTERRUPTED))


def _swept_trial(seed: int, kind: str | None, rng: np.random.Generator, interrupted: bool) -> Outcome:
    bench, work = Bench.drawn(rng), "interrupted sweep" if interrupted else "sweep"
    arms = {arm: f"{name}:{number}" for arm, (name, number) in bench.arms.items()}
    settings = Settings(seed=seed, speed=SPEED, pty=False, instruments=bench.instruments, **arms)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, in_background(settings) as running:
        where = ""
        if kind not in (None, INTERRUPT):
            where = _injected(running, seed, kind, rng, bench.instruments)
            if not where:
                return Outcome(seed, kind, work, "", str(bench), "not applicable", "", "", (), 0, 0, (), 0.0)
        watcher = Watcher(running, bench)
        delay, follows = (float(rng.uniform(0.0, SWEEP_S)), False) if rng.random() < 0.5 else (float(rng.uniform(0.0, 0.5)), True)
        with interrupting(watcher, running, delay, where if follows else "") if interrupted else contextlib.nullcontext():
            ended, message, wrong = _swept(running, bench, watcher, Path(folder))
        wrong += watcher.wrong
        struck = running.struck(where) if where else ()
        wrong += _left(running, bench, watcher, where if struck else "")
        incidents = Path(folder) / "run" / INCIDENTS
        dealt = tuple(line.split('"what": "')[1].split('"')[0] for line in incidents.read_text().splitlines()) if incidents.exists() else ()
    if kind is None and ended != "complete":
        wrong.append(f"ended with {ended} though nothing was wrong: {message}")
    # A signal that comes after the last reading finds nothing left to interrupt.
    over = watcher.interrupted == math.inf or watcher.stored == len(POINTS)
    if kind == INTERRUPT and ended not in ("Interrupted", *(["complete"] if over else [])):
        wrong.append(f"ended with {ended} though nothing but an interrupt came: {message}")
    did = str(struck[0]) if struck else "SIGINT" if kind == INTERRUPT and watcher.interrupted < math.inf else ""
    seconds = time.monotonic() - began
    return Outcome(
        seed, kind or "none", work, where, str(bench), ended, message, did, dealt, watcher.flagged, watcher.stored, tuple(wrong), seconds
    )


def _injected(running: Running, seed: int, kind: str, rng: np.random.Generator, instruments: tuple[str, ...]) -> str:
    """Have a fault strike one of the instruments that can have it; return which, or nothing where there is none."""
    able = [name for name in instruments if name in running.world.devices and kind in applicable(running.world.devices[name])]
    if not able:
        return ""
    where = str(rng.choice(able))
    running.inject(where, Fault(kind, seed, int(rng.integers(OPPORTUNITIES if where in STAGES else 30))))
    return where


def _swept(running: Running, bench: Bench, watcher: Watcher, folder: Path) -> tuple[str, str, list[str]]:
    """Sweep; return how it ended, and what is wrong with that."""

    def work() -> None:
        config = parse_config(bench.toml(running.url, SPEED), "campaign.toml")
        begin_run(folder / "run", config.text)
        measure(new_order(config, "RR", POINTS), folder / "run", watcher, Workspace(folder))

    return _ended(work)


def _ended(work: Callable[[], None]) -> tuple[str, str, list[str]]:
    """Do it; return how it ended, and what is wrong with that."""
    rig.ports.LINK_TIMEOUT_S = LINK_TIMEOUT_S
    try:
        with limited(HANG_S):
            work()
    except (DeviceError, RigError) as exc:
        return type(exc).__name__, str(exc), []
    except Hang as exc:
        return "Hang", str(exc), [f"hang: {exc}"]
    except Exception as exc:  # whatever it is, it has no name of ours
        return type(exc).__name__, str(exc), [f"an error without a name of ours: {exc!r}"]
    return "complete", "", []


def _left(running: Running, bench: Bench, watcher: Watcher, struck: str) -> list[str]:
    """Return what is wrong with the motion: outside the limits, begun after an interrupt, or not at rest soon after the end.

    Of the instrument that was `struck` it is not asked that nothing begins after the interrupt: its wire may be late.
    """
    world, wrong = running.world, []
    deadline = time.monotonic() + 2.0
    while any(arm.moving(world.clock.now()) for arm in world.arms.values()) and time.monotonic() < deadline:
        time.sleep(0.005)
    for name, arm in world.arms.items():
        if arm.moving(world.clock.now()):
            wrong.append(f"{name} still moves at the end")
        # Homing leads from wherever it stood to the origin, and from there the first motion into the limits.
        begin, origin, (low, high) = arm.track.nominal(0.0)[0] - arm.zero, -ZEROS[name], LIMITS[name]
        wrong += _beyond(name, arm.reach, min(begin, origin, low), max(begin, origin, high))
        if watcher.first < math.inf:
            wrong += _beyond(name, arm.reach_since(watcher.first), low, high)
        stops = [stop.time - watcher.signalled_s for stop in running.stops() if stop.axis == arm.axis]
        begun = [(at - watcher.interrupted) / SPEED for at in arm.track.departures if at > watcher.interrupted]
        late = [after for after in begun if after > GRACE_S or not any(after <= stop <= after + GRACE_S for stop in stops)]
        if late and bench.arms[name][0] != struck:
            wrong.append(f"{name} began to move {late[0]:.3f} s after the interrupt")
    return wrong


def _beyond(name: str, reach: tuple[float, float], least: float, most: float) -> list[str]:
    low, high = reach
    if low < least - SLACK_DEG or high > most + SLACK_DEG:
        return [f"{name} was at {low:.2f} to {high:.2f} deg, beyond {least:g} to {most:g}"]
    return []


# Readings along the linear axis


def _read_along(seed: int, kind: str | None, rng: np.random.Generator) -> Outcome:
    """Send the plate to drawn places, and read a range finder, or the camera, at each."""
    # The camera takes long, and has no wire of its own to be harmed.
    reader = str(rng.choice(list(READERS), p=(0.45, 0.45, 0.1)))
    places = [float(place) for place in rng.uniform(NEAREST_MM, FARTHEST_MM, PLACES)]
    settings = Settings(specimen="lambert:0.5", seed=seed, speed=SPEED, pty=False, instruments=("linear", reader))
    began = time.monotonic()
    with in_background(settings) as running:
        struck_at = "" if kind is None else _injected(running, seed, kind, rng, settings.instruments)
        if kind is not None and not struck_at:
            return Outcome(seed, kind, reader, "", f"linear/{reader}", "not applicable", "", "", (), 0, 0, (), 0.0)
        readings: list[tuple[float, bool]] = []
        dealt: list[str] = []
        wrong: list[str] = []

        def work() -> None:
            config = parse_config(_along_toml(running, reader), "campaign.toml")
            papers = Paperwork(report=lambda incident: dealt.append(incident.what))
            with open_bench(config, "RR", axes=["x"], sensors=["reader"], paperwork=papers) as bench:
                axis, sensor = bench.axes["x"], bench.sensors["reader"]
                axis.home().wait()
                for place in places:
                    axis.set(place).wait()
                    sensor.trigger().wait()
                    readings.append((sensor.value, sensor.last.good))
                    true = running.world.axes["linear:1"].nominal(running.world.clock.now())[0]
                    if abs(true - place) > SLACK_DEG:
                        wrong.append(f"x stored at {place:.3f} mm while it stood at {true:.3f}")
                    if sensor.last.good and reader in FRONTS and abs(sensor.value - FRONTS[reader] - true) > NOISE_MM:
                        wrong.append(f"{reader} {sensor.value:.3f} mm stored as good where {FRONTS[reader] + true:.3f} was true")

        ended, message, bad = _ended(work)
        struck = running.struck(struck_at) if struck_at else ()
        now = running.world.clock.now()
        track = running.world.axes["linear:1"]
        low, high = track.reach(now)
        if low < -SLACK_DEG or high > 150.0 + SLACK_DEG:
            wrong.append(f"x was at {low:.2f} to {high:.2f} mm, beyond 0 to 150")
        if track.moving(now):
            wrong.append("x still moves at the end")
    light = [value for value, good in readings if good] if reader not in FRONTS else []
    if light and max(light) > min(light) * (1 + CAMERA_SHARE):  # nothing that it looks at moves
        wrong.append(f"camera {max(light):.4g} and {min(light):.4g} stored as good of one and the same light")
    if kind is None and ended != "complete":
        wrong.append(f"ended with {ended} though nothing was wrong: {message}")
    flagged = sum(not good for _, good in readings)
    did = str(struck[0]) if struck else ""
    return Outcome(
        seed,
        kind or "none",
        reader,
        struck_at,
        f"linear/{reader}",
        ended,
        message,
        did,
        tuple(dealt),
        flagged,
        len(readings),
        (*bad, *wrong),
        time.monotonic() - began,
    )


def _along_toml(running: Running, reader: str) -> str:
    place = f"folder:{running.folder(reader)}" if reader == "camera" else running.url(reader)
    arms = (
        f'[axes.{arm}]\n{STAGES["stages"].format(number=number)}\nport = "none"\nlimits = [0, 1]'
        for number, arm in ((1, "source"), (2, "detector"))
    )
    tables = [
        f"[simulation]\nspeed = {SPEED}\nserved = true",
        *arms,
        f'{LINEAR}\ntolerance = {SLACK_DEG}\nport = "{running.url("linear")}"',
        '[sensor]\nmodel = "keithley-6485"\nport = "nowhere"',
        f'[sensors.reader]\n{READERS[reader]}\nport = "{place}"',
        "[keep_out]\nwithin = 3.0\ncrossing = true",
    ]
    return "\n\n".join(tables)


def kinds() -> tuple[str, ...]:
    """All kinds of faults, an interrupt in place of one among them."""
    return (*KINDS, INTERRUPT)
