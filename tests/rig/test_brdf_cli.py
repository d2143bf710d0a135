"""`rig brdf` as a technician and as a program meet it, and fits as files of other programs."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting.cells import Cell
from fitting.fit import Fit, fit
from fitting.formats.files import read_any, write_any
from fitting.formats.hemisphere import Whole
from fitting.formats.merl import Merl
from fitting.formats.rgl import Rgl
from fitting.measurements import Measurements
from fitting.model import build
from fitting.table import Grid
from rig.brdfs import brdf_of
from rig.cli.main import main
from rig.errors import ConfigError
from rig.fits import StoredFit, new_fit, store_fit
from rig.workspace import Workspace
from tests.formats.lobes import lobes

VIEWS = np.arange(-70.0, 71, 10)
RigRun = Callable[..., tuple[str, str]]


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> RigRun:
    """Run a command in this process, in an empty folder; returns stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RIG_HOME", raising=False)

    def run(*arguments: str, check: int = 0) -> tuple[str, str]:
        with pytest.raises(SystemExit) as left:
            main(["brdf", *arguments])
        said = capsys.readouterr()
        assert left.value.code == check, said
        return said.out, said.err

    return run


def fitted(model: str, *, quantity: Any = "intensity", scale: float = 1.0, theta_i: float = 45.0, **shape: float) -> Fit:
    """A fit of readings of two lobes; relative ones are `scale` times what they are against the perfect diffuser."""
    values = lobes(np.full(len(VIEWS), theta_i), VIEWS, 0.0)[:, 1:].sum(axis=1)
    per_sr = 1.0 if quantity == "brdf" else scale * np.pi * np.cos(np.radians(theta_i))
    readings = Measurements(np.full(len(VIEWS), theta_i), VIEWS, values * per_sr, quantity=quantity, unit="nA" if per_sr != 1 else "1/sr")
    return fit(readings, model, shape=shape)


def stored(tmp_path: Path, found: Fit, *, simulated: bool = True) -> StoredFit:
    made = new_fit("RR", simulated, {"run": "r", "run_uid": "u", "journal_sha256": "s"}, found)
    store_fit(Workspace(tmp_path / "rig-data").fits, made)
    return made


def test_help_has_examples_and_names_the_formats(rig: RigRun) -> None:
    said = rig("--help")[0]
    for kind in ("merl", "rgl", "klems", "alta", "pab", "csv", "zemax"):
        assert re.search(rf"^ +{kind} +\.\w+", said, re.MULTILINE), kind
    for verb in ("convert", "info"):
        said = rig(verb, "--help")[0]
        assert re.search(rf"Examples:\n +rig brdf {verb} ", said)
    assert "--beyond" in rig("convert", "--help")[0]


def test_help_knows_every_format() -> None:
    from fitting.formats.files import FORMATS
    from rig.cli.brdf import KINDS

    assert set(KINDS) == set(FORMATS)


@pytest.mark.slow
def test_a_file_is_converted_and_described(rig: RigRun, tmp_path: Path) -> None:
    write_any(tmp_path / "fabric.binary", lobes)
    out, err = rig("convert", "fabric.binary", "fabric.bsdf")
    assert (out, err) == ("fabric.bsdf\n", "")
    found = read_any(tmp_path / "fabric.bsdf")
    assert isinstance(found, Rgl)
    np.testing.assert_allclose(found(30, 40, 120), lobes(30, 40, 120), rtol=0.01)
    out, err = rig("convert", "fabric.bsdf", "fabric.xml", "--channel", "R", "--json")
    said = json.loads(out)
    assert said["seconds"] > 0
    assert {k: v for k, v in said.items() if k != "seconds"} == {
        "in": ["fabric.bsdf"],
        "from": "rgl",
        "out": ["fabric.xml"],
        "to": "klems",
        "bytes": (tmp_path / "fabric.xml").stat().st_size,
        "notes": ["means over patches 10 deg wide or more"],
    }
    assert err == "fabric.xml: means over patches 10 deg wide or more\n"
    about = json.loads(rig("info", "fabric.xml", "--json")[0])
    assert (about["format"], about["size"], about["channels"]) == ("klems", {"readings": 145**2}, ["value"])
    assert about["albedo"][0]["share"] == pytest.approx([0.3 * np.sin(np.radians(82.5)) ** 2], rel=0.01)
    said = rig("info", "fabric.binary")[0]
    assert re.match(r"fabric\.binary: merl, 34992012 bytes, 1458000 bins, \d+ bins with a value\nreflection, channels R, G, B", said)
    assert re.search(r"albedo at theta_i 45 deg, up to theta_r 90 deg: 0\.3000 ", said)


