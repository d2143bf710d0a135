"""Put the petals of a flower together: eq. (14), x' = T_i x + alpha_i, all petals at once.

The poses are the most probable ones given the measurements (Gaussian, with the stated standard uncertainties) under the condition that no
two petals pass through each other and that each lies on the stated side of its neighbours. Solved by Gauss-Newton steps on the petals'
coordinates (scanning.poses) with a one-sided spring on every gap narrower than a margin, its weight raised in stages until nothing
intersects. A step that does not lower the cost is taken back and shortened: without that the sets of springs that act chase each other.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scanning.contact import REACH, Gaps, Sheet, clearance, crossings, gaps, samples
from scanning.errors import ScanError
from scanning.placement import Placement
from scanning.poses import (
    ANGLES,
    AZIMUTH,
    HEADING,
    HEIGHT,
    RADIUS,
    ROLL,
    Array,
    inverse,
    measured_coordinates,
    petal_poses,
    stem_angles,
    twists,
)

MARGIN = 0.25  # mm between sheets that touch: a petal's thickness
SPAN = 3.5  # sd: no measurement is believed to be farther off
CAPS = np.where(np.isin(np.arange(6), ANGLES), 0.06, 1.5)  # rad, mm in one step: the gaps are linear only that far
STAGES = (3.0, 10.0, 30.0, 100.0, 100.0, 200.0, 400.0)  # 1/mm, weight of a gap against 1/sd of a measurement
DEEPEST, SHALLOWER = 0.8, 0.75  # mm, and per step: once the petals are nearly apart, what seems deeper is the far side of a fold
CONFLICT = 3.0  # sd
MEASUREMENTS = {"azimuth": "deg", "base_radius": "mm", "base_height": "mm", "stem_angle": "deg", "heading": "deg", "roll": "deg"}
_ORDER = (AZIMUTH, RADIUS, HEIGHT, None, HEADING, ROLL)  # the coordinate behind each measurement; None: a function of several

Progress = Callable[[str, float], None]


class AssemblyError(ScanError):
    """An assembly that cannot be begun."""


@dataclass(frozen=True)
class Assembly:
    """A flower put together.

    Attributes
    ----------
    names : K petal names.
    state : "free", or "intersecting": then the poses are the best found and not usable as they are.
    poses : (K, 4, 4) T_flower_scan, that is [T_i alpha_i] of eq. (14); mm.
    start : (K, 4, 4) the poses that the measurements alone give.
    clearance : least distance between two petals, mm (0 where they intersect, inf for a single petal).
    stem_angle, azimuth : (K,) degrees, as assembled.
    residuals : (K, 6) assembled less measured in standard uncertainties: azimuth, base_radius, base_height, stem_angle, and the two
        assumed to be 0: heading and roll.
    pairs : the pairs (inner, outer) that were kept, stated ones and those inferred from the measured poses.
    intersecting : pairs of petals that pass through each other.
    conflicts : what cannot be true together, in words.
    seed, seconds : of the run.
    """

    names: list[str]
    state: str
    poses: Array
    start: Array
    clearance: float
    stem_angle: Array
    azimuth: Array
    residuals: Array
    pairs: list[tuple[str, str]]
    intersecting: list[tuple[str, str]] = field(default_factory=list)
    conflicts: list[str] = field(default_factory=list)
    seed: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Measured:
    """The measurements: values and sd (K, 6) in the order of `MEASUREMENTS`, the inflections' directions (K, 3); rad and mm."""

    values: Array
    sd: Array
    inflection: Array

    def residuals(self, q: Array) -> Array:
        """Return (K, 6), assembled less measured in sd."""
        predicted = q.copy()
        predicted[:, 3] = stem_angles(q, self.inflection)
        difference = predicted - self.values
        difference[:, 0] = (difference[:, 0] + np.pi) % (2 * np.pi) - np.pi
        return difference / self.sd

    def jacobian(self, q: Array) -> Array:
        """Return d residuals / d q, (K, 6, 6): only the stem angle depends on several coordinates."""
        out = np.zeros((len(q), 6, 6))
        for row, coordinate in enumerate(_ORDER):
            if coordinate is not None:
                out[:, row, coordinate] = 1 / self.sd[:, row]
        for coordinate in range(6):
            step = np.zeros(6)
            step[coordinate] = 1e-6
            slope = (stem_angles(q + step, self.inflection) - stem_angles(q - step, self.inflection)) / 2e-6
            out[:, 3, coordinate] = slope / self.sd[:, 3]
        return out


