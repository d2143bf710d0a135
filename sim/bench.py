"""The virtual bench: lamp, specimen, photodiode and two arms, coupled by their true angles.

Its forward kinematics are its own: theta_i = source stage - 90 deg + misalignment, theta_r = detector stage - 100 deg + misalignment, both
positive towards +x and seen from the specimen's normal. The stages' readings know nothing of the misalignments, nor of the ringing.

Every light sensor sees the same light, each in its own unit: the picoammeter the photodiode's current; a luminance meter beside the diode,
on the same patch and arm, the patch's radiance times `Lamp.efficacy`; a camera there the radiance itself; a quantum sensor beside the
specimen, facing the lamp, the irradiance times `Lamp.photons`. Both factors stand for the spectrum of a white light-emitting diode, at
every angle and on every specimen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.errors import SimError, SpecimenError

ELEMENTARY_CHARGE = 1.602176634e-19
"""C, exact in the SI."""
BLOCKED = 3.0
"""Closer together than this, deg, the detector's arm stands in the lamp's beam."""
SOURCE_ZERO, DETECTOR_ZERO = 90.0, 100.0
"""Stage angles, deg, at which the arms stand on the specimen's normal."""

Floats = NDArray[np.float64]


class Specimen(Protocol):
    """What lies on the specimen stage."""

    @property
    def name(self) -> str:
        """What the command line calls it."""

    def f_r(self, theta_i: Floats, theta_r: Floats) -> Floats:
        """Return the BRDF in the plane of incidence, 1/sr.

        Parameters
        ----------
        theta_i : ndarray, deg
            Incidence, 0 to 90 (excluded).
        theta_r : ndarray, deg
            View, within 90 of the normal, positive on the light's side.
        """


@dataclass(frozen=True)
class Lambertian:
    """A matt surface that reflects the fraction `albedo` of the light."""

    albedo: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.albedo <= 1:
            raise SpecimenError(f"lambert:{self.albedo}: expected an albedo from 0 to 1")

    @property
    def name(self) -> str:
        """What the command line calls it."""
        return f"lambert:{self.albedo:g}"

    def f_r(self, theta_i: Floats, theta_r: Floats) -> Floats:
        """Return albedo/pi for every pair of angles, 1/sr."""
        return np.full(np.broadcast_shapes(np.shape(theta_i), np.shape(theta_r)), self.albedo / math.pi)


class Petal:
    """A virtual petal from its table, `sim.petals`.

    The table ends at theta_i = 80 deg. Arms stand beyond that at times, and the world must then still have some light: from there to
    grazing incidence the petal reflects as at 80 deg. Nothing between 80 and 90 deg is to be believed.
    """

    LAST = 80.0

    def __init__(self, name: str) -> None:
        from sim import petals
        from sim.petals.errors import PetalError

        if name not in petals.names():
            raise SpecimenError(f"specimen {name!r}: expected lambert:ALBEDO or one of {', '.join(petals.names())}")
        self.name = name
        try:
            self._table = petals.load(name)
        except PetalError as error:
            raise SpecimenError(f"specimen {name!r}: {error}") from error

    def f_r(self, theta_i: Floats, theta_r: Floats) -> Floats:
        """Return the table's BRDF, 1/sr."""
        return np.asarray(self._table.f_r(np.minimum(theta_i, self.LAST), theta_r), dtype=float)


def specimen(text: str) -> Specimen:
    """Make the specimen `lambert:ALBEDO` or the petal of that name.

    Raises
    ------
    SpecimenError
        No such specimen.
    """
    kind, colon, number = text.partition(":")
    if not colon:
        return Petal(text)
    try:
        if kind == "lambert":
            return Lambertian(float(number))
    except ValueError:
        pass
    raise SpecimenError(f"specimen {text!r}: expected lambert:ALBEDO, such as lambert:0.5, or the name of a petal")