def test_incidences_of_a_sample_are_read_together(rig: RigRun, tmp_path: Path) -> None:
    write_any(tmp_path / "petal.pab", lambda i, r, p: lobes(i, r, p)[..., 1])
    files = sorted(path.name for path in tmp_path.glob("petal_t*.pab"))
    assert len(files) == 9
    assert rig("convert", *files, "petal.csv") == ("petal.csv\n", "")
    assert len(read_any(tmp_path / "petal.csv").values) == 9 * 18 * 72  # type: ignore[arg-type]
    out, _ = rig("convert", "petal.csv", "again.txt", "--json")
    assert len(json.loads(out)["out"]) == 9
    rig("convert", "petal.csv", "petal.dat", "--to", "csv")
    assert json.loads(rig("info", "petal.dat", "--json")[0])["format"] == "csv"


def test_what_lies_beyond_must_be_said(rig: RigRun, tmp_path: Path) -> None:
    write_any(tmp_path / "petal.csv", lambda i, r, p: lobes(i, r, p)[..., 1])
    _, err = rig("convert", "petal.csv", "petal.bsdf", check=2)
    assert re.fullmatch(r"rig: petal\.csv: theta_. = .* has 0 to 8. deg\. Say .* \(--beyond nearest, --beyond zero\)\n", err)
    assert not (tmp_path / "petal.bsdf").exists()
    out, err = rig("convert", "petal.csv", "petal.bsdf", "--beyond", "nearest")
    assert out == "petal.bsdf\n"
    assert err.splitlines() == [
        "petal.bsdf: readings at theta_i 0 to 80 and theta_r 0 to 85 deg, beyond them as at their end; R, G and B are alike"
    ]


