"""Trace a cultivar over all angles of incidence and make its table."""

from collections.abc import Callable

import numpy as np

from sim.petals.structure import CULTIVARS
from sim.petals.table import PetalTable
from sim.petals.tracing import BATCHES, TRACER_VERSION, Trace, mean_and_error, theta_r_nodes, trace

THETA_I = (0.0, 10.0, 20.0, 30.0, 40.0, 45.0, 50.0, 60.0, 70.0, 80.0)
SEED = 20061
# Photons per angle of incidence, for a standard error of at most 1 % where |theta_r| and theta_i are at most 70 deg. Black needs most: the
# light that leaves its body does so in few, bright photons.
PHOTONS = {"BR": 7_000_000, "RR": 2_400_000, "PR": 2_000_000, "WR": 800_000}


def trace_node(name: str, theta_i: float, photons: int, seed: int = SEED) -> Trace:
    """Trace one row of a cultivar's table. Each row of each cultivar has random numbers of its own."""
    return trace(CULTIVARS[name], theta_i, photons, (seed, list(CULTIVARS).index(name), round(theta_i * 1000)))


def f_r_batches(row: Trace, theta_i: float) -> np.ndarray:
    """f_r of each batch, shape (B, 35) [1/sr]. At normal incidence both sides are one: they are averaged."""
    return 0.5 * (row.f_r + row.f_r[:, ::-1]) if theta_i == 0 else row.f_r


def build(name: str, photons: int, seed: int = SEED, progress: Callable[[float], None] = lambda theta_i: None) -> PetalTable:
    """Trace the table of a cultivar, rounding `photons` per angle of incidence up to whole batches; `progress` is told every angle done."""
    rows = []
    for theta_i in THETA_I:
        rows.append(trace_node(name, theta_i, photons, seed))
        progress(theta_i)
    f_r, error = zip(*(mean_and_error(f_r_batches(row, theta_i)) for row, theta_i in zip(rows, THETA_I, strict=True)), strict=True)
    reflectance, reflectance_error = zip(*(mean_and_error(row.reflected) for row in rows), strict=True)
    transmittance, transmittance_error = zip(*(mean_and_error(row.transmitted) for row in rows), strict=True)
    bins, bins_error = zip(*(mean_and_error(row.bins) for row in rows), strict=True)
    return PetalTable(
        name=name,
        theta_i=np.array(THETA_I),
        theta_r=theta_r_nodes(),
        f_r_nodes=np.array(f_r),
        standard_error=np.array(error),
        surface=np.array([row.surface.mean(axis=0) for row in rows]),
        reflectance=np.array(reflectance),
        reflectance_error=np.array(reflectance_error),
        transmittance=np.array(transmittance),
        transmittance_error=np.array(transmittance_error),
        theta_r_bins=np.linspace(0.0, 90.0, bins[0].shape[0] + 1),
        phi_bins=np.linspace(0.0, 180.0, bins[0].shape[1] + 1),
        f_r_bins=np.array(bins),
        f_r_bins_error=np.array(bins_error),
        parameters=CULTIVARS[name],
        seed=seed,
        photons=-(-photons // BATCHES) * BATCHES,
        tracer=TRACER_VERSION,
    )
