"""The shape of the epidermis: domed cells in hexagonal close packing.

Lengths are in units of the dome's base radius a; the model needs no other scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError

CELL_AREA = 2 * math.sqrt(3)
"""Area of the patch that one dome occupies, a^2: touching domes, hexagonally packed, pitch 2a."""


@dataclass(frozen=True)
class Dome:
    """Half-ellipsoid of revolution standing on the patch.

    Parameters
    ----------
    aspect : float
        Height over base diameter, h / 2a. 0.5 is a hemisphere; rose cells have about 1.9 (Tachino et al.).

    Raises
    ------
    DomainError
        If the aspect is not a finite number above 0.
    """

    aspect: float = 0.5

    def __post_init__(self) -> None:
        if not (math.isfinite(self.aspect) and self.aspect > 0):
            raise DomainError(f"a dome's aspect h / 2a must be a finite number above 0, not {self.aspect!r} (0.5 is a hemisphere)")

    @property
    def stretch(self) -> float:
        """Height over base radius, h / a."""
        return 2 * self.aspect

    def sphere_angle(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Angle from z of a direction after z is divided by h / a, which turns every dome into a unit hemisphere.

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
