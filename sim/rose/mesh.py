"""Triangle mesh of one petal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
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
