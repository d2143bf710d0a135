"""What the pages refuse before anything is served; none of it needs viser."""

import itertools
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from render.editor import serve_editor
from render.errors import RenderError
from render.viewer import Page, bounds, checked, petal_colours, serve_viewer
from tests.render_pages.flower import flower

PETALS = flower({"P01": (40.0, 10.0), "P02": (50.0, 130.0)})


def edit(**changes: Any) -> Page:
    asked = {
        "bases": PETALS.bases,
        "angles": PETALS.angles,
        "turned": PETALS.turned,
        "collisions": lambda poses: set(),
        "save": lambda poses: None,
    }
    return serve_editor(PETALS.petals, **asked | changes)


@pytest.mark.parametrize("serve", [lambda: serve_viewer(PETALS.petals), edit], ids=["viewer", "editor"])
def test_without_viser_the_error_says_how_to_install_it(serve: Callable[[], Page], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(RenderError, match=r"pip install 'petal-rig\[viewer\]'"):
        serve()


GOOD = PETALS.petals["P01"]
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ((GOOD[0][:, :2], GOOD[1], GOOD[2]), r"P01: expected finite vertices of shape \(V, 3\), got shape \(357, 2\)"),
        ((np.where(GOOD[0] == GOOD[0].max(), np.nan, GOOD[0]), GOOD[1], GOOD[2]), "P01: expected finite vertices"),
        ((GOOD[0], GOOD[1][:0], GOOD[2]), r"P01: expected whole-number faces"),
        ((GOOD[0], GOOD[1].astype(float), GOOD[2]), "got shape .* of float64"),
        ((GOOD[0], GOOD[1] + 1, GOOD[2]), "its faces name vertices 1 to 357, it has 357"),
        ((GOOD[0], GOOD[1] - 1, GOOD[2]), "its faces name vertices -1 to 355"),
        ((GOOD[0], GOOD[1], GOOD[2][:3]), "P01: expected a finite 4 x 4 transform"),
        ((GOOD[0], GOOD[1], GOOD[2] @ MIRROR), "P01: the transform is no rotation and shift"),
        ((GOOD[0], GOOD[1], 1.01 * GOOD[2]), "P01: the transform is no rotation and shift"),
    ],
)
def test_arrays_that_are_no_petal_are_refused_by_name(arrays: tuple[Any, Any, Any], problem: str) -> None:
    with pytest.raises(RenderError, match=problem):
        serve_viewer({"P01": arrays})


def test_a_flower_without_petals_and_names_that_would_nest_are_refused() -> None:
    with pytest.raises(RenderError, match="no petal to show"):
        serve_viewer({})
    with pytest.raises(RenderError, match="'P/1'"):
        serve_viewer({"P/1": GOOD})


def test_colours_of_unknown_petals_are_refused() -> None:
    with pytest.raises(RenderError, match="colours are given for P09"):
        serve_viewer(PETALS.petals, colours={"P09": (1, 2, 3)})


def test_the_editor_needs_every_base_and_a_rigid_pose() -> None:
    with pytest.raises(RenderError, match="bases are given for P01, but the petals are P01, P02"):
        edit(bases={"P01": PETALS.bases["P01"]})
    with pytest.raises(RenderError, match="P02: expected its base"):
        edit(bases=PETALS.bases | {"P02": [1.0, 2.0]})
    with pytest.raises(RenderError, match="P01: the transform is no rotation"):
        edit(turned=lambda name, T, stem_angle, azimuth: MIRROR)


def test_bounds_enclose_the_flower_closely() -> None:
    petals = checked(PETALS.petals)
    centre, radius = bounds(petals)
    points = np.concatenate([petal.vertices @ petal.pose[:3, :3].T + petal.pose[:3, 3] for petal in petals.values()])
    distances = np.linalg.norm(points - centre, axis=1)
    assert distances.max() == pytest.approx(radius, abs=0)
    np.testing.assert_allclose((points - centre).max(axis=0), -(points - centre).min(axis=0), rtol=1e-12)


def test_neighbouring_petals_differ_in_shade() -> None:
    many = checked({f"P{i:02d}": GOOD for i in range(25)})
    colours = list(petal_colours(many).values())
    assert all(sum(abs(x - y) for x, y in zip(a, b, strict=True)) > 20 for a, b in itertools.pairwise(colours))
    assert all(0 <= part <= 255 for colour in colours for part in colour)


def test_a_hue_is_linear_and_colours_every_petal() -> None:
    (only,) = petal_colours(checked({"P01": GOOD}), (1.0, 0.2140, 0.0)).values()  # half of sRGB's range is 0.2140 linear
    assert only[1] / only[0] == pytest.approx(0.5, abs=0.01)
    assert only[2] == 0