def measured(placement: Placement, names: list[str], inflection: Array, *, heading_u: float = 5.0, roll_u: float = 5.0) -> Measured:
    """Return the measurements of a placement as arrays.

    Parameters
    ----------
    placement, names : the measurements, and the petals' order.
    inflection : (K, 3) directions of the midribs at their inflections in the petals' frames.
    heading_u, roll_u : degrees; how far a petal may be turned out of the meridian plane of its base. Nobody measures these two: the
        values are an assumption about flowers [U].
    """
    petals = [placement.petals[name] for name in names]
    zero = [0.0] * len(petals)
    columns = [
        np.radians([p.azimuth for p in petals]),
        [p.base_radius for p in petals],
        [p.base_height for p in petals],
        np.radians([p.stem_angle for p in petals]),
        zero,
        zero,
    ]
    base_u = [p.base_u for p in petals]
    sd = [
        np.radians([p.azimuth_u for p in petals]),
        base_u,
        base_u,
        np.radians([p.stem_angle_u for p in petals]),
        np.full(len(petals), np.radians(heading_u)),
        np.full(len(petals), np.radians(roll_u)),
    ]
    return Measured(np.array(columns, float).T, np.array(sd, float).T, inflection)


def start_coordinates(m: Measured) -> Array:
    """Return the coordinates (K, 6) that the measurements alone give."""
    v = m.values
    return measured_coordinates(np.degrees(v[:, 0]), v[:, 1], v[:, 2], np.degrees(v[:, 3]), m.inflection)


def ranked_pairs(
    known: dict[tuple[int, int], bool], seen: Gaps, count: int, spread: Array, taken_off: list[int]
) -> dict[tuple[int, int], bool]:
    """Return for each two petals that face each other which one is inside.

    The known relations hold; the others follow the mean of the gaps, the surest first, unless that would close a circle.

    Parameters
    ----------
    known : {(i, j): True where i is inside j}, i < j.
    seen : gaps at the present poses.
    count : number of petals.
    spread : (M,) standard uncertainty of each gap by the petals' coordinates, mm.
    taken_off : petals in the order in which they were taken off: of two, the later one is inside. May be empty.

    Returns
    -------
    `known` with what was found added.
    """
    reach = np.eye(count, dtype=bool)  # reach[a, b]: a is b or inside b, by whatever chain

    def add(inner: int, outer: int) -> None:
        np.logical_or(reach, np.outer(reach[:, inner], reach[outer]), out=reach)

    out = dict(known)
    for (i, j), i_inside in known.items():
        add(*((i, j) if i_inside else (j, i)))
    turn = {petal: place for place, petal in enumerate(taken_off)}
    # A point of i on the inner face's side of j says that i is inside; a point of j on the inner face's side of i says the contrary.
    height = np.where(seen.i < seen.j, seen.height, -seen.height)
    key = np.minimum(seen.i, seen.j) * count + np.maximum(seen.i, seen.j)
    votes = []
    for k in np.unique(key):
        of = key == k
        # A pair's gaps have their errors in common, so more of them say little more; a handful says little at all.
        votes.append((float(height[of].mean() / spread[of].mean()) * float(np.sqrt(of.sum() / (of.sum() + 20))), *divmod(int(k), count)))
    for surely, i, j in sorted(votes, key=lambda vote: (-abs(vote[0]), vote[1:])):
        chained = reach[i, j] != reach[j, i]
        if (i, j) in out:
            continue
        if chained:
            i_inside = bool(reach[i, j])
        elif i in turn and j in turn:
            i_inside = turn[i] > turn[j]
        else:
            i_inside = surely > 0
        add(*((i, j) if i_inside else (j, i)))
        out[i, j] = i_inside
    return out


def _spread(q: Array, m: Measured, seen: Gaps) -> Array:
    """Return the standard uncertainty of each gap, mm, by the uncertainties of the two petals' coordinates."""
    omega, v = twists(q)
    variance = np.zeros(len(seen.i))
    for petal, at in ((seen.i, seen.p), (seen.j, seen.c)):
        rows = np.einsum("mci,mi->mc", omega[petal], np.cross(at, seen.n)) + np.einsum("mci,mi->mc", v[petal], seen.n)
        variance += np.einsum("mc,mc->m", rows**2, m.sd[petal] ** 2)
    return np.sqrt(variance)


