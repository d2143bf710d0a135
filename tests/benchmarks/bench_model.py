"""How fast, and how near the converged values, the paper's model is evaluated.

The tasks: all four terms at the paper's 15 directions in the plane of incidence, for hemispheres and for rose cells; the whole table of
directions; how near grazing it stays right; and how the cost grows with directions and with points, also as a picture:
`python -m tests.benchmarks.bench_model --plot FILE.png`, or PLOT_GROWTH=FILE.png in the environment. The yardstick is a plain numba loop
over points of a dome, each lit and seen or not.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting import CELL_AREA, Cell, Quadrature, Spread, basis_tables, paper_terms, paper_terms_any, radiometric_terms
from fitting.radiometric import Sampling
from tests.benchmarks.report import verdict

Array = NDArray[np.float64]

THETA_I = 45.0
THETA_R = np.arange(-70.0, 71, 10)
ASPECTS = (0.5, 1.9)
CONVERGED = Quadrature(121393, 40)
POLAR, AROUND, AZIMUTHS = 60, 120, 12  # 7200 points of a dome, 12 azimuths of the lattice
OTHERS = {
    "papillae with gaps": Cell(0.7, 1.3, 1.6, 0.15),
    "tall papillae": Cell(1.9, 1.5, 1.6),
    "cones": Cell(1.0, 1.0, 1.0, 0.1),
    "uneven domes": Cell(1.2, gap=0.4, spread=Spread(height=0.3, place=0.2, seed=2, cells=3)),
    "leaning domes": Cell(0.8, gap=0.3, spread=Spread(height=0.2, tilt=8, place=0.1, seed=4, cells=3)),
}
THETA = np.array([3, 15, 30, 45, 60, 70, 78, 84, 87, 88.5, 89.4, 89.8])  # deg, up to grazing
FINE = Sampling(200_000, 64)
WORTH_COUNTING = 1e-3  # of the term's largest value; smaller ones are left out of the relative error


@njit(cache=True)
def free(x: float, y: float, z: float, dx: float, dy: float, dz: float, height: float) -> bool:
    """Whether a ray passes all neighbours; z is already divided by the height, and the direction by its length after that."""
    reach = (1 - z) / dz * math.hypot(dx, dy) + 2
    rows = int(reach / math.sqrt(3.0))
    for j in range(-rows, rows + 1):
        for i in range(math.ceil((-reach - j) / 2), math.floor((reach - j) / 2) + 1):
            cx, cy = 2.0 * i + j - x, math.sqrt(3.0) * j - y
            ahead = cx * dx + cy * dy - z * dz
            if (i != 0 or j != 0) and ahead > 0 and cx * cx + cy * cy + z * z - ahead * ahead < 1:
                return False
    return True


@njit(cache=True)
def plain_terms(theta_i: float, theta_r: Array, height: float, n_us: float, polar: int, around: int, azimuths: int) -> Array:
    """u_diff and u_spec by summing eq. (7) over points."""
    out = np.zeros((len(theta_r), 2))
    for a in range(azimuths):
        azimuth = (a + 0.5) * math.pi / 3 / azimuths
        lx, ly, lz = math.sin(theta_i) * math.cos(azimuth), math.sin(theta_i) * math.sin(azimuth), math.cos(theta_i)
        squeezed_l = math.sqrt(lx * lx + ly * ly + (lz / height) ** 2)
        for p in range(polar):
            psi = (p + 0.5) * math.pi / 2 / polar
            for q in range(around):
                turn = (q + 0.5) * 2 * math.pi / around
                x, y, z = math.sin(psi) * math.cos(turn), math.sin(psi) * math.sin(turn), math.cos(psi)
                length = math.sqrt(x * x + y * y + (z / height) ** 2)
                nx, ny, nz = x / length, y / length, z / height / length
                area = height * length * math.sin(psi) * (math.pi / 2 / polar) * (2 * math.pi / around)
                cos_l = nx * lx + ny * ly + nz * lz
                if cos_l <= 0 or not free(x, y, z, lx / squeezed_l, ly / squeezed_l, lz / height / squeezed_l, height):
                    continue
                for r in range(len(theta_r)):
                    vx, vy, vz = math.sin(theta_r[r]) * math.cos(azimuth), math.sin(theta_r[r]) * math.sin(azimuth), math.cos(theta_r[r])
                    squeezed = math.sqrt(vx * vx + vy * vy + (vz / height) ** 2)
                    cos_v = nx * vx + ny * vy + nz * vz
                    if cos_v > 0 and free(x, y, z, vx / squeezed, vy / squeezed, vz / height / squeezed, height):
                        out[r, 0] += area * cos_l
                        cos_phi = 2 * cos_l * cos_v - (lx * vx + ly * vy + lz * vz)
                        if cos_phi > 0:
                            out[r, 1] += area * cos_phi**n_us
    return out / azimuths


def plain(points: int = 1) -> list[Array]:
    """The task by the plain loop; `points` multiplies the points along both coordinates."""
    domes = [
        plain_terms(math.radians(THETA_I), np.radians(THETA_R), 2 * aspect, 40.0, POLAR * points, AROUND * points, AZIMUTHS) / CELL_AREA
        for aspect in ASPECTS
    ]
    theta_i, theta_r = math.radians(THETA_I), np.radians(THETA_R)
    flat = np.column_stack([np.full(len(theta_r), math.cos(theta_i)), np.maximum(0, np.cos(theta_i + theta_r)) ** 5])
    return [np.column_stack([dome, flat]) for dome in domes]


def fitted(rule: Quadrature) -> list[Array]:
    """The task by the package."""
    return [paper_terms(THETA_I, THETA_R, aspect=aspect, quadrature=rule) for aspect in ASPECTS]


def warm(task: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Quickest and median time of a call after the first, ms; others on the machine disturb the quickest least."""
    task()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times), 1e3 * float(np.median(times))


