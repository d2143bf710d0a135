"""The whole hemisphere, as most renderers' files want it: readings put onto a grid, and a say on what lies beyond the grid's end."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError
from fitting.formats.grid import Array, Brdf, Function, Quantity, Scattered
from fitting.formats.merl import BINS, Merl, directions
from fitting.formats.rgl import FLATTEST_DEG, Rgl

Beyond = Literal["refuse", "nearest", "zero"]
BEYOND: tuple[Beyond, ...] = ("refuse", "nearest", "zero")

WIDEST_GAP_DEG = 46.0
"""Between neighbouring azimuths: those of the innermost ring of a Klems matrix are 45 deg apart."""

AZIMUTHS = np.arange(0.0, 360.0, 5.0)
"""Where readings are put whose azimuths differ from one theta to the next."""

DIGITS = 6
"""Angles that agree to so many decimals, deg, are one: files round them."""

ROOM_DEG = 0.01 + 1e-9
"""How far from 0 or 90 deg an RGL file may end, which is in single precision and looked up to 89.99 deg."""


class BeyondError(DomainError):
    """A direction lies beyond the end of the readings, and nobody has said what is there."""


def gridded(data: Scattered) -> Brdf:
    """Put readings of a whole turn onto an isotropic grid.

    Parameters
    ----------
    data : Scattered
        At every pair of a theta_i and a theta_r, azimuths all around, or from 0 to 180 deg, at most `WIDEST_GAP_DEG` apart; where either
        theta is 0, one is enough. This holds for each azimuth of the light.

    Returns
    -------
    Brdf
        Without the uncertainties; the mean over the light's azimuths, which its metadata's "azimuths" counts. "filled_in" says whether
        values had to be interpolated, straight along phi, because azimuths differ from pair to pair.

    Raises
    ------
    DomainError
        If the readings are no such grid.
    """
    theta_i, i = np.unique(np.round(data.theta_i_deg, DIGITS), return_inverse=True)
    theta_r, r = np.unique(np.round(data.theta_r_deg, DIGITS), return_inverse=True)
    phi = _azimuths(data.phi_r_deg - data.phi_i_deg)
    pair = i * len(theta_r) + r
    there = np.unique(pair)
    if len(there) < len(theta_i) * len(theta_r):
        k = int(np.argmin(np.append(there, -1) == np.arange(len(there) + 1)))  # the first that is missing
        raise _no_hemisphere(data, f"none at theta_i {theta_i[k // len(theta_r)]:g}, theta_r {theta_r[k % len(theta_r)]:g} deg")
    pole = np.isin(theta_i, (0, 180))[:, None] | np.isin(theta_r, (0, 180))
    turns: list[tuple[Array, Array]] = []
    filled_in = False
    for k, at in enumerate(_groups(pair)):
        alone = pole.flat[k]  # any azimuth is the same direction
        each = [_turn(phi[one], data.values[one]) for one in _lights(data, at)]
        if not alone and (gap := max(_widest_gap(azimuths) for azimuths, _ in each)) > WIDEST_GAP_DEG:
            where = f"theta_i {theta_i[k // len(theta_r)]:g}, theta_r {theta_r[k % len(theta_r)]:g} deg"
            raise _no_hemisphere(data, f"at {where} none over {gap:g} deg of azimuth")
        filled_in |= not alone and not _alike(each)
        axis = each[0][0] if _alike(each) else AZIMUTHS
        turns.append((axis, np.mean([_at(axis, *turn) for turn in each], axis=0)))
    around = [turn for turn, alone in zip(turns, pole.flat, strict=True) if not alone]
    axis = around[0][0] if around and _alike(around) else AZIMUTHS
    filled_in |= not _alike(around)
    table = [_at(axis, *turn) for turn in turns]
    lights = np.unique(_azimuths(data.phi_i_deg[~np.isin(data.theta_i_deg, (0, 180))])).size
    return Brdf(
        theta_i,
        None,
        theta_r,
        axis,
        np.reshape(table, (len(theta_i), len(theta_r), len(axis), -1)),
        data.quantity,
        data.channels,
        data.source,
        {**data.metadata, "azimuths": max(lights, 1), "filled_in": filled_in},
    )


def _azimuths(phi: Array) -> Array:
    """Within 0 to below 360 deg."""
    return np.asarray(np.round(phi % 360, DIGITS) % 360)


def _groups(keys: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Places of each key, by rising keys."""
    order = np.argsort(keys, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)


