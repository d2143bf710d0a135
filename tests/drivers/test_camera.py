"""The camera in a folder: frames out of RAW files, patches in pictures, and which files count."""

from __future__ import annotations

import math
import os
import struct
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.cameras import patch as patches
from drivers.cameras.errors import BadFrame, IncompleteFrame, NotRaw, PatchNotFound, UnusableFrame
from drivers.cameras.folder import DARK, POLL_S, SATURATED, FolderCamera, FolderLink
from drivers.cameras.frame import Frame, decode, read_frame
from drivers.cameras.patch import Region, find_chart, find_markers, finder, rectangle, statistics
from drivers.cameras.tiff import outline
from drivers.errors import DeviceError, DeviceFault, InvalidSetting, PortClosed, TransportTimeout
from drivers.kinds import Identity, LightSensor
from sim.camera import CameraModel, Scene, dng, expose

TAKEN = datetime(2026, 5, 4, 3, 2, 1)
NAME = Path("IMG_1.dng")
SMALL = CameraModel(width=32, height=24)


def picture(scene: Scene | None = None, light: float = 3.0, seed: int = 1, **settings: Any) -> bytes:
    """A DNG file of a petal of brightness `light`, 1/s in green."""
    model, scene = CameraModel(**settings), scene or Scene()
    mosaic = expose(*scene.draw(model.width, model.height), light, model, np.random.default_rng(seed))
    return dng(mosaic, model, TAKEN)


def frame(*args: Any, **settings: Any) -> Frame:
    return decode(picture(*args, **settings), NAME)


def even(level: int, model: CameraModel = SMALL) -> bytes:
    """A DNG file of one level all over."""
    return dng(np.full((model.height, model.width), level, np.uint16), model, TAKEN)


def altered(data: bytes, tag: int, kind: int, count: int, *, tag_now: int | None = None, value: bytes | None = None) -> bytes:
    """The file with an entry of its directories named otherwise, or holding another value."""
    place = data.index(struct.pack("<HHI", tag, kind, count))
    entry = struct.pack("<HHI", tag if tag_now is None else tag_now, kind, count) + (
        data[place + 8 : place + 12] if value is None else value
    )
    return data[:place] + entry + data[place + 12 :]


# Frames


@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_a_frame_is_what_was_stored_between_black_and_white(byte_order: Any) -> None:
    model = CameraModel(width=40, height=30, black=600, white=4000, exposure=1 / 125, iso=800)
    mosaic = np.random.default_rng(0).integers(0, 4001, (30, 40)).astype(np.uint16)
    found = decode(dng(mosaic, model, TAKEN, byte_order), NAME)
    assert np.allclose(found.values, (mosaic - 600.0) / 3400.0, atol=1e-6)
    assert found.values.min() < -0.15  # nothing clipped
    assert (found.saturated == (mosaic >= 4000)).all()
    assert (found.exposure_s, found.iso, found.taken) == (pytest.approx(1 / 125, rel=1e-6), 800, TAKEN)
    assert (found.black, found.white) == (((600, 600), (600, 600)), ((4000, 4000), (4000, 4000)))
    assert found.colours == (("R", "G"), ("G", "B"))
    assert found.identity == Identity("Simulated", "Petal camera", "000042", "not told")
    assert [int(found.mask(channel).sum()) for channel in "RGB"] == [300, 600, 300]


def test_each_pixel_has_the_black_level_of_its_place() -> None:
    levels = (500, 510, 520, 530)
    found = decode(even(600).replace(struct.pack("<4H", *[512] * 4), struct.pack("<4H", *levels)), NAME)
    assert found.black == ((500, 510), (520, 530))
    assert found.values[0, 0] == pytest.approx(100 / 14860)
    assert found.values[3, 5] == pytest.approx(70 / 14830)
    assert found.step("R") == pytest.approx(1 / 14860)
    assert found.step("G") == pytest.approx(1 / 14840)


def test_the_mosaic_is_the_file_s_own() -> None:
    found = decode(altered(even(600), 33422, 1, 4, value=bytes((1, 2, 0, 1))), NAME)
    assert found.colours == (("G", "B"), ("R", "G"))
    assert found.mask("R")[1, 0]
    assert not found.mask("R")[0, 1]


