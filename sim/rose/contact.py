"""Do sheets cross, and how near do they come: exact over triangles, a uniform grid to find the pairs."""

from functools import cache
from typing import Any

import numpy as np

from sim.rose.mesh import Array, Mesh


def crossings(a: Mesh, b: Mesh) -> int:
    """Count pairs of triangles, one of each mesh, of which an edge of one meets the other."""
    if not _boxes_meet(a, b, 0.0):
        return 0
    return int(_kernels()["crossings"](a.corners, b.corners, _cell(b)))


def clearance(a: Mesh, b: Mesh, within: float = 5.0) -> float:
    """Return the least distance between two meshes in mm, 0 when they cross; `inf` when it is not below `within`.

    Exact: the least over vertex to face and edge to edge of every pair of triangles that could be nearest.
    """
    if not _boxes_meet(a, b, within):
        return float("inf")
    # Vertices bound the distance from above; triangles nearer than that bound have vertices nearer than the bound and their two edges.
    edges = float(a.edges.max() + b.edges.max())
    between = b.tree.query(a.vertices, distance_upper_bound=within + edges)[0]
    if not np.isfinite(between).any():
        return float("inf")
    if crossings(a, b):
        return 0.0
    bound = min(within, float(between.min()) * (1 + 1e-9))
    to_b = between[a.faces].min(axis=1)
    nearest_first = np.argsort(to_b)
    nearest_first = nearest_first[: np.searchsorted(to_b[nearest_first], bound + edges, side="right")]
    found = float(_kernels()["clearance"](a.corners[nearest_first], b.corners, bound, _cell(b)))
    return found if found < within else float("inf")


def hits(origins: Array, directions: Array, mesh: Mesh, nearest: float = 1e-6) -> np.ndarray:
    """Tell which rays meet a mesh further along than `nearest` mm; origins and directions (n, 3), result (n,) of bool."""
    found: np.ndarray = _kernels()["hits"](np.ascontiguousarray(origins), np.ascontiguousarray(directions), mesh.corners, nearest)
    return found


def _boxes_meet(a: Mesh, b: Mesh, within: float) -> bool:
    low, high = np.maximum(a.box[0], b.box[0]), np.minimum(a.box[1], b.box[1])
    return bool(np.linalg.norm(np.clip(low - high, 0, None)) <= within)


def _cell(mesh: Mesh) -> float:
    """Side of the grid's cells, mm: no triangle reaches over more than two of them in any direction."""
    return max(float(mesh.edges.max()), 0.25)


@cache
def _kernels() -> dict[str, Any]:
    # Compiled on first use: numba takes a second to load.
    from sim.rose import kernels

    return {"crossings": kernels.count_crossings, "clearance": kernels.least_distance, "hits": kernels.rays_hit}
