"""Drawings of a reflection model alone: its cells, its lobes, its shape by direction, and what each physical term changes."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.ablation import READ, Step, ablation
from fitting.model import Model, cell_of
from fitting.reflectance import INTENSITY
from rig.cellfigure import draw_cell
from rig.figures import FORMATS, SPEC_ENLARGED, TERM_STYLES, TERMS, polar_axes, round_up, saved_figure, towards_light
from rig.models import PETAL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fitting.reflectance import Reflectance

VIEWS = np.arange(-80, 80.1, 2.5)
"""theta_r of an ablation, deg."""

INCIDENCES = (15.0, 30.0, 45.0, 60.0)

# Okabe and Ito's palette; dashes tell the same apart in grey print.
LINES: tuple[dict[str, Any], ...] = (
    {"color": "#000000", "dashes": (None, None)},
    {"color": "#D55E00", "dashes": (6, 2)},
    {"color": "#0072B2", "dashes": (6, 2, 1.5, 2)},
    {"color": "#009E73", "dashes": (1.5, 1.5)},
)
BODY_PARTS = {
    "mirror": ("mirror light of the domes", TERM_STYLES["u_spec"]),
    "stray": ("stray light of the epidermis", TERM_STYLES["s_spec"]),
    "body": ("body light", TERM_STYLES["s_diff"]),
}


@dataclass(frozen=True)
class Ablation:
    """One table of what each term changes.

    Parameters
    ----------
    mode : str
        The model's.
    numbers : mapping of str to float
        The cultivar's.
    theta_i : float, deg
    unit : str
        Of the steps' values; empty for intensities.
    steps : tuple of Step
    """

    mode: str
    numbers: Mapping[str, float]
    theta_i: float
    unit: str
    steps: tuple[Step, ...]

    @property
    def leaves_out(self) -> bool:
        """Whether each step is the whole without one part, not one term more."""
        return self.mode == "body"

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can hold."""
        return {
            "mode": self.mode,
            "numbers": dict(self.numbers),
            "theta_i_deg": self.theta_i,
            "unit": self.unit,
            "against": "the whole" if self.leaves_out else "the step before",
            "theta_r_deg": self.steps[0].theta_r_deg.tolist(),
            "steps": [
                {
                    "name": step.name,
                    "text": step.text,
                    "values": step.values.tolist(),
                    "ratio": step.ratio,
                    "albedo": step.albedo,
                    "transmitted": step.transmitted,
                    "change": step.change,
                    "change_at_deg": step.change_at_deg,
                }
                for step in self.steps
            ],
        }


def ablations(model: Model, numbers: Mapping[str, float], theta_i: float, others: Mapping[str, Model]) -> list[Ablation]:
    """Take the model to pieces, and where other modes are at hand, those two that know more physics."""
    asked = [(model, numbers), *((others[mode], PETAL[mode]) for mode in ("interreflecting", "body") if mode in others)]
    return [Ablation(one.mode, x, theta_i, _unit(one), ablation(one, x, theta_i, VIEWS)) for one, x in asked]


def ablation_table(found: Ablation) -> str:
    """Return an ablation as lines."""
    header = f"{'':<34} {'f(+40)/f(-40)':>13} {'albedo':>8} {'through':>8}  largest change, deg"
    against = "each left out of the whole" if found.leaves_out else "one term more each time"
    lines = [f"{found.mode}, theta_i = {found.theta_i:g} deg, {against}: {_words(found.numbers)}", header]
    for step in found.steps:
        ratio = "-" if step.ratio is None else f"{step.ratio:.3f}"
        through = "" if step.transmitted is None else f"{step.transmitted:.3f}"
        change = "" if step.change is None else f"{100 * step.change:9.1f} %  at {step.change_at_deg:+.0f}"
        lines.append(f"{step.text:<34} {ratio:>13} {step.albedo:>8.3f} {through:>8} {change}".rstrip())
    return "\n".join(lines)


