"""CSV tables: what is written comes back to the last digit, here and through the reader of the fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting import DomainError, FitError, Measurements, TableError, read_csv
from fitting.formats.grid import Brdf, Scattered
from fitting.formats.table_csv import in_plane, measurements_of_scattered, read_table, write_csv

TEXT = """# a rose
theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,brdf_per_sr,sigma_per_sr
45,0,10,0,0.5,0.01
45,0,20,180,0.25,0.02

45,0,30,90,0.125,0.03
"""

Write = Callable[[str], Path]


@pytest.fixture
def written(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "readings.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("quantity", ["intensity", "reflectance-factor", "brdf"])
@pytest.mark.parametrize("with_sigma", [True, False])
def test_measurements_through_the_reader_of_the_fit(tmp_path: Path, quantity: str, with_sigma: bool) -> None:
    random = np.random.default_rng(1)
    data = Measurements(
        theta_i_deg=90 * random.random(20),
        theta_r_deg=180 * random.random(20) - 90,
        value=0.01 + random.random(20),
        sigma=random.random(20) if with_sigma else None,
        quantity=quantity,  # type: ignore[arg-type]
        source="one\ntwo",
    )
    path = tmp_path / "readings.csv"
    write_csv(path, data)
    back = read_csv(path)
    for name in ("theta_i_deg", "theta_r_deg", "value"):
        np.testing.assert_array_equal(getattr(back, name), getattr(data, name))
    assert back.quantity == quantity
    assert (back.sigma is not None) == with_sigma
    if with_sigma:
        np.testing.assert_array_equal(back.sigma, data.sigma)


@settings(max_examples=40)
@given(seed=st.integers(0, 1 << 30), channels=st.sampled_from([("value",), ("R", "G", "B"), ("550 nm", "a_b")]), btdf=st.booleans())
def test_readings_come_back(tmp_path_factory: pytest.TempPathFactory, seed: int, channels: tuple[str, ...], btdf: bool) -> None:
    random = np.random.default_rng(seed)
    n = 12
    theta_i, phi_i, theta_r, phi_r = random.random((4, n)) * [[180], [720], [180], [360]]
    values, sigma = random.normal(size=(2, n, len(channels)))
    data = Scattered(
        theta_i, phi_i - 360, theta_r, phi_r, values, np.abs(sigma) if seed % 2 else None, channels, "btdf" if btdf else "brdf"
    )
    path = tmp_path_factory.getbasetemp() / "readings.csv"
    write_csv(path, data)
    back = read_table(path)
    for name in ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", "values"):
        np.testing.assert_array_equal(getattr(back, name), getattr(data, name))
    assert (back.channels, back.quantity) == (channels, data.quantity)
    assert (back.sigma is None) == (data.sigma is None)
    if data.sigma is not None:
        np.testing.assert_array_equal(back.sigma, data.sigma)


def test_grid_and_function(tmp_path: Path) -> None:
    path = tmp_path / "grid.csv"
    values = np.arange(2 * 3 * 2 * 2, dtype=float).reshape(2, 3, 2, 2, 1)
    write_csv(path, Brdf(np.array([10.0, 20]), np.array([0.0, 90, 180]), np.array([0.0, 50]), np.array([5.0, 95]), values, "btdf"))
    table = np.loadtxt(path, delimiter=",", skiprows=2)
    np.testing.assert_array_equal(table[:, 4], np.arange(24))
    np.testing.assert_array_equal(table[5], [10, 90, 0, 95, 5])
    write_csv(path, lambda theta_i, theta_r, phi: 0.25 + 0.0 * (theta_i + theta_r + phi))
    assert np.all(read_table(path).values == 0.25)
    one = np.zeros(1)
    with pytest.raises(DomainError):
        write_csv(path, Scattered(one, one, one, one, np.zeros((1, 2)), channels=("a,b", "c")))
    assert np.all(read_table(path).values == 0.25)  # as it was


def test_plane_of_incidence() -> None:
    data = Scattered(
        np.full(7, 45.0),
        np.array([0, 0, 0, 350, 350, 0, 0.0]),
        np.array([10, 20, 30, 40, 50, 0, 135.0]),
        np.array([0, 180, 90, -10, 170, 77, -180.0]),
        np.arange(14.0).reshape(7, 2),
        np.ones((7, 2)),
        ("a", "b"),
    )
    found = in_plane(data, channel="b")
    np.testing.assert_array_equal(found.theta_r_deg, [10, -20, 40, -50, 0, -135])  # straight through is theta_i - 180
    np.testing.assert_array_equal(found.value, [1, 3, 7, 9, 11, 13])
    np.testing.assert_array_equal(found.rows, [1, 2, 4, 5, 6, 7])
    assert found.quantity == "brdf"
    with pytest.raises(DomainError, match="choose one of a, b"):
        in_plane(data)
    everything = measurements_of_scattered(data, channel="b")
    np.testing.assert_array_equal(everything.theta_r_deg, [10, -20, 30, 40, -50, 0, -135])
    np.testing.assert_array_equal(everything.phi_deg, [0, 0, 90, 0, 0, 0, 0])
    np.testing.assert_array_equal(everything.value, [1, 3, 5, 7, 9, 11, 13])


def test_measurements_out_of_the_plane(tmp_path: Path) -> None:
    theta_r, phi = [-10.0, 20, 30, 40], [0.0, 90, -179, 0.1]
    data = Measurements([45.0] * 4, theta_r, [1.0, 2, 3, 4], quantity="brdf", phi_deg=phi)  # type: ignore[arg-type]
    write_csv(tmp_path / "readings.csv", data)
    back = read_csv(tmp_path / "readings.csv")
    np.testing.assert_array_equal(back.theta_r_deg, theta_r)
    np.testing.assert_array_equal(back.phi_deg, phi)


@pytest.mark.parametrize(
    ("change", "line", "says"),
    [
        (("0.25,", "nan,"), 4, "brdf_per_sr is 'nan'"),
        (("0.25,", "0.25,1,"), 4, "7 numbers, expected 6"),
        (("0.25", ""), 4, "brdf_per_sr is ''"),
        (("0.02", "-0.02"), 4, "sigma is below 0"),
        (("45,0,20,180", "45,0,10,0"), 4, "same angles as in line 3"),
        (("20,180", "-20,180"), 4, "theta_r"),
        (("45,0,20,180", "181,0,20,180"), 4, "theta_i"),
        (("brdf_per_sr", "brf"), 2, "in 1/sr"),
        (("brdf_per_sr", "brdf_R_per_sr"), 2, "sigma is given for value"),
        (("sigma_per_sr", "btdf_per_sr"), 2, "either brdf or btdf"),
        (("sigma_per_sr", "brdf_per_sr"), 2, "named twice"),
        (("phi_i_deg,", ""), 2, "no column phi_i_deg"),
        (("0.25,", '"0.25,'), 4, "comma-separated"),
    ],
)
def test_bad_table(written: Write, change: tuple[str, str], line: int, says: str) -> None:
    assert change[0] in TEXT
    with pytest.raises(TableError, match=says) as caught:
        read_table(written(TEXT.replace(*change)))
    assert caught.value.line == line


def test_no_table(written: Write, tmp_path: Path) -> None:
    binary = tmp_path / "binary"
    binary.write_bytes(b"\x7fELF" + bytes(100_000))
    for path in (binary, tmp_path / "nowhere", written(""), written("# nothing\n"), written(TEXT[:80])):
        with pytest.raises(TableError):
            read_table(path)


@settings(max_examples=150)
@given(at=st.integers(0, len(TEXT) - 1), change=st.binary(max_size=4), cut=st.booleans())
def test_damage_is_named(tmp_path_factory: pytest.TempPathFactory, at: int, change: bytes, cut: bool) -> None:
    whole = TEXT.encode()
    path = tmp_path_factory.getbasetemp() / "damaged.csv"
    path.write_bytes(whole[:at] + change + (b"" if cut else whole[at + 1 :]))
    try:
        said = read_table(path).source
    except FitError as error:
        said = str(error)
    assert path.name in said
