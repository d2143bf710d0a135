"""ALTA text: its angles, its error bars, a real file, and what is wrong with files."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting import DomainError, FitError, TableError
from fitting.formats.alta import TIMES_COS, read_alta, write_alta
from fitting.formats.grid import Brdf, Scattered
from fitting.formats.table_csv import in_plane

TEXT = """#SAMPLE "rose"
#DIM 4 1
#VS 1
#PARAM_IN SPHERICAL_TL_PL_TV_PV
#PARAM_OUT INV_STERADIAN
#ALTA END HEADER
0.5 0 0.25 3 0.75 0.01

0.5 0 0.50 3 0.65 0.02
1.0 0 0.75 3 0.55 0.03
"""

Write = Callable[[str], Path]


@pytest.fixture
def written(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "readings.dat"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def head(parameters: str, inputs: int, outputs: str = "INV_STERADIAN", count: int = 1, segments: str = "0") -> str:
    return f"#DIM {inputs} {count}\n#PARAM_IN {parameters}\n#PARAM_OUT {outputs}\n#VS {segments}\n"


def geometry(found: Scattered) -> Any:
    return np.column_stack([found.theta_i_deg, found.theta_r_deg, (found.phi_r_deg - found.phi_i_deg) % 360])


def test_hand_made_file(written: Write) -> None:
    found = read_alta(written(TEXT))
    np.testing.assert_allclose(found.theta_i_deg, np.degrees([0.5, 0.5, 1]))
    np.testing.assert_allclose(found.theta_r_deg, np.degrees([0.25, 0.5, 0.75]))
    np.testing.assert_allclose(found.phi_r_deg, np.degrees(3))
    np.testing.assert_array_equal(found.values[:, 0], [0.75, 0.65, 0.55])
    assert found.sigma is not None
    np.testing.assert_array_equal(found.sigma[:, 0], [0.01, 0.02, 0.03])
    assert (found.quantity, found.channels, found.metadata["SAMPLE"]) == ("brdf", ("value",), "rose")


def test_segments_of_two_ends_and_of_two_deviations(written: Write) -> None:
    path = written(head("ISOTROPIC_TV_TL", 2, segments="2") + "0.1 0.2 5 4.5 5.7\n")
    found = read_alta(path, coverage=2)
    assert found.sigma is not None
    assert found.sigma[0, 0] == pytest.approx(0.3, rel=1e-12)
    with pytest.raises(DomainError):
        read_alta(path, coverage=0)


@pytest.mark.parametrize(
    ("parameters", "row", "expected"),
    [
        ("ISOTROPIC_TV_TL_DPHI", (0.2, 0.7, 1.5), (0.7, 0.2, 1.5)),
        ("ISOTROPIC_TV_TL", (0.2, 0.7), (0.7, 0.2, 0)),
        ("ISOTROPIC_TV_TL", (-0.2, 0.7), (0.7, 0.2, pi)),
        ("ISOTROPIC_TL_TV_PROJ_DPHI", (0.7, 0.2, 0), (0.7, 0.2, 0)),  # the light's side
        ("ISOTROPIC_TL_TV_PROJ_DPHI", (0.7, -0.3, 0.4), (0.7, 0.5, pi - np.arctan2(4, 3))),
        ("RUSIN_TH_TD_PD", (0, 0.4, 1), (0.4, 0.4, pi)),  # the mirror
        ("RUSIN_TH_TD_PD", (0.6, 0, 0), (0.6, 0.6, 0)),  # back to the light
        ("RUSIN_TH_TD_PD", (0.3, 0.2, 0), (0.5, 0.1, 0)),  # in the plane
        ("CARTESIAN", (0.6, 0, 0.8, 0, 0.8, 0.6), (np.arccos(0.6), np.arccos(0.8), 1.5 * pi)),
    ],
)
def test_parametrisations(written: Write, parameters: str, row: tuple[float, ...], expected: tuple[float, ...]) -> None:
    found = read_alta(written(head(parameters, len(row)) + " ".join(map(repr, map(float, row))) + " 0.125\n"))
    np.testing.assert_allclose(geometry(found)[0], np.degrees(expected), atol=1e-6)
    assert found.values[0, 0] == 0.125


@settings(max_examples=50)
@given(seed=st.integers(0, 1000))
def test_half_and_difference_against_vectors(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """The file's angles from two random vectors, by their definition; the reader finds the vectors' own angles."""
    random = np.random.default_rng(seed)
    light, view = (
        np.array([v[0], v[1], abs(v[2]) + 0.05]) / np.linalg.norm([v[0], v[1], abs(v[2]) + 0.05]) for v in random.normal(size=(2, 3))
    )
    half = (light + view) / np.linalg.norm(light + view)
    side = np.cross([0, 0, 1], half) / np.linalg.norm(np.cross([0, 0, 1], half))
    difference = light @ np.cross(side, half), light @ side, light @ half
    angles = np.arccos(half[2]), np.arccos(difference[2]), np.arctan2(difference[1], difference[0])
    path = tmp_path_factory.getbasetemp() / "half.dat"
    path.write_text(head("RUSIN_TH_TD_PD", 3) + " ".join(repr(float(a)) for a in angles) + " 1\n")
    turn = np.arctan2(view[1], view[0]) - np.arctan2(light[1], light[0])
    theta_i, theta_r, phi = geometry(read_alta(path))[0]
    np.testing.assert_allclose([theta_i, theta_r], np.degrees([np.arccos(light[2]), np.arccos(view[2])]), atol=1e-5)
    assert np.cos(np.radians(phi)) == pytest.approx(np.cos(turn), abs=1e-6)
    assert np.sin(np.radians(phi)) == pytest.approx(np.sin(turn), abs=1e-6)


def test_written_and_read_back(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    n = 200
    data = Scattered(
        90 * random.random(n),
        360 * random.random(n) - 180,
        90 * random.random(n),
        360 * random.random(n),
        random.normal(size=(n, 3)),
        random.random((n, 3)),
        ("R", "G", "B"),
    )
    path = tmp_path / "readings.dat"
    write_alta(path, data)
    assert "#PARAM_OUT RGB_COLOR\n" in path.read_text()
    back = read_alta(path)
    for name in ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg"):
        np.testing.assert_allclose(getattr(back, name), getattr(data, name), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(back.values, data.values)
    np.testing.assert_array_equal(back.sigma, data.sigma)
    assert back.channels == data.channels


def test_plain_reader(tmp_path: Path) -> None:
    """NumPy reads what is written, which is what the format promises: numbers in columns, the rest behind '#'."""
    path = tmp_path / "grid.dat"
    grid = Brdf(np.array([10.0, 45]), None, np.array([0.0, 90]), np.array([0.0, 120, 240]), np.arange(12.0).reshape(2, 2, 3, 1))
    write_alta(path, grid)
    table = np.loadtxt(path)
    np.testing.assert_allclose(np.degrees(table[:, 0]), np.repeat([10, 45], 6))
    np.testing.assert_allclose(np.degrees(table[:, 2]), np.tile([0, 0, 0, 90, 90, 90], 2))
    np.testing.assert_allclose(np.degrees(table[:, 3]), np.tile([0, 120, 240], 4))
    np.testing.assert_array_equal(table[:, 4], np.arange(12))


def test_tape_that_sends_light_back(shared_data: Path) -> None:
    path = shared_data / "retroreflector" / "retro-gray-tape.dat"
    with pytest.raises(TableError, match="PARAM_OUT"):
        read_alta(path)
    with pytest.raises(TableError, match="90 deg says nothing"):
        read_alta(path, param_out=TIMES_COS)
    found = read_alta(path, param_out=TIMES_COS, theta_r_below_deg=89.9)
    assert len(found) + found.metadata["left_out"] == 7405
    plane = in_plane(found)
    for theta_i in (15, 30):  # at 60 deg the mirror direction is the brightest
        chosen = np.abs(plane.theta_i_deg - theta_i) < 1e-6
        assert plane.theta_r_deg[chosen][np.argmax(plane.value[chosen])] == pytest.approx(theta_i, abs=1e-6)  # back to the light


@pytest.mark.parametrize(
    ("change", "line", "says"),
    [
        (("3 0.65 0.02", "3 0.65"), 9, "5 numbers, expected 6"),
        (("0.65", "inf"), 9, "output 1 is 'inf'"),
        (("0.65", "0_65"), 9, "output 1 is '0_65'"),
        (("0.02", "-0.02"), 9, "below 0"),
        (("0.5 0 0.50", "0.5 0 0.25"), 9, "same angles as in line 7"),
        (("0.5 0 0.50", "28.6 0 0.50"), 9, "degrees"),
        (("0.75 3", "2 3"), 10, "behind the sample"),
        (("#DIM 4 1", "#DIM 3 1"), 7, "3 inputs, and SPHERICAL_TL_PL_TV_PV has 4"),
        (("#DIM 4 1", "#DIM 4 -1"), 2, "whole number"),
        (("#DIM 4 1", "#DIM 4 999999999"), 2, "at most 4096"),
        (("#DIM 4 1", "#DIM 4 0"), 2, "no output"),
        (("#DIM 4 1\n", ""), 6, "#DIM"),
        (("#DIM 4 1", "#DIM 4 1\n#DIM 4 1"), 3, "twice"),
        (("#VS 1", "#VS 3"), 3, "at most 2"),
        (("#VS 1", "#VS 1 1"), 7, "expected one number"),
        (("#VS 1", "#SAMPLE_COUNT 4"), 7, "expected 5"),
        (("#VS 1", "#VS 1\n#SAMPLE_COUNT 4"), 11, "header says 4"),
        (("#VS 1", "#FORMAT binary"), 3, "only the text form"),
        (("TL_PL_TV_PV", "TL_PL"), 4, "not understood"),
        (("INV_STERADIAN", "ENERGY"), None, "param_out"),
        (("INV_STERADIAN", "RGB_COLOR"), None, "3 outputs"),
    ],
)
def test_bad_file(written: Write, change: tuple[str, str], line: int | None, says: str) -> None:
    assert change[0] in TEXT
    with pytest.raises(TableError, match=says) as caught:
        read_alta(written(TEXT.replace(*change)))
    assert caught.value.line == line


def test_unit_mix(written: Write) -> None:
    with pytest.raises(TableError, match="header says PARAM_OUT 'INV_STERADIAN'"):
        read_alta(written(TEXT), param_out=TIMES_COS)


@settings(max_examples=150)
@given(at=st.integers(0, len(TEXT) - 1), change=st.binary(max_size=4), cut=st.booleans())
def test_damage_is_named(tmp_path_factory: pytest.TempPathFactory, at: int, change: bytes, cut: bool) -> None:
    whole = TEXT.encode()
    path = tmp_path_factory.getbasetemp() / "damaged.dat"
    path.write_bytes(whole[:at] + change + (b"" if cut else whole[at + 1 :]))
    try:
        said = read_alta(path).source
    except FitError as error:
        said = str(error)
    assert path.name in said
