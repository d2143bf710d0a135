"""The page of a fit: what its figures are drawn from, what it says, and that nothing on it is hidden."""

import itertools
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fitting.aperture import Aperture
from fitting.compare import Comparison, compare
from fitting.fit import Fit, fit, predicted, predictions
from fitting.ladder import Directions, Traces, rung_of
from fitting.measurements import Measurements
from rig import fitfigures
from rig.fitfigures import draw_fit, reflectances_of
from rig.fitpage import caption, result, write_page
from rig.fitreadings import curves, cuts_of, readings_of
from rig.fits import StoredFit

VIEWS = np.arange(-70.0, 71, 10)
LONG = "Rosa-hybrida-leaf-upper-side-of-the-third-leaflet-after-two-days-in-water"
SHAPE = {"n": 20.0}


def phong(
    incidences: Sequence[float] | NDArray[np.float64], *, noise: float = 0.03, phis: Sequence[float] = (), **settings: Any
) -> Measurements:
    """Readings of a glossy Lambertian surface; those out of the plane are at 45 deg."""
    rng = np.random.default_rng(1)
    theta_i, theta_r = np.repeat(np.asarray(incidences, float), VIEWS.size), np.tile(VIEWS, len(incidences))
    theta_i = np.append(theta_i, np.full(3 * len(phis), 45.0))
    theta_r = np.append(theta_r, np.tile([20.0, 40.0, 60.0], len(phis)))
    phi = np.append(np.zeros(VIEWS.size * len(incidences)), np.repeat(np.asarray(phis, float), 3))
    ones = Measurements(theta_i, theta_r, np.ones(theta_i.size), phi_deg=phi, quantity=settings.get("quantity", "intensity"))
    intensity = rung_of("phong").design(Directions.of(theta_i, theta_r, phi), SHAPE, Traces()) @ [2.0, 0.1]
    value = intensity / ones.intensity * (1 + noise * rng.standard_normal(theta_i.size))
    if settings.pop("known", False):
        settings["sigma"] = noise * np.abs(value)
    return Measurements(theta_i, theta_r, value, phi_deg=phi, rows=np.arange(2, theta_i.size + 2), **settings)


def stored(found: Fit, *, label: str = "RR", simulated: bool = True) -> StoredFit:
    provenance = {"run": "2026-05-01_RR_0001", "run_uid": "8a7c", "journal_sha256": "ab" * 32}
    return StoredFit("2026-05-01_RR_1234abcd", datetime(2026, 5, 1, 2, 30, tzinfo=UTC).timestamp(), label, simulated, provenance, found)


def texts(svg: Path) -> str:
    """Return all text of a figure without spaces: formulas are set letter by letter."""
    return "".join("".join("".join(element.itertext()) for element in ET.parse(svg).iter("{http://www.w3.org/2000/svg}text")).split())


