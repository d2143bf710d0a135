"""The shipped tables, and asking them."""

import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline, RectBivariateSpline

from sim.petals import PetalError, PetalTable, load, names
from sim.petals.__main__ import main
from sim.petals.build import THETA_I, f_r_batches, trace_node
from sim.petals.interpolation import BicubicSpline, spline_slopes
from sim.petals.structure import CULTIVARS, check
from sim.petals.table import read_table
from sim.petals.tracing import TRACER_VERSION, mean_and_error

TABLES = {name: load(name) for name in names()}
DARK, PALE = ("BR", "RR"), ("PR", "WR")
PAPER_VIEWS = np.arange(-70, 71, 10)

each = pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)


@each
def test_a_table_is_what_the_present_tracer_makes_of_the_present_petal(table: PetalTable) -> None:
    assert table.tracer == TRACER_VERSION
    assert table.parameters == check(CULTIVARS[table.name])
    assert table.theta_i.tolist() == list(THETA_I)
    assert table.theta_r.tolist() == list(range(-85, 86, 5))


@each
def test_standard_errors(table: PetalTable) -> None:
    relative = table.standard_error / table.f_r_nodes
    inner = np.abs(table.theta_r) <= 70
    assert (relative > 0.0005).all()
    assert relative[:, inner][table.theta_i <= 70].max() <= 0.01
    assert relative.max() <= 0.03


@each
def test_energy(table: PetalTable) -> None:
    assert (table.reflectance + table.transmittance < 1).all()
    assert (table.surface > 0).all()
    assert (table.surface < table.f_r_nodes).all()
    # The bins hold all of the reflected light.
    cosine = np.diff(np.sin(np.radians(table.theta_r_bins)) ** 2)
    whole = (table.f_r_bins.mean(axis=2) * cosine).sum(axis=1) * math.pi
    assert whole == pytest.approx(table.reflectance, rel=1e-4)


def test_together_they_are_small() -> None:
    data = Path(sys.modules["sim"].__path__[0]) / "data"
    assert sum((data / f"petal_{name}.json").stat().st_size for name in names()) < 500_000


def test_the_stronger_the_texture_the_more_light_back_to_the_lamp() -> None:
    ratios = []
    for table in TABLES.values():
        row = table.theta_i.tolist().index(45)
        back, mirror = table.theta_r.tolist().index(40), table.theta_r.tolist().index(-40)
        value = table.f_r_nodes[row, back] / table.f_r_nodes[row, mirror]
        error = value * np.hypot(*(table.standard_error[row, [back, mirror]] / table.f_r_nodes[row, [back, mirror]]))
        ratios.append((value, error))
    for (stronger, e1), (weaker, e2) in itertools.pairwise(ratios):
        assert stronger > 1.3 * weaker
        assert stronger - weaker > 10 * math.hypot(e1, e2)
    assert ratios[0][0] > 2
    assert ratios[3][0] < 0.9


def test_pale_petals_are_about_ten_times_brighter_and_fill_the_papers_scales() -> None:
    factor = {name: 1000 * math.pi * table.f_r(45, PAPER_VIEWS) for name, table in TABLES.items()}
    for name in DARK:
        assert factor[name].min() >= 2
        assert 15 <= factor[name].max() <= 40
    for name in PALE:
        assert factor[name].min() >= 40
        assert 150 <= factor[name].max() <= 400
    pale, dark = (np.mean([factor[name] for name in group]) for group in (PALE, DARK))
    assert 5 < pale / dark < 40


@each
def test_light_and_view_can_change_places(table: PetalTable) -> None:
    z = []
    for i, a in enumerate(table.theta_i):
        for b in table.theta_i[:i]:
            k = table.theta_i.tolist().index(b)
            for side in (1, -1) if b > 0 else (1,):
                there, back = (i, table.theta_r.tolist().index(side * b)), (k, table.theta_r.tolist().index(side * a))
                error = math.hypot(table.standard_error[there], table.standard_error[back])
                z.append((table.f_r_nodes[there] - table.f_r_nodes[back]) / error)
    assert len(z) == 81
    assert np.abs(z).max() < 5
    assert np.mean(np.square(z)) < 1 + 5 * math.sqrt(2 / len(z))


@each
def test_interpolation_goes_through_the_nodes_and_is_mirrored(table: PetalTable) -> None:
    grid = table.f_r(table.theta_i[:, None], table.theta_r)
    assert grid == pytest.approx(table.f_r_nodes, rel=1e-12)
    assert table.f_r(-table.theta_i[:, None], -table.theta_r) == pytest.approx(grid, rel=1e-12)
    assert table.f_r(0, table.theta_r) == pytest.approx(table.f_r(0, -table.theta_r), rel=1e-12)


@given(name=st.sampled_from(names()), theta_i=st.floats(-80, 80), theta_r=st.floats(-90, 90))
def test_interpolation_is_smooth_and_keeps_near_the_nodes(name: str, theta_i: float, theta_r: float) -> None:
    table = TABLES[name]
    value = table.f_r(theta_i, theta_r)
    i = np.searchsorted(table.theta_i, abs(theta_i), side="right") - 1
    j = np.searchsorted(table.theta_r, np.clip(math.copysign(1, theta_i) * theta_r, -85, 84.9), side="right") - 1
    corners = table.f_r_nodes[i : i + 2, max(0, j) : j + 2]
    assert 0.8 * corners.min() < value < 1.25 * corners.max() or abs(theta_r) > 85
    # Second differences fall with the square of the step: no kink, also at theta_i = 0 and at the last node.
    h = 1e-3
    theta_i, theta_r = np.clip(theta_i, -80 + h, 80 - h), np.clip(theta_r, -90 + h, 90 - h)
    for line in (table.f_r(theta_i + h * np.array([-1, 0, 1]), theta_r), table.f_r(theta_i, theta_r + h * np.array([-1, 0, 1]))):
        assert abs(line[0] - 2 * line[1] + line[2]) < 0.05 * h**2 * line[1]


