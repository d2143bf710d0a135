"""What is pictured: triangle meshes in one frame, smooth by their vertex normals."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import RenderError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SLIVER = 1e-7
"""A triangle less high than this fraction of its length has no normal."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """An open or closed sheet of triangles.

    Parameters
    ----------
    name : str
        What errors and pictures call it.
    vertices : ndarray, shape (v, 3), mm
    triangles : ndarray of int, shape (t, 3)
        Counter-clockwise seen from the side of the inner face.

    Raises
    ------
    RenderError
        If a shape is wrong, a coordinate is not finite or a triangle names no vertex.
    """

    name: str
    vertices: Array
    triangles: Indices

    def __post_init__(self) -> None:
        vertices, triangles = np.asarray(self.vertices, float), np.asarray(self.triangles)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
            raise RenderError(
                f"mesh {self.name}: vertices {vertices.shape} and triangles {triangles.shape}; expected (v, 3) and (t, 3), t above 0"
            )
        if not np.isfinite(vertices).all():
            raise RenderError(
                f"mesh {self.name}: {int((~np.isfinite(vertices)).any(axis=1).sum())} vertices are not finite: clean it first"
            )
        if not np.issubdtype(triangles.dtype, np.integer) or triangles.min() < 0 or triangles.max() >= len(vertices):
            raise RenderError(f"mesh {self.name}: triangles must hold whole numbers from 0 to {len(vertices) - 1}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles.astype(np.int64))

    def moved(self, T_target_source: ArrayLike) -> Mesh:
        """Bring the mesh to another frame.

        Parameters
        ----------
        T_target_source : array_like, shape (4, 4)
            Rigid transform, p_target = T p_source, eq. (14).

        Raises
        ------
        RenderError
            If it is not a rigid transform.
        """
        T = np.asarray(T_target_source, float)
        if (
            T.shape != (4, 4)
            or not np.allclose(T[3], (0, 0, 0, 1))
            or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
            or np.linalg.det(T[:3, :3]) < 0
        ):
            raise RenderError(
                f"mesh {self.name}: its placement is not a rigid transform (4 x 4: rotation, translation, 0 0 0 1): {T.tolist()}"
            )
        return Mesh(self.name, self.vertices @ T[:3, :3].T + T[:3, 3], self.triangles)

    @cached_property
    def normals(self) -> Array:
        """Unit vertex normals, the mean over the triangles about a vertex weighted by their angle there; shape (v, 3).

        Zero where no triangle, or only slivers without area, meet: their own normals are but rounding.
        """
        corners = self.vertices[self.triangles]
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        longest2 = np.max(np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=-1), axis=1)
        face = _unit(np.where((np.linalg.norm(doubled, axis=1) > SLIVER * longest2)[:, None], doubled, 0.0))
        out = np.zeros_like(self.vertices)
        for corner in range(3):
            a, b = (_unit(corners[:, (corner + k) % 3] - corners[:, corner]) for k in (1, 2))
            angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
            for axis in range(3):
                out[:, axis] += np.bincount(self.triangles[:, corner], angle * face[:, axis], len(out))
        return _unit(out)


@dataclass(frozen=True, eq=False)
class Scene:
    """Meshes in one frame, mm.

    Parameters
    ----------
    meshes : tuple of Mesh
        One or more.

    Raises
    ------
    RenderError
        If there is none.
    """

    meshes: tuple[Mesh, ...]

    def __post_init__(self) -> None:
        if not self.meshes:
            raise RenderError("a scene needs at least one mesh")

    @cached_property
    def vertices(self) -> Array:
        """All vertices, mesh by mesh; shape (v, 3), mm."""
        return np.concatenate([mesh.vertices for mesh in self.meshes])

    @cached_property
    def normals(self) -> Array:
        """Their unit normals, shape (v, 3)."""
        return np.concatenate([mesh.normals for mesh in self.meshes])

    @cached_property
    def triangles(self) -> Indices:
        """All triangles as rows of `vertices`, shape (t, 3)."""
        first = np.cumsum([0] + [len(mesh.vertices) for mesh in self.meshes[:-1]])
        return np.concatenate([mesh.triangles + start for mesh, start in zip(self.meshes, first, strict=True)])

    @cached_property
    def owner(self) -> NDArray[np.int32]:
        """Which of `meshes` each triangle belongs to, shape (t,)."""
        return np.repeat(np.arange(len(self.meshes), dtype=np.int32), [len(mesh.triangles) for mesh in self.meshes])

    @cached_property
    def size(self) -> float:
        """Diagonal of the box about the scene, mm."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


def read_mesh(path: str | Path, name: str | None = None) -> Mesh:
    """Read a triangle mesh from a .ply file.

    Raises
    ------
    RenderError
        If there is no such file or it holds no triangles.
    """
    import open3d

    path = Path(path)
    if not path.is_file():
        raise RenderError(f"{path}: no such mesh; expected a .ply file of triangles")
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(path)
    if not mesh.has_triangles():
        raise RenderError(
            f"{path}: no triangles in it (or not a mesh at all); expected a .ply file of triangles, as the scan of a petal leaves it"
        )
    return Mesh(name or path.stem, np.asarray(mesh.vertices), np.asarray(mesh.triangles))


def read_flower(folder: str | Path) -> Scene:
    """Read an assembled flower: `assembly.json` and each petal's `petals/NAME/mesh.ply`.

    Returns
    -------
    Scene
        In the flower's frame (z up along the stem), petals in the order of their names.

    Raises
    ------
    RenderError
        If the flower is not assembled yet or a file is missing or malformed.
    """
    folder = Path(folder)
    table = _assembly(folder)
    try:
        placed = {str(name): petal["T_flower_scan"] for name, petal in sorted(table["petals"].items())}
    except (KeyError, TypeError, AttributeError) as error:
        raise RenderError(
            f"{folder / 'assembly.json'}: expected petals, each with its T_flower_scan ({type(error).__name__}: {error}): assemble again"
        ) from error
    return Scene(tuple(_placed(folder, placed)))


def read_state(folder: str | Path) -> str:
    """Return the state of an assembled flower: "free" where no two petals intersect.

    Raises
    ------
    RenderError
        If the flower is not assembled yet or its state is not told.
    """
    state = _assembly(Path(folder)).get("state")
    if not isinstance(state, str):
        raise RenderError(f"{Path(folder) / 'assembly.json'}: does not tell its state: assemble again")
    return state


def _assembly(folder: Path) -> dict[str, Any]:
    path = folder / "assembly.json"
    if not path.is_file():
        raise RenderError(f"{path}: no such file: the flower is not assembled yet")
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RenderError(f"{path}: expected petals, each with its T_flower_scan ({error}): assemble again") from error
    if not isinstance(table, dict):
        raise RenderError(f"{path}: expected petals, each with its T_flower_scan: assemble again")
    return table


def _placed(folder: Path, placed: dict[str, ArrayLike]) -> Iterable[Mesh]:
    for name, T_flower_scan in placed.items():
        yield read_mesh(folder / "petals" / name / "mesh.ply", name).moved(T_flower_scan)


def _unit(vectors: Array) -> Array:
    """Vectors of length 1; those of length 0 stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
