"""From files to a flower folder."""

import hashlib
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from scanning import ImportFailed, PetalError, ScanError, import_scans
from scanning.formats.abs import write_abs
from scanning.formats.ply import read_mesh
from scanning.mesh import area_vectors, boundary_loops
from tests.conftest import ROOT
from tests.scanning.surfaces import petal_scan, scan


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two petals, a leaf without a claw and a file that is cut off."""
    folder = tmp_path_factory.mktemp("scans")
    for name, angle in (("P01", 0.0), ("P02", 70.0)):
        write_abs(folder / f"{name}.abs", petal_scan(angle, noise=0.05, quantum=0.3))
    write_abs(folder / "leaf.abs", scan(lambda x, y: 0.01 * x**2, lambda x, y: (x / 10) ** 2 + (y / 18) ** 2 < 1))
    (folder / "cut.abs").write_bytes((folder / "P01.abs").read_bytes()[:2000])
    return folder


def test_a_flower_folder(scans: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int, str]] = []
    files = [scans / "P01.abs", scans / "P02.abs"]
    results = import_scans(
        files, tmp_path / "rose", simulated=True, source='seed 3, "virtual"', pictures=False, progress=lambda *step: seen.append(step)
    )
    assert seen == [(0, 2, "P01"), (1, 2, "P02"), (2, 2, "")]
    flower = tomllib.loads((tmp_path / "rose" / "flower.toml").read_text())
    assert flower == {"name": "rose", "simulated": True, "units": "mm", "source": 'seed 3, "virtual"'}
    assert sorted(p.name for p in (tmp_path / "rose" / "petals").iterdir()) == ["P01", "P02"]
    for result, file in zip(results, files, strict=True):
        mesh = read_mesh(result.folder / "mesh.ply")
        np.testing.assert_allclose(mesh.vertices, result.mesh.vertices, atol=1e-5)
        assert (area_vectors(mesh)[:, 2] > 0).all()
        assert len(boundary_loops(mesh.triangles)) == 1
        assert b"SIMULATED" in (result.folder / "mesh.ply").read_bytes()[:400]
        written = tomllib.loads((result.folder / "petal.toml").read_text())
        np.testing.assert_array_equal(written["T_scan_petal"], result.petal.T_scan_petal)
        np.testing.assert_array_equal(written["base"], result.petal.base)
        np.testing.assert_array_equal(written["tip"], result.petal.tip)
        np.testing.assert_array_equal(written["inflection"]["point"], result.petal.inflection)
        np.testing.assert_array_equal(written["inflection"]["direction"], result.petal.direction)
        assert written["quality"]["points"] == len(mesh.vertices)
        assert written["quality"]["quantum_mm"] == pytest.approx(0.3)
        assert written["provenance"]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_the_same_files_give_the_same_bytes(scans: Path, tmp_path: Path) -> None:
    for flower in ("one", "two"):
        import_scans([scans / "P01.abs"], tmp_path / flower, name="rose", pictures=False)
    for file in ("petals/P01/mesh.ply", "petals/P01/petal.toml", "flower.toml"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_what_fails_does_not_stop_the_others_and_is_not_hidden(scans: Path, tmp_path: Path) -> None:
    with pytest.raises(ImportFailed, match=r"cut\.abs(.|\n)*petal leaf\).*--base") as caught:
        import_scans([scans / "cut.abs", scans / "leaf.abs", scans / "P01.abs"], tmp_path, pictures=False)
    assert len(caught.value.errors) == 2
    assert [p.name for p in (tmp_path / "petals").iterdir()] == ["P01"]
    with pytest.raises(PetalError, match="--base"):
        import_scans([scans / "leaf.abs"], tmp_path, pictures=False)
    (result,) = import_scans([scans / "leaf.abs"], tmp_path, pictures=False, bases={"leaf": (0.0, -18.0)})
    assert result.petal.base[1] == pytest.approx(-18, abs=0.6)


def test_a_failed_import_leaves_the_petal_that_was_there(scans: Path, tmp_path: Path) -> None:
    import_scans([scans / "P01.abs"], tmp_path / "f", pictures=False)
    before = (tmp_path / "f" / "petals" / "P01" / "petal.toml").read_bytes()
    (tmp_path / "P01.abs").write_bytes((scans / "cut.abs").read_bytes())
    with pytest.raises(ScanError):
        import_scans([tmp_path / "P01.abs"], tmp_path / "f", pictures=False)
    assert (tmp_path / "f" / "petals" / "P01" / "petal.toml").read_bytes() == before


def test_nothing_is_written_where_names_clash(scans: Path, tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="several scans are called P01"):
        import_scans([scans / "P01.abs", tmp_path / "P01.ply"], tmp_path / "f")
    with pytest.raises(ScanError, match="no scans"):
        import_scans([], tmp_path / "f")
    with pytest.raises(PetalError, match="P09"):
        import_scans([scans / "P01.abs"], tmp_path / "f", bases={"P09": (0, 0)})
    with pytest.raises(ScanError, match="cannot be the name"):
        import_scans([tmp_path / "my petal.abs"], tmp_path / "f")
    assert not (tmp_path / "f").exists()


@pytest.mark.slow
def test_a_picture_is_drawn(scans: Path, tmp_path: Path) -> None:
    from matplotlib.image import imread

    (result,) = import_scans([scans / "P01.abs"], tmp_path, simulated=True)
    picture = imread(result.folder / "picture.png")
    assert picture.shape[0] > 300
    assert len(np.unique((picture[..., :3] * 255).astype(int).reshape(-1, 3), axis=0)) > 100


def test_plain_import_is_light() -> None:
    code = "import sys, scanning, scanning.imports, scanning.petal, scanning.register; " + (
        "print([m for m in ('open3d', 'numba', 'matplotlib', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"
