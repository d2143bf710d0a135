"""The petal's surface as a polygon mesh on the measured points, adjacency from the measurement grid (paper, Figure 11)."""

from __future__ import annotations

import numpy as np

from scanning.errors import EmptyScanError
from scanning.mesh import TriangleMesh
from scanning.rangeimage import RangeImage

_SAMPLED = 50  # pairs of rows, at least, that are asked which way the grid runs


def triangulate(image: RangeImage, jump: float) -> TriangleMesh:
    """Join neighbouring points to triangles.

    One sheet, manifold (each edge in at most two triangles, one fan at each vertex), normals to the sensor (+z), no triangle across a jump.

    Parameters
    ----------
    image : RangeImage
        Cleaned.
    jump : float, mm
        Largest difference of depth within a triangle.

    Raises
    ------
    EmptyScanError
        Where no three neighbours are linked.
    """
    from scanning import grid

    triangles = grid.grid_triangles(image.points, image.valid, jump, _turned(image))
    if len(triangles) == 0:
        raise EmptyScanError("no three neighbouring points make a triangle", file=image.source or None, hint="Scan again, nearer")
    count = image.valid.size
    triangles = triangles[grid.keep_one_sheet(triangles, count)]
    used = np.zeros(count, dtype=bool)
    used[triangles.ravel()] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return TriangleMesh(image.points.reshape(-1, 3)[used], number[triangles])


def _turned(image: RangeImage) -> bool:
    """Whether going round a square of the grid as right, then down, is clockwise seen from the sensor."""
    turn = 0.0
    for every in (max(1, len(image.valid) // _SAMPLED), 1):
        rows = np.arange(0, len(image.valid) - 1, every)
        points = np.stack([image.points[rows], image.points[rows + 1]], axis=1)
        valid = np.stack([image.valid[rows], image.valid[rows + 1]], axis=1)
        ok = valid[:, 0, :-1] & valid[:, 0, 1:] & valid[:, 1, :-1]
        corner = points[:, 0, :-1][ok]
        right, down = points[:, 0, 1:][ok] - corner, points[:, 1, :-1][ok] - corner
        turn = float(np.sum(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]))
        if turn:
            break
    return turn < 0
