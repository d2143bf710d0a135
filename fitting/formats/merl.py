"""MERL's binary files: isotropic RGB reflectance over half and difference angles.

Three little-endian int32 (90, 90, 180) and a plane of float64 for each of R, G and B, over theta_half, theta_diff and phi_diff. Bins of
theta_half are narrow about the mirror's direction: bin j ends at (j + 1)^2 / 90 deg. Those of the others are 1 deg wide. Light and view are
exchangeable here, so phi_diff stops at 180 deg. A plane counts f_r in its own unit (`UNITS`); below 0 there is no value.

Sources: W. Matusik et al. 2003, "A data-driven reflectance model", doi:10.1145/882262.882343; S. Rusinkiewicz 1998, "A new change of
variables for efficient BRDF representation", doi:10.1007/978-3-7091-6453-2_2.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError, TableError
from fitting.formats import replacing
from fitting.formats.grid import Brdf, Function, ask, channel_names

Array = NDArray[np.float64]

BINS = (90, 90, 180)
"""theta_half, theta_diff, phi_diff."""

RGB = ("R", "G", "B")
UNITS = np.array([1.0, 1.15, 1.66]) / 1500
"""What a count of each plane stands for, 1/sr."""

HEADER = 12
SIZE = HEADER + 3 * 8 * 90 * 90 * 180
"""Bytes."""

INVALID = -1.0
"""Count written where there is no value."""

EDGE = 2.0
"""A bin whose middle is this far below the horizon, deg, may still reach above it, and then holds the value at the horizon."""


@dataclass(frozen=True, eq=False)
class Merl:
    """A MERL file's reflectance; a callable of the three angles.

    Attributes
    ----------
    values : ndarray, shape (90, 90, 180, c), 1/sr
        Over the bins of theta_half, theta_diff and phi_diff, and the channels; 0 where there is none.
    valid : ndarray of bool, shape (90, 90, 180)
        Where there is one.
    source : str
        The file.
    channels : tuple of str
        R, G and B, or one of them.
    """

    values: Array
    valid: NDArray[np.bool_]
    source: str = "MERL"
    channels: tuple[str, ...] = RGB

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look the reflectance up, linearly between the middles of those bins that have a value, or else those next to them.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        theta_r_deg : array_like, deg
            -90 to 90; below 0 it is the view at -theta_r and phi + 180.
        phi_deg : array_like, deg
            phi_r - phi_i, 0 on the light's side.

        Returns
        -------
        ndarray, of the broadcast shape and c, 1/sr

        Raises
        ------
        DomainError
            If a direction is not above the surface, or no bin about it, or within `EDGE` of it, has a value.
        """
        total, found = self._gathered(theta_i_deg, theta_r_deg, phi_deg)
        if not np.all(total > 0):
            raise DomainError(f"{self.source}: no value about {np.count_nonzero(total <= 0)} of {total.size} directions")
        return found / total[..., None]

    def covers(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> NDArray[np.bool_]:
        """Say for which directions, as for a call, there is a value."""
        return self._gathered(theta_i_deg, theta_r_deg, phi_deg)[0] > 0

    def gridded(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Brdf:
        """Look up all directions of a grid; parameters and errors as for a call."""
        return Brdf.sampled(
            self, theta_i_deg, theta_r_deg, phi_deg, channels=self.channels, source=self.source, metadata={"format": "MERL"}
        )

    def _gathered(self, theta_i: ArrayLike, theta_r: ArrayLike, phi: ArrayLike) -> tuple[Array, Array]:
        """Weight of the bins with a value about each direction, and the sum of their weighted values."""
        half, diff, around = half_difference(theta_i, theta_r, phi)
        total, found = self._blended(half, diff, around)
        # Writers leave out bins whose middle is below the horizon: what reaches above it is told by the bin next to them.
        for inwards in range(1, math.ceil(EDGE) + 1):
            if np.any(bare := total <= 0):
                total[bare], found[bare] = self._blended(half[bare], diff[bare] - inwards, around[bare])
        return total, found

    def _blended(self, half: Array, diff: Array, around: Array) -> tuple[Array, Array]:
        places = (np.sqrt(90 * half), diff, np.mod(around, 180.0))
        lower = [np.floor(place - 0.5) for place in places]
        shares = [place - 0.5 - low for place, low in zip(places, lower, strict=True)]
        planes = self.values.shape[-1]
        total, found = np.zeros(half.shape), np.zeros((planes, *half.shape))
        values, valid = self.values.reshape(-1), self.valid.reshape(-1)  # flat, which is quicker than through their axes
        sides = []
        for low, share, count, round_ in zip(lower, shares, BINS, (False, False, True), strict=True):
            at = [(low + c).astype(np.intp) for c in (0, 1)]
            at = [np.mod(k, count) if round_ else np.clip(k, 0, count - 1) for k in at]
            sides.append(list(zip(at, (1 - share, share), strict=True)))
        for (j, share_j), (k, share_k), (m, share_m) in itertools.product(*sides):
            bins = (j * BINS[1] + k) * BINS[2] + m
            weight = share_j * share_k * share_m * valid[bins]
            total += weight
            for plane in range(planes):
                found[plane] += weight * values[planes * bins + plane]
        return total, np.moveaxis(found, 0, -1)


def half_difference(theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> tuple[Array, Array, Array]:
    """Turn the house's angles into Rusinkiewicz's.

    Parameters
    ----------
    theta_i_deg, theta_r_deg, phi_deg : array_like, deg
        Light, view and phi_r - phi_i.

    Returns
    -------
    theta_half, theta_diff, phi_diff : ndarray, of the broadcast shape, deg
        Of the half vector, and of the light about it; phi_diff from -180 to 180.

    Raises
    ------
    DomainError
        If a direction is not above the surface.
    """
    theta_i, theta_r, phi = np.broadcast_arrays(*(np.radians(np.asarray(a, float)) for a in (theta_i_deg, theta_r_deg, phi_deg)))
    most = np.pi / 2 + 1e-9
    if not np.all((theta_i >= 0) & (theta_i <= most) & (np.abs(theta_r) <= most) & np.isfinite(phi)):
        raise DomainError(
            "directions must be above the surface: expected 0 <= theta_i <= 90 and -90 <= theta_r <= 90 deg, and a finite phi"
        )
    light = np.stack([np.sin(theta_i), np.zeros(phi.shape), np.cos(theta_i)], axis=-1)
    view = np.stack([np.sin(theta_r) * np.cos(phi), np.sin(theta_r) * np.sin(phi), np.cos(theta_r)], axis=-1)
    half = light + view
    length = np.linalg.norm(half, axis=-1)
    # Opposite each other along the surface they have no half vector; the limit from above is the normal.
    half = np.where(length[..., None] > 1e-12, half, [0.0, 0.0, 1.0])
    across = np.hypot(half[..., 0], half[..., 1])
    theta_half, phi_half = np.arctan2(across, half[..., 2]), np.arctan2(half[..., 1], half[..., 0])
    # The light in the frame whose third axis is the half vector and whose second lies along the surface.
    x = np.cos(phi_half) * light[..., 0]
    y = -np.sin(phi_half) * light[..., 0]
    x, z = np.cos(theta_half) * x - np.sin(theta_half) * light[..., 2], np.sin(theta_half) * x + np.cos(theta_half) * light[..., 2]
    return np.degrees(theta_half), np.degrees(np.arctan2(np.hypot(x, y), z)), np.degrees(np.arctan2(y, x))


def directions(theta_half_deg: ArrayLike, theta_diff_deg: ArrayLike, phi_diff_deg: ArrayLike) -> tuple[Array, Array, Array]:
    """Turn Rusinkiewicz's angles into the house's.

    Parameters
    ----------
    theta_half_deg, theta_diff_deg, phi_diff_deg : array_like, deg
        Of the half vector, and of the light about it.

    Returns
    -------
    theta_i, theta_r, phi : ndarray, of the broadcast shape, deg
        Thetas 0 to 180, above 90 below the surface; phi -180 to 180.
    """
    half, diff, around = (np.radians(np.asarray(a, float)) for a in (theta_half_deg, theta_diff_deg, phi_diff_deg))
    x, y, z = np.sin(diff) * np.cos(around), np.sin(diff) * np.sin(around), np.cos(diff)
    light = (np.cos(half) * x + np.sin(half) * z, y, np.cos(half) * z - np.sin(half) * x)
    view = (np.sin(half) * z - np.cos(half) * x, -y, np.cos(half) * z + np.sin(half) * x)
    theta_i, theta_r = (np.arctan2(np.hypot(v[0], v[1]), v[2]) for v in (light, view))
    phi = np.arctan2(light[0] * view[1] - light[1] * view[0], light[0] * view[0] + light[1] * view[1])
    theta_i, theta_r, phi = np.broadcast_arrays(np.degrees(theta_i), np.degrees(theta_r), np.degrees(phi))
    return theta_i, theta_r, phi


def read_merl(path: str | Path) -> Merl:
    """Read a MERL file.

    Parameters
    ----------
    path : str or Path
        The file.

    Raises
    ------
    TableError
        If the file cannot be read, is of another kind or size, or holds something that is not a finite number; with the byte.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            header = file.read(HEADER)
            if len(header) < HEADER:
                raise TableError(path, f"ends at byte {len(header)}, within the header: expected a MERL file of {SIZE} bytes")
            shape = tuple(np.frombuffer(header, "<i4").tolist())
            if shape != BINS:
                raise TableError(path, f"byte 0: bins {shape}, expected {BINS}: not a MERL file of isotropic reflectance")
            # One byte more than there should be tells a file that is too long; nothing is read by what the file says of its size.
            content = file.read(SIZE - HEADER + 1)
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error
    if len(content) != SIZE - HEADER:
        what = f"ends at byte {HEADER + len(content)}" if len(content) < SIZE - HEADER else f"goes on after byte {SIZE}"
        raise TableError(path, f"{what}: expected {SIZE} bytes, three planes of {'x'.join(map(str, BINS))} float64")
    counts = np.frombuffer(content, "<f8").reshape(3, *BINS)
    if not np.all(finite := np.isfinite(counts)):
        first = int(np.flatnonzero(~finite.ravel())[0])
        raise TableError(path, f"byte {HEADER + 8 * first}: the value is {counts.flat[first]}, expected a finite number")
    valid = np.all(counts >= 0, axis=0)
    values = np.empty((*BINS, 3))
    np.multiply(counts.transpose(1, 2, 3, 0), UNITS, out=values)
    values[~valid] = 0
    if not np.all(np.isfinite(values)) or not valid.any():
        raise TableError(path, "no bin has a value: every one is below 0")
    values.flags.writeable = valid.flags.writeable = False
    return Merl(values, valid, str(path))


def write_merl(path: str | Path, function: Function | Brdf | Merl) -> None:
    """Write a MERL file.

    Parameters
    ----------
    path : str or Path
        The file; what is there is replaced once the new one is whole.
    function : callable
        f(theta_i, theta_r, phi) in deg -> 1/sr, of one channel (grey) or three (R, G, B): a `Reflectance`, a `Brdf` or any other. Where it
        has a method `covers` that says no, the file is marked to have no value. As the format knows no difference between light and view,
        the mean of f(i, r) and f(r, i) is written, unless the function says that it is `reciprocal`.

    Raises
    ------
    DomainError
        If the function's channels are neither grey nor RGB, or its answer is not finite, below 0 or of another shape.
    TableError
        If the file cannot be written.
    """
    if isinstance(function, Merl):
        counts = np.where(function.valid, function.values.transpose(3, 0, 1, 2) / UNITS[:, None, None, None], INVALID)
    else:
        counts = _counts(function)
    try:
        with replacing(path) as temporary, temporary.open("wb") as file:
            file.write(np.array(BINS, "<i4").tobytes())
            file.write(np.ascontiguousarray(counts, "<f8").data)
    except OSError as error:
        raise TableError(path, f"cannot be written: {error.strerror or error}") from error


def _counts(function: Function | Brdf) -> Array:
    """Planes of a file, shape (3, 90, 90, 180)."""
    names = channel_names(function)
    if len(names) != 1 and names != RGB:
        raise DomainError(f"a MERL file holds R, G, B, not {', '.join(names)}: choose one channel or convert to RGB")
    if getattr(function, "quantity", "brdf") != "brdf":
        raise DomainError("a MERL file holds reflection only, and this is transmission")
    half = (np.arange(90) + 0.5) ** 2 / 90
    diff, around = np.arange(90) + 0.5, np.arange(180) + 0.5
    counts = np.full((3, *BINS), INVALID)
    for start in range(0, 90, 15):
        part = slice(start, start + 15)
        theta_i, theta_r, phi = directions(half[part, None, None], diff[:, None], around)
        held = np.maximum(theta_i, theta_r) <= 90 + EDGE
        at = (np.minimum(theta_i[held], 90.0), np.minimum(theta_r[held], 90.0), phi[held])
        swapped = (at[1], at[0], -at[2])
        ways = [at] if getattr(function, "reciprocal", False) else [at, swapped]
        if (covers := getattr(function, "covers", None)) is not None:
            known = np.all([covers(*way) for way in ways], axis=0)
            held[held] = known
            ways = [(i[known], r[known], p[known]) for i, r, p in ways]
        if held.any():
            counts[:, part][:, held] = (sum(ask(function, *way, channels=3) for way in ways) / len(ways) / UNITS).T
    if not np.any(counts >= 0):
        raise DomainError("the function covers none of the directions of a MERL file")
    return counts
