"""The relative pose of scans of one surface, found without a hint.

Coarse: FPFH features and fast global registration on thinned clouds, several tries from the seed; fine: generalised ICP on the points as
measured. What came out is only believed when enough of both scans lies on each other, and little of one hangs in the free space the other
looked through.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanning.errors import RegistrationError
from scanning.mesh import Array, TriangleMesh, vertex_normals

_THINNED = 45  # sides of a voxel along the diagonal of the scan
_TRIES = 3
_LEAST_POINTS = 100
_FINE_POINTS = 10_000


@dataclass(frozen=True, eq=False)
class Registration:
    """Where one scan lies in another's frame.

    Attributes
    ----------
    T_target_source : ndarray, shape (4, 4), mm
        Brings a point of the source's frame to the target's.
    fitness : float
        Smaller of the parts of either scan that lies on the other.
    inlier_rmse : float, mm
        Root mean square distance of the source's points that do, to the target.
    in_free_space : float
        Part of the source that hangs in front of the target where the scanner looked through.
    seed : int
        Of the random choices.
    seconds : float
        Time it took.
    """

    T_target_source: Array
    fitness: float
    inlier_rmse: float
    in_free_space: float
    seed: int
    seconds: float


def register(
    source: TriangleMesh,
    target: TriangleMesh,
    *,
    seed: int = 0,
    least_fitness: float = 0.3,
    most_in_free_space: float = 0.1,
    name: str = "scans",
) -> Registration:
    """Find the pose of a scan in another's frame.

    Parameters
    ----------
    source, target : TriangleMesh
        Overlapping scans, each in its own scan frame (mm, z towards the sensor).
    seed : int
        Of the random choices.
    least_fitness : float
        Smallest part of either scan that must lie on the other.
    most_in_free_space : float
        Largest part of the source that may hang where the target's scanner looked through, taken along the target's z.
    name : str
        What to call the pair in messages.

    Raises
    ------
    RegistrationError
        Where no pose is good enough to trust; a pose that is not trusted is never returned.
    """
    started = time.perf_counter()
    for which, mesh in (("source", source), ("target", target)):
        if len(mesh.vertices) < _LEAST_POINTS:
            raise RegistrationError(f"the {which} has {len(mesh.vertices)} points", file=name, expected=f"at least {_LEAST_POINTS}")
    o3d = _open3d()
    clouds = [_cloud(mesh, o3d) for mesh in (source, target)]
    steps = [_step(mesh) for mesh in (source, target)]
    step = max(steps)
    voxel = max(3 * step, min(_diagonal(source), _diagonal(target)) / _THINNED)
    thinned = [cloud.voxel_down_sample(voxel) for cloud in clouds]
    features = [
        o3d.pipelines.registration.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)) for cloud in thinned
    ]
    best: tuple[float, Array] | None = None
    for attempt in range(_TRIES):
        coarse = _coarse(thinned, features, voxel, seed + attempt, o3d)
        middle = _refined(thinned, 1.5 * voxel, coarse, 20, o3d)
        score = _on_each_other(thinned, middle.transformation, voxel)[0]
        if best is None or score > best[0]:
            best = score, middle.transformation
        if score > 2 * least_fitness:
            break
    assert best is not None
    pose = best[1]
    # More points of the source would take longer and not tell more: six numbers are sought.
    some = clouds[0].uniform_down_sample(max(1, len(source.vertices) // _FINE_POINTS))
    for reach in (4 * step, 2 * step):
        pose = _refined((some, clouds[1]), reach, pose, 30, o3d).transformation
    pose = np.array(pose)
    fitness, rmse = _on_each_other(clouds, pose, 1.5 * step)
    hanging = in_free_space(source, target, pose, steps[1])
    if fitness < least_fitness or hanging > most_in_free_space:
        raise RegistrationError(
            f"no pose to trust: the best has {fitness:.0%} of the smaller overlap and {hanging:.0%} of the source in free space",
            file=name,
            expected=f"at least {least_fitness:.0%} and at most {most_in_free_space:.0%}",
            hint="Give scans that share more of the surface",
        )
    return Registration(pose, fitness, rmse, hanging, seed, time.perf_counter() - started)


def merge(meshes: Sequence[TriangleMesh], poses: Sequence[Array], *, spacing: float | None = None) -> TriangleMesh:
    """Join registered scans; what a later scan repeats of the earlier ones is left out.

    Triangles stay as the scans' grids made them, and are not sewn at the seams: a triangle of a later scan goes where all its corners lie
    within `spacing` of the surface that is already there.

    Parameters
    ----------
    meshes : sequence of TriangleMesh
        Each in its own scan frame, best first.
    poses : sequence of ndarray, shape (4, 4)
        T_target_scan of each; the identity for the one in whose frame the result is.
    spacing : float, optional, mm
        Points nearer than this are one; by default the largest step of the scans.

    Raises
    ------
    ValueError
        Where the counts of meshes and poses differ, or there are none.
    """
    from scipy.spatial import cKDTree

    if len(meshes) != len(poses) or not meshes:
        raise ValueError(f"{len(meshes)} meshes and {len(poses)} poses")
    spacing = spacing or max(_step(mesh) for mesh in meshes)
    vertices, triangles = np.empty((0, 3)), np.empty((0, 3), dtype=np.int32)
    for mesh, pose in zip(meshes, poses, strict=True):
        moved = mesh.transformed(np.asarray(pose, dtype=np.float64))
        new = moved.triangles
        if len(vertices):
            near = cKDTree(vertices).query(moved.vertices, distance_upper_bound=spacing)[0] < spacing
            new = new[~near[new].all(axis=1)]
        used = np.unique(new)
        number = np.zeros(len(moved.vertices), dtype=np.int32)
        number[used] = np.arange(len(used)) + len(vertices)
        vertices = np.concatenate([vertices, moved.vertices[used]])
        triangles = np.concatenate([triangles, number[new]])
    return TriangleMesh(vertices, triangles)


def in_free_space(source: TriangleMesh, target: TriangleMesh, T_target_source: Array, step: float) -> float:
    """Part of the source's points that the target's scanner would have seen before what it did see: the pose then cannot be.

    The line of sight is taken to be z of the target's frame.
    """
    from scipy.spatial import cKDTree

    moved = source.transformed(T_target_source).vertices
    away, nearest = cKDTree(target.vertices[:, :2]).query(moved[:, :2], distance_upper_bound=step)
    over = np.isfinite(away)
    gap = np.zeros(len(moved))
    gap[over] = moved[over, 2] - target.vertices[nearest[over], 2]
    return float(np.mean(gap > 6 * step))


def _open3d() -> Any:
    """Open3D, or one line on what is missing."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise RegistrationError(
            f"Open3D cannot be loaded: {error}", hint="On Debian: apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1"
        ) from error
    return open3d


