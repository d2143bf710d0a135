"""Any file into any other: what is lost is said, what cannot be done is refused, and other people's readers agree."""

from __future__ import annotations

import functools
import itertools
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fitting.errors import DomainError, FitError, TableError
from fitting.formats import files
from fitting.formats.about import about
from fitting.formats.files import FORMATS, ChannelError, Data, format_named, format_of, listed_of, read_any, write_any
from fitting.formats.grid import Brdf, Scattered, ask
from fitting.formats.hemisphere import BeyondError, Whole, albedo, gridded, holes
from fitting.formats.merl import BINS, HEADER, Merl
from fitting.formats.rgl import Rgl
from tests.formats.lobes import lobes
from tests.formats.radiance import ask_radiance
from tests.formats.test_rgl import drawn, evaluated
from tests.formats.test_zemax import parse

SETTINGS = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
READABLE = [kind for kind, form in FORMATS.items() if form.readable]
NAMES = {kind: f"grey{form.suffixes[0]}" for kind, form in FORMATS.items()}
TOLERANCE = {
    "merl": (0.005, 0.03),
    "rgl": (0.005, 0.02),
    "klems": (0.03, 0.15),
    "alta": (0.01, 0.04),
    "pab": (0.01, 0.04),
    "csv": (0.01, 0.04),
}
"""Median and 95th percentile of what a format may be off by, between its nodes: patches of 10 deg are the coarsest."""


def grey(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    return lobes(theta_i, theta_r, phi)[..., 2]


def forward(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    i, r, p = map(np.radians, (theta_i, theta_r, phi))
    return 0.05 + 0.2 * np.maximum(-np.cos(i) * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(p), 0) ** 3


def back(paths: tuple[Path, ...]) -> Data:
    return read_any(paths if len(paths) > 1 else paths[0])


def looked_up(data: Data, at: Any) -> Any:
    """Values at rows of theta_i, phi_i, theta_r, phi_r, and the nearest beyond the end."""
    whole = Whole(gridded(data) if isinstance(data, Scattered) else data, "nearest")
    return whole(at[:, 0], at[:, 2], at[:, 3] - at[:, 1])


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, ...]]:
    """One reflectance in every format."""
    folder = tmp_path_factory.mktemp("sources")
    return {kind: write_any(folder / name, grey).paths for kind, name in NAMES.items()}


@pytest.fixture(scope="module")
def found(sources: dict[str, tuple[Path, ...]]) -> Callable[[str], Data]:
    """The same, each read when first asked for."""
    return functools.cache(lambda kind: back(sources[kind]))


@pytest.fixture
def coarse_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Klems matrices are means of 16 samples, not 256; how good these are is test_klems' business."""
    monkeypatch.setattr(files, "write_klems", functools.partial(files.write_klems, samples=2))


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_patches")
@pytest.mark.parametrize(("kind", "to"), [pair for pair in itertools.product(READABLE, FORMATS) if pair[0] != pair[1]])
def test_every_format_into_every_other(found: Callable[[str], Data], tmp_path: Path, kind: str, to: str) -> None:
    data = found(kind)
    written = write_any(tmp_path / NAMES[to], data, beyond="nearest", channel="G" if len(data.channels) == 3 else None)
    assert written.format == to
    if to == "zemax":
        _, axes, total, _ = parse(written.paths[0])
        expected = [albedo(grey, theta)[0] for theta in axes["AngleOfIncidence"]]
        np.testing.assert_allclose(total, expected, rtol=0.03)
        return
    at = drawn(11, 1500, 75.0)
    off = np.abs(looked_up(back(written.paths), at)[:, 0] / grey(at[:, 0], at[:, 2], at[:, 3] - at[:, 1]) - 1)
    median, most = np.array(TOLERANCE[kind]) + TOLERANCE[to]
    assert np.median(off) < median
    assert np.percentile(off, 95) < most


