"""The cell of a reflection model to scale: from the side with its neighbours, and from above as the light shows it."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.model import Model, cell_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fitting.cells import Cell

LIT, DARK, TISSUE, SLAB = "#E69F00", "#333333", "#E8EDF3", "#D8C3DE"
"""Lit outline, outline in shadow, inside of a cell, pigmented slab."""


def draw_cell(figure: "Figure", model: Model, theta_i: float, width: float) -> None:
    """Draw the cell from the side and from above.

    Parameters
    ----------
    figure : Figure
        Empty, about twice as wide as high.
    model : Model
    theta_i : float, deg
        Of the light.
    width : float
        Of a dome's base, um.
    """
    cell = cell_of(model)
    high = figure.get_size_inches()[1]
    side: Any = figure.add_axes((0.015, 0.02, 0.55, 1 - 0.5 / high))
    _side(side, model, cell, theta_i, width / 2)
    top: Any = figure.add_axes((0.63, (high - 4.1) / 2 / high, 0.32, 3.5 / high))
    _top(top, figure, cell, theta_i, width / 2)
    shape = f"z = h (1 $-$ (r/a)$^{{{cell.p:g}}}$)$^{{1/{cell.q:g}}}$, aspect h / 2a = {cell.aspect:g}"
    shape += f", gaps of {cell.gap * width:.3g} µm" if cell.gap else ""
    figure.text(0.015, 0.975, f"{model.mode} mode: domes {shape}", va="top")
    if not cell.spread.is_none:
        spread = cell.spread
        bounds = f"height $\\pm${100 * spread.height:g} %, tilt up to {spread.tilt:g} deg, place up to {spread.place:g} a"
        words = f"spread: {bounds}, seed {spread.seed}"
        figure.text(0.015, 0.925, words, va="top")


def _outline(cell: "Cell", a: float) -> tuple[Any, Any]:
    """Row of domes and floor from left to right, um; the middle dome stands at 0."""
    tau = np.linspace(-np.pi / 2, np.pi / 2, 401)
    r = np.sign(tau) * np.abs(np.sin(tau)) ** (2 / cell.p)
    z = np.abs(np.cos(tau)) ** (2 / cell.q)
    domes = cell.domes()
    cells = math.isqrt(len(domes))
    xs: list[Any] = []
    zs: list[Any] = []
    for i in range(-4, 5):
        shift, _, height, lean, _ = domes[(i % cells) * cells]
        across = a * (i * cell.pitch + shift + r + height * z * lean)
        if xs:
            xs.append(np.linspace(xs[-1][-1], across[0], 101))
            zs.append(np.zeros(101))
        xs.append(across)
        zs.append(a * height * z)
    return np.concatenate(xs), np.concatenate(zs)


def lit(x: Any, z: Any, theta_i: float) -> Any:
    """Tell which points of an outline, from left to right, see a light on the right.

    Parameters
    ----------
    x, z : ndarray, shape (n,)
    theta_i : float, rad

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    # Along a ray this stays; what is to the right and has less of it is in the way.
    across = x * math.cos(theta_i) - z * math.sin(theta_i)
    least = np.minimum.accumulate(across[::-1])[::-1]
    return across <= least + 1e-9 * np.ptp(x)


