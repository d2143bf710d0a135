"""What the poses of a flower's petals are judged by: residuals in standard uncertainties, linear about the present coordinates.

Measured: azimuth, base and stem angle of each petal. Assumed of any flower, because nobody measures it (`Habit`): petals grow out from the
stem, on one receptacle, the inner ones nearer to the stem, and lie against each other. Demanded: no gap less than a margin.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.contact import Gaps
from scanning.placement import Placement
from scanning.poses import AZIMUTH, HEIGHT, RADIUS, ROLL, SIDE, Array, measured_coordinates, stem_angles, twists

MEASUREMENTS = {"azimuth": "deg", "base_radius": "mm", "base_height": "mm", "stem_angle": "deg", "base_side": "mm", "roll": "deg"}
ASSUMED = ("base_side", "roll")  # of the above: taken to be 0
_ORDER = (AZIMUTH, RADIUS, HEIGHT, None, SIDE, ROLL)  # the coordinate behind each measurement; None: a function of several
_AHEAD = 1.5  # mm beyond the margin: a gap wider than that does not close within one step


@dataclass(frozen=True)
class Habit:
    """How petals grow, with standard uncertainties: assumptions about roses, none of them measured [U].

    Attributes
    ----------
    side_u : mm by which a base stands beside the meridian plane in which its petal grows.
    roll_u : degrees by which a petal is turned about its base-tip line.
    receptacle_u : mm by which a base lies off the receptacle, a cone about the stem.
    radius_u : mm by which an inner petal's base may be farther from the stem than an outer one's: petals arise from the outside inwards.
    nestle, nestle_u : mm; a petal's least gap to those inside it is no more than `nestle`, give or take `nestle_u`.
    """

    side_u: float = 0.5
    roll_u: float = 3.0
    receptacle_u: float = 0.3
    radius_u: float = 0.3
    nestle: float = 0.5
    nestle_u: float = 0.3


@dataclass(frozen=True)
class Terms:
    """A part of the cost.

    Attributes
    ----------
    residual : (M,) in standard uncertainties.
    rows : (M, 6 K) sparse matrix, derivative by all coordinates.
    one_sided : whether a residual counts only where it is negative.
    """

    residual: Array
    rows: Any
    one_sided: bool = False

    @property
    def cost(self) -> float:
        """Sum of the squares of what counts."""
        counts = np.minimum(self.residual, 0.0) if self.one_sided else self.residual
        return float(counts @ counts)


@dataclass(frozen=True)
class Measured:
    """The measurements: values and sd (K, 6) in the order of `MEASUREMENTS`, the inflections' directions (K, 3); rad and mm."""

    values: Array
    sd: Array
    inflection: Array

    def start(self) -> Array:
        """Return the coordinates (K, 6) that the measurements alone give."""
        v = self.values
        return measured_coordinates(np.degrees(v[:, 0]), v[:, 1], v[:, 2], np.degrees(v[:, 3]), self.inflection)

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

    def terms(self, q: Array) -> Terms:
        """Return the measurements' part of the cost."""
        from scipy.sparse import block_diag

        return Terms(self.residuals(q).ravel(), block_diag(list(self.jacobian(q)), format="csr"))


