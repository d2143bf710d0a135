"""Figures of one fit: measured against model by angle, its coefficients with their intervals, and the ladder of models."""

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.figures import SIMULATED, TERM_STYLES, TERMS, polar_axes, round_up, saved_figure, towards_light
from rig.fitreadings import Cut, Readings, curves, cuts_of, readings_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fitting.compare import Comparison
    from fitting.fit import Fit
    from fitting.linear import Coefficient

Array = NDArray[np.float64]
Drawer = Callable[["Figure"], None]

PANELS_POLAR, PANELS_CARTESIAN = 12, 6
"""So many panels to a figure; what is left goes on another."""

EXACT = 0.01
"""Errors below this, percent, are drawn as none: as many numbers as readings fit exactly."""

CLAIMED = 10.0
"""The paper's E, percent, marked among the residuals."""

# Okabe and Ito's colours, told apart in grey print by filled and open marks and by dashes.
FITTED: dict[str, Any] = {"color": "#000000", "marker": "o", "markersize": 4.5, "linestyle": "none", "markerfacecolor": "#000000"}
HELD_OUT: dict[str, Any] = FITTED | {"markerfacecolor": "white"}
MODEL: dict[str, Any] = {"color": "#D55E00", "linewidth": 1.5}
FORETOLD: dict[str, Any] = {"color": "#0072B2", "linewidth": 1.2, "linestyle": "--", "marker": "x", "markersize": 4.5}

ALL_TERMS = TERMS | {"diff": "diffuse", "spec": "mirror lobe", "mirror": "mirrored, by the domes", "body": "from within, the petal"}
ALL_STYLES = TERM_STYLES | {
    name: TERM_STYLES[like] for name, like in (("diff", "u_diff"), ("spec", "u_spec"), ("mirror", "u_spec"), ("body", "s_diff"))
}


def draw_fit(fit: "Fit", folder: Path, *, label: str = "", simulated: bool = False, comparison: "Comparison | None" = None) -> list[Path]:
    """Draw a fit as PNG and SVG into `folder` and return the files, in the order they are to be read.

    Parameters
    ----------
    fit : fitting.fit.Fit
    folder : Path
        Made where it is not there.
    label : str
        What was measured.
    simulated : bool
        Whether the readings are; every figure then says so.
    comparison : fitting.compare.Comparison, optional
        Draws the ladder of models, too.
    """
    readings = readings_of(fit)
    cuts = cuts_of(readings)
    scene = _Scene(fit, readings, curves(fit, cuts, readings), "; model: ".join(part for part in (label, model_title(fit.model)) if part))
    pages: dict[str, tuple[Drawer, tuple[float, float]]] = {}
    for name, chosen, most, draw in (
        ("polar", [cut for cut in cuts if cut.in_plane], PANELS_POLAR, _Polar),
        ("cartesian", cuts, PANELS_CARTESIAN, _Cartesian),
    ):
        for n, start in enumerate(range(0, len(chosen), most)):
            sheet = draw(scene, chosen[start : start + most])
            pages[f"{name}-{n + 1}" if n else name] = sheet.draw, sheet.size
    bars = _Coefficients(fit, scene.title)
    pages["coefficients"] = bars.draw, bars.size
    if comparison is not None:
        ladder = _Ladder(comparison, label)
        pages["ladder"] = ladder.draw, ladder.size
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, (drawn, size) in pages.items():
        paths = [folder / f"{name}.{ending}" for ending in ("png", "svg")]
        with saved_figure(size, paths, [SIMULATED] if simulated else []) as figure:
            drawn(figure)
        written += paths
    return written


def model_title(name: str) -> str:
    """Return what a rung of the ladder is called."""
    from fitting.ladder import RUNGS

    return RUNGS[name].title if name in RUNGS else name


def percent(E: float | None) -> str:
    """Return an error in percent; a dash where there is none."""
    if E is None or not math.isfinite(E):
        return "\N{EN DASH}"
    return f"{E:.1f} %" if E < 100 else f"{E:.0f} %"


