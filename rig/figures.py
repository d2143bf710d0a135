"""The paper's figures 1, 2, 6, 7, 8 and 9, drawn from stored fits. Readable in print and by colour-blind people."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rig.fits import StoredFit

SIMULATED = "SIMULATED"
"""What everything made from simulated readings or petals says."""

FORMATS = ("png", "svg")
"""What plots are drawn as."""

DARK, PALE = ("BR", "RR"), ("PR", "WR")
SCALES = {DARK: 40.0, PALE: 400.0}
"""Radial scales of the paper's figures 1 and 8, and 2 and 9."""

TERMS = {
    "u_diff": "epidermis, diffuse",
    "u_spec": "epidermis, specular",
    "s_diff": "spongy tissue, diffuse",
    "s_spec": "spongy tissue, specular",
}
SPEC_ENLARGED = 5.0
"""Figure 6 draws r'_u_spec five times enlarged."""

# Okabe and Ito's palette; marker and dash tell the same apart in grey print.
STYLES: dict[str, dict[str, Any]] = {
    "BR": {"color": "#000000", "marker": "o", "dashes": (None, None)},
    "RR": {"color": "#D55E00", "marker": "s", "dashes": (6, 2)},
    "PR": {"color": "#CC79A7", "marker": "^", "dashes": (None, None)},
    "WR": {"color": "#0072B2", "marker": "D", "dashes": (6, 2)},
}
TERM_STYLES: dict[str, dict[str, Any]] = {
    "u_diff": {"color": "#000000", "linestyle": "-", "hatch": ""},
    "u_spec": {"color": "#D55E00", "linestyle": "--", "hatch": "//"},
    "s_diff": {"color": "#0072B2", "linestyle": "-.", "hatch": ".."},
    "s_spec": {"color": "#009E73", "linestyle": ":", "hatch": "xx"},
}

Drawer = Callable[["Figure"], None]


