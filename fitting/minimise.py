"""Least squares within bounds, global then local, with an account of whether the minimum found can be trusted.

The search: a local descent from the caller's start, controlled random search over the whole box (NLopt's CRS2 with local mutation),
further descents from the best of seeded random points; then the best minimum is polished. Descents are trust-region Gauss-Newton.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError, FitError

Array = NDArray[np.float64]

DECADES = 2.0
"""A parameter whose bounds have one sign and lie this many decades apart, or more, is searched by its logarithm."""

STATIONARY = 1e-5
"""Largest relative offset of a minimum, unless another is asked for: the part of the residuals that the parameters could still take
away, as a fraction of them."""

STEP = 1e-9
"""A last Gauss-Newton step below this fraction of the bounds' distance is no step: it decides where the residuals themselves vanish."""

SAME_COST = 1e-6
"""Sums of squares this near each other, relatively, are one minimum's."""

SAME_PLACE = 1e-3
"""Minima this near each other, as a fraction of the bounds' distance, are one."""

AT_BOUND = 1e-6
"""A parameter this near a bound, as a fraction of the bounds' distance, is at it."""

POLISH = 20
"""Gauss-Newton steps of the polish, at most."""

DIFFERENCE = 6e-6
"""Half the span of central differences unless another is asked for: the cube root of the rounding error."""

DRAWN = 8
"""Random points drawn for each descent that begins at the best of them."""

RANK_TOLERANCE = 1e-8
"""Singular values of the Jacobian (columns scaled to length 1) below this fraction of the largest count as zero."""


@dataclass(frozen=True, eq=False)
class Restart:
    """One local descent.

    Attributes
    ----------
    origin : str
        "start", "global search" or "random point 1", ...
    begun, x : ndarray, shape (p,)
        Where it began and where it ended.
    cost : float
        Sum of squares at `x`.
    converged : bool
        Whether `x` is a minimum within the bounds by the test of `Minimum.offset`.
    offset : float
        See `Minimum.offset`.
    stopped : str
        Why it ended.
    evaluations : int
        Of the residuals, derivatives included.
    """

    origin: str
    begun: Array
    x: Array
    cost: float
    converged: bool
    offset: float
    stopped: str
    evaluations: int


@dataclass(frozen=True, eq=False)
class Minimum:
    """The least sum of squares found.

    Attributes
    ----------
    x : ndarray, shape (p,)
        Parameters.
    cost : float
        Sum of squares of `residuals`.
    residuals : ndarray, shape (n,)
    jacobian : ndarray, shape (n, p)
        Derivatives of the residuals by the parameters, at `x`, central differences.
    converged : bool
        Whether `x` is a minimum within the bounds. It says nothing of others; see `disagreeing`.
    offset : float
        Bates and Watts' measure (Technometrics 23, 179, 1981): length of the residuals' part along the tangents of the parameters free to
        move, over their length. 0 at a minimum; at most `stationary` counts as one.
    stopped : str
        Why the polish ended.
    at_bounds : tuple of (int, str)
        Parameters that ended at a bound, "lower" or "upper": the best may lie outside.
    rank : int
        Independent directions among the columns of the Jacobian; below p, some parameters trade against one another or do nothing.
    restarts : tuple of Restart
        All descents, in the order in which they were made; the best of them was polished.
    best : int
        Which of them.
    evaluations : int
        Of the residuals, in all.
    refused : int
        Evaluations that gave no finite residuals and were taken as infinitely bad.
    """

    x: Array
    cost: float
    residuals: Array
    jacobian: Array
    converged: bool
    offset: float
    stopped: str
    at_bounds: tuple[tuple[int, str], ...]
    rank: int
    restarts: tuple[Restart, ...]
    best: int
    evaluations: int
    refused: int
    _box: _Box
    _negligible: float  # difference between sums of squares

    @property
    def disagreeing(self) -> tuple[Restart, ...]:
        """Descents that ended elsewhere: in a worse minimum, in an equally good one at another place, or in none."""
        return tuple(r for r in self.restarts if not self._same(r))

    def _same(self, restart: Restart) -> bool:
        near = np.max(np.abs(self._box.to_unit(restart.x) - self._box.to_unit(self.x))) <= SAME_PLACE
        return bool(near) and restart.cost <= self.cost + self._negligible

    @property
    def rivals(self) -> tuple[Restart, ...]:
        """Descents that ended equally low at another place: the readings do not tell the two apart."""
        return tuple(r for r in self.disagreeing if r.cost <= self.cost + self._negligible)

    @property
    def statement(self) -> str:
        """What was found and how far to trust it, in a few sentences."""
        said = [
            f"{'converged' if self.converged else 'NOT converged'}: {self.stopped} (relative offset {self.offset:.1e})",
            f"sum of squares {self.cost:.6g} after {self.evaluations} evaluations, {self.refused} of them refused",
            f"{len(self.restarts) - len(self.disagreeing)} of {len(self.restarts)} descents agree",
        ]
        said += [f"{r.origin} ended elsewhere, at {r.cost:.6g}: {_listed(r.x)}" for r in self.disagreeing]
        if self.rivals:
            said.append("NOT determined: other parameters fit equally well")
        if self.rank < len(self.x):
            said.append(f"NOT determined: the residuals fix only {self.rank} combinations of {len(self.x)} parameters")
        said += [f"parameter {i} ended at its {side} bound, {self.x[i]:g}" for i, side in self.at_bounds]
        return "; ".join(said)