def test_binning_takes_each_colour_from_its_own_pixels() -> None:
    mosaic = np.empty((24, 32), np.uint16)
    mosaic[0::2, 0::2], mosaic[0::2, 1::2], mosaic[1::2, 0::2], mosaic[1::2, 1::2] = 612, 712, 812, 912
    binned = decode(dng(mosaic, SMALL, TAKEN), NAME).binned()
    assert binned.shape == (12, 16, 3)
    assert np.allclose(binned * 14848, (100, 250, 400), atol=0.01)


@pytest.mark.parametrize("length", [0, 1, 7, 100, 500, 1000, -2, -1])
def test_a_file_cut_short_is_told_from_a_whole_one(length: int, tmp_path: Path) -> None:
    path = tmp_path / "IMG_7.dng"
    path.write_bytes(even(600)[:length])
    with pytest.raises(IncompleteFrame if length not in (1, 7) else BadFrame, match=r"IMG_7\.dng"):
        read_frame(path)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2213))
def test_no_beginning_of_a_file_passes_for_the_whole(length: int) -> None:
    whole = even(600)
    assert len(whole) == 2214
    with pytest.raises(BadFrame):
        decode(whole[:length], NAME)


def test_what_is_no_raw_file_is_named_so() -> None:
    black = np.zeros((40, 40, 3), np.uint8)
    for suffix in (".jpg", ".png", ".tiff"):
        with pytest.raises(NotRaw, match="IMG_1"):
            decode(cv2.imencode(suffix, black)[1].tobytes(), NAME)
    with pytest.raises(NotRaw, match="set the camera to RAW"):
        decode(b"a letter to the camera's maker\n" * 100, NAME)


def test_what_cannot_be_measured_with_is_named_so() -> None:
    with pytest.raises(UnusableFrame, match=r"IMG_1\.dng.*no exposure time"):
        decode(altered(even(600), 33434, 5, 1, tag_now=33435), NAME)
    with pytest.raises(UnusableFrame, match="black 512/512/512/512, white 512"):
        decode(altered(even(600), 50717, 4, 1, value=struct.pack("<I", 512)), NAME)
    with pytest.raises(UnusableFrame, match="RGBR"):
        decode(altered(even(600), 33422, 1, 4, value=bytes((0, 1, 2, 0))), NAME)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(IncompleteFrame, match=r"nothing\.dng.*No such file"):
        read_frame(tmp_path / "nothing.dng")


def test_an_iso_that_is_not_told_is_none() -> None:
    assert decode(altered(even(600), 34855, 3, 1, tag_now=34856), NAME).iso is None


def outcome(content: bytes) -> Frame | BadFrame:
    try:
        return decode(content, NAME)
    except BadFrame as error:
        return error


@settings(max_examples=250, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(st.data())
def test_mutilated_files_give_named_errors_only(data: st.DataObject) -> None:
    content = bytearray(even(600))
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, 980))
        match data.draw(st.sampled_from(("set", "flip", "cut", "insert"))):
            case "set":
                content[place] = data.draw(st.integers(0, 255))
            case "flip":
                content[place] ^= 1 << data.draw(st.integers(0, 7))
            case "cut":
                del content[place : place + data.draw(st.integers(1, 40))]
            case "insert":
                content[place:place] = data.draw(st.binary(min_size=1, max_size=8))
    content += bytes(data.draw(st.sampled_from((0, 400))))  # else most are merely cut short
    found = outcome(bytes(content))
    if isinstance(found, Frame):
        assert np.isfinite(found.values).all()
        assert found.exposure_s > 0
    else:
        assert "IMG_1.dng" in str(found)


@pytest.mark.parametrize("pointer", [34665, 330])  # Exif's directory, and those of the images inside
def test_the_outline_has_what_the_inner_directories_say(pointer: int) -> None:
    data = altered(altered(even(600), 50735, 2, 7, tag_now=50737), 34665, 4, 1, tag_now=pointer)
    found = outline(data)
    assert found is not None
    assert (found.size, found.make, found.model, found.serial_number) == (len(data), "Simulated", "Petal camera", "000042")


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.sampled_from((b"", b"II*\0", b"MM\0*", b"II*\0\x08\0\0\0")))
def test_the_outline_of_anything_is_an_outline(data: bytes, start: bytes) -> None:
    found = outline(start + data)
    assert found is None or found.size >= 8


# Patches