def _lights(data: Scattered, at: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Of these readings, those of each azimuth of the light."""
    return [at[one] for one in _groups(np.unique(_azimuths(data.phi_i_deg[at]), return_inverse=True)[1])]


def _alike(turns: list[tuple[Array, Array]]) -> bool:
    return all(np.array_equal(azimuths, turns[0][0]) for azimuths, _ in turns)


def _at(axis: Array, azimuths: Array, values: Array) -> Array:
    """Values (p, c) of a turn, straight between its azimuths."""
    return np.stack([np.interp(axis, azimuths, one, period=360) for one in values.T], axis=-1)


def _turn(phi: Array, values: Array) -> tuple[Array, Array]:
    """Azimuths, rising, and the mean value at each; half a turn is made a whole one."""
    azimuths, at = np.unique(phi, return_inverse=True)
    sums = np.zeros((len(azimuths), values.shape[1]))
    np.add.at(sums, at, values)
    means = sums / np.bincount(at)[:, None]
    if azimuths[-1] <= 180:
        twin = np.flatnonzero((azimuths > 0) & (azimuths < 180))[::-1]
        azimuths, means = np.append(azimuths, 360 - azimuths[twin]), np.concatenate([means, means[twin]])
    return azimuths, means


def _widest_gap(azimuths: Array) -> float:
    return float(np.max(np.diff(azimuths, append=azimuths[0] + 360)))


def _no_hemisphere(data: Scattered, why: str) -> DomainError:
    return DomainError(
        f"{data.source}: {len(data)} readings do not make a hemisphere: {why}. Fit first (rig fit FILE), then convert the fit, "
        "or write a list of readings: .csv, .alta or .pab"
    )


@dataclass(frozen=True, eq=False)
class Whole:
    """A reflectance that has an answer for the whole hemisphere; a callable of the three angles.

    Parameters
    ----------
    table : Brdf, Merl or Rgl
        What may stop short of it. One that is not isotropic is averaged over the light's azimuths.
    beyond : {"refuse", "nearest", "zero"}
        What lies beyond its end: an error, the value at the end, or nothing.

    Raises
    ------
    DomainError
        If `beyond` is unknown.
    """

    table: Brdf | Merl | Rgl
    beyond: Beyond = "refuse"

    def __post_init__(self) -> None:
        if self.beyond not in BEYOND:
            raise DomainError(f"beyond is {self.beyond!r}, expected one of {', '.join(BEYOND)}")
        if isinstance(self.table, Merl) and self.beyond == "nearest":
            object.__setattr__(self, "table", filled(self.table))

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the values."""
        return self.table.channels

    @property
    def quantity(self) -> Quantity:
        """What side it is of."""
        return self.table.quantity if isinstance(self.table, Brdf) else "brdf"

    @property
    def source(self) -> str:
        """Where it comes from."""
        return self.table.source

    @property
    def reciprocal(self) -> bool:
        """Whether light and view may be swapped."""
        return isinstance(self.table, Merl)

    @property
    def azimuths(self) -> int:
        """How many azimuths of the light are averaged."""
        return 1 if isinstance(self.table, Merl) else len(lights_of(self.table))

    @property
    def reach(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """First and last theta_i and theta_r that it has values for, deg."""
        if isinstance(self.table, Brdf):
            theta_i, theta_r = self.table.theta_i_deg, self.table.theta_r_deg
            return (float(theta_i[0]), float(theta_i[-1])), (float(theta_r[0]), float(theta_r[-1]))
        if isinstance(self.table, Rgl):
            return (float(self.table.theta_i_deg[0]), float(self.table.theta_i_deg[-1])), (0.0, FLATTEST_DEG)
        return (0.0, 90.0), (0.0, 90.0)

    @property
    def complete(self) -> bool:
        """Whether the hemisphere is covered, but for holes within a MERL file."""
        horizon = (0.0, 90.0) if self.quantity == "brdf" else (90.0, 180.0)
        return all(
            low <= wanted[0] + ROOM_DEG and high >= wanted[1] - ROOM_DEG
            for (low, high), wanted in zip(self.reach, ((0.0, 90.0), horizon), strict=True)
        )

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look values up.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            theta_r 0 or more; phi = phi_r - phi_i.

        Returns
        -------
        ndarray, of the broadcast shape and a last axis for the channels, 1/sr

        Raises
        ------
        BeyondError
            If there is no value, and `beyond` is "refuse".
        DomainError
            If it has no value all around.
        """
        theta_i, theta_r, phi = self._placed(theta_i_deg, theta_r_deg, phi_deg)
        if self.beyond == "zero":
            known = self.table.covers(theta_i, theta_r, phi)
            found = np.zeros((*known.shape, len(self.channels)))
            if known.any():
                found[known] = self._mean(theta_i[known], theta_r[known], phi[known])
            return found
        try:
            return self._mean(theta_i, theta_r, phi)
        except DomainError as error:
            if self.beyond == "refuse" and not np.all(self.table.covers(theta_i, theta_r, phi)):
                raise BeyondError(f"{error}. Say what lies beyond the readings: nearest or zero") from error
            raise

    def covers(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> NDArray[np.bool_]:
        """Say for which directions there is a value: for all, unless `beyond` is "refuse"."""
        placed = self._placed(theta_i_deg, theta_r_deg, phi_deg)
        return self.table.covers(*placed) if self.beyond == "refuse" else np.ones(placed[0].shape, bool)

    def _placed(self, theta_i: ArrayLike, theta_r: ArrayLike, phi: ArrayLike) -> tuple[Array, Array, Array]:
        """Directions, moved to the end of the readings as far as `beyond` says, and a rounding at any rate."""
        theta_i, theta_r, phi = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i, theta_r, phi)))
        (low_i, high_i), (low_r, high_r) = self.reach
        near_i, near_r = np.clip(theta_i, low_i, high_i), np.clip(theta_r, low_r, high_r)
        if self.beyond == "nearest":
            return near_i, near_r, phi
        room = ROOM_DEG if isinstance(self.table, Rgl) else 1e-9
        return np.where(abs(near_i - theta_i) <= room, near_i, theta_i), np.where(abs(near_r - theta_r) <= room, near_r, theta_r), phi

    def _mean(self, theta_i: Array, theta_r: Array, phi: Array) -> Array:
        """The mean over the light's azimuths."""
        if isinstance(self.table, Merl):
            return self.table(theta_i, theta_r, phi)
        lights = lights_of(self.table)
        if isinstance(self.table, Rgl):
            return sum((self.table.evaluate(theta_i, at, theta_r, at + phi) for at in lights), start=np.zeros(1)) / len(lights)
        return sum((_lit_from(self.table, k)(theta_i, theta_r, phi) for k in range(len(lights))), start=np.zeros(1)) / len(lights)


def picked(data: Any, name: str) -> Any:
    """Take one channel of a Brdf, Scattered, Merl or Rgl.

    Raises
    ------
    DomainError
        If it is not there.
    """
    if name not in data.channels:
        raise DomainError(f"{data.source}: no channel {name!r}; choose one of {', '.join(data.channels)}")
    at = [data.channels.index(name)]
    if isinstance(data, Rgl):
        return replace(data, values=data.values[:, :, at], channels=(name,))
    sigma = {"sigma": data.sigma[..., at]} if isinstance(data, Scattered) and data.sigma is not None else {}
    return replace(data, values=data.values[..., at], channels=(name,), **sigma)


def lights_of(table: Brdf | Rgl) -> Array:
    """The light's azimuths to average over, each direction once."""
    if table.phi_i_deg is None or (isinstance(table, Rgl) and table.isotropic):
        return np.zeros(1)
    azimuths = table.phi_i_deg
    span = azimuths[-1] - azimuths[0]
    whole = span > 0 and abs(round(360 / span) * span - 360) < 0.01 and len(azimuths) > 2
    return azimuths[:-1] if whole else azimuths  # the last is the first again, or its mirror image


def _lit_from(table: Brdf, k: int) -> Brdf:
    """A grid with one of the light's azimuths."""
    if table.phi_i_deg is None:
        return table
    return replace(table, phi_i_deg=table.phi_i_deg[k : k + 1], values=table.values[:, k : k + 1])


def holes(merl: Merl) -> int:
    """Count the bins of a MERL file that have no value, though their middle is above the horizon."""
    half, diff, around = (np.arange(n) + 0.5 for n in BINS)
    theta_i, theta_r, _ = directions(half[:, None, None] ** 2 / 90, diff[:, None], around)
    return int(np.count_nonzero(~merl.valid & (np.maximum(theta_i, theta_r) <= 90)))


def filled(merl: Merl) -> Merl:
    """Give bins without a value that of the nearest one with, counted in bins."""
    if merl.valid.all():
        return merl
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~merl.valid, return_distances=False, return_indices=True)
    return replace(merl, values=merl.values[tuple(nearest)], valid=np.ones(BINS, bool))


def albedo(function: Function | Whole, theta_i_deg: float, theta_r_max_deg: float = 90.0, *, through: bool = False) -> Array:
    """Share of the light that is scattered up to an angle from the normal.

    Parameters
    ----------
    function : callable
        See `fitting.formats.grid.Function`.
    theta_i_deg : float, deg
        Light.
    theta_r_max_deg : float, deg
        From the normal, or for what goes through from the normal's other end.
    through : bool
        Of what goes through, theta_r 90 to 180 deg.

    Returns
    -------
    ndarray, shape (c,)
        Integral of f cos(theta_r), by midpoints of equal projected solid angle.
    """
    share = (np.arange(90) + 0.5) / 90 * np.sin(np.radians(theta_r_max_deg)) ** 2
    theta = np.degrees(np.arcsin(np.sqrt(share)))[:, None]
    values = np.asarray(function(theta_i_deg, 180 - theta if through else theta, np.arange(180) * 2.0 + 1), float)
    values = values.reshape(90 * 180, -1)
    mean: Array = np.pi * np.sin(np.radians(theta_r_max_deg)) ** 2 * values.mean(axis=0)
    return mean
