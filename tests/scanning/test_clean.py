"""Cleaning of scans of surfaces that are known."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.clean import Cleaning, clean, default_radius, depth_quantum, fit_weights
from scanning.errors import EmptyScanError
from scanning.mesh import area_vectors, boundary_loops, loop_length
from scanning.rangeimage import RangeImage
from scanning.triangulate import triangulate
from tests.scanning.surfaces import STEP, Array, scan, with_depths

RADIUS = 25.0


def cap(x: Array, y: Array) -> Array:
    """Sphere whose top is at 0."""
    return np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0)) - RADIUS


def disc(radius: float) -> Callable[[Array, Array], NDArray[np.bool_]]:
    """Points within a circle."""
    return lambda x, y: np.asarray(x**2 + y**2 < radius**2)


def test_smoothing_finds_the_surface_below_the_quantum_and_leaves_the_rim() -> None:
    inside = disc(17.0)
    truth = scan(cap, inside)
    image = scan(cap, inside, noise=0.05, quantum=0.3)
    result = clean(image)
    assert result.quantum == pytest.approx(0.3)
    assert result.roughness == pytest.approx(np.hypot(0.05, 0.3 / np.sqrt(12)), rel=0.15)
    np.testing.assert_array_equal(result.image.valid, image.valid)
    x, y, z = np.moveaxis(result.image.points, -1, 0)
    error = z - cap(x, y)
    rim = truth.valid & (np.hypot(np.nan_to_num(x), np.nan_to_num(y)) > 16)
    inner = truth.valid & ~rim
    assert np.sqrt(np.mean(error[inner] ** 2)) < 0.02
    # At the rim fewer points bear the fit, but it is not pulled to the inside (higher, on a dome).
    assert np.sqrt(np.mean(error[rim] ** 2)) < 0.07
    assert abs(error[rim].mean()) < 0.02


def rim_error(image: RangeImage, radius: float) -> Array:
    """Distances, in the plane, of the rim's points from a circle."""
    rows, columns = rim_places(image.valid)
    return np.asarray(np.hypot(*image.points[rows, columns, :2].T) - radius)


def test_the_rim_follows_the_outline_and_only_the_rim_moves() -> None:
    image = scan(cap, disc(15.13), noise=0.05, quantum=0.3)
    result = clean(image).image
    moved = np.hypot(*np.moveaxis((result.points - image.points)[..., :2], -1, 0))
    rows, columns = rim_places(image.valid)
    rim = np.zeros_like(image.valid)
    rim[rows, columns] = True
    assert moved[image.valid & ~rim].max() == 0
    assert np.median(moved[rim]) > 0.2 * STEP
    assert moved[rim].max() < 0.751 * STEP
    before, after = rim_error(image, 15.13), rim_error(result, 15.13)
    assert np.sqrt(np.mean(after**2)) < np.sqrt(np.mean(before**2)) / 3
    assert abs(after.mean()) < 0.05 * STEP
    np.testing.assert_array_equal(clean(image, Cleaning(smooth=0)).image.points[..., :2], image.points[..., :2])


@pytest.mark.parametrize("angle", [10.0, 27.0, 38.0])
def test_a_straight_rim_is_met_whichever_way_it_runs(angle: float) -> None:
    a, b = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    image = scan(lambda x, y: 0.0 * x, lambda x, y: (a * x + b * y < 7.0) & (np.hypot(x, y) < 20))
    off = []
    for points in (image.points, clean(image).image.points):
        rows, columns = rim_places(image.valid)
        distance = a * image.points[rows, columns, 0] + b * image.points[rows, columns, 1] - 7.0
        straight = (np.hypot(*image.points[rows, columns, :2].T) < 16) & (distance > -2)
        assert straight.sum() > 30
        off.append((a * points[rows, columns, 0] + b * points[rows, columns, 1] - 7.0)[straight])
    before, after = (float(np.sqrt(np.mean(o**2))) for o in off)
    assert after < before / 2
    assert abs(off[1].mean()) < 0.2 * STEP  # the staircase lies half a step inside


@pytest.mark.parametrize("filled", [0.5, 0.7, 0.9])
def test_moves_of_the_rim_turn_no_triangle_over(filled: float) -> None:
    from scanning import grid

    rng = np.random.default_rng(3)
    for _ in range(5):
        image = scan(lambda x, y: 0.0 * x, lambda x, y: rng.random(x.shape) < filled, size=40)
        depth = image.points[..., 2]
        move = grid.rim_moves(image.valid.astype(float), grid.rim_distance(depth, 2.0, 3), 0.8, 0.75)
        assert np.hypot(*np.moveaxis(move, -1, 0)).max() > 0.6
        mesh = triangulate(RangeImage(grid.moved(image.points, depth, depth, move), image.valid), 2.0)
        assert area_vectors(mesh)[:, 2].min() > 0.02 * STEP**2


