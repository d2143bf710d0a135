"""Contact of open sheets: signed gaps along a sheet's normal, and the edges that pierce another sheet.

A signed distance does not exist for an open sheet. Here a gap's sign comes from knowing on which side of the other petal a petal belongs,
and a closest point counts only where it says something about that: inside the other sheet's rim, near, on the same side of the stem, and
between sheets that face the same way (else a petal finds the far side of the flower).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.poses import Array, inverse, moved

Index = NDArray[np.int64]

REACH = 5.0  # mm, farther than any petal is pushed through another by measuring errors of a few degrees
SIDEWAYS = 0.75  # of a gap's height: a nearest point on the rim lies farther aside
SAME_SIDE = np.cos(np.radians(75.0))  # of the azimuths of the two points
FACING_ALIKE = 0.35  # least dot product of the two normals
NORMAL_PASSES = 4  # of averaging over the neighbours: a scanned sheet's normals are noisy


@dataclass(frozen=True)
class Sheet:
    """A petal's triangles in their own frame, ready for closest-point queries.

    Parameters
    ----------
    vertices : (N, 3) mm.
    triangles : (M, 3) indices, counter-clockwise seen from the inner face.
    """

    vertices: Array
    triangles: Index

    @cached_property
    def edges(self) -> Index:
        """(E, 2) vertex indices, each edge once."""
        return np.unique(self._half_edges, axis=0)

    @cached_property
    def rim(self) -> Index:
        """Indices of the vertices on the sheet's boundary."""
        edges, count = np.unique(self._half_edges, axis=0, return_counts=True)
        return np.unique(edges[count == 1])

    @cached_property
    def normals(self) -> Array:
        """(N, 3) unit normals towards the inner face, averaged over a few neighbours."""
        from scipy.sparse import coo_matrix

        a, b, c = (self.vertices[self.triangles[:, corner]] for corner in range(3))
        normals = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(normals, self.triangles[:, corner], np.cross(b - a, c - a))
        i, j = self.edges.T
        n = len(self.vertices)
        near = coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (n, n)).tocsr()
        for _ in range(NORMAL_PASSES):
            normals = normals + near @ normals
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    @cached_property
    def scene(self) -> Any:
        """Open3D's scene of the triangles."""
        import open3d as o3d

        scene: Any = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.triangles.astype(np.uint32))
        return scene

    @cached_property
    def tree(self) -> Any:
        """SciPy's k-d tree of the vertices."""
        from scipy.spatial import cKDTree

        return cKDTree(self.vertices)

    @cached_property
    def step(self) -> float:
        """Length of the longest edge but one in a hundred, mm."""
        return float(np.percentile(self._lengths, 99))

    @cached_property
    def longest(self) -> float:
        """Length of the longest edge, mm."""
        return float(self._lengths.max())

    @cached_property
    def _lengths(self) -> Array:
        return np.linalg.norm(self.vertices[self.edges[:, 0]] - self.vertices[self.edges[:, 1]], axis=1)

    @cached_property
    def box(self) -> Array:
        """(2, 3) lowest and highest corner, mm."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @cached_property
    def _half_edges(self) -> Index:
        return np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)

    def near_box(self, points: Array, reach: float) -> NDArray[np.bool_]:
        """Tell which points (N, 3) of the sheet's frame lie within `reach` mm of its box."""
        return np.all((points > self.box[0] - reach) & (points < self.box[1] + reach), axis=1)


def samples(sheet: Sheet, count: int, rng: np.random.Generator) -> Index:
    """Choose about `count` vertices: rim and inside half and half at most, drawn without replacement."""
    rim = sheet.rim if len(sheet.rim) <= count // 2 else rng.choice(sheet.rim, count // 2, replace=False)
    inside = np.setdiff1d(np.arange(len(sheet.vertices)), sheet.rim)
    return np.sort(np.r_[rim, rng.choice(inside, min(len(inside), count - len(rim)), replace=False)])


@dataclass(frozen=True)
class Gaps:
    """Where petal `i`'s points stand before petal `j`'s sheet; all in the flower's frame, mm.

    Attributes
    ----------
    i, j : (M,) petal numbers.
    p, c : (M, 3) point of i, and the closest point of j.
    n : (M, 3) unit normal of j's sheet at c, towards its inner face.
    """

    i: Index
    j: Index
    p: Array
    c: Array
    n: Array

    @property
    def height(self) -> Array:
        """(M,) mm by which the points stand on the inner face's side of the other sheet."""
        return np.einsum("mi,mi->m", self.p - self.c, self.n)

    def where(self, which: NDArray[np.bool_]) -> "Gaps":
        """Return the gaps that `which` (M,) picks."""
        return Gaps(self.i[which], self.j[which], self.p[which], self.c[which], self.n[which])


