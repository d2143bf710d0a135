"""A petal's own geometry: base and tip, midrib, frame, and where its curvature changes sign.

The base is known by the claw, the narrow end by which a petal hangs: of all places of the rim it has the least surface around it, and the
rim turns back most sharply there. The tip lies where the line from the base through the centre of area leaves the petal. Inner face: the
one that looked at the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.errors import PetalError
from scanning.mesh import Array, TriangleMesh, area, area_vectors, boundary_loops, loop_length, vertex_areas

_REACHES = 0.1, 0.15  # radii within which surface around a rim point is counted, in roots of the petal's area
_TURN_FROM, _TURN_OVER = 0.15, 0.3  # how far from a rim point, and over what length, the rim's direction is taken, in the same
_CLAW = 0.525  # narrowness of a claw, at most; a straight rim has 1, the corner of a square 0.43, the ends of an ellipse twice as long 0.63
_CLEAR = 0.85  # the claw must have less than this part of the next narrow place's
_APART = 0.15  # of the rim's length: two places nearer than this are one
_CLAW_STATIONS = 0.15, 0.6  # where its widths are taken, in parts of the way from the claw's end to the centre of area
_CLAW_ROUNDS = 4
_MIRROR_TURN = 10.0  # deg to either side of the claw's line that the line of symmetry is looked for
_RIM_POINTS = 240
_PROFILE_POINTS = 200
_SPANS = 5  # of the spline through the midrib's profile: finer ones follow the scanner's noise
_LEAST_TURN = math.radians(4.0)  # the midrib must turn at least this much on both sides of an inflection


@dataclass(frozen=True, eq=False)
class Petal:
    """What the placement of a petal rests on; all in the scan frame, mm.

    Attributes
    ----------
    base, tip : ndarray, shape (3,)
        Ends of the midrib, on the rim.
    T_scan_petal : ndarray, shape (4, 4)
        From the petal frame: origin at the base, y to the tip, z along the inner face's mean normal (across y), x = y cross z.
    midrib : ndarray, shape (n, 3)
        From base to tip, on the surface, where the plane through both and the mean normal cuts it.
    profile : ndarray, shape (n, 2)
        The same in the petal frame: y, and the smooth height z over it.
    inflection : ndarray, shape (3,)
        Point of the midrib where its curvature changes sign; the middle of its length where it does not.
    direction : ndarray, shape (3,)
        Unit tangent of the midrib there, to the tip.
    changes_sign : bool
        Whether the curvature changes sign.
    area : float, mm^2
        Of the surface.
    rim_length : float, mm
        Of the outer border.
    holes : int
        Borders inside the petal.
    narrowness : float
        Narrowness (see `narrowness_along`) of the base over that of the next narrow place of the rim; 0 where the base was given.
    """

    base: Array
    tip: Array
    T_scan_petal: Array
    midrib: Array
    profile: Array
    inflection: Array
    direction: Array
    changes_sign: bool
    area: float
    rim_length: float
    holes: int
    narrowness: float


def measure_petal(mesh: TriangleMesh, *, name: str = "petal", file: str = "", base: Sequence[float] | None = None) -> Petal:
    """Find base, tip, midrib, frame and inflection of a petal.

    Parameters
    ----------
    mesh : TriangleMesh
        One sheet, scan frame, normals to the inner face's side.
    name : str
        What to call the petal in messages.
    file : str
        Its scan, for messages.
    base : sequence of 2 floats, optional, mm
        x and y of the base in the scan frame, where it cannot be recognised; the nearest point of the rim is taken.

    Raises
    ------
    PetalError
        Where the base cannot be told, or the midrib is too broken to fit.
    """
    where = f"{file} (petal {name})" if file else name
    hint = f"Give the base by --base {name}=X,Y (mm, scan frame)"
    loops = boundary_loops(mesh.triangles)
    if not loops:
        raise PetalError("the surface has no rim", file=where, expected="an open sheet")
    rim = max(loops, key=lambda loop: loop_length(mesh.vertices, loop))
    rim_length = loop_length(mesh.vertices, rim)
    outline = _evenly(mesh.vertices[rim], _RIM_POINTS)
    if base is None:
        foot, narrowness = _claw(mesh, outline, where, hint)
    else:
        foot, narrowness = _nearest(outline, base, rim_length, where), 0.0

    normal = area_vectors(mesh).sum(axis=0)
    normal /= np.linalg.norm(normal)
    tip = _opposite(mesh, outline, foot, normal, where, hint)
    frame = petal_frame(foot, tip, normal)
    length = float(np.linalg.norm(tip - foot))
    y, z, smooth = _profile(mesh, frame, length, where, hint)
    place, slope, changes_sign = _inflection(y, smooth)

    def to_scan(along: Array, height: Array) -> Array:
        return np.asarray(frame[:3, 3] + np.outer(along, frame[:3, 1]) + np.outer(height, frame[:3, 2]))

    direction = frame[:3, 1] + slope * frame[:3, 2]
    return Petal(
        base=foot,
        tip=tip,
        T_scan_petal=frame,
        midrib=to_scan(y, z),
        profile=np.stack([y, smooth(y)], axis=1),
        inflection=to_scan(np.array([place]), np.array([float(smooth(place))]))[0],
        direction=direction / np.linalg.norm(direction),
        changes_sign=changes_sign,
        area=area(mesh),
        rim_length=rim_length,
        holes=len(loops) - 1,
        narrowness=narrowness,
    )


def petal_frame(base: Array, tip: Array, normal: Array) -> Array:
    """T_scan_petal, shape (4, 4): origin at the base, y to the tip, z the part of the normal across y, x = y cross z."""
    y = (tip - base) / np.linalg.norm(tip - base)
    z = normal - (normal @ y) * y
    z /= np.linalg.norm(z)
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = np.cross(y, z), y, z, base
    return frame


def _evenly(corners: Array, count: int) -> Array:
    """Points at equal distances along a closed line, shape (count, 2 or 3)."""
    closed = np.concatenate([corners, corners[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.arange(count) * along[-1] / count
    return np.stack([np.interp(at, along, closed[:, axis]) for axis in range(corners.shape[1])], axis=1)


def narrowness_along(mesh: TriangleMesh, outline: Array) -> Array:
    """How narrow the petal is at each of evenly spaced points along its rim, shape (n,): 1 on a straight rim, less at a narrow end.

    The product of two measures: surface within reach of the point, over the half disc it is on a straight rim (geometric mean over the
    reaches); and the angle on the petal's side between the rim before the point and behind it, over 180 deg, mean with 1.
    """
    from scipy.spatial import cKDTree

    weights = vertex_areas(mesh)
    scale = math.sqrt(weights.sum())
    tree = cKDTree(mesh.vertices)
    logs = []
    for reach in _REACHES:
        around = np.array([weights[near].sum() for near in tree.query_ball_point(outline, reach * scale)])
        logs.append(np.log(np.maximum(around, 1e-9) / (math.pi / 2 * (reach * scale) ** 2)))
    surface = np.exp(np.mean(logs, axis=0))
    # The staircase of the grid makes single points of the rim stick out.
    surface = (np.roll(surface, 1) + surface + np.roll(surface, -1)) / 3
    spacing = float(np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1).mean())
    near, over = (max(1, round(length * scale / spacing)) for length in (_TURN_FROM, _TURN_OVER))

    def chord(first: int, last: int) -> Array:
        vectors = np.roll(outline, -last, axis=0) - np.roll(outline, -first, axis=0)
        return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))

    turn = np.degrees(np.arccos(np.clip((chord(-near - over, -near) * chord(near, near + over)).sum(axis=1), -1, 1)))
    return np.asarray(surface * (1 - turn / 360))


def _claw(mesh: TriangleMesh, outline: Array, where: str, hint: str) -> tuple[Array, float]:
    """Middle of the narrow end, and how much narrower it is than the next."""
    narrowness = narrowness_along(mesh, outline)
    count = len(narrowness)
    narrowest = int(np.argmin(narrowness))
    steps = np.abs(np.arange(count) - narrowest)
    elsewhere = narrowness[np.minimum(steps, count - steps) > _APART * count]
    least = float(narrowness[narrowest])
    ratio = least / float(elsewhere.min())
    if least > _CLAW:
        raise PetalError(
            f"the base cannot be told: no end is narrow (narrowness {least:.2f})",
            file=where,
            expected=f"a claw of at most {_CLAW:.3g}; a straight rim has 1",
            hint=hint,
        )
    if ratio > _CLEAR:
        raise PetalError(
            f"the base cannot be told: the narrowest end has {ratio:.0%} of the narrowness of the next",
            file=where,
            expected=f"a claw with less than {_CLEAR:.0%}",
            hint=hint,
        )
    return _claw_middle(mesh, outline, outline[narrowest]), ratio


def _claw_middle(mesh: TriangleMesh, outline: Array, corner: Array) -> Array:
    """Where the line through the middles of the claw's widths leaves the petal; `corner` is any place on the claw's end."""
    weights = vertex_areas(mesh)
    centre = weights @ mesh.vertices / weights.sum()
    normal = area_vectors(mesh).sum(axis=0)
    normal /= np.linalg.norm(normal)
    foot = corner
    for _ in range(_CLAW_ROUNDS):
        along, across, reach = _directions(foot, centre, normal)
        side, ahead = (outline - foot) @ across, (outline - foot) @ along
        stations = np.linspace(*_CLAW_STATIONS, 8) * reach
        middles = []
        for station in stations:
            cut, part = _crossed(ahead - station)
            at = (1 - part) * side[cut] + part * side[(cut + 1) % len(side)]
            middles.append((at.min() + at.max()) / 2)
        slope, offset = np.polyfit(stations, middles, 1)
        cut, part = _crossed(side - slope * ahead - offset)
        places = (1 - part)[:, None] * outline[cut] + part[:, None] * outline[(cut + 1) % len(side)]
        if len(places) == 0:
            break
        foot = places[int(np.argmin((places - foot) @ along))]
    return _mirror_foot(outline, np.asarray(foot), centre, normal)


def _mirror_foot(outline: Array, foot: Array, centre: Array, normal: Array) -> Array:
    """Foot of the line through the centre of area about which the outline is most nearly its own mirror image, near a first foot."""
    from scipy.spatial import cKDTree

    along, across, _ = _directions(foot, centre, normal)
    flat = np.stack([(outline - centre) @ across, (outline - centre) @ along], axis=1)
    tree = cKDTree(_evenly(flat, 8 * len(flat)))
    turns = np.radians(np.linspace(-_MIRROR_TURN, _MIRROR_TURN, 49))
    # The mirror image about the line at an angle t from `along`.
    misfit = [
        float(np.mean(tree.query(flat @ np.array([[-np.cos(2 * t), np.sin(2 * t)], [np.sin(2 * t), np.cos(2 * t)]]))[0] ** 2))
        for t in turns
    ]
    best = turns[int(np.argmin(misfit))]
    cut, part = _crossed(flat @ np.array([np.cos(best), -np.sin(best)]))
    places = (1 - part)[:, None] * outline[cut] + part[:, None] * outline[(cut + 1) % len(outline)]
    if len(places) == 0:
        return foot
    return np.asarray(places[int(np.argmin((places - centre) @ along))])


def _directions(foot: Array, centre: Array, normal: Array) -> tuple[Array, Array, float]:
    """Unit vectors along the petal, from its foot to its centre, and across, both in the plane of the mean normal; and the distance, mm."""
    along = centre - foot
    along = along - (along @ normal) * normal
    reach = float(np.linalg.norm(along))
    along /= reach
    return along, np.cross(along, normal), reach


def _crossed(values: Array) -> tuple[NDArray[np.intp], Array]:
    """Where values along a closed line change sign: places before, and part of the way to the next."""
    following = np.roll(values, -1)
    before = np.flatnonzero((values > 0) != (following > 0))
    return before, values[before] / (values[before] - following[before])


def _nearest(outline: Array, base: Sequence[float], rim_length: float, where: str) -> Array:
    """Point of the rim nearest to a given one in x and y."""
    wanted = np.asarray(base, dtype=np.float64)
    if wanted.shape != (2,) or not np.isfinite(wanted).all():
        raise PetalError(f"{base!r} is no place", file=where, expected="x and y in the scan frame, mm")
    away = np.hypot(*(outline[:, :2] - wanted).T)
    if away.min() > rim_length / 20:
        nearest = outline[int(np.argmin(away))]
        raise PetalError(
            f"the base given, {wanted[0]:g},{wanted[1]:g}, lies {away.min():.3g} mm from the rim",
            file=where,
            expected=f"a place on the rim, e.g. {nearest[0]:.1f},{nearest[1]:.1f}",
            hint="Look at the picture, whose axes are the scan frame's",
        )
    return np.asarray(outline[int(np.argmin(away))])


def _opposite(mesh: TriangleMesh, outline: Array, foot: Array, normal: Array, where: str, hint: str) -> Array:
    """Where the line from the base through the centre of area last leaves the petal, seen along the mean normal."""
    weights = vertex_areas(mesh)
    along, across, _ = _directions(foot, weights @ mesh.vertices / weights.sum(), normal)
    cut, part = _crossed((outline - foot) @ across)
    if cut.size == 0:
        raise PetalError("no line from base to tip crosses the petal", file=where, hint=hint)
    places = (1 - part)[:, None] * outline[cut] + part[:, None] * outline[(cut + 1) % len(outline)]
    return np.asarray(places[int(np.argmax((places - foot) @ along))])


def _profile(mesh: TriangleMesh, frame: Array, length: float, where: str, hint: str) -> tuple[Array, Array, Any]:
    """Section of the petal in the plane of y and z of its frame: y, height, and a smooth spline of height over y."""
    from scipy.interpolate import make_lsq_spline

    local = (mesh.vertices - frame[:3, 3]) @ frame[:3, :3]
    a, b = mesh.triangles.ravel(), np.roll(mesh.triangles, -1, axis=1).ravel()
    cut = (local[a, 0] > 0) != (local[b, 0] > 0)
    a, b = a[cut], b[cut]
    part = (local[a, 0] / (local[a, 0] - local[b, 0]))[:, None]
    section = (1 - part) * local[a, 1:] + part * local[b, 1:]
    section = section[(section[:, 0] >= 0) & (section[:, 0] <= length)]
    bins = np.minimum((section[:, 0] / length * _PROFILE_POINTS).astype(int), _PROFILE_POINTS - 1)
    members = np.bincount(bins, minlength=_PROFILE_POINTS)
    there = members > 0
    y, z = (np.bincount(bins, weights=section[:, axis], minlength=_PROFILE_POINTS)[there] / members[there] for axis in (0, 1))
    knots = np.concatenate([np.zeros(4), np.arange(1, _SPANS) * length / _SPANS, np.full(4, length)])
    held = np.histogram(y, np.linspace(0, length, _SPANS + 1))[0]
    if held.min() < 4:
        raise PetalError(
            "the midrib is broken: the scan has no surface along a part of the line from base to tip",
            file=where,
            expected=f"points in every {length / _SPANS:.3g} mm",
            hint=f"Scan again. {hint}",
        )
    return y, z, make_lsq_spline(y, z, knots, k=3)


def _inflection(y: Array, smooth: Any) -> tuple[float, float, bool]:
    """Place along y where the curvature changes sign, slope there, and whether it does; else the middle of the length.

    The profile is cut where its second derivative changes sign. Pieces that turn too little to be told from noise join their neighbours; of
    the borders that stay the one with the most turning on both sides counts.
    """
    fine = np.linspace(y[0], y[-1], 2 * _PROFILE_POINTS)
    bend = smooth(fine, 2)
    slope = smooth(fine, 1)
    borders = [0, *(np.flatnonzero((bend[1:] > 0) != (bend[:-1] > 0)) + 1).tolist(), len(fine) - 1]

    def turns() -> Array:
        return np.abs(np.diff(np.arctan(slope[borders])))

    while len(borders) > 2 and turns().min() < _LEAST_TURN:
        weakest = int(np.argmin(turns()))
        # An inner piece goes with both its borders (its neighbours bend alike); an outer one with its inner border.
        outer = weakest in (0, len(borders) - 2)
        gone = {weakest + 1 if weakest == 0 else weakest} if outer else {weakest, weakest + 1}
        borders = [border for k, border in enumerate(borders) if k not in gone]
    if len(borders) > 2:
        turn = turns()
        best = borders[1 + int(np.argmax(np.minimum(turn[:-1], turn[1:])))]
        before, after = bend[best - 1], bend[best]
        where = float(fine[best - 1] + (fine[best] - fine[best - 1]) * (before / (before - after)))
        return where, float(smooth(where, 1)), True
    run = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(fine), np.diff(smooth(fine))))])
    middle = float(np.interp(run[-1] / 2, run, fine))
    return middle, float(smooth(middle, 1)), False
