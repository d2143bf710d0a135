"""RGL's tensor files (.bsdf): measured reflectance as Mitsuba's material `measured` and pbrt's `MeasuredBxDF` load it.

A table of named arrays, their places and shapes, then the arrays. Values lie over the half vector m of light and view, at (u, v) with
theta_m = u^2 pi/2 and phi_m = (2 v - 1) pi, phi_m counted from the light where the sample is isotropic, one picture for each direction of
the light. In a measured file the pictures are warped so that the sample's facets (`vndf`) lie evenly, and divided by their number (`ndf`)
over the area seen (`sigma`); a file written here has neither warp nor division: its values are f_r cos(theta_r).

Source: J. Dupuy, W. Jakob 2018, "An adaptive parameterization for efficient material acquisition and rendering",
doi:10.1145/3272127.3275059.
"""

from __future__ import annotations

import functools
import math
import mmap
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError, TableError
from fitting.formats import replacing
from fitting.formats.grid import Brdf, Function, ask, channel_names

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

MAGIC = b"tensor_file\0"
VERSION = (1, 0)
DTYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<u8", 8: "<i8", 9: "<f2", 10: "<f4", 11: "<f8"}
ALIGN = 8
RGB = ("R", "G", "B")
MOST_AXES = 32
"""Axes of an array; numpy takes no more everywhere."""

LIGHTS_DEG = 90 * (1 - (1 - np.linspace(0, 1, 33)) ** 1.5)
"""Light's angles of a file: closer towards grazing, where a domed surface changes quickly."""

FLATTEST_DEG = 89.99
"""Largest view angle that f_r cos(theta_r) can be divided by its cosine at."""

FLOOR = 1e-3
"""Share of its mean that is added to what views are drawn by, so that none is left out."""


