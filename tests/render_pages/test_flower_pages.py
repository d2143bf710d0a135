"""From a flower's folder to what its page moves, and back to assembly.json."""

import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from render.scene import read_flower
from render.viewer import COLLIDING
from rig.cli.view import serve
from rig.errors import RunError
from rig.flowerpages import HandFlower, Poses, Saving, open_flower, told_state, view
from rig.pictures import COLOURS
from scanning.flower import put_together
from scanning.poses import AZIMUTH, TILT, petal_poses
from tests.conftest import rig_environment
from tests.render_pages.controls import NUMBER_BOXES, STATUS, button, centre_of, show, type_number
from tests.scanning_flower import nested
from tests.scanning_flower.test_flower import write_flower

if TYPE_CHECKING:
    from tests.render_pages.browser import Browser

PETALS = 5


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flower of small meshes, not assembled."""
    folder = tmp_path_factory.mktemp("measured") / "rose"
    write_flower(folder, nested.grow(PETALS, 2))
    return folder


@pytest.fixture(scope="module")
def assembled_folder(measured_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assembled") / "rose"
    shutil.copytree(measured_folder, folder)
    assert put_together(folder).state == "free"
    return folder


@pytest.fixture
def measured(measured_folder: Path, tmp_path: Path) -> Path:
    """A flower that is not assembled, to write into."""
    return Path(shutil.copytree(measured_folder, tmp_path / "rose"))


@pytest.fixture
def assembled(assembled_folder: Path, tmp_path: Path) -> Path:
    """An assembled flower, to write into."""
    return Path(shutil.copytree(assembled_folder, tmp_path / "rose"))


def table_of(folder: Path) -> dict:
    return json.loads((folder / "assembly.json").read_text())


def shifted(flower: HandFlower, name: str, *by: float) -> Poses:
    poses = {each: T.copy() for each, T in flower.start.items()}
    poses[name][:3, 3] += by
    return poses


def test_what_was_assembled_reads_back_as_it_was_written(assembled: Path) -> None:
    flower, table = open_flower(assembled), table_of(assembled)
    found = flower.assembly(flower.start)
    assert (found.state, sorted(found.conflicts), found.seed) == ("free", sorted(table["conflicts"]), table["seed"])
    assert asdict(found.habit) == table["assumed"]
    assert found.clearance == pytest.approx(table["clearance_mm"])
    assert [list(pair) for pair in found.pairs] == table["inside"]
    for k, (name, petal) in enumerate(table["petals"].items()):
        np.testing.assert_allclose(found.residuals[k], list(petal["residuals_sd"].values()), atol=1e-9)
        assert flower.angles(name, flower.start[name]) == pytest.approx((petal["stem_angle"], petal["azimuth"]))


def test_without_an_assembly_petals_lie_as_measured(measured: Path) -> None:
    flower = open_flower(measured)
    assert flower.table is None
    for name, petal in flower.placement.petals.items():
        stem_angle, azimuth = flower.angles(name, flower.start[name])
        assert stem_angle == pytest.approx(petal.stem_angle)
        assert math.remainder(azimuth - petal.azimuth, 360) == pytest.approx(0, abs=1e-9)


def test_a_petal_turned_has_the_angles_asked_for_and_keeps_the_rest(assembled: Path) -> None:
    flower = open_flower(assembled)
    for name, T in flower.start.items():
        turned = flower.turned(name, T, 61.5, 222.25)
        assert flower.angles(name, turned) == pytest.approx((61.5, 222.25))
        before, after = flower._coordinates(name, T), flower._coordinates(name, turned)
        rest = [c for c in range(6) if c not in (AZIMUTH, TILT)]
        np.testing.assert_allclose(after[rest], before[rest], atol=1e-9)
        np.testing.assert_allclose(flower.turned(name, T, *flower.angles(name, T)), T, atol=1e-9)


def test_a_stem_angle_out_of_reach_is_refused_with_what_can_be_reached(assembled: Path) -> None:
    flower = open_flower(assembled)
    q = flower._coordinates("P03", flower.start["P03"])
    q[5] = 0.5  # rolled so far, its inflection does not come upright
    leaning = petal_poses(q[None])[0] @ np.linalg.inv(flower.petals["P03"].T_scan_petal)
    with pytest.raises(
        RunError, match=r"P03, rolled as it is, cannot have a stem angle of 0\.0 deg: \d+\.\d\d to 1\d\d\.\d\d can be reached"
    ):
        flower.turned("P03", leaning, 0.0, 10.0)


def test_saving_by_hand_says_what_is_there_and_who_moved_it(assembled: Path) -> None:
    before, flower = table_of(assembled), open_flower(assembled)
    save = Saving(flower)
    poses = shifted(flower, "P01", 0.0, 0.0, 40.0)  # far off, above the flower
    told = save(poses)
    table = table_of(assembled)
    assert told == f"{assembled / 'assembly.json'}, no two petals intersect, clearance {table['clearance_mm']:.3f} mm"
    assert set(table) == set(before) | {"by_hand"}
    assert table["by_hand"]["began_with"] == "an assembly"
    assert [each["moved"] for each in table["by_hand"]["saves"]] == [["P01"]]
    np.testing.assert_array_equal(table["petals"]["P01"]["T_flower_scan"], poses["P01"])
    assert table["petals"]["P01"]["residuals_sd"]["base_height"] == pytest.approx(
        before["petals"]["P01"]["residuals_sd"]["base_height"] + 40.0 / flower.placement.petals["P01"].base_u
    )
    assert any(conflict.startswith("P01: base_height is +") for conflict in table["conflicts"])
    assert table["petals"]["P02"]["T_flower_scan"] == before["petals"]["P02"]["T_flower_scan"]
    assert table["petals"]["P02"]["residuals_sd"] == pytest.approx(before["petals"]["P02"]["residuals_sd"])
    assert [path.name for path in assembled.iterdir() if path.name.startswith(".")] == []

    save(poses)
    assert table_of(assembled)["by_hand"] == table["by_hand"]  # nothing was moved
    again = Saving(open_flower(assembled))
    again(flower.start)
    assert [each["moved"] for each in table_of(assembled)["by_hand"]["saves"]] == [["P01"], ["P01"]]
    back = table_of(assembled)
    assert (back["state"], back["clearance_mm"]) == (before["state"], pytest.approx(before["clearance_mm"]))
    assert len(read_flower(assembled).meshes) == PETALS


def test_a_save_without_a_move_leaves_no_mark(assembled: Path) -> None:
    flower = open_flower(assembled)
    Saving(flower)(flower.start)
    assert "by_hand" not in table_of(assembled)


def test_petals_pushed_through_each_other_are_said_to_intersect(assembled: Path) -> None:
    flower = open_flower(assembled)
    inner, outer = flower.placement.inside_of()[0]
    stem_angle, _ = flower.angles(inner, flower.start[inner])
    azimuth = flower.angles(outer, flower.start[outer])[1]
    poses = flower.start | {inner: flower.turned(inner, flower.start[inner], stem_angle + 25, azimuth)}
    assert {inner, outer} <= flower.colliding(poses)
    told = Saving(flower)(poses)
    table = table_of(assembled)
    assert (table["state"], table["clearance_mm"]) == ("intersecting", 0.0)
    assert sorted((inner, outer)) in table["intersecting"]
    assert f"INTERSECTING: {told_state(table).split(': ')[1]}" in told
    assert any(f"{min(inner, outer)} and {max(inner, outer)} intersect: look first at" in conflict for conflict in table["conflicts"])


def test_a_petal_put_on_the_wrong_side_of_its_neighbour_is_a_conflict(assembled: Path) -> None:
    flower = open_flower(assembled)
    inner, outer = flower.placement.inside_of()[0]
    azimuth = flower.angles(outer, flower.start[outer])[1]
    stem_angle = flower.angles(outer, flower.start[outer])[0]
    put = flower.turned(inner, flower.start[inner], stem_angle, azimuth)
    put[:3, 3] += 3.0 * np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth)), -0.5])
    before, save = table_of(assembled)["inside"], Saving(flower)
    save(flower.start | {inner: put})
    assert f"{inner} is said to lie inside {outer}, but lies outside of it" in table_of(assembled)["conflicts"]
    assert [inner, outer] not in table_of(assembled)["inside"]
    save(flower.start)
    assert [inner, outer] in table_of(assembled)["inside"]
    assert [inner, outer] in before


def test_saving_what_was_never_assembled_says_so(measured: Path) -> None:
    flower = open_flower(measured)
    Saving(flower)(flower.start)
    mark = table_of(measured)["by_hand"]
    assert (mark["began_with"], [each["moved"] for each in mark["saves"]]) == ("the measured poses", [[]])
    residuals = [list(petal["residuals_sd"].values()) for petal in table_of(measured)["petals"].values()]
    np.testing.assert_allclose(residuals, 0, atol=1e-9)


def test_an_assembly_of_other_petals_is_refused(assembled: Path) -> None:
    table = table_of(assembled)
    del table["petals"]["P02"]
    (assembled / "assembly.json").write_text(json.dumps(table))
    with pytest.raises(RunError, match=r"holds P01, P03, P04, P05, but the flower's petals are P01, P02.*rig flower assemble"):
        open_flower(assembled)


@pytest.mark.parametrize(("label", "told"), [("RR", "in the hue of RR"), ("mine", "there is no hue for mine")])
def test_the_viewer_shows_a_fits_hue_and_what_intersects(monkeypatch: pytest.MonkeyPatch, assembled: Path, label: str, told: str) -> None:
    table = table_of(assembled) | {"state": "intersecting", "intersecting": [["P02", "P04"]]}
    (assembled / "assembly.json").write_text(json.dumps(table))
    shown: dict = {}
    monkeypatch.setattr("render.viewer.serve_viewer", lambda petals, **options: shown.update(petals=petals, **options))
    _, notes = view(assembled, SimpleNamespace(label=label, simulated=False), port=0)  # type: ignore[arg-type]
    assert shown["hue"] == COLOURS.get(label)
    assert shown["colours"] == {"P02": COLLIDING, "P04": COLLIDING}
    assert notes == shown["notes"]
    assert notes[:2] == ["SIMULATED", "INTERSECTING: P02-P04 (orange): not usable as it is"]
    assert notes[2].startswith(told)
    flower = open_flower(assembled)
    for name, (vertices, _, T) in shown["petals"].items():
        own = flower.start[name]
        expected = flower.petals[name].sheet.vertices @ own[:3, :3].T + own[:3, 3]
        np.testing.assert_allclose(vertices @ T[:3, :3].T + T[:3, 3], expected, atol=1e-5)


class Interrupted:
    """A page whose technician presses Ctrl-C, so many times."""

    url = "http://127.0.0.1:1"

    def __init__(self) -> None:
        self.presses = 0

    def wait(self) -> None:
        self.presses += 1
        raise KeyboardInterrupt

    def __enter__(self) -> "Interrupted":
        return self

    def __exit__(self, *what: object) -> None:
        self.closed = True


@pytest.mark.parametrize(("terminal", "unsaved", "presses"), [(True, ["P02"], 2), (False, ["P02"], 1), (True, [], 1)])
def test_ctrl_c_at_a_terminal_warns_once_of_what_would_be_lost(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], terminal: bool, unsaved: list[str], presses: int
) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: terminal, raising=False)
    page = Interrupted()
    serve(page, ["a note"], browser=False, unsaved=lambda: unsaved)  # type: ignore[arg-type]
    said = capsys.readouterr()
    assert page.presses == presses
    assert page.closed
    assert said.out == f"{page.url}\n"
    assert ("Ctrl-C again" in said.err) == (presses == 2)
    assert ("ended without saving where P02" in said.err) == bool(unsaved)


@pytest.mark.parametrize("command", [("flower", "edit"), ("view",)])
def test_without_viser_one_line_says_how_to_install_it(rig: Callable, assembled: Path, tmp_path: Path, command: tuple[str, ...]) -> None:
    (tmp_path / "viser.py").write_text("raise ImportError('no viser')\n")  # the command runs in this folder: python -m looks here first
    done = rig(*command, str(assembled), "--no-browser", check=1)
    assert "pip install 'petal-rig[viewer]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""


def test_what_is_no_assembled_flower_is_one_line(rig: Callable, measured: Path, tmp_path: Path) -> None:
    assert "not assembled yet" in rig("view", str(measured), check=1).stderr
    done = rig("flower", "edit", str(tmp_path / "nowhere"), check=1)
    assert len(done.stderr.strip().splitlines()) == 1


@contextmanager
def serving(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a command that serves a page; gives its process and the page's address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rig", *arguments, "--no-browser"],
        env=rig_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # tests started in the background ignore it
    )
    try:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Press Ctrl-C; returns exit code and what was said."""
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    return process.returncode, said