def draw_model(
    model: Model,
    numbers: Mapping[str, float],
    folder: Path,
    *,
    theta_i: float,
    width: float,
    others: Mapping[str, Model],
    ablations: Sequence[Ablation],
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Draw all pages into `folder`, made where it is not there; return the files.

    Parameters
    ----------
    model : Model
    numbers : mapping of str to float
        The cultivar's.
    folder : Path
    theta_i : float, deg
    width : float
        Of a cell, um.
    others : mapping of str to Model
        Of the same geometry, the other modes, to draw side by side; may be empty.
    ablations : sequence of Ablation
        See `ablations`.
    formats : sequence of str
        Some of `rig.figures.FORMATS`.
    """
    mixed = model.reflectance(**numbers)
    below = model.transmittance(direct=True, **numbers) if model.body is not None else None
    title = f"{model.mode}, {_shape(model)}: {_words(numbers)}"
    pages: dict[str, tuple[Callable[[Figure], None], tuple[float, float]]] = {
        "cell": (lambda f: draw_cell(f, model, theta_i, width), (10, 5.6 if below else 4.6)),
        "lobes": (lambda f: _lobes(f, model, numbers, theta_i), (6, 4.3)),
        "polar": (lambda f: _polar(f, mixed, below, title), (10, 6.4 if below else 3.9)),
        "solid": (lambda f: _solid(f, mixed, below, theta_i, title), (10, 4.9)),
        "map": (lambda f: _maps(f, mixed, below, theta_i, title), (10.8, 5.0) if below else (5.5, 5.0)),
    }
    for found in ablations:
        name = "ablation" if found.mode == model.mode else f"ablation-{found.mode}"
        pages[name] = (lambda f, found=found: _ablation(f, found), (10, 1.35 + 1.0 * len(found.steps)))  # type: ignore[misc]
    if others:
        pages["modes"] = (
            lambda f: _modes(f, {model.mode: (model, numbers)} | {m: (o, PETAL[m]) for m, o in others.items()}, theta_i),
            (10, 4.9),
        )
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, (draw, size) in pages.items():
        paths = [folder / f"{name}.{ending}" for ending in formats]
        with saved_figure(size, paths, []) as figure:
            draw(figure)
        written += paths
    return written


def _unit(model: Model) -> str:
    return "" if model.table.mode == INTENSITY else "1/sr"


def _symbol(mixed: "Reflectance | Ablation") -> str:
    intensity = mixed.unit == "" if isinstance(mixed, Ablation) else mixed.mode == INTENSITY
    return "intensity $I$" if intensity else "$f_r$, 1/sr"


def _words(numbers: Mapping[str, float]) -> str:
    """Return numbers as text; what is alike on the far face goes without saying."""
    kept = {
        name: value for name, value in numbers.items() if value != numbers.get(name.removesuffix("_below")) or not name.endswith("_below")
    }
    return ", ".join(f"{name} {value:g}" for name, value in kept.items())


def _shape(model: Model) -> str:
    cell = cell_of(model)
    words = f"aspect {cell.aspect:g}"
    return words + ("" if cell.is_ellipsoid else f", p {cell.p:g}, q {cell.q:g}") + (f", gap {cell.gap:g}" if cell.gap else "")


def _lobes(figure: "Figure", model: Model, numbers: Mapping[str, float], theta_i: float) -> None:
    """Figure 6: the terms by themselves, in plane."""
    fine = np.arange(-89.0, 89.5, 1.0)
    curves: list[tuple[str, Any, Mapping[str, Any]]] = []
    if model.body is None:
        orders = [name for name in model.table.names if name.startswith("order_")]
        for name, text in TERMS.items():
            if name in model.table.names:
                values = model.table.alone(name)(theta_i, fine, 0.0)
            else:
                values = np.sum([model.table.alone(order)(theta_i, fine, 0.0) for order in orders], axis=0)
                text = f"{text}, all bounces, albedo 1"
            enlarged = SPEC_ENLARGED if name == "u_spec" else 1.0
            symbol = f"$r'_{{{name.replace('_', ',')}}}$" if model.table.mode == INTENSITY else f"$f_{{{name.replace('_', ',')}}}$"
            label = f"{symbol} {text}{f' (x{enlarged:g})' if enlarged != 1 else ''}"
            curves.append((label, values * enlarged, TERM_STYLES[name]))
    else:
        table, _ = model.parts(**numbers)
        for name, (text, part) in BODY_PARTS.items():
            enlarged = 1.0 if name == "body" else SPEC_ENLARGED
            values = enlarged * table.alone(name)(theta_i, fine, 0.0)
            curves.append((f"{text}{f' (x{enlarged:g})' if enlarged != 1 else ''}", values, part))
    scale = round_up(max(float(np.max(values[np.abs(fine) <= READ])) for _, values, _ in curves))
    cut = any(float(np.max(values)) > scale for _, values, _ in curves)
    axes = polar_axes(figure, 0.6, 0.7, figure.get_size_inches()[0] - 1.2, scale)
    towards_light(axes, theta_i)
    for label, values, style in curves:
        axes.plot(np.radians(fine), values, color=style["color"], linestyle=style["linestyle"], linewidth=1.5, label=label)
    unit = _unit(model)
    caption = f"reflected light by angle $\\theta_r$, scale {scale:g}{f' {unit}' if unit else ''}{'; cut at the rim' if cut else ''}"
    figure.text(0.5, 0.02, caption, ha="center", va="bottom")
    figure.text(0.985, 0.975, f"{model.mode}\n{_shape(model)}", ha="right", va="top")
    figure.legend(loc="upper left", bbox_to_anchor=(0.0, 1.0), frameon=False)


def _polar(figure: "Figure", mixed: "Reflectance", below: "Reflectance | None", title: str) -> None:
    """The cultivar in plane and across, for several incidences; what comes through below."""
    fine = np.arange(-88.0, 88.1, 1.0)
    planes = {
        "in the plane of incidence": (fine, np.zeros(fine.shape)),
        "across it, $\\varphi$ = 90 deg": (np.abs(fine), np.full(fine.shape, 90.0)),
    }
    above = {(t, name): mixed(t, *view) for t in INCIDENCES for name, view in planes.items()}
    through = {} if below is None else {(t, name): below(t, *view) for t in INCIDENCES for name, view in planes.items()}
    # Grazing mirror light would dwarf the rest: the scale is that of the views people read.
    read = np.abs(fine) <= READ
    curves = (*above.values(), *through.values())
    scale = round_up(max(float(values[read].max()) for values in curves))
    cut = any(float(values.max()) > scale for values in curves)
    for left, (name, _) in zip((0.5, 5.45), planes.items(), strict=True):
        axes = polar_axes(figure, left, 0.85, 4.05, scale, whole=below is not None)
        for theta_i, style in zip(INCIDENCES, LINES, strict=True):
            label = f"$\\theta_i$ = {theta_i:g} deg" if left < 1 else None
            axes.plot(np.radians(fine), above[theta_i, name], **style, linewidth=1.4, label=label)
            if below is not None:
                axes.plot(np.radians(180 - fine), through[theta_i, name], **style, linewidth=1.4)
            if left < 1:
                tip = {"arrowstyle": "-|>", "color": style["color"], "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
                axes.annotate("", xy=(math.radians(theta_i), scale), xytext=(math.radians(theta_i), 0.88 * scale), arrowprops=tip)
        if below is not None:
            axes.plot([-math.pi / 2, math.pi / 2], [scale, scale], color="0.2", linewidth=1.0)
        figure.text((left + 2.02) / 10, 0.4 / figure.get_size_inches()[1], name, ha="center", va="center")
    caption = f"{_symbol(mixed)} by angle $\\theta_r$, scale {scale:g}; arrows point towards the light{'; cut at the rim' if cut else ''}"
    figure.text(0.5, 0.02, caption, ha="center", va="bottom")
    figure.text(0.015, 0.975, title, va="top")
    figure.legend(loc="upper left", bbox_to_anchor=(0.005, 1 - 0.28 / figure.get_size_inches()[1]), frameon=False, ncols=4)


def _solid(figure: "Figure", mixed: "Reflectance", below: "Reflectance | None", theta_i: float, title: str) -> None:
    """The cultivar as a body, as far from the middle in each direction as light is sent there; two incidences."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource

    theta, phi = np.linspace(0, 88, 67)[:, None], np.linspace(-180, 180, 145)
    sides = [(mixed, 1.0)] + ([] if below is None else [(below, -1.0)])
    lights = (theta_i, 70.0 if theta_i < 55 else 20.0)
    shapes = {light: [(side(light, theta, phi), up) for side, up in sides] for light in lights}
    values = [values for parts in shapes.values() for values, _ in parts]
    largest = max(float(part[theta[:, 0] <= READ].max()) for part in values)
    cut = max(float(part.max()) for part in values) > largest
    t, p = np.radians(theta), np.radians(phi)
    direction = np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t) + 0 * p
    wide = max(float(np.abs(np.minimum(part, largest) * direction[n]).max()) for part in values for n in (0, 1))
    high = max(float((np.minimum(part, largest) * direction[2]).max()) for part in values)
    low, lamp = -high if below is not None else 0.0, LightSource(azdeg=225, altdeg=50)
    for n, (light, parts) in enumerate(shapes.items()):
        axes: Any = figure.add_axes((0.02 + 0.49 * n, 0.05, 0.46, 0.88), projection="3d")
        for found, up in parts:
            kept = np.minimum(found, largest)
            x, y, z = (kept * along for along in direction)
            shades = colormaps["cividis"](0.45 + 0.55 * kept / largest)
            fine: Any = {"rcount": 67, "ccount": 145, "linewidth": 0, "antialiased": False, "rasterized": True}
            axes.plot_surface(x, y, up * z, facecolors=shades, lightsource=lamp, **fine)
        for sign, name, dashes in ((1, "L", (None, None)), (-1, "mirror", (4, 2))):
            tip = 1.15 * largest * np.array([sign * math.sin(math.radians(light)), 0.0, math.cos(math.radians(light))])
            axes.plot(*np.outer(tip, [0, 1.0]), color="#D55E00", linewidth=1.6, dashes=dashes, zorder=10)
            axes.text(*(1.08 * tip), name, color="#D55E00", fontweight="bold", ha="center", zorder=11)
        axes.set(xlim=(-wide, wide), ylim=(-wide, wide), zlim=(low, high))
        axes.set_box_aspect((2 * wide, 2 * wide, high - low), zoom=0.95)
        axes.view_init(elev=22, azim=-62)
        step = round_up(wide / 2.1)
        for axis in (axes.set_xticks, axes.set_yticks):
            axis([-step, 0, step], [f"{-step:g}", "0", f"{step:g}"])
        step = round_up(high / 1.6)
        heights = [0, step] if below is None else [-step, 0, step]
        axes.set_zticks([h for h in heights if low <= h <= high], [f"{h:g}" for h in heights if low <= h <= high])
        axes.set_xlabel("x, on the light's side")
        axes.set_ylabel("y")
        axes.set_zlabel("z, along the normal")
        axes.set_title(f"$\\theta_i$ = {light:g} deg", y=0.98)
    figure.text(0.015, 0.975, title, va="top")
    caption = f"distance from the middle: {_symbol(mixed)}{f'; cut at {largest:.2g}' if cut else ''}"
    figure.text(0.5, 0.02, f"{caption}; L: towards the light", ha="center", va="bottom")


