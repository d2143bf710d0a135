"""Readings, their units, and the tables they are read from."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting import FitError, Measurements, ReadingError, TableError, read_csv

ROWS = "theta_i_deg,theta_r_deg,value\n45,-10,1.5\n45,0,1.25\n45,10,1\n45,20,0.5\n"


Write = Callable[[str], Path]


@pytest.fixture
def table(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "readings.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_plain_table(table: Write) -> None:
    found = read_csv(table("# a petal\n\n" + ROWS))
    np.testing.assert_array_equal(found.theta_i_deg, [45, 45, 45, 45])
    np.testing.assert_array_equal(found.theta_r_deg, [-10, 0, 10, 20])
    np.testing.assert_array_equal(found.value, [1.5, 1.25, 1, 0.5])
    np.testing.assert_array_equal(found.rows, [4, 5, 6, 7])
    assert (found.quantity, found.unit, found.sigma) == ("intensity", "relative", None)
    assert found.source.endswith("readings.csv")
    assert len(found) == 4


@pytest.mark.parametrize(
    ("header", "quantity"),
    [
        ("theta_i,theta_r,I", "intensity"),
        ("ThetaI [deg],theta_v_deg,BRF", "reflectance-factor"),
        ("incidence,theta,Reflectance", "reflectance-factor"),
        ("theta_i_deg,theta_r_deg,f_r_per_sr", "brdf"),
        ("theta_l,view angle (deg),BRDF [1/sr]", "brdf"),
    ],
)
def test_usual_names_are_understood(table: Write, header: str, quantity: str) -> None:
    found = read_csv(table(ROWS.replace("theta_i_deg,theta_r_deg,value", header)))
    assert found.quantity == quantity
    np.testing.assert_array_equal(found.theta_r_deg, [-10, 0, 10, 20])


def test_columns_constants_and_quantity_may_be_named(table: Write) -> None:
    path = table("angle,signal,noise\n-10,1,.1\n0,2,.1\n10,3,.1\n20,4,.2\n")
    columns: dict[str, str | float] = {"theta_i": 45.0, "theta_r": "angle", "value": "signal", "sigma": "noise"}
    found = read_csv(path, columns=columns, quantity="brdf", unit="1/sr, absolute")
    np.testing.assert_array_equal(found.theta_i_deg, [45] * 4)
    np.testing.assert_array_equal(found.sigma, [0.1, 0.1, 0.1, 0.2])
    assert (found.quantity, found.unit) == ("brdf", "1/sr, absolute")


def test_forward_positive_is_turned_round(table: Write) -> None:
    found = read_csv(table(ROWS), theta_r_positive="forward")
    np.testing.assert_array_equal(found.theta_r_deg, [10, 0, -10, -20])
    assert not np.signbit(found.theta_r_deg[1])
    with pytest.raises(FitError, match="'light' or 'forward'"):
        read_csv(table(ROWS), theta_r_positive="back")  # type: ignore[arg-type]


def test_rows_are_chosen_by_number_and_by_text(table: Write) -> None:
    head, *rows = ROWS.splitlines()
    lines = [head + ",wavelength_nm,petal"] + [f"{row},{w},{p}" for row in rows for w in ("550", "650.0") for p in ("RR", "rr")]
    path = table("\n".join(lines))
    found = read_csv(path, where={"wavelength_nm": 650, "petal": "RR"})
    np.testing.assert_array_equal(found.rows, [4, 8, 12, 16])
    assert len(read_csv(path, where={"wavelength_nm": "5.5e2"}, repeats="keep")) == 8
    with pytest.raises(TableError, match=r"no rows where wavelength_nm = 600, .*wavelength_nm takes 550, 650.0"):
        read_csv(path, where={"wavelength_nm": 600})
    with pytest.raises(TableError, match="no column 'nm' to choose rows by; there are theta_i_deg"):
        read_csv(path, where={"nm": 600})


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        (ROWS.replace("1.25", "nan"), 3, "value is nan, expected a finite number"),
        (ROWS.replace("1.25", "-inf"), 3, "finite"),
        (ROWS.replace("1.25", ""), 3, "value is '', expected a number"),
        (ROWS.replace("45,10", "45,ten"), 4, "theta_r_deg is 'ten', expected a number"),
        (ROWS.replace("45,10", "95,10"), 4, "theta_i is 95, expected 0 <= theta_i < 90"),
        (ROWS.replace("45,10", "-45,10"), 4, "theta_i is -45"),
        (ROWS.replace("45,10", "45,190"), 4, "theta_r is 190"),
        (ROWS.replace("1.25", "1.25,7"), 3, "4 cells, expected 3"),
        (ROWS.replace("value", "volts"), 1, "no column found for value; there are theta_i_deg, theta_r_deg, volts"),
        (ROWS.replace("theta_r_deg", "theta_r_rad"), 1, "theta_r_rad is in rad, expected deg"),
        (ROWS.replace("1.25", "1_2"), 3, "value is '1_2', expected a number"),
        (ROWS.replace("1.25", "\uff11"), 3, "value is '\uff11', expected a number"),
        (ROWS.replace("1.25", "12%"), 3, "name the unit in the header"),
        (ROWS.replace("1.25", "0"), 3, "reading is 0 and no sigma says that this is noise"),
        (ROWS.replace("1.25", "-1.25"), 3, "reading is -1.25 and no sigma"),
        (ROWS.replace("45,10,1", "45,-10,1.25"), 4, "the same angles as in line 2"),
        (ROWS[:-6], 5, "2 cells, expected 3; the file ends within this line"),
        (ROWS.replace(",", ";"), 1, "separated by ';', expected commas"),
        (ROWS.partition("\n")[2], 1, "the first line holds numbers, expected names"),
        (ROWS + "45,30,1\0", 6, f"is not text: byte 0x00 at offset {len(ROWS) + 7}"),
        (ROWS + "#" * (1 << 16), 6, f"the line from offset {len(ROWS)} on is longer"),
        ("theta_v," + ROWS, 1, "theta_r may be any of theta_v, theta_r_deg: say which with columns"),
        (ROWS.replace("theta_i_deg", "value"), 1, "value appears twice"),
        (ROWS.splitlines()[0], None, "no rows, expected at least 1"),
        ("# nothing\n", None, "no header line"),
        (ROWS.replace("1.25", '"1.25'), 5, "not a comma-separated table"),
    ],
)
def test_tables_that_cannot_be_used(table: Write, text: str, line: int | None, message: str) -> None:
    path = table(text)
    with pytest.raises(TableError, match=message) as caught:
        read_csv(path)
    assert (caught.value.path, caught.value.line) == (path, line)
    assert str(caught.value).startswith(f"{path}, line {line}: " if line else f"{path}: ")


def test_line_numbers_count_comments(table: Write) -> None:
    with pytest.raises(TableError, match="line 5"):
        read_csv(table("# one\n" + ROWS.replace("45,0,", "# two\n45,0,").replace("1.25", "x")))


def test_rows_not_chosen_are_not_judged(table: Write) -> None:
    head, *rows = ROWS.splitlines()
    path = table("\n".join([f"{head},run", *(f"{row},1" for row in rows), "45,30,bad,2"]))
    assert len(read_csv(path, where={"run": 1})) == 4
    with pytest.raises(TableError, match="line 6: value is 'bad'"):
        read_csv(path)


def test_columns_that_are_not_there(table: Write) -> None:
    with pytest.raises(TableError, match="no column 'volts' for value; there are"):
        read_csv(table(ROWS), columns={"value": "volts"})
    with pytest.raises(TableError, match="no such role: angle"):
        read_csv(table(ROWS), columns={"angle": "theta_r_deg"})


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(TableError, match=r"missing\.csv: cannot be read"):
        read_csv(tmp_path / "missing.csv")
    (tmp_path / "latin.csv").write_bytes(ROWS.encode() + b"\xe9\n")
    with pytest.raises(TableError, match=f"line 6: is not UTF-8 text: byte 0xe9 at offset {len(ROWS)}"):
        read_csv(tmp_path / "latin.csv")
    (tmp_path / "excel.csv").write_bytes(ROWS.replace("\n", "\r").encode("utf-8-sig"))
    assert read_csv(tmp_path / "excel.csv").rows.tolist() == [2, 3, 4, 5]
    (tmp_path / "excel.csv").write_bytes(ROWS.encode("utf-16"))
    with pytest.raises(TableError, match="line 1: is not UTF-8 text: byte 0xff at offset 0"):
        read_csv(tmp_path / "excel.csv")


def test_quotes_in_a_comment_mean_nothing(table: Write) -> None:
    assert len(read_csv(table('# petal,"a\n' + ROWS))) == 4


number = st.floats(0, exclude_min=True, allow_infinity=False)


@given(
    readings=st.lists(
        st.tuples(st.floats(0, 89.9), st.floats(-180, 180), number, st.floats(0, 1e300)), min_size=4, max_size=20, unique_by=lambda r: r[:2]
    ),
    order=st.permutations(["theta_i", "theta_r", "value", "sigma"]),
)
def test_every_reading_comes_back(tmp_path_factory: pytest.TempPathFactory, readings: list[tuple[float, ...]], order: list[str]) -> None:
    named = [dict(zip(("theta_i", "theta_r", "value", "sigma"), r, strict=True)) for r in readings]
    path = tmp_path_factory.getbasetemp() / "back.csv"
    path.write_text("\n".join([",".join(order)] + [",".join(repr(r[name]) for name in order) for r in named]))
    found = read_csv(path, repeats="keep")
    for name, column in (("theta_i", found.theta_i_deg), ("theta_r", found.theta_r_deg), ("value", found.value), ("sigma", found.sigma)):
        np.testing.assert_array_equal(column, [r[name] for r in named])


FULL = """# a rose
theta_i,theta_r,phi_i,phi_r,brf [%],sigma,unit
deg,deg,deg,deg,%,%,
45,-10,0,0,150,1,%
45,20,90,270,125,2,%
45,30,0,90,100,2,%
30,20,0,-45,5e1,.5,%
"""


@settings(max_examples=300)
@given(data=st.data(), cut=st.booleans(), covariance=st.booleans(), repeats=st.sampled_from(["refuse", "keep", "mean"]))
def test_damage_is_named(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, cut: bool, covariance: bool, repeats: Literal["refuse", "keep", "mean"]
) -> None:
    """Whatever happens to a table, it is read or the error names the file: and a line, unless it is about the whole."""
    path, other = (tmp_path_factory.getbasetemp() / name for name in ("damaged.csv", "covariance.csv"))
    matrix = "\n".join(",".join("1" if i == j else ".5" for i in range(4)) for j in range(4)).replace("1,.5,.5,.5", "1,.5,.5,.5\n#")
    whole = (matrix if covariance else FULL).encode()
    at = data.draw(st.integers(0, len(whole) - 1))
    noise = st.binary(max_size=4) | st.text(',0123456789.-e%\n"', max_size=6).map(str.encode)
    broken = whole[:at] + data.draw(noise) + (b"" if cut else whole[at + data.draw(st.integers(0, 2)) :])
    path.write_bytes(FULL.replace(",sigma", ",other").encode() if covariance else broken)
    other.write_bytes(broken if covariance else matrix.encode())
    try:
        found = read_csv(path, repeats=repeats, covariance=other if covariance else None)
    except TableError as error:
        said = error
    else:
        for column in (found.theta_i_deg, found.theta_r_deg, found.phi_deg, found.value):
            assert np.isfinite(column).all()
        assert np.all(found.value > (0 if found.sigma is None else -5 * found.sigma))
        return
    assert said.path in (path, other)
    assert said.line is not None or re.search(r"no header line|rows, expected", said.problem)


def test_units_are_understood_wherever_they_stand(table: Write) -> None:
    found = read_csv(table(FULL))
    np.testing.assert_allclose(found.value, [1.5, 1.25, 1, 0.5], rtol=1e-15)
    np.testing.assert_allclose(found.sigma, [0.01, 0.02, 0.02, 0.005], rtol=1e-15)  # type: ignore[arg-type]
    np.testing.assert_array_equal(found.rows, [4, 5, 6, 7])
    assert (found.quantity, found.unit) == ("reflectance-factor", "1, from %")
    for head in ("theta_i,theta_r,I [nA]", "theta_i,theta_r,I\ndeg,deg,nA"):
        assert read_csv(table(ROWS.replace("theta_i_deg,theta_r_deg,value", head))).unit == "nA"
    with_unit = "\n".join(f"{row},{'unit' if k == 0 else 'mV'}" for k, row in enumerate(ROWS.splitlines()))
    assert read_csv(table(with_unit)).unit == "mV"
    percent = read_csv(table(ROWS.replace("value", "signal")), columns={"value": "signal"}, quantity="reflectance-factor", unit="%")
    np.testing.assert_array_equal(percent.value, np.array([1.5, 1.25, 1, 0.5]) / 100)


@pytest.mark.parametrize("name", ["BRF%", "brf [%]", "brf (%)", "brf_percent", "Reflectance [percent]", "rho_pct"])
def test_percent(table: Write, name: str) -> None:
    found = read_csv(table(ROWS.replace("value", name)))
    np.testing.assert_array_equal(found.value, np.array([1.5, 1.25, 1, 0.5]) / 100)
    assert found.unit == "1, from %"


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        (ROWS.replace("value", "brf_per_sr"), 1, "is in 1/sr, but by its name it is reflectance-factor, whose unit is 1 or %"),
        (ROWS.replace("value", "brdf [%]"), 1, "is in %, but by its name it is brdf, whose unit is 1/sr"),
        (ROWS.replace("value", "brdf [1]"), 1, "is in 1, but by its name it is brdf"),
        (ROWS.replace("value", "brdf [nA]"), 1, "is in nA, but"),
        (ROWS.replace("value", "value_per_sr"), 1, "is in 1/sr, but by its name it is intensity"),
        (ROWS.replace("value", "brdf_per_sr [%]"), 1, "said to be in 1/sr and in %"),
        (ROWS.replace("value", "brf\ndeg,deg,1/sr"), 2, "brf is in 1/sr, but"),
        (ROWS.replace("value", "brf [%]\ndeg,deg,1"), 2, "said to be in % and in 1"),
        (ROWS.replace("value", "value\n,deg,1"), 2, "theta_i_deg is '', expected a number"),
        (ROWS.replace("theta_r_deg,value", "theta_r,value\ndeg,rad,1"), 2, "theta_r is in rad, expected deg"),
        (FULL.replace("sigma", "sigma [1]"), 3, r"sigma \[1\] is said to be in 1 and in %"),
        (FULL.replace("%,%,", "%,1,"), 3, "sigma is in 1, but the values are in %"),
        (FULL.replace("100,2,%", "100,2,1/sr"), 6, "unit is '1/sr', but '%' in line 4"),
        (FULL.replace("deg,%", "deg,").replace("brf [%]", "brf").replace(",%\n", ",\n"), 3, "sigma is in %, but the values are in 1"),
        (FULL.replace(",%\n", ",1/sr\n"), 4, r"brf \[%\] is said to be in % and in 1/sr"),
        (FULL.replace("phi_i", "psi"), 2, "phi_r is an azimuth without its phi_i: give that with columns, or phi=0"),
        (FULL.replace("unit", "phi"), 2, "the azimuth may be phi, or that from phi_i to phi_r"),
        (FULL.replace("45,20,90", "45,-20,90").replace("270", "180"), 5, "theta_r is -20, expected 0 or more where phi is not 0"),
        (FULL.replace("-45", "-450"), 7, "phi_r is -450, expected -360"),
        (FULL.replace("45,30,0,90", "45,20,-10,170"), 6, "the same angles as in line 5"),
        (FULL.replace("100,2", "-10,2"), 6, "reading is -0.1 and its sigma is 0.02"),
    ],
)
def test_contradictions(table: Write, text: str, line: int, message: str) -> None:
    path = table(text)
    with pytest.raises(TableError, match=message) as caught:
        read_csv(path)
    assert (caught.value.path, caught.value.line) == (path, line)


def test_the_quantity_that_was_asked_for_settles_a_contradiction(table: Write) -> None:
    assert read_csv(table(ROWS.replace("value", "brf_per_sr")), quantity="brdf").unit == "1/sr"
    with pytest.raises(TableError, match="as asked it is intensity"):
        read_csv(table(ROWS.replace("value", "brf_per_sr")), quantity="intensity")
    with pytest.raises(TableError, match="said to be in % and in 1"):
        read_csv(table(ROWS.replace("value", "brf [%]")), unit="1")
    with pytest.raises(FitError, match="unknown quantity 'lumen'"):
        read_csv(table(ROWS), quantity="lumen")  # type: ignore[arg-type]


def test_noise_below_zero_is_kept(table: Write) -> None:
    found = read_csv(table(FULL.replace("100,2", "-9.9,2").replace("5e1", "0")))
    np.testing.assert_allclose(found.value[2:], [-0.099, 0], rtol=1e-15)


def test_azimuths(table: Write) -> None:
    found = read_csv(table(FULL))
    np.testing.assert_array_equal(found.theta_r_deg, [-10, -20, 30, 20])
    np.testing.assert_array_equal(found.phi_deg, [0, 0, 90, -45])
    np.testing.assert_array_equal(found.in_plane, [True, True, False, False])
    turned = read_csv(table(FULL), theta_r_positive="forward")
    np.testing.assert_array_equal(turned.theta_r_deg, [10, 20, 30, 20])
    np.testing.assert_array_equal(turned.phi_deg, [0, 0, -90, 135])
    named = read_csv(table(FULL), columns={"phi": "phi_r"})  # phi_i is of something else then
    np.testing.assert_array_equal(named.phi_deg, [0, -90, 90, -45])
    np.testing.assert_array_equal(read_csv(table(FULL), columns={"phi_i": "0"}).phi_deg, named.phi_deg)
    flat = table(FULL.replace("270", "180").replace("phi_i", "psi"))
    np.testing.assert_array_equal(read_csv(flat, columns={"phi": 0.0}).theta_r_deg, [-10, 20, 30, 20])
    with pytest.raises(TableError, match="not for both"):
        read_csv(flat, columns={"phi": 0.0, "phi_r": "phi_r"})


@given(st.lists(st.tuples(st.floats(0, 89), st.floats(0, 179), st.floats(-360, 360), st.floats(-360, 360)), min_size=4, max_size=9))
def test_directions_are_those_of_the_table(tmp_path_factory: pytest.TempPathFactory, angles: list[tuple[float, ...]]) -> None:
    path = tmp_path_factory.getbasetemp() / "directions.csv"
    path.write_text("theta_i,theta_r,phi_i,phi_r,value\n" + "".join(",".join(map(repr, a)) + ",1\n" for a in angles))
    _, theta_r, phi_i, phi_r = np.radians(angles).T
    for side, sign in (("light", 1), ("forward", -1)):
        found = read_csv(path, repeats="keep", theta_r_positive=side)  # type: ignore[arg-type]
        theta, phi = np.radians([found.theta_r_deg, found.phi_deg])
        np.testing.assert_allclose(np.sin(theta) * np.exp(1j * phi), sign * np.sin(theta_r) * np.exp(1j * (phi_r - phi_i)), atol=1e-7)
        np.testing.assert_allclose(np.cos(theta), np.cos(theta_r), atol=1e-12)
        assert np.all((found.phi_deg == 0) | (found.theta_r_deg > 0))


TWICE = "theta_i,theta_r,phi,value\n45,30,0,1\n45,-10,0,2\n45,10,180,4\n45,30,0,3\n45,20,0,5\n45,0,0,6\n45,0,90,6\n45,20,0,5.5\n"


def test_repeats(table: Write) -> None:
    with pytest.raises(TableError, match="line 4: the same angles as in line 3"):
        read_csv(table(TWICE))
    with pytest.raises(FitError, match="'refuse', 'keep' or 'mean'"):
        read_csv(table(TWICE), repeats="median")  # type: ignore[arg-type]
    assert len(read_csv(table(TWICE), repeats="keep")) == 8
    mean = read_csv(table(TWICE), repeats="mean")
    np.testing.assert_array_equal(mean.rows, [2, 3, 6, 7])
    np.testing.assert_array_equal(mean.theta_r_deg, [30, -10, 20, 0])
    np.testing.assert_array_equal(mean.value, [2, 3, 5.25, 6])
    assert mean.sigma is not None
    np.testing.assert_allclose(mean.sigma, [1, 1, 0.25, 0])
    once = read_csv(table(TWICE + "45,40,0,1\n"), repeats="mean")
    assert len(once) == 5
    assert once.sigma is None  # nothing tells the noise of what was read once
    assert len(read_csv(table(TWICE.replace("45,0,0,6\n45,0,90,6\n", "")), repeats="mean")) == 3


def test_means_carry_the_uncertainty_of_the_table(table: Write, tmp_path: Path) -> None:
    lines = TWICE.splitlines()
    own = "\n".join([lines[0] + ",sigma", *(f"{line},{k}" for k, line in enumerate(lines[1:], 1))])
    mean = read_csv(table(own), repeats="mean")
    np.testing.assert_allclose(mean.sigma, np.sqrt([1 + 16, 4 + 9, 25 + 64, 36 + 49]) / 2)  # type: ignore[arg-type]
    noise = np.diag(np.arange(1.0, 9) ** 2) + 0.5
    np.savetxt(tmp_path / "noise.csv", noise, delimiter=",", fmt="%.17g", header="of the readings")
    mean = read_csv(table(TWICE), repeats="mean", covariance=tmp_path / "noise.csv")
    average = np.zeros((4, 8))
    average[[0, 0, 1, 1, 2, 2, 3, 3], [0, 3, 1, 2, 4, 7, 5, 6]] = 0.5
    np.testing.assert_allclose(mean.covariance, average @ noise @ average.T)  # type: ignore[arg-type]


def test_a_covariance_in_a_file_of_its_own(table: Write, tmp_path: Path) -> None:
    root = np.random.default_rng(3).normal(size=(4, 4))
    noise = root @ root.T
    path = tmp_path / "noise.csv"
    np.savetxt(path, noise, delimiter=",", fmt="%.17g")
    whole = FULL.replace(",sigma", ",other")
    found = read_csv(table(whole), covariance=path)
    np.testing.assert_allclose(found.covariance, noise / 1e4, rtol=1e-14)  # type: ignore[arg-type]
    more = whole + "".join(f"50,{k},0,0,9,1,%\n" for k in range(4))
    np.savetxt(path, np.block([[noise, np.zeros((4, 4))], [np.zeros((4, 4)), np.eye(4)]])[::-1, ::-1], delimiter=",", fmt="%.17g")
    cut = read_csv(table(more), covariance=path, where={"theta_i": 50})
    np.testing.assert_allclose(cut.covariance, noise[::-1, ::-1] / 1e4, rtol=1e-14)  # type: ignore[arg-type]
    np.testing.assert_allclose(cut.sigma, np.sqrt(np.diag(noise)[::-1]) / 100, rtol=1e-14)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("1,0,0,0\n0,1,0,0\n0,0,1,0\n", None, r"noise.csv: 3 rows, expected 4, one for each row of .*readings.csv"),
        ("1,0,0,0\n0,1,0\n", 2, "noise.csv, line 2: 3 cells, expected 4$"),
        ("1,0,0,0\n0,1,0", 2, "noise.csv, line 2: 3 cells, expected 4; the file ends within"),
        ("1,0,x,0\n", 1, "noise.csv, line 1: column 3 is 'x', expected a number"),
        ("1,0,0,0\n0,1,0,0\n0,.1,1,0\n0,0,0,1", 3, "readings.csv, line 3: its covariance with row 4 is not finite or not symmetric"),
        ("1,0,0,0\n0,-1,0,0\n0,0,1,0\n0,0,0,1", 3, "readings.csv, line 3: variance is -1, expected"),
    ],
)
def test_a_covariance_that_cannot_be_used(table: Write, tmp_path: Path, text: str, line: int | None, message: str) -> None:
    (tmp_path / "noise.csv").write_text(text)
    with pytest.raises(TableError, match=message) as caught:
        read_csv(table(ROWS), covariance=tmp_path / "noise.csv")
    assert caught.value.line == line


def some(**change: Any) -> Measurements:
    shared: dict[str, Any] = {"theta_i_deg": [45.0, 15.2, 45.3, 15], "theta_r_deg": [10.0, 20, 30, 0], "value": [1.0, 2, 3, 4]}
    return Measurements(**shared | change)


def test_each_direction_has_one_name() -> None:
    assert some().in_plane.all()
    found = some(phi_deg=[180, -180 + 1e-9, 60, 33])
    np.testing.assert_array_equal(found.theta_r_deg, [-10, -20, 30, 0])
    np.testing.assert_array_equal(found.phi_deg, [0, 0, 60, 0])  # along the normal there is no azimuth
    np.testing.assert_array_equal(found.in_plane, [True, True, False, True])
    behind = some(theta_r_deg=[180, -180, 180, 0], phi_deg=[180, 90, 90, 0])
    np.testing.assert_array_equal(behind.theta_r_deg, [180, -180, 180, 0])
    assert behind.in_plane.all()  # nor is there straight behind
    with pytest.raises(ReadingError, match="row 2: phi is 181"):
        some(phi_deg=[0, 181, 0, 0])
    with pytest.raises(ReadingError, match="row 2: theta_r is -20, expected 0 or more where phi is not 0"):
        some(theta_r_deg=[10, -20, 30, 0], phi_deg=[0, 180, 0, 0])
    with pytest.raises(FitError, match="phi_deg has 1 entries, expected 4"):
        some(phi_deg=[0])


def test_covariance_and_sigma_are_one() -> None:
    noise = np.diag([1.0, 4, 9, 16]) + 0.5
    found = some(covariance=noise, quantity="brdf")
    np.testing.assert_allclose(found.sigma, np.sqrt([1.5, 4.5, 9.5, 16.5]))  # type: ignore[arg-type]
    scale = math.pi * np.cos(np.radians([45, 15.2, 45.3, 15]))
    np.testing.assert_allclose(found.intensity_covariance, noise * np.outer(scale, scale))  # type: ignore[arg-type]
    np.testing.assert_allclose(found.intensity_covariance.diagonal(), found.intensity_sigma**2)  # type: ignore[union-attr, operator]
    assert some().intensity_covariance is None
    alone = some(sigma=[1.0, 2, 3, 4], quantity="brdf").intensity_covariance
    np.testing.assert_allclose(alone, np.diag((np.arange(1, 5) * scale) ** 2))  # type: ignore[arg-type]
    near = np.sqrt(noise.diagonal()) * (1 + 5e-7)
    np.testing.assert_array_equal(some(covariance=noise, sigma=near).sigma, found.sigma)
    with pytest.raises(ReadingError, match=r"row 3: sigma is 3\.1, expected the root of its variance"):
        some(covariance=noise, sigma=[*near[:2], 3.1, near[3]])
    with pytest.raises(FitError, match=r"covariance has shape \(3, 3\), expected \(4, 4\)"):
        some(covariance=np.eye(3))
    with pytest.raises(FitError, match="covariance must be one matrix"):
        some(covariance=np.ones(4))
    for broken in (math.nan, 7.0):
        noise[1, 2] = broken
        with pytest.raises(ReadingError, match="row 2: its covariance with row 3 is not finite or not symmetric"):
            some(covariance=noise)


def test_taking_some_of_the_readings() -> None:
    noise = np.diag([1.0, 4, 9, 16]) + 0.5
    found = some(phi_deg=[0, 0, 60, 0], covariance=noise, rows=[7, 8, 9, 11], unit="nA", source="bench")
    for kept in ([2, 0], np.array([2, 0])):
        part = found.take(kept)
        np.testing.assert_array_equal(part.value, [3, 1])
        np.testing.assert_array_equal(part.rows, [9, 7])
        np.testing.assert_array_equal(part.phi_deg, [60, 0])
        np.testing.assert_array_equal(part.covariance, [[9.5, 0.5], [0.5, 1.5]])
        assert (part.unit, part.source) == ("nA", "bench")
    np.testing.assert_array_equal(found.take(found.in_plane).rows, [7, 8, 11])
    np.testing.assert_array_equal(some(sigma=[1, 2, 3, 4]).take(np.array([False, True, False, True])).sigma, [2, 4])
    assert len(found.take(np.zeros(4, bool))) == 0
    for wrong in ([4], [True], [0.5]):
        with pytest.raises(FitError, match="bench: of 4 readings those cannot be taken"):
            found.take(wrong)


def test_readbacks_of_one_incidence_are_one() -> None:
    found = some()
    np.testing.assert_array_equal(found.incidences, [15.1, 45.15])
    np.testing.assert_array_equal(found.incidence_of, [1, 0, 1, 0])
    apart = some(theta_i_deg=[10.0, 10.4, 10.8, 10.5])  # a chain is not one incidence
    np.testing.assert_array_equal(apart.incidences, [10.3, 10.8])
    np.testing.assert_array_equal(apart.incidence_of, [0, 0, 1, 0])


@given(st.lists(st.floats(0, 89), min_size=1, max_size=30))
def test_incidences_cover_the_readings(theta_i: list[float]) -> None:
    found = Measurements(np.array(theta_i), np.zeros(len(theta_i)), np.ones(len(theta_i)))
    assert np.all(np.abs(found.incidences[found.incidence_of] - theta_i) <= 0.5005)
    assert np.all(np.diff(found.incidences) >= 0)
    assert set(found.incidence_of.tolist()) == set(range(found.incidences.size))


def test_quantities_share_one_scale() -> None:
    theta_i = np.array([0.0, 30, 60, 75])
    f_r = np.array([0.2, 0.3, 0.1, 0.4])
    shared: dict[str, Any] = {"theta_i_deg": theta_i, "theta_r_deg": np.zeros(4)}
    brdf = Measurements(value=f_r, sigma=f_r / 10, quantity="brdf", **shared)
    factor = Measurements(value=math.pi * f_r, sigma=math.pi * f_r / 10, quantity="reflectance-factor", **shared)
    np.testing.assert_allclose(brdf.intensity, factor.intensity, rtol=1e-14)
    np.testing.assert_allclose(brdf.intensity, math.pi * f_r * np.cos(np.radians(theta_i)), rtol=1e-14)
    assert factor.intensity_sigma is not None
    np.testing.assert_allclose(factor.intensity_sigma, brdf.intensity / 10, rtol=1e-14)
    np.testing.assert_array_equal(Measurements(value=f_r, **shared).intensity, f_r)
    assert (brdf.unit, factor.unit) == ("1/sr", "1")


def good() -> dict[str, Any]:
    return {"theta_i_deg": [45.0] * 3, "theta_r_deg": [0.0, 1, 2], "value": [1.0, 2, 3], "source": "bench", "rows": [11, 12, 13]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"value": [1.0, math.nan, 3]}, "bench, row 12: value is nan"),
        ({"theta_i_deg": [45, 90, 45]}, "bench, row 12: theta_i is 90"),
        ({"theta_r_deg": [0, 0, -181]}, "bench, row 13: theta_r is -181"),
        ({"sigma": [0.1, 0.1, -0.1]}, "bench, row 13: sigma is -0.1"),
        ({"sigma": [0.1]}, "bench: sigma has 1 entries, expected 3"),
        ({"value": [1.0, 2]}, "bench: value has 2 entries, expected 3"),
        ({"rows": [1, 2]}, "theta_i_deg has 3 entries, expected 2"),
        ({"value": [[1.0, 2, 3]]}, "value must be one column"),
        ({"value": ["a", "b", "c"]}, "value must be numbers"),
        ({"quantity": "lumen"}, "unknown quantity 'lumen'"),
    ],
)
def test_readings_are_checked(change: dict[str, Any], message: str) -> None:
    with pytest.raises(FitError, match=message):
        Measurements(**good() | change)


def test_reading_errors_carry_their_row() -> None:
    with pytest.raises(ReadingError) as caught:
        Measurements(**good() | {"value": [1, 2, math.inf]})
    assert (caught.value.source, caught.value.row) == ("bench", 13)


def test_readings_are_copied_and_frozen() -> None:
    value = np.array([1.0, 2, 3])
    found = Measurements(**good() | {"value": value})
    value[0] = 7
    assert found.value[0] == 1
    with pytest.raises(ValueError, match="read-only"):
        found.value[0] = 7