@pytest.mark.slow
def test_a_visitor_turns_a_petal_saves_and_the_file_has_it(browser: "Browser", assembled: Path, rig: Callable) -> None:
    before = table_of(assembled)
    with serving("flower", "edit", str(assembled)) as (process, url):
        show(browser, url)
        browser.wait_until(f"document.body.innerText.includes('SIMULATED') && {STATUS}.includes('No petal collides')")
        azimuth = round(before["petals"]["P01"]["azimuth"] + 2.0, 1) % 360
        type_number(browser, 1, f"{azimuth:g}")
        browser.wait_until(f"{STATUS}.includes('Not saved yet: P01') && {NUMBER_BOXES}[1].value == '{azimuth:g}'")
        browser.click(*centre_of(browser, button("Save")))
        browser.wait_until(f"{STATUS}.includes('Saved {PETALS} petals, of them moved: P01')")
        code, said = ended(process)
    assert code == 0
    assert "SIMULATED" in said
    assert "without saving" not in said
    after = table_of(assembled)
    assert after["petals"]["P01"]["azimuth"] == pytest.approx(azimuth)
    assert after["petals"]["P01"]["stem_angle"] == pytest.approx(before["petals"]["P01"]["stem_angle"])
    assert after["petals"]["P02"]["T_flower_scan"] == before["petals"]["P02"]["T_flower_scan"]
    assert [each["moved"] for each in after["by_hand"]["saves"]] == [["P01"]]


@pytest.mark.slow
def test_the_viewer_says_that_petals_intersect_and_are_simulated(browser: "Browser", assembled: Path) -> None:
    table = table_of(assembled)
    table |= {"state": "intersecting", "clearance_mm": 0.0, "intersecting": [["P02", "P04"]]}
    (assembled / "assembly.json").write_text(json.dumps(table))
    with serving("view", str(assembled)) as (process, url):
        show(browser, url)
        browser.wait_until("document.body.innerText.includes('INTERSECTING: P02-P04') && document.body.innerText.includes('SIMULATED')")
        code, said = ended(process)
    assert code == 0
    assert "INTERSECTING: P02-P04" in said
