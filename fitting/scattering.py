"""What a petal does with light from above, on both of its sides: reflection and transmission as one thing that renderers ask."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError
from fitting.reflectance import PER_SR, Reflectance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scattering:
    """Reflectance above and transmittance below the petal, both in 1/sr.

    Angles follow the house's convention: abs(theta_r) above 90 deg is behind the petal, straight through is theta_i - 180.

    Parameters
    ----------
    reflected : Reflectance
        Views on the light's side.
    transmitted : Reflectance
        Views from behind, theta_r being their angle from the far normal.

    Raises
    ------
    DomainError
        If one of the two is not in 1/sr.
    """

    reflected: Reflectance
    transmitted: Reflectance

    def __post_init__(self) -> None:
        if self.reflected.mode != PER_SR or self.transmitted.mode != PER_SR:
            raise DomainError("reflection and transmission can only be put together in 1/sr")

    def evaluate(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look up the radiance per irradiance.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        theta_r_deg : array_like, deg
            -180 to 180; below 0 it is the view at -theta_r and phi + 180.
        phi_deg : array_like, deg
            phi_r - phi_i, any finite angle.

        Returns
        -------
        ndarray, of the broadcast shape, 1/sr

        Raises
        ------
        DomainError
            If a direction is outside the model.
        """
        return self._ask(lambda side: side.evaluate, theta_i_deg, theta_r_deg, phi_deg)[0]

    def sample(self, theta_i_deg: ArrayLike, u1: ArrayLike, u2: ArrayLike) -> tuple[Array, Array]:
        """Draw views on either side, nearly as the light is sent; `pdf` is exact for what is drawn.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        u1, u2 : array_like
            Evenly spread over 0 <= u < 1.

        Returns
        -------
        theta_r, phi : ndarray, of the broadcast shape, deg
            0 to 180, and -180 to 180.

        Raises
        ------
        DomainError
            If theta_i is outside the model or a u outside its range.
        """
        theta_i, first, second = np.broadcast_arrays(*(np.asarray(a, float) for a in (theta_i_deg, u1, u2)))
        if not np.all((first >= 0) & (first < 1)):
            raise DomainError("u1 must be 0 or more and below 1")
        share = self._share(theta_i)
        behind = first >= share
        theta_r, phi = np.empty(theta_i.shape), np.empty(theta_i.shape)
        below_one = np.nextafter(1.0, 0.0)
        for side, rows, low, width in ((self.reflected, ~behind, 0.0, share), (self.transmitted, behind, share, 1 - share)):
            u = np.minimum((first - low)[rows] / width[rows], below_one)
            drawn, phi[rows] = side.sample(theta_i[rows], u, second[rows])
            theta_r[rows] = 180 - drawn if side is self.transmitted else drawn
        return theta_r, phi

    def pdf(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """How densely `sample` draws a view, 1/sr; parameters and errors as for `evaluate`."""
        density, behind = self._ask(lambda side: side.pdf, theta_i_deg, theta_r_deg, phi_deg)
        share = np.broadcast_to(self._share(np.asarray(theta_i_deg, float)), density.shape)
        return density * np.where(behind, 1 - share, share)

    def _ask(self, method: Callable[[Reflectance], Callable[..., Array]], *angles: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Ask the side that each view sees; also tell which views are behind."""
        try:
            theta_i, theta_r, phi = np.broadcast_arrays(*(np.asarray(a, float) for a in angles))
        except ValueError as error:
            raise DomainError(f"theta_i, theta_r and phi must be numbers of matching shapes: {error}") from error
        if not np.all(np.abs(theta_r) <= 180):
            raise DomainError("theta_r must lie within -180 and 180 deg")
        behind = np.abs(theta_r) > 90
        out = np.empty(theta_r.shape)
        out[~behind] = method(self.reflected)(theta_i[~behind], theta_r[~behind], phi[~behind])
        from_far_normal = np.copysign(180 - np.abs(theta_r), theta_r)
        out[behind] = method(self.transmitted)(theta_i[behind], from_far_normal[behind], phi[behind])
        return out, behind

    def _share(self, theta_i: Array) -> Array:
        """Of the light that leaves the petal, what leaves on the lit side."""
        if not np.all((theta_i >= 0) & (theta_i <= 90)):
            raise DomainError("theta_i must lie within 0 and 90 deg; for light from below turn the petal over")
        return np.interp(theta_i, *self._shares)

    @functools.cached_property
    def _shares(self) -> tuple[Array, Array]:
        nodes = self.reflected.axes[0].nodes
        above, below = self.reflected.albedo(nodes), self.transmitted.albedo(nodes)
        return nodes, np.divide(above, above + below, out=np.full_like(above, 0.5), where=above + below > 0)