def worked(task: Callable[[], object]) -> float:
    """Least processor's time of a call after the first, ms: of all cores together, whatever else they do."""
    task()
    times = []
    for _ in range(3):
        start = time.process_time()
        task()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def worst(found: list[Array], converged: list[Array]) -> float:
    """Largest relative error of the values that count, percent."""
    return 100 * max(
        float(np.max(np.abs(f - c)[counts] / c[counts]))
        for f, c in zip(found, converged, strict=True)
        for counts in [c > WORTH_COUNTING * c.max(axis=0)]
    )


def in_plane() -> int:
    """Print the figures of the 15 directions; count the targets missed."""
    converged = fitted(CONVERGED)
    print(
        f"15 directions at theta_i = {THETA_I:g} deg, aspects {ASPECTS}, four terms, warm; errors in percent of the value, of values above"
    )
    print(f"{WORTH_COUNTING:g} of the term's largest, against {CONVERGED.slices} slices")
    theirs, theirs_median = warm(plain, 5)
    print(f"\n  slices   nodes   quickest ms   median ms   worst %   plain loop ({theirs:.0f} ms, one thread) / quickest")
    for slices, lobe in ((89, 12), (233, 12), (377, 8), (377, 10), (377, 12), (987, 12), (1597, 12), (4181, 12), (17711, 12)):
        rule = Quadrature(slices, lobe)
        quickest, median = warm(partial(fitted, rule), 20)
        error = worst(fitted(rule), converged)
        print(f"  {slices:6d}  {lobe:6d}  {quickest:12.2f}  {median:10.2f}  {error:8.4f}   {theirs / quickest:6.1f}")
    points, error = POLAR * AROUND, worst(plain(), converged)
    print(f"  plain loop, {points} points: {theirs:.1f} ms, median {theirs_median:.1f} ms; worst error {error:.3f} %")
    print(f"  plain loop, 16 times the points: worst error {worst(plain(4), converged):.3f} %\n")
    quick = Quadrature(377, 10)
    missed = verdict("377 slices, quickest", warm(partial(fitted, quick), 50)[0], 3, " ms")
    missed += verdict("377 slices, worst error", worst(fitted(quick), converged), 0.3, " %")
    missed += verdict("1597 slices (default), quickest", warm(partial(fitted, Quadrature()), 50)[0], 3, " ms")
    return missed + verdict("1597 slices (default), worst error", worst(fitted(Quadrature()), converged), 0.3, " %")