@dataclass(frozen=True)
class Lamp:
    """A lamp that drifts: `irradiance` on the specimen at normal incidence, W/m^2, times `level`.

    Parameters
    ----------
    irradiance : float
        W/m^2, all of it visible; the default makes the default photodiode give 1000 nA for a white Lambertian at theta_i = 45 deg.
    trend : float
        Steady drift, fraction per hour.
    flicker : float
        rms of the slow wandering, as a fraction. Its power per octave is the same from 4 s to 2.3 h (1/f).
    phases : tuple of float
        One per octave, rad.
    efficacy : float
        Luminous efficacy of the light, lm/W.
    photons : float
        In the light, umol/J.
    """

    irradiance: float = 5 * math.sqrt(2) * math.pi
    trend: float = 0.0
    flicker: float = 0.0
    phases: tuple[float, ...] = ()
    efficacy: float = 300.0
    photons: float = 4.6

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Lamp:
        """Draw a lamp that drifts 0.2 to 0.5 % per hour, either way, and wanders by 0.03 % rms."""
        trend = float(rng.uniform(0.002, 0.005) * rng.choice([-1, 1]))
        return cls(trend=trend, flicker=3e-4, phases=tuple(float(phase) for phase in rng.uniform(0, 2 * math.pi, 12)))

    def level(self, t: float) -> float:
        """Return the output at simulated time `t` (s) as a fraction of nominal; 1 on an average over time without trend."""
        octaves = range(len(self.phases))
        swing = self.flicker * math.sqrt(2 / len(self.phases)) if self.phases else 0.0
        # A sum of waves, not a random walk: the same at a time however often it is asked.
        wander = sum(math.sin(2 * math.pi * t / (4.0 * 2**k) + self.phases[k]) for k in octaves)
        return 1.0 + self.trend * t / 3600 + swing * wander


@dataclass(frozen=True)
class Photodiode:
    """A photodiode behind an aperture that sees only the lit patch.

    Parameters
    ----------
    responsivity : float
        A/W.
    solid_angle : float
        Of the aperture, seen from the specimen, sr.
    patch : float
        Area seen, m^2, the same at every view angle (it is taken from the radiance).
    dark : float
        Dark current, A.
    noise_density : float
        Noise of diode and cable without light, A/sqrt(Hz).
    """

    responsivity: float = 0.4
    solid_angle: float = 0.02
    patch: float = 25e-6
    dark: float = 3e-12
    noise_density: float = 1.5e-14

    def noise(self, current: float, duration: float) -> float:
        """Return the rms noise of a mean over `duration` (s): sqrt((2 q I + n^2) B) with B = 1/(2 duration)."""
        return math.sqrt((2 * ELEMENTARY_CHARGE * abs(current) + self.noise_density**2) / (2 * duration))


@dataclass(frozen=True)
class Misalignment:
    """True minus nominal angle of the two arms, deg."""

    source: float = 0.0
    detector: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Misalignment:
        """Draw 0.05 to 0.15 deg for each arm, either way."""
        source, detector = (rng.uniform(0.05, 0.15) * rng.choice([-1, 1]) for _ in range(2))
        return cls(float(source), float(detector))


Angle = Callable[[float], float]
"""True mechanical angle of a stage, deg, at a simulated time, s."""


@dataclass(frozen=True)
class Plate:
    """The matt plate beside the bench that both range finders look at, on a carriage that takes it away from them.

    Parameters
    ----------
    position : callable
        True position of the carriage, mm, at a simulated time, s.
    front : float
        From the front of the one sensor to the plate with the carriage at 0, mm. For the other, that is the start of its measuring range.
    """

    position: Callable[[float], float]
    front: float = 60.0

    def from_front(self, t0: float, t1: float) -> float:
        """Return the distance from the sensor's front midway between two times, mm."""
        return self.front + self.position((t0 + t1) / 2)

    def from_start(self, t0: float, t1: float) -> float:
        """Return the distance from the start of the measuring range midway between two times, mm."""
        return self.position((t0 + t1) / 2)


