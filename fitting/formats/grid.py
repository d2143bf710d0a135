"""What files of reflectance hold: values on a grid of directions, or a list of readings.

Directions follow the house's convention, in deg: theta from the normal on the light's side, 0 to 180 (above 90 is behind the sample), and
phi about it, so that phi_r - phi_i = 0 is the half-plane of the light.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError

Array = NDArray[np.float64]
Quantity = Literal["brdf", "btdf"]
Function = Callable[[Any, Any, Any], Any]
"""f(theta_i, theta_r, phi) in deg -> 1/sr, of their broadcast shape or with one more axis for channels; a `Reflectance` is one."""


AXES = (np.arange(0.0, 81, 10), np.arange(0.0, 86, 5), np.arange(0.0, 356, 5))
"""Where a function is asked for a list of readings: theta_i, theta_r and phi_r - phi_i, deg."""


@dataclass(frozen=True, eq=False)
class Brdf:
    """Values on a grid of directions.

    Parameters
    ----------
    theta_i_deg : ndarray, shape (i,), deg
        Light, 0 to 90, rising; above 90 lit from behind.
    phi_i_deg : ndarray, shape (k,), deg, or None
        Light's azimuth, rising; None for an isotropic sample, and then `phi_r_deg` counts from the light.
    theta_r_deg : ndarray, shape (r,), deg
        View, 0 to 180, rising.
    phi_r_deg : ndarray, shape (p,), deg
        View's azimuth, rising, within -360 to 360 and at most one turn. An isotropic one of 0 to 180 stands for both halves.
    values : ndarray, shape (i, r, p, c), or (i, k, r, p, c) where `phi_i_deg` is given, 1/sr
        Finite; below 0 only what a measurement's noise made so.
    quantity : {"brdf", "btdf"}
        What the file calls it.
    channels : tuple of str
        Name of each c, such as ("value",) or ("R", "G", "B").
    source : str
        Where they come from, for messages.
    metadata : mapping
        Whatever else the file says.

    Raises
    ------
    DomainError
        If shapes do not match, an axis does not rise or leaves its range, or a value is not finite.
    """

    theta_i_deg: Array
    phi_i_deg: Array | None
    theta_r_deg: Array
    phi_r_deg: Array
    values: Array
    quantity: Quantity = "brdf"
    channels: tuple[str, ...] = ("value",)
    source: str = "grid"
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        axes: list[Array] = []
        for name, low, high in (("theta_i", 0, 180), ("phi_i", -360, 360), ("theta_r", 0, 180), ("phi_r", -360, 360)):
            if name == "phi_i" and self.phi_i_deg is None:
                continue
            axis = _frozen(getattr(self, f"{name}_deg"), self.source, name)
            if axis.ndim != 1 or not axis.size or not np.all((axis >= low) & (axis <= high)) or np.any(np.diff(axis) <= 0):
                raise DomainError(f"{self.source}: {name} must be one rising list of angles within {low} to {high} deg, not {axis}")
            if name.startswith("phi") and axis[-1] - axis[0] > 360:
                raise DomainError(f"{self.source}: {name} spans {axis[-1] - axis[0]:g} deg, expected at most one turn")
            object.__setattr__(self, f"{name}_deg", axis)
            axes.append(axis)
        object.__setattr__(self, "channels", tuple(self.channels))
        values = _frozen(self.values, self.source, "values")
        expected = (*(axis.size for axis in axes), len(self.channels))
        if values.shape != expected:
            raise DomainError(f"{self.source}: values of shape {values.shape} do not match the axes, expected {expected}")
        object.__setattr__(self, "values", values)
        _check(self.source, self.quantity, self.channels, values)

    @classmethod
    def sampled(
        cls,
        function: Function,
        theta_i_deg: ArrayLike,
        theta_r_deg: ArrayLike,
        phi_deg: ArrayLike,
        *,
        channels: Sequence[str] = ("value",),
        quantity: Quantity = "brdf",
        source: str = "function",
        metadata: Mapping[str, Any] | None = None,
    ) -> Brdf:
        """Ask a function at every node of an isotropic grid.

        Parameters
        ----------
        function : callable
            See `Function`.
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            The axes.
        channels, quantity, source, metadata
            As in `Brdf`.

        Raises
        ------
        DomainError
            As `Brdf` and `ask` do.
        """
        theta_i, theta_r, phi = (np.atleast_1d(np.asarray(a, float)) for a in (theta_i_deg, theta_r_deg, phi_deg))
        values = ask(function, theta_i[:, None, None], theta_r[:, None], phi, channels=len(channels))
        return cls(theta_i, None, theta_r, phi, values, quantity, tuple(channels), source, metadata or {})

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look values up, linearly between nodes; this makes the grid a `Function`.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            theta_r below 0 is the view at -theta_r and phi + 180. phi = phi_r - phi_i, any angle. Where the sample is not isotropic, the
            light is at the grid's first phi_i.

        Returns
        -------
        ndarray, of the broadcast shape and a last axis for the channels, 1/sr
            At theta_r = 0 and theta_i = 0 as elsewhere: what the grid holds.

        Raises
        ------
        DomainError
            If a direction is outside the grid: nothing is extrapolated.
        """
        theta_i, theta_r, phi = self._directions(theta_i_deg, theta_r_deg, phi_deg)
        azimuths, table = self._turn
        corners = [
            _between("theta_i", self.theta_i_deg, theta_i, self.source),
            _between("theta_r", self.theta_r_deg, theta_r, self.source),
            _between("phi", azimuths, azimuths[0] + np.mod(phi - azimuths[0], 360.0), self.source),
        ]
        found = np.zeros((*theta_i.shape, len(self.channels)))
        for corner in np.ndindex(2, 2, 2):
            picked = [lower + c if len(axis) > 1 else lower for (axis, lower, _), c in zip(corners, corner, strict=True)]
            weight = np.prod([share if c else 1 - share for (_, _, share), c in zip(corners, corner, strict=True)], axis=0)
            found += weight[..., None] * table[tuple(picked)]
        return found

    def covers(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> NDArray[np.bool_]:
        """Say which directions the grid has values for.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            As for a call.

        Returns
        -------
        ndarray of bool, of the broadcast shape
        """
        theta_i, theta_r, phi = self._directions(theta_i_deg, theta_r_deg, phi_deg)
        inside = _inside(self.theta_i_deg, theta_i) & _inside(self.theta_r_deg, theta_r)
        azimuths, _ = self._turn
        return inside & _inside(azimuths, azimuths[0] + np.mod(phi - azimuths[0], 360.0))

    def _directions(self, theta_i: ArrayLike, theta_r: ArrayLike, phi: ArrayLike) -> tuple[Array, Array, Array]:
        """Broadcast, with theta_r 0 or more and phi on the grid's own count."""
        theta_i, theta_r, phi = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i, theta_r, phi)))
        phi = np.where(theta_r < 0, phi + 180, phi)
        return theta_i, np.abs(theta_r), phi if self.phi_i_deg is None else phi + self.phi_i_deg[0]

    @functools.cached_property
    def _turn(self) -> tuple[Array, Array]:
        """Azimuths and values (i, r, p, c) that they belong to, made a whole turn where the grid allows it."""
        table = self.values if self.phi_i_deg is None else self.values[:, 0]
        return _whole_turn(self.phi_r_deg, table, isotropic=self.phi_i_deg is None)