def unit_of_coefficients(fit: "Fit") -> str:
    """Return the unit of the coefficients; empty where they are reflectances or plain numbers."""
    return fit.unit if fit.quantity == "intensity" and fit.unit not in ("1", "relative") else ""


def reading_words(fit: "Fit") -> tuple[str, str]:
    """Return what a reading is, and its unit, empty where it has none."""
    words = {"intensity": "reading", "reflectance-factor": "reflectance factor", "brdf": "BRDF"}
    what = "relative reading" if fit.unit == "relative" else words.get(fit.quantity, fit.quantity)
    return what, "" if fit.unit in ("1", "relative") else fit.unit


def bars_mean(fit: "Fit") -> str:
    """Say what the error bars are; empty where there are none."""
    if fit.measurements.sigma is not None:
        return "one standard uncertainty of the reading"
    if fit.linear.scale is None or fit.weights not in ("relative", "plain"):
        return ""
    size = f"{100 * fit.linear.scale:.2g} % of the reading" if fit.weights == "relative" else f"{fit.linear.scale:.2g}"
    return f"the scatter of the residuals, {size} (the readings came without uncertainties)"


def _headed(figure: "Figure", title: str, columns: int) -> None:
    """Write the title, kept clear of the mark in the right corner."""
    width, height = figure.get_size_inches()
    figure.text(0.1 / width, 1 - 0.1 / height, _wrapped(title, columns), va="top", fontsize=10)


def _wrapped(text: str, columns: int) -> str:
    return "\n".join(textwrap.wrap(text, columns, max_lines=2, placeholder=" ...", break_long_words=True))


@dataclass(frozen=True, eq=False)
class _Scene:
    fit: "Fit"
    readings: Readings
    curves: dict[Cut, tuple[Array, Array]]
    title: str

    @property
    def keys(self) -> list[tuple[str, dict[str, Any]]]:
        """What the legend explains."""
        out = [("measured", FITTED), (f"model, mean E {percent(self.fit.E_mean)}", MODEL)]
        if not np.all(self.readings.fitted):
            out.append(("measured, not fitted", HELD_OUT))
        if np.any(np.isfinite(self.readings.foretold)):
            out.append(("predicted without the readings", FORETOLD))
        return out

    def heading(self, cut: Cut) -> str:
        """What a panel shows, and how well the model does there."""
        readings = self.readings
        told = [("mean E", readings.E[cut.rows][readings.fitted[cut.rows]]), ("predicted", readings.E_foretold[cut.rows])]
        words = [f"{name} {percent(float(np.nanmean(E)))}" for name, E in told if np.any(np.isfinite(E))]
        return f"{cut.title}: {', '.join(words)}" if words else cut.title

    def legend(self, figure: "Figure", below: float, columns: int) -> None:
        from matplotlib.lines import Line2D

        width, height = figure.get_size_inches()
        handles = [Line2D([], [], **style, label=text) for text, style in self.keys]
        anchor = (0.02 / width, 1 - below / height)
        figure.legend(handles=handles, loc="upper left", bbox_to_anchor=anchor, frameon=False, ncols=columns)

    def draw(self, axes: Any, cut: Cut, angles: Array, grid: Callable[[Array], Array], size: float, cap: float) -> None:
        """Draw readings, model and prediction; `angles` and `grid` are in the axes' unit."""
        readings = self.readings
        if cut in self.curves:
            fine, line = self.curves[cut]
            axes.plot(grid(fine), line, **MODEL, zorder=3)
        there = np.isfinite(readings.foretold[cut.rows])
        if there.any():
            axes.plot(angles[there], readings.foretold[cut.rows][there], **FORETOLD, zorder=3.5)
        value, bar = readings.value[cut.rows], readings.bar[cut.rows]
        for which, style in self.marks(cut):
            bars = {} if np.all(np.isnan(bar[which])) else {"yerr": np.nan_to_num(bar[which])}
            axes.errorbar(angles[which], value[which], **bars, **style | {"markersize": size}, elinewidth=1.0, capsize=cap, zorder=4)

    def marks(self, cut: Cut) -> list[tuple[NDArray[np.bool_], dict[str, Any]]]:
        """Which of the cut's rows have which mark."""
        fitted = self.readings.fitted[cut.rows]
        return [(which, style) for which, style in ((fitted, FITTED), (~fitted, HELD_OUT)) if which.any()]