@dataclass(frozen=True, eq=False)
class _Box:
    """Bounds, and the unit cube they are searched as: linear, or logarithmic where they span decades."""

    lower: Array
    upper: Array
    log: NDArray[np.bool_]
    sign: Array

    @classmethod
    def of(cls, bounds: ArrayLike) -> _Box:
        try:
            box = np.array(bounds, dtype=float)
        except (TypeError, ValueError) as error:
            raise DomainError(f"bounds must be pairs of numbers: {error}") from error
        if box.ndim != 2 or box.shape[1] != 2 or not len(box):
            raise DomainError(f"bounds must be a (lower, upper) pair for each parameter, not of shape {box.shape}")
        for i, (low, high) in enumerate(box):
            if not (math.isfinite(low) and math.isfinite(high) and low < high and math.isfinite(high - low)):
                raise DomainError(f"bounds of parameter {i} are {low:g} to {high:g}, expected finite ones, the lower below the upper")
        small, large = np.min(np.abs(box), axis=1), np.max(np.abs(box), axis=1)
        one_sign = (box[:, 0] > 0) | (box[:, 1] < 0)
        log = one_sign & (np.log10(np.where(one_sign, large, 1)) - np.log10(np.where(one_sign, small, 1)) >= DECADES)
        return cls(box[:, 0], box[:, 1], log, np.where(box[:, 1] < 0, -1.0, 1.0))

    @property
    def ends(self) -> tuple[Array, Array]:
        return self._bend(self.lower), self._bend(self.upper)

    def _bend(self, x: Array) -> Array:
        bent = np.array(x, dtype=float)
        bent[self.log] = self.sign[self.log] * np.log(np.abs(bent[self.log]))
        return bent

    def to_unit(self, x: Array) -> Array:
        low, high = self.ends
        return np.clip((self._bend(x) - low) / (high - low), 0, 1)

    def from_unit(self, u: Array) -> Array:
        low, high = self.ends
        x = low + u * (high - low)
        x[self.log] = self.sign[self.log] * np.exp(self.sign[self.log] * x[self.log])
        return np.clip(x, self.lower, self.upper)  # rounding only: u is within 0 to 1


