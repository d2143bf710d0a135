"""`rig fit` as a technician and as a program meet it, on tables; on runs see `test_cli`."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting import Measurements, paper_terms
from fitting.formats.table_csv import write_csv
from rig.cli.main import main
from rig.errors import RunError
from rig.fitjobs import specimen_of_table, together
from rig.fits import list_fits, read_fit

VIEWS = np.arange(-70.0, 71, 10)
X = {"u_diff": 0.3, "u_spec": 1.5, "s_diff": 0.2, "s_spec": 0.1}
RigFit = Callable[..., Any]


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RigFit:
    """Run `rig fit ... --json --no-page` in an empty folder; returns the fits, or with `check` what stderr says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RIG_HOME", raising=False)

    def run(*arguments: str, check: int = 0, options: tuple[str, ...] = ("--json", "--no-page")) -> Any:
        with pytest.raises(SystemExit) as left:
            main(["fit", *arguments, *options])
        said = capsys.readouterr()
        assert left.value.code == check, said
        if check:
            return said.err
        return [json.loads(line) for line in said.out.splitlines()] if "--json" in options else said.out

    return run


def table(path: str, incidences: tuple[float, ...] = (45.0,), *, aspect: float = 1.2, quantity: Any = "reflectance-factor") -> Measurements:
    """Readings of a petal that obeys the paper's model exactly, written as CSV."""
    theta_i, theta_r = (a.ravel() for a in np.meshgrid(incidences, VIEWS, indexing="ij"))
    intensity = paper_terms(theta_i, theta_r, aspect=aspect) @ list(X.values())
    value = intensity if quantity == "intensity" else intensity / np.cos(np.radians(theta_i))
    made = Measurements(theta_i, theta_r, value, quantity=quantity)
    write_csv(path, made)
    return made


def test_the_coefficients_of_a_table_come_back_with_what_can_be_said_of_them(rig: RigFit) -> None:
    table("petal.csv")
    (fitted,) = rig("petal.csv", "--aspect", "1.2")
    assert fitted["x"] == pytest.approx(X, rel=1e-4)
    assert fitted["model"] == "paper"
    assert fitted["shape"] == {"aspect": 1.2, "p": 2.0, "q": 2.0, "n_us": 40.0, "n_ss": 5.0}
    assert fitted["reflectances"]["s_diff"][0] == pytest.approx(X["s_diff"], rel=1e-4)
    assert fitted["reflectances"]["s_spec"][0] == pytest.approx(X["s_spec"] * 2 / 7, rel=1e-3)
    assert fitted["linear"]["coefficients"][0]["determined"]
    (stored,) = list_fits(Path("rig-data/fits"))
    assert stored.fit.x == fitted["x"]
    assert stored.provenance["file"] == "petal.csv"


def test_a_shape_is_found_within_bounds_or_held(rig: RigFit) -> None:
    table("petal.csv")
    (fitted,) = rig("petal.csv", "--find", "aspect=0.5:2", "--hold", "n_us=40")
    assert fitted["searched"] == ["aspect"]
    assert fitted["aspect"] == pytest.approx(1.2, rel=0.01)
    assert fitted["converged"]
    assert "descents agree" in fitted["search"]
    text = rig("petal.csv", "--find", "aspect=0.3:0.8", options=("--no-page",))
    assert "aspect ended at its upper bound" in text


def test_specimens_share_a_shape(rig: RigFit) -> None:
    table("one.csv", aspect=1.2)
    table("two.csv", aspect=1.2)
    one, two = rig("one.csv", "two.csv", "--joint", "--find", "aspect")
    assert one["aspect"] == two["aspect"] == pytest.approx(1.2, rel=0.01)
    assert one["shared_with"] == ["two.csv"]
    assert "--joint fits one model" in rig("one.csv", "two.csv", "--joint", "--model", "auto", check=2)


def test_the_ladder_says_what_the_readings_support(rig: RigFit, monkeypatch: pytest.MonkeyPatch) -> None:
    from fitting import compare

    quick = {name: compare.RUNGS[name] for name in ("lambert", "phong", "paper")}
    monkeypatch.setattr(compare, "RUNGS", quick)  # the traced rungs have their own tests
    table("petal.csv", (30.0, 45.0, 60.0), aspect=0.5)
    (fitted,) = rig("petal.csv", "--model", "auto")
    ladder = fitted["comparison"]
    assert ladder["supported"] == "the paper"
    assert fitted["model"] == "paper"
    assert [row["title"] for row in ladder["rows"]] == ["Lambert", "Phong", "the paper", "the paper, shape found"]
    assert ladder["rows"][2]["left_out"] < 0.1 < ladder["rows"][0]["left_out"]
    assert [p["what"] for p in fitted["predicted"]] == ["30 deg, from 45 deg", "60 deg, from 45 deg"]
    assert max(p["E_max"] for p in fitted["predicted"]) < 0.1
    text = rig("petal.csv", "--compare", options=("--no-page",))
    assert "the data support the paper" in text
    assert "x_u_diff" in text


def test_the_layers_follow_from_what_is_known(rig: RigFit) -> None:
    table("petal.csv")
    (fitted,) = rig("petal.csv", "--aspect", "1.2", "--known", "t_u=0.5", "--known", "t_s=0.2")
    assert fitted["layers"]["k_u_diff"] == pytest.approx([0.6, 0.6], rel=1e-3)
    assert fitted["layers"]["k_s_diff"] == pytest.approx([0.5, 0.5], rel=1e-3)
    assert "expected one of t_u" in rig("petal.csv", "--known", "t=0.5", check=2)