def _step(q: Array, m: Measured, seen: Gaps, sign: Array, weight: float, margin: float, caps: float) -> Array:
    """Return one Gauss-Newton step (K, 6): the springs that act are found again as the linearised gaps change."""
    from scipy.sparse import csr_matrix

    k = len(q)
    residual, jacobian = m.residuals(q), m.jacobian(q)
    prior = np.zeros((6 * k, 6 * k))
    right = np.zeros(6 * k)
    for petal in range(k):
        block = slice(6 * petal, 6 * petal + 6)
        prior[block, block] = jacobian[petal].T @ jacobian[petal]
        right[block] = -jacobian[petal].T @ residual[petal]
    near = (sign != 0) & (sign * seen.height < margin + 1.5)
    i, j, n = seen.i[near], seen.j[near], seen.n[near] * sign[near, None]
    gap = sign[near] * seen.height[near]
    omega, v = twists(q)
    # d gap = n . (velocity of p - velocity of c); n . (omega x p) = omega . (p x n)
    rows_i = np.einsum("mci,mi->mc", omega[i], np.cross(seen.p[near], n)) + np.einsum("mci,mi->mc", v[i], n)
    rows_j = -np.einsum("mci,mi->mc", omega[j], np.cross(seen.c[near], n)) - np.einsum("mci,mi->mc", v[j], n)
    columns = np.concatenate([6 * i[:, None] + np.arange(6), 6 * j[:, None] + np.arange(6)], 1)
    rows = csr_matrix((np.concatenate([rows_i, rows_j], 1).ravel(), columns.ravel(), np.arange(len(i) + 1) * 12), (len(i), 6 * k))

    def cost(step: Array) -> float:
        return float(0.5 * step @ prior @ step - right @ step + 0.5 * weight**2 * (np.minimum(gap + rows @ step - margin, 0.0) ** 2).sum())

    # A convex problem with kinks: Newton's direction for the springs that act, shortened until the cost falls.
    step = np.zeros(6 * k)
    for _ in range(12):
        short = np.minimum(gap + rows @ step - margin, 0.0)
        acting = rows[short < 0]
        hessian = prior + weight**2 * (acting.T @ acting).toarray()
        direction = np.linalg.solve(hessian, right - prior @ step - weight**2 * (rows.T @ short))
        length, here = 1.0, cost(step)
        while cost(step + length * direction) > here and length > 1e-3:
            length /= 2
        if length <= 1e-3 or np.abs(length * direction).max() < 1e-5:
            break
        step = step + length * direction
    # Shortened petal by petal, not coordinate by coordinate: a step keeps its direction.
    over = (np.abs(step.reshape(k, 6)) / (CAPS * caps)).max(1)
    step = (step.reshape(k, 6) / np.maximum(over, 1.0)[:, None]).ravel()
    return step.reshape(k, 6)


def _within(q: Array, m: Measured) -> Array:
    """Keep each coordinate within SPAN sd of its measurement, and the base on the outer side of the stem."""
    start = start_coordinates(m)
    half = SPAN * m.sd
    q = np.clip(q, start - half, start + half)
    q[:, RADIUS] = np.maximum(q[:, RADIUS], 0.0)
    return q


