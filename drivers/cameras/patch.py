"""Where in a picture to measure, and what is there: among markers, on a colour chart, or in a rectangle.

Coordinates are pixels of the mosaic, x to the right and y down, whole numbers at the pixels' centres.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.errors import PatchNotFound
from drivers.cameras.frame import CHANNELS, Frame
from drivers.errors import InvalidSetting

CORNERS = ("top left", "top right", "bottom right", "bottom left")
DICTIONARY = "DICT_4X4_50"
MARGIN = 0.2
PATCHES = 24
_PATCH_MARGIN = 0.4  # of a chart's patch: its edge is blurred, and the frame's shadow falls on it
_FORMS = "markers, markers:A,B,C,D, chart:NUMBER or X,Y,WIDTH,HEIGHT"


@dataclass(frozen=True)
class Region:
    """A convex quadrangle, corners in order round it, (x, y) each."""

    corners: tuple[tuple[float, float], ...]

    def mask(self, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """Which pixels have their centres inside, for a picture of `shape` (height, width)."""
        y, x = np.arange(shape[0])[:, None], np.arange(shape[1])[None, :]
        area = _area(np.array(self.corners))
        inside = np.ones((shape[0], shape[1]), dtype=bool)
        for (x0, y0), (x1, y1) in zip(self.corners, (*self.corners[1:], self.corners[0]), strict=True):
            inside &= ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) * np.sign(area) >= 0
        return inside

    def shrunk(self, margin: float) -> Region:
        """The same with each corner `margin` of the way towards the middle."""
        points = np.array(self.corners)
        return _region(points + margin * (points.mean(axis=0) - points))


@dataclass(frozen=True)
class Statistics:
    """What the pixels of one channel say in a region.

    Attributes
    ----------
    mean, spread : float
        Mean and standard deviation, fractions of black to white.
    count, saturated : int
        Pixels, and how many of them are saturated.
    """

    mean: float
    spread: float
    count: int
    saturated: int


Finder = Callable[[Frame], Region]


def statistics(frame: Frame, region: Region) -> dict[str, Statistics]:
    """Measure each channel in a region.

    Raises
    ------
    PatchNotFound
        The region reaches beyond the picture, or has fewer than two pixels of a channel.
    """
    height, width = frame.values.shape
    points = np.array(region.corners)
    if points.min() < -0.5 or points[:, 0].max() > width - 0.5 or points[:, 1].max() > height - 0.5:
        raise _missing(frame, f"the patch reaches beyond the picture: {_listed(region)}", f"within {width} x {height} pixels")
    top, left = np.maximum(np.floor(points.min(axis=0)).astype(int)[::-1], 0)
    bottom, right = np.ceil(points.max(axis=0)).astype(int)[::-1] + 1
    values, saturated = frame.values[top:bottom, left:right], frame.saturated[top:bottom, left:right]
    inside = Region(tuple((x - left, y - top) for x, y in region.corners)).mask(values.shape)
    found = {}
    for channel in CHANNELS:
        chosen = inside & frame.mask(channel)[top:bottom, left:right]
        pixels = values[chosen].astype(float)
        if pixels.size < 2:
            raise _missing(frame, f"{pixels.size} {channel} pixels in the patch", "at least 2")
        found[channel] = Statistics(float(pixels.mean()), float(pixels.std(ddof=1)), pixels.size, int(saturated[chosen].sum()))
    return found


def find_markers(frame: Frame, ids: Sequence[int] = (0, 1, 2, 3), dictionary: str = DICTIONARY, margin: float = MARGIN) -> Region:
    """Find four ArUco markers round a petal; the patch is what lies between them, less a margin.

    Parameters
    ----------
    ids : four ints
        Of the markers at the top left, top right, bottom right and bottom left of the petal, in whatever way the camera is held.
    dictionary : str
        OpenCV's name of it.
    margin : float
        How far the corners of the patch stand back, as a fraction of the way to its middle.

    Raises
    ------
    PatchNotFound
        A marker is missing (the message says which) or there twice, or they stand otherwise.
    """
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_dictionary(dictionary)), parameters)
    corners, numbers, _ = detector.detectMarkers(stretched(frame.binned().mean(axis=-1)))
    seen = [] if numbers is None else [int(number) for number in numbers.flat]
    lost = [f"{number} ({CORNERS[place]})" for place, number in enumerate(ids) if number not in seen]
    there = ", ".join(map(str, sorted(seen))) or "none"
    if lost:
        problem = f"marker{'s' if len(lost) > 1 else ''} {', '.join(lost)} missing; found {there}"
        raise _missing(frame, problem, f"markers {', '.join(map(str, ids))} of {dictionary}", "look at light, focus and reflections")
    if any(seen.count(number) > 1 for number in ids):
        raise _missing(frame, f"a marker is there more than once: found {there}", "each marker once")
    squares = np.array([2 * corners[seen.index(number)].reshape(4, 2).astype(float) + 0.5 for number in ids])
    middle = squares.mean(axis=(0, 1))
    nearest = np.linalg.norm(squares - middle, axis=-1).argmin(axis=1)
    inner = squares[np.arange(4), nearest]
    if not _convex(inner):
        raise _missing(frame, "the markers stand in another order", f"{', '.join(map(str, ids))} from the top left clockwise")
    return _region(inner).shrunk(margin)


def find_chart(frame: Frame) -> tuple[Region, ...]:
    """Find a ColorChecker of 24 patches; they come row by row from dark skin (1) to black (24), the edges of each left out.

    Raises
    ------
    PatchNotFound
        There is none in the picture.
    """
    import cv2

    light = frame.binned()
    picture = np.dstack([stretched(light[..., channel]) for channel in (2, 1, 0)])  # blue first, and white balanced by the stretch
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(picture, 1):
        raise _missing(frame, "no colour chart found", f"a ColorChecker of {PATCHES} patches", "let it fill more of the picture")
    points = np.asarray(detector.getBestColorChecker().getColorCharts(), dtype=float).reshape(PATCHES, 4, 2)
    return tuple(_region(2 * patch + 0.5).shrunk(_PATCH_MARGIN) for patch in points)


def rectangle(x: int, y: int, width: int, height: int) -> Region:
    """The rectangle of `width` x `height` pixels whose top left pixel is (x, y)."""
    left, top, right, bottom = x - 0.5, y - 0.5, x + width - 0.5, y + height - 0.5
    return Region(((left, top), (right, top), (right, bottom), (left, bottom)))


def finder(text: str, dictionary: str = DICTIONARY, margin: float = MARGIN) -> Finder:
    """Understand ``markers``, ``markers:0,1,2,3``, ``chart:22`` or ``x,y,width,height``.

    Raises
    ------
    InvalidSetting
        None of these.
    """
    if not 0 <= margin < 1:
        raise InvalidSetting(f"margin {margin}", expected="from 0 to below 1")
    kind, _, rest = text.partition(":")
    numbers = [int(number) for number in rest.split(",")] if re.fullmatch(r"\d{1,6}(,\d{1,6})*", rest) else []
    if kind == "markers" and (not rest or len(set(numbers)) == len(numbers) == 4):
        _dictionary(dictionary)
        return lambda frame: find_markers(frame, numbers or (0, 1, 2, 3), dictionary, margin)
    if kind == "chart" and len(numbers) == 1 and 1 <= numbers[0] <= PATCHES:
        return lambda frame: find_chart(frame)[numbers[0] - 1]
    if re.fullmatch(r"\d{1,6}(,\d{1,6}){3}", text):
        x, y, width, height = (int(number) for number in text.split(","))
        if width > 0 and height > 0:
            return lambda frame: rectangle(x, y, width, height)
    raise InvalidSetting(f"patch {text!r}", expected=_FORMS)


def stretched(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Make linear light a picture of 8 bits for OpenCV: its 1st and 99th percentile become black and white, with a gamma of 2."""
    low, high = np.percentile(light, (1, 99))
    scaled = np.clip((light - low) / max(high - low, 1e-6), 0, 1)
    return np.asarray(np.rint(255 * np.sqrt(scaled)), dtype=np.uint8)


def _dictionary(name: str) -> int:
    import cv2

    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        raise InvalidSetting(f"dictionary {name!r}", expected="OpenCV's name of an ArUco dictionary, such as DICT_4X4_50")
    return number


def _missing(frame: Frame, problem: str, expected: str, hint: str = "") -> PatchNotFound:
    return PatchNotFound(problem, attempt=f"looking for the patch in {frame.path}", expected=expected, hint=hint)


def _region(points: NDArray[np.float64]) -> Region:
    return Region(tuple((float(x), float(y)) for x, y in points))


def _area(points: NDArray[np.float64]) -> float:
    x, y = points.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def _convex(points: NDArray[np.float64]) -> bool:
    """Whether four points turn right at each corner, as they do clockwise where y points down."""
    sides = np.roll(points, -1, axis=0) - points
    after = np.roll(sides, -1, axis=0)
    return bool((sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0] > 0).all())


def _listed(region: Region) -> str:
    return ", ".join(f"({x:.1f}, {y:.1f})" for x, y in region.corners)
