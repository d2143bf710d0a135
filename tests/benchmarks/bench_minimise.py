"""How near the minimiser comes to certified values: NIST's eight nonlinear sets of higher difficulty, from both certified starts.

LRE is the number of right digits of the worst parameter. Beside it, plain `scipy.optimize.least_squares` with its default settings
and with tight tolerances, unbounded, from the same starts. Bounds are taken from the start alone: a factor `REACH` either way of each
parameter.
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fitting.minimise import minimise
from tests.benchmarks.report import verdict
from tests.fitting.nist import SETS, Certified

Array = NDArray[np.float64]

REACH = 1000.0
TIGHT = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "jac": "3-point", "x_scale": "jac", "max_nfev": 10_000}


def around(start: tuple[float, ...]) -> Array:
    """Bounds a factor `REACH` either side of a start, shape (p, 2)."""
    return np.sort(np.outer(start, [1 / REACH, REACH]), axis=1)


def plain(problem: Certified, start: tuple[float, ...], **settings: Any) -> str:
    """What scipy gets by itself: right digits, evaluations and ms."""
    count = 0

    def counted(b: Array) -> Array:
        nonlocal count
        count += 1
        return problem.residuals(b)

    before = time.perf_counter()
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            digits = f"{max(0.0, problem.digits(least_squares(counted, start, **settings).x)):5.1f}"
    except (ValueError, np.linalg.LinAlgError):
        digits = " fail"
    return f"{digits}  {count:7d}  {1e3 * (time.perf_counter() - before):6.0f}"


def main() -> int:
    """Print the figures; return how many targets were missed."""
    print(f"bounds a factor {REACH:g} either way of the start; LRE, evaluations of the residuals, ms")
    print("                     minimise                                      scipy, defaults           scipy, tight")
    print("   set       start    LRE   evaluations     ms  agree   converged    LRE     eval.      ms     LRE     eval.      ms")
    worst, unsure = np.inf, 0
    minimise(SETS[0].residuals, around(SETS[0].starts[1]), starts=1)  # loads what is loaded late
    for problem in SETS:
        for number, start in enumerate(problem.starts, 1):
            before = time.perf_counter()
            found = minimise(problem.residuals, around(start), start=start)
            took = 1e3 * (time.perf_counter() - before)
            digits = problem.digits(found.x)
            worst, unsure = min(worst, digits), unsure + (not found.converged)
            agree = f"{len(found.restarts) - len(found.disagreeing)}/{len(found.restarts)}"
            ours = f"{digits:5.1f}  {found.evaluations:12d}  {took:5.0f}  {agree:>5s}  {found.converged!s:>9s}"
            print(
                f"   {problem.name:9s} {number:5d}  {ours}   {plain(problem, start)}   {plain(problem, start, **TIGHT)}",
                flush=True,
            )
    missed = verdict("largest relative error of a parameter", 10**-worst, 1e-6, note=f"fewest digits {worst:.1f}")
    missed += verdict("minima not said to have converged", unsure, 0)
    print("   without any start, within the bounds of the second:")
    for problem in SETS:
        found = minimise(problem.residuals, around(problem.starts[1]))
        print(f"     {problem.name:9s} LRE {max(0.0, problem.digits(found.x)):4.1f}; {found.statement.split(' ended elsewhere')[0]}")
    return missed


if __name__ == "__main__":
    raise SystemExit(main())