def assemble(
    names: list[str],
    sheets: list[Sheet],
    T_scan_petal: Array,
    inflection: Array,
    placement: Placement,
    *,
    seed: int = 0,
    margin: float = MARGIN,
    points: int = 500,
    steps: int = 8,
    heading_u: float = 5.0,
    roll_u: float = 5.0,
    progress: Progress | None = None,
) -> Assembly:
    """Put petals together.

    Parameters
    ----------
    names : K petals, all in `placement`.
    sheets : K meshes in scan frames, mm.
    T_scan_petal : (K, 4, 4) from the petals' frames to their scans'.
    inflection : (K, 3) unit directions of the midribs at their inflections, in the petals' frames.
    placement : the measurements; must be without problems (scanning.placement.check).
    seed : of the choice of vertices.
    margin : gap that is aimed at where petals touch, mm.
    points : vertices of each petal that are looked at; all of them are in the final check.
    steps : Gauss-Newton steps at each weight.
    heading_u, roll_u : see `measured`.
    progress : called with a word and a share of 0 to 1.

    Returns
    -------
    Assembly
        Marked "intersecting", with the petals named, where no state without intersections was found.

    Raises
    ------
    AssemblyError
        If a petal has no placement.
    """
    began = time.monotonic()
    missing = [name for name in names if name not in placement.petals]
    if missing or not names:
        raise AssemblyError(f"{placement.source}: no placement for {', '.join(missing) or 'any petal'}: add [petals.NAME] for each petal")
    tell = progress or (lambda word, share: None)
    rng = np.random.default_rng(seed)
    k = len(names)
    m = measured(placement, names, inflection, heading_u=heading_u, roll_u=roll_u)
    to_petal = np.array([inverse(pose) for pose in T_scan_petal])
    q = start_coordinates(m)
    start = petal_poses(q) @ to_petal
    chosen = [samples(sheet, points, rng) for sheet in sheets]
    number = {name: index for index, name in enumerate(names)}
    stated = [(number[a], number[b]) for a, b in placement.inside_of() if a in number and b in number]
    inside = {(min(pair), max(pair)): pair[0] < pair[1] for pair in stated}
    side = np.zeros((k, k))
    taken_off = [number[name] for name in placement.taken_off if name in number]

    def look(q: Array, depth: float) -> Gaps:
        seen = gaps(sheets, petal_poses(q) @ to_petal, chosen, reach=REACH if depth > REACH / 2 else REACH / 2)
        settle(q, seen)
        return seen.where(signs(seen) * seen.height > -depth)

    def settle(q: Array, seen: Gaps) -> None:
        # Petals that meet for the first time get their order when they do; once settled it stays.
        inside.update(ranked_pairs(inside, seen, k, _spread(q, m, seen), taken_off))
        for (i, j), i_inside in inside.items():
            side[i, j], side[j, i] = (1, -1) if i_inside else (-1, 1)

    def signs(seen: Gaps) -> Array:
        return side[seen.i, seen.j]

    def merit(q: Array, seen: Gaps, weight: float) -> float:
        return float(
            (m.residuals(q) ** 2).sum() + weight**2 * (np.minimum(signs(seen) * seen.height - margin, 0.0)[signs(seen) != 0] ** 2).sum()
        )

    best, least, caps, depth = q, np.inf, 1.0, REACH
    for stage, weight in enumerate(STAGES):
        seen = look(q, depth)
        here = merit(q, seen, weight)
        for turn in range(steps):
            tell("moving", (stage + turn / steps) / len(STAGES))
            depth = max(DEEPEST, depth * SHALLOWER)
            trial = _within(q + _step(q, m, seen, signs(seen), weight, margin, caps), m)
            then = look(trial, depth)
            there = merit(trial, then, weight)
            if there < here:
                gained, q, seen, here, caps = here - there, trial, then, there, min(1.0, 2 * caps)
                if gained < 0.01 * here:
                    break
            else:
                caps /= 3
        pierced = crossings(sheets, petal_poses(q) @ to_petal)
        # The vertices looked at stand for their surroundings; what still pierces a sheet is now looked at itself.
        for (i, _), edges in pierced.items():
            chosen[i] = np.union1d(chosen[i], sheets[i].edges[edges])
        if sum(map(len, pierced.values())) < least:
            best, least = q, sum(map(len, pierced.values()))
        if not pierced:
            break
        caps = 1.0
    q, poses = best, petal_poses(best) @ to_petal
    pierced = crossings(sheets, poses)
    residuals = m.residuals(q)
    crossing = sorted({(names[min(pair)], names[max(pair)]) for pair in pierced})
    tell("done", 1.0)
    return Assembly(
        names=names,
        state="intersecting" if pierced else "free",
        poses=poses,
        start=start,
        clearance=0.0 if pierced else clearance(sheets, poses),
        stem_angle=np.degrees(stem_angles(q, inflection)),
        azimuth=np.degrees(q[:, AZIMUTH]) % 360,
        residuals=residuals,
        pairs=sorted((names[i], names[j]) if i_inside else (names[j], names[i]) for (i, j), i_inside in inside.items()),
        intersecting=crossing,
        conflicts=_conflicts(names, residuals, crossing),
        seed=seed,
        seconds=time.monotonic() - began,
    )


def _conflicts(names: list[str], residuals: Array, crossing: list[tuple[str, str]]) -> list[str]:
    out = []
    for name, row in zip(names, residuals, strict=True):
        for what, pull in zip(MEASUREMENTS, row, strict=True):
            if abs(pull) > CONFLICT:
                out.append(f"{name}: {what} is {pull:+.1f} standard uncertainties from what was measured")
    for a, b in crossing:
        pulls = [(abs(residuals[names.index(n), c]), n, what) for n in (a, b) for c, what in enumerate(MEASUREMENTS)]
        pull, name, what = max(pulls)
        out.append(f"{a} and {b} still intersect: look first at {what} of {name} ({pull:.1f} standard uncertainties)")
    return out
