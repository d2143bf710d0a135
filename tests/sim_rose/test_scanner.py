"""The range finder: what it sees, what it cannot see, and how well."""

from dataclasses import replace

import numpy as np
import pytest

from sim.rose import RangeFinder, Rose, RoseError, Scan, grow, scan
from sim.rose.mesh import Mesh, apply
from sim.rose.scanner import INVALID, lay_down


@pytest.fixture(scope="module")
def rose() -> Rose:
    return grow(12, opening=0.5, seed=1, triangles=5000)


def take(rose: Rose, number: int, finder: RangeFinder, seed: int = 0) -> tuple[Mesh, Scan]:
    petal = rose.petals[number]
    rng = np.random.default_rng(seed)
    frame = petal.t_flower_petal()
    pose = lay_down(petal.mesh, frame, finder, rng) @ np.linalg.inv(frame)
    laid = petal.mesh.moved(pose)
    return laid, scan(laid, finder, rng)


def plate(side: float, height: float = 0.0, slope: float = 0.0, at: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """A square plate whose height rises by `slope` along y."""
    x, y = np.meshgrid(np.linspace(-side / 2, side / 2, 21) + at[0], np.linspace(-side / 2, side / 2, 21) + at[1])
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (index[i, j].ravel() for i in (slice(0, -1), slice(1, None)) for j in (slice(0, -1), slice(1, None)))
    points = np.stack([x.ravel(), y.ravel(), (height + slope * y).ravel()], axis=1)
    return Mesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]))


EXACT = RangeFinder(noise=0.0, mixed=0.0, depth_step=1e-9, tilt=0.0)


def test_a_tilted_plate_is_measured_exactly_by_a_perfect_instrument() -> None:
    seen = scan(plate(30, height=2.0, slope=0.4), EXACT, np.random.default_rng(0))
    x, y, z = seen.points[seen.valid].T
    assert seen.valid.sum() > 9000
    assert z == pytest.approx(2.0 + 0.4 * y, abs=1e-6)
    # The points lie on the camera's rays, which meet in the camera.
    rows, columns = np.nonzero(seen.valid)
    side = seen.valid.shape[0]
    shrink = 1 - z / EXACT.distance
    assert x / shrink == pytest.approx((columns - (side - 1) / 2) * seen.step, abs=1e-6)
    assert y / shrink == pytest.approx(((side - 1) / 2 - rows) * seen.step, abs=1e-6)
    assert np.abs(x).max() == pytest.approx(15, abs=seen.step)


def test_a_plate_over_another_hides_it_and_shades_it_on_the_side_away_from_the_laser() -> None:
    low, high = plate(40), plate(10, height=8.0)
    both = Mesh(np.concatenate([low.vertices, high.vertices]), np.concatenate([low.faces, high.faces + len(low.vertices)]))
    finder = replace(EXACT, distance=1e5, baseline=30.0)
    seen = scan(both, finder, np.random.default_rng(0))
    shade = 8.0 * np.tan(np.radians(30.0))
    rows, columns = np.nonzero(seen.hidden)
    side = seen.valid.shape[0]
    y = ((side - 1) / 2 - rows) * seen.step
    x = (columns - (side - 1) / 2) * seen.step
    # Light comes from +y: the strip in shade reaches from the upper plate's lower edge that far down.
    assert y.max() == pytest.approx(-5.0, abs=0.02 + seen.step)
    assert y.min() == pytest.approx(-5.0 - shade, abs=0.02 + seen.step)
    assert np.abs(x).max() == pytest.approx(5.0, abs=0.02 + seen.step)
    assert seen.hidden.sum() == pytest.approx(10 * shade / seen.step**2, rel=0.05)
    heights = seen.points[seen.valid][:, 2]
    assert set(np.round(heights, 6)) == {0.0, 8.0}


def test_a_strongly_curved_petal_has_hidden_points_and_a_flat_one_has_none() -> None:
    angle = np.linspace(-np.radians(100), np.radians(100), 81)
    a, x = np.meshgrid(angle, np.linspace(-10, 10, 41))
    index = np.arange(a.size).reshape(a.shape)
    p, q, r, s = (index[i, j].ravel() for i in (slice(0, -1), slice(1, None)) for j in (slice(0, -1), slice(1, None)))
    trough = Mesh(
        np.stack([x.ravel(), (12 * np.sin(a)).ravel(), (-12 * np.cos(a)).ravel()], axis=1),
        np.concatenate([np.stack([p, r, q], 1), np.stack([q, r, s], 1)]),
    )
    assert trough.mean_normal()[2] > 0.99
    seen = scan(trough, EXACT, np.random.default_rng(0))
    assert seen.hidden.sum() > 0.1 * seen.valid.sum()
    flat = scan(plate(20), EXACT, np.random.default_rng(0))
    assert flat.hidden.sum() == 0


