"""MERL files: against the definition of the angles, and the layout, taken apart here by hand."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fitting.errors import DomainError, FitError, TableError
from fitting.formats.grid import Brdf, Scattered, ask
from fitting.formats.merl import BINS, HEADER, SIZE, UNITS, directions, half_difference, read_merl, write_merl
from tests.formats.lobes import lobes

SETTINGS = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def spun(vector: Any, axis: Any, angle: float) -> Any:
    """Turn a vector about an axis (Rodrigues)."""
    vector, axis = np.asarray(vector), np.asarray(axis)
    return vector * math.cos(angle) + np.cross(axis, vector) * math.sin(angle) + axis * (axis @ vector) * (1 - math.cos(angle))


def unit(theta: float, phi: float) -> Any:
    theta, phi = math.radians(theta), math.radians(phi)
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


def published(light: Any, view: Any) -> tuple[float, float, float]:
    """Half and difference angles as Rusinkiewicz defines them: turn the half vector's azimuth away, then tilt it onto the normal."""
    half = (light + view) / np.linalg.norm(light + view)
    theta_half, phi_half = math.acos(min(half[2], 1.0)), math.atan2(half[1], half[0])
    diff = spun(spun(light, [0, 0, 1], -phi_half), [0, 1, 0], -theta_half)
    return theta_half, math.acos(max(-1.0, min(diff[2], 1.0))), math.atan2(diff[1], diff[0])


def looked_up(content: bytes, light: Any, view: Any) -> list[float]:
    """R, G, B of the bin that holds two directions, straight from the bytes."""
    theta_half, theta_diff, phi_diff = published(light, view)
    j = min(int(math.sqrt(theta_half / (math.pi / 2)) * 90), 89)
    k = min(int(theta_diff / (math.pi / 2) * 90), 89)
    m = min(int((phi_diff % math.pi) / math.pi * 180), 179)
    index = m + 180 * (k + 90 * j)
    counts = [struct.unpack_from("<d", content, 12 + 8 * (index + plane * 90 * 90 * 180))[0] for plane in range(3)]
    return [counts[0] / 1500, counts[1] * 1.15 / 1500, counts[2] * 1.66 / 1500]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("merl") / "lobes.binary"
    write_merl(path, lobes)
    return path


@pytest.fixture
def scratch(tmp_path: Path, written: Path) -> Iterator[Path]:
    path = tmp_path / "scratch.binary"
    path.write_bytes(written.read_bytes())
    yield path
    path.unlink()


angles = st.tuples(st.floats(0.5, 89), st.floats(0.5, 89), st.floats(-180, 180))


@SETTINGS
@given(angles)
def test_angles_are_the_published_ones(given: tuple[float, float, float]) -> None:
    theta_i, theta_r, phi = given
    expected = published(unit(theta_i, 0), unit(theta_r, phi))
    found = half_difference(theta_i, theta_r, phi)
    np.testing.assert_allclose(found[0], math.degrees(expected[0]), atol=1e-5)
    np.testing.assert_allclose(found[1], math.degrees(expected[1]), atol=1e-5)
    if min(expected[0], expected[1]) > 1e-4:
        assert abs(math.remainder(float(found[2]) - math.degrees(expected[2]), 360)) < 1e-4
    back = directions(*found)
    np.testing.assert_allclose(back[:2], [theta_i, theta_r], atol=1e-6)
    assert abs(math.remainder(float(back[2]) - phi, 360)) < 1e-6


def test_layout(written: Path) -> None:
    content = written.read_bytes()
    assert len(content) == SIZE == 34_992_012
    assert struct.unpack_from("<3i", content) == BINS == (90, 90, 180)