class _Counted:
    """The residuals over the unit cube, checked and counted."""

    def __init__(self, residuals: Callable[[Array], ArrayLike], box: _Box, difference: float, stationary: float) -> None:
        self.residuals, self.box, self.difference, self.stationary = residuals, box, difference, stationary
        self.evaluations = self.refused = 0
        self.size: int | None = None
        self.raised: Exception | None = None

    def __call__(self, u: Array) -> Array:
        """Return the residuals; infinite, all of them, where any is not finite."""
        self.evaluations += 1
        try:
            with np.errstate(all="ignore"):
                found = np.asarray(self.residuals(self.box.from_unit(np.asarray(u, dtype=float))), dtype=float)
        except Exception as error:
            self.raised = error  # so that it is not taken for an optimiser's own
            raise
        if found.ndim != 1 or not found.size:
            raise FitError(f"the residuals must be a vector with at least one entry, not of shape {found.shape}")
        if self.size not in (None, found.size):
            raise FitError(f"the residuals changed their number from {self.size} to {found.size}")
        self.size = found.size
        with np.errstate(all="ignore"):
            usable = bool(np.isfinite(found @ found))
        if not usable:
            self.refused += 1
            return np.full(found.size, np.inf)
        return found

    def cost(self, u: Array) -> float:
        found = self(u)
        return float(found @ found)

    def jacobian(self, u: Array) -> tuple[Array, bool]:
        """Central differences within the cube, of one side at its faces and beside refused points; and whether all could be had."""
        columns, complete = [], True
        for j in range(len(u)):
            ahead, behind = u.copy(), u.copy()
            ahead[j], behind[j] = min(1.0, u[j] + self.difference), max(0.0, u[j] - self.difference)
            sides = [(v[j], found) for v in (ahead, behind) if np.isfinite(found := self(v)).all()]
            if len(sides) == 1:
                sides.append((u[j], self(u)))
            complete &= len(sides) == 2
            columns.append((sides[0][1] - sides[1][1]) / (sides[0][0] - sides[1][0]) if len(sides) == 2 else np.zeros(self.size or 0))
        return np.column_stack(columns), complete


def minimise(
    residuals: Callable[[Array], ArrayLike],
    bounds: ArrayLike,
    *,
    start: ArrayLike | None = None,
    seed: int = 0,
    global_evaluations: int = 2000,
    starts: int = 4,
    iterations: int = 500,
    difference: float = DIFFERENCE,
    stationary: float = STATIONARY,
) -> Minimum:
    """Minimise the sum of squares of residuals within bounds.

    Parameters
    ----------
    residuals : callable
        From parameters, ndarray of shape (p,), to residuals of shape (n,), always as many. Where it returns some that are not finite, the
        parameters are taken as infinitely bad; what it raises is passed on.
    bounds : array_like, shape (p, 2)
        Lower and upper bound of each parameter.
    start : array_like, shape (p,), optional
        Where the first descent begins.
    seed : int
        Of all that is random; the same seed gives the same minimum. NLopt's generator is seeded with it.
    global_evaluations : int
        Evaluations the global search may spend; 0 leaves it out.
    starts : int
        Further descents from random points.
    iterations : int
        Steps that one descent may try; each costs an evaluation, and 2p more where it is taken.
    difference : float
        Half the span of central differences, as a fraction of the bounds' distance. The default suits residuals exact to rounding; those
        that come from a quadrature want more.
    stationary : float
        Largest relative offset of what is called a minimum (see `Minimum.offset`).

    Returns
    -------
    Minimum

    Raises
    ------
    DomainError
        If the bounds, the start or a setting make no sense.
    FitError
        If no point with finite residuals was found, or the residuals are not a vector of constant length.
    """
    box = _Box.of(bounds)
    p = len(box.lower)
    if iterations < 1:
        raise DomainError(f"iterations must be 1 or more, not {iterations}")
    for name, fraction in (("difference", difference), ("stationary", stationary)):
        if not 0 < fraction < 0.5:
            raise DomainError(f"{name} must lie between 0 and 0.5, not {fraction}")
    for name, value in (("seed", seed), ("global_evaluations", global_evaluations), ("starts", starts)):
        if value < 0:
            raise DomainError(f"{name} must be 0 or more, not {value}")
    function = _Counted(residuals, box, difference, stationary)
    begins: list[tuple[str, Array]] = []
    if start is not None:
        begins.append(("start", box.to_unit(_checked_start(start, box))))
    if global_evaluations and (found := _search(function, p, seed, global_evaluations)) is not None:
        begins.append(("global search", found))
    begins += [(f"random point {k + 1}", u) for k, u in enumerate(_drawn(function, p, seed, starts))]
    if not begins:
        raise FitError(
            f"nothing to descend from: none of {function.evaluations} points gave finite residuals"
            if function.evaluations
            else "nowhere to begin: give a start, global_evaluations or starts"
        )
    restarts, units, scale = [], [], 0.0
    for origin, u in begins:
        before = function.evaluations
        if not math.isfinite(first := function.cost(u)):
            raise FitError(
                f"the residuals are not finite at the {origin} ({_listed(box.from_unit(u))}): begin elsewhere or narrow the bounds"
            )
        end, why = _descend(function, u, iterations)
        at = _judge(function, end)
        scale = max(scale, first)
        units.append(end)
        restarts.append(
            Restart(origin, box.from_unit(u), box.from_unit(end), at.cost, at.converged, at.offset, why, function.evaluations - before)
        )
    best = min(range(len(restarts)), key=lambda k: restarts[k].cost)
    return _polished(function, units[best], restarts, best, scale)


