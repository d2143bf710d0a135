"""`rig model` as a technician and as a program meet it."""

import csv
import io
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fitting.cells import Cell
from fitting.model import MODES, Model, load
from fitting.paper import paper_terms
from fitting.radiometric import radiometric_terms
from rig.cli.main import cli
from rig.cli.model import MODES as KNOWN
from rig.modelfigures import ablation_table, ablations
from tests.conftest import ROOT, rig_environment

COARSE = ("--n-us", "5", "--n-ss", "3", "--grid", "12x12")
BODY = {"mu": 0.1, "R_m": 0.5, "T_m": 0.3, "D_m": 0.05}
PAPER = {"u_diff": 0.2, "u_spec": 0.4, "s_diff": 0.1, "s_spec": 0.1}
PAGES = ("cell", "lobes", "polar", "solid", "map", "ablation")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose workspace keeps the models between the tests."""
    return tmp_path_factory.mktemp("models")


@pytest.fixture
def rig(folder: Path):
    def run(*arguments: str, check: int = 0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "rig", *arguments]
        done = subprocess.run(command, cwd=folder, env=rig_environment(), capture_output=True, text=True, timeout=110)
        assert done.returncode == check, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    return run


def sets(numbers: dict[str, float]) -> list[str]:
    return [word for name, value in numbers.items() for word in ("--set", f"{name}={value}")]


def table(text: str) -> dict[str, np.ndarray]:
    rows = list(csv.DictReader(io.StringIO(text)))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def texts(svg: Path) -> str:
    """All text of a figure without spaces: formulas are set letter by letter."""
    return "".join("".join("".join(element.itertext()) for element in ET.parse(svg).iter("{http://www.w3.org/2000/svg}text")).split())


def stored(folder: Path, mode: str) -> Model:
    (path,) = (folder / "rig-data" / "models").glob(f"{mode}-*.npz")
    return load(path)


def test_terms_are_weighted_and_summed(rig) -> None:
    found = table(rig("model", "eval", "--theta-i", "30,45", "--theta-r", "-60:60:20", *sets(PAPER)).stdout)
    assert list(found) == ["theta_i_deg", "theta_r_deg", *PAPER, "I"]
    terms = paper_terms(found["theta_i_deg"], found["theta_r_deg"]) * list(PAPER.values())
    assert np.column_stack([found[name] for name in PAPER]) == pytest.approx(terms, rel=1e-4)
    assert found["I"] == pytest.approx(terms.sum(axis=1), rel=1e-4)
    found = table(rig("model", "eval", "--mode", "radiometric", "--aspect", "0.8", "--n-us", "9", "--set", "u_diff=0.5").stdout)
    assert list(found) == ["theta_r_deg", *PAPER, "f_r"]
    exact = 0.5 * radiometric_terms(45, found["theta_r_deg"], 0, cell=Cell(0.8), n_us=9)[:, 0]
    assert found["f_r"] == pytest.approx(exact, rel=1e-4)
    assert found["u_diff"] == pytest.approx(exact, rel=1e-4)


@pytest.mark.slow
def test_orders_of_reflection_are_weighted_and_summed(rig, folder: Path) -> None:
    arguments = ("model", "eval", "--mode", "interreflecting", *COARSE, "--phi", "50", "--set", "albedo=0.7", "--set", "s_diff=0.1")
    first = rig(*arguments)
    assert "building the interreflecting model" in first.stderr
    again = rig(*arguments)
    assert again.stderr == ""  # kept in the workspace
    assert again.stdout == first.stdout
    found = table(first.stdout)
    model = stored(folder, "interreflecting")
    assert list(found) == ["theta_r_deg", "order_1", "order_2", "order_later", "u_spec", "s_diff", "s_spec", "f_r"]
    views = found.pop("theta_r_deg")
    mixed = model.reflectance(albedo=0.7, s_diff=0.1)
    assert found["f_r"] == pytest.approx(mixed(45, views, 50), rel=1e-4)
    assert found["order_2"] == pytest.approx(0.7**2 * model.table.alone("order_2")(45, views, 50), rel=1e-4)
    total = found.pop("f_r")
    assert sum(found.values()) == pytest.approx(total, rel=1e-3)
    assert found["s_diff"] == pytest.approx(0.1 / np.pi, rel=1e-3)
    assert np.all(found["order_later"] > 0)


@pytest.mark.slow
def test_body_light_is_reflected_and_sent_through(rig, folder: Path) -> None:
    found = table(rig("model", "eval", "--mode", "body", *COARSE, "--theta-r", "-160:160:40", *sets(BODY)).stdout)
    assert list(found) == ["theta_r_deg", "mirror", "stray", "body", "scattered", "direct", "f_r"]
    body = stored(folder, "body").body
    assert body is not None
    behind = np.abs(found["theta_r_deg"]) > 90
    above = body.reflectance(45, found["theta_r_deg"][~behind], 0, **BODY)  # type: ignore[arg-type]
    through = body.transmittance(45, found["theta_r_deg"][behind], **BODY)  # type: ignore[arg-type]
    assert found["f_r"][~behind] == pytest.approx(above, rel=1e-4)
    assert found["f_r"][behind] == pytest.approx(through, rel=1e-4)
    assert not found["body"][behind].any()
    assert not found["scattered"][~behind].any()
    assert np.all(found["direct"][behind] >= 0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("eval", "--set", "albedo=0.5"), "has no albedo: its numbers are u_diff, u_spec, s_diff, s_spec"),
        (("eval", "--mode", "radiometric", "--set", "u_diff"), "expected NAME=VALUE"),
        (("eval", "--mode", "radiometric", "--set", "u_diff=red"), "expected NAME=VALUE with a number"),
        (("eval", "--mode", "interreflecting", "--set", "albedo=1.5"), "must be a number of 0 to 1, not 1.5"),
        (("eval", "--mode", "body", "--set", "mu=1"), "needs R_m"),
        (("build", "--mode", "paper", "--out", "x.npz", "--set", "u_diff=nan"), "u_diff"),
        (("show", "--mode", "body", "--set", "mu=-1"), "must be a number of 0 or more"),
        (("show", "--grid", "12"), "--grid 12: expected two whole numbers"),
        (("eval", "--tilt", "70"), "tilt"),
        (("show", "x.npz", "--aspect", "1.9"), "x.npz holds mode and geometry: leave out --aspect"),
    ],
)
def test_wrong_numbers_are_one_line_and_exit_code_2(rig, arguments: tuple[str, ...], words: str) -> None:
    done = rig("model", *arguments, check=2)
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("rig: ")
    assert words in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("verb", ["eval", "build", "show"])
def test_help_names_the_numbers_and_gives_examples(rig, verb: str) -> None:
    said = rig("model", verb, "--help").stdout
    for name in ("albedo", "u_spec", "mu_below", "R_m", "D_m"):
        assert re.search(rf"\b{name}\b", said)
    assert re.search(rf"Examples?:\n +rig model {verb}", said)


def test_the_command_knows_every_mode() -> None:
    assert KNOWN == MODES  # listed again there, so that help needs no numpy


def test_help_of_the_group_stays_quick() -> None:
    slow = ("numpy", "numba", "scipy", "matplotlib", "fitting", "rich")
    code = f"""