class _Polar:
    """The paper's figures 8 and 9: one half disc an incidence, all of a sheet on one scale."""

    TOP, FOOT = 0.6, 0.35

    def __init__(self, scene: _Scene, cuts: Sequence[Cut]) -> None:
        self.scene, self.cuts = scene, cuts
        self.columns = 1 if len(cuts) == 1 else 2 if len(cuts) <= 4 else 3
        self.side = {1: 4.8, 2: 4.05, 3: 2.55}[self.columns]
        self.across = {1: 6.0, 2: 4.95, 3: 3.3}[self.columns]
        self.down = self.side / 2 + 0.95
        rows = math.ceil(len(cuts) / self.columns)
        self.size = (self.columns * self.across, self.TOP + rows * self.down + self.FOOT)

    def draw(self, figure: "Figure") -> None:
        scene, readings = self.scene, self.scene.readings
        scale, cut_off = self._scale()
        width, height = self.size
        for n, cut in enumerate(self.cuts):
            row, column = divmod(n, self.columns)
            left = column * self.across + (self.across - self.side) / 2
            bottom = height - self.TOP - (row + 1) * self.down + 0.5
            axes = polar_axes(figure, left, bottom, self.side, scale)
            if self.columns == 3:
                axes.set_rticks([scale / 2, scale])
                axes.tick_params(labelsize=7)
            towards_light(axes, cut.theta_i_deg)
            scene.draw(axes, cut, np.radians(cut.angles(readings)), np.radians, 3.5, 0)
            axes.set_rlim(0, scale)
            figure.text((left + self.side / 2) / width, (bottom - 0.38) / height, scene.heading(cut), ha="center", va="center")
        _headed(figure, scene.title, 55 if self.columns == 1 else 100)
        scene.legend(figure, 0.4, 2 if self.columns == 1 else 4)
        what, unit = reading_words(scene.fit)
        caption = f"{what} by angle $\\theta_r$, scale {scale:g}{f' {unit}' if unit else ''}; L points towards the light"
        figure.text(0.5, 0.1 / height, caption + cut_off, ha="center", va="bottom")

    def _scale(self) -> tuple[float, str]:
        """Return the radius, and what to say of what does not fit."""
        readings = self.scene.readings
        rows = np.concatenate([cut.rows for cut in self.cuts])
        value = readings.value[rows]
        tops = value + np.nan_to_num(readings.bar[rows])
        lines = [self.scene.curves[cut][1] for cut in self.cuts if cut in self.scene.curves]
        model = max(
            float(np.nanmax([*readings.modelled[rows], *np.nan_to_num(readings.foretold[rows])])),
            *(float(line.max()) for line in lines),
            0.0,
        )
        most = max(float(tops.max()), min(model, 1.5 * float(value.max())))
        scale = round_up(most)
        said = "; model cut at the rim" if model > scale else ""
        return scale, said + ("; readings below 0 not shown" if np.any(value < 0) else "")


