"""Klems matrices: Radiance reads what is written, and what Radiance writes is read."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting import DomainError, FitError, TableError
from fitting.formats.grid import Brdf
from fitting.formats.klems import BASES, read_klems, write_klems
from tests.formats.radiance import ask_radiance

QUARTER = "LBNL/Klems Quarter"
Write = Callable[..., Path]


def lobes(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    """A floor, a mirror lobe and a stronger one back to the light."""
    i, r, p = map(np.radians, (theta_i, theta_r, phi))
    along, across = np.cos(i) * np.cos(r), np.sin(i) * np.sin(r) * np.cos(p)
    return 0.1 + 0.2 * np.maximum(along - across, 0) ** 6 + 0.5 * np.maximum(along + across, 0) ** 6


def forward(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    """What goes through, strongest straight on."""
    i, r, p = map(np.radians, (theta_i, theta_r, phi))
    return 0.05 + 0.2 * np.maximum(-np.cos(i) * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(p), 0) ** 5


def test_mean_over_patches_keeps_the_energy(tmp_path: Path) -> None:
    """Lambert and cos(theta_r) have means that are known: integrals over rings."""
    path = tmp_path / "petal.xml"
    write_klems(path, lambda theta_i, theta_r, phi: 0.5 * np.cos(np.radians(theta_r)) + 0 * (theta_i + phi), basis=QUARTER, samples=8)
    found = read_klems(path)
    assert len(found) == 41**2
    bounds = np.radians([low for low, _ in BASES[QUARTER]])
    rings = 0.5 * (2 / 3) * -np.diff(np.cos(bounds) ** 3) / np.diff(np.sin(bounds) ** 2)
    expected = np.repeat(rings, [count for _, count in BASES[QUARTER][:-1]])
    np.testing.assert_allclose(found.values.reshape(41, 41), np.broadcast_to(expected, (41, 41)), rtol=5e-3)


def test_own_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "petal.xml"
    write_klems(path, lobes, transmitted=forward, name="a <rose> & more")
    back = read_klems(path)
    assert len(back) == 145**2
    assert back.theta_i_deg.max() == back.theta_r_deg.max() == 82.5
    ratio = back.values[:, 0] / lobes(back.theta_i_deg, back.theta_r_deg, back.phi_r_deg - back.phi_i_deg)
    assert np.percentile(ratio, [5, 95]) == pytest.approx([1, 1], abs=0.15)
    through = read_klems(path, quantity="btdf")
    assert through.theta_r_deg.min() == 97.5
    ratio = through.values[:, 0] / forward(through.theta_i_deg, through.theta_r_deg, through.phi_r_deg - through.phi_i_deg)
    assert np.percentile(ratio, [5, 95]) == pytest.approx([1, 1], abs=0.15)
    with pytest.raises(TableError, match=r"no Reflection Front \(Visible\); there is Reflection Back \(Visible\)"):
        read_klems(path, side="back")


@pytest.mark.slow
def test_radiance_reads_it(tmp_path: Path) -> None:
    pytest.importorskip("pyradiance", reason="Radiance is not installed: pip install pyradiance")
    path = tmp_path / "petal.xml"
    write_klems(path, lobes, transmitted=forward)
    random = np.random.default_rng(3)
    light, view = (np.column_stack([np.degrees(np.arcsin(np.sqrt(random.random(400)))), 360 * random.random(400)]) for _ in range(2))
    theta_i, phi_i, theta_r, phi_r = np.column_stack([light, view]).T
    for function, polar in ((lobes, theta_r), (forward, 180 - theta_r)):
        found = ask_radiance(path, np.column_stack([theta_i, phi_i, polar, phi_r]))
        expected = function(theta_i, polar, phi_r - phi_i)
        assert np.corrcoef(found, expected)[0, 1] > 0.95
        assert np.median(found / expected) == pytest.approx(1, abs=0.02)
        assert np.mean(found) == pytest.approx(np.mean(expected), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("side", "flags"), [("front", ("-forward", "+backward")), ("back", ("+forward", "-backward"))])
def test_radiance_wrote_it(tmp_path: Path, side: Literal["front", "back"], flags: tuple[str, str]) -> None:
    """A function without any symmetry, of vectors that point away from the surface, in a file of Radiance's own."""
    radiance = pytest.importorskip("pyradiance", reason="Radiance is not installed: pip install pyradiance")
    program, path = Path(radiance.__file__).parent / "bin" / "bsdf2klems", tmp_path / "theirs.xml"
    function = "f(ix,iy,iz,ox,oy,oz)=1+.3*ix+.2*iy+.15*ox-.1*oy"
    made = subprocess.run([program, "-n", "16", *flags, "-e", function, "f"], capture_output=True, check=True, timeout=90)
    path.write_bytes(made.stdout)
    for quantity in ("brdf", "btdf"):
        found = read_klems(path, side=side, quantity=quantity)
        assert len(found) == 145**2
        assert found.theta_i_deg.max() == 82.5
        assert (found.theta_r_deg < 90).all() == (quantity == "brdf")
        i, r = np.radians(found.theta_i_deg), np.radians(found.theta_r_deg)
        turned = 1 if side == "front" else -1  # about the x axis
        light = [np.sin(i) * np.cos(np.radians(found.phi_i_deg)), turned * np.sin(i) * np.sin(np.radians(found.phi_i_deg))]
        view = [np.sin(r) * np.cos(np.radians(found.phi_r_deg)), turned * np.sin(r) * np.sin(np.radians(found.phi_r_deg))]
        expected = 1 + 0.3 * light[0] + 0.2 * light[1] + 0.15 * view[0] - 0.1 * view[1]
        np.testing.assert_allclose(found.values[:, 0], expected, atol=0.08)
        assert np.corrcoef(found.values[:, 0], expected)[0, 1] > 0.995


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of two rings and five patches, by hand; the number counts exiting patches in tens, incident in ones."""
    rings = "".join(
        f"<AngleBasisBlock><Theta>{(low + high) / 2}</Theta><nPhis>{count}</nPhis>"
        f"<ThetaBounds><LowerTheta>{low}</LowerTheta><UpperTheta>{high}</UpperTheta></ThetaBounds></AngleBasisBlock>\n"
        for low, high, count in ((0, 30, 1), (30, 90, 4))
    )
    rows = "\n".join(", ".join(f"{r}{i}" for i in range(5)) + "," for r in range(5))
    return f"""<?xml version="1.0"?>