def test_a_surface_too_steep_gives_no_echo() -> None:
    steep = scan(plate(10, slope=np.tan(np.radians(82))), replace(EXACT, baseline=0.1, distance=1e5), np.random.default_rng(0))
    assert steep.valid.sum() == 0
    assert steep.hidden.sum() > 0


def test_typical_petals_give_nine_to_thirteen_thousand_points_inside_the_window(rose: Rose) -> None:
    finder = RangeFinder()
    for number in range(len(rose.petals)):
        laid, seen = take(rose, number, finder, seed=number)
        assert 9_000 <= seen.valid.sum() <= 13_000
        assert max(seen.valid.shape) <= 200
        assert (seen.valid.shape[0] - 1) * seen.step <= 70
        assert np.abs(laid.vertices[:, :2]).max() < 35
        # The whole petal is in the picture: its border is empty.
        assert not seen.valid[[0, -1]].any()
        assert not seen.valid[:, [0, -1]].any()


def test_depths_are_multiples_of_the_step_and_invalid_points_say_so(rose: Rose) -> None:
    _, seen = take(rose, 3, RangeFinder())
    depth = seen.points[seen.valid][:, 2] / 0.3
    assert depth == pytest.approx(np.round(depth), abs=1e-9)
    assert len(np.unique(np.round(depth))) > 10
    assert (seen.points[~seen.valid] == INVALID).all()


def surface_distance(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Height of points over the plane of the mesh's nearest vertex."""
    from scipy.spatial import cKDTree

    _, index = cKDTree(mesh.vertices).query(points)
    return np.einsum("ij,ij->i", points - mesh.vertices[index], mesh.vertex_normals()[index])


def test_points_scatter_about_the_surface_by_noise_and_rounding(rose: Rose) -> None:
    for noise in (0.0, 0.1, 0.25):
        laid, seen = take(rose, 2, RangeFinder(noise=noise))
        good = seen.valid & ~seen.mixed
        off = surface_distance(seen.points[good], laid)
        normals = laid.face_normals()
        # Depth errors count by their share along the normal; rounding is uniform.
        share = np.sqrt(np.average(normals[:, 2] ** 2, weights=laid.areas()))
        expected = share * np.hypot(noise, 0.3 / np.sqrt(12))
        assert np.sqrt(np.mean(off**2)) == pytest.approx(expected, rel=0.12)
        assert abs(off.mean()) < 0.02


def test_two_in_a_hundred_points_are_mixed_and_lie_at_or_beyond_the_rim_under_the_petal(rose: Rose) -> None:
    laid, seen = take(rose, 1, RangeFinder())
    assert seen.mixed.sum() / seen.valid.sum() == pytest.approx(0.02, abs=0.002)
    assert (seen.valid | ~seen.mixed).all()
    off = surface_distance(seen.points[seen.mixed], laid)
    assert np.mean(np.abs(off) > 0.5) > 0.9
    # Between the petal and the background.
    depth = seen.points[seen.mixed][:, 2]
    assert depth.min() > laid.vertices[:, 2].min() - RangeFinder().background - 1
    assert depth.max() < laid.vertices[:, 2].max()
    # Some of them are not on the petal's picture: a perfect scan of the same petal has nothing there.
    clean = scan(laid, replace(EXACT), np.random.default_rng(0))
    assert 0.1 < np.mean(~(clean.valid | clean.hidden)[seen.mixed]) < 0.4
    none = take(rose, 1, RangeFinder(mixed=0.0))[1]
    assert none.mixed.sum() == 0


def test_dropouts_are_as_many_as_asked(rose: Rose) -> None:
    whole = take(rose, 4, RangeFinder(mixed=0.0))[1]
    holed = take(rose, 4, RangeFinder(mixed=0.0, dropouts=0.1))[1]
    assert holed.valid.sum() / whole.valid.sum() == pytest.approx(0.9, abs=0.02)
    assert not (holed.valid & ~whole.valid).any()


def test_petals_lie_any_way_round_inner_face_up(rose: Rose) -> None:
    finder = RangeFinder()
    petal = rose.petals[0]
    frame = petal.t_flower_petal()
    turns = []
    for seed in range(24):
        pose = lay_down(petal.mesh, frame, finder, np.random.default_rng(seed))
        assert pose[2, 2] > np.cos(np.radians(20))
        turns.append(np.degrees(np.arctan2(pose[1, 1], pose[0, 1])))
        base, tip = apply(pose @ np.linalg.inv(frame), petal.midrib_points()[[0, 2]])
        assert np.degrees(np.arctan2(*(tip - base)[[1, 0]])) == pytest.approx(turns[-1], abs=1e-6)
    assert set(np.floor(np.array(turns) / 90)) == {-2, -1, 0, 1}


def test_a_petal_too_large_for_the_window_is_refused(rose: Rose) -> None:
    petal = rose.petals[0]
    with pytest.raises(RoseError, match="does not fit the window of 20 mm"):
        lay_down(petal.mesh, petal.t_flower_petal(), RangeFinder(window=20.0), np.random.default_rng(0))