def _cloud(mesh: TriangleMesh, o3d: Any) -> Any:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mesh.vertices))
    cloud.normals = o3d.utility.Vector3dVector(vertex_normals(mesh))
    return cloud


def _step(mesh: TriangleMesh) -> float:
    """Median length of the edges, mm."""
    first, second = mesh.vertices[mesh.triangles[:, 0]], mesh.vertices[mesh.triangles[:, 1]]
    return float(np.median(np.linalg.norm(second - first, axis=1)))


def _diagonal(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def _coarse(thinned: Sequence[Any], features: Sequence[Any], voxel: float, seed: int, o3d: Any) -> Array:
    reg = o3d.pipelines.registration
    o3d.utility.random.seed(seed)
    option = reg.FastGlobalRegistrationOption(maximum_correspondence_distance=1.5 * voxel, iteration_number=64)
    return np.array(reg.registration_fgr_based_on_feature_matching(*thinned, *features, option).transformation)


def _refined(clouds: Sequence[Any], reach: float, pose: Array, iterations: int, o3d: Any) -> Any:
    reg = o3d.pipelines.registration
    return reg.registration_generalized_icp(
        *clouds, reach, pose, reg.TransformationEstimationForGeneralizedICP(), reg.ICPConvergenceCriteria(1e-6, 1e-6, iterations)
    )


def _on_each_other(clouds: Sequence[Any], pose: Array, reach: float) -> tuple[float, float]:
    """Smaller of the parts of either cloud with the other within reach, and rms distance of the source's points to the target, mm."""
    from scipy.spatial import cKDTree

    source, target = (np.asarray(cloud.points) for cloud in clouds)
    moved = source @ pose[:3, :3].T + pose[:3, 3]
    there = cKDTree(target).query(moved, distance_upper_bound=reach)[0]
    back = cKDTree(moved).query(target, distance_upper_bound=reach)[0]
    near = there[np.isfinite(there)]
    rmse = math.sqrt(float(np.mean(near**2))) if near.size else math.inf
    return min(float(np.isfinite(there).mean()), float(np.isfinite(back).mean())), rmse
