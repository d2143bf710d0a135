"""The editor's page, driven from the program: what moves, what is checked, what is saved, what it says."""

import itertools
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from render.editor import Checks, Editor, Poses, serve_editor
from render.errors import RenderError
from render.viewer import COLLIDING, serve_viewer
from tests.render_pages.flower import Flower, Matrix, flower

pytest.importorskip("viser", reason="the optional package viser is not installed")

PATIENCE_S = 30.0
Open = Callable[..., Editor]


def shifted(T: Matrix, *shift: float) -> Matrix:
    moved = T.copy()
    moved[:3, 3] += shift
    return moved


@pytest.fixture
def petals() -> Flower:
    return flower({"P01": (40.0, 10.0), "P02": (50.0, 130.0), "P03": (45.0, 250.0)})


@pytest.fixture
def edit(petals: Flower) -> Iterator[Open]:
    opened: list[Editor] = []

    def open_page(**changes: Any) -> Editor:
        asked = {"bases": petals.bases, "angles": petals.angles, "turned": petals.turned, "collisions": petals.close_neighbours}
        page = serve_editor(petals.petals, **asked | {"save": lambda poses: "assembly.json"} | changes)
        opened.append(page)
        return page

    yield open_page
    for page in opened:
        page.close()


def test_to_begin_with_everything_lies_as_given_and_is_checked(edit: Open, petals: Flower) -> None:
    page = edit()
    assert page.settle(PATIENCE_S)
    assert page.status == "Nothing saved yet.\nNo petal collides."
    assert page.unsaved == []
    for name, T in page.poses.items():
        np.testing.assert_array_equal(T, petals.petals[name][2])


def test_turning_to_angles_gives_the_pose_of_these_angles(edit: Open, petals: Flower) -> None:
    page = edit()
    page.turn("P02", stem_angle=65.0)
    np.testing.assert_allclose(page.poses["P02"], petals.pose("P02", 65.0, 130.0), atol=1e-9)
    page.turn("P02", azimuth=100.0)
    np.testing.assert_allclose(page.poses["P02"], petals.pose("P02", 65.0, 100.0), atol=1e-9)
    page.turn("P01", stem_angle=20.0, azimuth=350.0)
    np.testing.assert_allclose(page.poses["P01"], petals.pose("P01", 20.0, 350.0), atol=1e-9)
    np.testing.assert_array_equal(page.poses["P03"], petals.petals["P03"][2])
    assert page.unsaved == ["P01", "P02"]


def test_a_petal_shifted_by_hand_bends_about_its_base_where_it_is_now(edit: Open, petals: Flower) -> None:
    page = edit()
    lying = shifted(petals.petals["P02"][2], 3.0, -2.0, 5.0)
    page.move("P02", lying)
    page.turn("P02", stem_angle=80.0)
    T, base = page.poses["P02"], petals.bases["P02"]
    np.testing.assert_allclose(T[:3, :3] @ base + T[:3, 3], lying[:3, :3] @ base + lying[:3, 3], atol=1e-9)
    assert petals.angles("P02", T)[0] == pytest.approx(petals.angles("P02", lying)[0] + 30.0)


def test_a_petal_shifted_by_hand_goes_round_the_stem_with_its_shift(edit: Open, petals: Flower) -> None:
    page = edit()
    page.move("P02", shifted(petals.petals["P02"][2], 3.0, -2.0, 5.0))
    base = petals.bases["P02"]
    lying = page.poses["P02"]
    azimuth = petals.angles("P02", lying)[1]
    page.turn("P02", azimuth=azimuth + 40.0)
    before, after = (T[:3, :3] @ base + T[:3, 3] for T in (lying, page.poses["P02"]))
    assert np.hypot(*after[:2]) == pytest.approx(np.hypot(*before[:2]))
    assert after[2] == pytest.approx(before[2])
    assert petals.angles("P02", page.poses["P02"]) == pytest.approx((petals.angles("P02", lying)[0], azimuth + 40.0))