def _maps(figure: "Figure", mixed: "Reflectance", below: "Reflectance | None", theta_i: float, title: str) -> None:
    """All directions from above: theta_r outwards, phi around."""
    theta, phi = np.linspace(0, 85, 86)[:, None], np.linspace(-180, 180, 181)
    sides = {"reflected": mixed} | ({} if below is None else {"sent through, from the far normal": below})
    width, height = figure.get_size_inches()
    for n, (name, side) in enumerate(sides.items()):
        values, left = side(theta_i, theta, phi), 0.5 + 5.45 * n
        axes: Any = figure.add_axes((left / width, 0.75 / height, 3.5 / width, 3.5 / height), projection="polar")
        around, out = np.meshgrid(np.radians(phi), theta[:, 0])
        image = axes.pcolormesh(around, out, values, cmap="cividis", shading="gouraud", rasterized=True, vmin=0)
        if np.ptp(values) > 1e-3 * values.max():
            axes.contour(around, out, values, levels=np.linspace(values.min(), values.max(), 8)[1:-1], colors="white", linewidths=0.7)
        axes.grid(color="0.6", linewidth=0.4)
        axes.set_rlim(0, 85)
        axes.set_rgrids([30, 60], labels=["30°", "60°"], angle=100, color="white", fontsize=8)
        axes.set_thetagrids(range(0, 360, 45))
        mark = {"color": "#D55E00", "markeredgecolor": "white", "linestyle": "none"}
        if side is mixed:
            axes.plot(0, theta_i, marker="*", markersize=14, **mark)
            axes.plot(
                math.pi, theta_i, marker="o", markersize=8, **mark | {"color": "none", "markeredgecolor": "#D55E00"}, markeredgewidth=2
            )
            marks = "★ towards the light, ○ mirror direction"
        else:
            axes.plot(math.pi, theta_i, marker="X", markersize=10, **mark)
            marks = "✖ straight through"
        bar = figure.colorbar(image, cax=figure.add_axes(((left + 3.95) / width, 0.95 / height, 0.15 / width, 3.1 / height)))
        bar.set_label(_symbol(mixed) if side is mixed else "$f_t$, 1/sr")
        around_and_out = f"{name}, $\\theta_i$ = {theta_i:g} deg; around $\\varphi$, outwards $\\theta_r$\n{marks}"
        figure.text((left + 1.75) / width, 0.02, around_and_out, ha="center", va="bottom")
    figure.text(0.015, 0.975, _wrapped(title, int(width * 12)), va="top")


