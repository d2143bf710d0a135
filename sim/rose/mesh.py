"""Triangle mesh of one petal."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """Triangles that turn counter-clockwise seen from the petal's inner face.

    Parameters
    ----------
    vertices
        (n, 3), mm.
    faces
        (m, 3), indices into `vertices`.
    """

    vertices: Array
    faces: NDArray[np.int64]

    @cached_property
    def corners(self) -> Array:
        """Corners of each face, mm, shape (m, 3, 3)."""
        return np.ascontiguousarray(self.vertices[self.faces])

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates, mm, each of shape (3,)."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @cached_property
    def edges(self) -> Array:
        """Lengths of each face's edges, mm, shape (m, 3)."""
        return np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=1), axis=2)

    @cached_property
    def tree(self) -> "cKDTree":
        """Search tree over the vertices."""
        from scipy.spatial import cKDTree

        return cKDTree(self.vertices)

    def moved(self, transform: Array) -> "Mesh":
        """Return the mesh moved by a 4x4 transform, p' = T p."""
        return Mesh(apply(transform, self.vertices), self.faces)

    def areas(self) -> Array:
        """Return the area of each face, mm^2, shape (m,)."""
        return np.linalg.norm(self._crossed(), axis=1) / 2

    def face_normals(self) -> Array:
        """Return the unit normal of each face, towards the inner face's side, shape (m, 3)."""
        crossed = self._crossed()
        return crossed / np.linalg.norm(crossed, axis=1, keepdims=True)

    def vertex_normals(self) -> Array:
        """Return area-weighted unit normals of the vertices, towards the inner face's side, shape (n, 3)."""
        total = np.zeros_like(self.vertices)
        crossed = self._crossed()
        for corner in range(3):
            np.add.at(total, self.faces[:, corner], crossed)
        return total / np.linalg.norm(total, axis=1, keepdims=True)

    def mean_normal(self) -> Array:
        """Return the unit vector along the sum of the area vectors, shape (3,)."""
        total = self._crossed().sum(axis=0)
        return total / np.linalg.norm(total)

    def _crossed(self) -> Array:
        a, b, c = self.corners.transpose(1, 0, 2)
        return np.cross(b - a, c - a)


def apply(transform: Array, points: Array) -> Array:
    """Move points (..., 3) by a 4x4 transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def rigid(rotation: Array, translation: Array) -> Array:
    """Build a 4x4 transform from a rotation (3, 3) and a translation (3,), mm."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def inverse(transform: Array) -> Array:
    """Invert a rigid 4x4 transform."""
    rotation = transform[:3, :3].T
    return rigid(rotation, -rotation @ transform[:3, 3])