def _checked_start(start: ArrayLike, box: _Box) -> Array:
    x = np.asarray(start, dtype=float)
    if x.shape != box.lower.shape:
        raise DomainError(f"the start must have {len(box.lower)} parameters as the bounds do, not shape {x.shape}")
    for i in range(len(x)):
        if not box.lower[i] <= x[i] <= box.upper[i]:
            raise DomainError(f"start: parameter {i} is {x[i]:g}, outside its bounds {box.lower[i]:g} to {box.upper[i]:g}")
    return x


def _search(function: _Counted, p: int, seed: int, evaluations: int) -> Array | None:
    """Best point of a global search over the cube, or None if none gave finite residuals."""
    import nlopt

    best: tuple[float, Array | None] = (math.inf, None)
    raised: BaseException | None = None

    def objective(u: Array, _gradient: Array) -> float:
        nonlocal best, raised
        try:
            cost = function.cost(np.clip(u, 0, 1))
        except BaseException as error:  # an exception must not pass through the C code, which would call again
            raised = error
            search.force_stop()
            return 1e300
        if cost < best[0]:
            best = cost, np.clip(u, 0, 1)
        return min(cost, 1e300)  # NLopt compares costs, and infinity would end some of its steps

    nlopt.srand(seed + 1)  # 0 would seed by the clock
    search = nlopt.opt(nlopt.GN_CRS2_LM, p)
    search.set_lower_bounds(np.zeros(p))
    search.set_upper_bounds(np.ones(p))
    search.set_min_objective(objective)
    search.set_maxeval(evaluations)
    search.set_ftol_rel(1e-6)  # the descent does the rest
    try:
        search.optimize(np.full(p, 0.5))
    except nlopt.RoundoffLimited:
        pass  # as near as the search can come; it is a beginning only
    except (nlopt.ForcedStop, RuntimeError) as error:
        if raised is None:
            raise FitError(f"the global search failed: {error}") from error
    if raised is not None:
        raise raised
    return best[1]


def _drawn(function: _Counted, p: int, seed: int, starts: int) -> list[Array]:
    """Best of each `DRAWN` points spread evenly over the cube."""
    if not starts:
        return []
    from scipy.stats import qmc

    points = qmc.LatinHypercube(p, rng=np.random.default_rng(seed)).random(starts * DRAWN)
    costs = np.array([function.cost(u) for u in points])
    chosen = [k + int(np.argmin(costs[k : k + DRAWN])) for k in range(0, len(points), DRAWN)]
    return [points[k] for k in chosen if math.isfinite(costs[k])]