<WindowElement xmlns="http://windows.lbl.gov"><Optical><Layer>
<DataDefinition>
<IncidentDataStructure>Columns</IncidentDataStructure>
<AngleBasis><AngleBasisName>five</AngleBasisName>
{rings}</AngleBasis></DataDefinition>
<WavelengthData><Wavelength unit="Integral">Visible</Wavelength><WavelengthDataBlock>
<WavelengthDataDirection>Reflection Back</WavelengthDataDirection>
<ColumnAngleBasis>five</ColumnAngleBasis><RowAngleBasis>five</RowAngleBasis>
<ScatteringDataType>BTDF</ScatteringDataType>
<ScatteringData>
{rows}
</ScatteringData></WavelengthDataBlock></WavelengthData></Layer></Optical></WindowElement>
"""


def test_order_of_the_numbers(tmp_path: Path, small: str) -> None:
    path = tmp_path / "five.xml"
    path.write_text(small)
    found = read_klems(path)
    columns = (found.theta_i_deg, found.phi_i_deg, found.theta_r_deg, found.phi_r_deg, found.values[:, 0])
    at = {row[:4]: row[4] for row in zip(*(column.tolist() for column in columns), strict=True)}
    assert len(at) == 25
    assert at[0, 180, 0, 0] == 0
    assert at[60, 180, 0, 0] == 1  # first incident patch of the outer ring: light that goes towards phi = 0
    assert at[60, 270, 0, 0] == 2
    assert at[0, 180, 60, 90] == 20  # second exiting patch
    path.write_text(small.replace("Columns", "Rows"))
    assert read_klems(path).values.reshape(5, 5)[2, 0] == 20


@pytest.mark.parametrize(
    ("old", "new", "line", "says"),
    [
        ("WindowElement", "Window", 2, "expected WindowElement"),
        ("Columns<", "TensorTree3<", 4, "bsdf2klems"),
        ("<nPhis>4<", "<nPhis>5<", 13, "holds 25 numbers, expected 36"),
        ("<nPhis>4<", "<nPhis>1e9<", 7, "1e\\+09 patches"),
        ("<LowerTheta>30<", "<LowerTheta>40<", 7, "expected to go on at 30"),
        ("<UpperTheta>90<", "<UpperTheta>80<", 5, "ends at 80"),
        ("RowAngleBasis>five", "RowAngleBasis>six", 11, "'six'"),
        ("BTDF", "BRF", 12, "in 1/sr"),
        ("23,", "nan,", 16, "'nan'"),
        ("23,", "-3,", 16, "'-3'"),
        ("23,", "", 13, "24 numbers, expected 25"),
        ("Reflection Back", "Reflection Front", 2, "no Reflection Back"),
        ("Visible", "Solar", 2, r"there is Reflection Back \(Solar\)"),
        ("<Optical>", "</Optical>", 2, "not whole XML"),
        ("<ScatteringDataType>BTDF</ScatteringDataType>", "", 9, "no ScatteringDataType"),
        ('<?xml version="1.0"?>', '<!DOCTYPE a [<!ENTITY b "c">]>', 1, "document type"),
    ],
)
def test_bad_file(tmp_path: Path, small: str, old: str, new: str, line: int, says: str) -> None:
    path = tmp_path / "five.xml"
    assert old in small
    text = small.replace(old, new)
    path.write_text(text)
    with pytest.raises(TableError, match=says) as caught:
        read_klems(path)
    assert caught.value.line == line


def test_bad_functions(tmp_path: Path) -> None:
    path = tmp_path / "petal.xml"
    with pytest.raises(DomainError, match="basis"):
        write_klems(path, lobes, basis="Tregenza")
    short = Brdf.sampled(lobes, [0, 45, 90], [0, 40, 80], np.arange(0, 360, 30))
    with pytest.raises(DomainError, match="outside the grid"):
        write_klems(path, short, basis=QUARTER)
    assert not list(tmp_path.iterdir())


@settings(max_examples=150)
@given(at=st.integers(0, 1600), change=st.binary(max_size=4), cut=st.booleans())
def test_damage_is_named(tmp_path_factory: pytest.TempPathFactory, small: str, at: int, change: bytes, cut: bool) -> None:
    whole = small.encode()
    at = min(at, len(whole) - 1)
    path = tmp_path_factory.getbasetemp() / "damaged.xml"
    path.write_bytes(whole[:at] + change + (b"" if cut else whole[at + 1 :]))
    try:
        said = read_klems(path).source
    except FitError as error:
        said = str(error)
    assert path.name in said
