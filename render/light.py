"""The one light of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from render.camera import Camera
from render.errors import RenderError


@dataclass(frozen=True)
class DistantLight:
    """A beam from infinity.

    Parameters
    ----------
    direction : tuple of float
        Towards the light, in the camera's frame (x right, y up, z towards the viewer); of any length. The paper's L = (1, 1, 1).
    intensity : float
        The paper's I_l: what a surface facing the light receives.

    Raises
    ------
    RenderError
        If the direction has no length or the intensity is negative.
    """

    direction: tuple[float, float, float] = (1.0, 1.0, 1.0)
    intensity: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.direction).all() and np.linalg.norm(self.direction) > 0 and self.intensity >= 0):
            raise RenderError(f"a light needs a direction and an intensity of 0 or more, not {self.direction} and {self.intensity}")

    def towards(self, camera: Camera) -> NDArray[np.float64]:
        """Unit vector towards the light in the scene's frame."""
        direction = camera.axes @ np.asarray(self.direction, float)
        return direction / np.linalg.norm(direction)


@dataclass(frozen=True)
class NearLight:
    """A point that shines all around, at a place of the scene.

    Parameters
    ----------
    place : tuple of float, mm
        In the scene's frame.
    intensity : float
        What a surface facing the light receives.
    reference : float, optional, mm
        Distance at which it receives that, falling with the inverse square. Without it, it receives that at every distance.

    Raises
    ------
    RenderError
        If a number is out of range.
    """

    place: tuple[float, float, float]
    intensity: float = 1.0
    reference: float | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.place).all() and self.intensity >= 0 and (self.reference is None or self.reference > 0)):
            raise RenderError(f"a light needs a place, an intensity of 0 or more and a reference distance above 0, not {self}")


Light = DistantLight | NearLight
