"""Files read back by others, and the figures' details."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from render import Box, Camera, DistantLight, Lambert, Picture, Raycaster, RenderError, boxed, develop, exposure, write_exr, write_png


@pytest.fixture(scope="module")
def picture(ball: Raycaster) -> Picture:
    return ball.picture(Camera.look_at((30, -20, 15), (0, 0, 0), width=70, height=50), Lambert())


def test_png_holds_srgb(picture: Picture, tmp_path: Path) -> None:
    image = develop(picture, 0.5, colour=(1, 0.5, 0.1))
    write_png(image, tmp_path / "p.png")
    read = np.asarray(Image.open(tmp_path / "p.png"))
    assert read.shape == (50, 70, 3)
    encoded = read / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    expected = np.minimum(1, picture.radiance[..., None] / 0.5 * np.array([1, 0.5, 0.1]))
    np.testing.assert_allclose(linear, expected, atol=5e-3)
    assert np.all(develop(picture, 0.5, background=1)[0, 0] == 255)


def test_exr_is_read_by_the_openexr_library(picture: Picture, tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR", reason="the OpenEXR package (a test peer) is not installed")
    write_exr(picture, tmp_path / "p.exr")
    with OpenEXR.File(str(tmp_path / "p.exr")) as file:
        (name,) = file.channels()
        pixels = np.array(file.channels()[name].pixels)
    assert name == "RGBA"
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels[..., :3], np.repeat(picture.radiance[..., None], 3, axis=-1))
    np.testing.assert_array_equal(pixels[..., 3], picture.coverage)


def test_exr_keeps_colours_apart(ball: Raycaster, tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR", reason="the OpenEXR package (a test peer) is not installed")
    coloured = ball.picture(
        Camera.look_at((30, -20, 15), (0, 0, 0), width=31, height=17), lambda i, r, p: np.column_stack([1 + 0 * i, 2 + 0 * i, 3 + 0 * i])
    )
    write_exr(coloured, tmp_path / "c.exr")
    with OpenEXR.File(str(tmp_path / "c.exr")) as file:
        np.testing.assert_array_equal(np.array(file.channels()["RGBA"].pixels)[..., :3], coloured.radiance)


def test_exposure_is_a_quantile_of_the_scene_not_of_the_background(picture: Picture) -> None:
    assert exposure(picture, 1.0) == pytest.approx(float(picture.radiance[picture.coverage == 1].max()))
    assert 0 < exposure(picture, 0.5) < exposure(picture)


def test_nothing_to_expose_for(ball: Raycaster) -> None:
    camera = Camera.look_at((30, -20, 15), (0, 0, 0), width=10, height=10)
    with pytest.raises(RenderError, match="nothing bright"):
        exposure(ball.picture(camera, Lambert(), light=DistantLight((0, 0, 1), intensity=0)))
    with pytest.raises(RenderError, match="white must be"):
        develop(ball.picture(camera, Lambert()), 0)


def test_a_box_is_drawn_around_what_it_holds() -> None:
    image = np.full((30, 40, 3), 7, np.uint8)
    out = boxed(image, Box(10, 5, 8, 6), colour=(255, 0, 1), thickness=2)
    assert np.all(image == 7)
    assert np.all(out[5:11, 10:18] == 7)
    changed = np.any(out != 7, axis=-1)
    assert np.count_nonzero(changed) == 12 * 10 - 8 * 6
    assert np.all(out[changed] == (255, 0, 1))
    assert np.all(boxed(image, Box(0, 0, 40, 30)) == 7)
    with pytest.raises(RenderError, match="not within"):
        boxed(image, Box(35, 5, 8, 6))


def test_places_that_cannot_be_written(picture: Picture, tmp_path: Path) -> None:
    with pytest.raises(RenderError, match="cannot be written"):
        write_exr(picture, tmp_path / "missing" / "p.exr")
    with pytest.raises(RenderError, match="cannot be written"):
        write_png(develop(picture, 1), tmp_path / "missing" / "p.png")