def any_direction() -> int:
    """Print the figures of the table over all directions; count the targets missed."""
    theta_i, theta_r, phi = np.arange(0, 90, 5.0), np.arange(0, 90, 2.5), np.arange(0, 181, 5.0)
    count = len(theta_i) * len(theta_r) * len(phi)
    missed = 0
    for aspect in ASPECTS:
        for mode in ("paper", "radiometric"):
            took = warm(partial(basis_tables, Cell(aspect), theta_i, theta_r, phi, mode), 2)[0] / 1e3
            what = f"{mode} table {len(theta_i)} x {len(theta_r)} x {len(phi)}, aspect {aspect:g}"
            missed += verdict(what, took, 5, " s", note=f"{1e6 * took / count:.1f} us a direction")
        exact, height = paper_terms(THETA_I, THETA_R, aspect=aspect), 2 * aspect
        found = paper_terms_any(THETA_I, THETA_R, 0, cell=Cell(aspect))
        off = 100 * np.max(np.abs(found - exact)[:, :2] / exact[:, :2].max(axis=0), axis=0)
        print(f"      against the in-plane integral: u_diff {off[0]:.2f} %, u_spec {off[1]:.2f} % of the term's largest")
        views = np.radians(theta_r)
        naive = warm(partial(plain_terms, math.radians(THETA_I), views, height, 40.0, POLAR, AROUND, AZIMUTHS), 3)[0] / len(views)
        print(f"      plain loop {1e3 * naive:.0f} us a direction: {naive / 1e3 * count / took:.0f} times the table's")
    return missed


def other_cells() -> int:
    """Print what tables of shapes without closed forms take, in time of the processor; count the targets missed."""
    nodes = np.arange(0, 90, 5.0), np.arange(0, 90, 2.5), np.arange(0, 181, 5.0)
    missed = 0
    for name, cell in OTHERS.items():
        for mode in ("paper", "radiometric"):
            start = time.process_time()
            basis_tables(cell, *nodes, mode)
            took = time.process_time() - start
            missed += verdict(f"{mode} table, {name}, processor's time on two cores", took / 2, 5, " s", note=f"{took:.1f} s in all")
    return missed


def convergence() -> int:
    """Print how the error over all directions falls with facets and turns; count the targets missed.

    Rms over directions by projected solid angle of light and view, as a fraction of the term's mean; THETA holds more than its share of
    grazing ones, whose rms by itself follows.
    """
    phi = np.array([0, 35.0, 75, 120, 180])
    directions = np.meshgrid(THETA, THETA, phi, indexing="ij")
    edges = np.concatenate([[0.0], (THETA[1:] + THETA[:-1]) / 2, [90.0]])
    solid = np.diff(np.sin(np.radians(edges)) ** 2)
    weight = np.repeat((solid[:, None] * solid).ravel(), len(phi))
    grazing = (np.maximum(*(a.ravel() for a in directions[:2])) > 85) & (np.minimum(*(a.ravel() for a in directions[:2])) < 85)
    missed = 0
    for mode, evaluate in (("paper", paper_terms_any), ("radiometric", radiometric_terms)):
        for aspect in ASPECTS:
            cell = Cell(aspect)
            exact = evaluate(*directions, cell=cell, sampling=FINE)[:, :2]
            mean = np.average(exact, weights=weight, axis=0)
            print(f"   {mode}, aspect {aspect:g}: rms, percent of the mean; all u_diff, u_spec; one grazing u_diff, u_spec")
            for sampling in (*(Sampling(f, t) for f in (750, 3000, 12000) for t in (8, 32, 64)), Sampling.grazing(), Sampling(48000, 64)):
                start = time.process_time()
                off = (evaluate(*directions, cell=cell, sampling=sampling)[:, :2] - exact) / mean
                took = time.process_time() - start
                every = 100 * np.sqrt(np.average(off**2, weights=weight, axis=0))
                low = 100 * np.sqrt(np.average(off[grazing] ** 2, weights=weight[grazing], axis=0))
                figures = "  ".join(f"{e:7.3f}" for e in (*every, *low))
                print(f"     {sampling.facets:6d} facets x {sampling.turns:2d} turns: {figures}   {1e3 * took:6.0f} ms")
                if sampling == Sampling.grazing():
                    missed += verdict(f"{mode}, aspect {aspect:g}, Sampling.grazing(), worse term's rms", float(every.max()), 0.5, " %")
    theta, phi = np.concatenate([np.arange(0, 84, 2.8), [84.5, 86, 87.5, 88.7, 89.4, 89.8]]), np.arange(0, 181, 5.0)
    for mode in ("paper", "radiometric"):
        for aspect in ASPECTS:
            start = time.process_time()
            basis_tables(Cell(aspect), theta, theta, phi, mode, sampling=Sampling.grazing())
            took = time.process_time() - start
            missed += verdict(f"{mode} table 36 x 36 x 37 to grazing, aspect {aspect:g}, processor's time", took, 8, " s")
    return missed


