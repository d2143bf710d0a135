"""The pages as a visitor meets them, in a headless Chromium: what is drawn where, and that every control does what it says."""

from __future__ import annotations

import itertools
import json
import queue
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from render.editor import Editor, Poses, serve_editor
from render.viewer import Page, serve_viewer
from tests.render_pages.controls import NUMBER_BOXES, STATUS, button, centre_of, show, type_number
from tests.render_pages.flower import Flower, Matrix, flower

pytest.importorskip("viser", reason="the optional package viser is not installed")
pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from viser import TransformControlsEvent

    from tests.render_pages.browser import Browser

PATIENCE_S = 30.0


def pixels(page: Page, browser: Browser, points: Matrix) -> Matrix:
    """Where points (n, 3) of the flower frame fall on the page (n, 2), by a pinhole camera as the page was told to have."""
    camera = page._server.initial_camera
    back = camera.position - camera.look_at
    z = back / np.linalg.norm(back)
    x = np.cross(camera.up, z)
    x /= np.linalg.norm(x)
    seen = (points - camera.position) @ np.stack([x, np.cross(z, x), z], axis=1)
    frame = browser.run("(r => [r.left, r.top, r.width, r.height])(document.querySelector('canvas[data-engine]').getBoundingClientRect())")
    focal = frame[3] / 2 / np.tan(camera.fov / 2)
    return np.stack(
        [frame[0] + frame[2] / 2 - focal * seen[:, 0] / seen[:, 2], frame[1] + frame[3] / 2 + focal * seen[:, 1] / seen[:, 2]], 1
    )


def picture_when(browser: Browser, mask: str, file: Path) -> NDArray[np.uint8]:
    """Take pictures until a colour is in it; drawing in software takes a while."""
    for _ in range(60):
        browser.frames(2)
        taken = browser.picture(file)
        if COLOURS[mask](taken.astype(int)).sum() > 300:
            return taken
    raise AssertionError(f"nothing {mask} was drawn")


COLOURS = {
    "yellow": lambda rgb: (rgb[..., 0] > 200) & (rgb[..., 1] > 200) & (rgb[..., 2] < 150),
    "pink": lambda rgb: (rgb[..., 0] > rgb[..., 1] + 10) & (rgb[..., 2] > rgb[..., 1] + 4),
    "green": lambda rgb: (rgb[..., 1] > rgb[..., 0] + 40) & (rgb[..., 1] > rgb[..., 2] + 40),
    "blue": lambda rgb: (rgb[..., 2] > rgb[..., 0] + 40) & (rgb[..., 2] > rgb[..., 1] + 40),
    "orange": lambda rgb: (rgb[..., 0] > rgb[..., 2] + 80) & (rgb[..., 0] > rgb[..., 1] + 40) & (rgb[..., 1] > rgb[..., 2] + 10),
}


def test_the_viewer_draws_each_petal_where_it_lies(browser: Browser, tmp_path: Path) -> None:
    petals = flower({"P01": (60.0, 20.0), "P02": (75.0, 200.0)})
    browser.requested.clear()
    with serve_viewer(petals.petals, title="Flower seen", colours={"P01": (0, 160, 0), "P02": (20, 20, 200)}) as page:
        show(browser, page.url)
        picture_when(browser, "green", tmp_path / "viewer.png")
        taken = picture_when(browser, "blue", tmp_path / "viewer.png").astype(int)
        panel = np.zeros(taken.shape[:2], dtype=bool)
        panel[:130, 590:] = True  # the page's own controls
        for name, colour in (("P01", "green"), ("P02", "blue")):
            vertices, _, T = petals.petals[name]
            expected = pixels(page, browser, vertices @ T[:3, :3].T + T[:3, 3])
            rows, columns = np.nonzero(COLOURS[colour](taken) & ~panel)
            # Wide of the mark by an edge pixel or a dim rim at most, of some 200.
            assert columns.min() == pytest.approx(expected[:, 0].min(), abs=4)
            assert columns.max() == pytest.approx(expected[:, 0].max(), abs=4)
            assert rows.min() == pytest.approx(expected[:, 1].min(), abs=4)
            assert rows.max() == pytest.approx(expected[:, 1].max(), abs=4)
        own = (page.url, page.url.replace("http", "ws"), f"blob:{page.url}", "data:")
        assert [address for address in browser.requested if not address.startswith(own)] == []
        assert any(address.startswith(page.url) for address in browser.requested)


class Watched:
    """An editor whose saves are kept."""

    def __init__(self) -> None:
        self.petals: Flower = flower({"P01": (40.0, 10.0), "P02": (50.0, 130.0), "P03": (45.0, 250.0)})
        self.saved: list[Poses] = []
        self.page: Editor = serve_editor(
            self.petals.petals,
            bases=self.petals.bases,
            angles=self.petals.angles,
            turned=self.petals.turned,
            collisions=self.petals.close_neighbours,
            save=self._save,
        )

    def _save(self, poses: Poses) -> str:
        self.saved.append(poses)
        return f"save {len(self.saved)}"

    def reset(self) -> None:
        """Lay every petal where it was at the beginning and save that."""
        for name, (_, _, T) in self.petals.petals.items():
            self.page.move(name, T)
        self.page.select("P01")
        self.page.save()


