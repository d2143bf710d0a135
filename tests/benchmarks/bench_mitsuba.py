"""How much faster than Mitsuba 3 (LLVM) on an explicit mesh of many domes, at equal error, in the plane of incidence.

The task: u_diff and u_spec of the paper at its 15 directions. Mitsuba gets what a careful user would give it: one kernel for all
directions, compiled and its scene built beforehand; one ray to the light and, where that is free, one to each view; points half even over
the dome's area, half over its normals, each with its own azimuth of the lattice. Its error is its noise alone, as it shrinks with the
samples; that of its triangles is left out. Ours is the whole of it, against the converged integral. Its time is CPU time over cores, as if
it had them all to itself and lost nothing in sharing them; ours is by the clock.
"""

from __future__ import annotations

import importlib.util
import math
import os
import time
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitting import Cell, Quadrature, paper_terms
from tests.benchmarks.bench_model import CONVERGED, THETA_I, THETA_R, WORTH_COUNTING, warm
from tests.benchmarks.report import verdict

Array = NDArray[np.float64]

N_US = 40.0
BUDGET = 40.0  # s of tracing for an aspect
FIRST, MOST = 2**15, 2**21  # samples of a launch
LAUNCHES = 16  # of which the noise is told


class Step(NamedTuple):
    """Samples, time (s), and the worst relative error of a value that counts (%)."""

    samples: int
    seconds: float
    error: float


class Traced:
    """The 15 directions by Mitsuba's rays on a patch of domes."""

    def __init__(self, cell: Cell) -> None:
        import drjit as dr

        from tests.fitting.mitsuba_patch import Opaque, Patch, mitsuba

        self.dr, self.mi = dr, mitsuba()
        patch = Patch(cell, fine=4.0, reach=cell.stretch * math.tan(math.radians(75)) + 6, rings=60, around=144)
        self.scene = Opaque(patch).scene
        tile = patch.tile
        dome = slice(tile.dome)
        corners, bent, areas = tile.vertices[tile.triangles[dome]], tile.normals[tile.triangles[dome]], tile.areas[dome]
        tilt = bent[:, :, 2]
        spread = np.ptp(tilt, axis=1)  # solid angle of a triangle's normals, but for a factor
        share = areas / areas.sum() + spread / spread.sum()
        mi = self.mi
        self.pick = mi.DiscreteDistribution(mi.Float(share.astype(np.float32)))
        self.corners = [mi.Point3f(*corners[:, n].T) for n in range(3)]
        self.normals = [mi.Vector3f(*bent[:, n].T) for n in range(3)]
        self.flat = mi.Vector3f(*tile.flat_normals[dome].T)
        self.weight = mi.Float(areas / (share / share.sum()) / tile.cell_area)

    def sums(self, samples: int, seed: int) -> Array:
        """Mean over samples, shape (15, 2)."""
        dr, mi = self.dr, self.mi
        random = mi.PCG32(size=samples, initstate=dr.opaque(mi.UInt64, seed))
        which = self.pick.sample(random.next_float32())
        u, v = dr.sqrt(random.next_float32()), random.next_float32()
        turn = random.next_float32() * (math.pi / 3)
        share = (1 - u, u * (1 - v), u * v)
        place = sum((dr.gather(mi.Point3f, c, which) * s for c, s in zip(self.corners, share, strict=True)), mi.Point3f(0))
        normal = dr.normalize(sum((dr.gather(mi.Vector3f, c, which) * s for c, s in zip(self.normals, share, strict=True)), mi.Vector3f(0)))
        start = place + 1e-4 * dr.gather(mi.Vector3f, self.flat, which)
        weight = dr.gather(mi.Float, self.weight, which)
        sin, cos = dr.sincos(turn)

        def direction(theta: float) -> Any:
            return mi.Vector3f(math.sin(theta) * cos, math.sin(theta) * sin, math.cos(theta))

        light = direction(math.radians(THETA_I))
        cos_l = dr.dot(normal, light)
        lit = cos_l > 0
        lit &= ~self.scene.ray_test(mi.Ray3f(start, light), lit)
        out = []
        for theta in np.radians(THETA_R):
            view = direction(float(theta))
            cos_v = dr.dot(normal, view)
            seen = lit & (cos_v > 0)
            seen &= ~self.scene.ray_test(mi.Ray3f(start, view), seen)
            lobe = dr.maximum(0, 2 * cos_l * cos_v - math.cos(math.radians(THETA_I) - theta)) ** N_US
            out += [dr.select(seen, weight * cos_l, 0), dr.select(seen, weight * lobe, 0)]
        dr.eval(out)  # together, or every sum would trace its rays anew
        return np.array([float(dr.sum(x)[0]) for x in out]).reshape(-1, 2) / samples

    def converge(self, converged: Array, target: float) -> tuple[list[Step], Array]:
        """Double the samples until the error is below the target (%) or the time is up."""
        size, seed = FIRST, 0
        steps: list[Step] = []
        started = time.perf_counter()
        counts = converged > WORTH_COUNTING * converged.max(axis=0)
        found = converged
        while (not steps or steps[-1].error > target) and size <= MOST and time.perf_counter() - started < BUDGET / 3:
            self.sums(size, seed)  # a launch of this size, warm
            begun = time.process_time()
            means = np.array([self.sums(size, seed + 1 + n) for n in range(LAUNCHES)])
            seconds = (time.process_time() - begun) / (os.cpu_count() or 1)
            seed += LAUNCHES + 1
            found = means.mean(axis=0)
            noise = means.std(axis=0, ddof=1) / math.sqrt(LAUNCHES)
            # What the worst of the values is off by, as a rule: the median of such a maximum, from the noise and not from one draw.
            draws = np.abs(np.random.default_rng(0).standard_normal((2000, int(counts.sum())))) * (noise / converged)[counts]
            steps.append(Step(size * LAUNCHES, seconds, 100 * float(np.median(draws.max(axis=1)))))
            size *= 2
        return steps, found