class Page(HTMLParser):
    """Reads a page; fails where tags do not match."""

    EMPTY = frozenset({"meta", "br"})

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.outward: list[str] = []
        self.words: list[str] = []
        self.bold: list[str] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.EMPTY:
            self.open.append(tag)
        self._look(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(attrs)

    def _look(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href") and not (value or "").startswith("#"):
                self.outward.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "text", "tspan"):
            self.words.append(data)
        if self.open and self.open[-1] == "b":
            self.bold.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def mixed() -> Fit:
    """A fit to 45 deg, with readings of two other incidences and out of the plane held out."""
    m = phong([30, 45, 60], phis=[60, 120])
    known = m.in_plane & (m.theta_i_deg == 45)
    found = fit(m.take(known), "phong", shape=SHAPE)
    others = [predicted(found, m.take(~known & m.in_plane), "30 and 60 deg"), predicted(found, m.take(~m.in_plane), "out of the plane")]
    return replace(found, predicted=tuple(others))


@pytest.fixture(scope="module")
def ladder() -> tuple[Fit, Comparison]:
    m = phong([30, 60], quantity="reflectance-factor", unit="1")
    comparison = compare(m, models=["lambert", "phong"])
    assert comparison.supported is not None
    found = comparison.supported.fit
    assert found is not None
    return found, comparison


# What is drawn


def test_readings_are_drawn_in_their_own_quantity() -> None:
    m = phong([20, 50], quantity="brdf", unit="1/sr")
    found = fit(m, "phong", shape=SHAPE)
    readings = readings_of(found)
    assert readings.value == pytest.approx(m.value)
    assert readings.modelled == pytest.approx(found.modelled / (math.pi * np.cos(np.radians(m.theta_i_deg))))
    assert np.allclose(readings.E, found.E)
    assert readings.percent == pytest.approx(100 * (m.value - readings.modelled) / m.value)
    assert readings.incidences.tolist() == [20, 50]


def test_a_reading_that_is_fitted_and_foretold_is_one_row() -> None:
    m = phong([30, 45])
    found = replace(fit(m, "phong", shape=SHAPE), predicted=predictions(m, "phong", shape=SHAPE))
    readings = readings_of(found)
    assert readings.fitted.all()
    assert len(readings.value) == len(m)
    other = m.theta_i_deg == 30
    assert readings.foretold[other] == pytest.approx(found.predicted[0].modelled)
    assert np.isnan(readings.foretold[~other]).all()
    assert not np.allclose(readings.foretold[other], readings.modelled[other], rtol=1e-4)
    assert readings.E_foretold[other] == pytest.approx(found.predicted[0].E)


def test_readings_held_out_come_after_those_fitted(mixed: Fit) -> None:
    readings = readings_of(mixed)
    assert readings.fitted.tolist() == [True] * 15 + [False] * 36
    assert readings.row[:15].tolist() == list(range(17, 32))
    assert readings.modelled[15:45] == pytest.approx(mixed.predicted[0].modelled)
    assert readings.foretold[15:45] == pytest.approx(mixed.predicted[0].modelled)
    assert np.isnan(readings.foretold[:15]).all()


def test_repeats_are_each_foretold_once() -> None:
    m = phong([30, 45])
    twice = m.take(np.r_[0 : len(m), 0:2])
    parts = predictions(twice, "phong", shape=SHAPE)
    readings = readings_of(replace(fit(twice, "phong", shape=SHAPE), predicted=parts))
    assert len(readings.value) == len(twice)
    assert np.isfinite(readings.foretold).sum() == 17


@pytest.mark.parametrize(("weights", "bar"), [("relative", lambda v, s: s * v), ("plain", lambda v, s: np.full(v.shape, s))])
def test_without_uncertainties_error_bars_are_the_scatter_of_the_residuals(weights: Any, bar: Any) -> None:
    m = phong([45])
    found = fit(m, "phong", shape=SHAPE, weights=weights)
    assert readings_of(found).bar == pytest.approx(bar(m.value, found.linear.scale))
    assert "came without uncertainties" in caption(stored(found))


def test_error_bars_are_the_uncertainties_where_there_are_any() -> None:
    m = phong([45], known=True)
    found = fit(m, "phong", shape=SHAPE)
    assert readings_of(found).bar == pytest.approx(m.sigma)
    assert "one standard uncertainty" in caption(stored(found))


def test_each_plane_is_a_line_of_its_own(mixed: Fit) -> None:
    readings = readings_of(mixed)
    cuts = cuts_of(readings)
    assert [(cut.theta_i_deg, cut.held, cut.by_phi, cut.rows.size) for cut in cuts] == [
        (30, 0, False, 15),
        (45, 0, False, 15),
        (45, 60, False, 3),
        (45, 120, False, 3),
        (60, 0, False, 15),
    ]
    for cut in cuts:
        assert np.all(np.diff(cut.angles(readings)) > 0)


def test_readings_round_a_cone_are_lines_by_phi() -> None:
    phi = np.linspace(-170, 170, 18)
    theta_i, theta_r = np.full(36, 45.0), np.repeat([20.0, 50.0], 18)
    design = rung_of("phong").design(Directions.of(theta_i, theta_r, np.tile(phi, 2)), SHAPE, Traces())
    found = fit(Measurements(theta_i, theta_r, design @ [2.0, 0.1], phi_deg=np.tile(phi, 2)), "phong", shape=SHAPE)
    cuts = cuts_of(readings_of(found))
    assert [(cut.held, cut.by_phi, cut.rows.size) for cut in cuts] == [(20, True, 18), (50, True, 18)]


@pytest.mark.parametrize("aperture", [Aperture(), Aperture(acceptance_deg=8)], ids=["ideal", "cone"])
def test_the_models_line_goes_through_the_model_at_the_readings(aperture: Aperture) -> None:
    m = phong([30, 45], quantity="brdf", unit="1/sr")
    found = fit(m, "phong", shape=SHAPE, aperture=aperture)
    readings = readings_of(found)
    lines = curves(found, cuts_of(readings), readings)
    assert len(lines) == 2
    for cut, (fine, line) in lines.items():
        assert np.max(np.diff(fine)) <= 1 + 1e-9
        assert np.interp(cut.angles(readings), fine, line) == pytest.approx(readings.modelled[cut.rows], rel=1e-9)
    # The cone makes the peak lower: without it the test would say nothing.
    bare = found.predict(m.theta_i_deg, m.theta_r_deg)
    assert np.allclose(found.modelled, bare, rtol=1e-9) == aperture.is_ideal


def test_no_line_of_the_fit_where_nothing_was_fitted(mixed: Fit) -> None:
    readings = readings_of(mixed)
    assert [cut.theta_i_deg for cut in curves(mixed, cuts_of(readings), readings)] == [45]


def test_coefficients_are_reflectances_too_where_the_scale_is_known() -> None:
    found = fit(phong([20, 50], quantity="brdf", unit="1/sr"), "phong", shape=SHAPE)
    reflectances = reflectances_of(found)
    assert reflectances is not None
    for c in found.linear.coefficients:  # both lobes are normalised
        assert reflectances[c.name] == pytest.approx((c.value, c.low, c.high), rel=1e-6)


def test_relative_readings_have_no_reflectances() -> None:
    assert reflectances_of(fit(phong([45]), "phong", shape=SHAPE)) is None


# The figures


@pytest.mark.slow
def test_every_figure_is_drawn_twice_and_says_simulated(ladder: tuple[Fit, Comparison], tmp_path: Path) -> None:
    found, comparison = ladder
    drawn = draw_fit(found, tmp_path, label="RR", simulated=True, comparison=comparison)
    names = ["polar", "cartesian", "coefficients", "ladder"]
    assert [path.name for path in drawn] == [f"{name}.{ending}" for name in names for ending in ("png", "svg")]
    from matplotlib.image import imread

    for path in drawn:
        if path.suffix == ".svg":
            assert "SIMULATED" in texts(path)
            assert "RR" in texts(path)
        else:
            picture = np.asarray(imread(path))[..., :3]
            assert 0.005 < np.mean(np.any(picture < 0.9, axis=-1)) < 0.5


@pytest.mark.slow
def test_measured_readings_are_not_called_simulated(tmp_path: Path) -> None:
    page = write_page(stored(fit(phong([45]), "phong", shape=SHAPE), simulated=False), tmp_path)
    assert "SIMULATED" not in page.read_text(encoding="utf-8")
    assert not any("SIMULATED" in texts(path) for path in tmp_path.rglob("*.svg"))


@pytest.mark.slow
def test_many_incidences_go_on_other_sheets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitfigures, "PANELS_POLAR", 2)
    monkeypatch.setattr(fitfigures, "PANELS_CARTESIAN", 1)
    found = fit(phong([10, 25, 55]), "phong", shape=SHAPE)
    names = [path.stem for path in draw_fit(found, tmp_path) if path.suffix == ".svg"]
    assert names == ["polar", "polar-2", "cartesian", "cartesian-2", "cartesian-3", "coefficients"]
    for name, theta_i in zip(["polar", "polar", "polar-2", "cartesian", "cartesian-2", "cartesian-3"], 2 * [10, 25, 55], strict=True):
        assert f"={theta_i}deg:meanE" in texts(tmp_path / f"{name}.svg")