@pytest.mark.parametrize(
    ("arguments", "code", "match"),
    [
        (("convert", "none.csv", "a.bsdf"), 1, "none.csv: no such file"),
        (("convert", "none", "a.bsdf"), 1, "no fit 'none'"),
        (("convert", "plane.csv", "a.bsdf"), 1, r"make a hemisphere: .*Fit first \(rig fit FILE\), then convert the fit"),
        (("convert", "plane.csv", "a.tif"), 1, "what it ends in says no format; known are merl"),
        (("convert", "plane.csv", "a.dat", "--white", "2"), 2, "--white is for fits of relative readings"),
        (("convert", "rgb.csv", "a.xml"), 2, r"holds one channel, not R, G, B: choose one channel \(--channel NAME\)"),
        (("convert", "rgb.csv", "a.xml", "--channel", "X"), 1, "no channel 'X'; choose one of R, G, B"),
        (("convert", "rgb.csv", "plane.csv", "a.xml"), 1, "only pab files are read several at a time"),
        (("convert", "empty.bsdf", "a.xml"), 1, "empty.bsdf: is empty; known are merl"),
        (("convert", "foreign.png", "a.xml"), 1, "byte 0: neither"),
        (("convert", "notes.json", "a.xml"), 1, "not a stored fit"),
        (("info", "cut.csv"), 1, "cut.csv, line 3: 2 numbers, expected 5|cut.csv, line 3"),
        (("info", "plane.csv", "--param-out", "INV_STERADIAN"), 1, "has no param_out"),
        (("convert", "plane.csv"), 2, "Missing argument"),
        (("convert", "plane.csv", "a.xml", "--to", "exr"), 2, "Invalid value for '--to'"),
    ],
)
def test_errors_are_one_line(rig: RigRun, tmp_path: Path, arguments: tuple[str, ...], code: int, match: str) -> None:
    head = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,"
    (tmp_path / "plane.csv").write_text(head + "brdf_per_sr\n45,0,30,0,0.2\n45,0,30,180,0.3\n")
    (tmp_path / "rgb.csv").write_text(head + "brdf_R_per_sr,brdf_G_per_sr,brdf_B_per_sr\n45,0,30,0,0.2,0.3,0.4\n")
    (tmp_path / "cut.csv").write_text(head + "brdf_per_sr\n45,0,30,0,0.2\n45,0")
    (tmp_path / "empty.bsdf").touch()
    (tmp_path / "foreign.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(9))
    (tmp_path / "notes.json").write_text("{}")
    before = sorted(tmp_path.iterdir())
    out, err = rig(*arguments, check=code)
    assert out == ""
    assert re.match(f"rig: .*(?:{match})", err)
    assert err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_a_fit_of_relative_readings_needs_the_white(rig: RigRun, tmp_path: Path) -> None:
    made = stored(tmp_path, fitted("phong", scale=12.5))
    _, err = rig("convert", made.id, "RR.bsdf", check=2)
    assert "--white VALUE says" in err or "say with --white VALUE" in err
    assert "--white -1" in rig("convert", made.id, "RR.bsdf", "--white", "-1", check=2)[1]
    out, err = rig("convert", made.id, "RR.bsdf", "--white", "12.5", "--json")
    assert json.loads(out)["from"] == "fit"
    found = read_any(tmp_path / "RR.bsdf")
    assert isinstance(found, Rgl)
    assert found.description == f"SIMULATED {made.id}"
    exact = made.fit.brdf(12.5)
    np.testing.assert_allclose(found(45, 45, [0, 90])[:, 0], exact(45, 45, np.array([0.0, 90])), rtol=0.01)
    assert "no place for SIMULATED" in rig("convert", made.id, "RR.binary", "--white", "12.5")[1]
    merl = read_any(tmp_path / "RR.binary")
    assert isinstance(merl, Merl)
    np.testing.assert_allclose(merl(45, 45, 90)[0], exact(45, 45, 90), rtol=0.01)
    again = json.loads(rig("info", f"rig-data/fits/{made.id}.json", "--white", "12.5", "--json")[0])
    assert again["format"] == "fit"
    assert "sends back more light than falls on it" in rig("convert", "RR", "RR.xml", "--white", "1")[1]


def test_a_fit_in_1_per_sr_has_its_scale(rig: RigRun, tmp_path: Path) -> None:
    made = stored(tmp_path, fitted("lambert", quantity="brdf"), simulated=False)
    assert "--white is for fits of relative readings" in rig("convert", made.id, "a.csv", "--white", "2", check=2)[1]
    rig("convert", made.id, "a.csv")
    (x,) = made.fit.x.values()
    np.testing.assert_allclose(read_any(tmp_path / "a.csv").values, x / np.pi, rtol=1e-12)
    assert made.id in (tmp_path / "a.csv").read_text().splitlines()[0]
    assert "SIMULATED" not in (tmp_path / "a.csv").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["paper", "radiometric", "interreflecting", "body"])
def test_tables_of_domes_are_the_fits_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    """What is converted is looked up in a table, here a coarse one; the fit integrates."""

    def coarse(workspace: Workspace, mode: str, cell: Cell, **settings: Any) -> Any:
        return build(mode, cell, grid=Grid(12, 12), **settings)

    monkeypatch.setattr("rig.brdfs.stored_model", coarse)
    shape = {"aspect": 0.7, "n_us": 6.0, "n_ss": 4.0} if model != "body" else {"aspect": 0.7, "mu": 0.2, "R_m": 0.6}
    made = stored(tmp_path, fitted(model, scale=3.0, **shape))
    assert min(made.fit.x.values()) >= 0
    found, exact = brdf_of(made, Workspace(tmp_path), 3.0), made.fit.brdf(3.0)
    at = np.array([30.0, 45, 60, 20, 70]), np.array([50.0, 20, 40, 60, 30]), np.array([180.0, 0, 120, 60, 90])
    np.testing.assert_allclose(found(*at), exact(*at), rtol=0.02)
    assert np.all(np.isfinite(found(np.array([0.0, 90, 90]), np.array([90.0, 0, 90]), 0.0)))
    with pytest.raises(ConfigError, match="--white VALUE"):
        brdf_of(made, Workspace(tmp_path), None)


