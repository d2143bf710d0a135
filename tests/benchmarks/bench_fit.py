"""How long fits take and how well the ladder's rungs describe petals, a leaf and a retro-reflecting tape.

The petals are virtual ones, traced cell by cell by other optics (`sim.petals`); leaf and tape were measured by others and are read from the
folder of reference data beside a checkout, where there is one. Tables are mean E of eq. (13) in percent.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.compare import Comparison, compare
from fitting.fit import fit, fit_joint
from fitting.formats.alta import read_alta
from fitting.ladder import RUNGS, Traces
from fitting.measurements import Measurements
from fitting.readings import read_csv
from fitting.search import usual_bounds
from sim.petals import load, names
from tests.benchmarks.report import verdict

Array = NDArray[np.float64]

VIEWS = np.arange(-70.0, 71, 10)
INCIDENCES = (15.0, 30.0, 45.0, 60.0)
DATA = Path(__file__).parents[2].parent / "shared" / "data"
SPARING = ("lambert", "phong", "ggx", "paper", "radiometric", "body")
"""Without the rung whose tracing is slowest and which a tape or a leaf has no use for."""


def petal(name: str) -> Measurements:
    """Readings of a virtual petal at four incidences."""
    theta_i, theta_r = (a.ravel() for a in np.meshgrid(INCIDENCES, VIEWS, indexing="ij"))
    return Measurements(theta_i, theta_r, np.asarray(load(name).f_r(theta_i, theta_r), float), quantity="brdf", source=name)


def took(task: Callable[[], object], repeats: int = 1) -> tuple[float, float]:
    """Quickest time of a call by the clock, and by the processor, s."""
    seen = []
    for _ in range(repeats):
        clock, processor = time.perf_counter(), time.process_time()
        task()
        seen.append((time.perf_counter() - clock, time.process_time() - processor))
    return min(c for c, _ in seen), min(p for _, p in seen)


def speed() -> int:
    """Print what fits take, warm; count the targets missed."""
    petals = {name: petal(name) for name in names()}
    one = petals["RR"].take(petals["RR"].theta_i_deg == 45)
    bounds = usual_bounds(RUNGS["paper"])
    tasks: tuple[tuple[str, Callable[[], object], int, float, float], ...] = (
        ("linear fit, the paper's rung, 15 readings", lambda: fit(one), 50, 1e3, 2.0),
        ("shape fit, the paper's rung, one cultivar, 15 readings", lambda: fit(one, shape=bounds), 3, 1, 2.0),
        ("shape fit, the paper's rung, one cultivar, four incidences", lambda: fit(petals["RR"], shape=bounds), 3, 1, 2.0),
        ("joint shape fit, four cultivars, four incidences", lambda: fit_joint(list(petals.values()), shape=bounds), 2, 1, 10.0),
    )
    missed = 0
    for what, task, repeats, scale, target in tasks:
        task()
        clock, processor = took(task, repeats)
        unit = " ms" if scale > 1 else " s"
        missed += verdict(what, scale * clock, target, unit, note=f"processor's time {scale * processor:.3g}{unit}")
    return missed


def table(rows: Mapping[str, Comparison], where: str) -> None:
    """Print mean E of each rung, what is left out beside it, and a star at what the data support."""
    titles = [row.title for row in next(iter(rows.values())).rows]
    print(f"\n   {where}; in brackets incidences left out, * what the data support")
    print(f"   {'':24s}" + "".join(f"{name:>18s}" for name in rows))
    for title in titles:
        cells = []
        for found in rows.values():
            (row,) = (r for r in found.rows if r.title == title)
            star = "*" if row is found.supported else ""
            left = "" if row.left_out is None else f" ({row.left_out:.1f})"
            cells.append(f"{'-' if row.E_mean is None else f'{row.E_mean:.1f}'}{star}{left}")
        print(f"   {title:24s}" + "".join(f"{cell:>18s}" for cell in cells), flush=True)


def best(found: Comparison) -> float:
    """Least mean E among rungs whose search converged."""
    return min(row.E_mean for row in found.rows if row.trusted and row.E_mean is not None)


def petals(traces: Traces) -> int:
    """Print the ladder against the virtual petals; count the targets missed."""
    readings = {name: petal(name) for name in names()}
    clock, processor = took(lambda: compare(readings["RR"], traces=traces))
    print(f"   whole ladder, 60 readings, with incidences left out, cold: {clock:.0f} s, processor's time {processor:.0f} s")
    clock, processor = took(lambda: compare(readings["RR"], traces=traces))
    print(f"   the same with traces kept: {clock:.0f} s, processor's time {processor:.0f} s")
    at_45 = {name: compare(m.take(m.theta_i_deg == 45), traces=traces) for name, m in readings.items()}
    table(at_45, "virtual petals, fitted at 45 deg")
    everywhere = {name: compare(m, traces=traces) for name, m in readings.items()}
    table(everywhere, "virtual petals, fitted at 15, 30, 45, 60 deg")
    missed = 0
    for name in names():
        missed += verdict(f"{name}, best rung's mean E at 45 deg", best(at_45[name]), 10, " %")
        chosen = everywhere[name].supported
        left = np.inf if chosen is None or chosen.left_out is None else chosen.left_out
        missed += verdict(f"{name}, incidences left out, the rung the data support", left, 15, " %")
    return missed


def leaf(traces: Traces) -> int:
    """Print the ladder against the leaf at its four wavelengths; count the targets missed."""
    missed, whole, apart = 0, {}, {}
    for wavelength in (450, 550, 650, 850):
        m = read_csv(DATA / "leaf" / "principal_plane_dj.csv", where={"wavelength_nm": wavelength}, theta_r_positive="forward")
        whole[f"{wavelength} nm"] = compare(m, models=SPARING, traces=traces)
        apart[wavelength] = {
            f"{theta_i:g} deg": compare(m.take(m.incidence_of == k), models=SPARING, traces=traces)
            for k, theta_i in enumerate(m.incidences)
        }
    table(whole, "leaf, all incidences")
    for wavelength, rows in apart.items():
        table(rows, f"leaf, {wavelength} nm, each incidence by itself")
    for what, found in whole.items():
        missed += verdict(f"leaf, {what}, all incidences, best rung's mean E", best(found), 10, " %")
    for wavelength, rows in apart.items():
        mean = float(np.mean([best(found) for found in rows.values()]))
        missed += verdict(f"leaf, {wavelength} nm, incidence by incidence, best rung's mean E", mean, 10, " %")
    return missed


def tape() -> Measurements:
    """Readings of the tape in the plane of incidence."""
    path = DATA / "retroreflector" / "retro-gray-tape.dat"
    read = read_alta(path, param_out="INV_STERADIAN_COSINE_FACTOR", theta_r_below_deg=89.9)
    phi = (read.phi_r_deg - read.phi_i_deg + 180) % 360 - 180
    m = Measurements(read.theta_i_deg, read.theta_r_deg, read.values[:, 0], phi_deg=phi, quantity="brdf", source=path.name)
    return m.take(m.in_plane)


def retroreflection(traces: Traces) -> None:
    """Print what the ladder makes of the tape: no rung has a lobe back to the light, narrower than 5 deg and a hundred times its floor."""
    m = tape()
    found = compare(m, models=SPARING, traces=traces)
    table({"tape": found}, f"retro-reflecting tape, {len(m)} readings in the plane at 15, 30, 60 deg")
    back = np.abs(m.theta_r_deg - m.theta_i_deg) <= 5
    print("   within 5 deg of the light, mean E, and the model's share of the peak; elsewhere, mean E:")
    for row in found.rows:
        if row.fit is not None:
            share: Any = row.fit.modelled / row.fit.measured
            peak = m.intensity == m.intensity[back].max()
            figures = f"{np.mean(row.fit.E[back]):.0f} %, {100 * share[peak][0]:.1f} % of the peak; {np.mean(row.fit.E[~back]):.0f} %"
            print(f"   {row.title:24s} {figures}")


def main() -> int:
    """Print the figures; return how many targets were missed."""
    missed = speed()
    traces = Traces()
    missed += petals(traces)
    if not DATA.is_dir():
        print("   leaf and tape: the reference data are not beside this checkout")
        return missed
    missed += leaf(traces)
    retroreflection(traces)
    return missed


if __name__ == "__main__":
    raise SystemExit(main())