def test_a_reader_of_bins_finds_the_function(written: Path) -> None:
    """Bins are a degree or two wide: where the function turns little within one, it is met within 3 %; diffuse light exactly."""
    content = written.read_bytes()
    rng = np.random.default_rng(1)
    off = []
    for theta_i, theta_r, phi in zip(rng.uniform(0, 88, 400), rng.uniform(0, 88, 400), rng.uniform(-180, 180, 400), strict=True):
        found = looked_up(content, unit(theta_i, 20), unit(theta_r, 20 + phi))
        expected = lobes(theta_i, theta_r, phi)
        assert found[0] == pytest.approx(expected[0], rel=1e-12, abs=0)
        off.append(np.abs(found / expected - 1))
    off = np.array(off)
    assert np.median(off[:, 1:]) < 0.01
    assert np.all(np.percentile(off[:, 1:], 95, axis=0) < 0.1)


def test_bin_middles_hold_the_function_itself(written: Path) -> None:
    """At the middle of a bin, found here without the package's angles."""
    content = written.read_bytes()
    rng = np.random.default_rng(2)
    met = 0
    for j, k, m in rng.integers(0, BINS, (300, 3)):
        half, diff, around = math.radians((j + 0.5) ** 2 / 90), math.radians(k + 0.5), math.radians(m + 0.5)
        raw = np.array([math.sin(diff) * math.cos(around), math.sin(diff) * math.sin(around), math.cos(diff)])
        light, view = (spun(v, [0, 1, 0], half) for v in (raw, raw * [-1, -1, 1]))
        if min(light[2], view[2]) <= 0:
            continue
        met += 1
        theta_i, theta_r = (math.degrees(math.acos(v[2])) for v in (light, view))
        phi = math.degrees(math.atan2(view[1], view[0]) - math.atan2(light[1], light[0]))
        np.testing.assert_allclose(looked_up(content, light, view), lobes(theta_i, theta_r, phi), rtol=1e-6)
    assert met > 150


def test_every_direction_above_the_surface_is_in_a_bin_with_a_value(written: Path) -> None:
    content = written.read_bytes()
    rng = np.random.default_rng(3)
    for theta_i, theta_r, phi in zip(rng.uniform(85, 90, 500), rng.uniform(0, 90, 500), rng.uniform(0, 360, 500), strict=True):
        assert min(looked_up(content, unit(theta_i, 0), unit(theta_r, phi))) > 0, (theta_i, theta_r, phi)


def test_read_back(written: Path) -> None:
    merl = read_merl(written)
    rng = np.random.default_rng(4)
    at = rng.uniform(0, 80, 2000), rng.uniform(-80, 80, 2000), rng.uniform(-180, 180, 2000)
    found, expected = merl(*at), lobes(*at)
    assert found.shape == (2000, 3)
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=1e-12)
    assert np.percentile(np.abs(found / expected - 1), 99) < 0.01
    np.testing.assert_allclose(merl(at[1].clip(0), at[0], at[2]), merl(at[0], at[1].clip(0), at[2]), rtol=1e-9)
    grid = merl.gridded([0, 30, 60], [0, 30, 60], [0, 90, 180])
    assert grid.channels == ("R", "G", "B")
    np.testing.assert_allclose(grid.values[1, 2, 1], merl(30, 60, 90))


def test_other_peoples_files(shared_data: Path) -> None:
    """Every MERL file of the reference measurements: our look-up between bins stays about the bins', by hand."""
    files = sorted(shared_data.rglob("*.binary"))
    if not files:
        pytest.skip("the reference measurements have no MERL file")
    for path in files:
        merl, content = read_merl(path), path.read_bytes()
        rng = np.random.default_rng(6)
        at = np.column_stack([rng.uniform(5, 70, (200, 2)), rng.uniform(-180, 180, 200)])
        by_hand = np.array([looked_up(content, unit(i, 0), unit(r, p)) for i, r, p in at])
        assert np.median(np.abs(merl(*at.T) / by_hand - 1)) < 0.03, path


