"""What the detector really sees: a cone of views, lit by a cone of light, from a spot that has a size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError

Array = NDArray[np.float64]

WIDEST = 30.0
"""Largest half-angle of a cone, deg: seven nodes over a wider one would miss what lies between them."""

# Mean over the unit disc, exact for polynomials up to degree 5 (Radon's seven points): the centre and a hexagon. Each node has its mirror
# image across y = 0, to the last bit.
_NODES = np.array(
    [
        [0.0, 0.0],
        *([sx / math.sqrt(2), sy / math.sqrt(6)] for sx in (-1, 1) for sy in (-1, 1)),
        *([0.0, s * math.sqrt(2 / 3)] for s in (-1, 1)),
    ]
)
_WEIGHTS = np.array([1 / 4] + 6 * [1 / 8])
_MIRRORED = np.array([0, 2, 1, 4, 3, 6, 5])
_CENTRE = np.zeros((1, 2)), np.ones(1), np.zeros(1, int)


@dataclass(frozen=True)
class Aperture:
    """The extent of lamp, spot and detector; as it stands, a ray from a point to a point.

    Parameters
    ----------
    acceptance_deg : float, deg
        Half-angle of the detector's acceptance cone, as seen from the specimen.
    beam_deg : float, deg
        Half-angle of the cone of light, as seen from the specimen: the lamp's angular radius.
    spot_mm : float, mm
        Diameter of the spot that the reading comes from. Where the whole lit spot is seen, it is that spot's, across the beam: on the
        specimen it is longer by 1 / cos(theta_i) in the plane of incidence. Where a patch of it is seen, it is the patch's, across the
        view: longer by 1 / cos(theta_r) in the view's direction.
    lamp_mm, detector_mm : float, mm, optional
        Distances from the specimen. Points of the spot off the axis see lamp and detector elsewhere, both at once. None is far away.
    sees : {"patch", "spot"}
        "patch": the detector's field lies within the lit spot, and its reading follows the radiance. "spot": it sees all of the lit spot,
        and its reading follows the flux from there, radiance times cos(theta_r) / cos(theta_i). Readings that were already turned into
        BRDF or reflectance factor are of the first kind, whatever took them.

    Raises
    ------
    DomainError
        If a setting is outside its range, or a spot has a size while lamp and detector are both far away, so that it would change nothing.

    Notes
    -----
    A reading is the mean of the radiance f(theta_i, theta_r, phi) under a beam of constant strength, evenly over the solid angles of both
    cones and over the area of the spot. f holds the cosine of the incidence, and a detector's flux is counted by solid angle, so neither
    needs a further weight; a field stop holds the projection of the area seen constant. With v the unit vector to the detector, e1 and e2
    across it, p a point of the flat spot and D the distance, the direction of a node is along

        cos(psi) v + sin(psi) (q1 e1 + q2 e2) / |q| - p / D,    sin(psi / 2) = |q| sin(acceptance / 2)

    where q runs over the unit disc: the map keeps areas, so that the disc's quadrature is the cone's. Light alike. Light and view share p.

    Each disc has seven nodes and degree 5 (J. Radon, Monatsh. Math. 52 (1948) 286, doi:10.1007/BF01525334): a Phong lobe n = 40 is averaged
    over a cone of 5 deg to 0.1 % wherever it is above a thousandth of its peak; the error grows with the sixth power of the angle. Discs
    multiply. In the plane of incidence mirror images are folded: one disc takes 4 nodes, two take 25, three 172.

    Left out: the loss of light with distance within the spot (where spot / distance is 1 / 50, up to 0.3 % of the reading on the far flank
    of that lobe and next to nothing at its peak), and the other shape that a diverging beam's spot takes (of the second order in spot /
    distance).
    """

    acceptance_deg: float = 0.0
    beam_deg: float = 0.0
    spot_mm: float = 0.0
    lamp_mm: float | None = None
    detector_mm: float | None = None
    sees: Literal["patch", "spot"] = "patch"

    def __post_init__(self) -> None:
        for name in ("acceptance_deg", "beam_deg"):
            half = getattr(self, name)
            if not 0 <= half <= WIDEST:
                raise DomainError(f"aperture: {name} is {half!r}, expected a half-angle of 0 to {WIDEST:g} deg")
        if not 0 <= self.spot_mm < math.inf:
            raise DomainError(f"aperture: spot_mm is {self.spot_mm!r}, expected a finite number of 0 or more")
        for name in ("lamp_mm", "detector_mm"):
            distance = getattr(self, name)
            if distance is not None and not 0 < distance < math.inf:
                raise DomainError(f"aperture: {name} is {distance!r}, expected a finite number above 0, or None for far away")
        if self.spot_mm > 0 and self.lamp_mm is None and self.detector_mm is None:
            raise DomainError("aperture: a spot_mm needs lamp_mm or detector_mm: seen from far away a spot's size changes nothing")
        if self.sees not in ("patch", "spot"):
            raise DomainError(f"aperture: sees is {self.sees!r}, expected 'patch' or 'spot'")

    @property
    def is_ideal(self) -> bool:
        """Whether each reading is that of a single pair of directions, its radiance."""
        return self.acceptance_deg == self.beam_deg == self.spot_mm == 0 and self.sees == "patch"

    def nodes(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike = 0.0) -> tuple[Array, Array, Array, Array]:
        """Directions whose weighted sum is the reading.

        Parameters
        ----------
        theta_i_deg : array_like, deg
            Incidence of the axis, 0 <= theta_i < 90.
        theta_r_deg, phi_deg : array_like, deg
            View of the axis, -180 to 180, positive on the light's side where phi = 0, and its azimuth from the light. All broadcast.

        Returns
        -------
        theta_i, theta_r, phi : ndarray, shape (n, k), deg
            In the plane of incidence phi is 0 and theta_r signed, out of it theta_r >= 0 and phi -180 to 180. Where all axes lie in the
            plane, phi is 0 or more, each node standing for its mirror image too: f must not depend on the sign of phi.
        weight : ndarray, shape (n, k)
            They sum to 1 for a patch, to the mean of cos(theta_r) over cos(theta_i) for a spot. k = 1 where nothing has an extent.

        Raises
        ------
        DomainError
            If a direction is not a number or out of range, a cone reaches the horizon, or a spot reaches as far as the lamp or detector.
        """
        theta_i, theta_r, phi = self._checked(theta_i_deg, theta_r_deg, phi_deg)
        reach = self._reach(theta_i, theta_r)
        folded = bool(np.all(phi == 0))
        q_r, q_i, p, weight = self._rule(folded=folded)
        light, across, side = _frame(theta_i, np.zeros_like(theta_i))
        view, along, beside = _frame(theta_r, phi)
        wi, wo = _cone(light, across, side, q_i, self.beam_deg), _cone(view, along, beside, q_r, self.acceptance_deg)
        if self.spot_mm > 0:
            stretched, straight = (across, side) if self.sees == "spot" else (along, beside)
            flat = stretched[..., :2] / np.hypot(stretched[..., 0], stretched[..., 1])[..., None]  # not 0: _reach refuses 90 deg
            spot = (reach * p[:, 0])[..., None] * flat + (self.spot_mm / 2 * p[:, 1])[..., None] * straight[..., :2]
            for w, distance in ((wi, self.lamp_mm), (wo, self.detector_mm)):
                if distance is not None:
                    w[..., :2] -= spot / distance
        if len(weight) == 1:
            incidence, angle, azimuth = theta_i, theta_r, phi  # not even rounded
        else:
            incidence, angle = _polar(wi), _polar(wo)
            angle, azimuth = _canonical(angle, _between(wi, wo))
        weights = np.tile(weight, (len(theta_i), 1))
        if self.sees == "spot":
            weights *= np.abs(np.cos(np.radians(angle))) / np.cos(np.radians(theta_i))
        return incidence, angle, np.abs(azimuth) if folded else azimuth, weights

    def to_dict(self) -> dict[str, Any]:
        """Return the settings by name, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> Aperture:
        """Make an aperture from `to_dict`'s settings; those missing take their defaults.

        Raises
        ------
        DomainError
            If a setting is unknown, not a number, or out of range.
        """
        known = [f.name for f in fields(cls)]
        if unknown := sorted(set(settings) - set(known)):
            raise DomainError(f"aperture: unknown setting {', '.join(unknown)}; known are {', '.join(known)}")
        try:
            return cls(**settings)
        except TypeError as error:
            raise DomainError(f"aperture: settings must be numbers: {error}") from error

    def _checked(self, theta_i_deg: ArrayLike, theta_r_deg: ArrayLike, phi_deg: ArrayLike) -> tuple[Array, Array, Array]:
        """Columns of axes, those in the plane with phi = 0."""
        try:
            columns = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (theta_i_deg, theta_r_deg, phi_deg)))
        except (TypeError, ValueError) as error:
            raise DomainError(f"aperture: directions must be numbers whose shapes match: {error}") from error
        theta_i, theta_r, phi = (column.reshape(-1, 1).copy() for column in columns)
        for name, angle, good, expected in (
            ("theta_i", theta_i, (theta_i >= 0) & (theta_i < 90), "0 <= theta_i < 90 deg"),
            ("theta_r", theta_r, np.abs(theta_r) <= 180, "-180 to 180 deg"),
            ("phi", phi, np.abs(phi) <= 360, "-360 to 360 deg"),
        ):
            if not good.all():
                raise DomainError(f"aperture: {name} is {angle[~good][0]:g}, expected {expected}")
        for name, half, axis, angle in (
            ("acceptance_deg", self.acceptance_deg, "theta_r", theta_r),
            ("beam_deg", self.beam_deg, "theta_i", theta_i),
        ):
            over = np.abs(90 - np.abs(angle)) <= half
            if half > 0 and over.any():
                raise DomainError(
                    f"aperture: {name} of {half:g} deg is too large at {axis} = {angle[over][0]:g} deg, where the cone reaches the "
                    f"horizon at 90 deg; give a smaller one or leave such readings out"
                )
        return theta_i, *_canonical(theta_r, phi)

    def _reach(self, theta_i: Array, theta_r: Array) -> Array:
        """Longer half-axis of the spot on the specimen, mm."""
        axis, name = (theta_i, "theta_i") if self.sees == "spot" else (theta_r, "theta_r")
        if self.spot_mm == 0:
            return np.zeros_like(axis)
        cosine = np.abs(np.cos(np.radians(axis)))
        nearest, which = min((d, n) for n in ("lamp_mm", "detector_mm") if (d := getattr(self, n)) is not None)
        over = self.spot_mm / 2 >= nearest * cosine
        if over.any():
            raise DomainError(
                f"aperture: spot_mm of {self.spot_mm:g} mm is too large at {name} = {axis[over][0]:g} deg, where the spot on the specimen "
                f"reaches as far as {which}, {nearest:g} mm; give a smaller one or leave such readings out"
            )
        return np.asarray(self.spot_mm / 2 / cosine)

    def _rule(self, *, folded: bool) -> tuple[Array, Array, Array, Array]:
        """Nodes on the discs of view, light and spot, each (k, 2), and weights (k,)."""
        discs = [(_NODES, _WEIGHTS, _MIRRORED) if size > 0 else _CENTRE for size in (self.acceptance_deg, self.beam_deg, self.spot_mm)]
        shape = tuple(len(weights) for _, weights, _ in discs)
        chosen = np.indices(shape).reshape(3, -1)
        weight = np.prod([disc[1][which] for disc, which in zip(discs, chosen, strict=True)], axis=0)
        if folded:
            image = np.ravel_multi_index(tuple(disc[2][which] for disc, which in zip(discs, chosen, strict=True)), shape)
            here = np.arange(len(weight))
            weight = np.where(image == here, weight, 2 * weight)[here <= image]
            chosen = chosen[:, here <= image]
        view, light, spot = (disc[0][which] for disc, which in zip(discs, chosen, strict=True))
        return view, light, spot, weight


