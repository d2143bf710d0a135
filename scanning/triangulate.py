"""The petal's surface as a polygon mesh on the measured points, adjacency from the measurement grid (paper, Figure 11)."""

from __future__ import annotations

import numpy as np

from scanning.errors import EmptyScanError
from scanning.mesh import TriangleMesh
from scanning.rangeimage import RangeImage


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

    depth = np.where(image.valid, image.points[..., 2], np.nan)
    square = grid.squares(image.points, depth, jump)
    grid.part_fans(square)
    grid.largest_sheet(square)
    mesh = TriangleMesh(*grid.sheet(image.points, square, grid.turn(image.points, depth) < 0))
    if len(mesh.triangles) == 0:
        raise EmptyScanError("no three neighbouring points make a triangle", file=image.source or None, hint="Scan again, nearer")
    return mesh