class _Cartesian:
    """Readings and model by angle, residuals below: a column of axes for each line of readings."""

    TOP, FOOT, MAIN, STRIP, APART, GAP, LEFT = 0.75, 0.0, 2.2, 0.75, 0.14, 1.0, 0.85

    def __init__(self, scene: _Scene, cuts: Sequence[Cut]) -> None:
        self.scene, self.cuts = scene, cuts
        self.with_sigma = bool(np.any(np.isfinite(scene.readings.sigma)))
        self.columns = 1 if len(cuts) == 1 else 2
        self.across = 7.0 if self.columns == 1 else 5.2
        self.strips = 2 if self.with_sigma else 1
        self.down = self.MAIN + self.strips * (self.STRIP + self.APART) + self.GAP
        self.size = (self.columns * self.across, self.TOP + math.ceil(len(cuts) / self.columns) * self.down + self.FOOT)

    def draw(self, figure: "Figure") -> None:
        width, height = self.size
        for n, cut in enumerate(self.cuts):
            row, column = divmod(n, self.columns)
            left, top = column * self.across + self.LEFT, height - self.TOP - row * self.down - 0.3
            wide = self.across - self.LEFT - 0.15

            def box(up: float, tall: float, left: float = left, wide: float = wide) -> tuple[float, float, float, float]:
                return left / width, up / height, wide / width, tall / height

            top -= self.MAIN
            main: Any = figure.add_axes(box(top, self.MAIN))
            strips = [figure.add_axes(box(top - (k + 1) * (self.STRIP + self.APART), self.STRIP), sharex=main) for k in range(self.strips)]
            self._readings(main, cut, labelled=column == 0)
            self._strips(strips, cut, labelled=column == 0)
            for axes in (main, *strips):
                axes.tick_params(labelbottom=axes is strips[-1])
                axes.spines[["top", "right"]].set_visible(False)
            running = "\\varphi" if cut.by_phi else "\\theta_r"
            strips[-1].set_xlabel(f"${running}$, deg" + ("" if cut.by_phi else " (light's side positive)"))
            main.set_title(self.scene.heading(cut), fontsize=9, loc="left", pad=13)
        _headed(figure, self.scene.title, 65 if self.columns == 1 else 105)
        self.scene.legend(figure, 0.4, 2 if self.columns == 1 else 4)

    def _readings(self, axes: Any, cut: Cut, *, labelled: bool) -> None:
        scene, readings = self.scene, self.scene.readings
        if cut.in_plane:
            _light_lines(axes, cut.theta_i_deg, cut.fine(readings))
        scene.draw(axes, cut, cut.angles(readings), lambda fine: fine, 4.5, 2)
        value, bar = readings.value[cut.rows], readings.bar[cut.rows]
        lowest = min(float(np.min(value - np.nan_to_num(bar))), 0.0)
        axes.set_ylim(1.05 * lowest if lowest < 0 else 0, None)
        what, unit = reading_words(scene.fit)
        if labelled:
            axes.set_ylabel(f"{what}{f', {unit}' if unit else ''}")

    def _strips(self, strips: Sequence[Any], cut: Cut, *, labelled: bool) -> None:
        readings = self.scene.readings
        angles, percent = cut.angles(readings), readings.percent[cut.rows]
        kinds: list[tuple[Array, str, float]] = [(percent, "residual, %", CLAIMED)]
        if self.with_sigma:
            sigma = readings.sigma[cut.rows]
            kinds.append((readings.residual[cut.rows] / np.where(sigma > 0, sigma, math.nan), "residual/$\\sigma$", 2.0))
        for axes, (values, name, band) in zip(strips, kinds, strict=True):
            axes.axhspan(-band, band, color="0.92", linewidth=0)
            axes.axhline(0, color="0.4", linewidth=0.8)
            for which, style in self.scene.marks(cut):
                axes.vlines(angles[which], 0, values[which], color=style["color"], linewidth=1.0)
                axes.plot(angles[which], values[which], **style)
            _symmetric(axes, values, band)
            if labelled:
                axes.set_ylabel(name)


