"""A pinhole camera. Its frame: x right, y up, z towards the viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import RenderError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """Part of a picture, in pixels: rows `top` to `top + height`, columns `left` to `left + width`."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Camera:
    """Where the picture is taken from and what of it is seen.

    Parameters
    ----------
    eye : ndarray, shape (3,), mm
        In the scene's frame.
    axes : ndarray, shape (3, 3)
        Columns: the camera's x (right), y (up) and z (towards the viewer) in the scene's frame.
    window : tuple of float
        left, right, bottom, top of the view, x and y at distance 1 before the eye.
    width, height : int
        Pixels.

    Raises
    ------
    RenderError
        If the axes are not a rotation, or window or picture are empty.
    """

    eye: Array
    axes: Array
    window: tuple[float, float, float, float]
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (
            np.allclose(self.axes.T @ self.axes, np.eye(3), atol=1e-9) and np.linalg.det(self.axes) > 0 and np.isfinite(self.eye).all()
        ):
            raise RenderError(f"a camera needs a finite eye and a rotation for its axes, not {self.eye} and {self.axes.tolist()}")
        left, right, bottom, top = self.window
        if not (left < right and bottom < top and self.width >= 1 and self.height >= 1):
            raise RenderError(f"nothing to see through the window {self.window} on {self.width} x {self.height} pixels")

    @classmethod
    def look_at(
        cls, eye: ArrayLike, target: ArrayLike, *, up: ArrayLike = (0, 0, 1), fov: float = 30.0, width: int = 800, height: int = 800
    ) -> Camera:
        """Put the camera at a place, its middle on another.

        Parameters
        ----------
        eye, target : array_like, shape (3,), mm
            In the scene's frame.
        up : array_like, shape (3,)
            What is upwards in the picture; looking along it, the picture's up is the scene's y (or x).
        fov : float, deg
            Angle of view over the picture's height.
        width, height : int
            Pixels, square ones.

        Raises
        ------
        RenderError
            If eye and target coincide or a number is out of range.
        """
        eye = np.asarray(eye, float)
        if not (0 < fov < 180):
            raise RenderError(f"the angle of view must be between 0 and 180 deg, not {fov:g}")
        axes = _axes(eye - np.asarray(target, float), up)
        top = math.tan(math.radians(fov) / 2)
        right = top * width / height
        return cls(eye, axes, (-right, right, -top, top), width, height)

    @classmethod
    def framing(
        cls,
        points: ArrayLike,
        towards: ArrayLike,
        *,
        up: ArrayLike = (0, 0, 1),
        fov: float = 30.0,
        margin: float = 0.05,
        width: int = 800,
        height: int = 800,
    ) -> Camera:
        """Step back until all points are in the picture.

        Parameters
        ----------
        points : array_like, shape (n, 3), mm
            The scene's vertices.
        towards : array_like, shape (3,)
            Direction from the scene to the eye.
        up, fov, width, height
            As for `look_at`.
        margin : float
            Part of the picture left free on each side, 0 to below 0.5.

        Raises
        ------
        RenderError
            If there are no points or a number is out of range.
        """
        points = np.asarray(points, float).reshape(-1, 3)
        if not len(points) or not (0 <= margin < 0.5):
            raise RenderError(f"{len(points)} points with a margin of {margin:g}; expected some points and a margin of 0 to below 0.5")
        axes = _axes(towards, up)
        local = points @ axes
        middle = (local.min(axis=0) + local.max(axis=0)) / 2
        x, y, z = (local - middle).T
        half = math.tan(math.radians(fov) / 2) * (1 - 2 * margin)
        distance = float(max((np.abs(x) * height / width / half + z).max(), (np.abs(y) / half + z).max()))
        if not distance > 0:
            raise RenderError("the points fill no picture: they all fall on one place")
        target = axes @ middle
        return cls.look_at(target + axes[:, 2] * distance, target, up=up, fov=fov, width=width, height=height)

    def detail(self, box: Box, *, enlarge: float) -> Camera:
        """Picture a part of the view on more pixels: the same eye, a smaller window.

        Parameters
        ----------
        box : Box
            Part of this camera's picture.
        enlarge : float
            Pixels of the detail to a pixel of the box.

        Raises
        ------
        RenderError
            If the box is not within the picture.
        """
        left, right, bottom, top = self.window
        if not (min(box.left, box.top) >= 0 and box.left + box.width <= self.width and box.top + box.height <= self.height):
            raise RenderError(f"{box} is not within the picture of {self.width} x {self.height} pixels")
        x, y = (right - left) / self.width, (top - bottom) / self.height
        window = (left + box.left * x, left + (box.left + box.width) * x, top - (box.top + box.height) * y, top - box.top * y)
        return replace(self, window=window, width=round(box.width * enlarge), height=round(box.height * enlarge))

    def project(self, points: ArrayLike) -> Array:
        """Find where points appear in the picture.

        Parameters
        ----------
        points : array_like, shape (n, 3), mm
            Before the eye, in the scene's frame.

        Returns
        -------
        ndarray, shape (n, 2), pixels
            Column and row from the picture's upper left corner; pixel centres are at halves.
        """
        local = (np.asarray(points, float) - self.eye) @ self.axes
        left, right, bottom, top = self.window
        x, y = local[:, 0] / -local[:, 2], local[:, 1] / -local[:, 2]
        return np.column_stack([(x - left) / (right - left) * self.width, (top - y) / (top - bottom) * self.height])


def _axes(towards: ArrayLike, up: ArrayLike) -> Array:
    """Axes of a camera that the viewer's side `towards` is z of; shape (3, 3), columns."""
    z = np.asarray(towards, float)
    if z.shape != (3,) or not np.isfinite(z).all() or not np.linalg.norm(z) > 0:
        raise RenderError(f"a camera must look along a direction: eye and target coincide or are no places ({z.tolist()})")
    z = z / np.linalg.norm(z)
    for upwards in (np.asarray(up, float), np.array([0.0, 1, 0]), np.array([1.0, 0, 0])):
        x = np.cross(upwards, z)
        if np.linalg.norm(x) > 1e-6 * np.linalg.norm(upwards):
            x /= np.linalg.norm(x)
            return np.column_stack([x, np.cross(z, x), z])
    raise AssertionError("one of two perpendicular directions is not along z")
