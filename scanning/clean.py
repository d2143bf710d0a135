"""From a raw range image to the points of one petal.

The scanner looks along z: a jump is a difference of depth between neighbours on the grid. Depth is smoothed by a polynomial of second order
through each point's own side of the rim (moving least squares, one-sided at the rim): it neither shrinks a curved surface nor pulls the
rim's depth inwards, as a mean or a Gaussian would.

Single readings that went, half on the petal and half beside it, leave notches of a step in the rim. A notch with measured points on both
sides is closed: the depth of its point is not measured but extrapolated, by one step, from the surface beside it; x and y are those of the
place's line of sight. Nothing else is filled: no holes, nothing as wide as an island.

x and y stay as measured, but at the rim: the grid's staircase lies up to a step inside the outline, and each of its points moves, within
three quarters of a step, to the border half way between what was measured and what was not. Of the height of waves that the rim has itself
nine tenths stay where they are ten steps long, seven where they are five: shorter ones are not told from the staircase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanning.errors import EmptyScanError
from scanning.rangeimage import Array, RangeImage

_LEAST_POINTS = 25
_SAMPLE = 4096
_SAMPLED = 10_000
_LEAST_RADIUS, _MOST_RADIUS = 3, 10  # of the smoothing window, grid steps
_RADIUS_FOR_NOISE = 13.0  # measured on scans of virtual petals
_RIM_BLUR = 0.8  # grid steps: corners of the outline sharper than that are rounded
_RIM_MOVE = 0.75  # grid steps, at most: the corners of a staircase of 45 degrees lie 0.71 inside
_MOST_SINGLE = 3  # mixed points beside each other may hang together; a piece of more is an island
_NOTCH_NEIGHBOURS = 4  # of eight; a place beside a straight rim has three
_NOTCH_RADIUS = 5  # of the window a closed notch's depth comes from, at most: the smoothing does the rest
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
        Radius of the smoothing window, grid steps; 0 leaves points as measured. By default 3 to 10, by the noise (see `default_radius`).
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
        The points that stay and those of closed notches, depth smoothed and the rim's staircase straightened.
    jump : float, mm
        Depth difference taken for a jump.
    quantum : float, mm
        Step of the depth values, 0 where they are not quantised.
    roughness : float, mm
        Root mean square distance of measured depths from the local surface.
    removed : dict
        Count of readings by reason: background, grazing, spike, island.
    closed_notches : int
        How many of the removed readings' places have a point all the same, its depth extrapolated by one step.
    """

    image: RangeImage
    jump: float
    quantum: float
    roughness: float
    removed: dict[str, int] = field(default_factory=dict)
    closed_notches: int = 0


