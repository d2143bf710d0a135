"""What a scanned petal looks like: to judge a scan by."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanning.mesh import TriangleMesh, boundary_loops, vertex_normals
from scanning.petal import Petal


def draw_petal(path: str | Path, mesh: TriangleMesh, petal: Petal, *, name: str, simulated: bool = False) -> None:
    """Draw a petal from the front (depth), its midrib from the side, and how steeply the scanner saw it, to a PNG file.

    Parameters
    ----------
    path : path
        File to write.
    mesh : TriangleMesh
        Scan frame, mm.
    petal : Petal
        Its base, tip, midrib and inflection.
    name : str
        Title.
    simulated : bool
        Whether to say SIMULATED.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    front, side, slope = figure.subplots(1, 3)
    x, y, z = mesh.vertices.T
    steepness = np.degrees(np.arccos(np.clip(np.abs(vertex_normals(mesh)[:, 2]), 0, 1)))
    for axes, values, label in ((front, z, "z, mm"), (slope, steepness, "normal against line of sight, deg")):
        shown = axes.tripcolor(x, y, mesh.triangles, values, shading="gouraud", cmap="viridis")
        figure.colorbar(shown, ax=axes, label=label, shrink=0.8)
        for loop in boundary_loops(mesh.triangles):
            border = mesh.vertices[np.append(loop, loop[0])]
            axes.plot(border[:, 0], border[:, 1], color="black", linewidth=0.7)
        axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    front.plot(petal.midrib[:, 0], petal.midrib[:, 1], color="white", linewidth=1)
    front.set_title("inner face, depth")
    slope.set_title("steepness")
    for point, mark, label in ((petal.base, "o", "base"), (petal.tip, "^", "tip"), (petal.inflection, "x", "inflection")):
        front.plot(*point[:2], mark, color="red")
        local = (point - petal.T_scan_petal[:3, 3]) @ petal.T_scan_petal[:3, :3]
        side.plot(*local[1:], mark, color="red", label=label)
    measured = (petal.midrib - petal.T_scan_petal[:3, 3]) @ petal.T_scan_petal[:3, :3]
    side.plot(measured[:, 1], measured[:, 2], ".", color="grey", markersize=2, label="midrib")
    side.plot(*petal.profile.T, color="black", linewidth=1, label="smooth")
    side.set(xlabel="from base to tip, mm", ylabel="towards the inner face, mm", aspect="equal", title="midrib from the side")
    side.set_adjustable("datalim")
    side.legend(loc="upper right", fontsize="small")
    figure.suptitle(f"{name}, {petal.area:.0f} mm²" + (" (SIMULATED)" if simulated else ""))
    figure.savefig(path, dpi=110)