def test_all_readings_lie_on_the_sheet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures: dict[str, Any] = {}

    @contextmanager
    def kept(size: tuple[float, float], paths: Sequence[Path], marks: Sequence[str]) -> Iterator[Any]:
        from matplotlib.figure import Figure

        yield figures.setdefault(paths[0].stem, Figure(size))

    monkeypatch.setattr(fitfigures, "saved_figure", kept)
    m = phong([20, 45, 70], known=True)
    draw_fit(fit(m, "phong", shape=SHAPE), tmp_path)
    polar, cartesian = figures["polar"].axes, figures["cartesian"].axes
    assert len(polar) == 3
    assert len(cartesian) == 9  # readings and two strips of residuals each
    for k in range(3):
        mine = m.incidence_of == k
        (marks,) = (line for line in polar[k].lines if line.get_marker() == "o")
        assert np.degrees(marks.get_xdata()) == pytest.approx(m.theta_r_deg[mine])
        assert marks.get_ydata() == pytest.approx(m.value[mine])
        assert polar[k].get_rmax() >= m.value[mine].max()
        for axes in cartesian[3 * k : 3 * k + 3]:
            (marks,) = (line for line in axes.lines if line.get_marker() == "o")
            low, high = axes.get_ylim()
            assert np.all((marks.get_ydata() >= low) & (marks.get_ydata() <= high))


