"""Cleaning of scans of surfaces that are known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.clean import Cleaning, clean, depth_quantum
from scanning.errors import EmptyScanError
from tests.scanning.surfaces import STEP, Array, scan, with_depths

RADIUS = 25.0


def cap(x: Array, y: Array) -> Array:
    """Sphere whose top is at 0."""
    return np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0)) - RADIUS


def disc(radius: float) -> object:
    """Points within a circle."""
    return lambda x, y: x**2 + y**2 < radius**2


def test_smoothing_finds_the_surface_below_the_quantum_and_leaves_the_rim() -> None:
    inside = disc(17.0)
    truth = scan(cap, inside)
    image = scan(cap, inside, noise=0.05, quantum=0.3)
    result = clean(image)
    assert result.quantum == pytest.approx(0.3)
    assert result.roughness == pytest.approx(np.hypot(0.05, 0.3 / np.sqrt(12)), rel=0.15)
    np.testing.assert_array_equal(result.image.valid, image.valid)
    np.testing.assert_array_equal(result.image.points[..., :2], image.points[..., :2])
    error = (result.image.points - truth.points)[..., 2]
    x, y = truth.points[..., 0], truth.points[..., 1]
    rim = truth.valid & (np.hypot(np.nan_to_num(x), np.nan_to_num(y)) > 16)
    inner = truth.valid & ~rim
    assert np.sqrt(np.mean(error[inner] ** 2)) < 0.03
    # At the rim fewer points bear the fit, but it is not pulled to the inside (higher, on a dome).
    assert np.sqrt(np.mean(error[rim] ** 2)) < 0.09
    assert abs(error[rim].mean()) < 0.02


def test_a_quadratic_is_left_exactly_as_it_is() -> None:
    image = scan(lambda x, y: 0.02 * x**2 - 0.01 * x * y + 0.1 * y, disc(15.0))
    result = clean(image)
    np.testing.assert_allclose(result.image.points[image.valid], image.points[image.valid], atol=1e-9)
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
    assert not result.image.valid[changes != 0].any()
    assert result.image.valid[changes == 0].sum() == clear.valid.sum() - 26


def rim_places(valid: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Valid points with an invalid neighbour."""
    inner = valid.copy()
    for axis in (0, 1):
        for shift in (1, -1):
            inner &= np.roll(valid, shift, axis=axis)
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
    assert result.image.points[result.image.valid][:, 0].max() <= 2
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