def growth(plot: Path | None = None) -> int:
    """Print, and draw, how the cost grows over three decades; count what grows faster than in proportion."""
    rng = np.random.default_rng(0)
    missed = 0
    cell = Cell(1.9)
    tasks: dict[str, list[tuple[int, Callable[[], object]]]] = {"directions": [], "points": []}
    for n in (10, 100, 1000, 10_000):
        directions = rng.uniform(0, 85, n), rng.uniform(0, 85, n), rng.uniform(0, 180, n)
        tasks["directions"].append((n, partial(paper_terms_any, *directions, cell=cell, sampling=Sampling(96, 4))))
    for n in (3000, 30_000, 300_000, 3_000_000):
        tasks["points"].append((n, partial(paper_terms_any, 45.0, THETA_R, 0.0, cell=cell, sampling=Sampling(n, 4))))
    seen = {}
    for what, series in tasks.items():
        sizes, times = np.array([n for n, _ in series]), np.array([worked(task) for _, task in series])
        seen[what] = sizes, times
        print("   " + what + ": " + ", ".join(f"{n} in {t:.3g} ms" for n, t in zip(sizes, times, strict=True)))
        power = float(np.polyfit(np.log(sizes[1:]), np.log(times[1:]), 1)[0])
        missed += verdict(f"cost grows with {what} to the power of", power, 1.1)
    if plot is not None:
        draw(seen, plot)
    return missed


def draw(seen: dict[str, tuple[Array, Array]], path: Path) -> None:
    """Draw times over sizes, each beside the line of proportion through its last point."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xlabel="number of directions, or of points of the dome [1]", ylabel="processor's time of a call, warm [ms]")
    for (what, (sizes, times)), colour, marker in zip(seen.items(), ("#0072B2", "#D55E00"), ("o-", "s--"), strict=True):
        axes.loglog(sizes, times, marker, color=colour, label=what)
        axes.loglog(sizes, times[-1] / sizes[-1] * sizes, ":", color=colour, label=f"in proportion to {what} (slope 1)")
    axes.set_title(f"Cost of any-direction evaluation, aspect 1.9, {os.cpu_count()} cores")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2)
    figure.savefig(path, dpi=150)


def main(plot: Path | None = None) -> int:
    """Print the figures; return how many targets were missed."""
    if plot is None and "PLOT_GROWTH" in os.environ:
        plot = Path(os.environ["PLOT_GROWTH"])
    return in_plane() + any_direction() + other_cells() + convergence() + growth(plot)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="How fast and how exact the paper's model is evaluated.")
    parser.add_argument("--plot", type=Path, help="draw how the cost grows to this file")
    raise SystemExit(main(parser.parse_args().plot))