def _descend(function: _Counted, u: Array, iterations: int) -> tuple[Array, str]:
    """Go down from a point; return the end and why it is one."""
    from scipy.optimize import least_squares

    tight = 4 * np.finfo(float).eps
    inside = np.clip(u, 1e-9, 1 - 1e-9)
    try:
        with np.errstate(all="ignore"):
            found = least_squares(
                function,
                inside,
                bounds=(0, 1),
                jac=lambda at: function.jacobian(at)[0],
                method="trf",
                x_scale="jac",
                ftol=tight,
                xtol=tight,
                gtol=tight,
                max_nfev=iterations,
            )
    except (ValueError, np.linalg.LinAlgError) as error:
        if function.raised is not None:
            raise
        return u, f"the descent failed: {error}"  # judged where it began
    why = {0: "no evaluations left", 1: "no slope left", 2: "the cost falls no more", 3: "the step vanished", 4: "cost and step vanished"}
    return found.x, why[found.status]


@dataclass(frozen=True, eq=False)
class _Local:
    """The residuals to first order about a point of the cube."""

    cost: float
    offset: float
    step: Array  # of Gauss and Newton, for the parameters free to move; 0 for the others
    held: NDArray[np.bool_]  # leaning on a bound
    jacobian: Array
    stationary: float

    @property
    def converged(self) -> bool:
        return self.offset <= self.stationary or bool(np.max(np.abs(self.step)) <= STEP)


def _judge(function: _Counted, u: Array) -> _Local:
    residual = function(u)
    jacobian, complete = function.jacobian(u)
    cost = float(residual @ residual)
    slope = jacobian.T @ residual
    held = ((u <= AT_BOUND) & (slope > 0)) | ((u >= 1 - AT_BOUND) & (slope < 0))
    length = np.linalg.norm(jacobian, axis=0)
    free = ~held & (length > 0)
    step = np.zeros(len(u))
    if not complete:
        return _Local(cost, 1.0, step + 1, held, jacobian, function.stationary)  # hemmed in by refused points: not known to be a minimum
    if cost == 0 or not free.any():
        return _Local(cost, 0.0, step, held, jacobian, function.stationary)
    tangent, singular, turn = np.linalg.svd(jacobian[:, free] / length[free], full_matrices=False)
    known = singular > RANK_TOLERANCE * singular[0]
    along = tangent[:, known].T @ residual
    step[free] = -(turn[known].T @ (along / singular[known])) / length[free]
    return _Local(cost, float(np.linalg.norm(along) / math.sqrt(cost)), step, held, jacobian, function.stationary)


def _polished(function: _Counted, u: Array, restarts: list[Restart], best: int, scale: float) -> Minimum:
    """Take the best descent's end to the last digits, onto the bounds it leans on, and judge it."""
    box, why = function.box, restarts[best].stopped
    here = _judge(function, u)
    for _ in range(POLISH):
        resting = np.where(here.held, np.round(u), u)
        trials = [resting + part * here.step for part in (1.0, 0.3, 0.0)]
        found = next((t for t in (np.clip(t, 0, 1) for t in trials) if not np.array_equal(t, u) and function.cost(t) < here.cost), None)
        if found is None:
            break
        u, why, here = found, "polished until the sum of squares fell no more", _judge(function, found)
    x = box.from_unit(u)
    low, high = box.ends
    # By the chain rule of the logarithm where the search is logarithmic.
    stretch = np.where(box.log, 1 / np.where(box.log, np.abs(x), 1), 1) / (high - low)
    length = np.linalg.norm(here.jacobian, axis=0)
    return Minimum(
        x=x,
        cost=here.cost,
        residuals=function(u),
        jacobian=here.jacobian * stretch,
        converged=here.converged,
        offset=here.offset,
        stopped=why,
        at_bounds=tuple((i, "lower" if v < 0.5 else "upper") for i, v in enumerate(u) if min(v, 1 - v) <= AT_BOUND),
        rank=int(np.linalg.matrix_rank(here.jacobian / np.where(length > 0, length, 1), tol=RANK_TOLERANCE)),
        restarts=tuple(restarts),
        best=best,
        evaluations=function.evaluations,
        refused=function.refused,
        _box=box,
        _negligible=SAME_COST * max(here.cost, math.ulp(1.0) * scale),
    )


def _listed(x: Array) -> str:
    return ", ".join(f"{v:.6g}" for v in x)
