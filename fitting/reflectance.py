"""One reflectance over all directions above the petal: evaluated, drawn from, and judged by its albedo and its reciprocity."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError

if TYPE_CHECKING:
    from fitting.interpolate import Axis
    from fitting.lobes import Lobes

INTENSITY, PER_SR = "intensity", "1/sr"
MODES = (INTENSITY, PER_SR)
"""What values mean: eq. (8)'s intensity per unit beam, which holds the cosine of incidence already, or a BRDF."""

Array = NDArray[np.float64]
Singles = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Reflectance:
    """One mixture of basis functions: a callable of the three angles that also draws directions.

    Attributes
    ----------
    mode : str
        `INTENSITY` or `PER_SR`.
    x : mapping of str to float
        Weights of the basis functions.
    axes : tuple of Axis
        theta_i, theta_r, phi.
    table : ndarray of float32, shape (i, r, p)
        Coefficients of the spline through the nodes.
    reciprocal : bool
        Whether light and view may be swapped, f(i, r) = f(r, i): then they may to the last bit. The axes of theta are alike.
    """

    mode: str
    x: Mapping[str, float]
    axes: tuple[Axis, Axis, Axis]
    table: Singles
    reciprocal: bool = False

    def __call__(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """The same as `evaluate`."""
        return self.evaluate(theta_i_deg, theta_r_deg, phi_deg)

    def evaluate(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """Look the reflectance up, on all cores where there are many directions.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        theta_r_deg : array_like, deg
            -90 to 90; below 0 it is the view at -theta_r and phi + 180.
        phi_deg : array_like, deg
            phi_r - phi_i, any finite angle: 0 on the light's side, left and right alike.

        Returns
        -------
        ndarray, of the broadcast shape
            Intensity per unit beam, 1/1, or BRDF, 1/sr, by `mode`; never below 0.

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        from fitting.interpolate import look_up  # numba

        (theta_i, theta_r, phi), shape = _flat(theta_i=theta_i_deg, theta_r=theta_r_deg, phi=phi_deg)
        out = np.empty(len(theta_i))
        bad = _spread(len(out), lambda s: look_up(self.table, *self.axes, self.reciprocal, theta_i[s], theta_r[s], phi[s], out[s]))
        if bad is not None:
            raise _outside(theta_i[bad], theta_r[bad], phi[bad])
        return out.reshape(shape)

    def sample(self, theta_i_deg: ArrayLike, u1: ArrayLike, u2: ArrayLike) -> tuple[Array, Array]:
        """Draw views as the light is sent: by value times cos(theta_r) per solid angle, nearly; `pdf` is exact for what is drawn.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90.
        u1, u2 : array_like
            Evenly spread over 0 <= u < 1; theta_r rises with u1 and phi with u2, so that strata stay strata.

        Returns
        -------
        theta_r, phi : ndarray, of the broadcast shape, deg
            0 to 90, and -180 to 180.

        Raises
        ------
        DomainError
            If theta_i is outside the table or a u outside its range.
        """
        from fitting.lobes import draw  # numba

        (theta_i, first, second), shape = _flat(theta_i=theta_i_deg, u1=u1, u2=u2)
        theta_r, phi = np.empty(len(theta_i)), np.empty(len(theta_i))
        of = self._lobes
        bad = _spread(len(phi), lambda s: draw(of.theta_i, of.rows, of.cells, theta_i[s], first[s], second[s], theta_r[s], phi[s]))
        if bad is not None:
            raise DomainError(
                f"theta_i = {theta_i[bad]:g} deg, u1 = {first[bad]:g} and u2 = {second[bad]:g} draw nothing: "
                "expected 0 <= theta_i <= 90 deg and 0 <= u < 1"
            )
        return theta_r.reshape(shape), phi.reshape(shape)

    def pdf(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> Array:
        """How densely `sample` draws a view.

        Parameters
        ----------
        theta_i_deg, theta_r_deg, phi_deg : array_like, deg
            As in `evaluate`.

        Returns
        -------
        ndarray, of the broadcast shape, 1/sr
            Above 0 wherever theta_r is below 90 deg; 1 over the hemisphere.

        Raises
        ------
        DomainError
            If a direction is outside the table.
        """
        from fitting.lobes import density  # numba

        (theta_i, theta_r, phi), shape = _flat(theta_i=theta_i_deg, theta_r=theta_r_deg, phi=phi_deg)
        out, of = np.empty(len(theta_i)), self._lobes
        bad = _spread(len(out), lambda s: density(of.theta_i, of.rows, of.cells, theta_i[s], theta_r[s], phi[s], out[s]))
        if bad is not None:
            raise _outside(theta_i[bad], theta_r[bad], phi[bad])
        return out.reshape(shape)

    def albedo(self, theta_i_deg: ArrayLike) -> Array:
        """Share of the light that is sent back into the hemisphere, by Gauss-Legendre quadrature between the nodes.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            0 to 90; as an intensity, below 90.

        Returns
        -------
        ndarray, of theta_i's shape
            Integral of f cos(theta_r) d(omega), where f is the BRDF or the intensity over cos(theta_i). The paper's intensity has no unit
            of its own: its albedo is relative and may exceed 1.

        Raises
        ------
        DomainError
            If an angle is outside the table.
        """
        (theta_i,), shape = _flat(theta_i=theta_i_deg)
        if self.mode == INTENSITY and np.any(theta_i == 90):
            raise DomainError("an intensity has no albedo at theta_i = 90 deg, where no light falls on the petal: expected below 90 deg")
        edges = self.axes[1].nodes if self.axes[1].last == 90 else np.append(self.axes[1].nodes, 90.0)
        view, d_view = _gauss(edges, 3)
        phi, d_phi = _gauss(self.axes[2].nodes, 2)
        weight = 2 * np.sin(np.radians(view)) * np.cos(np.radians(view)) * d_view
        sent = np.array([weight @ self.evaluate(t, view[:, None], phi) @ d_phi for t in theta_i]).reshape(shape)
        return sent / np.cos(np.radians(theta_i)).reshape(shape) if self.mode == INTENSITY else sent

    def reciprocity(self) -> float:
        """How far light and view are from exchangeable.

        Returns
        -------
        float
            With F(i, r) = f cos(theta_i) cos(theta_r), the light exchanged between two directions: the rms of F(i, r) - F(r, i) over all
            pairs of directions, by solid angle, as a fraction of the mean of F; 0 for what obeys Helmholtz, and for black. The paper's
            formula does not: it knows no foreshortening of the view.
        """
        theta, d_theta = _gauss(np.linspace(0, 90, 13), 2)
        phi, d_phi = _gauss(np.linspace(0, 180, 25), 2)
        cosine = np.cos(np.radians(theta))
        solid = np.sin(np.radians(theta)) * d_theta
        exchanged = self.evaluate(theta[:, None, None], theta[:, None], phi) * cosine[:, None]
        if self.mode == PER_SR:
            exchanged *= cosine[:, None, None]
        weight = solid[:, None, None] * solid[:, None] * d_phi
        mean = np.average(exchanged, weights=weight)
        return math.sqrt(np.average((exchanged - exchanged.transpose(1, 0, 2)) ** 2, weights=weight)) / mean if mean > 0 else 0.0

    @functools.cached_property
    def _lobes(self) -> Lobes:
        from fitting.lobes import lobes  # numba

        return lobes(self.evaluate, self.axes[0].nodes)


def _flat(**numbers: ArrayLike) -> tuple[list[Array], tuple[int, ...]]:
    """Broadcast named numbers against one another and flatten them."""
    try:
        found = np.broadcast_arrays(*(np.asarray(a, float) for a in numbers.values()))
    except (TypeError, ValueError) as error:
        raise DomainError(f"{', '.join(numbers)} must be numbers of matching shapes: {error}") from error
    return [np.ascontiguousarray(a).reshape(-1) for a in found], found[0].shape


def _spread(count: int, kernel: Callable[[slice], int]) -> int | None:
    """Run a kernel over directions on all cores; the first direction that it refused, if any."""
    from fitting.interpolate import in_chunks

    refused: list[int] = []

    def task(part: slice) -> None:
        if (at := kernel(part)) >= 0:
            refused.append(part.start + at)

    in_chunks(count, task)
    return min(refused, default=None)


def _outside(theta_i: float, theta_r: float, phi: float) -> DomainError:
    """Say which angle is outside the table."""
    for name, angle, inside, span in (
        ("theta_i", theta_i, 0 <= theta_i <= 90, "0 <= theta_i <= 90 deg"),
        ("theta_r", theta_r, abs(theta_r) <= 90, "-90 <= theta_r <= 90 deg (beyond is behind the petal, which has no model here)"),
    ):
        if not inside:
            return DomainError(f"{name} = {angle:g} deg is outside the table: expected {span}")
    return DomainError(f"phi = {phi:g} deg is outside the table: expected a finite angle")


def _gauss(edges: Array, points: int) -> tuple[Array, Array]:
    """Gauss-Legendre between edges in deg: nodes in deg, weights in rad."""
    x, w = np.polynomial.legendre.leggauss(points)
    half = np.diff(edges)[:, None] / 2
    return (edges[:-1, None] + half * (1 + x)).ravel(), np.radians(half * w).ravel()
