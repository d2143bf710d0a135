"""Meshes, their normals and placement, and the flower's folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from render import Mesh, RenderError, Scene, read_flower, read_mesh

from .conftest import sheet, sphere


def placement(degrees: float, axis: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * degrees, degrees=True).as_matrix()
    T[:3, 3] = shift
    return T


def test_normals_of_a_sphere_point_from_its_middle() -> None:
    ball = sphere(rows=60)
    apart = np.abs(ball.vertices[:, 2]) < 9.9  # each pole is many vertices on one place
    np.testing.assert_allclose(ball.normals[apart], ball.vertices[apart] / 10, atol=2e-3)
    np.testing.assert_allclose(ball.normals[~apart], ball.vertices[~apart] / 10, atol=0.03)


def test_normals_are_those_of_another_library() -> None:
    random = np.random.default_rng(2)
    tile = sheet("tile", 0, 10, steps=9)
    rough = Mesh("rough", tile.vertices + random.normal(0, 0.8, tile.vertices.shape), tile.triangles)
    theirs = trimesh.Trimesh(rough.vertices, rough.triangles, process=False)
    weights = trimesh.geometry.weighted_vertex_normals(len(rough.vertices), theirs.faces, theirs.face_normals, theirs.face_angles)
    np.testing.assert_allclose(rough.normals, weights, atol=1e-9)


def test_vertices_without_area_have_no_normal() -> None:
    mesh = Mesh("one", np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [2, 0, 0]], float), np.array([[0, 1, 2], [0, 1, 4]]))
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]])


@settings(max_examples=20)
@given(degrees=st.floats(-180, 180), shift=st.tuples(*[st.floats(-100, 100)] * 3))
def test_normals_turn_with_the_mesh(degrees: float, shift: tuple[float, float, float]) -> None:
    T = placement(degrees, (1, 2, -1), shift)
    ball = sphere(rows=6)
    moved = ball.moved(T)
    np.testing.assert_allclose(moved.normals, ball.normals @ T[:3, :3].T, atol=1e-9)
    np.testing.assert_allclose(moved.vertices.mean(axis=0), ball.vertices.mean(axis=0) @ T[:3, :3].T + shift, atol=1e-9)


@pytest.mark.parametrize("T", [np.eye(3), np.diag([1, 1, -1, 1]), np.diag([2, 2, 2, 1]), np.ones((4, 4))])
def test_placements_that_are_not_rigid(T: np.ndarray) -> None:
    with pytest.raises(RenderError, match="not a rigid transform"):
        sheet("P01", 0, 1).moved(T)


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (np.zeros((3, 2)), np.zeros((1, 3), int), "expected"),
        (np.zeros((3, 3)), np.zeros((0, 3), int), "expected"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "3 vertices are not finite"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), "0 to 2"),
        (np.zeros((3, 3)), np.array([[0, 1, -1]]), "0 to 2"),
        (np.zeros((3, 3)), np.array([[0, 1, 0.5]]), "whole numbers"),
    ],
)
def test_meshes_that_are_none(vertices: np.ndarray, triangles: np.ndarray, message: str) -> None:
    with pytest.raises(RenderError, match=message):
        Mesh("P01", vertices, triangles)


def test_a_scene_joins_its_meshes() -> None:
    scene = Scene((sheet("a", 0, 1), sheet("b", 5, 1, steps=3)))
    np.testing.assert_array_equal(scene.owner, [0] * 2 + [1] * 8)
    assert np.all(scene.vertices[scene.triangles[scene.owner == 1]][..., 2] == 5)
    assert scene.size == pytest.approx(np.sqrt(4 + 4 + 25))
    with pytest.raises(RenderError, match="at least one mesh"):
        Scene(())


def flower(folder: Path) -> dict[str, np.ndarray]:
    """A flower of two petals, written by another library; returns the placements."""
    placed = {"P01": placement(30, (0, 0, 1), (1, 2, 3)), "P02": placement(-80, (1, 1, 0), (0, 0, 7))}
    for name in placed:
        tile = sheet(name, 0, 4, steps=4)
        path = folder / "petals" / name / "mesh.ply"
        path.parent.mkdir(parents=True)
        trimesh.Trimesh(tile.vertices, tile.triangles, process=False).export(path)
    petals = {name: {"T_flower_scan": T.tolist(), "azimuth": 0.0} for name, T in reversed(placed.items())}
    (folder / "assembly.json").write_text(json.dumps({"state": "free", "petals": petals}))
    return placed


def test_a_flower_is_read_with_its_petals_in_place(tmp_path: Path) -> None:
    placed = flower(tmp_path)
    scene = read_flower(tmp_path)
    assert [mesh.name for mesh in scene.meshes] == ["P01", "P02"]
    for mesh in scene.meshes:
        tile, T = sheet(mesh.name, 0, 4, steps=4), placed[mesh.name]
        np.testing.assert_allclose(mesh.vertices, tile.vertices @ T[:3, :3].T + T[:3, 3], atol=1e-5)
        np.testing.assert_array_equal(mesh.triangles, tile.triangles)


def test_flowers_that_are_not_whole(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match="not assembled yet"):
        read_flower(tmp_path)
    flower(tmp_path)
    (tmp_path / "petals/P02/mesh.ply").unlink()
    with pytest.raises(RenderError, match=r"P02.mesh\.ply: no such mesh"):
        read_flower(tmp_path)
    for text in ("{", "[]", '{"petals": {"P01": {}}}', '{"petals": 3}'):
        (tmp_path / "assembly.json").write_text(text)
        with pytest.raises(RenderError, match="expected petals"):
            read_flower(tmp_path)


def test_files_that_hold_no_triangles(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_text("not a mesh\n")
    with pytest.raises(RenderError, match="no triangles"):
        read_mesh(path)
