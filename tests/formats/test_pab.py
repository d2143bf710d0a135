"""pab text: what is written is read back, here and by Radiance; what is damaged is refused by name."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting import DomainError, FitError, TableError
from fitting.formats.grid import Brdf, Scattered
from fitting.formats.pab import read_pab, write_pab
from tests.formats.radiance import ask_radiance

TEXT = """#sample_name "rose"
#incident_angle 30 10
#intheta 30
#upphi 90
#colorimetry: CIE-Y
#datapoints_in_file: 3
#format: theta phi BRDF
10 0 0.5
20 90 0.25
80 180 1e-3
"""

Write = Callable[..., Path]


@pytest.fixture
def written(tmp_path: Path) -> Write:
    def write(text: str, name: str = "petal.txt") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def lobes(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    """A floor, a mirror lobe and a stronger one back to the light."""
    i, r, p = map(np.radians, (theta_i, theta_r, phi))
    along, across = np.cos(i) * np.cos(r), np.sin(i) * np.sin(r) * np.cos(p)
    return 0.1 + 0.2 * np.maximum(along - across, 0) ** 8 + 0.5 * np.maximum(along + across, 0) ** 8


def test_hand_made_file(written: Write) -> None:
    found = read_pab(written(TEXT))
    np.testing.assert_array_equal(found.theta_i_deg, [30, 30, 30])
    np.testing.assert_array_equal(found.phi_i_deg, [10, 10, 10])
    np.testing.assert_array_equal(found.theta_r_deg, [10, 20, 80])
    np.testing.assert_array_equal(found.phi_r_deg, [0, 90, 180])
    np.testing.assert_array_equal(found.values, [[0.5], [0.25], [1e-3]])
    assert (found.quantity, found.channels) == ("brdf", ("value",))
    assert found.metadata["sample_name"] == "rose"
    assert found.metadata["up_phi"] == 90


def test_dsf_is_divided_by_the_cosine(written: Write) -> None:
    found = read_pab(written(TEXT.replace("BRDF", "DSF")))
    np.testing.assert_allclose(found.values[:, 0], [0.5, 0.25, 1e-3] / np.cos(np.radians([10, 20, 80])), rtol=1e-14)


def test_light_from_behind_is_turned_over(written: Write) -> None:
    found = read_pab(written(TEXT.replace("#incident_angle 30 10", "#incident_angle 150 10").replace("#intheta 30\n", "")))
    np.testing.assert_array_equal(found.theta_i_deg, [30, 30, 30])
    np.testing.assert_array_equal(found.phi_i_deg, [-10, -10, -10])
    np.testing.assert_array_equal(found.theta_r_deg, [170, 160, 100])
    assert found.quantity == "btdf"


def test_colour_and_several_incidences(tmp_path: Path) -> None:
    values = np.random.default_rng(5).random((2, 3, 4, 3))
    grid = Brdf(np.array([0.0, 32.5]), None, np.array([0.0, 30, 60]), np.array([0.0, 90, 180, 270]), values, channels=("X", "Y", "Z"))
    files = write_pab(tmp_path / "petal.txt", grid, name='a "red" one')
    assert [file.name for file in files] == ["petal_t000p000.txt", "petal_t032.500p000.txt"]
    back = read_pab(files)
    np.testing.assert_array_equal(back.values, values.reshape(-1, 3))
    np.testing.assert_array_equal(back.theta_i_deg, np.repeat([0, 32.5], 12))
    assert back.channels == ("X", "Y", "Z")
    assert back.metadata["sample_name"] == "a 'red' one"


def test_transmission_comes_back_as_it_was(tmp_path: Path) -> None:
    data = Scattered(
        np.full(3, 20.0), np.full(3, 45.0), np.array([100.0, 120, 180]), np.array([1.0, 2, 3]), np.array([[1.0], [2], [3]]), quantity="btdf"
    )
    (file,) = write_pab(tmp_path / "leaf.txt", data)
    assert file.name == "leaf.txt"
    back = read_pab(file)
    assert back.quantity == "btdf"
    for name in ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", "values"):
        np.testing.assert_array_equal(getattr(back, name), getattr(data, name))


@pytest.mark.slow
def test_radiance_reads_it(tmp_path: Path) -> None:
    radiance = pytest.importorskip("pyradiance", reason="Radiance is not installed: pip install pyradiance")
    programs = Path(radiance.__file__).parent / "bin"
    files = write_pab(tmp_path / "petal.txt", lobes)
    fitted, tree = tmp_path / "petal.sir", tmp_path / "petal.xml"
    fitted.write_bytes(subprocess.run([programs / "pabopto2bsdf", *files], capture_output=True, check=True, timeout=90).stdout)
    made = subprocess.run([programs / "bsdf2ttree", "-t", "90", "-g", "5", fitted], capture_output=True, check=True, timeout=90)
    tree.write_bytes(made.stdout)
    views = [(40, 0), (40, 180), (20, 60), (60, 0), (10, 90), (0, 0), (50, 150)]
    found = ask_radiance(tree, [(40, 0, theta_r, phi) for theta_r, phi in views])
    expected = np.array([lobes(40, theta_r, phi) for theta_r, phi in views])
    assert found[0] > 1.4 * found[1]  # back to the light is stronger than the mirror direction
    np.testing.assert_allclose(found, expected, rtol=0.4)  # Radiance fits lobes to the readings
    assert np.median(found / expected) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(
    ("change", "line", "says"),
    [
        (("20 90 0.25", "20 90"), 9, "2 numbers, expected 3: theta, phi, value"),
        (("20 90 0.25", "20 90 0.25 1"), 9, "4 numbers, expected 3"),
        (("0.25", "nan"), 9, "value is 'nan'"),
        (("0.25", "O.25"), 9, "value is 'O.25'"),
        (("20 90", "10 0"), 9, "same angles as in line 8"),
        (("80 180", "100 180"), 10, "other side"),
        (("80 180", "181 180"), 10, "0 to 180"),
        (("80 180 1e-3\n", ""), 9, "header says 3"),
        (("#format: theta phi BRDF\n", ""), 7, "#format"),
        (("theta phi BRDF", "phi theta BRDF"), 7, "expected theta phi"),
        (("theta phi BRDF", "theta phi BRF"), 7, "one of BRDF"),
        (("CIE-Y", "CIE-Lab"), 5, "CIE-LAB"),
        (("CIE-Y", "CIE-XYZ"), 8, "expected 5"),
        (("#intheta 30", "#intheta 31"), 3, "was 30 deg"),
        (("#incident_angle 30 10\n", ""), 7, "incidence"),
        (("20 90 0.25", "#inphi 3"), 9, "header line among the numbers"),
        (("30 10", "30"), 2, "expected 2"),
    ],
)
def test_bad_file(written: Write, change: tuple[str, str], line: int, says: str) -> None:
    with pytest.raises(TableError, match=says) as caught:
        read_pab(written(TEXT.replace(*change)))
    assert caught.value.line == line


def test_foreign_files(tmp_path: Path, written: Write) -> None:
    binary = tmp_path / "binary"
    binary.write_bytes(bytes(range(256)) * 300)
    empty = written("", "empty")
    for path in (binary, empty, tmp_path / "nowhere", tmp_path):
        with pytest.raises(TableError):
            read_pab(path)
    with pytest.raises(TableError, match="same incidence"):
        read_pab([written(TEXT), written(TEXT, "again.txt")])
    with pytest.raises(TableError, match="btdf of value"):
        read_pab([written(TEXT), written(TEXT.replace("30", "150"), "behind.txt")])
    with pytest.raises(DomainError):
        read_pab([])


def test_nothing_is_left_of_a_failed_write(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="cannot be written"):
        write_pab(tmp_path / "nowhere" / "petal.txt", lobes)
    with pytest.raises(DomainError):
        write_pab(tmp_path / "petal.txt", lambda theta_i, theta_r, phi: np.nan * (theta_i + theta_r + phi))
    assert not list(tmp_path.iterdir())


@settings(max_examples=150)
@given(at=st.integers(0, len(TEXT) - 1), change=st.binary(max_size=4), cut=st.booleans())
def test_damage_is_named(tmp_path_factory: pytest.TempPathFactory, at: int, change: bytes, cut: bool) -> None:
    whole = TEXT.encode()
    path = tmp_path_factory.getbasetemp() / "damaged_pab.txt"
    path.write_bytes(whole[:at] + change + (b"" if cut else whole[at + 1 :]))
    try:
        said = read_pab(path).source
    except FitError as error:
        said = str(error)
    assert path.name in said
