"""One picture of a camera as linear light, straight from the sensor: black level taken off, scaled to the white level, nothing clipped."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.cameras import tiff
from drivers.cameras.errors import IncompleteFrame, NotRaw, UnusableFrame
from drivers.kinds import Identity

if TYPE_CHECKING:
    import rawpy

Pair = tuple[float, float]
CHANNELS = ("R", "G", "B")
NOT_TOLD = "not told"


@dataclass(frozen=True, eq=False)
class Frame:
    """A Bayer mosaic.

    Attributes
    ----------
    values : ndarray of float32, shape (height, width)
        Linear: 0 at the black level, 1 at the white level of the pixel's own filter. Below black it is negative.
    saturated : ndarray of bool, shape (height, width)
        At or above the white level.
    colours : tuple of two pairs of str
        ``R``, ``G`` or ``B`` of the two by two pixels at the top left; the pattern repeats.
    black, white : tuple of two pairs of float
        Levels of those pixels, as stored.
    exposure_s : float, s
    iso : float, optional
    taken : datetime, optional
        By the camera's clock, whole seconds.
    identity : Identity
        The camera, as far as the file tells.
    path : Path
    """

    values: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    colours: tuple[tuple[str, str], tuple[str, str]]
    black: tuple[Pair, Pair]
    white: tuple[Pair, Pair]
    exposure_s: float
    iso: float | None
    taken: datetime | None
    identity: Identity
    path: Path

    def mask(self, channel: str) -> NDArray[np.bool_]:
        """Which pixels are of a channel, shape (height, width)."""
        tile = np.array([[colour == channel for colour in row] for row in self.colours])
        height, width = self.values.shape
        return np.tile(tile, (-(-height // 2), -(-width // 2)))[:height, :width]

    def step(self, channel: str) -> float:
        """One count of the converter, in `values`; of the coarsest pixel of a channel."""
        ours = [(y, x) for y in range(2) for x in range(2) if self.colours[y][x] == channel]
        return max(1 / (self.white[y][x] - self.black[y][x]) for y, x in ours)

    def binned(self) -> NDArray[np.float32]:
        """Two by two pixels as one, shape (height // 2, width // 2, 3): red, the mean of the greens, blue; for finding things."""
        height, width = (size // 2 * 2 for size in self.values.shape)
        planes: dict[str, list[NDArray[np.float32]]] = {channel: [] for channel in CHANNELS}
        for y, row in enumerate(self.colours):
            for x, colour in enumerate(row):
                planes[colour].append(self.values[y:height:2, x:width:2])
        return np.stack([np.mean(planes[channel], axis=0) for channel in CHANNELS], axis=-1)


def read_frame(path: Path) -> Frame:
    """Read a RAW file with LibRaw.

    Raises
    ------
    IncompleteFrame
        It cannot be read, is cut short or is damaged.
    NotRaw
        It is not a RAW file, or not one that LibRaw knows.
    UnusableFrame
        It has no exposure time, its black level is not below the white level, or its pixels are not a Bayer mosaic of red, green and blue.
    """
    attempt = f"reading {path}"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise IncompleteFrame(f"it cannot be read: {error.strerror or error}", attempt=attempt) from error
    return decode(data, path)


def decode(data: bytes, path: Path) -> Frame:
    """Make a frame of a file's bytes; see `read_frame`."""
    import rawpy

    attempt = f"reading {path}"
    outline = tiff.outline(data)
    if not data or (outline is not None and outline.size > len(data)):
        expected = f"at least {outline.size} bytes" if outline else "a RAW file"
        raise IncompleteFrame(f"cut short: {len(data)} bytes", attempt=attempt, expected=expected)
    with rawpy.RawPy() as raw:
        try:
            raw.open_buffer(io.BytesIO(data))
            raw.unpack()
        except (rawpy.LibRawFileUnsupportedError, rawpy.LibRawRequestForNonexistentImageError, rawpy.LibRawNotImplementedError) as error:
            raise NotRaw("no RAW file that LibRaw knows", raw=data[:8], attempt=attempt, hint="set the camera to RAW") from error
        except (rawpy.LibRawError, rawpy.NotSupportedError, OSError, MemoryError) as error:
            told = error.args[0].decode("ascii", "replace") if error.args and isinstance(error.args[0], bytes) else str(error)
            raise IncompleteFrame(f"cut short or damaged: LibRaw says {told!r}", attempt=attempt) from error
        camera = outline or tiff.Outline(0)
        identity = Identity(camera.make or NOT_TOLD, camera.model or NOT_TOLD, camera.serial_number or NOT_TOLD, NOT_TOLD)
        return _frame(raw, identity, path)


def _frame(raw: rawpy.RawPy, identity: Identity, path: Path) -> Frame:
    attempt = f"reading {path}"
    try:
        told, mosaic, colours = raw.other, raw.raw_image_visible, raw.raw_colors_visible
        exposure_s, iso, taken = float(told.shutter_speed), float(told.iso_speed), told.timestamp
    except (ValueError, OverflowError, OSError, NotImplementedError, TypeError, AttributeError) as error:  # a date or a mosaic beyond rawpy
        raise UnusableFrame(f"rawpy cannot tell what is in it: {error}", attempt=attempt) from error
    if mosaic is None or mosaic.ndim != 2 or min(mosaic.shape) < 2:
        raise UnusableFrame("not a mosaic of single pixels", attempt=attempt, hint="switch off sRAW, mRAW and pixel shift")
    letters = raw.color_desc.decode("ascii", "replace")
    indices = np.asarray(colours[:2, :2], dtype=int)
    found = "".join(letters[index] if index < len(letters) else "?" for index in indices.flat)
    if not _repeats(colours) or sorted(found) != ["B", "G", "G", "R"]:
        raise UnusableFrame(f"a mosaic that begins {found}", attempt=attempt, expected="a Bayer mosaic of R, G, G and B")
    if not 0 < exposure_s < math.inf:
        raise UnusableFrame("no exposure time", attempt=attempt, hint="use a program that keeps the camera's Exif data")
    black = np.array(raw.black_level_per_channel, dtype=float)[indices]
    white = np.array(_white(raw), dtype=float)[indices]
    if not (black < white).all():
        levels = f"black {_listed(black)}, white {_listed(white)}"
        raise UnusableFrame(f"levels that cannot be: {levels}", attempt=attempt, expected="black below white")
    height, width = mosaic.shape
    repeats = (-(-height // 2), -(-width // 2))
    blacks, whites = (np.tile(level, repeats)[:height, :width].astype(np.float32) for level in (black, white))
    return Frame(
        values=(mosaic - blacks) / (whites - blacks),
        saturated=mosaic >= whites,
        colours=((found[0], found[1]), (found[2], found[3])),
        black=_pairs(black),
        white=_pairs(white),
        exposure_s=exposure_s,
        iso=iso if 0 < iso < math.inf else None,
        taken=taken if taken.timestamp() > 0 else None,
        identity=identity,
        path=path,
    )


def _white(raw: rawpy.RawPy) -> list[int]:
    """White level of LibRaw's four colours: where the converter ends, or below that where the camera says it stops being linear."""
    linear, highest = raw.camera_white_level_per_channel or [0] * 4, min(raw.white_level, 0xFFFF)
    return [min(highest, level) if level > 0 else highest for level in linear]


def _repeats(colours: NDArray[np.uint8]) -> bool:
    return all((colours[y::2, x::2] == colours[y, x]).all() for y in range(2) for x in range(2))


def _pairs(levels: NDArray[np.float64]) -> tuple[Pair, Pair]:
    (a, b), (c, d) = levels.tolist()
    return (a, b), (c, d)


def _listed(levels: NDArray[np.float64]) -> str:
    return "/".join(f"{level:g}" for level in levels.flat)