def _frame(theta_deg: Array, phi_deg: Array) -> tuple[Array, Array, Array]:
    """Unit vectors (n, 1, 3): the direction, across it in its plane with the normal, and across that plane."""
    theta, phi = np.radians(theta_deg), np.radians(phi_deg)
    s, c, x, y = np.sin(theta), np.cos(theta), np.cos(phi), np.sin(phi)
    zero = np.zeros_like(s)
    return np.stack([s * x, s * y, c], axis=-1), np.stack([c * x, c * y, -s], axis=-1), np.stack([-y, x, zero], axis=-1)


def _cone(axis: Array, along: Array, beside: Array, q: Array, half_deg: float) -> Array:
    """Unit vectors (n, k, 3) of a cone for points q (k, 2) of the unit disc; equal areas stay equal."""
    radius = np.hypot(q[:, 0], q[:, 1])
    half = radius * math.sin(math.radians(half_deg) / 2)  # sin(psi / 2)
    per = 2 * math.sin(math.radians(half_deg) / 2) * np.sqrt(1 - half**2)  # sin(psi) / |q|
    return np.asarray((1 - 2 * half**2)[:, None] * axis + (per * q[:, 0])[:, None] * along + (per * q[:, 1])[:, None] * beside)


def _polar(w: Array) -> Array:
    """Angle from the normal, deg, of vectors of any length."""
    return np.asarray(np.degrees(np.arctan2(np.hypot(w[..., 0], w[..., 1]), w[..., 2])))


def _between(wi: Array, wo: Array) -> Array:
    """Azimuth of the view from the light, deg; 0 where the light is on the normal. Mirror images differ by sign only, to the last bit."""
    (ix, iy), (rx, ry) = (np.moveaxis(w[..., :2], -1, 0) for w in (wi, wo))
    return np.asarray(np.degrees(np.arctan2(ix * ry - iy * rx, ix * rx + iy * ry)))


def _canonical(theta_r: Array, phi: Array) -> tuple[Array, Array]:
    """In the plane of incidence a signed angle and phi = 0; out of it an angle of 0 or more and phi -180 to 180; deg."""
    theta, turned = np.abs(theta_r), np.where(theta_r < 0, phi + 180, phi)
    turned = turned - 360 * np.round(turned / 360)
    sideways = np.sin(np.radians(turned)) * np.sin(np.radians(theta))
    plane = np.abs(sideways) < 1e-14  # rounding only
    return np.where(plane & (np.abs(turned) > 90), -theta, theta), np.where(plane, 0.0, turned)
