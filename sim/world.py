"""The simulated world: any choice of instruments around one bench, and what an onlooker may know of it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TextIO

import numpy as np

from sim.apogee import QuantumSensor
from sim.baumer import DistanceSensor
from sim.bench import DETECTOR_ZERO, SOURCE_ZERO, Bench, Lamp, Misalignment, Plate, specimen
from sim.camera import SimulatedCamera
from sim.clock import Clock, SimClock
from sim.errors import SimError
from sim.faults import Faulty, parse
from sim.keithley import Keithley6485, MeterModel
from sim.konica_minolta import Photometer, PhotometerModel
from sim.modbus import ModbusBus
from sim.motion import Ringing, Track
from sim.newport import Esp301, EspStage
from sim.optoncdt import OptoNCDT
from sim.oriental import AzAxis, AzModel
from sim.sigma_koki import GSC_02, SHOT_302GS, SigmaKoki
from sim.wire import Instrument
from sim.zaber import LinearModel, StageModel, ZaberChain

INSTRUMENTS: Mapping[str, str] = MappingProxyType(
    {
        "stages": "Zaber X-RSW60A rotary stages, a chain of two, addresses 1 and 2",
        "linear": "Zaber X-LSM linear stages, a chain of two, x and y at addresses 1 and 2; x carries the plate the range finders look at",
        "newport": "Newport ESP301 motion controller with two rotary stages",
        "shot": "Sigma Koki SHOT-302GS stage controller with two rotary stages",
        "gsc": "Sigma Koki GSC-02 stage controller with two rotary stages",
        "oriental": "Oriental Motor AZ drivers with hollow rotary actuators, Modbus RTU addresses 1 and 2",
        "meter": "Keithley 6485 picoammeter with a photodiode on the detector's arm",
        "ls-100": "Konica Minolta LS-100 luminance meter on the detector's arm",
        "cs-100a": "Konica Minolta CS-100A luminance and colour meter on the detector's arm",
        "apogee": "Apogee SQ-422X quantum sensor that faces the lamp, Modbus RTU address 1",
        "om20": "Baumer OM20 laser distance sensor, Modbus RTU address 1",
        "optoncdt": "Micro-Epsilon optoNCDT 1420 laser triangulation sensor",
        "camera": "tethered camera on the detector's arm: make the file .shutter in its folder, and it drops a picture there",
    }
)
"""What can be served. A new one goes to the end: its place decides its random numbers."""

LINES: Mapping[str, str] = MappingProxyType(
    {
        "stages": "115200 8N1, LF; replies CRLF",
        "linear": "115200 8N1, LF; replies CRLF",
        "newport": "921600 8N1 RTS/CTS (an ESP300: 19200), CR; replies CRLF",
        "shot": "9600 8N1 RTS/CTS, CRLF",
        "gsc": "9600 8N1 RTS/CTS, CRLF",
        "oriental": "115200 8E1, Modbus RTU",
        "meter": "9600 8N1, {terminator} both ways",
        "ls-100": "4800 7E2, CRLF",
        "cs-100a": "4800 7E2, CRLF",
        "apogee": "19200 8E1, Modbus RTU",
        "om20": "57600 8E1, Modbus RTU",
        "optoncdt": "921600 8N1, CRLF",
    }
)
"""Line settings as the drivers have them where rig.toml says nothing; of newport and meter they are not verified. Sockets and
pseudo-terminals ignore all but the line ends."""

CAMERA = "camera"
STANDING = {"source": 45.0, "detector": 0.0}
"""Nominal angles, deg, of arms that no axis carries."""
_ZEROS = {"source": SOURCE_ZERO, "detector": DETECTOR_ZERO}
_PLATE = "linear:1"
_AWAY = 25.0  # mm: where the plate stands if nothing moves it


@dataclass(frozen=True)
class Settings:
    """What can be chosen about the simulated world.

    Parameters
    ----------
    specimen : str
        Name of a virtual petal, or `lambert:ALBEDO`.
    seed : int
        Decides the positions at power-up, misalignments, drift, offset and noise.
    speed : float
        Simulated seconds per real second.
    stage, meter, linear
        What the Zaber rotary stages, the picoammeter and the linear stages are like.
    misalignment : Misalignment or None
        Of the arms; None draws it.
    pty : bool
        Serve on pseudo-terminals too.
    instruments : tuple of str
        What is served, names of `INSTRUMENTS`.
    source, detector : str or None
        The rotary axis that carries the lamp's and the detector's arm, such as `newport:2`. None takes `stages:1` and `stages:2`, and
        where the stages are not served leaves the arm `STANDING`.
    camera_folder : str or None
        Where the camera drops its pictures; None makes a folder for it. A folder that was made is removed at the end.
    faults : tuple of str
        `NAME:KIND:SEED` or `NAME:KIND:SEED:AFTER`, pending from the start; see `sim.faults`.
    """

    specimen: str = "RR"
    seed: int = 1
    speed: float = 1.0
    stage: StageModel = field(default_factory=StageModel)
    meter: MeterModel = field(default_factory=MeterModel)
    misalignment: Misalignment | None = None
    pty: bool = True
    instruments: tuple[str, ...] = ("stages", "meter")
    source: str | None = None
    detector: str | None = None
    linear: LinearModel = field(default_factory=LinearModel)
    camera_folder: str | None = None
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class Arm:
    """An arm of the goniometer, for onlookers. Angles are nominal, deg: what its axis would say with the home position known.

    Parameters
    ----------
    axis : str or None
        What carries it, as in `World.axes`; None if it stands still.
    track : Track
        Of that axis.
    zero : float
        Angle of the axis at which the arm stands on the specimen's normal.
    clock : Clock
        Simulated time.
    """

    axis: str | None
    track: Track
    zero: float
    clock: Clock

    def nominal(self, t: float) -> float:
        """Return the angle at simulated time `t`."""
        return self.track.nominal(t)[0] - self.zero

    def moving(self, t: float) -> bool:
        """Tell whether the arm was moving at simulated time `t`; the ringing after a stop does not count."""
        return self.track.moving(t)

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest angle there ever was, up to now, exactly."""
        return self.reach_since(0.0)

    def reach_since(self, t: float) -> tuple[float, float]:
        """Return the lowest and the highest angle from simulated time `t` to now, exactly.

        Raises
        ------
        SimError
            `t` lies before what the track remembers.
        """
        low, high = self.track.reach(self.clock.now(), t)
        return low - self.zero, high - self.zero


