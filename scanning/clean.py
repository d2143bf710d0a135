"""From a raw range image to the points of one petal.

The scanner looks along z: a jump is a difference of depth between neighbours on the grid. Depth alone is smoothed: x and y stay as
measured, so the outline of the petal cannot move, and a polynomial of second order through each point's own side of the rim (moving least
squares, one-sided at the rim) neither shrinks a curved surface nor pulls the rim's depth inwards, as a mean or a Gaussian would.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from scanning.errors import EmptyScanError
from scanning.rangeimage import Array, RangeImage

_LEAST_POINTS = 25
_SAMPLE = 4096
_LEAST_LEVELS = 5  # two surfaces parted by a jump are not a quantum


@dataclass(frozen=True)
class Cleaning:
    """How a scan is cleaned.

    Attributes
    ----------
    grazing : float, deg
        Largest angle of the normal against the line of sight; steeper parts are not to be trusted.
    jump : float, optional, mm
        Difference of depth at which two neighbours are two surfaces; by default the rise of one step at the grazing angle plus one quantum.
    spike : float
        Points farther than this many standard deviations (and one step) from the plane of their neighbours are removed.
    behind : float, optional, mm
        Everything with z below is background. What a jump separates from the petal, and lines the window's border, goes anyway.
    smooth : int, optional
        Radius of the smoothing window, grid steps; 0 leaves depths as measured. By default 3, and 5 where depth is quantised coarsely.
    """

    grazing: float = 80.0
    jump: float | None = None
    spike: float = 6.0
    behind: float | None = None
    smooth: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.grazing < 90:
            raise ValueError(f"grazing angle {self.grazing:g} deg is not between 0 and 90")
        if self.jump is not None and not self.jump > 0:
            raise ValueError(f"jump {self.jump:g} mm is not positive")
        if not self.spike > 0:
            raise ValueError(f"spike threshold {self.spike:g} is not positive")
        if self.smooth is not None and not 0 <= self.smooth <= 15:
            raise ValueError(f"smoothing radius {self.smooth} is not between 0 and 15 steps")


@dataclass(frozen=True, eq=False)
class Cleaned:
    """One surface, and what had to go.

    Attributes
    ----------
    image : RangeImage
        The points that stay, depth smoothed.
    jump : float, mm
        Depth difference taken for a jump.
    quantum : float, mm
        Step of the depth values, 0 where they are not quantised.
    roughness : float, mm
        Root mean square distance of measured depths from the local surface.
    removed : dict
        Count of points by reason: background, grazing, spike, island.
    """

    image: RangeImage
    jump: float
    quantum: float
    roughness: float
    removed: dict[str, int] = field(default_factory=dict)


def clean(image: RangeImage, how: Cleaning | None = None) -> Cleaned:
    """Keep the largest surface of a scan, without background, grazing parts, spikes and islands; smooth its depth.

    Parameters
    ----------
    image : RangeImage
        As measured, mm.
    how : Cleaning, optional
        Thresholds.

    Raises
    ------
    EmptyScanError
        Where fewer than 25 points are left.
    """
    from scanning import grid  # numba is slow to load

    how = how or Cleaning()
    step = image.step
    depth = np.ascontiguousarray(image.points[..., 2])
    quantum = depth_quantum(depth[image.valid])
    jump = how.jump if how.jump is not None else step * math.tan(math.radians(how.grazing)) + quantum
    removed: dict[str, int] = {}
    valid = image.valid

    def drop(reason: str, bad: NDArray[np.bool_]) -> None:
        nonlocal valid
        gone = valid & bad
        removed[reason] = removed.get(reason, 0) + int(gone.sum())
        valid = valid & ~bad
        if int(valid.sum()) < _LEAST_POINTS:
            raise EmptyScanError(
                f"only {int(valid.sum())} points are left after removing {', '.join(f'{n} ({why})' for why, n in removed.items())}",
                file=image.source or None,
                expected=f"at least {_LEAST_POINTS}",
                hint="Loosen the cleaning, or scan again",
            )

    with np.errstate(invalid="ignore"):
        drop("background", np.zeros_like(valid) if how.behind is None else depth < how.behind)
        drop("background", background(*grid.islands(depth, valid, jump)))
        far = grid.rim_distance(depth, valid, jump, 3)
        plane = grid.local_fit(depth, valid, jump, far, *_fit_weights(3, 1, False), True)
        residual = np.abs(plane - depth)
        known = residual[np.isfinite(residual)]
        spread = 1.4826 * float(np.median(known)) if known.size else 0.0
        drop("spike", residual > max(how.spike * spread, step))
        drop("grazing", _grazing(image.points, valid, step, how.grazing, quantum))
        label, count = grid.islands(depth, valid, jump)
        largest = int(np.argmax(np.bincount(label.ravel(), minlength=count + 1)[1:])) + 1
        drop("island", label != largest)

    radius = how.smooth if how.smooth is not None else (5 if quantum > step / 4 else 3)
    roughness_radius = radius or 3
    far = grid.rim_distance(depth, valid, jump, roughness_radius)
    fitted = grid.local_fit(depth, valid, jump, far, *_fit_weights(roughness_radius, 2, True), False)
    smooth = np.where(np.isfinite(fitted), fitted, depth)  # a point that too few others bear out stays as measured
    roughness = float(np.sqrt(np.mean((smooth[valid] - depth[valid]) ** 2)))
    points = image.points.copy()
    if radius:
        points[..., 2] = smooth
    points[~valid] = np.nan
    return Cleaned(RangeImage(points, valid, image.source), jump, quantum, roughness, removed)


def depth_quantum(depth: Array) -> float:
    """Step of quantised depths, mm; 0 where values hardly repeat.

    Looks at a sample: values that repeat, with gaps that are whole multiples of the smallest.
    """
    sample = np.unique(np.round(depth[:: max(1, len(depth) // _SAMPLE)], 6))
    gaps = np.diff(sample)
    if len(sample) < _LEAST_LEVELS or 4 * len(sample) > min(len(depth), _SAMPLE):
        return 0.0
    smallest = float(gaps.min())
    multiples = gaps / smallest
    return smallest if np.abs(multiples - np.round(multiples)).max() < 0.05 else 0.0


def background(label: NDArray[np.int32], count: int) -> NDArray[np.bool_]:
    """Pieces that reach three or all four sides of the window, where another, larger than a hundredth of them, does not."""
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    sides = sum(np.bincount(np.unique(edge), minlength=count + 1) for edge in (label[0], label[-1], label[:, 0], label[:, -1]))
    framing = np.asarray(sides) >= 3
    framing[0] = False
    inner = np.where(framing, 0, sizes)[1:]
    if not framing.any() or inner.size == 0 or inner.max() < max(_LEAST_POINTS, sizes[framing].max() / 100):
        return np.zeros(label.shape, dtype=bool)
    return np.asarray(framing[label])


def _grazing(points: Array, valid: NDArray[np.bool_], step: float, angle: float, quantum: float) -> NDArray[np.bool_]:
    """Points whose depth rises, over two steps of the grid, as steeply as the grazing angle on both axes' mean, quantum allowed for."""
    depth = np.where(valid, points[..., 2], np.nan)
    rise = np.zeros(depth.shape)
    for axis in (0, 1):
        moved = np.moveaxis(depth, axis, 0)
        slope = np.zeros(moved.shape)
        slope[1:-1] = np.nan_to_num(np.abs(moved[2:] - moved[:-2]), nan=0.0)
        rise += np.moveaxis(np.maximum(slope - quantum, 0.0), 0, axis) ** 2
    return np.asarray(rise > (2 * step * math.tan(math.radians(angle))) ** 2)


@lru_cache(maxsize=32)
def _fit_weights(radius: int, order: int, middle: bool) -> tuple[Array, Array, Array]:
    """Tables of a local polynomial fit, for `grid.local_fit`: weighted basis, its moments, and the fit over a full window as a kernel.

    Weights are Gaussian, of half the radius' width; without its middle, a point does not bear itself out.
    """
    offset = np.arange(-radius, radius + 1) / radius
    v, u = (axis.ravel() for axis in np.meshgrid(offset, offset, indexing="ij"))
    weights = np.exp(-2 * (u * u + v * v))
    if not middle:
        weights[weights.size // 2] = 0.0
    basis = np.stack([np.ones_like(u), u, v] + ([u * u, u * v, v * v] if order == 2 else []), axis=1)
    weighted = weights[:, None] * basis
    rows, columns = np.tril_indices(basis.shape[1])
    kernel = np.linalg.solve(basis.T @ weighted, weighted.T)[0]
    size = 2 * radius + 1
    return weighted, np.ascontiguousarray(weighted[:, rows] * basis[:, columns]), np.ascontiguousarray(kernel.reshape(size, size))
