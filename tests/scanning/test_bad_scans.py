"""What is wrong with a scan is said in one plain line by `rig scan import`, which then exits with 1."""

import gzip
import re
from pathlib import Path

import numpy as np
import pytest

from rig.cli.main import main
from scanning.formats.abs import write_abs
from scanning.rangeimage import RangeImage
from tests.scanning.surfaces import petal_scan, scan


@pytest.fixture(scope="module")
def petal() -> RangeImage:
    return petal_scan(20.0, noise=0.05, quantum=0.3)


@pytest.fixture(scope="module")
def whole(petal: RangeImage, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Bytes of a good scan of 150 rows and 120 columns."""
    path = tmp_path_factory.mktemp("whole") / "P07.abs"
    write_abs(path, RangeImage(petal.points[25:175, 40:160], petal.valid[25:175, 40:160]))
    return path.read_bytes()


def changed(whole: bytes, line: int, change: str) -> bytes:
    """The scan with its first valid value of a line (from 1) replaced."""
    lines = whole.split(b"\n")
    first = lines[3].split().index(b"1")
    words = lines[line - 1].split()
    words[first] = change.encode()
    lines[line - 1] = b" ".join(words)
    return b"\n".join(lines)


def said(tmp_path: Path, capsys: pytest.CaptureFixture[str], *options: str, name: str = "P07.abs") -> str:
    """What the command says of a scan it refuses."""
    with pytest.raises(SystemExit) as left:
        main(["scan", "import", str(tmp_path / name), "--flower", str(tmp_path / "rose"), *options])
    assert left.value.code == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = [line for line in printed.err.splitlines() if line.startswith("rig: ")]
    assert len(lines) == 1
    assert "Traceback" not in printed.err
    assert str(tmp_path / name) in lines[0]
    assert not list((tmp_path / "rose" / "petals").glob("*"))
    return lines[0]


@pytest.mark.parametrize(
    ("kept", "line", "problem"),
    [(0.0, 1, "header is ''"), (0.1, 5, "lines of values"), (0.5, 6, "lines of values"), (0.9999, 7, "values of Z")],
)
def test_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: bytes, kept: float, line: int, problem: str) -> None:
    (tmp_path / "P07.abs").write_bytes(whole[: int(kept * len(whole))])
    text = said(tmp_path, capsys)
    assert f"P07.abs, line {line}: " in text
    assert problem in text


def test_swapped(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: bytes) -> None:
    (tmp_path / "P07.abs").write_bytes(whole.replace(b"150 rows\n120 columns", b"120 rows\n150 columns"))
    text = said(tmp_path, capsys)
    assert "P07.abs, line 1: rows and columns seem swapped" in text
    assert "Exchange the numbers of lines 1 and 2" in text


def test_nothing_valid(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: bytes) -> None:
    lines = whole.split(b"\n")
    lines[3] = lines[3].replace(b"1", b"0")
    (tmp_path / "P07.abs").write_bytes(b"\n".join(lines))
    assert "line 4: none of the 18000 points is valid. Scan again" in said(tmp_path, capsys)


def test_nothing_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    write_abs(tmp_path / "P07.abs", scan(lambda x, y: 50 * rng.standard_normal(x.shape), size=40))
    assert "points are left after removing" in said(tmp_path, capsys)


@pytest.mark.parametrize("token", ["nan", "inf", "-inf", "1e400", "1e30", "-999999.000000"])
def test_no_place_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: bytes, token: str) -> None:
    (tmp_path / "P07.abs").write_bytes(changed(whole, 6, token))
    text = said(tmp_path, capsys)
    assert "P07.abs, line 6: point " in text
    assert "is valid but its Y is" in text


def test_words_among_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: bytes) -> None:
    (tmp_path / "P07.abs").write_bytes(changed(whole, 7, "deep"))
    assert "line 7: 'deep' where a number should be" in said(tmp_path, capsys)


def test_a_packed_file_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str], whole: bytes) -> None:
    packed = gzip.compress(whole)
    (tmp_path / "P07.abs.gz").write_bytes(packed[: len(packed) // 2])
    assert "cannot be read" in said(tmp_path, capsys, name="P07.abs.gz")
    (tmp_path / "P07.abs.gz").write_bytes(gzip.compress(whole[: len(whole) // 2]))
    assert "P07.abs.gz, line 6: " in said(tmp_path, capsys, name="P07.abs.gz")


@pytest.mark.slow
def test_no_base(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_abs(tmp_path / "P07.abs", scan(lambda x, y: 0.01 * x**2, lambda x, y: (x / 10) ** 2 + (y / 18) ** 2 < 1))
    text = said(tmp_path, capsys)
    assert "(petal P07): the base cannot be told" in text
    assert "--base P07=X,Y" in text
    assert re.search(r"\(petal P07\): the base given, 0,0, lies (9\.\d+|10) mm from the rim", said(tmp_path, capsys, "--base", "P07=0,0"))
    assert "P09: a base is given for it, but it is not among the scans; expected one of P07" in left_out(tmp_path, capsys)
    with pytest.raises(SystemExit) as left:
        main(["scan", "import", str(tmp_path / "P07.abs"), "--flower", str(tmp_path / "rose"), "--base", "P07=0,-18"])
    assert left.value.code == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("P07 ")


def left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What is said of a base for a petal that is not there."""
    with pytest.raises(SystemExit) as left:
        main(["scan", "import", str(tmp_path / "P07.abs"), "--flower", str(tmp_path / "rose"), "--base", "P09=0,0"])
    assert left.value.code == 1
    return capsys.readouterr().err