def _side(axes: Any, model: Model, cell: "Cell", theta_i: float, a: float) -> None:
    x, z = _outline(cell, a)
    height, pitch = cell.stretch * a, cell.pitch * a
    theta = math.radians(theta_i)
    half = 1.5 * pitch + 0.1 * a
    bottom = _layers(axes, model, a, half) if model.body is not None else -0.12 * a
    shown, inside = lit(x, z, theta), np.abs(x) <= half
    axes.fill_between(x, np.maximum(z, 0), 0, where=inside, color=TISSUE, linewidth=0)
    for of, color, line, label in ((~shown, DARK, 1.8, "in shadow"), (shown, LIT, 3.2, "lit")):
        axes.plot(np.where(of & inside, x, np.nan), z, color=color, linewidth=line, label=label, solid_capstyle="butt")
    if model.body is None:
        axes.fill_between([-half, half], 0, bottom, color=TISSUE, linewidth=0)
    above = 0.9 * a + 0.25 * height
    _ray(axes, x, z, shown, theta, theta_i, a, height + above)
    # Lengths: the height beside the domes, the others below.
    dimension = {"arrowstyle": "<->", "color": "black", "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    leader = {"color": "0.45", "linewidth": 0.6, "dashes": (2, 2), "zorder": 1}
    nominal = "" if cell.spread.is_none else " (mean)"
    at = half + 0.25 * a
    axes.annotate("", xy=(at, 0), xytext=(at, height), arrowprops=dimension)
    axes.plot([pitch, at + 0.1 * a], [height, height], **leader)
    axes.plot([half, at + 0.1 * a], [0, 0], **leader)
    axes.text(at + 0.12 * a, height / 2, f"h = {height:.3g} µm{nominal}", rotation=90, va="center")
    rows = [(-a, a, f"2a = {2 * a:.3g} µm")]
    if cell.spread.is_none:
        rows.append((-pitch, 0.0, f"pitch {pitch:.3g} µm"))
    drop = 0.42 * a + 0.04 * height
    for n, (begin, end, words) in enumerate(rows):
        y = bottom - (0.6 + n) * drop
        for place in (begin, end):
            axes.plot([place, place], [0, y - 0.08 * a], **leader)
        axes.annotate("", xy=(begin, y), xytext=(end, y), arrowprops=dimension)
        paper = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
        axes.text((begin + end) / 2, y, words, ha="center", va="center", bbox=paper)
    axes.set_xlim(-half, half + 0.75 * a)
    axes.set_ylim(bottom - (0.3 + len(rows)) * drop, height + above + 0.35 * a)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.legend(loc="upper left", frameon=False)


def _ray(axes: Any, x: Any, z: Any, shown: Any, theta: float, theta_i: float, a: float, top: float) -> None:
    """Draw the ray that grazes the middle dome, from the light down to where its shadow ends."""
    middle = np.abs(x) <= 1.0001 * a
    across = np.where(middle, x * math.cos(theta) - z * math.sin(theta), np.inf)
    touch = int(np.argmin(across)) if theta > 0.02 else int(np.argmin(np.abs(x)))
    before = np.nonzero(shown[:touch])[0]
    edge = int(before[-1]) if theta > 0.02 and len(before) else touch
    upwards = top - z[touch]
    length = min(upwards / math.cos(theta), 2.5 * upwards)
    end = x[touch] + length * math.sin(theta), z[touch] + length * math.cos(theta)
    arrow = {"arrowstyle": "-|>", "color": "#D55E00", "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(x[touch], z[touch]), xytext=end, arrowprops=arrow)
    axes.plot([x[touch], x[edge]], [z[touch], z[edge]], color="#D55E00", linewidth=1.2, dashes=(3, 2))
    axes.plot([x[touch]] * 2, [z[touch], top], color="0.3", linewidth=0.8, dashes=(6, 2, 1, 2))
    axes.text(x[touch], top + 0.06 * a, "N", ha="center", va="bottom", fontweight="bold")
    axes.text(end[0] + 0.05 * a, end[1] + 0.06 * a, f"light, $\\theta_i$ = {theta_i:g} deg", va="bottom", color="#A84300")
    if theta > 0.02:
        turn = np.linspace(0, theta, 30)
        radius = 0.75 * upwards
        axes.plot(x[touch] + radius * np.sin(turn), z[touch] + radius * np.cos(turn), color="0.3", linewidth=0.8)


def _layers(axes: Any, model: Model, a: float, half: float) -> float:
    """Draw what lies below the domes: slab, mesophyll, slab and far face; return how far down it goes, um."""
    assert model.body is not None
    upper, lower = model.body.upper.epidermis, model.body.lower.epidermis
    mesophyll = 0.6 * a
    down = -upper.depth * a
    axes.fill_between([-half, half], 0, down, color=SLAB, linewidth=0)
    axes.fill_between([-half, half], down, down - mesophyll, facecolor="white", edgecolor="0.7", hatch="....", linewidth=0)
    words = {"color": "black", "va": "center", "ha": "center", "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1.5}}
    if upper.depth:
        axes.text(0, down / 2, f"pigmented slab, {upper.depth * a:.3g} µm deep", **words)
    axes.text(0, down - mesophyll / 2, "diffusing mesophyll (not to scale)", **words)
    end = down - mesophyll - lower.depth * a
    axes.fill_between([-half, half], down - mesophyll, end, color=SLAB, linewidth=0)
    if lower.cell is None:
        axes.plot([-half, half], [end, end], color=DARK, linewidth=1.8)
        return end
    x, z = _outline(lower.cell, a)
    x, z = x[np.abs(x) <= half], z[np.abs(x) <= half]
    axes.fill_between(x, end, end - z, color=TISSUE, linewidth=0)
    axes.plot(x, end - z, color=DARK, linewidth=1.8)
    return end - lower.cell.stretch * a


def _top(axes: Any, figure: "Figure", cell: "Cell", theta_i: float, a: float) -> None:
    """Draw domes and floor from above, as bright as the light falls on them."""
    from matplotlib.patches import Circle, RegularPolygon
    from matplotlib.tri import Triangulation

    from fitting.surface import surface

    pitch, reach = cell.pitch * a, 1.55 * cell.pitch * a
    patch = surface(cell, 40, 72, 4)
    domes = cell.domes()
    cells = math.isqrt(len(domes))
    theta = math.radians(theta_i)
    facing = np.maximum(0, math.sin(theta) * patch.normals[:, 0] + math.cos(theta) * patch.normals[:, 2])
    light = facing * (patch.horizon[:, 0] * math.tan(theta) < 1) if theta > 0 else facing
    shades = {"cmap": "gray", "vmin": -0.6, "vmax": 1.0, "shading": "gouraud", "rasterized": True}
    floor: Any = patch.is_floor
    image: Any = None
    parts = np.split(np.nonzero(~floor)[0], len(domes))
    period = cells * pitch
    for m in range(-4, 5):
        for n in range(-4, 5):
            corner = period * np.array([m + n / 2, math.sqrt(3) / 2 * n])
            for index in parts:
                at = patch.points[index, :2] * a + corner
                if np.abs(at.mean(axis=0)).max() < reach + 1.2 * a:
                    image = axes.tripcolor(Triangulation(*at.T), light[index], zorder=2, **shades)
            grounds = patch.points[floor, :2] * a + corner
            near = np.abs(grounds).max(axis=1) < reach + 0.5 * a
            if near.any():
                dots = {"vmin": -0.6, "vmax": 1.0, "cmap": "gray", "linewidths": 0, "rasterized": True, "zorder": 1}
                axes.scatter(*grounds[near].T, c=light[floor][near], s=14, **dots)
    places = [(m, n) for m in range(-5, 6) for n in range(-5, 6)]
    for m, n in places:
        x, y = pitch * (m + n / 2), pitch * math.sqrt(3) / 2 * n
        dx, dy, height, tx, ty = domes[(m % cells) * cells + n % cells]
        base = x + a * dx, y + a * dy
        axes.add_patch(Circle(base, a, fill=False, edgecolor="#56B4E9", linewidth=0.7, zorder=3))
        if tx or ty:
            axes.plot([base[0], base[0] + a * height * tx], [base[1], base[1] + a * height * ty], color="#0072B2", linewidth=1.2, zorder=4)
    axes.add_patch(RegularPolygon((0, 0), 6, radius=pitch / math.sqrt(3), fill=False, edgecolor="#0072B2", linewidth=1.6, zorder=5))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x, µm (the light stands on the right)", ylabel="y, µm", facecolor="0.85")
    axes.set_aspect("equal")
    axes.set_title("from above: cosine of incidence; blue: one cell" + (", leans" if cell.spread.tilt else ""), fontsize=9)
    box = axes.get_position()
    bar = figure.colorbar(image, cax=figure.add_axes((box.x1 + 0.008, box.y0, 0.009, box.height)), ticks=[0, 0.5, 1])
    bar.ax.set_ylim(0, 1)
    bar.ax.tick_params(labelsize=7, pad=1)
