"""The flower folder: from petals on disk to assembly.json."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scanning.contact import Sheet
from scanning.flower import FlowerError, load, new, petal_names, put_together, read_poses
from scanning.placement import PlacementError, write
from scanning.poses import moved
from tests.conftest import ROOT
from tests.scanning_flower import nested


def write_ply(path: Path, sheet: Sheet) -> None:
    head = ["ply", "format ascii 1.0", f"element vertex {len(sheet.vertices)}", *(f"property double {axis}" for axis in "xyz")]
    head += [f"element face {len(sheet.triangles)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(repr, row)) for row in sheet.vertices.tolist()] + [f"3 {a} {b} {c}" for a, b, c in sheet.triangles.tolist()]
    path.write_text("\n".join(head + rows) + "\n")


def write_flower(folder: Path, flower: nested.Nested) -> None:
    new(folder, "nested", simulated=True)
    write(folder / "placement.toml", flower.placement)
    for k, name in enumerate(flower.placement.petals):
        where = folder / "petals" / name
        where.mkdir()
        write_ply(where / "mesh.ply", flower.sheets[k])
        frame = flower.T_scan_petal[k]
        direction = (frame[:3, :3] @ flower.inflection[k]).tolist()
        text = f"T_scan_petal = {frame.tolist()}\n[inflection]\npoint = [0.0, 0.0, 0.0]\ndirection = {direction}\n"
        (where / "petal.toml").write_text(text)


def test_a_flower_on_disk_is_put_together_and_written(tmp_path: Path) -> None:
    flower = nested.grow(5, 2)
    write_flower(tmp_path, flower)
    assert petal_names(tmp_path) == list(flower.placement.petals)
    petals, _ = load(tmp_path)
    np.testing.assert_allclose(petals[3].sheet.vertices, flower.sheets[3].vertices, atol=1e-9)
    np.testing.assert_allclose([petal.inflection for petal in petals], flower.inflection, atol=1e-9)
    found = put_together(tmp_path, seed=3)
    table = json.loads((tmp_path / "assembly.json").read_text())
    assert (table["state"], table["seed"], table["clearance_mm"]) == (found.state, 3, found.clearance)
    assert found.state == "free"
    poses = read_poses(tmp_path / "assembly.json")
    np.testing.assert_array_equal(np.array([poses[name] for name in found.names]), found.poses)


def test_what_is_missing_or_wrong_is_said(tmp_path: Path) -> None:
    with pytest.raises(FlowerError, match="Import scans first"):
        load(tmp_path)
    write_flower(tmp_path, nested.grow(5, 2))
    with pytest.raises(FlowerError, match="there is a flower already"):
        new(tmp_path, "again")
    (tmp_path / "petals" / "P02" / "petal.toml").write_text("T_scan_petal = 3\n[inflection]\ndirection = [0.0, 1.0, 0.0]\n")
    with pytest.raises(FlowerError, match=r"P02.petal.toml.*not a rigid transform"):
        load(tmp_path)
    (tmp_path / "petals" / "P01" / "mesh.ply").unlink()
    with pytest.raises(PlacementError, match=r"placement.toml:\d+: P01 has no mesh"):
        load(tmp_path)
    (tmp_path / "assembly.json").write_text('{"petals": {"P01": {}}}')
    with pytest.raises(FlowerError, match="Assemble the flower again"):
        read_poses(tmp_path / "assembly.json")


@pytest.mark.slow
def test_a_virtual_rose_is_scanned_measured_and_put_together(tmp_path: Path) -> None:
    from scanning.imports import import_scans

    command = [sys.executable, "-m", "sim.rose", "--petals", "5", "--seed", "3", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
    truth = json.loads((tmp_path / "truth.json").read_text())
    bases = {name: petal["base"][:2] for name, petal in truth["petals"].items()}
    import_scans(sorted(tmp_path.glob("*.abs")), tmp_path, simulated=True, pictures=False, bases=bases)
    found = put_together(tmp_path)
    assert found.state == "free"
    assert found.clearance > 0.05
    true = [np.array(truth["petals"][name]["T_flower_scan"]) for name in found.names]
    scans, placement = load(tmp_path)
    assert set(placement.inside_of()) <= set(found.pairs)
    away = [
        np.sqrt(((moved(t, s.sheet.vertices) - moved(f, s.sheet.vertices)) ** 2).sum(1).mean())
        for t, f, s in zip(true, found.poses, scans, strict=True)
    ]
    assert np.median(away) < 3.0  # mm: 3 deg at the end of a petal of 45 mm is 2.4