def test_a_mixed_point_is_replaced_and_its_neighbours_stay() -> None:
    # A point half on the petal, far below it: what lies beside it is not steep.
    clear = scan(cap, disc(12.0))
    changes = np.zeros(clear.shape)
    rows, columns = rim_places(clear.valid)
    changes[rows[::5], columns[::5]] = -6.0
    result = clean(with_depths(clear, changes))
    assert result.removed["island"] == result.closed_notches == (changes != 0).sum()
    np.testing.assert_array_equal(result.image.valid, clear.valid)
    x, y, z = result.image.points[changes != 0].T
    assert np.abs(z - cap(x, y)).max() < 0.01
    # Where nothing was read nothing is made up, and the rim lies farther in.
    missing = clean(RangeImage(clear.points, clear.valid & (changes == 0)))
    assert missing.closed_notches == 0
    np.testing.assert_array_equal(missing.image.valid, clear.valid & (changes == 0))
    assert rim_error(missing.image, 12.0).mean() < rim_error(result.image, 12.0).mean() - 0.1 * STEP


@pytest.mark.parametrize("distance", [200.0, 600.0])
def test_a_closed_notch_lies_on_its_line_of_sight_and_on_the_surface(distance: float) -> None:
    from scanning import grid

    x, y = np.meshgrid((np.arange(60) - 30) * STEP, (30 - np.arange(60)) * STEP)
    z = 0.02 * x**2 - 0.01 * x * y + 0.3 * y  # in the grid's coordinates: the fit has nothing to guess
    truth = np.stack([x * (1 - z / distance), y * (1 - z / distance), z], axis=-1)
    whole = np.hypot(x, y) < 8
    rows, columns = rim_places(whole)
    notch = np.zeros_like(whole)
    notch[rows[::6], columns[::6]] = True
    depth = np.where(whole & ~notch, z, np.nan)
    points = np.where((whole & ~notch)[..., None], truth, np.nan)
    closed = grid.close_notches(points, depth, notch, 2.0, 4, fit_weights(4))
    assert closed.sum() > 15
    assert not (closed & ~notch).any()
    np.testing.assert_allclose(depth[closed], z[closed], atol=1e-9)
    np.testing.assert_allclose(points[closed][:, 2], z[closed], atol=1e-9)
    # The spacing of the lines of sight changes over the petal by z / distance: that is all x and y may miss.
    assert np.abs(points[closed] - truth[closed]).max() < 4 * STEP * np.ptp(z[whole]) / distance
    assert np.isnan(depth[~whole | (notch & ~closed)]).all()


def test_only_notches_of_single_readings_are_closed() -> None:
    def closed(height: float, *where: tuple[slice | int, slice | int], rim: int = 60) -> int:
        clear = scan(lambda x, y: 0.02 * x**2, size=80)
        changes = np.zeros(clear.shape)
        for place in where:
            changes[place] = height
        rows, columns = np.indices(clear.shape)
        result = clean(with_depths(clear, changes, (rows >= 10) & (rows < rim) & (columns >= 10) & (columns < 70)))
        assert result.removed["island"] + result.removed["spike"] + result.removed["grazing"] > 0
        assert result.image.valid[changes != 0].sum() == result.closed_notches
        return result.closed_notches

    assert closed(-6.0, (59, 40)) == 1
    assert closed(-6.0, (59, 40), (59, 50)) == 2
    assert closed(-6.0, (59, slice(40, 42))) == 2  # each beside measured points
    assert closed(-6.0, (59, slice(40, 43))) == 2  # not the middle
    assert closed(-6.0, (40, 40)) == 0  # a hole
    assert closed(-6.0, (40, slice(40, 42))) == 0
    assert closed(-6.0, (slice(56, 60), 40)) == 0  # a slit: a piece of four
    assert closed(-6.0, (slice(57, 60), slice(40, 46))) == 0  # as wide as an island
    assert closed(-6.0, (slice(57, 60), 40)) == 1  # of a slit of three its end, between points on three sides


