"""The simulated camera: its files as LibRaw reads them, its noise, and how it delivers."""

from __future__ import annotations

import asyncio
import io
import math
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
from PIL import ExifTags, Image

from sim.camera import POLL, SHUTTER, CameraModel, Scene, SimulatedCamera, dng, expose
from sim.clock import ManualClock
from sim.errors import SimError

TAKEN = datetime(2026, 5, 4, 3, 2, 1)


def opened(data: bytes) -> rawpy.RawPy:
    raw = rawpy.RawPy()
    raw.open_buffer(io.BytesIO(data))
    raw.unpack()
    return raw


@pytest.mark.parametrize("byte_order", ["<", ">"])
@pytest.mark.parametrize("model", [CameraModel(width=64, height=40, black=256, white=4095, exposure=1 / 250, iso=3200), CameraModel()])
def test_libraw_reads_what_was_written(model: CameraModel, byte_order: Any) -> None:
    mosaic = np.random.default_rng(1).integers(0, model.white + 1, (model.height, model.width)).astype(np.uint16)
    with opened(dng(mosaic, model, TAKEN, byte_order)) as raw:
        assert (raw.raw_image_visible == mosaic).all()
        assert raw.black_level_per_channel == [model.black] * 4
        assert raw.white_level == model.white
        assert raw.color_desc == b"RGBG"
        assert raw.raw_pattern is not None
        assert raw.raw_pattern.tolist() == [[0, 1], [3, 2]]
        assert raw.other.shutter_speed == pytest.approx(model.exposure, rel=1e-6)
        assert raw.other.iso_speed == model.iso
        assert raw.other.timestamp == TAKEN


def test_another_reader_finds_the_camera_and_the_date() -> None:
    model = CameraModel(width=64, height=40, make="Somebody", model="Something", serial_number="77")
    exif = Image.Exif()
    exif.load(dng(np.zeros((40, 64), np.uint16), model, TAKEN))
    names = {ExifTags.TAGS.get(tag, str(tag)): value for tag, value in exif.items()}
    names |= {ExifTags.TAGS[tag]: value for tag, value in exif.get_ifd(ExifTags.IFD.Exif).items()}
    assert (names["Make"], names["Model"], names["BodySerialNumber"], names["CameraSerialNumber"]) == ("Somebody", "Something", "77", "77")
    assert names["DateTime"] == names["DateTimeOriginal"] == "2026:05:04 03:02:01"
    assert (names["ExposureTime"], names["ISOSpeedRatings"], names["Software"]) == (pytest.approx(0.1), 100, "SIMULATED")


@pytest.mark.parametrize("missing", [2, 1000, 614000])
def test_libraw_refuses_what_is_cut_short(missing: int) -> None:
    whole = dng(np.zeros((480, 640), np.uint16), CameraModel(), TAKEN)
    with pytest.raises(rawpy.LibRawIOError):
        opened(whole[:-missing])


def shots(light: float, count: int = 1, **settings: Any) -> np.ndarray:
    """Pixels that see nothing but the petal, above black, by colour: (count, pixels) of red, green and blue."""
    model, rng = CameraModel(width=128, height=96, **settings), np.random.default_rng(5)
    table, petal = np.zeros((96, 128, 3)), np.ones((96, 128))
    taken = np.array([expose(table, petal, light, model, rng) for _ in range(count)], dtype=float) - model.black
    return np.array([taken[:, 0::2, 0::2], taken[:, 0::2, 1::2], taken[:, 1::2, 1::2]]).reshape(3, count, -1)


@pytest.mark.parametrize(("exposure", "iso"), [(0.1, 100), (0.02, 100), (0.02, 400)])
def test_the_mean_is_light_times_exposure_times_gain(exposure: float, iso: int) -> None:
    means = shots(2.0, exposure=exposure, iso=iso).mean(axis=(1, 2)) / 14848
    assert means == pytest.approx(np.array([1.2, 1.0, 0.5]) * 2.0 * exposure * iso / 100, rel=0.005)


@pytest.mark.parametrize("iso", [100, 400])
def test_the_noise_is_that_of_the_electrons(iso: int) -> None:
    gain = 14848 / 30000 * iso / 100  # counts an electron
    variances = shots(0.5, 20, iso=iso).var(axis=(1, 2))
    electrons = np.array([1.2, 1.0, 0.5]) * 0.5 * 0.1 * 30000
    assert variances == pytest.approx(gain**2 * (electrons + 9.0) + 1 / 12, rel=0.02)


