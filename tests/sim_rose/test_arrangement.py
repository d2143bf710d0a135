"""The flower as a whole: no petal through another, near but not touching, covered, in an order one can take it apart."""

from dataclasses import replace

import numpy as np
import pytest

from sim.rose import Rose, grow
from sim.rose.arrangement import CLEARANCE, whorls
from sim.rose.contact import crossings
from sim.rose.shape import sheet

SMALL = [(5, 0.5, 1), (5, 1.0, 2), (12, 0.0, 3), (12, 1.0, 4)]
# Of each of these a search over vertices alone leaves one petal too near (0.13 mm) or too far (1.15 mm, 1.17 mm).
LARGE = [(35, 0.0, 5), (25, 0.5, 3), (45, 1.0, 1)]

_grown: dict[tuple[int, float, int], Rose] = {}


@pytest.fixture
def rose(request: pytest.FixtureRequest) -> Rose:
    """A rose of full meshes; grown once for all tests."""
    case = request.param
    if case not in _grown:
        _grown[case] = grow(case[0], opening=case[1], seed=case[2])
    return _grown[case]


EVERY_ROSE = pytest.mark.parametrize(
    "rose", [*SMALL, *(pytest.param(case, marks=pytest.mark.slow) for case in LARGE)], indirect=True, ids=str
)


def coarser(rose: Rose, triangles: int) -> Rose:
    return replace(rose, petals=tuple(replace(petal, mesh=sheet(petal.form, triangles)) for petal in rose.petals))


@EVERY_ROSE
def test_no_petal_crosses_another_and_the_nearest_inside_is_near(rose: Rose) -> None:
    assert all(len(petal.mesh.faces) > 12_000 for petal in rose.petals)
    assert rose.crossings() == {}
    # Exact distances of hundreds of pairs take long: large roses are measured on coarser meshes of the same sheets, 0.01 mm off.
    measured = rose if len(rose.petals) <= 12 else coarser(rose, 5000)
    nearest = list(measured.clearances().values())
    assert len(nearest) == len(rose.petals) - 1
    assert min(nearest) >= CLEARANCE[0] == 0.2
    assert max(nearest) <= CLEARANCE[1] == 1.0


@EVERY_ROSE
def test_inner_petals_are_covered(rose: Rose) -> None:
    covered = rose.covered()
    inner = [share for name, share in covered.items() if name not in rose.outermost_whorl()]
    assert min(inner, default=1.0) >= 0.4
    # The outermost petal has nothing outside it.
    assert covered["P01"] == 0.0


@EVERY_ROSE
def test_neighbours_agree_with_each_other_and_have_an_order(rose: Rose) -> None:
    petals = {petal.name: petal for petal in rose.petals}
    outer_to_inner = list(petals)
    opposite = {"inside": "outside", "outside": "inside"}
    for name, petal in petals.items():
        assert petals[petal.left.petal].right.petal == name
        assert petals[petal.right.petal].left.petal == name
        assert petals[petal.left.petal].right.side == opposite[petal.left.side]
        for beside in (petal.left, petal.right):
            further_in = outer_to_inner.index(beside.petal) > outer_to_inner.index(name)
            assert beside.side == ("inside" if further_in else "outside")
        # Counter-clockwise by less than a turn, and nobody of the whorl in between.
        turn = (petals[petal.left.petal].form.azimuth - petal.form.azimuth) % 360
        assert 0 < turn < 180


@pytest.mark.parametrize("rose", SMALL, indirect=True, ids=str)
def test_sides_are_those_of_the_meshes(rose: Rose) -> None:
    # Where a ray from the stem's side passes through both petals it meets the inner one first: seen in the meshes, not in the numbering.
    petals = {petal.name: petal for petal in rose.petals}
    looked_at = 0
    for petal in rose.petals:
        beside = petals[petal.left.petal]
        points, normals = petal.mesh.vertices, petal.mesh.vertex_normals()
        offset = beside.mesh.vertices[None, ::40] - points[::40, None]
        distance = np.linalg.norm(offset, axis=2)
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        along = float(offset[i, j] @ normals[::40][i])
        if distance[i, j] < 1.5 and abs(along) > 0.8 * distance[i, j] and normals[::40][i] @ beside.mesh.vertex_normals()[::40][j] > 0.5:
            looked_at += 1
            assert petal.left.side == ("inside" if along > 0 else "outside")
    assert looked_at >= 2


def test_the_check_for_crossings_sees_a_petal_pushed_through_another() -> None:
    rose = grow(12, opening=0.5, seed=1, triangles=3000)
    assert rose.crossings() == {}
    outer = rose.petals[5]
    turn = np.radians(outer.form.azimuth)
    pushed = replace(outer.mesh, vertices=outer.mesh.vertices - 1.5 * np.array([np.cos(turn), np.sin(turn), 0.0]))
    assert sum(crossings(pushed, other.mesh) for other in rose.petals[6:]) > 0


def test_opening_opens() -> None:
    bud, flower = (grow(12, opening=opening, seed=3, triangles=800) for opening in (0.0, 1.0))
    assert max(petal.form.stem_angle for petal in bud.petals) < 25
    assert flower.petals[0].form.stem_angle > 60
    assert all(b.form.stem_angle > a.form.stem_angle for a, b in zip(bud.petals, flower.petals, strict=True))


def test_the_same_seed_grows_the_same_rose_and_another_seed_another() -> None:
    one, same, other = (grow(6, seed=seed, triangles=800) for seed in (7, 7, 8))
    assert all((a.mesh.vertices == b.mesh.vertices).all() for a, b in zip(one.petals, same.petals, strict=True))
    assert [petal.form.length for petal in one.petals] != [petal.form.length for petal in other.petals]


@pytest.mark.parametrize("petals", range(5, 46))
def test_whorls_hold_every_petal(petals: int) -> None:
    sizes = whorls(petals)
    assert sum(sizes) == petals
    assert all(5 <= size <= 12 for size in sizes)