@dataclass
class Bench:
    """The world the instruments share.

    Parameters
    ----------
    source, detector : callable
        True mechanical angles of the two stages, deg, at a time.
    specimen : Specimen
        What is measured.
    rng : numpy.random.Generator
        Draws the noise of each reading.
    lamp, photodiode, misalignment
        Ideal and nominal if not given.
    """

    source: Angle
    detector: Angle
    specimen: Specimen
    rng: np.random.Generator
    lamp: Lamp = field(default_factory=Lamp)
    photodiode: Photodiode = field(default_factory=Photodiode)
    misalignment: Misalignment = field(default_factory=Misalignment)

    @property
    def scale(self) -> float:
        """K of current = K f_r cos(theta_i), A sr, with the lamp at nominal."""
        diode = self.photodiode
        return self.lamp.irradiance * diode.patch * diode.solid_angle * diode.responsivity

    def angles(self, t: float) -> tuple[float, float]:
        """Return the true theta_i and theta_r at time `t`, deg, within -180 to 180."""
        theta_i = self.source(t) - SOURCE_ZERO + self.misalignment.source
        theta_r = self.detector(t) - DETECTOR_ZERO + self.misalignment.detector
        return _wrapped(theta_i), _wrapped(theta_r)

    def light(self, theta_i: Any, theta_r: Any) -> Floats:
        """Return the photocurrent without dark current and noise at nominal lamp level, A; angles in deg, broadcast.

        Dark when the detector's arm blocks the beam, and when lamp or detector stands at the horizon or behind the specimen: the bench
        knows only reflection so far.
        """
        theta_i, theta_r = np.broadcast_arrays(np.asarray(theta_i, dtype=float), np.asarray(theta_r, dtype=float))
        lit = (np.abs(theta_i) < 90) & (np.abs(theta_r) < 90) & (np.abs(theta_i - theta_r) >= BLOCKED)
        current = np.zeros(lit.shape)
        if lit.any():
            side = np.where(theta_i[lit] < 0, -1.0, 1.0)  # a specimen knows the light on its positive side only
            incidence, view = side * theta_i[lit], side * theta_r[lit]
            current[lit] = self.scale * self.specimen.f_r(incidence, view) * np.cos(np.radians(incidence))
        return current

    def truth(self, theta_i: Any, theta_r: Any) -> Floats:
        """Return `light` with the arms at these nominal angles, which is where their stages say they stand."""
        return self.light(np.add(theta_i, self.misalignment.source), np.add(theta_r, self.misalignment.detector))

    def photocurrent(self, t0: float, t1: float) -> float:
        """Return the mean current between two times, s, without dark current and noise, A; the arms may move meanwhile.

        Raises
        ------
        SimError
            The times are not in order, or older than the axes remember.
        """
        if not t1 > t0:
            raise SimError(f"signal asked for from {t0} s to {t1} s: expected a later end")
        # Fine enough for the ringing (some 25 Hz) and for a move at 100 deg/s through a highlight.
        count = min(256, max(4, math.ceil((t1 - t0) / 0.0025)))
        times = t0 + (np.arange(count) + 0.5) * (t1 - t0) / count
        angles = np.array([self.angles(t) for t in times])
        return float(np.mean(self.light(angles[:, 0], angles[:, 1]))) * self.lamp.level((t0 + t1) / 2)

    def signal(self, t0: float, t1: float) -> float:
        """Return what comes out of the photodiode: the mean current between two times, s, with dark current and noise, A.

        Raises
        ------
        SimError
            As `photocurrent`.
        """
        current = self.photocurrent(t0, t1) + self.photodiode.dark
        return current + float(self.rng.normal(0.0, self.photodiode.noise(current, t1 - t0)))

    @property
    def radiance_per_ampere(self) -> float:
        """Radiance of the patch over the photocurrent it gives, W/(m^2 sr A)."""
        diode = self.photodiode
        return 1 / (diode.patch * diode.solid_angle * diode.responsivity)

    def radiance(self, t0: float, t1: float) -> float:
        """Return the mean radiance of the patch, seen along the detector's arm between two times, s, without noise, W/(m^2 sr)."""
        return self.radiance_per_ampere * self.photocurrent(t0, t1)

    def luminance(self, t0: float, t1: float) -> float:
        """Return the mean luminance of the patch, seen along the detector's arm between two times, s, without noise, cd/m^2."""
        return self.lamp.efficacy * self.radiance(t0, t1)

    def photon_flux(self, t0: float, t1: float) -> float:
        """Return the mean photon flux density from the lamp at normal incidence between two times, s, without noise, umol/(m^2 s)."""
        return self.lamp.irradiance * self.lamp.photons * self.lamp.level((t0 + t1) / 2)


def _wrapped(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0