def _light_lines(axes: Any, theta_i: float, fine: Array) -> None:
    """Mark the light's direction and the mirror direction where they lie among the readings."""
    for at, name, dashes in ((theta_i, "L", (None, None)), (-theta_i, "mirror", (2, 2))):
        if fine.min() <= at <= fine.max() and (theta_i > 0 or name == "L"):
            axes.axvline(at, color="0.7", linewidth=1.0, dashes=dashes, zorder=1)
            axes.annotate(name, (at, 1), xycoords=("data", "axes fraction"), xytext=(0, 1), textcoords="offset points", ha="center",
                          color="0.35", fontsize=8, fontweight="bold" if name == "L" else "normal")  # fmt: skip


def _symmetric(axes: Any, values: Array, band: float) -> None:
    """Set limits about 0 that hold all values; beyond ten bands the outer ones are squeezed together."""
    most = max(band, float(np.nanmax(np.abs(values))) if np.any(np.isfinite(values)) else band)
    if most > 10 * band:
        axes.set_yscale("symlog", linthresh=band)
        power = math.ceil(math.log10(most))
        ticks, names = (-(10.0**power), 0, 10.0**power), (f"$-10^{power}$", "0", f"$10^{power}$")
        axes.set_ylim(2 * ticks[0], 2 * ticks[-1])
        axes.set_yticks(ticks, names)
        axes.minorticks_off()
    else:
        most = round_up(most)
        axes.set_ylim(-1.25 * most, 1.25 * most)
        axes.set_yticks([-most, 0, most])


class _Coefficients:
    """Figure 7 for one fit, with 95 % intervals; and beside it the reflectances, where the readings' scale is known."""

    def __init__(self, fit: "Fit", title: str) -> None:
        self.title, self.unit = title, unit_of_coefficients(fit)
        self.coefficients = fit.linear.coefficients
        self.reflectances = reflectances_of(fit)
        width = max(3.6, 1.1 * len(self.coefficients) + 1.1)
        self.size = (max(6.0, width * (2 if self.reflectances else 1)), 4.4)

    def draw(self, figure: "Figure") -> None:
        width, height = self.size
        panels: Any = figure.subplots(1, 2 if self.reflectances else 1, squeeze=False)[0]
        figure.subplots_adjust(
            left=0.85 / width, right=1 - 0.15 / width, top=1 - 0.75 / height, bottom=1.0 / height, wspace=0.9 / (width / 2)
        )
        raw = [(c.value, c.low, c.high) for c in self.coefficients]
        self._panel(panels[0], raw, f"coefficient x{f', {self.unit}' if self.unit else ''}")
        if self.reflectances:
            scaled = [self.reflectances[c.name] for c in self.coefficients]
            self._panel(panels[1], scaled, "reflectance at normal incidence")
        _headed(figure, self.title, 62 if width < 8 else 100)
        notes = ["bars: 95 % intervals"]
        if any(c.value == 0 and c.determined for c in self.coefficients):
            notes.append("arrow down: 0, with its upper limit")
        if any(not c.determined for c in self.coefficients):
            notes.append("hatched: NOT determined, anything within")
        figure.text(0.5, 0.08 / height, "; ".join(notes), ha="center", va="bottom", fontsize=8)

    def _panel(self, axes: Any, values: Sequence[tuple[float, float, float]], name: str) -> None:
        sizes = [value or high for value, _, high in values if 0 < (value or high) < math.inf] or [1.0]
        most = max([*sizes, *(high for _, _, high in values if math.isfinite(high))])
        if most > 30 * min(sizes):
            # Lower ends next to 0 would open decades of nothing.
            lowest = min([*sizes, *(low for _, low, _ in values if low > min(sizes) / 10)])
            floor = 10.0 ** math.floor(math.log10(lowest / 1.5))
            top = most * (most / floor) ** 0.22
            axes.set_yscale("log")
        else:
            floor, top = 0.0, 1.3 * most
        axes.set_ylim(floor, top)
        spare = max(0, 4 - len(values)) / 2
        axes.set_xlim(-0.6 - spare, len(values) - 0.4 + spare)
        for n, (coefficient, triple) in enumerate(zip(self.coefficients, values, strict=True)):
            _bar(axes, n, coefficient, triple, floor, top)
        axes.set_xticks(range(len(values)), [term_label(c.name) for c in self.coefficients], fontsize=8)
        axes.set_ylabel(name)
        axes.spines[["top", "right"]].set_visible(False)