def main() -> int:
    """Print the figures; return how many targets were missed."""
    if importlib.util.find_spec("mitsuba") is None:
        print("   Mitsuba 3 is not installed: nothing to compare with (pip install 'petal-rig[photoreal]')")
        return 0
    from tests.fitting.mitsuba_patch import vectorised

    if not vectorised():
        print("   no LLVM for Mitsuba's LLVM variant: install libllvm19, or name the library in DRJIT_LIBLLVM_PATH")
        return 0
    print(f"   u_diff and u_spec at {len(THETA_R)} directions, theta_i = {THETA_I:g} deg; errors in percent of the worst value above")
    print(f"   {WORTH_COUNTING:g} of its term's largest; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    missed = 0
    for aspect in (0.5, 1.9):
        ours = partial(paper_terms, THETA_I, THETA_R, aspect=aspect)
        converged = paper_terms(THETA_I, THETA_R, aspect=aspect, quadrature=CONVERGED)[:, :2]
        counts = converged > WORTH_COUNTING * converged.max(axis=0)
        error = 100 * float((np.abs(ours()[:, :2] - converged) / converged)[counts].max())
        quickest = warm(ours, 30)[0]
        traced = Traced(Cell(aspect))
        steps, found = traced.converge(converged, error)
        print(f"   aspect {aspect:g}: ours ({Quadrature().slices} slices) {quickest:.2f} ms, error {error:.3f} %")
        for step in steps:
            print(f"      Mitsuba: {step.samples:9d} samples {1e3 * step.seconds:9.1f} ms, error {step.error:.3f} %")
        departure = 100 * (found / converged - 1)[counts]
        print(
            f"      its last values are off ours by {np.median(np.abs(departure)):.2f} % (median), {np.abs(departure).max():.2f} % (most)"
        )
        last = steps[-1]
        times = last.seconds * max(1.0, (last.error / error) ** 2)
        how = "reached" if last.error <= error else "EXTRAPOLATED by 1 / sqrt(samples)"
        print(f"      Mitsuba at our error: {times:.3g} s, {how}; as measured, at {last.error:.3f} %, {_ratio(last.seconds, quickest)}")
        missed += verdict(
            f"aspect {aspect:g}, our time over Mitsuba's at equal error", quickest / 1e3 / times, 1 / 50, note=_ratio(times, quickest)
        )
    return missed


def _ratio(seconds: float, ours_ms: float) -> str:
    return f"{1e3 * seconds / ours_ms:.0f} times faster, target 50"


if __name__ == "__main__":
    raise SystemExit(main())