@pytest.mark.parametrize(
    "scene",
    [
        Scene(),
        Scene(turn=180),
        Scene(turn=90, size=0.7),
        Scene(turn=-30, size=0.7),
        Scene(tilt=35, turn=10, size=0.8),
        Scene(tilt=-50, size=0.8),
        Scene(dictionary="DICT_6X6_250", markers=(40, 41, 42, 43)),
    ],
    ids=["straight", "upside down", "on its side", "turned", "tilted and turned", "far tilted", "other markers"],
)
@pytest.mark.parametrize("light", [0.0, 3.0, 50.0])
def test_the_patch_lies_between_the_markers(scene: Scene, light: float) -> None:
    found = find_markers(frame(scene, light), scene.markers, scene.dictionary, margin=0.0)
    assert np.abs(np.array(found.corners) - scene.corners(640, 480)).max() < 3.0  # of 320 pixels across


def test_the_corners_are_found_to_a_fraction_of_a_pixel() -> None:
    found = find_markers(frame(), margin=0.0)
    assert np.abs(np.array(found.corners) - Scene().corners(640, 480)).max() < 0.4


def test_each_marker_may_be_glued_on_turned() -> None:
    table, petal = Scene().draw(640, 480)
    for turns, (row, column) in enumerate(((40, 40), (40, 520), (360, 520), (360, 40))):
        table[row : row + 80, column : column + 80] = np.rot90(table[row : row + 80, column : column + 80], turns)
    mosaic = expose(table, petal, 3.0, CameraModel(), np.random.default_rng(1))
    found = find_markers(decode(dng(mosaic, CameraModel(), TAKEN), NAME), margin=0.0)
    assert np.abs(np.array(found.corners) - Scene().corners(640, 480)).max() < 0.4


def test_the_margin_is_part_of_the_way_to_the_middle() -> None:
    square = Region(((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 10.0)))
    assert square.shrunk(0.2).corners == ((1.0, 1.0), (9.0, 1.0), (9.0, 9.0), (1.0, 9.0))


@pytest.mark.parametrize(
    ("missing", "told"),
    [((2,), r"marker 2 \(bottom right\) missing; found 0, 1, 3"), ((0, 3), r"markers 0 \(top left\), 3 \(bottom left\)")],
)
def test_a_missing_marker_is_named(missing: tuple[int, ...], told: str) -> None:
    with pytest.raises(PatchNotFound, match=told) as caught:
        find_markers(frame(Scene(missing=missing)))
    assert "IMG_1.dng" in str(caught.value)


def test_a_picture_in_the_dark_has_no_markers() -> None:
    with pytest.raises(PatchNotFound, match="found none"):
        find_markers(frame(light=0.0, paper=0.0))


def test_a_marker_that_is_there_twice_is_refused() -> None:
    with pytest.raises(PatchNotFound, match="more than once"):
        find_markers(frame(Scene(markers=(0, 1, 2, 2))), (0, 1, 2, 2))


def test_markers_that_stand_otherwise_are_refused() -> None:
    with pytest.raises(PatchNotFound, match="another order"):
        find_markers(frame(Scene(markers=(0, 1, 3, 2))))
    with pytest.raises(PatchNotFound, match="another order"):  # as in a mirror
        find_markers(frame(Scene(markers=(1, 0, 3, 2))))


CHART = np.array([(115, 82, 68), (214, 126, 44), (56, 61, 150), (243, 243, 242), (52, 52, 52)])  # patches 1, 7, 13, 19 and 24, sRGB


@pytest.mark.parametrize("scene", [Scene("chart"), Scene("chart", tilt=15, turn=8), Scene("chart", turn=180)])
def test_the_chart_s_patches_are_found_in_order(scene: Scene) -> None:
    shown = frame(scene, paper=8.0)
    regions = find_chart(shown)
    assert len(regions) == 24
    found = [[one.mean / 0.8 for one in statistics(shown, regions[number - 1]).values()] for number in (1, 7, 13, 19, 24)]
    assert np.allclose(found, ((CHART / 255 + 0.055) / 1.055) ** 2.4, atol=0.003)


def test_no_chart_is_said() -> None:
    with pytest.raises(PatchNotFound, match="no colour chart"):
        find_chart(frame())