def _wrapped(text: str, columns: int) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, columns))


def _ablation(figure: "Figure", found: Ablation) -> None:
    """A row for each step: its curve, the same normalised, and its figures; in grey what it is compared with."""
    rows, height = len(found.steps), figure.get_size_inches()[1]
    against = "the whole" if found.leaves_out else "the step before"
    figure.text(0.015, 1 - 0.08 / height, f"{found.mode}, $\\theta_i$ = {found.theta_i:g} deg: {_words(found.numbers)}", va="top")
    grid = figure.subplots(rows, 2, sharex=True, squeeze=False)
    figure.subplots_adjust(left=0.25, right=0.8, top=1 - 0.85 / height, bottom=0.5 / height, hspace=0.28, wspace=0.24)
    grid[0, 0].set_title(_symbol(found))
    grid[0, 1].set_title("over its value at $\\theta_r$ = 0")
    most = round_up(1.02 * max(float(step.values.max()) for step in found.steps))
    shapes = [step.normalised for step in found.steps]
    most_shape = min(4.0, round_up(1.02 * max((float(shape.max()) for shape in shapes if shape is not None), default=1.0)))
    for n, step in enumerate(found.steps):
        before = found.steps[0 if found.leaves_out else max(0, n - 1)]
        for axes, of, top in ((grid[n, 0], lambda s: s.values, most), (grid[n, 1], lambda s: s.normalised, most_shape)):
            for one, style in ((before, {"color": "0.6", "dashes": (4, 2)}), (step, {"color": "black"})):
                curve = of(one)
                if curve is not None and (one is step or n):
                    axes.plot(one.theta_r_deg, curve, linewidth=1.4, **style)
            axes.axvline(found.theta_i, color="#D55E00", linewidth=0.9)
            axes.axvline(-found.theta_i, color="#D55E00", linewidth=0.9, dashes=(4, 2))
            axes.set(xlim=(-80, 80), ylim=(0, top))
            axes.set_xticks([-80, -40, 0, 40, 80])
            axes.spines[["top", "right"]].set_visible(False)
        middle = grid[n, 0].get_position()
        y = (middle.y0 + middle.y1) / 2
        figure.text(0.015, y, _wrapped(step.text if n == 0 or found.leaves_out else f"+ {step.text}", 25), va="center")
        words = [f"albedo {step.albedo:.3f}"]
        if step.transmitted is not None:
            words.append(f"through {step.transmitted:.3f}")
        if step.ratio is not None:
            words.append(f"f(+40)/f(-40) {step.ratio:.3f}")
        if step.change is not None:
            words.append(f"change {100 * step.change:.0f} % at {step.change_at_deg:+.0f} deg")
        figure.text(0.815, y, "\n".join(words), va="center", fontsize=8)
    for axes in grid[-1]:
        axes.set_xlabel("$\\theta_r$, deg (light's side positive)")
    lines = f"grey: {against}; thin lines: towards the light, and the mirror direction (dashed)"
    figure.text(0.015, 1 - 0.3 / height, lines, va="top", fontsize=8)


