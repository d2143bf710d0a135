"""Trace photons on a petal and turn the tallies into reflectance with standard errors."""

import math
from dataclasses import dataclass

import numpy as np

from sim.petals.errors import PetalError
from sim.petals.structure import Petal, check, tallest

TRACER_VERSION = 1  # raise it when the same seed would give another table
BATCHES = 50  # their scatter gives a standard error good to 10 %


@dataclass(frozen=True)
class Trace:
    """What became of the light that fell on a petal from one angle of incidence.

    Each array has B batches along its first axis; each batch is an independent estimate.

    Attributes
    ----------
    petal : Petal
    surface, body : ndarray, shape (B, 35)
        Parts of f_r [1/sr] in the plane of incidence at theta_r = -85, -80 .. 85 deg, positive on the light's side: light that never
        entered the petal, and light that did. Exactly at these angles (a far point detector): each meeting of a photon with the rough
        surface adds what it is expected to send there.
    cones : ndarray, shape (B, 35)
        f_r there once more [1/sr], by counting the photons in acceptance cones of half-angle 4 deg (mean weighted with cos theta_r, as a
        detector weights it): noisier and a little blurred, but free of any formula for the rough surface's lobes.
    bins : ndarray, shape (B, 9, 12)
        f_r [1/sr], mean over bins of theta_r (10 deg, from 0) by |phi_r - phi_i| (15 deg, from 0).
    reflected, transmitted, absorbed : ndarray, shape (B,)
        Shares of the light.
    roulette : ndarray, shape (B,)
        What the Russian roulette took less what it gave; 0 in the mean. With it the four sum to 1 to rounding.
    """

    petal: Petal
    surface: np.ndarray
    body: np.ndarray
    cones: np.ndarray
    bins: np.ndarray
    reflected: np.ndarray
    transmitted: np.ndarray
    absorbed: np.ndarray
    roulette: np.ndarray

    @property
    def f_r(self) -> np.ndarray:
        """f_r in the plane of incidence, shape (B, 35) [1/sr].

        Raises
        ------
        PetalError
            For a smooth surface, whose mirror lobe no point detector can sample.
        """
        if self.petal.roughness == 0:
            raise PetalError("f_r at single directions of a petal with roughness 0: it mirrors to one direction only; use cones or bins")
        return self.surface + self.body


def mean_and_error(batches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the first axis, and its standard error."""
    return batches.mean(axis=0), batches.std(axis=0, ddof=1) / math.sqrt(len(batches))


def trace(petal: Petal, theta_i: float | tuple[float, float], photons: int, seed: int | tuple[int, ...], batches: int = BATCHES) -> Trace:
    """Trace light that falls on a petal at theta_i.

    The same arguments give the same numbers, whatever the number of threads.

    Parameters
    ----------
    petal : Petal
    theta_i : float or (float, float)
        Angle of incidence [deg], 0 to 90 exclusive; or a ring from..to, filled with light of one radiance (cosine-weighted). The azimuth of
        the light against the lattice is random.
    photons : int
        Number of photons, rounded up to a multiple of `batches`.
    seed : int or tuple of int
    batches : int

    Raises
    ------
    PetalError
        For values out of range, and if photons were lost between the domes.
    """
    from sim.petals import kernels

    petal = check(petal)
    low, high = theta_i if isinstance(theta_i, tuple) else (theta_i, theta_i)
    if not (0 <= low <= high <= 90 and low < 90):
        raise PetalError(f"theta_i = {theta_i} deg: expected 0 to less than 90, or a ring (from, to) within 0 to 90")
    if photons < 1 or batches < 2:
        raise PetalError(f"{photons} photons in {batches} batches: expected at least 1 photon and 2 batches")
    sin2 = [math.sin(math.radians(angle)) ** 2 for angle in (low, high)]
    seeds = np.random.SeedSequence(seed).generate_state(batches, np.uint64)
    energy, seen, cones, bins = kernels.shine_batches(petal, tallest(petal), sin2[0], sin2[1], -(-photons // batches), seeds)
    stray = energy[:, kernels.STRAY].mean()
    if stray > 1e-6:
        raise PetalError(
            f"a share {stray:.1e} of the light ran on between the domes of {petal}: expected less than 1e-6; spread the heights"
        )
    # Solid angles projected on the petal: of a cone pi sin^2(half) cos(theta); of a bin (sin^2 - sin^2) dphi / 2, and again for -phi.
    half = math.radians(kernels.CONE_HALF_ANGLE)
    cone = math.pi * math.sin(half) ** 2 * np.cos(np.radians(theta_r_nodes()))
    edges = np.sin(np.radians(np.linspace(0, 90, kernels.THETA_BINS + 1))) ** 2
    cell = np.diff(edges)[:, None] * math.pi / kernels.PHI_BINS
    return Trace(
        petal=petal,
        surface=seen[:, kernels.SURFACE],
        body=seen[:, kernels.BODY],
        cones=cones / cone,
        bins=bins / cell,
        reflected=energy[:, kernels.SURFACE] + energy[:, kernels.BODY],
        transmitted=energy[:, kernels.TRANSMITTED],
        absorbed=energy[:, kernels.ABSORBED],
        roulette=energy[:, kernels.ROULETTE] + energy[:, kernels.STRAY],
    )


def theta_r_nodes() -> np.ndarray:
    """Viewing angles of the detectors in the plane of incidence [deg], shape (35,)."""
    return np.linspace(-85.0, 85.0, 35)
