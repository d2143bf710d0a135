"""The folder of files, read back by readers written here."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sim.rose import RoseError, grow, measure, write_specimen
from tests.conftest import ROOT


def read_abs(path: Path) -> tuple[np.ndarray, np.ndarray]:
    lines = path.read_text(encoding="ascii").splitlines()
    rows, columns = int(lines[0].removesuffix(" rows")), int(lines[1].removesuffix(" columns"))
    assert lines[2] == "pixels (flag X Y Z):"
    assert len(lines) == 7
    flags, *coordinates = (np.array(line.split(" "), dtype=float).reshape(rows, columns) for line in lines[3:])
    return flags, np.stack(coordinates, axis=-1)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    n, m = (int(line.split()[-1]) for line in header.decode().splitlines() if line.startswith("element"))
    faces = np.frombuffer(body, dtype=[("n", "u1"), ("v", "<i4", 3)], offset=12 * n)
    assert len(faces) == m
    assert (faces["n"] == 3).all()
    return np.frombuffer(body, dtype="<f4", count=3 * n).reshape(n, 3).astype(float), faces["v"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rose") / "six"
    write_specimen(path, 6, 0.4, 3, triangles=5000)
    return path


def test_the_range_images_follow_the_format(folder: Path) -> None:
    for path in sorted(folder.glob("*.abs")):
        flags, points = read_abs(path)
        assert set(np.unique(flags)) == {0.0, 1.0}
        assert 9_000 <= flags.sum() <= 13_000
        assert (points[flags == 0] == -999999.0).all()
        assert np.abs(points[flags == 1]).max() < 60
        assert "-999999.000000" in path.read_text(encoding="ascii")
        # x grows along a row, y falls down the rows.
        x, y = (np.where(flags == 1, points[..., axis], np.nan) for axis in (0, 1))
        assert np.nanmax(x[:, :80]) < np.nanmax(x)
        assert np.nanmedian(np.diff(x, axis=1)) > 0
        assert np.nanmedian(np.diff(y, axis=0)) < 0


def test_the_true_transforms_put_the_scans_onto_the_flower(folder: Path) -> None:
    from scipy.spatial import cKDTree

    rose = grow(6, opening=0.4, seed=3, triangles=5000)
    truth = json.loads((folder / "truth.json").read_text())
    assert list(truth["petals"]) == truth["order"] == [petal.name for petal in rose.petals]
    for petal in rose.petals:
        true = truth["petals"][petal.name]
        transform = np.array(true["T_flower_scan"])
        assert transform[:3, :3] @ transform[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)

        flags, points = read_abs(folder / true["scan"])
        placed = points[flags == 1] @ transform[:3, :3].T + transform[:3, 3]
        _, index = cKDTree(petal.mesh.vertices).query(placed)
        off = np.einsum("ij,ij->i", placed - petal.mesh.vertices[index], petal.mesh.vertex_normals()[index])
        assert np.median(np.abs(off)) < 0.13
        assert np.mean(np.abs(off) < 0.45) > 0.97

        vertices, faces = read_ply(folder / true["mesh"])
        assert vertices @ transform[:3, :3].T + transform[:3, 3] == pytest.approx(petal.mesh.vertices, abs=1e-5)
        assert (faces == petal.mesh.faces).all()
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        assert np.cross(b - a, c - a).sum(axis=0)[2] > 0  # towards the sensor

        base, inflection, tip = (np.array(true[key]) @ transform[:3, :3].T + transform[:3, 3] for key in ("base", "inflection", "tip"))
        assert np.degrees(np.arctan2(base[1], base[0])) % 360 == pytest.approx(true["azimuth"], abs=1e-6)
        assert np.hypot(*base[:2]) == pytest.approx(true["base_radius"], abs=1e-6)
        assert base[2] == pytest.approx(true["base_height"], abs=1e-6)
        assert np.linalg.norm(inflection - base) < np.linalg.norm(tip - base)


def test_the_placement_is_the_truth_within_its_errors(folder: Path) -> None:
    placement = tomllib.loads((folder / "placement.toml").read_text(encoding="utf-8"))
    truth = json.loads((folder / "truth.json").read_text())["petals"]
    assert set(placement) == {"flower", "petals"}
    assert set(placement["flower"]) == {"name"}
    assert sorted(placement["petals"]) == sorted(truth)
    for name, measured in placement["petals"].items():
        assert measured["left"] == truth[name]["left"]
        assert measured["right"] == truth[name]["right"]
        assert measured["stem_angle_u"] == measured["azimuth_u"] == 3.0
        assert measured["base_u"] == 1.0
        assert set(measured) == {
            *("left", "right", "stem_angle", "stem_angle_u", "azimuth", "azimuth_u", "base_radius", "base_height", "base_u")
        }


def test_errors_of_the_placement_have_the_spread_asked_for() -> None:
    rose = grow(12, opening=0.8, seed=2, triangles=800)
    off = []
    for seed in range(120):
        for petal, placed in zip(rose.petals, measure(rose, seed=seed, angle_sd=2.0, base_sd=0.5), strict=True):
            turned = (placed.azimuth - petal.form.azimuth + 180) % 360 - 180
            off.append((placed.stem_angle - petal.form.stem_angle, turned, placed.base_height - petal.form.base_height))
    spread, mean = np.std(off, axis=0), np.mean(off, axis=0)
    assert spread == pytest.approx([2.0, 2.0, 0.5], rel=0.08)
    assert mean == pytest.approx([0, 0, 0], abs=0.25)
    exact = measure(rose, angle_sd=0.0, base_sd=0.0)
    assert [placed.stem_angle for placed in exact] == [petal.form.stem_angle for petal in rose.petals]
    with pytest.raises(RoseError, match="-1"):
        measure(rose, base_sd=-1)


def test_the_same_seed_writes_the_same_files_and_another_seed_others(folder: Path, tmp_path: Path) -> None:
    write_specimen(tmp_path / "again", 6, 0.4, 3, triangles=5000)
    write_specimen(tmp_path / "other", 6, 0.4, 4, triangles=5000)
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "again").iterdir())
    assert len(names) == 6 + 6 + 2
    for name in names:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()
        assert (tmp_path / "other" / name).read_bytes() != (folder / name).read_bytes()


@pytest.mark.slow
def test_the_command_writes_a_specimen_and_refuses_what_cannot_be(tmp_path: Path) -> None:
    def run(petals: str) -> subprocess.CompletedProcess[str]:
        command = [
            sys.executable,
            "-m",
            "sim.rose",
            "--petals",
            petals,
            "--triangles",
            "800",
            "--no-meshes",
            "--out",
            str(tmp_path / petals),
        ]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)

    done = run("5")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "5").iterdir()) == [
        *(f"P0{k}.abs" for k in range(1, 6)),
        "placement.toml",
        "truth.json",
    ]
    refused = run("3")
    assert refused.returncode == 1
    assert "5 to 45" in refused.stderr
    assert "Traceback" not in refused.stderr