@dataclass(frozen=True, eq=False)
class Scattered:
    """Readings, each in its own direction.

    Parameters
    ----------
    theta_i_deg, phi_i_deg, theta_r_deg, phi_r_deg : ndarray, shape (n,), deg
        Light and view; thetas 0 to 180.
    values : ndarray, shape (n, c), 1/sr
    sigma : ndarray, shape (n, c), 1/sr, or None
        Standard uncertainties, 0 or more.
    channels, quantity, source, metadata
        As in `Brdf`.

    Raises
    ------
    DomainError
        If shapes do not match, a number is not finite, or an angle or sigma is out of its range.
    """

    theta_i_deg: Array
    phi_i_deg: Array
    theta_r_deg: Array
    phi_r_deg: Array
    values: Array
    sigma: Array | None = None
    channels: tuple[str, ...] = ("value",)
    quantity: Quantity = "brdf"
    source: str = "readings"
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        values = _frozen(self.values, self.source, "values")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "channels", tuple(self.channels))
        if values.ndim != 2 or values.shape[1] != len(self.channels):
            raise DomainError(f"{self.source}: values of shape {values.shape}, expected (n, {len(self.channels)})")
        for name in ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg"):
            angles = _frozen(getattr(self, name), self.source, name)
            if angles.shape != values.shape[:1]:
                raise DomainError(f"{self.source}: {name} of shape {angles.shape}, expected {values.shape[:1]}, one for each reading")
            if not np.all(np.isfinite(angles)) or (name.startswith("theta") and not np.all((angles >= 0) & (angles <= 180))):
                raise DomainError(f"{self.source}: {name} must be finite, a theta within 0 to 180 deg")
            object.__setattr__(self, name, angles)
        _check(self.source, self.quantity, self.channels, values)
        if self.sigma is not None:
            sigma = _frozen(self.sigma, self.source, "sigma")
            if sigma.shape != values.shape or not np.all(np.isfinite(sigma) & (sigma >= 0)):
                raise DomainError(f"{self.source}: sigma must be finite, 0 or more and of shape {values.shape}")
            object.__setattr__(self, "sigma", sigma)

    def __len__(self) -> int:
        return len(self.values)