def _modes(figure: "Figure", cultivars: Mapping[str, tuple[Model, Mapping[str, float]]], theta_i: float) -> None:
    """The four modes side by side: what they do with the same light, by direction and altogether."""
    fine, incidences = np.arange(-85.0, 85.1, 1.0), np.arange(0.0, 85.1, 2.5)
    mixtures = {mode: model.reflectance(**x) for mode, (model, x) in cultivars.items()}
    albedos = {mode: mixed.albedo(incidences) for mode, mixed in mixtures.items()}
    curves = {}
    for mode, mixed in mixtures.items():
        lit = math.cos(math.radians(theta_i)) if mixed.mode == INTENSITY else 1.0
        curves[mode] = math.pi * mixed(theta_i, fine, 0.0) / lit / float(mixed.albedo(theta_i))
    scale = round_up(max(float(curve.max()) for curve in curves.values()))
    axes = polar_axes(figure, 0.45, 1.65, 4.9, scale)
    towards_light(axes, theta_i)
    right = figure.add_axes((0.625, 0.34, 0.35, 0.52))
    for (mode, (_, x)), style in zip(cultivars.items(), LINES, strict=True):
        departs = mixtures[mode].reciprocity()
        far = f"{100 * departs:.2g} %" if departs > 1e-5 else "less than 0.001 %"
        label = f"{mode}: {_words(x)}; departs from reciprocity by {far}"
        axes.plot(np.radians(fine), curves[mode], **style, linewidth=1.4, label=label)
        right.plot(incidences, albedos[mode], **style, linewidth=1.4)
    figure.text(0.29, 0.215, f"shape in plane: $\\pi f_r$ / albedo, 1 for Lambert, scale {scale:g}", ha="center", va="bottom")
    right.set(xlim=(0, 85), ylim=(0, None), xlabel="$\\theta_i$, deg", ylabel="albedo (of the paper's intensity: relative)")
    right.spines[["top", "right"]].set_visible(False)
    figure.text(
        0.015, 0.975, f"four modes of the model, $\\theta_i$ = {theta_i:g} deg, {_shape(next(iter(cultivars.values()))[0])}", va="top"
    )
    figure.legend(loc="lower left", bbox_to_anchor=(0.01, 0.0), frameon=False, fontsize=8)