def measured(placement: Placement, names: list[str], inflection: Array, habit: Habit) -> Measured:
    """Return the measurements of a placement, and what is assumed of single petals, as arrays.

    Parameters
    ----------
    placement, names : the measurements, and the petals' order.
    inflection : (K, 3) directions of the midribs at their inflections in the petals' frames.
    habit : gives the uncertainties of base_side and roll, whose values are 0.
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
        np.full(len(petals), habit.side_u),
        np.full(len(petals), np.radians(habit.roll_u)),
    ]
    return Measured(np.array(columns, float).T, np.array(sd, float).T, inflection)


def on_receptacle(q: Array, receptacle_u: float) -> Terms:
    """Return how far each base lies off the receptacle.

    The receptacle is the cone height = a + b radius that fits the bases best. The fit is projected out (variable projection in Kaufman's
    form, BIT Numerical Mathematics 15, 49, 1975), so a and b are no variables.

    Parameters
    ----------
    q : (K, 6) coordinates; radians and mm.
    receptacle_u : mm by which a base may lie off the cone.

    Returns
    -------
    Terms
        K + 1 of them: one for each base, and the last for the cone's slope.
    """
    from scipy.sparse import csr_matrix

    k = len(q)
    # One row more, the slope is 0 give or take 1, serves where all bases have one radius.
    basis = np.vstack([np.stack([np.ones(k), q[:, RADIUS]], 1), [0.0, receptacle_u]])
    fit = np.linalg.pinv(basis)
    project = (np.eye(k + 1) - basis @ fit)[:, :k] / receptacle_u
    slope = fit[1, :k] @ q[:, HEIGHT]
    jacobian = np.zeros((k + 1, k, 6))
    jacobian[:, :, HEIGHT] = project
    jacobian[:, :, RADIUS] = -slope * project
    return Terms(project @ q[:, HEIGHT], csr_matrix(jacobian.reshape(k + 1, 6 * k)))


def inner_nearer(q: Array, pairs: list[tuple[int, int]], radius_u: float) -> Terms:
    """Return by how much the base of each outer petal is farther from the stem than the inner one's; it counts where it is not.

    Parameters
    ----------
    q : (K, 6) coordinates; radians and mm.
    pairs : (inner, outer).
    radius_u : mm.
    """
    from scipy.sparse import csr_matrix

    inner, outer = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    each, one = np.arange(len(inner)), np.ones(len(inner)) / radius_u
    columns = np.r_[6 * outer + RADIUS, 6 * inner + RADIUS]
    rows = csr_matrix((np.r_[one, -one], (np.r_[each, each], columns)), (len(inner), q.size))
    return Terms((q[outer, RADIUS] - q[inner, RADIUS]) / radius_u, rows, one_sided=True)


def apart_and_nestled(q: Array, seen: Gaps, sign: Array, habit: Habit, margin: float, weight: float) -> list[Terms]:
    """Return what is demanded and what is assumed of the gaps: none less than the margin, and each petal's least not wide.

    Parameters
    ----------
    q : (K, 6) coordinates; radians and mm.
    seen : M gaps at q.
    sign : (M,) 1 where the gap's point must lie on the inner face's side of the other sheet, -1 on the outer's, 0 unknown.
    habit : how close petals lie.
    margin : mm, demanded.
    weight : 1/mm, of what lacks of the margin.
    """
    from scipy.sparse import csr_matrix

    gap = np.where(sign == 0, np.inf, sign * seen.height)
    wide = _least_where_wide(seen, sign, gap, habit.nestle)
    near = gap < margin + _AHEAD
    near[wide] = True
    at = (np.cumsum(near) - 1)[wide]
    i, j, n, gap = seen.i[near], seen.j[near], seen.n[near] * sign[near, None], gap[near]
    rows = np.concatenate([slopes(q, i, seen.p[near], n), -slopes(q, j, seen.c[near], n)], 1)
    columns = np.concatenate([6 * i[:, None] + np.arange(6), 6 * j[:, None] + np.arange(6)], 1)
    matrix = csr_matrix((rows.ravel(), columns.ravel(), np.arange(len(i) + 1) * 12), (len(i), q.size))
    return [
        Terms(weight * (gap - margin), weight * matrix, one_sided=True),
        Terms((gap[at] - habit.nestle) / habit.nestle_u, matrix[at] / habit.nestle_u),
    ]


def slopes(q: Array, petal: NDArray[np.int64], p: Array, n: Array) -> Array:
    """Return how fast points p (M, 3) of petals move along n (M, 3) with each of their petal's coordinates, (M, 6)."""
    omega, v = twists(q)
    # n . (omega x p) = omega . (p x n)
    return np.asarray(np.einsum("mci,mi->mc", omega[petal], np.cross(p, n)) + np.einsum("mci,mi->mc", v[petal], n))


def _least_where_wide(seen: Gaps, sign: Array, gap: Array, nestle: float) -> NDArray[np.intp]:
    """Return the least gap of each petal to those inside it, of the petals where that is more than `nestle` mm."""
    outer = np.where(sign > 0, seen.j, seen.i)
    order = np.lexsort((gap, outer))
    least = order[np.unique(outer[order], return_index=True)[1]]
    return least[(gap[least] > nestle) & np.isfinite(gap[least])]


def step_down(terms: list[Terms]) -> Array:
    """Return the step (6 K,) to the least cost of the linearised terms.

    The problem is convex with kinks where one-sided terms begin to act: Newton's direction for those that do, shortened until the cost
    falls.
    """
    from scipy.sparse import vstack

    both, one = ([t for t in terms if t.one_sided == sided] for sided in (False, True))
    fixed, rows = (vstack([t.rows for t in some]).tocsr() for some in (both, one))
    residual = np.concatenate([t.residual for t in one])
    prior = (fixed.T @ fixed).toarray()
    right = -fixed.T @ np.concatenate([t.residual for t in both])

    def cost(step: Array) -> float:
        return float(0.5 * step @ prior @ step - right @ step + 0.5 * (np.minimum(residual + rows @ step, 0.0) ** 2).sum())

    step = np.zeros(len(right))
    for _ in range(12):
        short = np.minimum(residual + rows @ step, 0.0)
        acting = rows[short < 0]
        direction = np.linalg.solve(prior + (acting.T @ acting).toarray(), right - prior @ step - rows.T @ short)
        length, here = 1.0, cost(step)
        while cost(step + length * direction) > here and length > 1e-3:
            length /= 2
        if length <= 1e-3 or np.abs(length * direction).max() < 1e-5:
            break
        step = step + length * direction
    return step