def readings(data: Function | Brdf | Scattered, axes: Sequence[Array] = AXES) -> Scattered:
    """List what is to be written, reading by reading.

    Parameters
    ----------
    data : callable, Brdf or Scattered
        A function is asked at every combination of `axes`; a grid is written node by node.
    axes : sequence of three ndarray, deg
        theta_i, theta_r and phi_r - phi_i.

    Raises
    ------
    DomainError
        If the function is no BRDF.
    """
    if isinstance(data, Scattered):
        return data
    grid = data if isinstance(data, Brdf) else Brdf.sampled(data, *axes)
    phi_i = np.zeros(1) if grid.phi_i_deg is None else grid.phi_i_deg
    nodes = np.meshgrid(grid.theta_i_deg, phi_i, grid.theta_r_deg, grid.phi_r_deg, indexing="ij")
    return Scattered(
        theta_i_deg=nodes[0].ravel(),
        phi_i_deg=nodes[1].ravel(),
        theta_r_deg=nodes[2].ravel(),
        phi_r_deg=nodes[3].ravel(),
        values=grid.values.reshape(-1, len(grid.channels)),
        channels=grid.channels,
        quantity=grid.quantity,
        source=grid.source,
        metadata=grid.metadata,
    )


def channel_names(function: Function) -> tuple[str, ...]:
    """Find how many values a function answers with, and what they are called.

    Parameters
    ----------
    function : callable
        See `Function`. If it has no attribute `channels`, it is asked for one direction.

    Returns
    -------
    tuple of str
        ("value",) for one, ("R", "G", "B") for three, numbers from 0 for more.

    Raises
    ------
    DomainError
        If it answers with anything else.
    """
    if (names := getattr(function, "channels", None)) is not None:
        return tuple(names)
    shape = np.shape(function(np.array([45.0]), np.array([30.0]), np.array([90.0])))
    if shape == (1,):
        return ("value",)
    if len(shape) != 2 or shape[0] != 1 or shape[1] < 1:
        raise DomainError(f"the function answered for one direction with shape {shape}, expected (1,) or (1, channels)")
    return {1: ("value",), 3: ("R", "G", "B")}.get(shape[1], tuple(map(str, range(shape[1]))))