def test_statistics_of_a_rectangle_are_those_of_its_pixels() -> None:
    mosaic = np.random.default_rng(3).integers(512, 15361, (24, 32)).astype(np.uint16)
    mosaic[9, 5] = 15360
    shown = decode(dng(mosaic, SMALL, TAKEN), NAME)
    found = statistics(shown, rectangle(5, 7, 6, 4))
    pixels = {"R": mosaic[8:11:2, 6:11:2], "B": mosaic[7:11:2, 5:11:2]}
    for channel, stored in pixels.items():
        light = (stored - 512.0) / 14848
        assert found[channel].mean == pytest.approx(light.mean(), rel=1e-5)
        assert found[channel].spread == pytest.approx(light.std(ddof=1), rel=1e-5)
        assert found[channel].count == 6
    assert (found["G"].count, found["B"].saturated, found["R"].saturated) == (12, 1, 0)


@pytest.mark.parametrize("place", [(30, 0, 4, 4), (0, 22, 4, 4), (100, 100, 4, 4)])
def test_a_rectangle_beyond_the_edge_is_refused(place: tuple[int, int, int, int]) -> None:
    with pytest.raises(PatchNotFound, match="beyond the picture"):
        statistics(decode(even(600), NAME), rectangle(*place))


def test_a_patch_of_too_few_pixels_is_refused() -> None:
    with pytest.raises(PatchNotFound, match="1 R pixels"):
        statistics(decode(even(600), NAME), rectangle(0, 0, 2, 2))


@pytest.mark.parametrize(
    "text", ["", "petal", "markers:1,2,3", "markers:1,1,2,3", "chart", "chart:0", "chart:25", "1,2,3", "1,2,0,4", "1,-2,3,4"]
)
def test_a_patch_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(InvalidSetting, match=r"markers|patch"):
        finder(text)


def test_finders_find() -> None:
    shown = frame(Scene(markers=(4, 5, 6, 7)))
    assert finder("markers:4,5,6,7")(shown) == find_markers(shown, (4, 5, 6, 7))
    assert finder("3,4,10,20")(shown) == rectangle(3, 4, 10, 20)
    with pytest.raises(InvalidSetting, match="DICT"):
        finder("markers", dictionary="getPredefinedDictionary")
    with pytest.raises(InvalidSetting, match="margin"):
        finder("markers", margin=1.0)


def test_a_dark_or_even_picture_can_be_stretched() -> None:
    assert patches.stretched(np.zeros((8, 8), np.float32)).max() == 0
    assert set(np.unique(patches.stretched(np.eye(8, dtype=np.float32)))) == {0, 255}


# The folder