def test_no_smoothing_leaves_notches() -> None:
    clear = scan(cap, disc(12.0))
    changes = np.zeros(clear.shape)
    rows, columns = rim_places(clear.valid)
    changes[rows[::5], columns[::5]] = -6.0
    result = clean(with_depths(clear, changes), Cleaning(smooth=0))
    assert result.closed_notches == 0
    np.testing.assert_array_equal(result.image.valid, clear.valid & (changes == 0))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_a_rim_of_mixed_points_is_as_long_as_the_outline(share: float) -> None:
    radius = 14.0
    clear = scan(lambda x, y: 0.0 * x, disc(radius), noise=0.05)
    rng = np.random.default_rng(5)
    changes = np.zeros(clear.shape)
    rows, columns = rim_places(clear.valid)
    mixed = rng.random(len(rows)) < share
    changes[rows[mixed], columns[mixed]] = -rng.uniform(1.0, 11.0, mixed.sum())
    result = clean(with_depths(clear, changes))
    mesh = triangulate(result.image, result.jump)
    (loop,) = boundary_loops(mesh.triangles)
    flat = mesh.vertices * [1, 1, 0]
    assert loop_length(flat, loop) == pytest.approx(2 * np.pi * radius, rel=0.03)
    assert area_vectors(mesh)[:, 2].sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    assert np.sqrt(np.mean((np.hypot(*flat[loop, :2].T) - radius) ** 2)) < 0.3 * STEP
    assert area_vectors(mesh)[:, 2].min() > 0.02 * STEP**2


def test_waves_of_ten_steps_stay_on_the_rim() -> None:
    radius, height = 14.0, 0.6
    waves = round(2 * np.pi * radius / (10 * STEP))

    def wavy(x: Array, y: Array) -> NDArray[np.bool_]:
        return np.asarray(np.hypot(x, y) < radius + height * np.cos(waves * np.arctan2(y, x)))

    mesh = triangulate(clean(scan(lambda x, y: 0.0 * x, wavy, noise=0.05)).image, 2.0)
    x, y, _ = mesh.vertices[boundary_loops(mesh.triangles)[0]].T
    angle = np.arctan2(y, x)
    found = np.linalg.lstsq(np.stack([np.ones_like(angle), np.cos(waves * angle)], axis=1), np.hypot(x, y), rcond=None)[0]
    assert found[0] == pytest.approx(radius, abs=0.2 * STEP)
    assert 0.87 * height < found[1] < height