class Stop(NamedTuple):
    """A stop command that arrived: `time.monotonic()`, s, and the axis."""

    time: float
    axis: str


class StopLog:
    """Stop commands in the order of their arrival, one entry for each axis they speak to."""

    def __init__(self) -> None:
        self._stops: list[Stop] = []
        self._file: TextIO | None = None

    def note(self, axis: str) -> None:
        """Note that a stop command for `axis` is here."""
        stop = Stop(time.monotonic(), axis)
        self._stops.append(stop)
        if self._file is not None:
            self._file.write(json.dumps(stop._asdict()) + "\n")
            self._file.flush()

    def all(self) -> tuple[Stop, ...]:
        """Return what was noted so far; from any thread."""
        return tuple(self._stops)

    @contextmanager
    def written_to(self, path: str | Path) -> Iterator[None]:
        """Write what is noted to a file too, for the length of a `with` block: JSON lines, each flushed.

        Raises
        ------
        SimError
            The file cannot be written.
        """
        with ExitStack() as stack:
            try:
                self._file = stack.enter_context(open(path, "w", encoding="utf-8"))
            except OSError as error:
                raise SimError(f"stop log {path}: {error.strerror}") from error
            try:
                yield
            finally:
                self._file = None


class Carried(Protocol):
    """Whatever has a track."""

    @property
    def track(self) -> Track:
        """Where it was told to be, and where it was."""