LONE = flower({"P01": (40.0, 10.0)})


@pytest.fixture(scope="module")
def lone_page() -> Iterator[Editor]:
    nothing = {"collisions": lambda poses: (), "save": lambda poses: None}
    with serve_editor(LONE.petals, bases=LONE.bases, angles=LONE.angles, turned=LONE.turned, **nothing) as page:
        yield page


@settings(max_examples=20, deadline=None)
@given(way=st.lists(st.tuples(st.floats(5, 175), st.floats(0, 360)), min_size=1, max_size=6))
def test_any_way_of_turning_ends_at_the_last_angles(lone_page: Editor, way: list[tuple[float, float]]) -> None:
    for stem_angle, azimuth in way:
        lone_page.turn("P01", stem_angle=stem_angle)
        lone_page.turn("P01", azimuth=azimuth)
    np.testing.assert_allclose(lone_page.poses["P01"], LONE.pose("P01", *way[-1]), atol=1e-8)


def test_colliding_petals_are_named_and_coloured_and_freed_again(edit: Open) -> None:
    page = edit()
    assert page.settle(PATIENCE_S)
    free = {name: mesh.color for name, mesh in page._meshes.items()}
    page.turn("P03", azimuth=140.0)
    assert page.settle(PATIENCE_S)
    assert page.status.endswith("Not saved yet: P03.\nCollide: P02, P03.")
    assert {name for name, mesh in page._meshes.items() if tuple(mesh.color) == COLLIDING} == {"P02", "P03"}
    page.turn("P03", azimuth=250.0)
    assert page.settle(PATIENCE_S)
    assert page.status.endswith("No petal collides.")
    assert {name: mesh.color for name, mesh in page._meshes.items()} == free


def test_a_slow_check_holds_nothing_up_and_its_outdated_answer_is_not_shown(edit: Open) -> None:
    begun, go_on, seen = threading.Semaphore(0), threading.Semaphore(0), []

    def slow(poses: Poses) -> set[str]:
        seen.append(poses)
        begun.release()
        assert go_on.acquire(timeout=PATIENCE_S)
        return {"P01"} if len(seen) == 1 else {"P02", "P03"}

    page = edit(collisions=slow)
    assert begun.acquire(timeout=PATIENCE_S)
    for azimuth in range(131, 151):
        page.turn("P02", azimuth=float(azimuth))
    assert page.status.endswith("Looking for collisions ...")
    go_on.release()
    assert begun.acquire(timeout=PATIENCE_S)
    assert page.status.endswith("Looking for collisions ...")
    assert all(tuple(mesh.color) != COLLIDING for mesh in page._meshes.values())
    go_on.release()
    assert page.settle(PATIENCE_S)
    assert page.status.endswith("Collide: P02, P03.")
    assert len(seen) == 2  # twenty changes, one check
    np.testing.assert_array_equal(seen[-1]["P02"], page.poses["P02"])


def test_a_check_that_fails_is_said_and_the_next_one_counts_again(edit: Open) -> None:
    answers = iter([RuntimeError("mesh P01 has a hole"), {"P99"}, {"P01"}])

    def check(poses: Poses) -> set[str]:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    page = edit(collisions=check)
    assert page.settle(PATIENCE_S)
    assert page.status.endswith("COLLISIONS UNKNOWN: mesh P01 has a hole")
    page.turn("P01", azimuth=12.0)
    assert page.settle(PATIENCE_S)
    assert page.status.endswith("COLLISIONS UNKNOWN: the check names petals that are not here: P99")
    page.turn("P01", azimuth=14.0)
    assert page.settle(PATIENCE_S)
    assert page.status.endswith("Collide: P01.")


