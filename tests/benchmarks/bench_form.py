"""How fast the functional form answers, and how near it is to direct integration over all directions, beside scipy on the same nodes.

Run as `python -m tests.benchmarks form`. The integration's facets are others than the tables', and several times as many, and none of the
directions is a node: what is seen is what the tables' own sampling and what lies between their nodes do together.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from fitting.cells import Cell
from fitting.paper import TERMS
from fitting.radiometric import Sampling, paper_terms_any, radiometric_terms
from fitting.reflectance import PER_SR
from fitting.table import ALBEDO_MARGIN, paper_table, radiometric_table
from tests.benchmarks.report import verdict

Array = NDArray[np.float64]

X = {"u_diff": 0.3, "u_spec": 0.5, "s_diff": 0.2, "s_spec": 0.1}
DIRECTIONS = 4_000_000
REPEATS = 7
NS = 50.0
"""20 million directions a second."""

CELLS = (
    ("hemispheres", Cell(0.5), True),
    ("rose, aspect 1.9", Cell(1.9), True),
    ("aspect 3", Cell(3), False),
    ("aspect 1.9, p 1.3, q 1.6, gap 0.2", Cell(1.9, 1.3, 1.6, 0.2), False),
)
"""The targets are for the first two."""

THETA_I = np.array([5.3, 16.4, 25.3, 37.1, 46.2, 58.0, 67.3, 74.2, 80.7])
THETA_R = np.degrees(np.arccos((np.arange(60) + 0.5) / 60))  # even over the solid angle, up to 89.5 deg
PHI = np.sort(np.random.default_rng(8).uniform(0, 180, 20))


def rate(task: Callable[[], object], count: int, repeats: int = REPEATS) -> tuple[float, float]:
    """Shortest time per direction of some calls after the first, ns: on the clock, and of one core's time."""
    task()
    clock, core = [], []
    for _ in range(repeats):
        before = time.perf_counter(), time.process_time()
        task()
        clock.append(time.perf_counter() - before[0])
        core.append(time.process_time() - before[1])
    return 1e9 * min(clock) / count, 1e9 * min(core) / count


def errors(found: Array, exact: Array) -> tuple[Array, Array]:
    """Rms and 99th percentile of the difference at each theta_i, percent of the mean over the hemisphere."""
    relative = 100 * np.abs(found - exact) / exact.mean(axis=(1, 2), keepdims=True)
    return np.sqrt(np.mean(relative**2, axis=(1, 2))), np.quantile(relative, 0.99, axis=(1, 2))


def compared(what: str, found: Array, exact: Array, judged: bool) -> int:
    """Print one basis function's errors, and judge them over all incidences together."""
    rms, p99 = errors(found, exact)
    for label, values in (("rms", rms), ("99th", p99)):
        print(f"      {what} {label}, % at each theta_i: {' '.join(f'{v:.2f}' for v in values)}")
    all_together = 100 * np.abs(found - exact) / exact.mean(axis=(1, 2), keepdims=True)
    weight = np.sin(np.radians(THETA_I))[:, None, None] * np.ones_like(all_together)
    order = np.argsort(all_together, axis=None)
    share = np.cumsum(weight.ravel()[order]) / weight.sum()
    total, most = math.sqrt(np.average(all_together**2, weights=weight)), float(all_together.ravel()[order][np.searchsorted(share, 0.99)])
    if not judged:
        print(f"   {what}: {total:.2f} % rms of the mean over the hemisphere, 99th percentile {most:.2f} %")
        return 0
    missed = verdict(f"{what}, rms of the mean over the hemisphere", total, 1, " %")
    return missed + verdict(f"{what}, 99th percentile", most, 3, " %")


def precision() -> int:
    """Compare tables with integration, in both modes; scipy's linear interpolation of the same nodes beside it."""
    missed = 0
    for what, cell, judged in CELLS:
        phi, finely = (PHI, Sampling(100_003, 12)) if judged else (PHI[::4], Sampling(60_013, 8))
        directions = THETA_I[:, None, None], THETA_R[:, None], phi
        at = np.stack(np.broadcast_arrays(*directions), axis=-1)
        for make, integrate in ((paper_table, paper_terms_any), (radiometric_table, radiometric_terms)):
            before = time.perf_counter(), time.process_time()
            table = make(cell)
            clock, core = time.perf_counter() - before[0], time.process_time() - before[1]
            between = " ".join(f"{name} {100 * error:.2g}" for name, error in table.provenance["error_between_nodes"].items())
            print(f"   {what}, {table.mode}: {clock:.1f} s, {core:.1f} s of one core; says of itself, % rms between nodes: {between}")
            exact = integrate(*directions, cell=cell, sampling=finely).reshape(*at.shape[:-1], len(TERMS))
            found = table.evaluate(*directions)
            for n, name in enumerate(TERMS[:2]):
                missed += compared(f"{name}, {what}, {table.mode}", found[..., n], exact[..., n], judged)
                linear = RegularGridInterpolator(table.nodes, table.values[n].astype(float), bounds_error=False, fill_value=None)(at)
                print(f"      scipy, linear on the same nodes: rms {np.max(errors(linear, exact[..., n])[0]):.2f} % at the worst theta_i")
            off = " ".join(f"{name} {table.alone(name).reciprocity():.2g}" for name in TERMS)
            print(f"   reciprocity: off by {off} of the mean")
            if table.mode == PER_SR:
                most = max(float(table.alone(name).albedo(table.nodes[0]).max()) for name in TERMS)
                missed += verdict("largest albedo of a term, any theta_i", most, 1 + ALBEDO_MARGIN)
    return missed


def speed() -> int:
    """Print rates of evaluation and of sampling."""
    table = paper_table(Cell(1.9))
    shade = table.mixed(X)
    theta_i, theta_r, phi = np.random.default_rng(0).uniform([[0], [-90], [-180]], [[90], [90], [180]], (3, DIRECTIONS))
    clock, core = rate(lambda: shade.evaluate(theta_i, theta_r, phi), DIRECTIONS)
    cores = os.cpu_count() or 1
    note = f"{1e3 / clock:.1f} million a second; by the time of its {cores} cores, were they free, {cores * 1e3 / core:.1f}"
    missed = verdict("evaluate, time per direction", clock, NS, " ns", note=note)
    few = 100_000
    values = np.tensordot([X[name] for name in table.names], table.values.astype(float), 1)
    folded = np.stack([theta_i, np.abs(theta_r), np.where(theta_r < 0, 180 - np.abs(phi), np.abs(phi))], axis=-1)[:few]
    for method in ("linear", "cubic"):
        scipy = RegularGridInterpolator(table.nodes, values, method=method)
        some = few if method == "linear" else few // 100
        theirs, _ = rate(lambda scipy=scipy, some=some: scipy(folded[:some]), some, 3)  # type: ignore[misc]
        print(f"   scipy RegularGridInterpolator, {method}: {theirs:.0f} ns per direction, {theirs / clock:.0f} times as long")
    u1, u2 = np.random.default_rng(1).random((2, 1_000_000))
    for what, task in (
        ("sample", lambda: shade.sample(theta_i[: len(u1)], u1, u2)),
        ("pdf", lambda: shade.pdf(theta_i[: len(u1)], theta_r[: len(u1)], phi[: len(u1)])),
    ):
        clock, core = rate(task, len(u1), 3)
        print(f"   {what}: {clock:.0f} ns, {core:.0f} ns of one core")
    return missed


def main() -> int:
    """Print the figures; return how many targets are missed."""
    return speed() + precision()


if __name__ == "__main__":
    raise SystemExit(main())