def test_the_continuation_to_the_horizon() -> None:
    table = TABLES["BR"]
    for side in (1, -1):
        theta = side * np.array([84.999, 85.001, 89.999, 90.0])
        log = np.log(table.f_r(60, theta))
        inner, outer = (np.log(table.f_r(60, side * np.array([a, a + 1e-4]))) for a in (85 - 1e-4, 85.0))
        assert np.diff(inner) == pytest.approx(np.diff(outer), rel=1e-2)  # leaves with the same slope
        assert abs(log[3] - log[2]) < 1e-6  # and arrives level
        assert log[1] == pytest.approx(log[0], abs=1e-3)


def test_questions_outside_a_table_are_refused() -> None:
    table = TABLES["RR"]
    assert table.f_r([[10], [-80]], [0, 90, -90]).shape == (2, 3)
    for theta_i, theta_r, words in ((80.1, 0, "theta_i = 80.1"), (0, -90.5, "theta_r = -90.5"), (math.nan, 0, "theta_i = nan")):
        with pytest.raises(PetalError, match=words):
            table.f_r([0, theta_i], theta_r)
    with pytest.raises(PetalError, match="expected one of BR, RR, PR, WR"):
        load("XX")


def test_splines_are_scipys() -> None:
    rng = np.random.default_rng(3)
    x, y = np.cumsum(rng.uniform(1, 10, 9)), np.cumsum(rng.uniform(1, 10, 7))
    values = rng.normal(size=(9, 7))
    assert spline_slopes(x, values) == pytest.approx(CubicSpline(x, values)(x, 1))
    px, py = rng.uniform(x[0], x[-1], 50), rng.uniform(y[0], y[-1], 50)
    ours, theirs = BicubicSpline(x, y, values), RectBivariateSpline(x, y, values)
    assert ours(px, py) == pytest.approx(theirs(px, py, grid=False))
    assert ours.slope_y(px, py) == pytest.approx(theirs(px, py, dy=1, grid=False))


def test_asking_a_table_needs_numpy_alone() -> None:
    code = (
        "import sys, sim.petals as p; p.load('BR').f_r(45, 0); "
        "print([m for m in ('numba', 'scipy', 'matplotlib') if m in sys.modules])"
    )  # fmt: skip
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


@pytest.mark.parametrize("change", ["{", '{"format": "other"}', "drop", "zero"])
def test_damaged_files_are_refused(tmp_path: Path, change: str) -> None:
    path = tmp_path / "petal.json"
    text = (Path(sys.modules["sim"].__path__[0]) / "data" / "petal_WR.json").read_text(encoding="ascii")
    data = json.loads(text)
    if change == "drop":
        del data["theta_r"]
    elif change == "zero":
        data["f_r_nodes"][3][4] = 0.0
    path.write_text(json.dumps(data) if change in ("drop", "zero") else change, encoding="ascii")
    with pytest.raises(PetalError, match=r"petal\.json.*python -m sim\.petals"):
        read_table(path)
    with pytest.raises(PetalError, match=r"absent\.json"):
        read_table(tmp_path / "absent.json")


def test_rebuilding_is_repeatable_and_reports_progress(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        assert main(["--cultivar", "WR", "--photons", "500", "--out", str(tmp_path / folder)]) == 0
        texts.append((tmp_path / folder / "petal_WR.json").read_bytes())
    assert texts[0] == texts[1]
    table = read_table(tmp_path / "a" / "petal_WR.json")
    assert (table.photons, table.seed, table.parameters) == (500, TABLES["WR"].seed, TABLES["WR"].parameters)
    # It is a noisy version of the shipped one.
    z = (table.f_r_nodes - TABLES["WR"].f_r_nodes) / np.hypot(table.standard_error, TABLES["WR"].standard_error)
    assert np.mean(z**2) < 3
    progress = capsys.readouterr()
    assert progress.err.count("min left") == 2 * len(THETA_I)
    assert progress.out.count("petal_WR.json") == 2
    assert main(["--cultivar", "WR", "--photons", "500", "--out", str(tmp_path / "absent")]) == 1
    assert "absent" in capsys.readouterr().err


@pytest.mark.slow
@each
def test_a_row_traced_anew_agrees_with_the_table(table: PetalTable) -> None:
    # A twentieth of the photons: with much fewer, the rare bright photons of BR leave the batches far from normal.
    mean, error = mean_and_error(f_r_batches(trace_node(table.name, 45.0, table.photons // 20, seed=1), 45.0))
    row = table.theta_i.tolist().index(45)
    z = (mean - table.f_r_nodes[row]) / np.hypot(error, table.standard_error[row])
    assert np.abs(z).max() < 5
    # A photon is seen from several neighbouring views, so that about a quarter of the 35 are independent.
    assert np.mean(z**2) < 1 + 5 * math.sqrt(2 / (z.size / 4))