def test_lists_are_carried_to_the_last_digit(tmp_path: Path) -> None:
    """Readings with error bars, out of the plane and not on any grid: ALTA and CSV lose nothing but a rounding of radians."""
    random = np.random.default_rng(1)
    angles = random.uniform(1, 80, 50), random.uniform(0, 360, 50), random.uniform(1, 80, 50), random.uniform(0, 360, 50)
    data = Scattered(*angles, values=random.normal(0.3, 0.2, (50, 3)), sigma=random.uniform(0, 0.1, (50, 3)), channels=("R", "G", "B"))
    assert (data.values < 0).any()
    write_any(tmp_path / "a.csv", data)
    write_any(tmp_path / "b.dat", read_any(tmp_path / "a.csv"))
    written = write_any(tmp_path / "c.csv", read_any(tmp_path / "b.dat"))
    found = back(written.paths)
    assert isinstance(found, Scattered)
    assert found.channels == data.channels
    for name in ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg"):
        np.testing.assert_allclose(getattr(found, name), getattr(data, name), rtol=1e-12)
    np.testing.assert_array_equal(found.values, data.values)
    np.testing.assert_array_equal(found.sigma, data.sigma)
    pab = write_any(tmp_path / "d.pab", data, channel="G")
    assert pab.notes == ("no error bars", "channels without their names (G)")
    np.testing.assert_array_equal(np.sort(back(pab.paths).values[:, 0]), np.sort(data.values[:, 1]))


def test_mitsuba_loads_what_was_a_merl_file(sources: dict[str, tuple[Path, ...]], tmp_path: Path, mitsuba: Any) -> None:
    path = tmp_path / "fabric.bsdf"
    write_any(tmp_path / "fabric.binary", lobes)
    write_any(path, read_any(tmp_path / "fabric.binary"))
    at = drawn(3, 400, 80.0)
    expected = lobes(at[:, 0], at[:, 2], at[:, 3] - at[:, 1])
    off = np.abs(evaluated(mitsuba, path, at) / expected - 1)
    assert np.median(off) < 0.003
    assert np.percentile(off, 95) < 0.02


@pytest.mark.slow
def test_radiance_reads_what_was_readings(sources: dict[str, tuple[Path, ...]], tmp_path: Path) -> None:
    pytest.importorskip("pyradiance", reason="Radiance is not installed: pip install pyradiance")
    write_any(tmp_path / "petal.xml", back(sources["alta"]), beyond="nearest")
    at = drawn(4, 300, 85.0)
    expected = grey(at[:, 0], at[:, 2], at[:, 3] - at[:, 1])
    found = ask_radiance(tmp_path / "petal.xml", at)
    assert np.corrcoef(found, expected)[0, 1] > 0.95
    assert np.median(found / expected) == pytest.approx(1, abs=0.02)


@pytest.mark.usefixtures("coarse_patches")
@pytest.mark.parametrize("to", ["rgl", "klems", "zemax"])
def test_nothing_is_made_up_beyond_the_readings(found: Callable[[str], Data], tmp_path: Path, to: str) -> None:
    data = found("csv")
    with pytest.raises(BeyondError, match=r"theta_[ir] = [89]\d\S* deg is outside the grid, which has 0 to 8[05] deg.*nearest or zero"):
        write_any(tmp_path / NAMES[to], data)
    assert not list(tmp_path.iterdir())
    for beyond, does in (("nearest", "as at their end"), ("zero", "taken as 0")):
        written = write_any(tmp_path / NAMES[to], data, beyond=beyond)  # type: ignore[arg-type]
        assert f"readings at theta_i 0 to 80 and theta_r 0 to 85 deg, beyond them {does}" in written.notes