def ask(function: Function, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike, *, channels: int = 1) -> Array:
    """Call a function for what a file is to hold.

    Parameters
    ----------
    function : callable
        See `Function`.
    theta_i_deg, theta_r_deg, phi_deg : array_like, deg
        Directions.
    channels : int
        How many it is to answer with; a function of one answers for all.

    Returns
    -------
    ndarray, of the broadcast shape and a last axis for the channels, 1/sr

    Raises
    ------
    DomainError
        If the function is no BRDF in 1/sr, or its answer is of another shape, not finite or below 0.
    """
    if getattr(function, "mode", "1/sr") != "1/sr":
        raise DomainError(f"a file of reflectance holds 1/sr, and this is {function.mode!r}: choose a model in 1/sr")  # type: ignore[attr-defined]
    shape = np.broadcast_shapes(np.shape(theta_i_deg), np.shape(theta_r_deg), np.shape(phi_deg))
    values = np.asarray(function(theta_i_deg, theta_r_deg, phi_deg), float)
    if values.shape == shape:
        values = values[..., None]
    if values.shape[:-1] != shape or values.shape[-1] not in (1, channels):
        raise DomainError(f"the function answered with shape {values.shape}, expected {shape} or {(*shape, channels)}")
    if not np.all(np.isfinite(values) & (values >= 0)):
        bad = values[~(np.isfinite(values) & (values >= 0))].flat[0]
        raise DomainError(f"the function answered with {bad:g}, expected finite values of 0 or more in 1/sr")
    return np.broadcast_to(values, (*shape, channels))


def _frozen(values: ArrayLike, source: str, name: str) -> Array:
    """Make a read-only array of numbers, so that a frozen grid stays what it was when it was checked."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise DomainError(f"{source}: {name} must be numbers: {error}") from error
    view = array.view()
    view.flags.writeable = False
    return view


def _check(source: str, quantity: str, channels: tuple[str, ...], values: Array) -> None:
    if quantity not in ("brdf", "btdf"):
        raise DomainError(f"{source}: unknown quantity {quantity!r}, expected 'brdf' or 'btdf'")
    if not channels or len(set(channels)) < len(channels):
        raise DomainError(f"{source}: channels must be named, each differently, not {channels}")
    if not np.all(np.isfinite(values)):
        raise DomainError(f"{source}: {np.count_nonzero(~np.isfinite(values))} of {values.size} values are not finite numbers")


def _whole_turn(azimuths: Array, table: Array, *, isotropic: bool) -> tuple[Array, Array]:
    """Mirror an isotropic half-turn, and close what is almost a turn; azimuths are the axis before the last."""
    if len(azimuths) < 2:
        return azimuths, table
    if isotropic and azimuths[0] == 0 and azimuths[-1] <= 180:
        twin = slice(None, 0, -1)
        azimuths, table = np.append(-azimuths[twin], azimuths), np.concatenate([table[..., twin, :], table], axis=-2)
    gap = azimuths[0] + 360 - azimuths[-1]
    if 0 < gap <= 1.5 * np.max(np.diff(azimuths)):
        azimuths, table = np.append(azimuths, azimuths[0] + 360), np.concatenate([table, table[..., :1, :]], axis=-2)
    return azimuths, table


def _inside(axis: Array, at: Array) -> NDArray[np.bool_]:
    return (at >= axis[0] - 1e-9) & (at <= axis[-1] + 1e-9)


def _between(name: str, axis: Array, at: Array, source: str) -> tuple[Array, NDArray[np.intp], Array]:
    """Axis, lower node and share of the upper one, or refuse."""
    if not np.all(inside := _inside(axis, at)):
        bad = at[~inside].flat[0]
        raise DomainError(f"{source}: {name} = {bad:g} deg is outside the grid, which has {axis[0]:g} to {axis[-1]:g} deg")
    if len(axis) == 1:
        return axis, np.zeros(at.shape, np.intp), np.zeros(at.shape)
    lower = np.clip(np.searchsorted(axis, at, side="right") - 1, 0, len(axis) - 2)
    return axis, lower, np.clip((at - axis[lower]) / (axis[lower + 1] - axis[lower]), 0, 1)
