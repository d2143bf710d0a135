"""Interreflection by escape orders, and body light: how long they take, how near they are, and what photons shot one by one would cost.

Run as `python -m tests.benchmarks light`. The photons (`tests.fitting.photons`) have their own geometry and draw every choice by lot.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fitting.body import BodyTrace, Epidermis, trace_body
from fitting.cells import Cell
from fitting.orders import EscapeOrders, escape_orders
from fitting.radiometric import Sampling
from tests.benchmarks.report import verdict
from tests.fitting.photons import PARTS, Mesophyll, Side, bounce, shoot

Array = NDArray[np.float64]
Result = TypeVar("Result")

THETA_I, THETA_R, PHI = np.linspace(0, 85, 18), np.linspace(0, 87.5, 36), np.linspace(0, 180, 37)
ALBEDOS = (0.2, 0.5, 0.8, 0.95)
U, W = np.polynomial.legendre.leggauss(24)
U, W = (U + 1) / 2, W / 2
HEMISPHERE = np.degrees(np.arccos(U))
EVEN = np.arange(0, 181, 5.0)
TISSUE = {"mu": 0.3, "R_m": 0.5, "T_m": 0.3}


def timed(task: Callable[[], Result]) -> tuple[Result, float, float]:
    """What a task returns, and its seconds: on the clock and of processor time."""
    before = time.perf_counter(), time.process_time()
    result = task()
    return result, time.perf_counter() - before[0], time.process_time() - before[1]


def mean(f_r: Array, theta_r: Array) -> Array:
    """Mean of (i, r, p) over the hemisphere's solid angle, shape (i, 1, 1)."""
    weights = np.sin(np.radians(theta_r))
    return np.asarray(f_r.mean(2) @ weights / weights.sum())[:, None, None]


def orders() -> tuple[int, dict[float, float]]:
    """Judge time of the whole table, furnace, closure and tail; return the times by aspect too."""
    missed, times = 0, {}
    for aspect in (0.5, 1.9):
        cell = Cell(aspect)
        _, clock, core = timed(lambda cell=cell: escape_orders(cell, THETA_I, THETA_R, PHI))  # type: ignore[misc]
        times[aspect] = clock
        missed += verdict(f"escape orders, 18 x 36 x 37, aspect {aspect:g}", clock, 60, " s", note=f"{core:.1f} s of processor time")
    print("   sum of all later orders as one geometric row, against 150 orders: largest error in any direction, of the hemisphere's mean")
    for aspect in (0.5, 1.9, 3.0):
        few, many = (escape_orders(Cell(aspect), [0, 60, 89.8], HEMISPHERE, EVEN, rays=1024, **kept) for kept in ({}, {"orders": 150}))
        sent_back = 2 * np.pi * np.trapezoid(few.reflectance(1.0), EVEN, axis=2) / 180 @ (W * U)
        missed += verdict(f"white furnace, aspect {aspect:g}, off by", float(np.abs(sent_back - 1).max()), 1e-9)
        missed += verdict("scaled to close, by at most", 100 * few.closure, 5, " %", note="of a beam, grazing ones included")
        off = [float((np.abs(few.reflectance(a) - many.reflectance(a)) / mean(many.reflectance(a), HEMISPHERE)).max()) for a in ALBEDOS]
        note = ", ".join(f"albedo {a:g}: {100 * e:.2g} %" for a, e in zip(ALBEDOS, off, strict=True))
        missed += verdict(f"tail after {len(few.bases) - 1} orders, aspect {aspect:g}", 100 * max(off), 0.3, " %", note=note)
    return missed, times


def orders_converge() -> float:
    """Print errors against facets and rays; return the rms of the usual ones."""
    nodes, azimuths = np.array([0.0, 20, 40, 60, 80]), np.arange(0, 181, 20.0)

    def traced(rings: int, sectors: int, rays: int, seed: int = 0) -> EscapeOrders:
        few: dict[str, Any] = {"rings": rings, "sectors": sectors, "rays": rays, "seed": seed, "orders": 12, "sampling": Sampling(800, 8)}
        return escape_orders(Cell(1.9), nodes, nodes, azimuths, **few)

    fine = traced(24, 72, 8192, 1).reflectance(0.8)
    print("   aspect 1.9, albedo 0.8, against 24 rings x 72 sectors x 8192 rays, percent of the mean over the hemisphere")
    print("   rings sectors  rays |   rms   max")
    usual = 0.0
    for rings, sectors, rays in ((7, 18, 1024), (14, 36, 256), (14, 36, 1024), (14, 36, 4096), (20, 54, 4096)):
        off = (traced(rings, sectors, rays).reflectance(0.8) - fine) / mean(fine, nodes)
        rms = float(np.sqrt(np.mean(off**2)))
        usual = rms if (rings, rays) == (14, 4096) else usual
        print(f"   {rings:5} {sectors:7} {rays:5} | {100 * rms:5.2f} {100 * np.abs(off).max():5.2f}", flush=True)
    return usual


