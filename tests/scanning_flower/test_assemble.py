"""Petals put together: small cases with known answers, and nested flowers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanning.assemble import Assembly, AssemblyError, assemble
from scanning.contact import Sheet, clearance, crossings, gaps, samples
from scanning.placement import Neighbour, PetalPlacement, Placement
from scanning.poses import Array, moved
from scanning.terms import Habit
from tests.scanning_flower import nested

UP = np.array([0.0, 1.0, 0.0])


def flat(width: float = 10.0, length: float = 12.0, n: int = 15) -> Sheet:
    """Return a flat petal in its own frame: base at the origin, inner face to +z."""
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, n), np.linspace(0, length, n))
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([corner, corner + 1, corner + n], 1), np.stack([corner + 1, corner + n + 1, corner + n], 1)])
    return Sheet(np.stack([x, y, 0 * x], -1).reshape(-1, 3), triangles)


def placed(name: str, other: str, side: str, radius: float, stem_angle: float = 5.0, **more: float) -> PetalPlacement:
    neighbour = Neighbour(other, side)
    return PetalPlacement(name, neighbour, neighbour, stem_angle, 0.0, radius, 0.0, **more)


def two(first: PetalPlacement, second: PetalPlacement, **options: Any) -> Assembly:
    placement = Placement("two", {p.name: p for p in (first, second)})
    return assemble(["A", "B"], [flat(), flat()], np.array([np.eye(4)] * 2), np.array([UP] * 2), placement, **options)


def test_a_petal_alone_stands_as_measured() -> None:
    placement = Placement("one", {"A": PetalPlacement("A", None, None, 40.0, 70.0, 3.0, 1.0)})
    found = assemble(["A"], [flat()], np.eye(4)[None], UP[None], placement)
    assert found.state == "free"
    assert np.isinf(found.clearance)
    np.testing.assert_allclose([found.stem_angle[0], found.azimuth[0]], [40.0, 70.0], atol=1e-9)
    np.testing.assert_allclose(found.poses[0, :3, 3], [3 * np.cos(np.radians(70)), 3 * np.sin(np.radians(70)), 1.0], atol=1e-9)
    np.testing.assert_allclose(found.residuals, 0, atol=1e-9)


def test_parallel_sheets_too_near_are_pushed_apart_evenly() -> None:
    found = two(placed("A", "B", "outside", 4.0), placed("B", "A", "inside", 4.1))
    assert found.state == "free"
    assert found.clearance == pytest.approx(0.25, abs=0.03)
    assert found.poses[1, 0, 3] > found.poses[0, 0, 3]
    # Of two equally sure petals each yields the same.
    np.testing.assert_allclose(found.residuals[0], -found.residuals[1], atol=0.02)


def test_sheets_that_lie_against_each_other_stay_where_they_were_measured() -> None:
    found = two(placed("A", "B", "outside", 4.0), placed("B", "A", "inside", 4.4))
    np.testing.assert_allclose(found.poses, found.start, atol=1e-9)


def test_petals_measured_far_apart_are_brought_together_unless_nothing_is_assumed_of_them() -> None:
    pair = placed("A", "B", "outside", 4.0), placed("B", "A", "inside", 6.0)
    # Two radii of 1 mm and what is assumed of the gap, 0.5 mm give or take 0.3: 0.5 + 1.5 * 0.09 / (2 + 0.09) where sheets only shift.
    assert 0.5 < two(*pair).clearance < 0.57
    free = two(*pair, habit=Habit(nestle=np.inf))
    np.testing.assert_allclose(free.poses, free.start, atol=1e-9)


def test_of_two_petals_side_by_side_the_inner_one_comes_to_grow_nearer_to_the_stem() -> None:
    facing = {"A": 0.0, "B": 180.0}
    petals = {"A": placed("A", "B", "outside", 5.0), "B": placed("B", "A", "inside", 4.0)}
    placement = Placement("two", {name: replace(petal, azimuth=facing[name]) for name, petal in petals.items()})
    found = assemble(["A", "B"], [flat(), flat()], np.array([np.eye(4)] * 2), np.array([UP] * 2), placement)
    # 1 mm too much against sd 0.3 mm; each base is known to 1 mm: (1, 1, 0.3)-weighted least squares.
    inner, outer = (np.hypot(*pose[:2, 3]) for pose in found.poses)
    assert inner - outer == pytest.approx(0.09 / 2.09, abs=1e-6)


def test_bases_come_to_lie_on_one_receptacle() -> None:
    names = [f"P{i}" for i in range(8)]
    rng = np.random.default_rng(1)
    lifted = {name: 2.0 + 0.3 * (3 + i) + rng.normal(0, 1) for i, name in enumerate(names)}
    petals = {name: PetalPlacement(name, None, None, 40.0, 45.0 * i, 3.0 + i, lifted[name]) for i, name in enumerate(names)}
    small = [flat(0.5, 1.0, 3)] * 8
    found = assemble(names, small, np.array([np.eye(4)] * 8), np.array([UP] * 8), Placement("many", petals))
    off = []
    for poses in (found.start, found.poses):
        radius, height = np.hypot(poses[:, 0, 3], poses[:, 1, 3]), poses[:, 2, 3]
        off.append(np.std(height - np.polyval(np.polyfit(radius, height, 1), radius)))
    # Each height is known to 1 mm, the receptacle to 0.3 mm; the radii take a little of it.
    assert off[1] < 0.09 / 1.09 * off[0] * 1.05


@pytest.mark.parametrize("outer", ["A", "B"])
def test_crossing_sheets_part_on_the_side_that_is_stated(outer: str) -> None:
    # A leans out through B: which one ends up outside is for the placement to say.
    sides = ("inside", "outside") if outer == "A" else ("outside", "inside")
    found = two(placed("A", "B", sides[0], 4.0, 8.0, base_u=2.0), placed("B", "A", sides[1], 4.5, 4.0, base_u=2.0))
    assert crossings([flat(), flat()], found.start)
    assert found.state == "free"
    middle = np.array([[0.0, 6.0, 0.0]])
    a, b = (float(moved(pose, middle)[0, 0]) for pose in found.poses)
    assert (a > b) == (outer == "A")
    assert found.pairs == [("B", "A") if outer == "A" else ("A", "B")]


def test_a_sure_petal_moves_less_than_a_doubtful_one() -> None:
    found = two(
        placed("A", "B", "outside", 4.2, base_u=0.1, stem_angle_u=0.2), placed("B", "A", "inside", 4.0, base_u=1.0, stem_angle_u=4.0)
    )
    moves = np.linalg.norm(found.poses[:, :3, 3] - found.start[:, :3, 3], axis=1)
    assert found.state == "free"
    assert moves[0] < 0.1 * moves[1]


def test_an_impossible_flower_is_marked_and_its_conflict_named() -> None:
    # B must be outside of A, but is surely measured 3 mm inside of it, leaning the other way.
    first = placed("A", "B", "outside", 5.0, 3.0, base_u=0.05, stem_angle_u=0.1, azimuth_u=0.1)
    second = placed("B", "A", "inside", 4.0, 14.0, base_u=0.05, stem_angle_u=0.1, azimuth_u=0.1)
    found = two(first, second, habit=Habit(side_u=0.05, roll_u=0.1, receptacle_u=0.05))
    assert found.state == "intersecting"
    assert found.clearance == 0
    assert found.intersecting == [("A", "B")]
    assert any("standard uncertainties from what was measured" in conflict for conflict in found.conflicts)
    assert any(conflict.startswith("A and B intersect") for conflict in found.conflicts)
    assert np.isfinite(found.poses).all()


def test_crossings_finds_one_thorn_through_a_sheet_and_nothing_in_its_absence() -> None:
    thorn = Sheet(np.array([[0.1, 5.1, -1.0], [0.2, 5.1, -1.0], [0.15, 5.2, 0.5]]), np.array([[0, 1, 2]]))
    poses = np.array([np.eye(4), np.eye(4)])
    assert set(crossings([flat(), thorn], poses)) == {(1, 0)}
    poses[1, 2, 3] = -0.75
    assert crossings([flat(), thorn], poses) == {}
    assert clearance([flat(), thorn], poses) == pytest.approx(0.25, abs=1e-5)


def test_gaps_of_parallel_sheets_are_their_distance_signed_by_the_inner_face() -> None:
    poses = np.array([np.eye(4), np.eye(4)])
    poses[:, 1, 3] = 4.0
    poses[1, 2, 3] = 0.7
    chosen = [samples(flat(), 100, np.random.default_rng(0))] * 2
    seen = gaps([flat(), flat()], poses, chosen)
    np.testing.assert_allclose(seen.height[seen.i == 1], 0.7, atol=1e-9)
    np.testing.assert_allclose(seen.height[seen.i == 0], -0.7, atol=1e-9)
    assert (seen.i == 1).sum() == 100


def test_gaps_do_not_see_the_far_side_of_the_flower() -> None:
    poses = np.array([np.eye(4), np.diag([1.0, 1.0, 1.0, 1.0])])
    poses[0, 1, 3] = poses[1, 1, 3] = 4.0
    turned = poses.copy()
    turned[1, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # the same place, facing away
    chosen = [samples(flat(), 100, np.random.default_rng(0))] * 2
    assert len(gaps([flat(), flat()], poses, chosen).i) == 200
    assert len(gaps([flat(), flat()], turned, chosen).i) == 0


def test_a_petal_without_placement_is_refused() -> None:
    placement = Placement("two", {"A": placed("A", "B", "inside", 4.0)})
    with pytest.raises(AssemblyError, match="no placement for B"):
        assemble(["A", "B"], [flat(), flat()], np.array([np.eye(4)] * 2), np.array([UP] * 2), placement)


def put(flower: nested.Nested, seed: int = 0) -> Assembly:
    names = list(flower.placement.petals)
    return assemble(names, flower.sheets, flower.T_scan_petal, flower.inflection, flower.placement, seed=seed)


def errors(flower: nested.Nested, poses: Array) -> Array:
    pairs = zip(flower.sheets, flower.T_flower_scan, poses, strict=True)
    return np.array([np.sqrt(((moved(true, s.vertices) - moved(found, s.vertices)) ** 2).sum(1).mean()) for s, true, found in pairs])


def test_exact_measurements_give_the_true_flower() -> None:
    flower = nested.grow(5, 1, angle_sd=0, base_sd=0)
    found = put(flower)
    assert found.state == "free"
    assert errors(flower, found.poses).max() < 0.05  # tangent planes at vertices 0.6 mm apart


def test_a_nested_flower_is_freed_in_order_the_same_way_each_time() -> None:
    flower = nested.grow(6, 3)
    first, again = put(flower, seed=4), put(flower, seed=4)
    assert crossings(flower.sheets, first.start)
    assert first.state == "free"
    assert first.clearance > 0.1
    stated = set(flower.placement.inside_of())
    assert stated <= set(first.pairs)
    assert all(inner < outer for inner, outer in stated)
    assert np.abs(first.residuals).max() < 3.5
    np.testing.assert_array_equal(first.poses, again.poses)


def test_progress_is_told_and_ends_at_one() -> None:
    told: list[float] = []
    flower = nested.grow(5, 1)
    names = list(flower.placement.petals)
    assemble(
        names, flower.sheets, flower.T_scan_petal, flower.inflection, flower.placement, progress=lambda word, share: told.append(share)
    )
    assert told[-1] == 1.0
    assert told == sorted(told)


def test_the_order_of_taking_off_settles_what_neighbours_do_not(tmp_path: Path) -> None:
    flower = nested.grow(8, 2)
    placement = replace(flower.placement, taken_off=tuple(sorted(flower.placement.petals, reverse=True)))
    found = put(replace(flower, placement=placement))
    assert found.state == "free"
    assert all(inner < outer for inner, outer in found.pairs)