def _bar(axes: Any, place: int, coefficient: "Coefficient", triple: tuple[float, float, float], floor: float, top: float) -> None:
    value, low, high = triple
    base, reach = max(low, floor), min(high, top)
    style = term_style(coefficient.name)
    within = f"{short(low)} to {short(high)}"
    if not coefficient.determined:
        axes.bar(place, reach - base, 0.62, bottom=base, facecolor="white", edgecolor="0.45", hatch="////", linewidth=0.8)
        text = f"NOT determined\n{within}"
    elif value == 0:
        axes.annotate("", xy=(place, floor), xytext=(place, reach), arrowprops={"arrowstyle": "-|>", "color": style["color"], "lw": 1.4})
        axes.plot([place - 0.2, place + 0.2], [reach, reach], color=style["color"], linewidth=1.6)
        text = f"0\nbelow {short(high)}"
    else:
        face = "white" if style["hatch"] else style["color"]
        axes.bar(place, value - floor, 0.62, bottom=floor, facecolor=face, edgecolor=style["color"], hatch=style["hatch"])
        # An end that lies beyond the axis has no cap.
        caps = [end for end in (low, high) if floor <= end <= top]
        # White below, so that lines stand out from any bar.
        for line in ({"color": "white", "linewidth": 3.6, "zorder": 3}, {"color": "0.1", "linewidth": 1.4, "zorder": 4}):
            axes.vlines(place, base, reach, **line)
            axes.hlines(caps, place - 0.09, place + 0.09, **line)
        text = f"{short(value)}\n{within}"
    inside = reach >= top
    ground = {"facecolor": "white", "edgecolor": "none", "pad": 1.0} if inside else None
    axes.annotate(
        text,
        (place, reach),
        textcoords="offset points",
        xytext=(0, -3 if inside else 3),
        ha="center",
        va="top" if inside else "bottom",
        fontsize=7,
        zorder=6,
        bbox=ground,
    )


def short(value: float) -> str:
    """Return a number of three digits for a label, without an exponent where a person would write none."""
    if not math.isfinite(value):
        return "any"
    return f"{float(f'{value:.3g}'):.7g}" if value == 0 or 1e-3 <= abs(value) < 1e6 else f"{value:.3g}"


def term_style(name: str) -> dict[str, Any]:
    """Return colour and hatch of a term."""
    return ALL_STYLES.get(name, TERM_STYLES["s_spec"])


def term_label(name: str) -> str:
    """Return a term's symbol and what it stands for, for an axis."""
    symbol = f"$x_{{{name.replace('_', ',')}}}$"
    return f"{symbol}\n{ALL_TERMS[name].replace(', ', chr(10))}" if name in ALL_TERMS else symbol


def reflectances_of(fit: "Fit") -> dict[str, tuple[float, float, float]] | None:
    """Return each term as a reflectance with its 95 % interval; None for relative readings, whose scale is not known."""
    return None if fit.quantity == "intensity" else fit.reflectances()