def overlaps(figure: Any, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Return pairs of texts that lie over one another, and texts that leave the sheet."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    drawn: dict[int, Text] = {}
    plain = Text.draw

    def noted(self: Text, *args: Any, **kwargs: Any) -> None:
        if self.get_visible() and self.get_text().strip():
            drawn[id(self)] = self
        plain(self, *args, **kwargs)

    with monkeypatch.context() as patch:  # ticks beyond an axis' ends are there, but not drawn
        patch.setattr(Text, "draw", noted)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    boxes = [(text.get_text(), text.get_window_extent(canvas.get_renderer())) for text in drawn.values()]
    sheet = figure.bbox
    out = [(name, "the edge") for name, box in boxes if box.x0 < 0 or box.y0 < 0 or box.x1 > sheet.x1 or box.y1 > sheet.y1]
    return out + [(a, b) for (a, one), (b, other) in itertools.combinations(boxes, 2) if one.padded(-1).overlaps(other.padded(-1))]


def nearly_dark() -> Measurements:
    one = phong([45])
    value = one.value.copy()
    value[3:5] = [0.0005, 0.05]
    return replace(one, value=value)


HARD: dict[str, tuple[Callable[[], Fit], str]] = {
    "long label": (
        lambda: fit(phong([15, 30, 45, 60], quantity="brdf", unit="1/sr", known=True), "phong", shape=SHAPE, weights="sigma"),
        LONG,
    ),
    "E above 100 %": (lambda: fit(nearly_dark(), "phong", shape=SHAPE, weights="plain"), "RR"),
    "four coefficients": (lambda: fit(phong([15, 45], quantity="reflectance-factor"), "paper"), "WR"),
    "next to nothing known": (lambda: fit(phong([45]).take([1, 3, 5, 9]), "paper"), "RR"),
    "not determined": (lambda: fit(phong([0]).take([6, 7, 8]), "paper"), "RR"),
    "one coefficient": (lambda: fit(phong([60]), "lambert"), "RR"),
    "three columns": (lambda: fit(phong(np.arange(5, 75, 15.0)), "phong", shape=SHAPE), LONG),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", HARD)
def test_no_text_hides_another(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, label = HARD[case]
    seen: dict[str, list[tuple[str, str]]] = {}
    plain = fitfigures.saved_figure

    @contextmanager
    def looked_at(size: tuple[float, float], paths: Sequence[Path], marks: Sequence[str]) -> Iterator[Any]:
        with plain(size, paths[:1], marks) as figure:
            yield figure
            seen[paths[0].stem] = overlaps(figure, monkeypatch)

    monkeypatch.setattr(fitfigures, "saved_figure", looked_at)
    draw_fit(made(), tmp_path, label=label, simulated=True)
    assert {name: pairs for name, pairs in seen.items() if pairs} == {}
    assert "coefficients" in seen


# The page


@pytest.mark.slow
def test_the_page_is_whole_and_needs_nothing_from_outside(ladder: tuple[Fit, Comparison], tmp_path: Path) -> None:
    found, comparison = ladder
    one = stored(found)
    path = write_page(one, tmp_path / "fits", comparison)
    assert path == tmp_path / "fits" / f"{one.id}.html"
    page = Page(path)
    assert page.outward == []
    assert len(page.ids) == len(set(page.ids)) > 100
    used = set(re.findall(r"url\(#([^)]+)\)", page.source)) | set(re.findall(r'href="#([^"]+)"', page.source))
    assert used
    assert used <= set(page.ids)
    addresses = set(re.findall(r"https?://[^\"' <]+", page.source))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}  # names, not places
    assert (tmp_path / "fits" / "figures" / one.id / "polar.png").is_file()


@pytest.mark.slow
def test_the_page_says_all(ladder: tuple[Fit, Comparison], tmp_path: Path) -> None:
    found, comparison = ladder
    page = Page(write_page(stored(found), tmp_path, comparison))
    text = page.text
    assert text.startswith("SIMULATED: Fit of RR; model: Phong")
    assert "2026-05-01_RR_0001" in text
    assert "ab" * 32 in text
    assert "2026-05-01 02:30 UTC" in text
    for c in found.linear.coefficients:
        assert f"{c.low:.4g} to {c.high:.4g}" in text
    n_sigma = found.shape_sigma["n"]
    assert n_sigma is not None
    assert f"{found.shape['n']:.4g} {n_sigma:.4g} found" in text
    assert f"mean {found.E_mean:.1f} %, maximum {found.E_max:.1f} %" in text
    assert f"{found.linear.cosine_rmse:.4g}" in text
    assert f"{found.linear.condition:.4g}" in text
    for theta_r, E in zip(found.theta_r_deg, found.E, strict=True):
        assert f"{theta_r:.2f}".replace("-", "−") in text
        assert f"{E:.2f}" in text
    assert page.bold == ["Phong"]
    for row in comparison.rows:
        assert row.left_out is not None
        assert f"{row.left_out:.1f} %" in text
    assert caption(stored(found)) in text


@pytest.mark.slow
def test_a_ladder_of_too_few_readings_says_so(tmp_path: Path) -> None:
    m = phong([45]).take([2, 7, 11])
    comparison = compare(m, models=["lambert", "phong", "paper"])
    assert comparison.supported is None or comparison.supported.model == "lambert"
    problems = [row.problem for row in comparison.rows if row.problem]
    assert problems
    page = Page(write_page(stored(fit(m, "lambert")), tmp_path, comparison))
    for problem in problems:
        assert f"not fitted: {problem}" in page.text
    assert "notfitted:" in texts(next(tmp_path.rglob("ladder.svg")))


@pytest.mark.slow
def test_a_page_shows_which_readings_were_not_fitted(mixed: Fit, tmp_path: Path) -> None:
    page = Page(write_page(stored(mixed), tmp_path))
    assert page.source.count("<tr class=out>") == 36
    assert "phi, deg" in page.text
    assert "30 and 60 deg" in page.text
    drawn = "".join(texts(path) for path in tmp_path.rglob("cartesian*.svg"))
    assert "measured,notfitted" in drawn
    assert "predictedwithoutthereadings" in drawn


@pytest.mark.slow
def test_names_from_outside_are_text_not_markup(tmp_path: Path) -> None:
    found = fit(phong([45]), "phong", shape=SHAPE)
    page = Page(write_page(replace(stored(found), provenance={"file": "a<script>&b.csv"}, label="x<b>y"), tmp_path))
    assert "a<script>&b.csv" in page.text
    assert "<script" not in page.source
    assert page.bold == []


def test_a_page_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    from rig.errors import RunError

    (tmp_path / "figures").write_text("in the way")
    with pytest.raises(RunError, match=r"figures.*cannot be written"):
        write_page(stored(fit(phong([45]), "lambert")), tmp_path)


# The words


def test_the_caption_is_what_a_paper_needs() -> None:
    m = phong([15, 45.2], unit="nA")
    found = replace(fit(m, "paper"), predicted=predictions(m))
    said = caption(stored(found))
    assert said.startswith("SIMULATED readings. ")
    for words in ("eq. (8)", "eqs. (1) to (7)", "eq. (13)", "((I - I_exp)/I_exp)²", "30 readings", "2 angles of incidence, 15 and 45.2°",
                  "from −70 to 70°", f"{found.E_mean:.1f} % on average and {found.E_max:.1f} % at most", "diameter of the domes 0.5",
                  "lobe 40", "lobe 5", "one point from one direction"):  # fmt: skip
        assert words in said
    for c in found.linear.coefficients:
        assert f"x_{c.name} = {c.value:.4g} nA" in said
    assert f"{found.predicted[0].E_mean:.1f} % and {found.predicted[0].E_max:.1f} %" in said


def test_what_was_searched_is_not_called_assumed() -> None:
    said = caption(stored(fit(phong([30, 45]), "phong", shape={"n": (1.0, 500.0)}, aperture=Aperture(acceptance_deg=2))))
    found, assumed = said.split("Assumed: ")
    assert "exponent of the lobe n = " in found
    assert "exponent" not in assumed
    assert "acceptance cone of half-angle 2 deg" in assumed


def test_bad_news_is_in_the_first_sentence() -> None:
    good = fit(phong([30, 45]), "phong", shape=SHAPE)
    assert result(stored(good)).endswith("all its coefficients are determined.")
    assert "NOT converge" in result(stored(replace(good, converged=False)))
    assert "NOT converge" in caption(stored(replace(good, converged=False)))
    bounded = fit(phong([30, 45]), "phong", shape={"n": (60.0, 90.0)})
    assert "n ended at a bound" in result(stored(bounded))
    assert "at its bound" in caption(stored(bounded))
    loose = replace(fit(phong([30, 45]), "phong", shape={"n": (1.0, 500.0)}), shape_sigma={"n": None})
    assert "do not tell how far n can be trusted" in result(stored(loose))
    assert "without standard error" in caption(stored(loose))
    blind = fit(phong([0]).take([6, 7, 8]), "paper", shape={"aspect": 0.5})
    assert blind.linear.undetermined
    assert "NOT determined" in result(stored(blind))
    assert "is not determined" in caption(stored(blind))
    near = fit(phong([10], quantity="reflectance-factor"), "paper")
    assert near.linear.alike
    assert "hard to tell apart" in result(stored(near))
    wrong = fit(phong([30, 60], known=True, noise=0.001), "lambert", weights="sigma")
    assert "larger than the readings' uncertainty" in result(stored(wrong))