def test_write_what_was_read(written: Path, tmp_path: Path) -> None:
    write_merl(tmp_path / "again.binary", read_merl(written))
    first, again = (np.frombuffer(path.read_bytes(), "<f8", offset=HEADER) for path in (written, tmp_path / "again.binary"))
    np.testing.assert_allclose(again, first, rtol=1e-15)


def test_light_and_view_are_averaged_unless_exchangeable(tmp_path: Path) -> None:
    def one_way(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return np.broadcast_to(0.1 + 0.1 * np.cos(np.radians(theta_i)), np.broadcast_shapes(*map(np.shape, (theta_i, theta_r, phi))))

    write_merl(tmp_path / "mean.binary", one_way)
    found = read_merl(tmp_path / "mean.binary")
    expected = (one_way(20, 70, 90) + one_way(70, 20, 90)) / 2
    np.testing.assert_allclose(found(20, 70, 90), np.full(3, expected), rtol=1e-3)
    np.testing.assert_allclose(found(70, 20, 90), np.full(3, expected), rtol=1e-3)


def test_left_and_right_are_told_apart(tmp_path: Path) -> None:
    """A sample without a grain may still turn light one way round, and obey Helmholtz."""

    def handed(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        i, r, p = (np.radians(a) for a in np.broadcast_arrays(theta_i, theta_r, phi))
        return 0.3 + 0.5 * np.sin(i) * np.sin(r) * np.sin(p) * (np.cos(i) - np.cos(r))

    write_merl(tmp_path / "handed.binary", handed)
    merl, content = read_merl(tmp_path / "handed.binary"), (tmp_path / "handed.binary").read_bytes()
    for at in ((20, 60, 70), (20, 60, -70), (60, 20, 110), (60, 20, -110), (75, 40, 150)):
        np.testing.assert_allclose(merl(*at), np.full(3, handed(*at)), rtol=0.002)
        np.testing.assert_allclose(looked_up(content, unit(at[0], 0), unit(at[1], at[2])), np.full(3, handed(*at)), rtol=0.03)


def test_bins_left_out_below_the_horizon(written: Path) -> None:
    """A file that marks every bin whose middle is below it still tells all directions above."""
    merl = read_merl(written)
    middles = directions((np.arange(90)[:, None, None] + 0.5) ** 2 / 90, np.arange(90)[:, None] + 0.5, np.arange(180) + 0.5)
    strict = replace(merl, valid=merl.valid & (np.maximum(middles[0], middles[1]) <= 90))
    assert strict.valid.sum() < merl.valid.sum()
    rng = np.random.default_rng(7)
    at = rng.uniform(86, 90, 5000), rng.uniform(0, 90, 5000), rng.uniform(-180, 180, 5000)
    assert strict.covers(*at).all()
    np.testing.assert_allclose(strict(*at)[:, 0], lobes(*at)[:, 0], rtol=1e-9)


def test_a_grid_leaves_what_it_does_not_cover_without_a_value(tmp_path: Path) -> None:
    theta = np.arange(0, 71, 5.0)
    write_merl(tmp_path / "part.binary", Brdf.sampled(lobes, theta, theta, np.arange(0, 181, 10.0), channels=("R", "G", "B")))
    found = read_merl(tmp_path / "part.binary")
    assert not found.covers(20, 80, 0)
    with pytest.raises(DomainError, match="no value"):
        found(20, 80, 0)
    np.testing.assert_allclose(found(30, 40, 90), lobes(30, 40, 90), rtol=0.03)


@pytest.mark.parametrize(
    ("function", "match"),
    [
        (lambda i, r, p: np.full(np.broadcast(i, r, p).shape, np.nan), "finite"),
        (lambda i, r, p: np.full(np.broadcast(i, r, p).shape, -0.1), "0 or more"),
        (lambda i, r, p: np.ones((*np.broadcast(i, r, p).shape, 2)), "R, G, B"),
        (lambda i, r, p: np.ones(7), "shape"),
    ],
    ids=["nan", "negative", "two channels", "shape"],
)
def test_a_bad_function_leaves_the_old_file(tmp_path: Path, function: Any, match: str) -> None:
    path = tmp_path / "old.binary"
    path.write_bytes(b"old")
    with pytest.raises(DomainError, match=match):
        write_merl(path, function)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_intensity_is_refused(tmp_path: Path) -> None:
    class Intensity:
        mode = "intensity"

        def __call__(self, i: Any, r: Any, p: Any) -> Any:
            return np.ones(np.broadcast(i, r, p).shape)

    with pytest.raises(DomainError, match="1/sr"):
        write_merl(tmp_path / "x.binary", Intensity())


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "ends at byte 0"),
        (b"\x5a\0\0\0\x5a", "ends at byte 5"),
        (struct.pack("<3i", 90, 90, 360) + bytes(64), r"byte 0: bins \(90, 90, 360\)"),
        (struct.pack(">3i", *BINS) + bytes(64), "byte 0: bins"),
        (struct.pack("<3i", *BINS) + bytes(64), "ends at byte 76: expected 34992012"),
        (b"#DIM 2 1\n0 0 1\n", "byte 0"),
    ],
)
def test_foreign_and_cut_files(tmp_path: Path, content: bytes, match: str) -> None:
    path = tmp_path / "bad.binary"
    path.write_bytes(content)
    with pytest.raises(TableError, match=match):
        read_merl(path)