class _Ladder:
    """Errors and evidence of each model, side by side."""

    def __init__(self, comparison: "Comparison", label: str) -> None:
        self.comparison, self.label = comparison, label
        self.size = (10.0, 1.75 + 0.5 * len(comparison.rows))

    def draw(self, figure: "Figure") -> None:
        width, height = self.size
        rows, chosen = self.comparison.rows, self.comparison.supported
        errors, evidence = figure.subplots(1, 2, sharey=True)
        figure.subplots_adjust(left=1.75 / width, right=1 - 0.3 / width, top=1 - 0.7 / height, bottom=0.65 / height, wspace=0.08)
        places = np.arange(len(rows))
        self._errors(errors, places)
        self._evidence(evidence, places)
        errors.set_yticks(places, ["\n".join(textwrap.wrap(row.title, 20)) for row in rows])
        for text, row in zip(errors.get_yticklabels(), rows, strict=True):
            text.set_fontweight("bold" if row is chosen else "normal")
        errors.set_ylim(len(rows) - 0.4, -0.6)
        for axes in (errors, evidence):
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(axis="y", length=0)
        title = f"{self.label}: the ladder of models" if self.label else "the ladder of models"
        _headed(figure, f"{title}; supported by the data: {'none' if chosen is None else chosen.title}", 95)

    def _errors(self, axes: Any, places: NDArray[np.int64]) -> None:
        rows = self.comparison.rows
        fitted, left_out = (
            [math.nan if v is None else v for v in column] for column in zip(*((r.E_mean, r.left_out) for r in rows), strict=True)
        )
        there = [v for v in (*fitted, *left_out) if v >= EXACT]
        log = bool(there) and max(there) > 20 * min(there)
        if log:
            axes.set_xscale("log")
        floor = 10.0 ** math.floor(math.log10(min(there))) if log else 0.0
        top = max(there, default=1.0) * (2.2 if log else 1.18)
        axes.set_xlim(floor, top)
        apart = 0.19 if np.any(np.isfinite(left_out)) else 0.0
        for values, offset, style, name in (
            (fitted, -apart, {"facecolor": "#0072B2", "edgecolor": "#0072B2"}, "fitted"),
            (left_out, apart, {"facecolor": "white", "edgecolor": "#D55E00", "hatch": "///"}, "left out, one incidence at a time"),
        ):
            if not np.any(np.isfinite(values)):
                continue
            axes.barh(
                places + offset, [max(v, floor) - floor if math.isfinite(v) else 0.0 for v in values], 0.34, left=floor, **style, label=name
            )
            for place, value in zip(places, values, strict=True):
                if math.isfinite(value):
                    axes.annotate(
                        f"{value:.3g}" if value >= EXACT else "0",
                        (max(value, floor), place + offset),
                        textcoords="offset points",
                        xytext=(3, 0),
                        va="center",
                        fontsize=7,
                    )
        for place, row in zip(places, rows, strict=True):
            if row.problem:
                text = textwrap.shorten(f"not fitted: {row.problem}", 60, placeholder=" ...")
                axes.annotate(text, (0.01, place), xycoords=("axes fraction", "data"), va="center", fontsize=7, color="#B00000")
        if floor < CLAIMED < top:
            axes.axvline(CLAIMED, color="0.6", linewidth=0.9, dashes=(3, 2), zorder=0)
        axes.set_xlabel("mean E, %")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=2, borderaxespad=0.1)

    def _evidence(self, axes: Any, places: NDArray[np.int64]) -> None:
        aicc = np.array([math.nan if row.aicc is None else row.aicc for row in self.comparison.rows])
        axes.set_xlabel("AICc above the least")
        if not np.any(np.isfinite(aicc)):
            axes.set_xticks([])
            axes.text(0.5, 0.5, "no AICc: too few readings", transform=axes.transAxes, ha="center", fontsize=8)
            return
        above = aicc - np.nanmin(aicc)
        most = float(np.nanmax(above))
        if most > 100:
            axes.set_xscale("symlog", linthresh=10, linscale=1.0)
        axes.set_xlim(0, max(12.0, most * (4 if most > 100 else 1.25)))
        axes.axvspan(0, 2, color="0.92", linewidth=0)
        axes.hlines(places, 0, above, color="0.6", linewidth=1.0)
        axes.plot(above, places, color="#000000", marker="D", markersize=6, linestyle="none", clip_on=False)
        for place, value in zip(places, above, strict=True):
            if math.isfinite(value):
                axes.annotate(f"{value:.1f}", (value, place), textcoords="offset points", xytext=(8, 0), va="center", fontsize=7)
