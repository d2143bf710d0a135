"""A range image: points on the grid they were measured on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanning.errors import EmptyScanError

Array = NDArray[np.float64]

_SAMPLED = 25  # rows and columns, at least, whose spacing is looked at


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Points of one scan, on the sensor's grid.

    Attributes
    ----------
    points : ndarray, shape (H, W, 3), mm
        Scan frame: x right, y up, z towards the sensor. NaN where nothing was measured.
    valid : ndarray of bool, shape (H, W)
        Where a point was measured.
    source : str
        File it was read from, for messages and provenance.
    """

    points: Array
    valid: NDArray[np.bool_]
    source: str = ""

    def __post_init__(self) -> None:
        if self.points.ndim != 3 or self.points.shape[2] != 3 or self.valid.shape != self.points.shape[:2]:
            raise ValueError(f"points {self.points.shape} and valid {self.valid.shape} do not make a grid (H, W, 3) and (H, W)")
        finite = np.isfinite(self.points)
        if not (finite[..., 0] & finite[..., 1] & finite[..., 2] | ~self.valid).all():
            raise ValueError("a point that is said to be valid is not finite")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.valid.shape[0], self.valid.shape[1]

    @cached_property
    def step(self) -> float:
        """Median distance of neighbouring points across the line of sight, mm.

        Raises
        ------
        EmptyScanError
            Where no two neighbours were both measured, or all lie at one place.
        """
        lengths = np.empty(0)
        for sampled in (_SAMPLED, max(self.shape)):
            rows, columns = (slice(None, None, max(1, size // sampled)) for size in self.shape)
            across = neighbour_distances(self.points[rows], self.valid[rows], 1)
            lengths = np.concatenate([across, neighbour_distances(self.points[:, columns], self.valid[:, columns], 0)])
            if lengths.size >= _SAMPLED:
                break
        step = float(np.median(lengths)) if lengths.size else 0.0
        if not step > 0:
            raise EmptyScanError(
                "no two neighbouring points were measured at different places",
                file=self.source or None,
                hint="Scan again, nearer or with more light returned",
            )
        return step


def neighbour_distances(points: Array, valid: NDArray[np.bool_], axis: int) -> Array:
    """Distances across the line of sight (in x and y) of valid neighbours along an axis of the grid, mm, shape (n,)."""
    first, second = (slice(None, -1), slice(1, None)) if axis == 0 else ((slice(None), slice(None, -1)), (slice(None), slice(1, None)))
    apart = np.hypot(points[second][..., 0] - points[first][..., 0], points[second][..., 1] - points[first][..., 1])
    return np.asarray(apart[valid[first] & valid[second]], dtype=np.float64)