def clean(image: RangeImage, how: Cleaning | None = None) -> Cleaned:
    """Keep the largest surface of a scan, without background, grazing parts, spikes and islands; smooth its depth and its rim.

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
    depth = np.where(image.valid, image.points[..., 2], np.nan)
    quantum = depth_quantum(depth[image.valid])
    jump = how.jump if how.jump is not None else step * math.tan(math.radians(how.grazing)) + quantum
    removed: dict[str, int] = {}
    singles = np.zeros(image.shape, dtype=bool)  # readings that went for themselves, not with a piece or what lies behind

    def drop(reason: str, bad: NDArray[np.bool_], single: NDArray[np.bool_] | bool = False) -> None:
        gone = bad & ~np.isnan(depth)
        depth[gone] = np.nan
        singles[gone & single] = True
        removed[reason] = removed.get(reason, 0) + int(np.count_nonzero(gone))
        left = int(image.valid.sum()) - sum(removed.values())
        if left < _LEAST_POINTS:
            raise EmptyScanError(
                f"only {left} points are left after removing {', '.join(f'{n} ({why})' for why, n in removed.items())}",
                file=image.source or None,
                expected=f"at least {_LEAST_POINTS}",
                hint="Loosen the cleaning, or scan again",
            )

    def drop_islands(label: NDArray[np.int32], count: int) -> None:
        if count > 1:
            here = np.where(np.isnan(depth), 0, label)
            sizes = np.bincount(here.ravel(), minlength=count + 1)
            drop("island", here != int(np.argmax(sizes[1:])) + 1, (sizes <= _MOST_SINGLE)[here])

    drop("background", np.zeros(image.shape, dtype=bool) if how.behind is None else depth < how.behind)
    label, count = grid.islands(depth, jump)
    drop("background", background(label, count))
    front = ~np.isnan(depth)
    removed |= {"spike": 0, "grazing": 0, "island": 0}
    # What hangs free goes first: every window with a jump is gone through point by point.
    drop_islands(label, count)
    far = grid.rim_distance(depth, jump, 3)
    residual = np.abs(grid.plane_residual(depth, far, jump, fit_weights(3)))
    spread = 1.4826 * _median(residual)
    drop("spike", residual > max(how.spike * spread, step), True)
    drop("grazing", grid.too_steep(depth, jump, 2 * step * math.tan(math.radians(how.grazing)), quantum), True)
    drop_islands(*grid.islands(depth, jump))

    radius = how.smooth if how.smooth is not None else default_radius(spread, step)
    weights = fit_weights(radius or _LEAST_RADIUS)
    points = image.points
    closed = np.zeros(image.shape, dtype=bool)
    if radius and singles.any():
        points, places = points.copy(), singles & outside(depth)
        closed = grid.close_notches(points, depth, places, jump, _NOTCH_NEIGHBOURS, fit_weights(min(radius, _NOTCH_RADIUS)))
    far = grid.rim_distance(depth, jump, len(weights) // 2)
    valid = far >= 0
    # A point removed beside the petal was most likely half on it.
    cover = np.where(valid, 1.0, np.where(front & _beside(valid), 0.5, 0.0))
    move = grid.rim_moves(cover, far, _RIM_BLUR, _RIM_MOVE) if radius else np.zeros((*valid.shape, 2))
    smooth = grid.smoothed(depth, far, jump, weights, move)
    off = (smooth - depth)[(far > 0) & ~closed]
    roughness = float(np.sqrt(np.mean(off * off))) if off.size else 0.0
    points = grid.moved(points, depth, smooth if radius else depth, move)
    return Cleaned(RangeImage(points, valid, image.source), jump, quantum, roughness, removed, int(np.count_nonzero(closed)))


def default_radius(noise: float, step: float) -> int:
    """Radius of the smoothing window, grid steps, at which noise of depth (both mm) tilts the surface by about a degree.

    Halving a radius makes the tilt about four times larger.
    """
    return int(np.clip(round(_RADIUS_FOR_NOISE * math.sqrt(noise / step)), _LEAST_RADIUS, _MOST_RADIUS))


def fit_weights(radius: int) -> Array:
    """Weights of the points of a window along either axis: a Gaussian of half the radius' width, shape (2 radius + 1,)."""
    offset = np.arange(-radius, radius + 1) / radius
    return np.asarray(np.exp(-2 * offset * offset))


def _median(values: Array) -> float:
    """Median of what is finite in a sample; 0 where nothing is."""
    flat = values.ravel()[:: max(1, values.size // _SAMPLED)]
    flat = flat[np.isfinite(flat)]
    return float(np.median(flat)) if flat.size else 0.0


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Places with one of their four neighbours in the mask."""
    beside = np.zeros_like(mask)
    beside[1:] |= mask[:-1]
    beside[:-1] |= mask[1:]
    beside[:, 1:] |= mask[:, :-1]
    beside[:, :-1] |= mask[:, 1:]
    return beside


def outside(depth: Array) -> NDArray[np.bool_]:
    """Places without a point that hang together, over the four neighbours, with the window's border: those of holes do not."""
    from scanning import grid

    label, count = grid.islands(np.where(np.isnan(depth), 0.0, np.nan), 1.0)
    open_ = np.zeros(count + 1, dtype=bool)
    for edge in (label[0], label[-1], label[:, 0], label[:, -1]):
        open_[edge] = True
    open_[0] = False
    return np.asarray(open_[label])


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