@pytest.mark.parametrize("radius", [3, 6])
def test_sums_over_windows_give_the_same_as_point_by_point(radius: int) -> None:
    from scanning import grid

    rng = np.random.default_rng(0)
    depth = scan(cap, lambda x, y: (np.hypot(x, y) < 9) & (rng.random(x.shape) < 0.97), size=60, noise=0.1).points[..., 2] - 600
    weight = fit_weights(radius)
    far = grid.rim_distance(depth, 2.0, radius)
    move = np.zeros((*depth.shape, 2))
    found = grid.smoothed(depth, far, 2.0, weight, move)
    v, u = (axis.ravel() / radius for axis in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    padded = np.pad(depth, radius, constant_values=np.nan)
    for i, j in np.argwhere(far >= 0)[::7]:
        window = padded[i : i + 2 * radius + 1, j : j + 2 * radius + 1].ravel()
        seen = np.isfinite(window)
        root = np.sqrt(np.outer(weight, weight).ravel()[seen])
        fit = np.linalg.lstsq(basis[seen] * root[:, None], window[seen] * root, rcond=None)[0]
        assert found[i, j] == pytest.approx(fit[0], abs=1e-8)


def test_the_window_grows_with_the_noise() -> None:
    assert [default_radius(noise, 0.3) for noise in (0.0, 0.03, 0.13, 1.0)] == [3, 4, 9, 10]
    tilts = []
    for noise in (0.03, 0.06, 0.12):
        points = clean(scan(lambda x, y: 0.01 * x**2, noise=noise)).image.points
        slope = np.diff(points[20:-20, 20:-20, 2], axis=0) / STEP
        tilts.append(np.degrees(np.arctan(np.sqrt(np.mean(slope**2)))))
    assert max(tilts) < 1.5


def test_a_quadratic_is_left_exactly_as_it_is() -> None:
    image = scan(lambda x, y: 0.02 * x**2 - 0.01 * x * y + 0.1 * y, disc(15.0))
    result = clean(image)
    x, y, z = result.image.points[image.valid].T
    np.testing.assert_allclose(z, 0.02 * x**2 - 0.01 * x * y + 0.1 * y, atol=1e-9)
    assert sum(result.removed.values()) == 0


def test_no_smoothing_leaves_depths() -> None:
    image = scan(cap, disc(15.0), noise=0.05)
    np.testing.assert_array_equal(clean(image, Cleaning(smooth=0)).image.points[image.valid], image.points[image.valid])


def test_a_table_behind_goes() -> None:
    petal = scan(cap, disc(12.0))
    table = scan(lambda x, y: 0.05 * x - 20)
    image = with_depths(table, np.where(petal.valid, np.nan_to_num(petal.points[..., 2]) - table.points[..., 2], 0.0))
    result = clean(image)
    assert result.removed["background"] == (~petal.valid).sum()
    np.testing.assert_array_equal(result.image.valid, petal.valid)


def test_what_lies_behind_a_depth_goes() -> None:
    image = scan(cap, disc(15.0))
    depth = -2.0
    result = clean(image, Cleaning(behind=depth, smooth=0))
    assert result.removed["background"] == (image.points[image.valid][:, 2] < depth).sum() > 0
    assert result.image.points[result.image.valid][:, 2].min() >= depth


def test_mixed_pixels_and_spikes_go() -> None:
    clear = scan(cap, disc(12.0), noise=0.02)
    changes = np.zeros(clear.shape)
    rows, columns = rim_places(clear.valid)
    rng = np.random.default_rng(1)
    chosen = rng.choice(len(rows), 25, replace=False)
    changes[rows[chosen], columns[chosen]] = -rng.uniform(1.0, 1.8, 25)  # between petal and background, no jump to the neighbour
    changes[100, 100] = 1.5
    result = clean(with_depths(clear, changes))
    assert result.removed["spike"] == 26
    assert not result.image.valid[100, 100]  # a hole is not filled
    assert result.image.valid[changes == 0].sum() == clear.valid.sum() - 26
    assert 15 < result.image.valid[changes != 0].sum() == result.closed_notches <= 25
    x, y, z = result.image.points[result.image.valid & (changes != 0)].T
    assert np.abs(z - cap(x, y)).max() < 0.1  # none of the readings is left in them


def rim_places(valid: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Valid points with an invalid one among their four neighbours."""
    inner = valid.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(valid, step, axis=axis)
    rows, columns = np.nonzero(valid & ~inner)
    return rows, columns


def test_islands_go_and_the_largest_stays() -> None:
    image = scan(cap, lambda x, y: (x**2 + y**2 < 100) | ((x - 20) ** 2 + y**2 < 9) | ((x + 20) ** 2 + y**2 < 4))
    result = clean(image)
    x, y = image.points[..., 0], image.points[..., 1]
    large = image.valid & (np.nan_to_num(x) ** 2 + np.nan_to_num(y) ** 2 < 100)
    np.testing.assert_array_equal(result.image.valid, large)
    assert result.removed["island"] == image.valid.sum() - large.sum()


def test_a_jump_parts_two_surfaces() -> None:
    image = scan(lambda x, y: np.where(x > 2, 8.0, 0.0), disc(12.0), noise=0.01)
    result = clean(image)
    assert image.points[result.image.valid][:, 0].max() <= 2
    assert result.removed["island"] + result.removed["grazing"] > 0
    whole = clean(image, Cleaning(jump=20.0, grazing=89.0, spike=1e9, smooth=0))
    np.testing.assert_array_equal(whole.image.valid, image.valid)


def test_smoothing_does_not_mix_what_a_jump_parts() -> None:
    # One sheet that a slit of a step parts for most of its length: both sides hang together at its end.
    image = scan(lambda x, y: np.where((x > 0) & (y > -8), 3.0 * np.minimum((y + 8) / 4, 1), 0.0), disc(12.0))
    result = clean(image, Cleaning(spike=1e9))
    at = image.valid & (np.nan_to_num(image.points[..., 1]) > 0) & result.image.valid
    assert at.sum() > 1000
    np.testing.assert_allclose(result.image.points[at][:, 2], image.points[at][:, 2], atol=1e-9)


def test_grazing_parts_go() -> None:
    steep = np.tan(np.radians(75.0))
    image = scan(lambda x, y: np.where(x > 5, steep * (x - 5), 0.0), disc(9.0))
    assert clean(image).removed["grazing"] == 0
    result = clean(image, Cleaning(grazing=70.0, jump=5.0, spike=1e9))
    assert result.image.points[result.image.valid][:, 0].max() < 5 + 2 * STEP
    assert result.removed["grazing"] > 100


def test_quantum() -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 10, 5000)
    assert depth_quantum(values) == 0
    assert depth_quantum(np.round(values / 0.3) * 0.3) == pytest.approx(0.3)


def test_too_little_is_refused() -> None:
    image = scan(cap, disc(0.8))
    with pytest.raises(EmptyScanError, match="points are left"):
        clean(image)
    with pytest.raises(EmptyScanError, match="background"):
        clean(scan(cap, disc(10)), Cleaning(behind=50.0))


@pytest.mark.parametrize("wrong", [{"grazing": 90}, {"jump": 0}, {"spike": 0}, {"smooth": 99}])
def test_senseless_thresholds(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Cleaning(**wrong)  # type: ignore[arg-type]