def test_files_that_are_not_there_too_long_or_hold_no_number(tmp_path: Path, scratch: Path) -> None:
    with pytest.raises(TableError, match="cannot be read"):
        read_merl(tmp_path / "none.binary")
    with pytest.raises(TableError, match="cannot be written"):
        write_merl(tmp_path / "none" / "x.binary", lobes)
    with scratch.open("r+b") as file:
        file.seek(HEADER + 8 * 123_456)
        file.write(struct.pack("<d", math.nan))
    with pytest.raises(TableError, match=f"byte {HEADER + 8 * 123_456}: the value is nan"):
        read_merl(scratch)
    with scratch.open("ab") as file:
        file.write(b"x")
    with pytest.raises(TableError, match=f"goes on after byte {SIZE}"):
        read_merl(scratch)


@settings(SETTINGS, max_examples=12)
@given(st.integers(0, SIZE - 1), st.binary(min_size=1, max_size=16), st.booleans())
def test_changed_bytes_give_a_table_or_a_named_error(scratch: Path, at: int, bytes_: bytes, begin: bool) -> None:
    at = at % (HEADER + 32) if begin else at
    bytes_ = bytes_[: SIZE - at]
    with scratch.open("r+b") as file:
        file.seek(at)
        was = file.read(len(bytes_))
        file.seek(at)
        file.write(bytes_)
    try:
        assert np.all(np.isfinite(read_merl(scratch).values))
    except FitError as error:
        assert "byte" in str(error)  # noqa: PT017  it may as well not be raised
    finally:
        with scratch.open("r+b") as file:
            file.seek(at)
            file.write(was)


def test_units() -> None:
    np.testing.assert_allclose(UNITS * 1500, [1.0, 1.15, 1.66])