def test_relative_readings_need_a_white_for_reflectances(rig: RigFit) -> None:
    table("petal.csv", quantity="intensity")
    (fitted,) = rig("petal.csv", "--aspect", "1.2")
    assert "reflectances" not in fitted
    (fitted,) = rig("petal.csv", "--aspect", "1.2", "--white", "2")
    assert fitted["reflectances"]["s_diff"][0] == pytest.approx(X["s_diff"] / 2, rel=1e-4)


def test_an_aperture_is_part_of_the_model(rig: RigFit) -> None:
    lobe = (10 + 2) / 2 * np.maximum(0.0, np.cos(np.radians(45 + VIEWS))) ** 10
    write_csv("petal.csv", Measurements(np.full(15, 45.0), VIEWS, 0.3 + 0.2 * lobe, quantity="reflectance-factor"))
    point, wide = (rig("petal.csv", "--model", "phong", "--acceptance", deg)[0] for deg in ("0", "8"))
    assert wide["aperture"]["acceptance_deg"] == 8
    assert point["shape"]["n"] == pytest.approx(10, rel=1e-3)
    assert wide["shape"]["n"] > 10.3  # what a wide cone blurs to n = 10 is narrower itself


def test_of_a_long_table_so_many_are_fitted_and_the_others_foretold(rig: RigFit) -> None:
    m = table("petal.csv", (20.0, 45.0, 60.0))
    (fitted,) = rig("petal.csv", "--aspect", "1.2", "--most", "20")
    assert fitted["n"] == 20
    (told,) = [p for p in fitted["predicted"] if "not drawn" in p["what"]]
    assert len(told["measured"]) == len(m) - 20
    assert told["E_max"] < 0.1
    # A comment and a header come first.
    assert specimen_of_table(Path("petal.csv"), m, 20, seed=0).measurements.rows.tolist() == [row - 2 for row in fitted["rows"]]


def test_files_of_others_are_fitted_as_they_are(rig: RigFit) -> None:
    from fitting.formats.alta import write_alta
    from fitting.formats.grid import Scattered

    m = table("petal.csv", (30.0, 45.0))
    across = np.where(m.theta_r_deg < 0, 180.0, 0.0)
    brdf = m.value / np.pi
    write_alta("petal.alta", Scattered(m.theta_i_deg, 0 * across, np.abs(m.theta_r_deg), across, brdf[:, None]))
    (fitted,) = rig("petal.alta", "--aspect", "1.2", "--in-plane")
    assert fitted["quantity"] == "brdf"
    assert fitted["x"] == pytest.approx(X, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("petal.csv", "--find", "mu"), 1, "has no mu: its shape numbers are aspect, p, q, n_us, n_ss"),
        (("petal.csv", "--hold", "aspect"), 2, "expected NAME=VALUE"),
        (("petal.csv", "--hold", "aspect=tall"), 2, "expected NAME=NUMBER"),
        (("petal.csv", "--find", "aspect=1"), 2, "expected NAME=LOW:HIGH"),
        (("petal.csv", "--find", "aspect=2:1"), 1, "the lower one first"),
        (("petal.csv", "--acceptance", "50"), 1, "acceptance_deg"),
        (("petal.csv", "--weights", "sigma"), 1, "no sigma"),
        (("petal.csv", "--covariance", "none.csv"), 1, "none.csv"),
        (("missing.csv",), 1, "no such file"),
        (("twice.csv",), 1, "line 4"),
        (("dark.csv",), 1, "line 3"),
    ],
)
def test_what_cannot_be_is_one_line(rig: RigFit, arguments: tuple[str, ...], code: int, said: str) -> None:
    table("petal.csv")
    Path("twice.csv").write_text("theta_i,theta_r,brdf\n45,0,0.1\n45,10,0.1\n45,0,0.1\n")
    Path("dark.csv").write_text("theta_i,theta_r,brdf\n45,0,0.1\n45,10,-0.1\n45,20,0.1\n45,30,0.1\n")
    error = rig(*arguments, check=code)
    assert said in error
    assert error.count("\n") == 1


def test_the_page_lies_beside_the_fit(rig: RigFit) -> None:
    table("petal.csv")
    rig("petal.csv", options=("--json",))
    (stored,) = list_fits(Path("rig-data/fits"))
    page = Path(f"rig-data/fits/{stored.id}.html").read_text(encoding="utf-8")
    assert "petal.csv" in page


def test_fits_of_the_first_version_are_read(rig: RigFit, tmp_path: Path) -> None:
    table("petal.csv")
    (doc,) = rig("petal.csv", "--aspect", "1.2")
    old = {"schema_version": 1, "n": 15} | {
        name: doc[name]
        for name in (
            *("id", "time", "label", "simulated", "provenance", "x", "aspect", "n_us", "n_ss", "weights", "quantity", "unit"),
            *("source", "theta_i_deg", "theta_r_deg", "measured", "modelled", "E", "rows"),
        )
    }
    path = tmp_path / "old.json"
    path.write_text(json.dumps(old))
    assert read_fit(path).fit.x == pytest.approx(doc["x"])
    path.write_text(json.dumps(old | {"measured": "no"}))
    with pytest.raises(RunError, match="not a stored fit"):
        read_fit(path)


def test_only_readings_of_one_kind_are_put_together() -> None:
    one = Measurements(np.full(2, 45.0), np.array([0.0, 10.0]), np.ones(2), sigma=np.ones(2))
    other = Measurements(np.full(2, 30.0), np.array([0.0, 10.0]), np.ones(2))
    both = together([one, other])
    assert both.theta_i_deg.tolist() == [45, 45, 30, 30]
    assert both.sigma is None
    with pytest.raises(RunError, match="different quantities"):
        together([one, Measurements(np.full(1, 30.0), np.zeros(1), np.ones(1), quantity="brdf")])
