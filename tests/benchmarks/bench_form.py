"""How fast the functional form answers, and how near it is to direct integration over all directions, beside scipy on the same nodes.

Run as `python -m tests.benchmarks form`. The integration (`fitting.radiometric`: points along a spiral and their horizons) shares nothing
with the table's (a polar grid and rays among spheres), and none of the directions is a node.
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
from fitting.radiometric import Sampling, basis_tables, paper_terms_any, radiometric_terms
from fitting.table import PER_SR, Grid, ReflectanceTable, tabulate
from tests.benchmarks.report import verdict

Array = NDArray[np.float64]

X = {"u_diff": 0.3, "u_spec": 0.5, "s_diff": 0.2, "s_spec": 0.1}
DIRECTIONS = 4_000_000
REPEATS = 7
NS = 50.0
"""20 million directions a second."""

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


def compared(what: str, found: Array, exact: Array) -> int:
    """Print one basis function's errors, and judge them over all incidences together."""
    rms, p99 = errors(found, exact)
    for label, values in (("rms", rms), ("99th", p99)):
        print(f"      {what} {label}, % at each theta_i: {' '.join(f'{v:.2f}' for v in values)}")
    all_together = 100 * np.abs(found - exact) / exact.mean(axis=(1, 2), keepdims=True)
    weight = np.sin(np.radians(THETA_I))[:, None, None] * np.ones_like(all_together)
    order = np.argsort(all_together, axis=None)
    share = np.cumsum(weight.ravel()[order]) / weight.sum()
    missed = verdict(f"{what}, rms of the mean over the hemisphere", math.sqrt(np.average(all_together**2, weights=weight)), 1, " %")
    return missed + verdict(f"{what}, 99th percentile", float(all_together.ravel()[order][np.searchsorted(share, 0.99)]), 3, " %")


def precision() -> int:
    """Compare tables with integration, in both modes; scipy's linear interpolation of the same nodes beside it."""
    missed = 0
    directions = THETA_I[:, None, None], THETA_R[:, None], PHI
    shape = len(THETA_I), len(THETA_R), len(PHI)
    for aspect in (0.5, 1.9):
        started = time.perf_counter()
        table = tabulate(aspect=aspect)
        print(f"   paper's table, aspect {aspect:g}: {time.perf_counter() - started:.1f} s, {table.values.nbytes / 2**20:.1f} MB")
        exact = paper_terms_any(*directions, cell=Cell(aspect), sampling=Sampling(16000, 32)).reshape(*shape, 4)
        found = table.evaluate(*directions)
        at = np.stack(np.broadcast_arrays(*directions), axis=-1)
        for n, name in enumerate(TERMS[:2]):
            missed += compared(name, found[..., n], exact[..., n])
            linear = RegularGridInterpolator(table.nodes, table.values[n].astype(float))(at)
            print(f"      scipy, linear on the same nodes: rms {np.max(errors(linear, exact[..., n])[0]):.2f} % at the worst theta_i")
        print(f"   reciprocity: off by {' '.join(f'{name} {table.alone(name).reciprocity():.2g}' for name in TERMS)} of the mean")
        grid = Grid()
        theta = grid.theta[:-1]
        started = time.perf_counter()
        bases = basis_tables(Cell(aspect), theta, theta, grid.phi, sampling=Sampling(20000, 32))
        brdf = ReflectanceTable.from_basis(tuple(bases), bases, nodes=(theta, theta, grid.phi), mode=PER_SR, provenance={})
        print(f"   in 1/sr, aspect {aspect:g}: {time.perf_counter() - started:.1f} s")
        exact = radiometric_terms(*directions, cell=Cell(aspect), sampling=Sampling(30000, 32)).reshape(*shape, 2)
        found = brdf.evaluate(*directions)
        for n, name in enumerate(bases):
            missed += compared(f"{name}, 1/sr", found[..., n], exact[..., n])
        print(f"   reciprocity: off by {' '.join(f'{name} {brdf.alone(name).reciprocity():.2g}' for name in bases)} of the mean")
    return missed


def speed() -> int:
    """Print rates of evaluation and of sampling."""
    table = tabulate(aspect=1.9)
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