def test_a_grid_is_linear_between_its_nodes_and_whole_around() -> None:
    """Linear functions come out exactly; half a turn of an isotropic sample stands for both halves."""

    def linear(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return 1 + 0.01 * theta_i + 0.02 * theta_r + 0.001 * np.abs(np.remainder(np.asarray(phi) + 180, 360) - 180)

    half = Brdf.sampled(linear, [0, 20, 60], [0, 50, 80], np.arange(0, 181, 20.0))
    whole = Brdf.sampled(linear, [0, 20, 60], [0, 50, 80], np.arange(0, 360, 20.0))
    rng = np.random.default_rng(5)
    theta_i, theta_r, phi = rng.uniform(0, 60, 200), rng.uniform(0, 80, 200), rng.uniform(-400, 400, 200)
    for grid in (half, whole):
        np.testing.assert_allclose(grid(theta_i, theta_r, phi)[..., 0], linear(theta_i, theta_r, phi), rtol=1e-12)
        np.testing.assert_allclose(grid(theta_i, -theta_r, phi), grid(theta_i, theta_r, phi + 180), rtol=1e-12)
        assert grid.covers(theta_i, theta_r, phi).all()
        assert not grid.covers([61, 30], [30, 81], 0).any()
        with pytest.raises(DomainError, match="theta_r = 81 deg is outside the grid"):
            grid(30, 81, 0)
    slice_ = Brdf.sampled(linear, [0, 20], [0, 50], [0, 30, 60])
    assert slice_.covers(10, 10, [-50, 50]).all()
    assert not slice_.covers(10, 10, [-70, 70, 180]).any()


def test_a_sample_with_a_grain_is_lit_from_its_first_azimuth() -> None:
    values = np.arange(2 * 2 * 2 * 4, dtype=float).reshape(2, 2, 2, 4, 1)
    grid = Brdf([0, 60], [10, 100], [0, 60], [0, 90, 180, 270], values)
    assert grid(60, 60, 80)[0] == values[1, 0, 1, 1, 0]
    assert grid(60, 60, -10)[0] == values[1, 0, 1, 0, 0]


def test_a_grid_of_one_plane_and_one_incidence() -> None:
    """Where an axis has one node, that is all it covers."""
    grid = Brdf([45.0], None, [0.0, 30.0], [0.0, 180.0], np.ones((1, 2, 2, 1)))
    np.testing.assert_allclose(grid(45, [10, -10], 0), 1)
    assert not grid.covers(44, 10, 0)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"theta_i_deg": [60, 0]}, "rising"),
        ({"theta_r_deg": [0, 190]}, "within 0 to 180"),
        ({"theta_r_deg": [0, math.nan]}, "within 0 to 180"),
        ({"phi_r_deg": [-200, 200]}, "one turn"),
        ({"values": np.ones((2, 2, 3, 1))}, "do not match"),
        ({"values": np.full((2, 2, 2, 1), math.nan)}, "not finite"),
        ({"values": "many"}, "numbers"),
        ({"channels": ()}, "do not match"),
        ({"quantity": "albedo"}, "quantity"),
    ],
)
def test_grids_that_cannot_be(change: dict[str, Any], match: str) -> None:
    good = {"theta_i_deg": [0, 60], "phi_i_deg": None, "theta_r_deg": [0, 60], "phi_r_deg": [0, 180], "values": np.ones((2, 2, 2, 1))}
    Brdf(**good)
    with pytest.raises(DomainError, match=match):
        Brdf(**good | change)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"theta_i_deg": [0]}, "one for each reading"),
        ({"theta_r_deg": [0, 181]}, "within 0 to 180"),
        ({"phi_r_deg": [0, math.inf]}, "finite"),
        ({"values": np.ones(2)}, "expected"),
        ({"values": [[1], [math.nan]]}, "not finite"),
        ({"sigma": [[0.1], [-0.1]]}, "sigma"),
        ({"channels": ("a", "b")}, "expected"),
    ],
)
def test_readings_that_cannot_be(change: dict[str, Any], match: str) -> None:
    good = {f"{name}_deg": [0, 60] for name in ("theta_i", "phi_i", "theta_r", "phi_r")} | {"values": [[1], [2]], "sigma": [[0], [0.1]]}
    assert len(Scattered(**good)) == 2
    with pytest.raises(DomainError, match=match):
        Scattered(**good | change)


def test_one_channel_answers_for_all() -> None:
    assert ask(lambda i, r, p: np.ones(np.broadcast(i, r, p).shape), [1.0, 2.0], 3.0, 4.0, channels=3).shape == (2, 3)