def test_saving_hands_over_all_poses_and_says_which_moved(edit: Open) -> None:
    saved: list[Poses] = []

    def save(poses: Poses) -> str:
        saved.append(poses)
        return "assembly.json"

    page = edit(save=save)
    page.turn("P02", stem_angle=60.0)
    assert "Not saved yet: P02." in page.status
    page.save()
    assert page.status.startswith("Saved 3 petals, of them moved: P02 -> assembly.json.\n")
    assert page.unsaved == []
    assert list(saved[0]) == ["P01", "P02", "P03"]
    for name, T in page.poses.items():
        np.testing.assert_array_equal(saved[0][name], T)
    saved[0]["P01"][0, 3] = 1e9  # what was handed over is the callable's own
    assert page.poses["P01"][0, 3] < 1e3
    page.save()
    assert page.status.startswith("Saved 3 petals, none moved since last time -> assembly.json.\n")


@pytest.mark.parametrize(("error", "words"), [(OSError("disk full"), "disk full"), (MemoryError(), "MemoryError")])
def test_a_failed_save_is_said_and_nothing_counts_as_saved(edit: Open, error: Exception, words: str) -> None:
    def save(poses: Poses) -> None:
        raise error

    page = edit(save=save)
    page.turn("P02", stem_angle=60.0)
    page.save()
    assert page.status.startswith(f"NOT SAVED: {words}\nNot saved yet: P02.")
    assert page.unsaved == ["P02"]


def test_what_cannot_be_moved_stays_and_is_named(edit: Open, petals: Flower) -> None:
    page = edit()
    for act in (lambda: page.select("P07"), lambda: page.turn("P07", azimuth=1.0), lambda: page.move("P07", np.eye(4))):
        with pytest.raises(RenderError, match="there is no petal 'P07'; there are P01, P02, P03"):
            act()
    with pytest.raises(RenderError, match="P01: the transform is no rotation"):
        page.move("P01", 2 * np.eye(4))
    np.testing.assert_array_equal(page.poses["P01"], petals.petals["P01"][2])
    assert page.unsaved == []


def test_pages_are_served_to_this_machine_only_and_never_shared(edit: Open, petals: Flower) -> None:
    with serve_viewer(petals.petals) as viewer:
        for page in (viewer, edit()):
            host, port = page.url.removeprefix("http://").split(":")
            assert host == "127.0.0.1"
            socket.create_connection((host, int(port)), timeout=PATIENCE_S).close()
            # Another address of this machine: answers when a page is bound to all of them.
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(("127.0.0.2", int(port)), timeout=PATIENCE_S)
            with pytest.raises(RenderError, match="this machine only"):
                page._server.request_share_url()


def test_a_port_asked_for_is_the_one_served_or_an_error(petals: Flower) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(RenderError, match=f"port {port} .*choose another one"):
            serve_viewer(petals.petals, port=port)
    with serve_viewer(petals.petals, port=port) as page:
        assert page.url == f"http://127.0.0.1:{port}"
    with pytest.raises(RenderError, match="port 99999"):
        serve_viewer(petals.petals, port=99999)


def test_closing_ends_the_waiting_and_the_serving(edit: Open, capsys: pytest.CaptureFixture[str]) -> None:
    page = edit()
    assert not page.wait(0)
    ended: list[bool] = []
    waiter = threading.Thread(target=lambda: ended.append(page.wait(PATIENCE_S)))
    waiter.start()
    page.close()
    page.close()
    waiter.join()
    assert ended == [True]
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", int(page.url.rsplit(":", 1)[1])), timeout=PATIENCE_S)
    assert capsys.readouterr().out == ""


def test_checks_begin_one_after_the_other() -> None:
    running, most, reports = itertools.count(), 0, []
    lock = threading.Lock()

    def check(poses: Poses) -> set[str]:
        nonlocal most
        assert lock.acquire(blocking=False)
        most = next(running)
        lock.release()
        return set(poses)

    checks = Checks(check, lambda poses, answer: reports.append(answer), quiet_s=0.0)
    for i in range(50):
        checks.ask({f"P{i:02d}": np.eye(4)})
    assert checks.settle(PATIENCE_S)
    checks.close()
    assert reports[-1] == {"P49"}
    assert len(reports) == most + 1