def test_mitsuba_loads_a_fit(rig: RigRun, tmp_path: Path) -> None:
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is an optional extra")
    from tests.formats.test_rgl import drawn, evaluated

    made = stored(tmp_path, fitted("phong", quantity="brdf"))
    rig("convert", made.id, "RR.bsdf")
    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    try:
        at = drawn(5, 300, 80.0)
        off = np.abs(evaluated(mitsuba, tmp_path / "RR.bsdf", at)[:, 0] / made.fit.brdf()(at[:, 0], at[:, 2], at[:, 3] - at[:, 1]) - 1)
    finally:
        if before:
            mitsuba.set_variant(before)
    assert np.median(off) < 0.002
    assert np.percentile(off, 95) < 0.02


def test_a_real_file_of_others(rig: RigRun, shared_data: Path, tmp_path: Path) -> None:
    """Measured out of the plane, with nothing said of its values' unit."""
    tape = str(shared_data / "retroreflector" / "retro-gray-tape.dat")
    assert "PARAM_OUT is None" in rig("info", tape, check=1)[1]
    said = json.loads(rig("info", tape, "--param-out", "INV_STERADIAN", "--json")[0])
    assert said["size"] == {"readings": 7405}
    assert said["albedo"] == []
    assert "do not make a hemisphere" in said["no_albedo"]
    fewer = json.loads(rig("info", tape, "--param-out", "INV_STERADIAN", "--theta-r-below", "60", "--json")[0])
    assert fewer["axes"]["theta_r"]["last"] <= 60
    assert 1000 < fewer["size"]["readings"] < 7405
    rig("convert", tape, "tape.csv", "--param-out", "INV_STERADIAN")
    again = json.loads(rig("info", "tape.csv", "--json")[0])
    assert (again["largest"], again["largest_at"]) == (said["largest"], pytest.approx(said["largest_at"]))


def test_a_matrix_of_both_sides_is_asked_for_either(rig: RigRun, tmp_path: Path) -> None:
    from fitting.formats.klems import write_klems

    def white(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return np.full(np.broadcast(theta_i, theta_r, phi).shape, 0.2)

    write_klems(tmp_path / "leaf.xml", white, transmitted=lambda *at: white(*at) / 2, basis="LBNL/Klems Quarter", samples=1)
    for option, value in (((), 0.2), (("--through",), 0.1)):
        said = json.loads(rig("info", "leaf.xml", *option, "--json")[0])
        assert (said["least"], said["largest"]) == pytest.approx((value, value))
        assert said["quantity"] == ("btdf" if option else "brdf")
    _, err = rig("convert", "leaf.xml", "leaf.csv", "--through")
    assert err == "leaf.csv: only Transmission Back, without Reflection Back (Visible)\n"
    assert "btdf_per_sr" in (tmp_path / "leaf.csv").read_text()
    assert "holds reflection only" in rig("convert", "leaf.xml", "leaf.bsdf", "--through", "--beyond", "nearest", check=1)[1]


def test_asking_for_help_imports_no_formats(rig: RigRun) -> None:
    """Names of formats are in the command itself, so that help is quick."""
    known = {name: module for name, module in sys.modules.items() if name.startswith("fitting.formats")}
    for name in known:
        del sys.modules[name]
    try:
        rig("convert", "--help")
        assert not [name for name in sys.modules if name.startswith("fitting.formats")]
    finally:
        sys.modules.update(known)


def test_whole_is_what_is_converted(tmp_path: Path) -> None:
    """The command's --beyond is that of the package."""
    from fitting.formats.hemisphere import BEYOND

    assert BEYOND == ("refuse", "nearest", "zero")
    assert Whole.__dataclass_fields__["beyond"].default == "refuse"