def test_nearest_and_zero(sources: dict[str, tuple[Path, ...]], tmp_path: Path) -> None:
    grid = gridded(back(sources["csv"]))  # type: ignore[arg-type]
    beyond = np.array([30.0, 85.0, 88.0]), np.array([88.0, 20.0, 89.5]), np.array([170.0, 40.0, 10.0])
    end = grid(np.minimum(beyond[0], 80), np.minimum(beyond[1], 85), beyond[2])
    np.testing.assert_allclose(Whole(grid, "nearest")(*beyond), end)
    np.testing.assert_array_equal(Whole(grid, "zero")(*beyond), np.zeros((3, 1)))
    assert not Whole(grid).covers(*beyond).any()
    assert Whole(grid, "zero").covers(*beyond).all()
    inside = np.array([80.0]), np.array([85.0]), np.array([60.0])
    for way in ("refuse", "nearest", "zero"):
        np.testing.assert_array_equal(Whole(grid, way)(*inside), grid(*inside))  # type: ignore[arg-type]
    for way, least in (("nearest", 0.9), ("zero", 0.0)):
        found = read_any(write_any(tmp_path / "a.bsdf", grid, beyond=way).paths[0])  # type: ignore[arg-type]
        assert isinstance(found, Rgl)
        ratio = found(30, 88.5, 90)[0] / grid(30, 85, 90)[0]
        assert ratio == pytest.approx(least, abs=0.11 if least else 0.01)
    with pytest.raises(DomainError, match="beyond is 'guess', expected one of refuse, nearest, zero"):
        Whole(grid, "guess")  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_merl_file_marks_what_nobody_measured(sources: dict[str, tuple[Path, ...]], tmp_path: Path) -> None:
    data = back(sources["csv"])
    written = write_any(tmp_path / "a.binary", data)
    assert "readings at theta_i 0 to 80 and theta_r 0 to 85 deg, beyond them marked as without a value" in written.notes
    found = back(written.paths)
    assert isinstance(found, Merl)
    assert not found.covers(30, 89, 0)
    assert found.covers(30, 80, 0)
    missing = holes(found)
    assert missing > 10_000
    assert about(found)["invalid"] == missing
    with pytest.raises(BeyondError, match=r"no value about \d+ of"):
        write_any(tmp_path / "a.bsdf", found)
    again = write_any(tmp_path / "b.binary", found, beyond="nearest")
    assert again.notes == (f"{missing} bins without a value, as at their end",)
    whole = back(again.paths)
    assert isinstance(whole, Merl)
    assert holes(whole) == 0
    np.testing.assert_allclose(whole.values[found.valid], found.values[found.valid], rtol=1e-12)
    np.testing.assert_allclose(whole(30, 88, 90)[1], grey(30, 84, 90), rtol=0.1)
    dark = back(write_any(tmp_path / "c.binary", found, beyond="zero").paths)
    assert isinstance(dark, Merl)
    assert holes(dark) == 0
    assert dark(30, 89.5, 0)[0] == 0
    np.testing.assert_allclose(dark(30, 60, 90), found(30, 60, 90), rtol=0.02)


def anisotropic(theta_i: Any, phi_i: Any, theta_r: Any, phi_r: Any) -> Any:
    """Its mean over the light's azimuth depends on phi_r - phi_i alone."""
    return 0.3 + 0.1 * np.cos(np.radians(phi_r - phi_i)) + 0.2 * np.cos(np.radians(2 * phi_i)) * np.cos(np.radians(theta_r)) + 0 * theta_i


