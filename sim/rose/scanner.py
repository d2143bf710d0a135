"""The virtual range finder: one petal, inner face up, seen by a camera and lit by a laser from the side."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.rose.errors import RoseError
from sim.rose.mesh import Array, Mesh, inverse, rigid

INVALID = -999999.0


@dataclass(frozen=True)
class RangeFinder:
    """A triangulating range finder looking down on the plane z = 0. Lengths in mm, angles in degrees.

    Window, grid and depth step are the paper's (section 5). The distance, the baseline, the steepest surface that still answers and the
    choice of magnification are not documented there [U]: change them here.

    Parameters
    ----------
    window
        Side of the square it can see.
    grid
        Most rows and columns.
    depth_step
        Depths are multiples of this.
    noise
        Standard deviation of the depth before it is rounded.
    distance
        From the camera to the plane z = 0.
    baseline
        Angle at the middle of the window between camera and laser; the laser stands towards +y.
    steepest
        No echo where the view or the light is further off the surface normal than this.
    points
        Valid points aimed at: the step of the grid is chosen for each petal, as with a zoom.
    mixed
        Share of the valid points that average petal and background at the rim.
    dropouts
        Share of points lost at random.
    background
        Depth of the background under the lowest point of the petal.
    tilt
        Standard deviation of the tilt at which a petal is laid down, about x and about y.
    """

    window: float = 70.0
    grid: int = 200
    depth_step: float = 0.3
    noise: float = 0.1
    distance: float = 600.0
    baseline: float = 15.0
    steepest: float = 80.0
    points: int = 11_000
    mixed: float = 0.02
    dropouts: float = 0.0
    background: float = 12.0
    tilt: float = 4.0

    @property
    def camera(self) -> Array:
        """Where the camera is."""
        return np.array([0.0, 0.0, self.distance])

    @property
    def laser(self) -> Array:
        """Where the laser is."""
        return np.array([0.0, self.distance * np.tan(np.radians(self.baseline)), self.distance])


@dataclass(frozen=True)
class Scan:
    """A range image. Row 0 is at the top (+y), column 0 at the left (-x).

    Parameters
    ----------
    valid
        (rows, columns) of bool.
    points
        (rows, columns, 3), mm, scan frame; -999999 where not valid.
    mixed
        (rows, columns) of bool: valid points that lie on no surface.
    hidden
        (rows, columns) of bool: the camera sees the petal there, but the laser does not reach it.
    step
        Grid step in the plane z = 0, mm.
    """

    valid: NDArray[np.bool_]
    points: Array
    mixed: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    step: float


def lay_down(mesh: Mesh, t_flower_petal: Array, finder: RangeFinder, rng: np.random.Generator) -> Array:
    """Lay a petal in the window, inner face up, turned at random, nearly in the middle.

    Returns
    -------
    T_scan_petal, 4x4.

    Raises
    ------
    RoseError
        If the petal does not fit into the window.
    """
    about_x, about_y = np.radians(rng.normal(0, finder.tilt, 2))
    turn = rng.uniform(-np.pi, np.pi)
    face_up = inverse(t_flower_petal)
    rotation = _about(2, turn) @ _about(1, about_y) @ _about(0, about_x)
    pose = rigid(rotation, np.zeros(3))
    laid = mesh.moved(pose @ face_up).vertices
    low, high = laid.min(axis=0), laid.max(axis=0)
    # 2 mm are kept free: the camera's perspective widens what stands above z = 0.
    play = np.minimum((finder.window - (high - low)[:2]) / 2 - 2.0, 3.0)
    if (play < 0).any():
        raise RoseError(f"a petal of {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} mm does not fit the window of {finder.window:.0f} mm")
    middle = np.append(rng.uniform(-play, play), rng.uniform(-2, 2))
    return rigid(rotation, middle - (low + high) / 2)


def scan(mesh: Mesh, finder: RangeFinder, rng: np.random.Generator) -> Scan:
    """Scan a petal.

    Parameters
    ----------
    mesh
        Petal in the scan frame, inner face towards +z.
    finder
        The range finder.
    rng
        Source of noise, mixed points and dropouts.
    """
    from sim.rose.kernels import first_surface, shadowed

    step, side = _magnification(mesh, finder)
    z, face = first_surface(mesh.corners, finder.camera, step, side, side)
    seen = face >= 0
    x_0, y_0 = np.meshgrid((np.arange(side) - (side - 1) / 2) * step, ((side - 1) / 2 - np.arange(side)) * step)

    def on_ray(depth: Array) -> Array:
        shrink = 1 - depth / finder.distance
        return np.stack([x_0 * shrink, y_0 * shrink, depth], axis=-1)

    where = on_ray(np.where(seen, z, 0.0))[seen]
    normals = mesh.face_normals()[face[seen]]
    lit = ~shadowed(where, mesh.corners, finder.laser, 2 * step, 0.05)
    for eye in (finder.camera, finder.laser):
        towards = eye - where
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        lit &= np.einsum("ij,ij->i", towards, normals) > np.cos(np.radians(finder.steepest))
    valid = np.zeros_like(seen)
    valid[seen] = lit
    hidden = seen & ~valid
    valid &= rng.random(valid.shape) >= finder.dropouts

    depth = np.where(seen, z, 0.0) + rng.normal(0, finder.noise, z.shape)
    depth, mixed = _mix(depth, valid, seen, finder, rng)
    valid |= mixed
    depth = np.round(depth / finder.depth_step) * finder.depth_step
    points = np.where(valid[..., None], on_ray(depth), INVALID)
    return Scan(valid, points, mixed, hidden, step)


def _magnification(mesh: Mesh, finder: RangeFinder) -> tuple[float, int]:
    """Choose the grid's step and its side in points."""
    shrink = 1 - mesh.vertices[:, 2] / finder.distance
    flat = mesh.vertices[:, :2] / shrink[:, None]
    a, b, c = (flat[mesh.faces[:, corner]] for corner in range(3))
    facing = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    area = float(np.clip(facing, 0, None).sum()) / 2
    extent = 2 * float(np.abs(flat).max()) + 1.5
    step = max((area / finder.points) ** 0.5, extent / finder.grid)
    return step, min(finder.grid, int(finder.window / step))


def _mix(
    depth: Array, valid: NDArray[np.bool_], seen: NDArray[np.bool_], finder: RangeFinder, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """Spoil points at the rim: most in the petal's outline, some just outside it, lying free."""
    rim = valid & _beside(~seen)
    outside = ~seen & _beside(_beside(seen) | seen)
    wanted = round(finder.mixed * int(valid.sum()))
    free = wanted // 5
    mixed = np.zeros_like(valid)
    bottom = float(depth[seen].min()) - finder.background if seen.any() else 0.0
    depth = depth.copy()
    for pool, count in ((rim, wanted - free), (outside, free)):
        candidates = np.argwhere(pool)
        chosen = candidates[rng.permutation(len(candidates))[:count]]
        for row, column in chosen:
            near = depth[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3][
                seen[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
            ].mean()
            depth[row, column] = near + rng.uniform(0.1, 0.9) * (bottom - near)
            mixed[row, column] = True
    return depth, mixed


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points with one of their four neighbours in the mask."""
    padded = np.pad(mask, 1)
    around: NDArray[np.bool_] = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
    return around


def _about(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[[i, j], [i, j]] = c
    rotation[i, j], rotation[j, i] = -s, s
    return rotation
