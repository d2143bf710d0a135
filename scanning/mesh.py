"""Triangle meshes of open surfaces, and what can be told from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """An oriented surface.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3), mm
        Corners.
    triangles : ndarray of int32, shape (m, 3)
        Corners of each triangle, counter-clockwise seen from the side its normal points to.
    """

    vertices: Array
    triangles: Indices

    def transformed(self, T_target_source: Array) -> TriangleMesh:
        """Return the mesh brought to another frame by a rigid transform, shape (4, 4), mm."""
        return TriangleMesh(self.vertices @ T_target_source[:3, :3].T + T_target_source[:3, 3], self.triangles)


def area_vectors(mesh: TriangleMesh) -> Array:
    """Normals of the triangles, as long as their areas, shape (m, 3), mm^2."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a) / 2, dtype=np.float64)


def area(mesh: TriangleMesh) -> float:
    """Area of the surface, mm^2."""
    return float(np.linalg.norm(area_vectors(mesh), axis=1).sum())


def vertex_normals(mesh: TriangleMesh) -> Array:
    """Unit normals at the vertices, means of the triangles around weighted by area, shape (n, 3); zero for a vertex of no triangle."""
    vectors = area_vectors(mesh)
    total = np.stack(
        [np.bincount(mesh.triangles.ravel(), weights=np.repeat(vectors[:, axis], 3), minlength=len(mesh.vertices)) for axis in range(3)],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.divide(total, length, out=np.zeros_like(total), where=length > 0)


def vertex_areas(mesh: TriangleMesh) -> Array:
    """A third of the area of the triangles around each vertex, shape (n,), mm^2; their sum is the surface's area."""
    thirds = np.linalg.norm(area_vectors(mesh), axis=1) / 3
    return np.asarray(np.bincount(mesh.triangles.ravel(), weights=np.repeat(thirds, 3), minlength=len(mesh.vertices)), dtype=np.float64)


def boundary_loops(triangles: Indices) -> list[Indices]:
    """Closed borders of an oriented surface, each as the vertices met on the way round, the surface on the left.

    The first is the one of most vertices: the rim of a petal; the others are holes.

    Raises
    ------
    ValueError
        Where the borders do not close, or touch at a vertex: the surface is no manifold.
    """
    if len(triangles) == 0:
        return []
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    count = int(triangles.max()) + 1
    forth = directed[:, 0] * count + directed[:, 1]
    back = directed[:, 1] * count + directed[:, 0]
    if len(np.unique(forth)) != len(forth):
        raise ValueError("an edge is used twice in the same direction: triangles are turned over, or more than two meet there")
    open_edges = directed[~np.isin(forth, back)]
    following = dict(open_edges.tolist())
    if len(following) != len(open_edges):
        raise ValueError("two borders touch at a vertex")
    loops = []
    while following:
        start, here = following.popitem()
        loop = [start]
        while here != start:
            loop.append(here)
            if here not in following:
                raise ValueError("a border does not close")
            here = following.pop(here)
        loops.append(np.array(loop, dtype=np.int32))
    return sorted(loops, key=len, reverse=True)


def loop_length(vertices: Array, loop: Indices) -> float:
    """Length of a closed border, mm."""
    corners = vertices[loop]
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum())