@pytest.fixture(scope="module")
def opened(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    made = Watched()
    with made.page:
        show(browser, made.page.url)  # once for all tests: drawn in software, a first look takes seconds
        picture_when(browser, "pink", tmp_path_factory.mktemp("opened") / "editor.png")
        yield made


@pytest.fixture
def watched(browser: Browser, opened: Watched) -> Watched:
    opened.reset()
    browser.wait_until(f"{STATUS}.includes('save {len(opened.saved)}.') && {STATUS}.includes('No petal collides')")
    return opened


def choose(browser: Browser, name: str) -> None:
    browser.click(*centre_of(browser, "document.querySelector('input[value=P01]')"))
    option = f"Array.from(document.querySelectorAll('[role=option]')).find(each => each.innerText.trim() == {json.dumps(name)})"
    browser.click(*centre_of(browser, option))
    browser.wait_until(f"Array.from(document.querySelectorAll('input')).some(each => each.value == {json.dumps(name)})")


def test_a_visitor_chooses_turns_sees_the_collision_and_saves(browser: Browser, watched: Watched, tmp_path: Path) -> None:
    page, petals = watched.page, watched.petals
    choose(browser, "P03")
    browser.wait_until(f"{NUMBER_BOXES}[0].value == '45' && {NUMBER_BOXES}[1].value == '250'")

    type_number(browser, 1, "140")
    browser.wait_until(f"{STATUS}.includes('Collide: P02, P03.')")
    np.testing.assert_allclose(page.poses["P03"], petals.pose("P03", 45.0, 140.0), atol=1e-9)
    orange = COLOURS["orange"](picture_when(browser, "orange", tmp_path / "editor.png").astype(int))
    rows, columns = np.nonzero(orange)
    both = np.concatenate([petals.petals[name][0] @ T[:3, :3].T + T[:3, 3] for name, T in page.poses.items() if name != "P01"])
    expected = pixels(page, browser, both)
    assert expected[:, 0].min() - 4 < columns.min() < columns.max() < expected[:, 0].max() + 4
    assert expected[:, 1].min() - 4 < rows.min() < rows.max() < expected[:, 1].max() + 4

    # With the mouse: an arrow key turns the view as well, as far as the page draws pictures before the key is up.
    browser.click(*centre_of(browser, "document.querySelectorAll('.mantine-Slider-track')[0]"))
    stem_angle = float(browser.wait_until(f"{NUMBER_BOXES}[0].value != '45' && {NUMBER_BOXES}[0].value"))
    assert stem_angle == pytest.approx(90.0, abs=1.0)

    number = len(watched.saved) + 1
    browser.click(*centre_of(browser, button("Save")))
    told = browser.wait_until(f"{STATUS}.includes('save {number}.') && {STATUS}.includes('Collide') && {STATUS}")
    assert told == f"Saved 3 petals, of them moved: P03 -> save {number}.\nCollide: P02, P03."
    np.testing.assert_allclose(watched.saved[-1]["P03"], petals.pose("P03", stem_angle, 140.0), atol=1e-9)
    np.testing.assert_array_equal(watched.saved[-1]["P01"], petals.petals["P01"][2])


def test_dragging_the_handle_moves_the_petal_along_the_arrow(browser: Browser, watched: Watched) -> None:
    page, petals = watched.page, watched.petals
    before = page.poses["P01"]
    base = before[:3, :3] @ petals.bases["P01"] + before[:3, 3]
    direction = before[:3, _longest_arrow(page, browser, base, before)]
    scale = page._handle.scale
    way = [(float(x), float(y)) for x, y in pixels(page, browser, base + np.linspace(0.8, 1.2, 6)[:, None] * scale * direction)]
    phases: queue.Queue[str] = queue.Queue()

    async def heard(event: TransformControlsEvent) -> None:
        phases.put(event.phase)  # after the page's own: coroutines run in the order in which they were asked for

    page._handle.on_update(heard)
    try:
        hover_until_lit(browser, way[0])
        browser.press(way[0])
        assert phases.get(timeout=PATIENCE_S) == "start"
        for point in way[1:]:
            browser.pull(point)
        browser.release(way[-1])
        assert set(iter(lambda: phases.get(timeout=PATIENCE_S), "end")) == {"update"}
    finally:
        page._handle.remove_update_callback(heard)
    T = page.poses["P01"]
    shift = T[:3, 3] - before[:3, 3]
    assert shift @ direction == pytest.approx(0.4 * scale, rel=0.2)
    np.testing.assert_allclose(shift, (shift @ direction) * direction, atol=1e-4)
    np.testing.assert_allclose(T[:3, :3], before[:3, :3], atol=1e-6)
    assert page.unsaved == ["P01"]
    browser.wait_until(f"{STATUS}.includes('Not saved yet: P01.')")


def hover_until_lit(browser: Browser, point: tuple[float, float]) -> None:
    """Move the pointer about a point by a pixel until the part of the handle there lights up.

    The page draws on demand: a handle just told to go elsewhere may not be there yet, and what comes to lie under a resting pointer is
    not noticed. A press too early takes hold of the view instead.
    """
    for aside in itertools.islice(itertools.cycle((0.0, 1.0)), 100):
        browser.hover((point[0] + aside, point[1]))
        browser.frames(2)
        if COLOURS["yellow"](browser.picture().astype(int)).sum() > 20 and not aside:
            return
    raise AssertionError("the handle's arrow never lit up under the pointer")


def _longest_arrow(page: Page, browser: Browser, base: Matrix, T: Matrix) -> int:
    ends = pixels(page, browser, np.concatenate([base[None], base + page._handle.scale * T[:3, :3].T]))
    return int(np.argmax(np.linalg.norm(ends[1:] - ends[0], axis=1)))


def test_clicking_on_a_petal_selects_it(browser: Browser, watched: Watched) -> None:
    petals = watched.petals
    vertices, _, T = petals.petals["P02"]
    middle = pixels(watched.page, browser, (vertices @ T[:3, :3].T + T[:3, 3])[[17 * 12 + 8]])[0]
    browser.click(*middle)
    browser.wait_until(f"{NUMBER_BOXES}[0].value == '50' && {NUMBER_BOXES}[1].value == '130'")
    assert watched.page._selected == "P02"