import sys
from rig.cli.main import main
try:
    main(["model", "--help"])
except SystemExit:
    print([module for module in {slow!r} if module in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_build_says_what_it_wrote_and_show_draws_it(rig, folder: Path) -> None:
    said = json.loads(rig("model", "build", "--mode", "radiometric", *COARSE, "--out", "r.npz", "--set", "u_diff=0.5", "--json").stdout)
    assert said["bytes"] == (folder / "r.npz").stat().st_size
    model = load(folder / "r.npz")
    mixed = model.reflectance(u_diff=0.5)
    assert [said["albedo"][theta] for theta in ("0", "45", "70")] == pytest.approx([float(mixed.albedo(t)) for t in (0, 45, 70)])
    assert said["reciprocity"] == pytest.approx(mixed.reciprocity())
    assert said["seconds"] > 0
    text = CliRunner().invoke(
        cli, ["model", "build", "--mode", "radiometric", *COARSE, "--out", str(folder / "b.npz"), "--set", "u_diff=0.5"]
    )
    for value in said["albedo"].values():
        assert f"{value:.4f}" in text.output

    # As both kinds of file, unless told otherwise.
    drawn = json.loads(rig("model", "show", "r.npz", "--set", "u_diff=0.5", "--set", "u_spec=0.1", "--out", "pages", "--json").stdout)
    assert drawn["files"] == [f"pages/{page}.{ending}" for page in PAGES for ending in ("png", "svg")]
    for path in drawn["files"]:
        assert (folder / path).stat().st_size > 8000
    (ablation,) = drawn["ablation"]
    mixed = model.reflectance(u_diff=0.5, u_spec=0.1)
    last = ablation["steps"][-1]
    assert last["values"] == pytest.approx(mixed(45, ablation["theta_r_deg"], 0).tolist())
    assert last["ratio"] == pytest.approx(float(mixed(45, 40, 0) / mixed(45, -40, 0)))
    assert last["albedo"] == pytest.approx(float(mixed.albedo(45)))
    (found,) = ablations(model, drawn["numbers"], 45, {})
    row = next(line for line in ablation_table(found).splitlines() if line.startswith("the domes' lobe"))
    assert f"{last['ratio']:.3f}" in row
    assert f"{last['albedo']:.3f}" in row
    assert f"{100 * last['change']:.1f} %" in row

    labels = {page: texts(folder / "pages" / f"{page}.svg") for page in PAGES}
    assert "SIMULATED" not in "".join(labels.values())  # nothing in them was measured
    for page, words in {
        "cell": ("2a=20µm", "h=10µm", "pitch20µm", "inshadow"),
        "lobes": ("(x5)", "epidermis,specular", "1/sr"),
        "polar": ("intheplaneofincidence", "acrossit", "u_spec0.1"),
        "solid": ("mirror", "1/sr"),
        "map": ("towardsthelight", "mirrordirection"),
        "ablation": ("flatLambertsurface", "floorinthegaps", f"albedo{last['albedo']:.3f}"),
    }.items():
        for word in words:
            assert word in labels[page]


@pytest.mark.slow
@pytest.mark.timeout(200)
def test_show_puts_the_four_modes_side_by_side(rig, folder: Path) -> None:
    said = rig("model", "show", *COARSE, "--width", "30", "--theta-i", "60", "--format", "svg").stdout
    (pages,) = (folder / "rig-data" / "figures").glob("model-paper-*")
    names = {path.name for path in pages.iterdir()}
    assert names == {f"{page}.svg" for page in (*PAGES, "ablation-interreflecting", "ablation-body", "modes")}
    assert all(f"figures/{pages.name}/{name}" in said for name in names)
    assert "2a=30µm" in texts(pages / "cell.svg")
    for mode in ("paper", "radiometric", "interreflecting", "body"):
        assert f"{mode}:" in texts(pages / "modes.svg")
    for line in (
        "paper, theta_i = 60 deg, one term more",
        "interreflecting, theta_i = 60 deg, one",
        "body, theta_i = 60 deg, each left out",
    ):
        assert line in said
    assert "blackmesophyll" in texts(pages / "ablation-body.svg")
