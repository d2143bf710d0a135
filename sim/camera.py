"""Simulated tethered camera: takes pictures of a petal among markers, or of a colour chart, and drops them into a folder as DNG files.

Source: TIFF 6.0 (header, image file directories, strips), TIFF/EP and DNG 1.4 (colour filter array, black and white level), Exif 2.3
(exposure time, sensitivity, body serial number). The pictures are uncompressed, 16 bits a pixel, RGGB.

Simulated are shot and read noise, gain by ISO, rounding and clipping at the white level; not simulated are lens, vignetting, fixed pattern
and dark current. A person or a remote release presses the shutter: whoever makes the file `SHUTTER` in the folder.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.clock import Clock
from sim.errors import SimError

SHUTTER = ".shutter"
"""A file of this name in the folder presses the shutter; the camera takes it away."""
POLL = 0.02
"""How often the camera looks whether somebody presses the shutter, s of simulated time."""
COLOURS = (("R", "G"), ("G", "B"))
"""Of the colour filters, row by row from the top left."""

Floats = NDArray[np.float64]
Signal = Callable[[float, float], float]
"""Mean brightness of the petal between two simulated times, s."""

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL = 1, 2, 3, 4, 5, 10
_FORMATS = {_BYTE: "B", _SHORT: "H", _LONG: "I"}
_EXIF_IFD = 34665

# sRGB of the 24 patches of a ColorChecker, row by row from dark skin.
_CHART = (
    *((115, 82, 68), (194, 150, 130), (98, 122, 157), (87, 108, 67), (133, 128, 177), (103, 189, 170)),
    *((214, 126, 44), (80, 91, 166), (193, 90, 99), (94, 60, 108), (157, 188, 64), (224, 163, 46)),
    *((56, 61, 150), (70, 148, 73), (175, 54, 60), (231, 199, 31), (187, 86, 149), (8, 133, 161)),
    *((243, 243, 242), (200, 200, 200), (160, 160, 160), (122, 122, 121), (85, 85, 85), (52, 52, 52)),
)


@dataclass(frozen=True)
class CameraModel:
    """A camera and how it is set.

    Attributes
    ----------
    width, height : int
        Pixels, even.
    black, white : int
        Levels without light and at saturation.
    exposure : float, s
    iso : int
    full_well : float
        Electrons that take a pixel from black to white at ISO 100.
    read_noise : float
        rms, electrons.
    sensitivity : tuple of float
        Fraction of black to white per second at ISO 100 for a signal of 1, for red, green and blue.
    paper : float
        Brightness of the markers' white paper, fraction of black to white per second at ISO 100; it is lit by the room, not by the lamp.
    make, model, serial_number : str
    """

    width: int = 640
    height: int = 480
    black: int = 512
    white: int = 15360
    exposure: float = 0.1
    iso: int = 100
    full_well: float = 30000.0
    read_noise: float = 3.0
    sensitivity: tuple[float, float, float] = (1.2, 1.0, 0.5)
    paper: float = 4.0
    make: str = "Simulated"
    model: str = "Petal camera"
    serial_number: str = "000042"

    def __post_init__(self) -> None:
        if self.width < 2 or self.height < 2 or self.width % 2 or self.height % 2:
            raise SimError(f"a camera of {self.width} x {self.height} pixels: expected even numbers")
        if not 0 <= self.black < self.white <= 0xFFFF:
            raise SimError(f"black {self.black} and white {self.white}: expected 0 <= black < white <= 65535")
        if not (self.exposure > 0 and self.iso > 0 and self.full_well > 0 and self.read_noise >= 0):
            raise SimError("exposure, iso and full_well must be above 0, read_noise not below")


@dataclass(frozen=True)
class Scene:
    """What the camera looks at, seen from straight above or not.

    Attributes
    ----------
    subject : str
        ``petal`` (among four markers) or ``chart`` (a ColorChecker of 24 patches, lit by the room).
    markers : tuple of int
        Ids from the top left clockwise.
    missing : tuple of int
        Those of them that are not there.
    tilt : float, deg
        How far the paper is turned away about its vertical middle line, in perspective.
    turn : float, deg
        How far it is turned in the picture.
    size : float
        Of the paper in the picture; 1 fills it.
    """

    subject: Literal["petal", "chart"] = "petal"
    dictionary: str = "DICT_4X4_50"
    markers: tuple[int, int, int, int] = (0, 1, 2, 3)
    missing: tuple[int, ...] = ()
    tilt: float = 0.0
    turn: float = 0.0
    size: float = 1.0

    def draw(self, width: int, height: int) -> tuple[Floats, Floats]:
        """Return what the room lights, linear reflectance (height, width, 3), and how much of each pixel is petal (height, width)."""
        import cv2

        flat, petal = self._chart(width, height) if self.subject == "chart" else self._petal(width, height)
        view = self._view(width, height)
        table = cv2.warpPerspective(flat, view, (width, height), flags=cv2.INTER_LINEAR, borderValue=(0.02, 0.02, 0.02))
        seen = cv2.warpPerspective(petal, view, (width, height), flags=cv2.INTER_LINEAR, borderValue=0.0)
        return np.asarray(table, dtype=float), np.asarray(seen, dtype=float)

    def corners(self, width: int, height: int) -> Floats:
        """Return where the inner corners of the markers are in the picture, (4, 2), x and y in pixels, from the top left clockwise."""
        import cv2

        side, gap = self._sizes(width, height)
        left, right, top, bottom = gap + side - 0.5, width - gap - side - 0.5, gap + side - 0.5, height - gap - side - 0.5
        flat = np.array([[[left, top], [right, top], [right, bottom], [left, bottom]]])
        return np.asarray(cv2.perspectiveTransform(flat, self._view(width, height))[0], dtype=float)

    def _sizes(self, width: int, height: int) -> tuple[int, int]:
        side = min(width, height) // 6
        return side, side // 2

    def _petal(self, width: int, height: int) -> tuple[Floats, Floats]:
        import cv2

        side, gap = self._sizes(width, height)
        paper = np.full((height, width, 3), 0.9)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        left, right, top, bottom = gap, width - gap - side, gap, height - gap - side
        for number, (column, row) in zip(self.markers, ((left, top), (right, top), (right, bottom), (left, bottom)), strict=True):
            if number not in self.missing:
                printed = cv2.aruco.generateImageMarker(dictionary, number, side)
                paper[row : row + side, column : column + side] = np.where(printed > 0, 0.9, 0.04)[..., None]
        x, y = (np.arange(width) + 0.5) / width * 2 - 1, (np.arange(height) + 0.5) / height * 2 - 1
        reach_x, reach_y = 1 - 2 * (gap + side) / width, 1 - 2 * (gap + side) / height
        petal = (np.abs(x / reach_x)[None, :] ** 6 + np.abs(y / reach_y)[:, None] ** 6 <= 1).astype(float)
        return paper, petal

    def _chart(self, width: int, height: int) -> tuple[Floats, Floats]:
        chart = np.full((height, width, 3), 0.35)
        patch = min(width // 8, height // 6)
        gap = patch // 6
        across, down = 6 * patch + 7 * gap, 4 * patch + 5 * gap
        left, top = (width - across) // 2, (height - down) // 2
        chart[top : top + down, left : left + across] = 0.03
        for index, colour in enumerate(_CHART):
            row, column = divmod(index, 6)
            y, x = top + gap + row * (patch + gap), left + gap + column * (patch + gap)
            chart[y : y + patch, x : x + patch] = [_linear(value / 255) for value in colour]
        return chart, np.zeros((height, width))

    def _view(self, width: int, height: int) -> Floats:
        """Homography from the flat paper to the picture, pixels with whole numbers at their centres."""
        middle = np.array([[1, 0, -(width - 1) / 2], [0, 1, -(height - 1) / 2], [0, 0, 1]])
        scaled = np.diag([self.size, self.size, 1.0])
        tilt, turn, distance = math.radians(self.tilt), math.radians(self.turn), 2.0 * width
        tilted = np.array([[math.cos(tilt), 0, 0], [0, 1, 0], [math.sin(tilt) / distance, 0, 1]])
        turned = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        return np.asarray(np.linalg.inv(middle) @ turned @ tilted @ scaled @ middle)


def expose(table: Floats, petal: Floats, signal: float, model: CameraModel, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Take a picture: the mosaic of pixel values (height, width), of what the room lights and a petal of brightness `signal`."""
    plane = np.array([[("RGB").index(colour) for colour in row] for row in COLOURS])
    channel = np.tile(plane, (table.shape[0] // 2, table.shape[1] // 2))
    room = np.take_along_axis(table, channel[..., None], axis=2)[..., 0] * model.paper
    lit = np.asarray(model.sensitivity)[channel] * signal
    rate = room * (1 - petal) + lit * petal  # fraction of black to white per second, at ISO 100
    electrons = rng.poisson(np.maximum(rate, 0) * model.exposure * model.full_well) + rng.normal(0, model.read_noise, rate.shape)
    gain = (model.white - model.black) / model.full_well * model.iso / 100
    return np.clip(np.rint(model.black + electrons * gain), 0, model.white).astype(np.uint16)


def dng(mosaic: NDArray[np.uint16], model: CameraModel, taken: datetime, byte_order: Literal["<", ">"] = "<") -> bytes:
    """Write a mosaic (height, width) as a DNG file; the pixels come last."""
    height, width = mosaic.shape
    date = taken.strftime("%Y:%m:%d %H:%M:%S")
    pixels = mosaic.astype(f"{byte_order}u2").tobytes()
    colours = ["RGB".index(colour) for row in COLOURS for colour in row]
    exif: list[_Entry] = [
        (33434, _RATIONAL, [_fraction(model.exposure)]),  # ExposureTime
        (34855, _SHORT, [model.iso]),  # PhotographicSensitivity
        (36864, 7, list(b"0230")),  # ExifVersion
        (36867, _ASCII, date),  # DateTimeOriginal
        (42033, _ASCII, model.serial_number),  # BodySerialNumber
    ]
    main: list[_Entry] = [
        (254, _LONG, [0]),  # NewSubFileType
        (256, _LONG, [width]),
        (257, _LONG, [height]),
        (258, _SHORT, [16]),  # BitsPerSample
        (259, _SHORT, [1]),  # Compression: none
        (262, _SHORT, [32803]),  # PhotometricInterpretation: colour filter array
        (271, _ASCII, model.make),
        (272, _ASCII, model.model),
        (273, _LONG, [0]),  # StripOffsets, known below
        (274, _SHORT, [1]),  # Orientation
        (277, _SHORT, [1]),  # SamplesPerPixel
        (278, _LONG, [height]),  # RowsPerStrip
        (279, _LONG, [len(pixels)]),  # StripByteCounts
        (284, _SHORT, [1]),  # PlanarConfiguration
        (305, _ASCII, "SIMULATED"),  # Software
        (306, _ASCII, date),
        (33421, _SHORT, [2, 2]),  # CFARepeatPatternDim
        (33422, _BYTE, colours),  # CFAPattern
        (_EXIF_IFD, _LONG, [0]),  # known below
        (50706, _BYTE, [1, 4, 0, 0]),  # DNGVersion
        (50707, _BYTE, [1, 1, 0, 0]),  # DNGBackwardVersion
        (50708, _ASCII, f"{model.make} {model.model}"),  # UniqueCameraModel
        (50710, _BYTE, [0, 1, 2]),  # CFAPlaneColor
        (50711, _SHORT, [1]),  # CFALayout: rectangular
        (50713, _SHORT, [2, 2]),  # BlackLevelRepeatDim
        (50714, _SHORT, [model.black] * 4),  # BlackLevel
        (50717, _LONG, [model.white]),  # WhiteLevel
        (50721, _SRATIONAL, [Fraction(value) for value in (1, 0, 0, 0, 1, 0, 0, 0, 1)]),  # ColorMatrix1
        (50728, _RATIONAL, [Fraction(1)] * 3),  # AsShotNeutral
        (50735, _ASCII, model.serial_number),  # CameraSerialNumber
        (50778, _SHORT, [21]),  # CalibrationIlluminant1: D65
    ]
    first = 8
    second = first + len(_directory(main, first, byte_order))
    start = second + len(_directory(exif, second, byte_order))
    known = {273: [start], _EXIF_IFD: [second]}
    main = [(tag, kind, known.get(tag, values)) for tag, kind, values in main]
    header = (b"II" if byte_order == "<" else b"MM") + struct.pack(f"{byte_order}HI", 42, first)
    return header + _directory(main, first, byte_order) + _directory(exif, second, byte_order) + pixels


class SimulatedCamera:
    """A tethered camera that drops what it takes into a folder.

    Parameters
    ----------
    folder : Path
        There already.
    clock : Clock
    signal : callable
        ``signal(t0, t1)``: mean brightness of the petal; times `CameraModel.sensitivity` it is the fraction of black to white per second.
    rng : numpy.random.Generator
    model, scene
        May be changed between pictures.
    delivery : str
        ``pieces``: the file grows under its own name; ``rename``: under another, and is renamed when it is whole.
    name : str
        Of the files, with the number of the picture.
    """

    PIECES = 8
    PAUSE = 0.03
    """A file is written in so many pieces, with so long a pause after each, s."""

    def __init__(
        self,
        folder: Path,
        clock: Clock,
        signal: Signal,
        rng: np.random.Generator,
        model: CameraModel | None = None,
        scene: Scene | None = None,
        *,
        delivery: Literal["pieces", "rename"] = "rename",
        name: str = "IMG_{:04d}.dng",
    ) -> None:
        self.folder = folder
        self.model = model or CameraModel()
        self.scene = scene or Scene()
        self.delivery = delivery
        self.taken: list[Path] = []
        self._name = name
        self._clock, self._signal, self._rng = clock, signal, rng
        self._drawn: tuple[object, Floats, Floats] | None = None

    @property
    def url(self) -> str:
        """What the folder is called as a port."""
        return f"folder:{self.folder}"

    async def run(self) -> None:
        """Take a picture whenever the shutter is pressed, until cancelled."""
        while True:
            try:
                (self.folder / SHUTTER).unlink()
            except FileNotFoundError:
                await self._clock.sleep(POLL)
            else:
                await self.shoot()

    async def shoot(self) -> Path:
        """Expose for as long as the camera is set to, and deliver the file."""
        begin = self._clock.now()
        await self._clock.sleep_until(begin + self.model.exposure)
        table, petal = self._scenery()
        mosaic = expose(table, petal, self._signal(begin, begin + self.model.exposure), self.model, self._rng)
        path = self.folder / self._name.format(len(self.taken) + 1)
        self.taken.append(path)
        await self._deliver(dng(mosaic, self.model, datetime(2001, 1, 1) + timedelta(seconds=begin)), path)
        return path

    async def _deliver(self, content: bytes, path: Path) -> None:
        if path.exists():
            raise SimError(f"{path} is there already")
        written = path.with_name(f"{path.name}.part") if self.delivery == "rename" else path
        size = math.ceil(len(content) / self.PIECES)
        with written.open("wb", buffering=0) as file:
            for begin in range(0, len(content), size):
                file.write(content[begin : begin + size])
                await self._clock.sleep(self.PAUSE)
        os.replace(written, path)

    def _scenery(self) -> tuple[Floats, Floats]:
        key = (self.scene, self.model.width, self.model.height)
        if self._drawn is None or self._drawn[0] != key:
            self._drawn = (key, *self.scene.draw(self.model.width, self.model.height))
        return self._drawn[1:]


_Entry = tuple[int, int, Sequence[int] | Sequence[Fraction] | str]


def _directory(entries: Sequence[_Entry], offset: int, order: str) -> bytes:
    """An image file directory at `offset`, and behind it the values too long to stand in it."""
    table, beyond = struct.pack(f"{order}H", len(entries)), b""
    outside = offset + 2 + 12 * len(entries) + 4
    for tag, kind, values in sorted(entries, key=lambda entry: entry[0]):
        data, count = _packed(kind, values, order)
        if len(data) <= 4:
            field = data.ljust(4, b"\0")
        else:
            field = struct.pack(f"{order}I", outside + len(beyond))
            beyond += data + b"\0" * (len(data) % 2)
        table += struct.pack(f"{order}HHI", tag, kind, count) + field
    return table + b"\0\0\0\0" + beyond


def _packed(kind: int, values: Sequence[int] | Sequence[Fraction] | str, order: str) -> tuple[bytes, int]:
    if isinstance(values, str):
        data = values.encode("ascii") + b"\0"
        return data, len(data)
    if kind in (_RATIONAL, _SRATIONAL):
        form = "II" if kind == _RATIONAL else "ii"
        return b"".join(struct.pack(f"{order}{form}", value.numerator, value.denominator) for value in values), len(values)
    return struct.pack(f"{order}{len(values)}{_FORMATS.get(kind, 'B')}", *values), len(values)


def _fraction(value: float) -> Fraction:
    return Fraction(value).limit_denominator(1_000_000)


def _linear(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