def mean(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    return 0.3 + 0.1 * np.cos(np.radians(phi)) + 0 * (theta_i + theta_r)


def test_a_grain_is_averaged_and_said(tmp_path: Path) -> None:
    lights, views, around = np.arange(0, 81, 20.0), np.arange(0, 86, 5.0), np.arange(0, 360, 15.0)
    phi_i = np.arange(0, 360, 45.0)
    nodes = np.meshgrid(lights, phi_i, views, around, indexing="ij")
    grid = Brdf(lights, phi_i, views, around, anisotropic(*nodes)[..., None])
    at_nodes = np.array([0.0, 75.0, 210.0])
    np.testing.assert_allclose(Whole(grid)(30.0, 40.0, at_nodes)[:, 0], mean(30.0, 40.0, at_nodes), rtol=1e-9)
    listed = write_any(tmp_path / "a.alta", grid)
    assert listed.notes == ()
    data = back(listed.paths)
    assert np.unique(data.phi_i_deg).size == 8  # type: ignore[union-attr]
    for whole in (grid, data):
        written = write_any(tmp_path / "a.bsdf", whole, beyond="nearest")
        assert any(note == "isotropic: the mean over 8 azimuths of the light" for note in written.notes), written.notes
        np.testing.assert_allclose(back(written.paths)(30, 40, [20, 75, 200])[:, 0], mean(30, 40, np.array([20, 75, 200])), rtol=0.02)  # type: ignore[operator]


def test_half_a_turn_with_error_bars_that_light_and_view_may_not_swap(tmp_path: Path) -> None:
    """Azimuths of 0 to 180 deg stand for both halves; error bars go; a MERL file holds the mean of both ways."""

    def one_way(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return 0.2 + 0.1 * np.cos(np.radians(theta_i)) + 0.05 * np.cos(np.radians(phi)) + 0 * theta_r

    theta = np.arange(0, 91, 10.0)
    nodes = [at.ravel() for at in np.meshgrid(theta, theta, np.arange(0, 181, 15.0), indexing="ij")]
    values = one_way(*nodes)[:, None]
    half = Scattered(nodes[0], np.zeros(len(values)), nodes[1], nodes[2], values=values, sigma=values / 10)
    written = write_any(tmp_path / "a.binary", half)
    assert written.notes == ("no error bars", "light and view are taken to be exchangeable: the mean of both ways", "R, G and B are alike")
    found = back(written.paths)
    for phi in (60.0, -60.0, 240.0):
        np.testing.assert_allclose(found(20, 70, phi), (one_way(20, 70, phi) + one_way(70, 20, phi)) / 2, rtol=0.005)  # type: ignore[operator]


def test_lights_whose_azimuths_interleave_are_averaged_each_over_its_turn(tmp_path: Path) -> None:
    """Pooled, the two would make a saw."""
    theta, around = np.array([0.0, 45.0, 90.0]), np.arange(0, 360, 15.0)
    parts = [
        [i, phi_i, r, phi_r, 1.0 + phi_i]
        for phi_i in (0.0, 7.0)
        for i in theta
        for r in theta
        for phi_r in around
        if i > 0 or phi_i == 0  # light along the normal has no azimuth
    ]
    columns = np.array(parts).T
    grid = gridded(Scattered(*columns[:4], values=columns[4][:, None]))
    assert grid.metadata["azimuths"] == 2
    assert grid.metadata["filled_in"]
    np.testing.assert_allclose(grid.values[1:], 4.5)
    np.testing.assert_allclose(grid.values[0], 1.0)


@pytest.mark.slow
def test_an_rgl_file_with_a_grain(tmp_path: Path) -> None:
    """Pictures that are brighter for some of the light's azimuths: their mean is written, or all of them as readings."""
    plain = read_any(write_any(tmp_path / "a.bsdf", grey).paths[0])
    assert isinstance(plain, Rgl)
    shares = np.array([0.5, 1.0, 1.5, 1.0, 0.5], np.float32)  # the last is the first again

    def around(pictures: Any) -> Any:
        return shares.reshape(-1, *[1] * (pictures.ndim - 1)) * pictures

    # In a file with a grain, half vectors count from phi = 0; a picture that does not depend on phi_m is the same either way.
    even = plain.values[..., :1, :] * 0 + 0.2
    grain = replace(
        plain,
        phi_i_deg=np.array([-180.0, -90.0, 0.0, 90.0, 180.0]),
        values=around(np.broadcast_to(even, plain.values.shape)),
        luminance=around(plain.luminance),
        vndf=np.ones((5, *plain.vndf.shape[1:]), np.float32),
    )
    assert not grain.isotropic
    found = Whole(grain)(40.0, np.array([20.0, 60.0]), 30.0)
    np.testing.assert_allclose(found[:, 0], 0.2 / np.cos(np.radians([20, 60])), rtol=1e-5)
    listed = listed_of(grain)
    assert np.unique(listed.phi_i_deg).tolist() == [-180, -90, 0, 90]
    bright = listed.values[(listed.phi_i_deg == 0) & (listed.theta_r_deg == 60) & (listed.theta_i_deg == 40), 0]
    np.testing.assert_allclose(bright, 1.5 * 0.2 / 0.5, rtol=1e-5)
    assert "isotropic: the mean over 4 azimuths of the light" in write_any(tmp_path / "b.bsdf", grain, beyond="nearest").notes


def test_channels_are_chosen(tmp_path: Path) -> None:
    data = read_any(write_any(tmp_path / "a.bsdf", lobes).paths[0])
    for name in ("x.xml", "x.pab", "x.zemax.bsdf"):
        with pytest.raises(ChannelError, match="not R, G, B: choose one channel"):
            write_any(tmp_path / name, data)
    with pytest.raises(DomainError, match="no channel 'Z'; choose one of R, G, B"):
        write_any(tmp_path / "x.xml", data, channel="Z")
    with pytest.raises(DomainError, match="cannot be chosen"):
        write_any(tmp_path / "x.xml", grey, channel="R")
    written = write_any(tmp_path / "b.binary", data, channel="B")
    assert "R, G and B are alike" in written.notes
    found = back(written.paths)(30, 50, 60)  # type: ignore[operator]
    np.testing.assert_allclose(found, np.full(3, grey(30, 50, 60)), rtol=0.02)
    np.testing.assert_allclose(
        back(write_any(tmp_path / "c.csv", back(written.paths), channel="G").paths).values[0], lobes(0, 0, 0)[2], rtol=0.01
    )  # type: ignore[union-attr]


def test_wavelengths_are_kept(tmp_path: Path) -> None:
    names = ("400 nm", "550 nm", "700 nm")
    spectrum = Brdf.sampled(lobes, np.arange(0, 91, 5.0), np.arange(0, 91, 5.0), np.arange(0, 360, 5.0), channels=names)
    written = write_any(tmp_path / "a.bsdf", spectrum)
    assert written.notes == ()
    found = back(written.paths)
    assert found.channels == names
    with pytest.raises(ChannelError, match="R, G, B, not 400 nm, 550 nm, 700 nm"):
        write_any(tmp_path / "a.binary", found)
    table = write_any(tmp_path / "a.csv", found)
    assert back(table.paths).channels == names
    assert any("grey" in note or "alike" in note for note in write_any(tmp_path / "b.bsdf", found, channel="550 nm").notes)


def test_in_plane_readings_make_no_hemisphere(tmp_path: Path) -> None:
    (tmp_path / "leaf.csv").write_text(
        "theta_i_deg,theta_r_deg,brdf_per_sr\n" + "".join(f"45,{t},0.{abs(t) + 10}\n" for t in range(-60, 61, 20))
    )
    data = read_any(tmp_path / "leaf.csv")
    assert isinstance(data, Scattered)
    assert sorted(set(zip(data.theta_r_deg.tolist(), data.phi_r_deg.tolist(), strict=True)))[:3] == [(0, 0), (20, 0), (20, 180)]
    with pytest.raises(
        DomainError, match=r"7 readings do not make a hemisphere: .* 180 deg of azimuth\. Fit first \(rig fit FILE\), then convert the fit"
    ):
        write_any(tmp_path / "leaf.bsdf", data, beyond="nearest")
    np.testing.assert_array_equal(back(write_any(tmp_path / "leaf.alta", data).paths).values, data.values)  # type: ignore[union-attr]
    holey = Scattered(*np.array([[10, 0, 10, 0], [20, 0, 20, 0]], float).T, values=np.ones((2, 1)))
    with pytest.raises(DomainError, match="none at theta_i 10, theta_r 20 deg"):
        gridded(holey)


def test_tables_of_factors_are_divided_and_relative_ones_refused(tmp_path: Path) -> None:
    text = "theta_i,theta_r,{}\n45,-30,0.5\n45,0,0.4\n45,30,0.3\n45,50,0.2\n"
    (tmp_path / "a.csv").write_text(text.format("reflectance_factor"))
    np.testing.assert_allclose(read_any(tmp_path / "a.csv").values[:, 0], np.array([0.5, 0.4, 0.3, 0.2]) / np.pi)  # type: ignore[union-attr]
    (tmp_path / "b.csv").write_text(text.format("intensity"))
    with pytest.raises(TableError, match="relative readings, which are no reflectance: fit them"):
        read_any(tmp_path / "b.csv")


@pytest.mark.usefixtures("coarse_patches")
def test_what_goes_through(tmp_path: Path) -> None:
    behind = Brdf.sampled(forward, np.arange(0, 91, 5.0), np.arange(90, 181, 5.0), np.arange(0, 360, 5.0), quantity="btdf")
    written = write_any(tmp_path / "a.xml", behind)
    with pytest.raises(TableError, match="no Reflection Back"):
        read_any(tmp_path / "a.xml")
    found = read_any(tmp_path / "a.xml", quantity="btdf")
    assert isinstance(found, Scattered)
    assert found.quantity == "btdf"
    ratio = found.values[:, 0] / forward(found.theta_i_deg, found.theta_r_deg, found.phi_r_deg - found.phi_i_deg)
    assert np.percentile(ratio, [5, 95]) == pytest.approx([1, 1], abs=0.1)
    assert about(found)["quantity"] == "btdf"
    for name in ("a.binary", "a.bsdf"):
        with pytest.raises(DomainError, match=r"holds reflection only: write \.xml or \.zemax\.bsdf"):
            write_any(tmp_path / name, found)
    header, axes, total, _ = parse(write_any(tmp_path / "a.zemax.bsdf", found, beyond="nearest").paths[0])
    assert header["ScatterType"] == "BTDF"
    np.testing.assert_allclose(total, [albedo(forward, theta, through=True)[0] for theta in axes["AngleOfIncidence"]], rtol=0.03)
    assert written.notes == ("means over patches 10 deg wide or more",)


def test_a_matrix_says_what_is_left_out(tmp_path: Path) -> None:
    from fitting.formats.klems import write_klems

    write_klems(tmp_path / "both.xml", grey, transmitted=forward, basis="LBNL/Klems Quarter", samples=2)
    for name in ("a.csv", "a.bsdf"):
        notes = write_any(tmp_path / name, read_any(tmp_path / "both.xml"), beyond="nearest").notes
        assert "only Reflection Back, without Transmission Back (Visible)" in notes


@pytest.mark.parametrize(
    ("make", "size", "expected"),
    [
        (lambda folder: write_any(folder / "a.binary", grey), {"bins": 1458000}, (0, 0.4)),
        (lambda folder: write_any(folder / "a.bsdf", grey), {"pictures": 33, "points along a side": 128}, (0, 0.4)),
        (lambda folder: write_any(folder / "a.alta", grey), {"readings": 9 * 18 * 72}, (0, 0.4)),
        (lambda folder: write_any(folder / "a.xml", grey), {"readings": 145**2}, (0, 0.39)),
    ],
    ids=["merl", "rgl", "alta", "klems"],
)
def test_about(tmp_path: Path, make: Any, size: dict[str, int], expected: tuple[int, float]) -> None:
    said = about(back(make(tmp_path).paths))
    assert said["size"].items() >= size.items()
    assert said["largest"] == pytest.approx(expected[1], rel=0.03)
    assert said["largest_at"][:2] == pytest.approx([0, 0], abs=20.1)
    assert (said["negative"], said["invalid"]) == (expected[0], 0)
    assert [share["theta_i"] for share in said["albedo"]] == [0, 30, 45, 60, 75]
    for share in said["albedo"]:
        exact = albedo(grey, share["theta_i"], share["to_theta_r"])
        assert share["share"][-1] == pytest.approx(exact[0], rel=0.02), share
        if share["theta_i"] == 0:  # the integrals of cos, cos^11 and of nothing: see `lobes`
            end = np.cos(np.radians(share["to_theta_r"]))
            by_hand = 2 * np.pi * (0.1 * (1 - end**2) / 2 + 0.3 * (1 - end**12) / 12)
            assert exact[0] == pytest.approx(by_hand, rel=1e-3)


def test_about_counts_what_is_below_zero_and_says_why_there_is_no_albedo(tmp_path: Path) -> None:
    data = Scattered(*np.array([[45, 0, 30, 0], [45, 0, 40, 0], [45, 0, 50, 180]], float).T, values=np.array([[0.2], [-0.1], [0.5]]))
    said = about(data)
    assert (said["negative"], said["least"], said["largest"], said["largest_at"]) == (1, -0.1, 0.5, [45, 50, 180])
    assert said["albedo"] == []
    assert "do not make a hemisphere" in said["no_albedo"]
    noisy = Brdf(np.array([0.0, 90]), None, np.array([0.0, 90]), np.array([0.0, 90, 180]), np.full((2, 2, 3, 1), -0.1))
    with pytest.raises(DomainError, match=r"answered with -0\.1, expected finite values of 0 or more"):
        write_any(tmp_path / "a.bsdf", noisy)


@pytest.mark.parametrize("kind", READABLE)
def test_content_comes_before_the_name(sources: dict[str, tuple[Path, ...]], tmp_path: Path, kind: str) -> None:
    content = sources[kind][0].read_bytes()
    for name in ("a.binary", "b.bsdf", "c.xml", "d.csv", "e.zemax.bsdf", "f.png", "g"):
        path = tmp_path / name
        path.write_bytes(content)
        assert format_of(path) == kind
        path.unlink()


def test_zemax_files_are_known_and_only_written(sources: dict[str, tuple[Path, ...]]) -> None:
    assert format_of(sources["zemax"][0]) == "zemax"
    with pytest.raises(TableError, match="Zemax tabular BSDF is written only"):
        read_any(sources["zemax"][0])


def test_names() -> None:
    assert [format_named(name) for name in ("a.bsdf", "a.zemax.bsdf", "A.BINARY", "a.dat", "a.txt", "a.tif", "bsdf")] == [
        "rgl",
        "zemax",
        "merl",
        "alta",
        "pab",
        None,
        None,
    ]


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.bsdf", b"", "is empty; known are merl"),
        ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(40), r"byte 0: neither .* begins with b'\\x89PNG.*Known are merl \(.binary\), rgl"),
        ("a.txt", b"\x89PNG\r\n\x1a\n" + bytes(40), "byte 0: neither"),
        ("a.json", b'{"x": 1}', "byte 0: neither"),
        ("a.binary", b"hello", "ends at byte 5, within the header"),
        ("a.binary", struct.pack("<3i", 90, 90, 360) + bytes(99), r"byte 0: bins \(90, 90, 360\)"),
        ("a.what", struct.pack("<3i", *BINS) + bytes(99), f"ends at byte {HEADER + 99}"),
        ("a.bsdf", b"nothing of the kind", "byte 0: does not begin with"),
        ("a.bsdf", b"tensor_file\0\1\0\xff\xff\xff\xff", "ends at byte 18, within its table"),
        ("a.xml", b"hello", "line 1|is not whole XML"),
        ("a.csv", b"<html><body>404</body></html>", "expected WindowElement"),
        ("a.csv", b"a,b\n1,2\n", "theta_i"),
        ("a.dat", b"1 2 3\n", "line 1: numbers before any #DIM"),
        ("a.pab", b"1 2 3\n", "line 1: numbers before any line that says the format"),
        ("a.csv", b"#format: theta phi BRDF\n1 2 3\n", "line 2: numbers before any line that says the incidence"),
    ],
)
def test_foreign_empty_and_cut_files(tmp_path: Path, name: str, content: bytes, match: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FitError, match=match) as raised:
        read_any(tmp_path / name)
    assert str(tmp_path / name) in str(raised.value)