@dataclass(frozen=True)
class World:
    """The bench and the instruments around it.

    Parameters
    ----------
    settings : Settings
        What it was made from.
    clock : Clock
        Simulated time.
    bench : Bench
        Lamp, specimen, photodiode, true angles.
    devices : mapping of str to Instrument
        What is served, by name; all but the camera, which has no port.
    faulty : mapping of str to Faulty
        The same behind lines that can fail.
    camera : SimulatedCamera or None
        Where it is served.
    axes : mapping of str to Track
        Every axis of every stage served: `stages:1`, ...; degrees, of linear stages mm.
    arms : mapping of str to Arm
        `source` and `detector`.
    stops : StopLog
        Stop commands that arrived.
    """

    settings: Settings
    clock: Clock
    bench: Bench
    devices: Mapping[str, Instrument]
    faulty: Mapping[str, Faulty]
    camera: SimulatedCamera | None
    axes: Mapping[str, Track]
    arms: Mapping[str, Arm]
    stops: StopLog

    def truth(self, theta_i: Any, theta_r: Any, sensor: str = "meter") -> Any:
        """Return what a sensor would tell at nominal angles, deg, if the lamp were at its nominal level and nothing noisy.

        Parameters
        ----------
        theta_i, theta_r : array_like, deg
            What the stages say; the light is that of the true angles, misalignment included.
        sensor : str
            `meter` (A, without dark current), `ls-100` or `cs-100a` (cd/m^2), `apogee` (umol/(m^2 s), at any angle).

        Raises
        ------
        SimError
            No such sensor.
        """
        lamp, current = self.bench.lamp, self.bench.truth(theta_i, theta_r)
        match sensor:
            case "meter":
                return current
            case "ls-100" | "cs-100a":
                return current * self.bench.radiance_per_ampere * lamp.efficacy
            case "apogee":
                return np.full_like(current, lamp.irradiance * lamp.photons)
        raise SimError(f"truth of {sensor!r}: expected meter, ls-100, cs-100a or apogee")

    @property
    def stages(self) -> ZaberChain:
        """The Zaber chain of rotary stages, where it is served."""
        chain = self.devices["stages"]
        assert isinstance(chain, ZaberChain)
        return chain

    @property
    def meter(self) -> Keithley6485:
        """The picoammeter, where it is served."""
        meter = self.devices["meter"]
        assert isinstance(meter, Keithley6485)
        return meter


def build(settings: Settings, clock: Clock | None = None) -> World:
    """Make the world of these settings; it starts at rest, unhomed, at simulated time zero.

    Raises
    ------
    SimError
        A setting makes no sense, or there is no such specimen.
    """
    _check(settings.instruments)
    if settings.seed < 0:
        raise SimError(f"seed {settings.seed}: expected zero or more")
    clock = clock or SimClock(settings.speed)
    # One stream of random numbers per part: a change to one does not reshuffle the others. The first five are older than the rest.
    seeds = np.random.SeedSequence(settings.seed).spawn(5 + len(INSTRUMENTS))
    parked, aligned, lit, diode, meter = map(np.random.default_rng, seeds[:5])
    streams = dict(zip(INSTRUMENTS, map(np.random.default_rng, seeds[5:]), strict=True)) | {"stages": parked, "meter": meter}
    stops = StopLog()
    stages = {name: _stages(name, settings, clock, streams[name]) for name in settings.instruments if name in _STAGES}
    carried = {f"{name}:{number}": axis for name, stage in stages.items() for number, axis in _axes(stage, name, stops).items()}
    axes = {name: axis.track for name, axis in carried.items()}
    chosen = {"source": settings.source, "detector": settings.detector}
    arms = {arm: Arm(*_carrier(arm, axis, axes), zero=_ZEROS[arm], clock=clock) for arm, axis in chosen.items()}
    if arms["source"].axis is not None and arms["source"].axis == arms["detector"].axis:
        raise SimError(f"source and detector {settings.source!r}: one axis cannot carry both arms")
    bench = Bench(
        source=arms["source"].track.mechanical,
        detector=arms["detector"].track.mechanical,
        specimen=specimen(settings.specimen),
        rng=diode,
        lamp=Lamp.drawn(lit),
        misalignment=settings.misalignment or Misalignment.drawn(aligned),
    )
    plate = Plate(axes[_PLATE].mechanical if _PLATE in axes else lambda t: _AWAY)
    devices = {
        name: stages[name] if name in stages else _sensor(name, settings, clock, bench, plate, streams[name])
        for name in settings.instruments
        if name != CAMERA
    }
    camera = None
    if CAMERA in settings.instruments:
        camera = SimulatedCamera(Path(settings.camera_folder or ""), clock, bench.radiance, streams[CAMERA])
    return World(
        settings=settings,
        clock=clock,
        bench=bench,
        devices=MappingProxyType(devices),
        faulty=MappingProxyType(_faulty(devices, settings.faults, clock)),
        camera=camera,
        axes=MappingProxyType(axes),
        arms=MappingProxyType(arms),
        stops=stops,
    )


