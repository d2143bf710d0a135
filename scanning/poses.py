"""Where a petal stands in its flower, as the six coordinates that are measured or assumed.

A petal's pose is written in generalised coordinates q = (azimuth, radius, height, tilt, side, roll): the direction in which the petal grows
out of the receptacle, how far along it and how high its base point stands, the angle between the stem and the base-tip line, how far the
base point lies beside the meridian plane, and the turn about the base-tip line. At side 0 and roll 0 the petal's y and z axes lie in the
meridian plane, its inner face to the stem. Each measurement is then one coordinate, or (the stem angle) one function of them.

A base is millimetres wide and stands millimetres from the stem: its azimuth is where its middle faces, and a base point found a little too
far to one side must not turn the petal.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AZIMUTH, RADIUS, HEIGHT, TILT, SIDE, ROLL = range(6)
ANGLES = (AZIMUTH, TILT, ROLL)
_UPRIGHT = 1e-9  # horizontal part of a midrib's direction, below which it points nowhere


def _axes(q: Array) -> tuple[Array, Array, Array, Array]:
    """Return base points, and the tangential (x = -tangential), base-tip and inner-face directions before roll, each (K, 3)."""
    azimuth, radius, height, tilt, side, _ = q.T
    zero = np.zeros_like(azimuth)
    outward = np.stack([np.cos(azimuth), np.sin(azimuth), zero], -1)
    tangent = np.stack([-np.sin(azimuth), np.cos(azimuth), zero], -1)
    up = np.array([0.0, 0.0, 1.0])
    base = radius[:, None] * outward + side[:, None] * tangent + height[:, None] * up
    midrib = np.cos(tilt)[:, None] * up + np.sin(tilt)[:, None] * outward
    inner = np.sin(tilt)[:, None] * up - np.cos(tilt)[:, None] * outward
    return base, tangent, midrib, inner


def petal_poses(q: Array) -> Array:
    """Return the poses of petals from their coordinates.

    Parameters
    ----------
    q : (K, 6) azimuth, radius, height, tilt, side, roll; radians and mm.

    Returns
    -------
    (K, 4, 4) T_flower_petal.
    """
    base, tangent, midrib, inner = _axes(q)
    cos, sin = np.cos(q[:, ROLL])[:, None], np.sin(q[:, ROLL])[:, None]
    poses = np.zeros((len(q), 4, 4))
    poses[:, :3, 0] = -cos * tangent - sin * inner
    poses[:, :3, 1] = midrib
    poses[:, :3, 2] = cos * inner - sin * tangent
    poses[:, :3, 3] = base
    poses[:, 3, 3] = 1.0
    return poses


def twists(q: Array) -> tuple[Array, Array]:
    """Return how a petal moves when one of its coordinates does.

    A point p of petal k moves by omega[k, c] x p + v[k, c] per unit of coordinate c.

    Parameters
    ----------
    q : (K, 6) coordinates; radians and mm.

    Returns
    -------
    omega, v : (K, 6, 3) angular velocity, and velocity at the origin.
    """
    base, tangent, midrib, _ = _axes(q)
    up = np.array([0.0, 0.0, 1.0])
    omega, v = np.zeros((len(q), 6, 3)), np.zeros((len(q), 6, 3))
    omega[:, AZIMUTH] = up
    v[:, RADIUS] = np.stack([np.cos(q[:, AZIMUTH]), np.sin(q[:, AZIMUTH]), np.zeros(len(q))], -1)
    v[:, SIDE] = tangent
    v[:, HEIGHT] = up
    for coordinate, axis in ((TILT, tangent), (ROLL, midrib)):
        omega[:, coordinate] = axis
        v[:, coordinate] = -np.cross(np.broadcast_to(axis, base.shape), base)
    return omega, v


def stem_angles(q: Array, inflection: Array) -> Array:
    """Return the angles between the stem and the midribs' directions at their inflections.

    Parameters
    ----------
    q : (K, 6) coordinates; radians and mm.
    inflection : (K, 3) unit directions in the petals' frames.

    Returns
    -------
    (K,) radians, 0 to pi.
    """
    direction = np.einsum("kij,kj->ki", petal_poses(q)[:, :3, :3], inflection)
    return np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])


def measured_coordinates(azimuth: Array, radius: Array, height: Array, stem_angle: Array, inflection: Array) -> Array:
    """Return the coordinates that have the measured values, side and roll 0.

    Parameters
    ----------
    azimuth, stem_angle : (K,) degrees.
    radius, height : (K,) of the base points, mm.
    inflection : (K, 3) unit directions of the midribs at their inflections, in the petals' frames.

    Returns
    -------
    (K, 6) coordinates; radians and mm. Where an inflection's direction leaves the petal's y-z plane so far that no tilt has the
    measured stem angle, the nearest one.
    """
    lean = np.arctan2(-inflection[:, 2], inflection[:, 1])
    in_plane = np.hypot(inflection[:, 1], inflection[:, 2])
    cosine = np.cos(np.radians(stem_angle)) / np.maximum(in_plane, 1e-9)
    tilt = np.arccos(np.clip(cosine, -1.0, 1.0)) - lean
    zero = np.zeros_like(tilt)
    return np.stack([np.radians(azimuth), radius, height, tilt, zero, zero], -1)


def coordinates(T_flower_petal: Array) -> Array:
    """Return the coordinates of petals' poses, so that `petal_poses` gives them back.

    Of the two ways to write a pose, leaning out or, turned half round, in, the one with less roll. A petal upright to the last digit has no
    roll.

    Parameters
    ----------
    T_flower_petal : (K, 4, 4) rigid.

    Returns
    -------
    (K, 6) coordinates; radians and mm.
    """
    x, midrib, base = (T_flower_petal[:, :3, column] for column in (0, 1, 3))
    level = np.hypot(midrib[:, 0], midrib[:, 1])
    ways = []
    for way in (1.0, -1.0):
        q = np.zeros((len(base), 6))
        q[:, TILT] = way * np.arctan2(level, midrib[:, 2])
        leaning = np.arctan2(way * midrib[:, 1], way * midrib[:, 0])
        q[:, AZIMUTH] = np.where(level > _UPRIGHT, leaning, np.arctan2(x[:, 0], -x[:, 1]))
        _, tangent, _, inner = _axes(q)
        outward = np.stack([tangent[:, 1], -tangent[:, 0]], -1)
        q[:, RADIUS] = np.einsum("ki,ki->k", base[:, :2], outward)
        q[:, SIDE] = np.einsum("ki,ki->k", base, tangent)
        q[:, HEIGHT] = base[:, 2]
        q[:, ROLL] = np.arctan2(-np.einsum("ki,ki->k", x, inner), -np.einsum("ki,ki->k", x, tangent))
        ways.append(q)
    out, turned = ways
    return np.where((np.abs(out[:, ROLL]) <= np.abs(turned[:, ROLL]))[:, None], out, turned)


def moved(poses: Array, points: Array) -> Array:
    """Apply one pose (4, 4) to points (N, 3)."""
    return points @ poses[:3, :3].T + poses[:3, 3]


def inverse(pose: Array) -> Array:
    """Return the inverse of a rigid pose (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out
