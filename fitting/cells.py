"""The shape of the epidermis: domed cells in hexagonal packing, with flat floor in the gaps.

Lengths are in units of the dome's base radius a; the model needs no other scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError

CELL_AREA = 2 * math.sqrt(3)
"""Area of the patch that one dome occupies, a^2: touching domes, hexagonally packed, pitch 2a."""


@dataclass(frozen=True)
class Spread:
    """How much the domes of a patch differ; uniform within the bounds, drawn for a supercell that repeats.

    Parameters
    ----------
    height : float
        Largest departure from the height, as a fraction of it, 0 to less than 1.
    tilt : float, deg
        Largest lean of a dome's axis from the normal, any way round. The dome is sheared: its base stays where it is.
    place : float
        Largest shift of a base from its place in the lattice, in a.
    seed : int
        Of the random numbers.
    cells : int
        The supercell has cells x cells domes.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """

    height: float = 0.0
    tilt: float = 0.0
    place: float = 0.0
    seed: int = 0
    cells: int = 5

    def __post_init__(self) -> None:
        if not (0 <= self.height < 1 and 0 <= self.tilt < 60 and 0 <= self.place < math.inf and self.seed >= 0 and 1 <= self.cells <= 64):
            raise DomainError(
                f"this spread is outside the model: {self}; expected 0 <= height < 1, 0 <= tilt < 60 deg, place and seed of 0 or more, "
                "1 to 64 cells"
            )

    @property
    def is_none(self) -> bool:
        """Whether all domes are alike."""
        return self.height == self.tilt == self.place == 0


@dataclass(frozen=True)
class Cell:
    """Domes z = h (1 - (r / a)^p)^(1 / q) standing on a flat floor, between lens, dome and cone.

    Parameters
    ----------
    aspect : float
        Height over base diameter, h / 2a. 0.5 with p = q = 2 is a hemisphere; rose cells have about 1.9 (Tachino et al.).
    p, q : float
        Exponents, 1 or more, so that the dome is convex. p = q = 2 is a half-ellipsoid, p = 2 and q = 1 a paraboloid (a lens where
        flat), p = q = 1 a cone; p just above 1 is a cone with its tip rounded.
    gap : float
        Free way between neighbouring bases over 2a: the pitch is 2a (1 + gap).
    spread : Spread
        How much the domes differ.

    Raises
    ------
    DomainError
        If a number is outside its range, or domes spread so far that they could meet.
    """

    aspect: float = 0.5
    p: float = 2.0
    q: float = 2.0
    gap: float = 0.0
    spread: Spread = field(default_factory=Spread)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.aspect) and self.aspect > 0):
            raise DomainError(f"a dome's aspect h / 2a must be a finite number above 0, not {self.aspect!r} (0.5 is a hemisphere)")
        for name, exponent in (("p", self.p), ("q", self.q)):
            if not 1 <= exponent < math.inf:
                raise DomainError(f"a dome's {name} must be a finite number of 1 or more, or the dome is not convex; not {exponent!r}")
        if not 0 <= self.gap < math.inf:
            raise DomainError(f"the gap between domes must be a finite number of 0 or more, not {self.gap!r}")
        if self.reach > 1 + self.gap + 1e-12:
            raise DomainError(f"domes spread by {self.spread} could run into one another: expected a gap of {self.reach - 1:.4g} or more")

    @property
    def stretch(self) -> float:
        """Height over base radius, h / a."""
        return 2 * self.aspect

    @property
    def is_ellipsoid(self) -> bool:
        """Whether the dome is a half-ellipsoid, for which shadows have closed forms."""
        return self.p == 2 and self.q == 2

    @property
    def pitch(self) -> float:
        """Distance of neighbouring domes, a."""
        return 2 * (1 + self.gap)

    @property
    def cell_area(self) -> float:
        """Area of the patch that one dome occupies, a^2."""
        return math.sqrt(3) / 2 * self.pitch**2

    @property
    def reach(self) -> float:
        """How far from its place in the lattice a dome may extend sideways, a."""
        if self.spread.tilt == 0:
            return 1 + self.spread.place
        z = np.cos(np.linspace(0, np.pi / 2, 1001))
        lean = self.stretch * (1 + self.spread.height) * math.tan(math.radians(self.spread.tilt))
        return self.spread.place + float(np.max((1 - z**self.q) ** (1 / self.p) + lean * z))

    def profile(self, r: ArrayLike) -> NDArray[np.float64]:
        """Height of the dome at distance r from its axis, both in a; 0 outside the base."""
        inside = np.clip(np.asarray(r, float), 0, 1)
        return self.stretch * (1 - inside**self.p) ** (1 / self.q)

    def slope(self, r: ArrayLike) -> NDArray[np.float64]:
        """Derivative dz / dr at distance r (a) from the axis, 0 <= r < 1; 0 or less, without bound at the rim where q > 1."""
        r = np.asarray(r, float)
        return -self.stretch * self.p / self.q * r ** (self.p - 1) * (1 - r**self.p) ** (1 / self.q - 1)

    def domes(self) -> NDArray[np.float64]:
        """One row for each dome of the (super)cell.

        Returns
        -------
        ndarray, shape (cells^2, 5)
            Shift of its base from the lattice in x and y, height, and lean dx / dz, dy / dz of its axis; a. Row i * cells + j stands at
            i (pitch, 0) + j (pitch / 2, sqrt(3) pitch / 2).
        """
        if self.spread.is_none:
            return np.array([[0.0, 0.0, self.stretch, 0.0, 0.0]])
        spread = self.spread
        u = np.random.default_rng(spread.seed).random((spread.cells**2, 5))
        shift, lean = spread.place * np.sqrt(u[:, 0]), math.tan(math.radians(spread.tilt)) * np.sqrt(u[:, 2])
        place, way = 2 * np.pi * u[:, 1], 2 * np.pi * u[:, 3]
        height = self.stretch * (1 + spread.height * (2 * u[:, 4] - 1))
        return np.column_stack([shift * np.cos(place), shift * np.sin(place), height, lean * np.cos(way), lean * np.sin(way)])

    def sphere_angle(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Angle from z of a direction after z is divided by h / a, which turns every half-ellipsoid into a unit hemisphere.

        Straight lines stay straight, so what hides what can be found among the hemispheres.

        Parameters
        ----------
        theta : array_like, rad
            Signed angle from z in the plane of incidence.

        Returns
        -------
        ndarray, rad
        """
        return np.arctan2(self.stretch * np.sin(theta), np.cos(theta))
