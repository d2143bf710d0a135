"""Readings, their units, and the tables they are read from."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
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
    assert len(read_csv(path, where={"wavelength_nm": "5.5e2"})) == 8
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
        (ROWS.replace("theta_r_deg", "theta_r_rad"), 1, "no column found for theta_r"),
        ("theta_v," + ROWS, 1, "theta_r may be any of theta_v, theta_r_deg: say which with columns"),
        (ROWS.replace("theta_i_deg", "value"), 1, "value appears twice"),
        (ROWS.rsplit("45", 1)[0], None, "3 rows, expected at least 4"),
        (ROWS.splitlines()[0], None, "no rows, expected at least 4"),
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
    with pytest.raises(TableError, match="not UTF-8"):
        read_csv(tmp_path / "latin.csv")


number = st.floats(allow_nan=False, allow_infinity=False)


@given(
    readings=st.lists(st.tuples(st.floats(0, 89.9), st.floats(-180, 180), number, st.floats(0, 1e300)), min_size=4, max_size=20),
    order=st.permutations(["theta_i", "theta_r", "value", "sigma"]),
)
def test_every_reading_comes_back(tmp_path_factory: pytest.TempPathFactory, readings: list[tuple[float, ...]], order: list[str]) -> None:
    named = [dict(zip(("theta_i", "theta_r", "value", "sigma"), r, strict=True)) for r in readings]
    path = tmp_path_factory.mktemp("tables") / "t.csv"
    path.write_text("\n".join([",".join(order)] + [",".join(repr(r[name]) for name in order) for r in named]))
    found = read_csv(path)
    for name, column in (("theta_i", found.theta_i_deg), ("theta_r", found.theta_r_deg), ("value", found.value), ("sigma", found.sigma)):
        np.testing.assert_array_equal(column, [r[name] for r in named])


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