def test_wrong_requests(sources: dict[str, tuple[Path, ...]], tmp_path: Path) -> None:
    with pytest.raises(TableError, match="cannot be read: No such file"):
        read_any(tmp_path / "none.binary")
    with pytest.raises(DomainError, match="unknown format 'exr'; known are merl"):
        read_any(sources["csv"][0], "exr")
    with pytest.raises(DomainError, match="no file was given"):
        read_any([])
    with pytest.raises(TableError, match="only pab files are read several at a time"):
        read_any([sources["csv"][0], sources["alta"][0]])
    with pytest.raises(DomainError, match="which has no param_out"):
        read_any(sources["csv"][0], param_out="INV_STERADIAN")
    with pytest.raises(DomainError, match="says no format; known are merl"):
        write_any(tmp_path / "a.tif", grey)
    with pytest.raises(DomainError, match="unknown format 'exr'"):
        write_any(tmp_path / "a.binary", grey, "exr")
    with pytest.raises(TableError, match="byte 0"):
        read_any(sources["csv"][0], "rgl")
    assert format_of(write_any(tmp_path / "a.bsdf", grey, "zemax").paths[0]) == "zemax"


@SETTINGS
@given(st.data())
def test_changed_headers_give_a_table_or_a_named_error(sources: dict[str, tuple[Path, ...]], tmp_path: Path, data: st.DataObject) -> None:
    """Small files of every kind, their first bytes changed, under any name."""
    kind = data.draw(st.sampled_from(READABLE))
    content = bytearray(sources[kind][0].read_bytes()[: data.draw(st.sampled_from([200, 700, 3000]))])
    for _ in range(data.draw(st.integers(0, 4))):
        at, piece = data.draw(st.integers(0, min(len(content), 400))), data.draw(st.binary(min_size=1, max_size=8))
        content[at : at + data.draw(st.integers(0, len(piece)))] = piece
    path = tmp_path / f"changed{data.draw(st.sampled_from([s for form in FORMATS.values() for s in form.suffixes] + ['']))}"
    path.write_bytes(content)
    try:
        found = read_any(path)
        assert np.all(np.isfinite(found.values))
    except FitError as error:
        assert str(path) in str(error)  # noqa: PT017  it may as well not be raised


def test_a_function_is_asked_for_what_a_file_can_hold(tmp_path: Path) -> None:
    """What a fit gives is a plain function: nothing lies beyond it, and it is not asked below the horizon."""
    asked: list[float] = []

    def function(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        asked.append(float(np.max(np.abs(theta_r))))
        return grey(theta_i, theta_r, phi)

    for name in NAMES.values():
        notes = write_any(tmp_path / name, function).notes
        assert not any("beyond" in note for note in notes)
    assert max(asked) <= 90
    np.testing.assert_allclose(ask(function, 30, 40, 50), [grey(30, 40, 50)])