def draw_all(fits: Mapping[str, "StoredFit"], folder: Path) -> list[Path]:
    """Draw the six figures as PNG and SVG into `folder` and return the files.

    Parameters
    ----------
    fits : mapping of cultivar (BR, RR, PR, WR) to its fit
        All of one incidence.
    folder : Path
        Made where it is not there.
    """
    simulated = any(fit.simulated for fit in fits.values())
    dark, pale = ([fits[name] for name in group] for group in (DARK, PALE))
    drawers: dict[str, tuple[Drawer, tuple[float, float]]] = {
        "figure-1": (lambda f: _polar_fits(f, dark, SCALES[DARK], model=False), (6, 4.3)),
        "figure-2": (lambda f: _polar_fits(f, pale, SCALES[PALE], model=False), (6, 4.3)),
        "figure-6": (lambda f: _lobes(f, fits["RR"]), (6, 4.3)),
        "figure-7": (lambda f: _coefficients(f, list(fits.values())), (7, 4.2)),
        "figure-8": (lambda f: _polar_fits(f, dark, SCALES[DARK], model=True), (6, 4.3)),
        "figure-9": (lambda f: _polar_fits(f, pale, SCALES[PALE], model=True), (6, 4.3)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, (draw, size) in drawers.items():
        paths = [folder / f"{name}.{ending}" for ending in FORMATS]
        # Figure 6 is the model alone: nothing in it was measured.
        with saved_figure(size, paths, [SIMULATED] if simulated and name != "figure-6" else []) as figure:
            draw(figure)
        written += paths
    return written


@contextmanager
def saved_figure(size: tuple[float, float], paths: Sequence[Path], marks: Sequence[str]) -> Iterator["Figure"]:
    """Yield an empty figure of `size` inches with `marks` in its corner, and save it to `paths` afterwards."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "rig", "axes.titlesize": 10}):
        figure = Figure(figsize=size)
        if marks:
            figure.text(0.985, 0.975, ", ".join(marks), ha="right", va="top", fontsize=13, fontweight="bold", color="#B00000")
        yield figure
        for path in paths:
            figure.savefig(path, dpi=160, metadata={"Date": None} if path.suffix == ".svg" else None)


def _polar_axes(figure: "Figure", scale: float, theta_i: float, unit: str) -> Any:
    """Return a half disc that fills the figure, the normal upwards, the light's side to the right, with L drawn in."""
    axes = polar_axes(figure, 0.6, 0.7, figure.get_size_inches()[0] - 1.2, scale)
    towards_light(axes, theta_i)
    caption = f"reflected light by angle $\\theta_r$, scale {scale:g}{f' {unit}' if unit else ''}"
    figure.text(0.5, 0.02, caption, ha="center", va="bottom")
    return axes


def polar_axes(figure: "Figure", left: float, bottom: float, side: float, scale: float, *, whole: bool = False) -> Any:
    """Return a half disc `side` inches wide, or a whole one, the normal upwards and the light's side to the right."""
    # A half disc is as wide as its square box and stands in its middle: the box reaches beyond it.
    width, height = figure.get_size_inches()
    box = bottom if whole else bottom - side / 4
    axes: Any = figure.add_axes((left / width, box / height, side / width, side / height), projection="polar")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    if whole:
        axes.set_thetalim(-math.pi, math.pi)
        axes.set_rlabel_position(105)
    else:
        axes.set_thetalim(-math.pi / 2, math.pi / 2)
    axes.set_rlim(0, scale)
    axes.set_rticks([scale * i / 4 for i in range(1, 5)])
    axes.set_thetagrids(range(-150, 181, 30) if whole else range(-90, 91, 30))
    axes.grid(color="0.85", linewidth=0.6)
    return axes


def towards_light(axes: Any, theta_i: float) -> None:
    """Draw L, which points towards the light, into polar axes."""
    light, scale = math.radians(theta_i), axes.get_rmax()
    arrow = {"arrowstyle": "-|>", "color": "0.35", "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(light, scale), xytext=(0, 0), arrowprops=arrow)
    # Where the rim has a number, the letter stands beside the arrow.
    place = (light + 0.08, scale * 0.93) if abs(theta_i % 30 - 15) > 9 else (light, scale * 1.06)
    axes.text(*place, "L", fontweight="bold", color="0.25", ha="center", va="center")


def round_up(value: float) -> float:
    """Return the next round number that is round in quarters, too."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.2, 1.6, 2, 2.4, 3.2, 4, 6, 8, 10) if step * power >= value * 0.999)


def _scale(fits: Sequence["StoredFit"], wanted: float) -> float:
    """Return the paper's scale, or a multiple of it where the readings would not fit."""
    largest = max(max(*fit.fit.measured, *fit.fit.modelled) for fit in fits)
    return wanted * max(1, math.ceil(largest / wanted))


def _polar_fits(figure: "Figure", fits: Sequence["StoredFit"], scale: float, *, model: bool) -> None:
    axes = _polar_axes(figure, _scale(fits, scale), float(np.median(fits[0].fit.theta_i_deg)), fits[0].fit.unit)
    for stored in fits:
        fit, style = stored.fit, STYLES[stored.label]
        order = np.argsort(fit.theta_r_deg)
        angles, measured = np.radians(np.asarray(fit.theta_r_deg))[order], np.asarray(fit.measured)[order]
        marks: dict[str, Any] = {"color": style["color"], "marker": style["marker"], "markersize": 4.5}
        if model:
            axes.plot(angles, measured, **marks, linestyle="none", markerfacecolor="white", label=f"{stored.label} measured")
            fine = np.linspace(min(fit.theta_r_deg), max(fit.theta_r_deg), 141)
            line = fit.predict(np.full(fine.size, np.median(fit.theta_i_deg)), fine)
            axes.plot(
                np.radians(fine),
                line,
                color=style["color"],
                dashes=style["dashes"],
                linewidth=1.3,
                label=f"{stored.label} model, E {fit.E_mean:.1f} %",
            )
        else:
            axes.plot(angles, measured, **marks, dashes=style["dashes"], linewidth=1.3, label=stored.label)
    figure.legend(loc="upper left", bbox_to_anchor=(0.0, 1.0), frameon=False)


def _lobes(figure: "Figure", stored: "StoredFit") -> None:
    from fitting.paper import paper_terms

    theta_i = float(np.median(stored.fit.theta_i_deg))
    fine = np.arange(-89.0, 89.5, 1.0)
    terms = paper_terms(np.full(fine.size, theta_i), fine, aspect=stored.fit.shape["aspect"])
    axes = _polar_axes(figure, 1.0, theta_i, "")
    for (name, text), column in zip(TERMS.items(), terms.T, strict=True):
        enlarged = SPEC_ENLARGED if name == "u_spec" else 1.0
        style = TERM_STYLES[name]
        axes.plot(
            np.radians(fine),
            column * enlarged,
            color=style["color"],
            linestyle=style["linestyle"],
            linewidth=1.5,
            label=f"$r'_{{{name.replace('_', ',')}}}$ {text}{f' (x{enlarged:g})' if enlarged != 1 else ''}",
        )
    figure.text(0.985, 0.975, f"aspect {stored.fit.shape['aspect']:g}", ha="right", va="top")
    figure.legend(loc="upper left", bbox_to_anchor=(0.0, 1.0), frameon=False)


def _coefficients(figure: "Figure", fits: Sequence["StoredFit"]) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.1, right=0.985, top=0.8, bottom=0.08)
    # Logarithmic: r'_u_spec is small where cells scatter the mirror image, so its coefficient is large.
    positive = [value for stored in fits for value in stored.fit.x.values() if value > 0]
    floor = 10.0 ** (math.floor(math.log10(min(positive))) - 0.3) if positive else 0.1
    axes.set_yscale("log")
    axes.set_ylim(floor, 4 * max(positive, default=1.0))
    width = 0.8 / len(TERMS)
    for i, (name, text) in enumerate(TERMS.items()):
        style = TERM_STYLES[name]
        heights = [stored.fit.x[name] for stored in fits]
        places = np.arange(len(fits)) + (i - 1.5) * width
        face = "white" if style["hatch"] else style["color"]
        label = f"$x_{{{name.replace('_', ',')}}}$ {text}"
        axes.bar(places, heights, width * 0.92, facecolor=face, edgecolor=style["color"], hatch=style["hatch"], label=label)
        for place, height in zip(places, heights, strict=True):
            text_at = (place, max(height, floor))
            axes.annotate(f"{height:.3g}", text_at, textcoords="offset points", xytext=(0, 2), ha="center", fontsize=7)
    axes.set_xticks(range(len(fits)), [stored.label for stored in fits])
    axes.set_ylabel(f"coefficient{f', {fits[0].fit.unit}' if fits[0].fit.unit else ''}")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, loc="upper left", ncols=2)