def twice(task: Callable[[int], Result]) -> list[Result]:
    """Results of a task for two seeds, side by side."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(task, (1, 2)))


def photons_for_orders(table: float, error: float) -> None:
    """Print how long photons would take for the same table at the same error."""
    count = 1_000_000
    bounce(50.0, 10, 3.8, 2.0, 60, 0)

    def binned(seed: int) -> Array:
        bounces, ways = bounce(50.0, count, 3.8, 2.0, 60, seed)
        azimuth = np.abs((ways[:, 1] + np.pi) % (2 * np.pi) - np.pi)
        some = bounces > 0
        light = np.histogram2d(ways[some, 0], azimuth[some], [36, 37], [[0, 1], [0, np.pi]], weights=0.8 ** bounces[some])[0]
        return np.asarray(light / ((np.arange(36) + 0.5) / 36)[:, None])

    runs, clock, core = timed(lambda: twice(binned))
    noise = float(np.sqrt(np.mean((runs[0] - runs[1]) ** 2) / 2) / np.mean(runs))
    whole = len(THETA_I) * core / 2 * (noise / error) ** 2 / (os.cpu_count() or 1)
    rate = 2 * count / clock / 1e6
    print(
        f"   photons one by one: {rate:.1f} million a second; the table for one albedo at its rms of {100 * error:.2f} % would take "
        f"{whole:.0f} s on all cores, {whole / table:.0f} times as long"
    )


def body() -> int:
    """Time, balance and convergence of body light; photons beside it."""
    rose = Epidermis(Cell(1.9))
    trace_body(Epidermis(Cell(1.9)), rays=64)
    petal, clock, core = timed(lambda: trace_body(rose))
    missed = verdict("body light, both faces, aspect 1.9", clock, 20, " s", note=f"{core:.1f} s of processor time")
    theta = np.linspace(0, 89.9, 400)
    worst = max(
        float(np.abs(sum(petal.budget(theta, mu=mu, R_m=r, T_m=t, D_m=d).values()) - 1).max())
        for mu in (0.0, 0.1, 3.0)
        for r, t, d in ((0.5, 0.3, 0.1), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    )
    missed += verdict("energy budget, off from 1 by", worst, 1e-11)
    angles = np.linspace(0, 85, 18)

    def reflected(trace: BodyTrace) -> Array:
        budget = trace.budget(angles, **TISSUE)
        return np.array([budget["body"], budget["scattered"]])

    fine = reflected(trace_body(Epidermis(Cell(0.5)), rays=16384, seed=1))
    print("   hemispheres, mu 0.3 / a, R_m 0.5, T_m 0.3, against 16384 rays of another seed: light leaving above and below, over theta_i")
    print("    rays |  rms %  max %  closure  seconds")
    error = took = 1.0
    for rays in (64, 256, 1024, 4096):
        found, took, core = timed(lambda rays=rays: trace_body(Epidermis(Cell(0.5)), rays=rays))  # type: ignore[misc]
        off = reflected(found) / fine - 1
        error = float(np.sqrt(np.mean(off**2)))
        print(f"   {rays:5} | {100 * error:6.3f} {100 * np.abs(off).max():6.3f}  {found.upper.closure:.5f}  {took:.2f}", flush=True)

    count = 1_000_000
    mu, meso = TISSUE["mu"], Mesophyll(TISSUE["R_m"], TISSUE["R_m"], TISSUE["T_m"], 0.0)
    shoot(50.0, 10, Side(1.0, 2.0, 1.0, mu), Side(0.0, 2.0, 1.0, mu), 1.4, meso, 0)
    runs, clock, core = timed(
        lambda: twice(lambda seed: shoot(50.0, count, Side(1.0, 2.0, 1.0, mu), Side(0.0, 2.0, 1.0, mu), 1.4, meso, seed))
    )
    ends = np.concatenate([run[0] for run in runs])
    budget = found.budget(50.0, **TISSUE)
    expected = np.array([float(budget[part]) for part in PARTS])
    shares = np.bincount(ends, minlength=len(PARTS)) / len(ends)
    for part, share, value in zip(PARTS, shares, expected, strict=True):
        print(f"      {part:>10}: {value:.5f}, photons {share:.5f} +- {np.sqrt(share / len(ends)):.5f}")
    bound = 4 * np.sqrt(expected / len(ends)) + 0.003 * expected + 1e-5
    missed += verdict("farthest from the photons, of 4 standard deviations and 0.3 %", float((np.abs(shares - expected) / bound).max()), 1)
    wanted = (1 - expected[3]) / expected[3] / error**2
    alone, rate = clock * wanted / len(ends), len(ends) / clock / 1e6
    print(
        f"   photons one by one: {rate:.1f} million a second; one incidence and pigment at {100 * error:.2f} %: {alone:.1f} s; "
        f"18 incidences and 10 pigments: {180 * alone:.0f} s, {180 * alone / took:.0f} times as long as the trace that holds them all"
    )
    return missed


def main() -> int:
    """Print the figures; return how many targets are missed."""
    missed, times = orders()
    photons_for_orders(times[1.9], orders_converge())
    return missed + body()


if __name__ == "__main__":
    raise SystemExit(main())
