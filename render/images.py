"""Pictures into files: linear radiance to sRGB .png and to OpenEXR .exr; boxes and details for the paper's Figure 13."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from render.camera import Box
from render.errors import RenderError
from render.raycast import Picture

Single = NDArray[np.float32]
Pixels = NDArray[np.uint8]


def exposure(picture: Picture, share: float = 0.995) -> float:
    """Find the radiance to show as white: the given quantile over the pixels that are wholly of the scene.

    Raises
    ------
    RenderError
        If no pixel is, or all of them are dark.
    """
    inside = picture.radiance[picture.coverage == 1]
    white = float(np.quantile(inside, share)) if inside.size else 0.0
    if not white > 0:
        raise RenderError("nothing bright in the picture to expose for: check camera and light, or give the radiance of white yourself")
    return white


def develop(picture: Picture, white: float, *, colour: tuple[float, float, float] = (1, 1, 1), background: float = 0.0) -> Pixels:
    """Bring a picture to 8-bit sRGB (IEC 61966-2-1).

    Parameters
    ----------
    picture : Picture
    white : float
        Radiance shown as full white; what is brighter is shown as white too.
    colour : tuple of float
        Linear red, green and blue of a reflectance without colour of its own, 0 to 1.
    background : float
        Linear grey behind the scene, 0 to 1.

    Returns
    -------
    ndarray of uint8, shape (h, w, 3), red, green, blue

    Raises
    ------
    RenderError
        If white is not above 0.
    """
    if not (np.isfinite(white) and white > 0):
        raise RenderError(f"white must be a radiance above 0, not {white:g}")
    linear = _channels(picture.radiance) / white * np.asarray(colour, float) + background * (1 - picture.coverage[..., None])
    linear = np.minimum(linear, 1)
    return np.rint(255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)).astype(
        np.uint8
    )


def boxed(image: Pixels, box: Box, *, colour: tuple[int, int, int] = (255, 255, 255), thickness: int = 2) -> Pixels:
    """Draw the outline of a box, outside of it, on a copy of an image.

    Raises
    ------
    RenderError
        If the box is not within the image.
    """
    height, width = image.shape[:2]
    top, bottom, left, right = box.top, box.top + box.height, box.left, box.left + box.width
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise RenderError(f"{box} is not within the image of {width} x {height} pixels")
    out = image.copy()
    inside = image[top:bottom, left:right]
    out[max(0, top - thickness) : bottom + thickness, max(0, left - thickness) : right + thickness] = colour
    out[top:bottom, left:right] = inside
    return out


def write_png(image: Pixels, path: str | Path) -> None:
    """Write an 8-bit image of red, green and blue.

    Raises
    ------
    RenderError
        If the file cannot be written.
    """
    import cv2

    done, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise RenderError(f"{path}: an image of shape {image.shape} and type {image.dtype} cannot be written as .png")
    _write(Path(path), data.tobytes())


def write_exr(picture: Picture, path: str | Path) -> None:
    """Write linear radiance, coverage as alpha, as 32-bit OpenEXR without compression.

    Channels A, B, G, R in one scan-line part; a picture without colour has three equal ones. Layout: "OpenEXR File Layout", openexr.com.

    Raises
    ------
    RenderError
        If the file cannot be written.
    """
    rgb = _channels(picture.radiance)
    planes = [picture.coverage, rgb[..., 2], rgb[..., 1], rgb[..., 0]]  # alphabetical, as the format asks
    height, width = picture.coverage.shape
    channels = b"".join(name + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for name in (b"A", b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        (b"channels", b"chlist", channels),
        (b"compression", b"compression", b"\0"),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
        (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0, 0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    )
    header = struct.pack("<2i", 20000630, 2)
    header += b"".join(name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value for name, kind, value in attributes) + b"\0"
    line = np.dtype([("y", "<i4"), ("size", "<i4"), ("values", "<f4", (len(planes), width))])
    lines = np.empty(height, line)
    lines["y"], lines["size"] = np.arange(height), 4 * len(planes) * width
    lines["values"] = np.stack(planes, axis=1)
    offsets = len(header) + 8 * height + np.arange(height, dtype="<u8") * line.itemsize
    _write(Path(path), header + offsets.astype("<u8").tobytes() + lines.tobytes())


def _channels(radiance: Single) -> Single:
    return radiance if radiance.ndim == 3 else np.repeat(radiance[..., None], 3, axis=-1)


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise RenderError(f"{path}: cannot be written ({error.strerror})") from error