def gaps(sheets: list[Sheet], poses: Array, chosen: list[Index], pairs: list[tuple[int, int]] | None = None, reach: float = REACH) -> Gaps:
    """Return the gaps between the chosen vertices of each petal and the sheets of the others.

    A sheet is taken as the tangent planes at its vertices: the error is half its curvature times the squared step of the mesh, 0.01 mm for
    a step of 0.4 mm and a radius of 8 mm, and a nearest vertex is found much faster than a nearest triangle.

    Parameters
    ----------
    sheets, poses : K sheets and their T_flower_scan (K, 4, 4).
    chosen : K arrays of vertex indices.
    pairs : the (i, j) to look at; default all.
    reach : largest distance that counts, mm.
    """
    inverses = [inverse(pose) for pose in poses]
    found: list[tuple[Index, Index, Array, Array, Array]] = []
    points = [moved(pose, sheet.vertices[index]) for pose, sheet, index in zip(poses, sheets, chosen, strict=True)]
    normals = [sheet.normals[index] @ pose[:3, :3].T for pose, sheet, index in zip(poses, sheets, chosen, strict=True)]
    for i, j in pairs if pairs is not None else [(i, j) for i in range(len(sheets)) for j in range(len(sheets)) if i != j]:
        local = moved(inverses[j], points[i])
        index = np.flatnonzero(sheets[j].near_box(local, reach))
        distance, nearest = sheets[j].tree.query(local[index], distance_upper_bound=reach, workers=-1)
        index, nearest, distance = index[distance < reach], nearest[distance < reach], distance[distance < reach]
        n = sheets[j].normals[nearest] @ poses[j][:3, :3].T
        p = points[i][index]
        height = np.einsum("mi,mi->m", p - moved(poses[j], sheets[j].vertices[nearest]), n)
        c = p - height[:, None] * n
        across = np.hypot(p[:, 0], p[:, 1]) * np.hypot(c[:, 0], c[:, 1])
        # Over the rim, or over a hole, the nearest vertex lies more sideways than a step of the mesh explains.
        sideways = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
        counts = (
            (sideways < np.maximum(sheets[j].step, SIDEWAYS * np.abs(height)))
            & (np.einsum("mi,mi->m", normals[i][index], n) > FACING_ALIKE)
            & (np.einsum("mi,mi->m", p[:, :2], c[:, :2]) >= SAME_SIDE * across)
        )
        m = int(counts.sum())
        found.append((np.full(m, i), np.full(m, j), p[counts], c[counts], n[counts]))
    if not found:
        return Gaps(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    i_, j_, p_, c_, n_ = (np.concatenate(column) for column in zip(*found, strict=True))
    return Gaps(i_, j_, p_, c_, n_)


def crossings(sheets: list[Sheet], poses: Array) -> dict[tuple[int, int], Index]:
    """Return the edges that pierce another sheet, over the full meshes.

    Two triangles in general position intersect only where an edge of one passes through the other, so no entry means no intersection.

    Returns
    -------
    {(i, j): indices of edges of petal i that pass through petal j}; empty when no two petals intersect.
    """
    out: dict[tuple[int, int], Index] = {}
    placed = [moved(pose, sheet.vertices) for pose, sheet in zip(poses, sheets, strict=True)]
    for j, target in enumerate(sheets):
        back = inverse(poses[j])
        low, high = placed[j].min(0), placed[j].max(0)
        for i, source in enumerate(sheets):
            if i == j or np.any(placed[i].min(0) > high) or np.any(placed[i].max(0) < low):
                continue
            local = moved(back, placed[i])
            # An edge is short beside a petal: one end within its longest edge of the box is every edge that can reach it.
            edges = source.edges
            index = np.flatnonzero(target.near_box(local, source.longest)[edges].any(1))
            if not len(index):
                continue
            start, end = local[edges[index, 0]], local[edges[index, 1]]
            rays = _tensor(np.hstack([start, end - start]))
            pierced = target.scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()
            if pierced.any():
                out[i, j] = index[pierced]
    return out


def clearance(sheets: list[Sheet], poses: Array) -> float:
    """Return the least distance between the vertices of one petal and the sheet of another, mm (inf for a single petal)."""
    least = np.inf
    placed = [moved(pose, sheet.vertices) for pose, sheet in zip(poses, sheets, strict=True)]
    for j, target in enumerate(sheets):
        back = inverse(poses[j])
        for i in range(len(sheets)):
            if i == j:
                continue
            local = moved(back, placed[i])
            # Only what a quick look at the nearest vertices leaves as possible is measured against the triangles.
            bound = float(min(least, np.ptp(np.concatenate([local, target.box]), axis=0).sum()))
            local = local[target.near_box(local, bound)]
            distance = target.tree.query(local, distance_upper_bound=bound + target.longest, workers=-1)[0]
            local = local[distance <= min(bound, distance.min(initial=np.inf)) + target.longest]
            if len(local):
                least = min(least, float(target.scene.compute_distance(_tensor(local)).numpy().min()))
    return least


def _tensor(points: Array) -> Any:
    import open3d as o3d

    core: Any = o3d.core
    return core.Tensor(np.ascontiguousarray(points, dtype=np.float32))