def _faulty(devices: Mapping[str, Instrument], faults: tuple[str, ...], clock: Clock) -> dict[str, Faulty]:
    faulty = {name: Faulty(device, clock) for name, device in devices.items()}
    for text in faults:
        name, fault = parse(text)
        if name not in faulty:
            raise SimError(f"fault {text!r}: expected one of {', '.join(faulty)}")
        faulty[name].inject(fault)
    return faulty


def _check(names: tuple[str, ...]) -> None:
    for name in names:
        if name not in INSTRUMENTS:
            raise SimError(f"instrument {name!r}: expected some of {', '.join(INSTRUMENTS)}")
    if not names or len(set(names)) < len(names):
        raise SimError(f"instruments {', '.join(names) or 'none'}: expected at least one, and each but once")


_STAGES = ("stages", "linear", "newport", "shot", "gsc", "oriental")


def _stages(name: str, settings: Settings, clock: Clock, rng: np.random.Generator) -> ZaberChain | Esp301 | SigmaKoki | ModbusBus:
    """Make stages, parked anywhere within their travel, or the turn where they have none."""

    def parked(low: float, high: float) -> list[float]:
        return [float(position) for position in rng.uniform(low, high, 2)]

    match name:
        case "stages":
            return ZaberChain(clock, parked(settings.stage.limit_min, settings.stage.limit_max), settings.stage, name)
        case "linear":
            return ZaberChain(clock, parked(settings.linear.limit_min, settings.linear.limit_max), settings.linear, name)
        case "newport":
            esp = EspStage()
            return Esp301(clock, parked(esp.limit_min, esp.limit_max), esp, name)
        case "shot" | "gsc":
            return SigmaKoki(clock, parked(0.0, 360.0), SHOT_302GS if name == "shot" else GSC_02, name=name)
        case "oriental":
            az = AzModel()
            units = {address: AzAxis(az, angle) for address, angle in enumerate(parked(az.limit_min, az.limit_max), 1)}
            return ModbusBus(clock, units, name, "oriental-az")
    raise AssertionError(name)


def _axes(stage: ZaberChain | Esp301 | SigmaKoki | ModbusBus, name: str, stops: StopLog) -> dict[int, Carried]:
    """Return the axes by their numbers, with their stop commands noted."""
    if not isinstance(stage, ModbusBus):
        stage.on_stop = lambda axis: stops.note(f"{name}:{axis}")
        return dict(enumerate(stage.axes, 1))
    drivers = {address: unit for address, unit in stage.units.items() if isinstance(unit, AzAxis)}
    for address, driver in drivers.items():
        driver.on_stop = partial(stops.note, f"{name}:{address}")
    return dict(drivers)


def _carrier(arm: str, axis: str | None, axes: Mapping[str, Track]) -> tuple[str | None, Track]:
    """Return the axis that carries an arm, and its track."""
    usual = f"stages:{1 if arm == 'source' else 2}"
    if axis is None and usual not in axes:
        return None, Track(STANDING[arm] + _ZEROS[arm], Ringing(amplitude=0.0))
    rotary = [known for known in axes if not known.startswith("linear:")]
    if (axis or usual) not in rotary:
        raise SimError(f"{arm} {axis!r}: expected a rotary axis that is served, {' or '.join(rotary) or 'of which there is none'}")
    return axis or usual, axes[axis or usual]


def _sensor(name: str, settings: Settings, clock: Clock, bench: Bench, plate: Plate, rng: np.random.Generator) -> Instrument:
    match name:
        case "meter":
            return Keithley6485(clock, bench.signal, rng, settings.meter, name)
        case "ls-100" | "cs-100a":
            return Photometer(clock, bench.luminance, rng, PhotometerModel(colour=name == "cs-100a"), name=name)
        case "apogee":
            return ModbusBus(clock, {1: QuantumSensor(bench.photon_flux, rng)}, name, "apogee-sq-422x")
        case "om20":
            return ModbusBus(clock, {1: DistanceSensor(plate.from_front, rng)}, name, "baumer-om20")
        case "optoncdt":
            return OptoNCDT(clock, plate.from_start, rng, name=name)
    raise AssertionError(name)
