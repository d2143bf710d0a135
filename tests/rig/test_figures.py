"""The demo as a whole, and what its figures say."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]  # the first kernels of a new installation are compiled by the demo
NUMBERS = (1, 2, 6, 7, 8, 9)
POINTS, SIZE = 3000, 200


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    import subprocess
    import sys

    from tests.conftest import rig_environment

    folder = tmp_path_factory.mktemp("demo")
    small = ("--petals", "5", "--points", str(POINTS), "--size", str(SIZE), "--samples", "1")
    done = subprocess.run([sys.executable, "-m", "rig", "demo", *small], cwd=folder, env=rig_environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "rig-data", done.stdout


def texts(svg: Path) -> str:
    """Return all text of a figure without spaces: formulas are set letter by letter."""
    return "".join("".join("".join(element.itertext()) for element in ET.parse(svg).iter("{http://www.w3.org/2000/svg}text")).split())


def test_the_closing_table_names_x_and_e_of_every_cultivar_and_where_all_lies(demo: tuple[Path, str]) -> None:
    workspace, said = demo
    coefficients = said.split("E, 1.9:")[0]
    rows = {words[0]: words for line in coefficients.splitlines() if (words := line.split()) and words[0] in ("BR", "RR", "PR", "WR")}
    assert list(rows) == ["BR", "RR", "PR", "WR"]
    assert "SIMULATED" in said
    for folder in ("runs", "fits", "figures"):
        assert re.search(rf"^{folder} +rig-data/{folder}$", said, re.MULTILINE)
    stored = {fit["label"]: fit for fit in (json.loads(path.read_text()) for path in (workspace / "fits").glob("*.json"))}
    for label, words in rows.items():
        assert [float(word) for word in words[1:7]] == pytest.approx(
            [*stored[label]["x"].values(), stored[label]["E_mean"], stored[label]["E_max"]], rel=1e-3
        )


def test_the_papers_phenomenon_is_in_the_readings(demo: tuple[Path, str]) -> None:
    _, said = demo
    ratios = [float(re.search(rf"^{label} .* ([\d.]+) +20", said, re.MULTILINE)[1]) for label in ("BR", "RR", "PR", "WR")]  # type: ignore[index]
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[0] > 1.5
    assert ratios[-1] < 1


@pytest.mark.parametrize("number", NUMBERS)
def test_every_plot_of_simulated_readings_says_so(demo: tuple[Path, str], number: int) -> None:
    workspace, _ = demo
    said = texts(workspace / "figures" / f"figure-{number}.svg")
    assert ("SIMULATED" in said) is (number != 6)  # figure 6 is the model alone
    assert (workspace / "figures" / f"figure-{number}.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (1, ("BR", "RR", "scale 40")),
        (2, ("PR", "WR", "scale 400")),
        (6, ("x5",)),
        (8, ("BR model", "scale 40")),
        (9, ("WR measured", "scale 400")),
    ],
)
def test_the_figures_are_the_papers(demo: tuple[Path, str], number: int, words: tuple[str, ...]) -> None:
    workspace, _ = demo
    said = texts(workspace / "figures" / f"figure-{number}.svg")
    for word in words:
        assert word.replace(" ", "") in said


def test_the_demo_goes_on_to_a_rose_that_nobody_put_together(demo: tuple[Path, str]) -> None:
    import cv2

    workspace, said = demo
    assembled = json.loads((workspace / "flowers" / "demo" / "assembly.json").read_text())
    assert assembled["state"] == "free"
    assert len(assembled["petals"]) == 5
    assert f"no two petals intersect; clearance {assembled['clearance_mm']:.3f} mm" in said
    scanned = [int(points) for points in re.findall(r"^P0\d +(\d{4}) +\d{4} ", said, re.MULTILINE)]
    assert scanned == pytest.approx([POINTS] * 5, rel=0.05)
    assert cv2.imread(str(workspace / "figures" / "rose.png")).shape == (SIZE, SIZE, 3)
    for name in ("figure-11.png", "figure-13.png", "figure-14.png", "rose.png"):
        picture = cv2.imread(str(workspace / "figures" / name))
        # More than paper or background: a good part of the picture is something else than its commonest colour.
        colours, counts = np.unique(picture.astype(np.uint32) @ (1, 256, 65536), return_counts=True)
        assert counts.max() < 0.9 * counts.sum()
        assert len(colours) > 100


def test_figure_14_stands_beside_the_readings(demo: tuple[Path, str]) -> None:
    _, said = demo
    rows = re.findall(r"^(BR|RR|PR|WR) +([\d.]+) +([\d.]+) +([\d.]+) +([\d.]+) +([\d.]+)$", said, re.MULTILINE)
    assert [row[0] for row in rows] == ["BR", "RR", "PR", "WR"]
    ratios = [float(re.search(rf"^{row[0]} .* ([\d.]+) +20", said, re.MULTILINE)[1]) for row in rows]  # type: ignore[index]
    assert [float(row[1]) for row in rows] == ratios
    C = {row[0]: float(row[3]) for row in rows}
    assert C["WR"] < min(C["BR"], C["RR"], C["PR"])  # the glossy petal