def test_it_saturates_at_white_and_knows_negative_noise() -> None:
    assert (shots(50.0) == 14848).all()
    dark = shots(0.0, 4)
    assert dark.min() < 0 < dark.max()
    assert abs(dark.mean()) < 0.03


@pytest.mark.parametrize("settings", [{"width": 641}, {"height": 0}, {"black": 512, "white": 512}, {"white": 70000}, {"exposure": 0.0}])
def test_a_camera_that_cannot_be(settings: dict[str, Any]) -> None:
    with pytest.raises(SimError):
        CameraModel(**settings)


def test_the_scene_has_its_markers_paper_and_petal() -> None:
    table, petal = Scene(missing=(3,)).draw(640, 480)
    corners = Scene().corners(640, 480)
    assert np.allclose(corners, [(119.5, 119.5), (519.5, 119.5), (519.5, 359.5), (119.5, 359.5)])
    assert petal[240, 320] == 1
    assert petal[60, 60] == 0
    assert petal.mean() == pytest.approx(400 * 240 / (640 * 480) * 0.97, rel=0.02)
    assert (table[45:115, 45:115] < 0.5).any()  # the marker at the top left
    assert np.allclose(table[365:435, 45:115], 0.9)  # and none at the bottom left
    turned, _ = Scene(turn=180, missing=(3,)).draw(640, 480)
    assert np.allclose(turned, table[::-1, ::-1], atol=0.02)


class Light:
    """A light that remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[float, float]] = []

    def __call__(self, begin: float, end: float) -> float:
        self.asked.append((begin, end))
        return 2.0


def camera(folder: Path, clock: ManualClock, light: Callable[[float, float], float], delivery: Any) -> SimulatedCamera:
    model = CameraModel(width=128, height=96, exposure=0.25)
    return SimulatedCamera(folder, clock, light, np.random.default_rng(1), model, delivery=delivery)


@pytest.mark.parametrize("delivery", ["pieces", "rename"])
def test_a_file_comes_bit_by_bit(tmp_path: Path, delivery: str) -> None:
    light, seen = Light(), []

    async def main() -> None:
        clock = ManualClock()
        shooting = asyncio.create_task(camera(tmp_path, clock, light, delivery).shoot())
        await clock.advance(0.24)
        assert not list(tmp_path.iterdir())  # still exposing
        while not shooting.done():
            await clock.advance(SimulatedCamera.PAUSE)
            seen.append({path.name: path.stat().st_size for path in tmp_path.iterdir()})

    asyncio.run(main())
    assert light.asked == [(0.0, 0.25)]
    growing = "IMG_0001.dng" if delivery == "pieces" else "IMG_0001.dng.part"
    whole = tmp_path / "IMG_0001.dng"
    size = whole.stat().st_size
    assert seen[:8] == [{growing: min(size, number * math.ceil(size / 8))} for number in range(1, 9)]
    assert seen[-1] == {"IMG_0001.dng": size}
    with opened(whole.read_bytes()) as raw:
        assert raw.other.shutter_speed == pytest.approx(0.25)


def test_whoever_presses_the_shutter_gets_a_picture_and_none_comes_by_itself(tmp_path: Path) -> None:
    light = Light()

    async def main() -> None:
        clock = ManualClock()
        ours = camera(tmp_path, clock, light, "rename")
        running = asyncio.create_task(ours.run())
        await clock.advance(5.0)
        assert not light.asked
        for number in (1, 2):
            (tmp_path / SHUTTER).touch()
            await clock.advance(POLL + 0.25 + 9 * SimulatedCamera.PAUSE)
            assert len(light.asked) == number
            assert sorted(path.name for path in tmp_path.iterdir()) == [f"IMG_000{one}.dng" for one in range(1, number + 1)]
        assert ours.taken == sorted(tmp_path.iterdir())
        assert ours.url == f"folder:{tmp_path}"
        running.cancel()

    asyncio.run(main())
    assert light.asked[0][1] - light.asked[0][0] == 0.25


def test_no_picture_is_written_over_another(tmp_path: Path) -> None:
    (tmp_path / "IMG_0001.dng").touch()
    with pytest.raises(SimError, match="there already"):
        asyncio.run(camera(tmp_path, ManualClock(eager=True), Light(), "rename").shoot())