class Desk:
    """A clock that others have written things down for: they happen while somebody sleeps."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []
        self.plans: list[tuple[float, Callable[[], object]]] = []

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds
        due = sorted((plan for plan in self.plans if plan[0] <= self.now), key=lambda plan: plan[0])
        self.plans = [plan for plan in self.plans if plan[0] > self.now]
        for _, action in due:
            action()

    def after(self, seconds: float, action: Callable[[], object]) -> None:
        self.plans.append((self.now + seconds, action))

    def drops(self, seconds: float, path: Path, content: bytes) -> None:
        self.after(seconds, lambda: path.write_bytes(content))


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "pictures"
    path.mkdir()
    return path


@pytest.fixture
def camera(folder: Path, desk: Desk) -> Callable[..., FolderCamera]:
    def make(**options: Any) -> FolderCamera:
        link = FolderLink.open(f"folder:{folder}", device="camera-folder")
        return FolderCamera.open(link, "eye", **{"patch": "8,8,16,12", "patience_s": 5.0, "clock": desk, **options})

    return make


def flat(level: float, noise: float = 0.0, seed: int = 1, **settings: Any) -> bytes:
    """A small picture of one level, as a fraction of black to white."""
    model = replace(SMALL, **settings)
    stored = 512 + 14848 * level + noise * np.random.default_rng(seed).normal(size=(24, 32))
    return dng(np.clip(np.rint(stored), 0, 15360).astype(np.uint16), model, TAKEN)


def test_a_picture_is_a_reading(camera: Any, folder: Path, desk: Desk) -> None:
    eye = camera()
    assert isinstance(eye, LightSensor)
    assert (eye.name, eye.unit, eye.integration_s) == ("eye", "1/s", 1e-4)
    assert eye.identify().vendor == "not told"
    desk.drops(1.0, folder / "a.dng", flat(0.25, exposure=0.05, iso=200))
    reading = eye.read()
    assert reading.value == pytest.approx(0.25 / 0.05 / 2, rel=1e-3)
    assert (reading.unit, reading.good, reading.status, reading.flags) == ("1/s", True, 0, ())
    assert reading.device_time_s == TAKEN.timestamp()
    assert eye.integration_s == pytest.approx(0.05)
    assert eye.identify() == Identity("Simulated", "Petal camera", "000042", "not told")


def test_it_waits_without_haste(camera: Any, folder: Path, desk: Desk) -> None:
    desk.drops(2.0, folder / "a.dng", flat(0.25))
    camera().read()
    assert set(desk.slept) == {POLL_S}
    assert desk.now - 100 == pytest.approx(2.0 + 0.2, abs=2.5 * POLL_S)


def test_the_petal_is_read_between_its_markers(camera: Any, folder: Path, desk: Desk) -> None:
    for number, scene in enumerate((Scene(), Scene(tilt=30, turn=15, size=0.8))):
        desk.drops(1.0, folder / f"{number}.dng", picture(scene, 4.0, exposure=0.1))
        readings = camera(patch="markers").read_channels()
        assert [readings[channel].value for channel in "RGB"] == pytest.approx([4.8, 4.0, 2.0], rel=0.002)


def test_the_reading_does_not_depend_on_exposure_and_iso(camera: Any, folder: Path, desk: Desk) -> None:
    for number, (exposure, iso) in enumerate([(0.01, 100), (0.05, 100), (0.2, 100), (0.01, 800), (0.05, 400)]):
        desk.drops(1.0, folder / f"{number}.dng", picture(light=2.0, exposure=exposure, iso=iso, seed=number))
        # 30 000 pixels of 600 electrons at the least, read noise 3: 0.03 %, and a count of 15 at the least.
        assert camera(patch="markers").read().value == pytest.approx(2.0, rel=0.002)


def test_one_saturated_pixel_makes_it_over_range(camera: Any, folder: Path, desk: Desk) -> None:
    stored = np.full((24, 32), 8000, np.uint16)
    stored[8, 9], stored[0, 1] = 15360, 15360  # a green one in the patch, another beside it
    desk.drops(1.0, folder / "a.dng", dng(stored, SMALL, TAKEN))
    readings = camera().read_channels()
    assert readings["G"].over_range
    assert readings["G"].value == math.inf
    assert (readings["G"].status, readings["G"].flags) == (SATURATED, ("1 of 96 G pixels saturated",))
    assert not readings["G"].good
    assert readings["R"].good
    assert readings["R"].flags == readings["G"].flags

    desk.drops(1.0, folder / "b.dng", dng(stored, SMALL, TAKEN))
    tolerant = camera(saturated_fraction=0.02).read()
    assert tolerant.good
    assert tolerant.flags == ("1 of 96 G pixels saturated",)


@pytest.mark.parametrize(("level", "dark"), [(0.0, True), (-0.001, True), (2e-5, True), (0.0005, False)])
def test_what_is_not_above_black_is_under_range(camera: Any, folder: Path, desk: Desk, level: float, dark: bool) -> None:
    desk.drops(1.0, folder / "a.dng", flat(level, noise=4.0))
    reading = camera().read()
    assert reading.under_range == dark
    assert reading.good != dark
    assert (reading.status, reading.flags) == ((DARK, ("not above black",)) if dark else (0, ()))
    assert reading.value == pytest.approx(level / 0.1, abs=0.001)


def test_half_a_count_is_not_above_black_however_steady(camera: Any, folder: Path, desk: Desk) -> None:
    stored = (512 + (np.random.default_rng(1).random((24, 32)) < 0.4)).astype(np.uint16)
    desk.drops(1.0, folder / "a.dng", dng(stored, SMALL, TAKEN))
    assert camera().read().under_range


def test_what_was_there_before_does_not_count(camera: Any, folder: Path, desk: Desk) -> None:
    for name in ("z.dng", "older.dng.part"):
        (folder / name).write_bytes(flat(0.9))
    (folder / "growing.dng").write_bytes(flat(0.9)[:1500])
    desk.after(0.5, lambda: (folder / "older.dng.part").rename(folder / "older.dng"))  # delivered late
    desk.after(0.5, lambda: (folder / "growing.dng").write_bytes(flat(0.9)))  # completed late
    desk.after(0.6, lambda: (folder / "z.dng").rename(folder / "zz.dng"))
    desk.drops(2.0, folder / "a.dng", flat(0.25))
    assert camera().frame().path.name == "a.dng"


def test_an_old_picture_that_another_program_saves_again_does_not_count(camera: Any, folder: Path, desk: Desk, tmp_path: Path) -> None:
    (folder / "old.dng").write_bytes(flat(0.9))
    (tmp_path / "edited.dng").write_bytes(flat(0.9, seed=2))
    desk.after(0.5, lambda: (tmp_path / "edited.dng").replace(folder / "old.dng"))
    desk.drops(2.0, folder / "new.dng", flat(0.25))
    assert camera().frame().path.name == "new.dng"


def test_files_count_in_the_order_they_come_not_of_their_names(camera: Any, folder: Path, desk: Desk) -> None:
    eye, taken = camera(), []
    for name, level in (("m.dng", 0.1), ("z.dng", 0.2), ("a.dng", 0.3), ("n.dng", 0.4)):
        desk.drops(1.0, folder / name, flat(level))
        taken.append(round(eye.read().value, 2))
    assert taken == [1.0, 2.0, 3.0, 4.0]


def test_of_two_that_come_at_once_the_older_counts(camera: Any, folder: Path, desk: Desk) -> None:
    def both() -> None:
        for name, seconds in (("a.dng", 1000), ("b.dng", 900)):
            (folder / name).write_bytes(flat(0.25))
            os.utime(folder / name, (seconds, seconds))

    desk.after(1.0, both)
    assert camera().frame().path.name == "b.dng"


def test_a_file_in_pieces_is_taken_when_it_is_whole(camera: Any, folder: Path, desk: Desk) -> None:
    whole = flat(0.25)
    for number in range(1, 9):
        desk.drops(0.4 * number, folder / "a.dng", whole[: math.ceil(len(whole) * number / 8)])  # rests long enough between
    assert camera().read().value == pytest.approx(2.5, rel=1e-3)
    assert desk.now - 100 > 0.4 * 8


def test_a_file_whose_room_is_taken_before_it_is_filled_is_not_taken_before(camera: Any, folder: Path, desk: Desk) -> None:
    whole = flat(0.25)
    for number in range(1, 20):
        filled = len(whole) * number // 19
        desk.drops(0.1 * number, folder / "a.dng", whole[:filled] + bytes(len(whole) - filled))
        desk.after(0.1 * number, lambda n=number: os.utime(folder / "a.dng", (n, n)))
    assert camera().read().value == pytest.approx(2.5, rel=1e-3)


def test_a_file_that_is_written_to_while_it_is_read_is_read_again(
    camera: Any, folder: Path, desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: list[Path] = []

    def interrupted(path: Path) -> Frame:
        found = read_frame(path)
        reads.append(path)
        if len(reads) == 1:
            path.write_bytes(flat(0.5))
        return found

    monkeypatch.setattr("drivers.cameras.folder.read_frame", interrupted)
    desk.drops(1.0, folder / "a.dng", flat(0.25))
    assert camera().read().value == pytest.approx(5.0, rel=1e-3)
    assert len(reads) == 2


def test_other_files_are_passed_over(camera: Any, folder: Path, desk: Desk) -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((40, 40, 3), np.uint8))[1].tobytes()
    for name, content in (("a.jpg", jpeg), (".b.dng", flat(0.9)), ("c.dng.part", flat(0.9)), ("d.xmp", b"<x/>"), ("e.raf", flat(0.9))):
        desk.drops(0.5, folder / name, content)
    desk.after(0.5, (folder / "sub.dng").mkdir)
    desk.drops(2.0, folder / "f.DNG", flat(0.25))
    assert camera(pattern="*.[dj][np]g").frame().path.name == "f.DNG"


def test_a_camera_that_takes_nothing_is_named_with_its_folder_and_the_patience(camera: Any, folder: Path) -> None:
    with pytest.raises(
        TransportTimeout, match=rf"eye on folder:{folder}: waiting for a picture: no new file came .* within 5 s.*after 5\."
    ) as caught:
        camera().read()
    assert caught.value.device == "eye"


def test_what_came_instead_is_told(camera: Any, folder: Path, desk: Desk) -> None:
    desk.drops(0.5, folder / "a.dng", flat(0.25)[:2000])
    desk.drops(0.5, folder / "b.txt", b"nothing of the kind" * 10)
    desk.drops(4.9, folder / "c.dng", flat(0.25))
    with pytest.raises(
        TransportTimeout, match=r"a\.dng: cut short: 2000 bytes; b\.txt: no RAW file that LibRaw knows; c\.dng: still being written"
    ):
        camera().read()


def test_a_picture_that_cannot_be_measured_with_ends_the_waiting(camera: Any, folder: Path, desk: Desk) -> None:
    desk.drops(0.5, folder / "a.dng", altered(flat(0.25), 33434, 5, 1, tag_now=33435))
    with pytest.raises(UnusableFrame, match=r"eye on folder:.*a\.dng.*no exposure time"):
        camera().read()
    assert desk.now < 102


def test_a_patch_that_is_not_there_names_device_and_file(camera: Any, folder: Path, desk: Desk) -> None:
    desk.drops(0.5, folder / "a.dng", picture(Scene(missing=(1,))))
    with pytest.raises(PatchNotFound, match=r"eye on folder:.*a\.dng: marker 1 \(top right\) missing"):
        camera(patch="markers").read()


def test_a_folder_that_goes_away(camera: Any, folder: Path, desk: Desk) -> None:
    eye = camera()
    desk.after(1.0, lambda: folder.rename(folder.with_name("elsewhere")))
    with pytest.raises(PortClosed, match=r"eye on folder:.*the folder is gone"):
        eye.read()
    with pytest.raises(PortClosed):
        eye.read()


def test_closed_is_closed(folder: Path, desk: Desk) -> None:
    with FolderLink.open(f"folder://{folder}") as link:
        eye = FolderCamera.open(link, "eye", clock=desk)
        eye.close()
        with pytest.raises(PortClosed, match="eye"):
            eye.read()
        other = FolderCamera.open(link, "other", clock=desk)
        desk.after(1.0, link.close)
        with pytest.raises(PortClosed, match="other"):
            other.read()


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(TransportTimeout, match="no such folder"):
        FolderLink.open(f"folder:{tmp_path / 'nowhere'}")
    for url in ("folder:", str(tmp_path), "socket://127.0.0.1:1"):
        with pytest.raises(InvalidSetting, match="folder:/path"):
            FolderLink.open(url)


@pytest.mark.parametrize(
    "option",
    [
        {"channel": "luminance"},
        {"patch": "petal"},
        {"saturated_fraction": 1.0},
        {"patience_s": 0.0},
        {"settle_s": math.nan},
        {"iso": -1.0},
        {"trigger_command": "'"},
        {"trigger_command": " "},
        {"integration_s": 6.0},
    ],
)
def test_settings_that_cannot_be(camera: Any, option: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match="eye"):
        camera(**option)


def test_a_shorter_exposure_than_asked_for_is_refused(camera: Any, folder: Path, desk: Desk) -> None:
    eye = camera()
    eye.configure(0.2)
    assert eye.integration_s == 0.2
    desk.drops(0.5, folder / "a.dng", flat(0.25, exposure=0.1))
    with pytest.raises(DeviceFault, match=r"a\.dng was exposed for 0\.1 s .*at least 0\.2 s"):
        eye.read()
    desk.drops(0.5, folder / "b.dng", flat(0.25, exposure=0.19))  # 1/5 s as cameras round it
    assert eye.read().good
    for seconds in (0.0, -1.0, math.nan, math.inf, 1e6):
        with pytest.raises(InvalidSetting):
            eye.configure(seconds)
    with pytest.raises(InvalidSetting, match="range"):
        eye.configure(0.1, range=1.0)


def test_an_iso_that_is_not_told_must_be_given(camera: Any, folder: Path, desk: Desk) -> None:
    silent = altered(flat(0.25), 34855, 3, 1, tag_now=34856)
    desk.drops(0.5, folder / "a.dng", silent)
    with pytest.raises(DeviceFault, match=r"a\.dng does not tell its ISO; give iso"):
        camera().read()
    desk.drops(0.5, folder / "b.dng", silent)
    assert camera(iso=200.0).read().value == pytest.approx(1.25, rel=1e-3)


def python(code: str) -> str:
    return f'"{sys.executable}" -c "{code}"'


def test_the_command_takes_the_picture_in_the_folder_and_is_logged(tmp_path: Path, folder: Path, desk: Desk) -> None:
    (tmp_path / "shot.dng").write_bytes(flat(0.25))
    log: list[tuple[str, bytes]] = []
    link = FolderLink.open(f"folder:{folder}", traffic=lambda when, way, data: log.append((way, data)))
    command = python("import shutil; shutil.copyfile('../shot.dng', 'taken.dng')")
    eye = FolderCamera.open(link, "eye", patch="8,8,16,12", trigger_command=command, clock=desk)
    assert eye.read().value == pytest.approx(2.5, rel=1e-3)
    assert [way for way, _ in log] == ["tx", "rx"]
    assert b"shutil" in log[0][1]
    assert log[1][1] == b"taken.dng"


def test_a_camera_that_was_closed_takes_no_picture(camera: Any, folder: Path) -> None:
    eye = camera(trigger_command=python("open('taken', 'w')"))
    eye.close()
    with pytest.raises(PortClosed, match="eye"):
        eye.read()
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("code", "error", "told"),
    [
        ("import sys; print('noise'); sys.exit('no camera found')", DeviceFault, "exit code 1: no camera found"),
        ("import threading; threading.Event().wait(60)", TransportTimeout, r"longer than 0\.3 s"),
    ],
)
def test_a_command_that_fails(camera: Any, code: str, error: type[DeviceError], told: str) -> None:
    with pytest.raises(error, match=rf"eye on folder:.*taking a picture: .*{told}"):
        camera(trigger_command=python(code), trigger_s=0.3 if error is TransportTimeout else 20.0).read()


@pytest.mark.parametrize("closes", ["link", "device"])
def test_closing_ends_a_command_and_what_it_started(folder: Path, desk: Desk, closes: str) -> None:
    """At once: neither `trigger_s` nor the patience is waited for. A pipe has ended when all who could write to it have."""
    os.mkfifo(folder / "pipe")
    (folder.parent / "child.py").write_text("import os, signal\nos.open('pipe', os.O_WRONLY)\nsignal.pause()\n")
    command = python("import subprocess, sys; subprocess.run([sys.executable, '../child.py'])")
    link = FolderLink.open(f"folder:{folder}")
    eye = FolderCamera.open(link, "eye", patch="8,8,16,12", trigger_command=command, trigger_s=600.0, patience_s=600.0, clock=desk)
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(eye.read)
        with open(folder / "pipe", "rb") as pipe:  # returns when the child is there
            {"link": link, "device": eye}[closes].close()
            with pytest.raises(PortClosed, match=r"eye on folder:.*taking a picture"):
                reading.result(timeout=20)
            assert pipe.read() == b""


def test_closing_ends_the_waiting_for_a_picture(folder: Path, desk: Desk) -> None:
    waits = threading.Event()
    desk.after(1.0, waits.set)
    with FolderLink.open(f"folder:{folder}") as link, ThreadPoolExecutor(1) as pool:
        eye = FolderCamera.open(link, "eye", patch="8,8,16,12", patience_s=1e9, clock=desk)
        reading = pool.submit(eye.read)
        assert waits.wait(20)
        link.close()
        with pytest.raises(PortClosed, match="the folder was closed"):
            reading.result(timeout=20)


def test_who_it_is_is_not_told_before_a_picture_but_the_folder_must_be_there(camera: Any, folder: Path) -> None:
    eye = camera()
    assert eye.identify() == Identity("not told", "camera", "not told", "not told")
    folder.rmdir()
    with pytest.raises(PortClosed, match=r"eye on folder:.*looking for the folder: the folder is gone"):
        eye.identify()
    folder.mkdir()
    eye.close()
    with pytest.raises(PortClosed, match="the device was closed"):
        eye.identify()


def test_a_log_that_fails_is_no_matter(tmp_path: Path, folder: Path, desk: Desk) -> None:
    (tmp_path / "shot.dng").write_bytes(flat(0.25))

    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    link = FolderLink.open(f"folder:{folder}", traffic=full)
    command = python("import shutil; shutil.copyfile('../shot.dng', 'taken.dng')")
    assert FolderCamera.open(link, "eye", patch="8,8,16,12", trigger_command=command, clock=desk).read().good


def test_a_command_that_is_not_there(camera: Any) -> None:
    with pytest.raises(DeviceFault, match=r"no-such-program --now cannot be run: .*check trigger_command"):
        camera(trigger_command="no-such-program --now").read()


def test_two_threads_get_a_picture_each(camera: Any, folder: Path, desk: Desk) -> None:
    eye = camera(patience_s=50.0)
    for number in range(2):
        desk.drops(10.0 * number + 1, folder / f"{number}.dng", flat(0.25))
    names: list[str] = []
    threads = [threading.Thread(target=lambda: names.append(eye.frame().path.name)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(names) == ["0.dng", "1.dng"]
