"""Put the petals of a flower together: eq. (14), x' = T_i x + alpha_i, all petals at once.

The poses are the most probable ones given the measurements (Gaussian, with the stated standard uncertainties) and what is assumed of
flowers (scanning.terms), under the condition that no two petals pass through each other and that each lies on the stated side of its
neighbours. Solved by Gauss-Newton steps on the petals' coordinates (scanning.poses) with a one-sided spring on every gap narrower than a
margin, its weight raised in stages until nothing intersects. A step that does not lower the cost is taken back and shortened: without that
the sets of springs that act chase each other.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scanning.contact import REACH, Gaps, Sheet, clearance, crossings, gaps, samples
from scanning.errors import ScanError
from scanning.placement import Placement
from scanning.poses import ANGLES, AZIMUTH, RADIUS, Array, inverse, petal_poses, stem_angles
from scanning.terms import (
    ASSUMED,
    MEASUREMENTS,
    Habit,
    Measured,
    Terms,
    apart_and_nestled,
    inner_nearer,
    measured,
    on_receptacle,
    slopes,
    step_down,
)

MARGIN = 0.25  # mm between sheets that touch: a petal's thickness
SPAN = 3.5  # sd: no measurement is believed to be farther off
CAPS = np.where(np.isin(np.arange(6), ANGLES), 0.06, 1.5)  # rad, mm in one step: the gaps are linear only that far
STAGES = (3.0, 10.0, 30.0, 100.0, 100.0, 200.0, 400.0)  # 1/mm, weight of a gap against 1/sd of a measurement
DEEPEST, SHALLOWER = 0.8, 0.75  # mm, and per step: once the petals are nearly apart, what seems deeper is the far side of a fold
CONFLICT = 3.0  # sd

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
        assumed to be 0: base_side and roll.
    pairs : the pairs (inner, outer) that were kept, stated ones and those inferred from the measured poses.
    intersecting : pairs of petals that pass through each other.
    conflicts : what cannot be true together, in words.
    habit : what was assumed.
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
    habit: Habit = field(default_factory=Habit)
    seed: int = 0
    seconds: float = 0.0


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
    variance = sum((slopes(q, petal, at, seen.n) ** 2 * m.sd[petal] ** 2).sum(1) for petal, at in ((seen.i, seen.p), (seen.j, seen.c)))
    return np.sqrt(np.asarray(variance))


def _within(q: Array, m: Measured) -> Array:
    """Keep each coordinate within SPAN sd of its measurement, and the base on the outer side of the stem."""
    start = m.start()
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
    habit: Habit | None = None,
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
    habit : what is assumed of the flower.
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
    habit = habit or Habit()
    tell = progress or (lambda word, share: None)
    rng = np.random.default_rng(seed)
    k = len(names)
    m = measured(placement, names, inflection, habit)
    to_petal = np.array([inverse(pose) for pose in T_scan_petal])
    q = m.start()
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

    def judged(q: Array, seen: Gaps, weight: float) -> tuple[list[Terms], float]:
        pairs = [(i, j) if i_inside else (j, i) for (i, j), i_inside in inside.items()]
        terms = [
            m.terms(q),
            on_receptacle(q, habit.receptacle_u),
            inner_nearer(q, pairs, habit.radius_u),
            *apart_and_nestled(q, seen, signs(seen), habit, margin, weight),
        ]
        return terms, sum(part.cost for part in terms)

    best, least, caps, depth = q, np.inf, 1.0, REACH
    for stage, weight in enumerate(STAGES):
        seen = look(q, depth)
        terms, here = judged(q, seen, weight)
        for turn in range(steps):
            tell("moving", (stage + turn / steps) / len(STAGES))
            depth = max(DEEPEST, depth * SHALLOWER)
            step = step_down(terms).reshape(k, 6)
            # Shortened petal by petal, not coordinate by coordinate: a step keeps its direction.
            over = (np.abs(step) / (CAPS * caps)).max(1)
            trial = _within(q + step / np.maximum(over, 1.0)[:, None], m)
            then = look(trial, depth)
            ahead, there = judged(trial, then, weight)
            if there < here:
                gained, q, seen, terms, here, caps = here - there, trial, then, ahead, there, min(1.0, 2 * caps)
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
    tell("done", 1.0)
    pairs = [(i, j) if i_inside else (j, i) for (i, j), i_inside in inside.items()]
    return judge(names, sheets, best, petal_poses(best) @ to_petal, m, pairs, habit=habit, seed=seed, seconds=time.monotonic() - began)


def judge(
    names: list[str],
    sheets: list[Sheet],
    q: Array,
    poses: Array,
    m: Measured,
    pairs: list[tuple[int, int]],
    *,
    habit: Habit,
    seed: int = 0,
    seconds: float = 0.0,
) -> Assembly:
    """Return what is to be said of a flower as its petals lie, whoever put them there.

    Parameters
    ----------
    names, sheets : K petals and their meshes in scan frames, mm.
    q, poses : (K, 6) coordinates, and the same as T_flower_scan (K, 4, 4).
    m : what was measured.
    pairs : (inner, outer) that hold.
    habit : what is assumed of the flower.
    seed, seconds : of the run.
    """
    pierced = crossings(sheets, poses)
    residuals = m.residuals(q)
    crossing = sorted({(names[min(pair)], names[max(pair)]) for pair in pierced})
    return Assembly(
        names=names,
        state="intersecting" if pierced else "free",
        poses=poses,
        start=petal_poses(m.start()) @ np.linalg.inv(petal_poses(q)) @ poses,
        clearance=0.0 if pierced else clearance(sheets, poses),
        stem_angle=np.degrees(stem_angles(q, m.inflection)),
        azimuth=np.degrees(q[:, AZIMUTH]) % 360,
        residuals=residuals,
        pairs=sorted((names[inner], names[outer]) for inner, outer in pairs),
        intersecting=crossing,
        conflicts=_conflicts(names, residuals, on_receptacle(q, habit.receptacle_u).residual, crossing),
        habit=habit,
        seed=seed,
        seconds=seconds,
    )


def _conflicts(names: list[str], residuals: Array, off: Array, crossing: list[tuple[str, str]]) -> list[str]:
    out = []
    for name, row, lift in zip(names, residuals, off, strict=False):
        for what, pull in zip(MEASUREMENTS, row, strict=True):
            if abs(pull) > CONFLICT:
                out.append(
                    f"{name}: {what} is {pull:+.1f} standard uncertainties from what was {'assumed' if what in ASSUMED else 'measured'}"
                )
        if abs(lift) > CONFLICT:
            out.append(f"{name}: its base lies {lift:+.1f} standard uncertainties off the receptacle")
    for a, b in crossing:
        pulls = [(abs(residuals[names.index(n), c]), n, what) for n in (a, b) for c, what in enumerate(MEASUREMENTS)]
        pull, name, what = max(pulls)
        out.append(f"{a} and {b} intersect: look first at {what} of {name} ({pull:.1f} standard uncertainties)")
    return out