@dataclass(frozen=True, eq=False)
class Rgl:
    """An RGL file's reflectance; a callable of the three angles.

    Attributes
    ----------
    theta_i_deg : ndarray, shape (t,), deg
        Light's angles.
    phi_i_deg : ndarray, shape (p,), deg
        Its azimuths; two or fewer where the sample is isotropic.
    ndf, sigma : ndarray of float32, shape (a, b)
        Density of facets over m, and their area seen from the light's direction.
    vndf : ndarray of float32, shape (p, t, v, u)
        Density of facets that the light sees.
    values : ndarray of float32, shape (p, t, c, n, n)
        The pictures.
    luminance : ndarray of float32, shape (p, t, n, n)
        What views are drawn by.
    divided : bool
        Whether the pictures are divided by ndf / (4 sigma), the file's `jacobian`.
    channels : tuple of str
        "R", "G", "B", or wavelengths such as "550 nm".
    description : str
    source : str
        The file.
    """

    theta_i_deg: Array
    phi_i_deg: Array
    ndf: Singles
    sigma: Singles
    vndf: Singles
    values: Singles
    luminance: Singles
    divided: bool
    channels: tuple[str, ...]
    description: str = ""
    source: str = "RGL"

    @property
    def isotropic(self) -> bool:
        """Whether values depend on phi_r - phi_i alone."""
        return len(self.phi_i_deg) <= 2

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """As `evaluate`, with the light at phi_i = 0."""
        return self.evaluate(theta_i_deg, 0.0, theta_r_deg, phi_deg)

    def covers(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> NDArray[np.bool_]:
        """Say for which directions, as for a call, there is a value."""
        theta_i, theta_r, phi = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i_deg, theta_r_deg, phi_deg)))
        first, last = self.theta_i_deg[[0, -1]]
        return (theta_i >= first - 1e-4) & (theta_i <= last + 1e-4) & (np.abs(theta_r) <= FLATTEST_DEG) & np.isfinite(phi)

    def evaluate(self, theta_i_deg: ArrayLike, phi_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_r_deg: ArrayLike) -> Array:
        """Look the reflectance up.

        Parameters
        ----------
        theta_i_deg, phi_i_deg : array_like, deg
            Light, its theta within the file's.
        theta_r_deg, phi_r_deg : array_like, deg
            View, its theta below 89.99; a theta below 0 is the view at -theta_r and phi_r + 180.

        Returns
        -------
        ndarray, of the broadcast shape and c, 1/sr

        Raises
        ------
        DomainError
            If a direction is outside the file's.
        """
        angles = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i_deg, phi_i_deg, theta_r_deg, phi_r_deg)))
        if not np.all(self.covers(angles[0], angles[2], angles[3] - angles[1])):
            raise DomainError(
                f"{self.source}: a direction is outside the file: it has theta_i of {self.theta_i_deg[0]:g} to {self.theta_i_deg[-1]:g}, "
                f"and theta_r below {FLATTEST_DEG:g} deg"
            )
        theta_i, phi_i, theta_r, phi_r = (np.radians(a).ravel() for a in angles)
        light, view = _vector(theta_i, phi_i), _vector(theta_r, phi_r)
        if not self.isotropic and (turns := round(360 / (self.phi_i_deg[-1] - self.phi_i_deg[0]))) >= 2:
            # Half or a quarter of the azimuths stand for all; the file's are those below 0.
            sign_y = np.where(np.signbit(light[1]), 1.0, -1.0)
            sign_x = np.where(np.signbit(light[0]), 1.0, -1.0) if turns == 4 else sign_y
            for vector in (light, view):
                vector[0] *= sign_x
                vector[1] *= sign_y
        half = light + view
        half /= np.linalg.norm(half, axis=0)
        azimuth_i, azimuth = np.arctan2(light[1], light[0]), np.arctan2(half[1], half[0])
        u = np.sqrt(np.arctan2(np.hypot(half[0], half[1]), half[2]) * 2 / np.pi)
        v = np.mod(((azimuth - azimuth_i if self.isotropic else azimuth) + np.pi) / (2 * np.pi), 1.0)
        slices = self._slices(azimuth_i, theta_i)
        if self._warped:
            s, t = self._unwarped(u, v, slices)
        else:
            s, t = u, v
        found = _looked_up(self.values, s, t, slices)
        if self.divided:
            u_i, v_i = np.sqrt(theta_i * 2 / np.pi), np.mod((azimuth_i + np.pi) / (2 * np.pi), 1.0)
            alone: list[tuple[Any, Any, Any]] = [(0, 0, 1.0)]
            facets = _looked_up(self.ndf[None, None, None], u, v, alone)
            found *= facets / (4 * _looked_up(self.sigma[None, None, None], u_i, v_i, alone))
        return (found / view[2][:, None]).reshape(*angles[0].shape, len(self.channels))

    def gridded(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Brdf:
        """Look up all directions of a grid, with the light at phi_i = 0; parameters and errors as for a call."""
        about = {"format": "RGL", "description": self.description}
        return Brdf.sampled(self, theta_i_deg, theta_r_deg, phi_deg, channels=self.channels, source=self.source, metadata=about)

    def _slices(self, phi_i: Array, theta_i: Array) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
        """Pictures about each direction of the light: places along phi_i and theta_i, and weights."""
        around = [_neighbours(np.radians(self.phi_i_deg), phi_i), _neighbours(np.radians(self.theta_i_deg), theta_i)]
        return [(p, t, wp * wt) for p, wp in around[0] for t, wt in around[1]]

    @functools.cached_property
    def _warped(self) -> bool:
        """Whether facets are anything but even."""
        return bool(np.any(self.vndf != self.vndf.flat[0]))

    @functools.cached_property
    def _cumulated(self) -> tuple[Array, Array, Array]:
        """Density of facets, each picture's integral 1; its integrals along u from 0, shape (p, t, v, u); and of those along v."""
        density = self.vndf.astype(float)
        density /= _running(_running(density)[..., -1])[..., -1, None, None]
        along = _running(density)
        return density, along, _running(along[..., -1])

    def _unwarped(self, u: Array, v: Array, slices: list[tuple[Any, Any, Any]]) -> tuple[Array, Array]:
        """Where the facet at (u, v) lies in the pictures: the shares of facets below it, first over v, then over u."""
        density, along, above = self._cumulated
        rows, columns = density.shape[-2:]
        (row, y), (column, x) = _cell(v, rows), _cell(u, columns)

        def mixed(table: Array, *at: NDArray[np.intp]) -> Array:
            return sum((w * table[(p, t, *at)] for p, t, w in slices), start=np.zeros(u.shape))

        ends = np.full(column.shape, columns - 1)
        r0, r1 = mixed(along, row, ends), mixed(along, row + 1, ends)
        c0 = (1 - y) * mixed(density, row, column) + y * mixed(density, row + 1, column)
        c1 = (1 - y) * mixed(density, row, column + 1) + y * mixed(density, row + 1, column + 1)
        begun = (1 - y) * mixed(along, row, column) + y * mixed(along, row + 1, column)
        facets = (1 - y) * r0 + y * r1
        some = facets > 0  # where there are none, any order among them will do
        s = np.where(some, (begun + x * (c0 + x * (c1 - c0) / 2) / (columns - 1)) / np.where(some, facets, 1.0), u)
        t = mixed(above, row) + y * (r0 + y * (r1 - r0) / 2) / (rows - 1)
        return np.clip(s, 0, 1), np.clip(t, 0, 1)  # no more than rounding is cut off


@dataclass(frozen=True)
class _Entry:
    """One array of a tensor file: where its entry and its numbers are, and of what kind."""

    name: str
    at: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


@dataclass(frozen=True, eq=False)
class _Tensors:
    """An open tensor file; its arrays are read when asked for."""

    path: Path
    data: bytes | mmap.mmap
    entries: dict[str, _Entry] = field(default_factory=dict)

    def __post_init__(self) -> None:
        head = len(MAGIC) + 6
        if self.data[: len(MAGIC)] != MAGIC:
            raise TableError(self.path, f"byte 0: begins with {bytes(self.data[:12])!r}, expected {MAGIC!r}: not an RGL file")
        version, count = tuple(self._taken("<2B", len(MAGIC))), self._taken("<I", len(MAGIC) + 2)[0]
        if version != VERSION:
            raise TableError(self.path, f"byte {len(MAGIC)}: version {version}, expected {VERSION}")
        at = head
        for _ in range(count):
            at = self._enter(at)

    def _taken(self, form: str, at: int) -> tuple[int, ...]:
        size = struct.calcsize(form)
        if at + size > len(self.data):
            raise TableError(self.path, f"ends at byte {len(self.data)}, within its table of arrays: it is cut short")
        return struct.unpack(form, self.data[at : at + size])

    def _enter(self, begin: int) -> int:
        """Note the array whose entry begins here; return where the next one does."""
        (length,) = self._taken("<H", begin)
        raw = bytes(self._taken(f"<{length}B", begin + 2))
        at = begin + 2 + length
        axes, kind = self._taken("<HB", at)
        (offset,) = self._taken("<Q", at + 3)
        name = raw.decode("utf-8", "backslashreplace")
        if kind not in DTYPES or axes > MOST_AXES:
            raise TableError(
                self.path, f"byte {at}: array {name!r} has {axes} axes of type {kind}, expected {MOST_AXES} at most of 1 to 11"
            )
        entry = _Entry(name, begin, np.dtype(DTYPES[kind]), self._taken(f"<{axes}Q", at + 11), offset)
        if name in self.entries:
            raise TableError(self.path, f"byte {begin}: array {name!r} is there twice")
        if offset + entry.size > len(self.data):
            raise TableError(
                self.path,
                f"byte {begin}: array {name!r} of shape {entry.shape} would end at byte {offset + entry.size}, "
                f"but the file ends at byte {len(self.data)}: it is cut short or no RGL file",
            )
        self.entries[name] = entry
        return at + 11 + 8 * axes

    def array(self, name: str, dtype: str, shape: Sequence[int | None]) -> NDArray[Any]:
        """Read an array that must be there, of finite numbers; None stands for any length of an axis but 0."""
        entry = self.entries.get(name)
        if entry is None:
            raise TableError(self.path, f"has no array {name!r}; it has {', '.join(map(repr, self.entries)) or 'none'}")
        wanted = "x".join("n" if n is None else str(n) for n in shape)
        fits = len(entry.shape) == len(shape) and all(m > 0 and n in (None, m) for m, n in zip(entry.shape, shape, strict=True))
        if entry.dtype != np.dtype(dtype) or not fits:
            raise TableError(
                self.path,
                f"byte {entry.at}: array {name!r}: {entry.dtype.name} of shape {entry.shape}, expected {np.dtype(dtype).name} of {wanted}",
            )
        numbers = np.frombuffer(self.data[entry.offset : entry.offset + entry.size], entry.dtype).reshape(entry.shape)
        if numbers.dtype.kind == "f" and not np.all(finite := np.isfinite(numbers)):
            first = int(np.flatnonzero(~finite.ravel())[0])
            at = entry.offset + first * entry.dtype.itemsize
            raise TableError(self.path, f"byte {at}: array {name!r} holds {numbers.flat[first]}, expected finite numbers")
        return numbers

    def refuse(self, name: str, problem: str) -> TableError:
        return TableError(self.path, f"byte {self.entries[name].offset}: array {name!r} {problem}")


def read_rgl(path: str | Path) -> Rgl:
    """Read an RGL file.

    Parameters
    ----------
    path : str or Path
        The file; where it has both, R, G, B are read rather than the spectrum.

    Raises
    ------
    TableError
        If the file cannot be read, is of another kind, cut short, or holds what makes no reflectance; with the byte.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise TableError(path, f"byte 0: does not begin with {MAGIC!r}: not an RGL file")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                return _reflectance(_Tensors(path, data))
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error


def _reflectance(file: _Tensors) -> Rgl:
    """Take the arrays of a reflectance out of a tensor file."""
    theta_i, phi_i = (file.array(name, "<f4", [None]) for name in ("theta_i", "phi_i"))
    for name, axis, low, high in (("theta_i", theta_i, 0, np.pi / 2), ("phi_i", phi_i, -2 * np.pi, 2 * np.pi)):
        if np.any(np.diff(axis) <= 0) or axis[0] < low - 1e-5 or axis[-1] > high + 1e-5:
            raise file.refuse(name, f"must rise within {low:.4g} to {high:.4g} rad")
    lights = [len(phi_i), len(theta_i)]
    ndf, sigma = (file.array(name, "<f4", [None, None]) for name in ("ndf", "sigma"))
    vndf = file.array("vndf", "<f4", [*lights, None, None])
    channels: tuple[str, ...]
    if "rgb" in file.entries:
        pictures, channels = "rgb", RGB
    else:
        pictures = "spectra"
        channels = tuple(f"{nm:.6g} nm" for nm in file.array("wavelengths", "<f4", [None]))
    values = file.array(pictures, "<f4", [*lights, len(channels), None, None])
    if values.shape[3] != values.shape[4]:
        raise file.refuse(pictures, f"has pictures of shape {values.shape[3:]}, expected squares")
    luminance = file.array("luminance", "<f4", [*lights, *values.shape[3:]])
    divided = bool(file.array("jacobian", "u1", [1])[0])
    for name, table in (("ndf", ndf), ("sigma", sigma), ("vndf", vndf), (pictures, values)):
        if min(table.shape[-2:]) < 2:
            raise file.refuse(name, f"has pictures of shape {table.shape[-2:]}, expected two or more each way")
    if len(set(channels)) < len(channels):
        raise file.refuse("wavelengths", "has one twice")
    if np.any(vndf < 0) or not np.all(vndf.any(axis=(2, 3))):
        raise file.refuse("vndf", "must be 0 or more, and more somewhere in every picture")
    if divided and np.any(sigma <= 0):
        raise file.refuse("sigma", "must be more than 0")
    lit, around = (np.degrees(axis.astype(float)) for axis in (theta_i, phi_i))
    said = file.array("description", "u1", [None]).tobytes().decode("utf-8", "replace")
    return Rgl(lit, around, ndf, sigma, vndf, values, luminance, divided, channels, said, str(file.path))


def write_rgl(
    path: str | Path,
    function: Function | Brdf,
    *,
    wavelengths_nm: Sequence[float] | None = None,
    theta_i_deg: ArrayLike | None = None,
    resolution: int = 128,
    description: str = "",
) -> None:
    """Write an RGL file.

    Parameters
    ----------
    path : str or Path
        The file; what is there is replaced once the new one is whole.
    function : callable
        f(theta_i, theta_r, phi) in deg -> 1/sr, of one channel (grey), three (R, G, B) or one for each wavelength. As renderers that
        follow paths from the eye take theta_i for the view's, it is drawn as it is only if light and view may be swapped. Pictures end at
        the horizon and are linear across it: within 2 deg of it the file's f_r is coarse, though not the light it stands for.
    wavelengths_nm : sequence of float, optional
        Of the function's channels, rising; a grey function needs two or more that enclose what will be rendered. With them a spectral file
        is written, for Mitsuba's spectral variants and pbrt, without them one of R, G, B for Mitsuba's RGB variants: neither loads both.
    theta_i_deg : array_like, deg, optional
        Light's angles, rising within 0 to 90; by default `LIGHTS_DEG`.
    resolution : int
        Points along either side of a picture.
    description : str
        What the file says it is.

    Raises
    ------
    DomainError
        If channels, angles or resolution are not as above, or the function's answer is not finite, below 0 or of another shape.
    TableError
        If the file cannot be written.
    """
    names = channel_names(function)
    if getattr(function, "quantity", "brdf") != "brdf":
        raise DomainError("an RGL file holds reflection only, and this is transmission")
    if not 2 <= resolution <= 4096:
        raise DomainError(f"resolution must be 2 to 4096 points, not {resolution}")
    lights = np.atleast_1d(np.asarray(LIGHTS_DEG if theta_i_deg is None else theta_i_deg, float))
    if lights.ndim != 1 or not np.all(np.diff(lights) > 0) or not np.all((lights >= 0) & (lights <= 90)):
        raise DomainError(f"theta_i must rise within 0 to 90 deg, not {lights}")
    arrays: dict[str, NDArray[Any]] = {
        "description": np.frombuffer((description or "reflectance").encode(), np.uint8),
        "theta_i": np.radians(lights).astype("<f4"),
        "phi_i": np.zeros(1, "<f4"),
        "ndf": np.ones((2, 2), "<f4"),
        "sigma": np.full((2, 2), 0.25, "<f4"),
        "vndf": np.ones((1, len(lights), 2, 2), "<f4"),
        "jacobian": np.zeros(1, np.uint8),
    }
    if wavelengths_nm is not None:
        waves = np.asarray(wavelengths_nm, float)
        rising = waves.ndim == 1 and waves.size and np.all(np.diff(waves) > 0) and np.all((waves > 0) & (waves < 1e6))
        if not rising or len(names) not in (1, waves.size):
            raise DomainError(f"the function has {len(names)} channels: expected as many wavelengths in nm, rising, not {waves}")
    elif len(names) != 1 and names != RGB:
        raise DomainError(f"the channels {', '.join(names)} are neither grey nor R, G, B: give their wavelengths")
    pictures, arrays["luminance"] = _pictures(function, lights, resolution, len(names))
    if wavelengths_nm is None:
        arrays["rgb"] = np.broadcast_to(pictures, (1, len(lights), 3, resolution, resolution))
    else:
        arrays["wavelengths"] = waves.astype("<f4")
        arrays["spectra"] = np.broadcast_to(pictures, (1, len(lights), len(waves), resolution, resolution))
    try:
        with replacing(path) as temporary:
            _write_tensors(temporary, arrays)
    except OSError as error:
        raise TableError(path, f"cannot be written: {error.strerror or error}") from error


def _pictures(function: Function, lights: Array, resolution: int, channels: int) -> tuple[Singles, Singles]:
    """f_r cos(theta_r), shape (1, t, c, n, n), and what views are drawn by, (1, t, n, n)."""
    u = np.linspace(0, 1, resolution)
    theta_m = u**2 * np.pi / 2
    half = _vector(theta_m, ((2 * u - 1) * np.pi)[:, None])
    pictures = np.zeros((1, len(lights), channels, resolution, resolution), "<f4")
    luminance = np.zeros((1, len(lights), resolution, resolution), "<f4")
    for k, theta_i in enumerate(lights):
        light = _vector(np.radians(theta_i), 0.0)
        seen = np.tensordot(light, half, 1)
        view = 2 * seen * half - light[:, None, None]
        above = (seen > 0) & (view[2] > 0)
        x, y, z = (component[above] for component in view)
        theta_r, phi = np.degrees(np.arctan2(np.hypot(x, y), z)), np.degrees(np.arctan2(y, x))
        sent = ask(function, np.full(theta_r.shape, theta_i), np.minimum(theta_r, 90.0), phi, channels=channels) * z[:, None]
        pictures[0, k][:, above] = sent.T
        # Solid angle of the view for an area of the picture.
        spread = 4 * seen * np.sin(theta_m) * 2 * np.pi**2 * u
        mean = sent.mean(axis=1)
        luminance[0, k][above] = (mean + FLOOR * (mean.mean() if mean.any() else 1.0)) * spread[above]
        if not luminance[0, k].any():
            luminance[0, k] = 1.0  # light along the surface has next to no view, but a picture must have something to draw by
    return pictures, luminance


def _write_tensors(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write named arrays as a tensor file."""
    kinds = {np.dtype(form): kind for kind, form in DTYPES.items()}
    names = {name: name.encode() for name in arrays}
    offset = len(MAGIC) + 6 + sum(13 + len(names[name]) + 8 * array.ndim for name, array in arrays.items())
    with path.open("wb") as file:
        file.write(MAGIC + struct.pack("<2BI", *VERSION, len(arrays)))
        for name, array in arrays.items():
            offset += -offset % ALIGN
            file.write(struct.pack("<H", len(names[name])) + names[name])
            file.write(struct.pack(f"<HBQ{array.ndim}Q", array.ndim, kinds[array.dtype], offset, *array.shape))
            offset += array.nbytes
        for array in arrays.values():
            file.write(bytes(-file.tell() % ALIGN))
            file.write(np.ascontiguousarray(array).data)


def _vector(theta: ArrayLike, phi: ArrayLike) -> Array:
    """Unit vectors, shape (3, ...), from angles in rad."""
    theta, phi = np.asarray(theta, float), np.asarray(phi, float)
    across = np.sin(theta)
    return np.stack(np.broadcast_arrays(across * np.cos(phi), across * np.sin(phi), np.cos(theta)))


def _neighbours(axis: Array, at: Array) -> list[tuple[NDArray[np.intp], Array]]:
    """Nodes about each place and their weights; beyond the ends, the end."""
    if len(axis) == 1:
        return [(np.zeros(at.shape, np.intp), np.ones(at.shape))]
    lower = np.clip(np.searchsorted(axis, at, side="right") - 1, 0, len(axis) - 2)
    share = np.clip((at - axis[lower]) / (axis[lower + 1] - axis[lower]), 0, 1)
    return [(lower, 1 - share), (lower + 1, share)]


def _cell(at: Array, points: int) -> tuple[NDArray[np.intp], Array]:
    """Cell between evenly spaced points over 0 to 1, and the place within it."""
    scaled = at * (points - 1)
    lower = np.clip(scaled.astype(np.intp), 0, points - 2)
    return lower, scaled - lower


def _looked_up(pictures: Singles, u: Array, v: Array, slices: list[tuple[Any, Any, Any]]) -> Array:
    """Bilinear values of pictures (p, t, c, v, u), mixed over slices; shape (n, c)."""
    (row, y), (column, x) = _cell(v, pictures.shape[-2]), _cell(u, pictures.shape[-1])
    channels, rows, columns = pictures.shape[2:]
    planes = pictures.reshape(-1)  # one number at a time out of a flat array: several times quicker than through five axes
    found = np.zeros((channels, len(u)))
    for p, t, weight in slices:
        picture = (p * pictures.shape[1] + t) * channels
        for dy, wy in ((0, 1 - y), (1, y)):
            for dx, wx in ((0, 1 - x), (1, x)):
                share, place = weight * wy * wx, (picture * rows + row + dy) * columns + column + dx
                for c in range(channels):
                    found[c] += share * planes.take(place + c * rows * columns)
    return found.T


def _running(table: Array) -> Array:
    """Integral of what is linear between points evenly spaced over 0 to 1, from 0 to each, along the last axis."""
    steps = (table[..., 1:] + table[..., :-1]) / 2 / (table.shape[-1] - 1)
    return np.concatenate([np.zeros((*table.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)
