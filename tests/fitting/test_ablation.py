"""What each physical term changes: single terms by closed forms, their sum by the model itself."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from fitting.ablation import READ, Step, ablation, single_bounce
from fitting.cells import Cell, Spread
from fitting.errors import DomainError
from fitting.model import Model, build
from fitting.paper import paper_terms
from fitting.radiometric import paper_terms_any, radiometric_terms
from fitting.surface import surface
from fitting.table import Grid

VIEWS = np.arange(-80, 80.1, 5)
READ_VIEWS = VIEWS[np.abs(VIEWS) <= READ]
X = {
    "paper": {"u_diff": 0.2, "u_spec": 0.3, "s_diff": 0.05, "s_spec": 0.06},
    "radiometric": {"u_diff": 0.6, "u_spec": 0.05, "s_diff": 0.2, "s_spec": 0.05},
    "interreflecting": {"albedo": 0.8, "u_spec": 0.05},
    "body": {"mu": 0.1, "R_m": 0.5, "T_m": 0.3, "D_m": 0.05},
}
NAMES = ["flat", "slopes", "shadows", "hiding", "foreshortening", "floor", "interreflection", "lobe", "spongy"]


@pytest.fixture(scope="session")
def models() -> dict[str, Model]:
    cell = Cell(0.8, gap=0.1)
    return {mode: build(mode, cell, n_us=6, n_ss=3, grid=Grid(12, 12)) for mode in ("paper", "radiometric", "interreflecting")}


@pytest.fixture(scope="session")
def body() -> Model:
    return build("body", Cell(0.8, gap=0.1), grid=Grid(12, 12))


@pytest.mark.parametrize("cell", [Cell(), Cell(1.9), Cell(1.2, 1.5, 1.6, 0.15), Cell(0.5, gap=0.3, spread=Spread(0.1, place=0.2))])
def test_all_factors_together_are_single_bounce(cell: Cell) -> None:
    patch = surface(cell, 20, 36, 36) if cell.spread.height else surface(cell, 64, 96)
    values, albedo = single_bounce(patch, 45, READ_VIEWS)
    assert values == pytest.approx(radiometric_terms(45, READ_VIEWS, 0, cell=cell)[:, 0], rel=0.01)
    assert 0.2 < albedo < 1
    literal, _ = single_bounce(patch, 45, READ_VIEWS, foreshortened=False, floor=False)
    assert literal * math.pi * math.cos(math.pi / 4) == pytest.approx(paper_terms_any(45, READ_VIEWS, 0, cell=cell)[:, 0], rel=0.015)


@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_the_papers_factors_are_the_papers_sum(aspect: float) -> None:
    values, _ = single_bounce(surface(Cell(aspect), 64, 96), 30, READ_VIEWS, foreshortened=False, floor=False)
    exact = paper_terms(30, READ_VIEWS, aspect=aspect)[:, 0]
    assert values * math.pi * math.cos(math.pi / 6) == pytest.approx(exact, rel=0.01)


def test_each_factor_against_what_it_must_be() -> None:
    patch = surface(Cell(), 64, 96)
    plain = {"shadows": False, "hiding": False}
    # From the zenith to the zenith: a hemisphere's cosines add up to its base, its squared cosines to two thirds of it.
    (literal,), _ = single_bounce(patch, 0, [0.0], **plain, foreshortened=False, floor=False)
    assert literal == pytest.approx(1 / (2 * math.sqrt(3)), rel=1e-3)
    (aslant,), _ = single_bounce(patch, 0, [0.0], **plain, floor=False)
    assert aslant == pytest.approx(2 / 3 / (2 * math.sqrt(3)), rel=1e-3)
    (whole,), albedo = single_bounce(patch, 0, [0.0], **plain)
    assert whole == pytest.approx(aslant + (1 - math.pi / (2 * math.sqrt(3))) / math.pi, rel=1e-3)
    # Without hiding the whole upper half of each facet's Lambert light leaves: (1 + cos) / 2 of it, on average 5/6 of a lone hemisphere's.
    covered = math.pi / (2 * math.sqrt(3))
    assert albedo == pytest.approx(5 / 6 * covered + 1 - covered, rel=2e-3)
    # Nothing is in the way of nearly flat domes.
    flat, albedo = single_bounce(surface(Cell(0.001), 24, 48), 45, READ_VIEWS)
    assert flat == pytest.approx(1 / math.pi, rel=1e-2)
    assert albedo == pytest.approx(1, rel=1e-2)


def test_shadows_and_hiding_only_take_away() -> None:
    patch = surface(Cell(1.9), 24, 48)
    kept = [
        single_bounce(patch, 45, VIEWS, shadows=shadows, hiding=hiding)[0]
        for shadows, hiding in ((False, False), (True, False), (True, True))
    ]
    assert np.all(kept[1] <= kept[0])
    assert np.all(kept[2] <= kept[1])
    there, _ = single_bounce(patch, 60, [-20.0])
    back, _ = single_bounce(patch, 20, [-60.0])
    assert there == pytest.approx(back, rel=1e-9)  # reciprocal


@pytest.mark.parametrize("mode", ["paper", "radiometric", "interreflecting"])
def test_the_last_step_is_the_model_and_each_names_its_change(models: dict[str, Model], mode: str) -> None:
    model, x = models[mode], X[mode]
    steps = ablation(model, x, 45, VIEWS)
    left_out = {"paper": {"foreshortening", "floor", "interreflection"}, "radiometric": {"interreflection"}, "interreflecting": {"spongy"}}[
        mode
    ]
    assert [step.name for step in steps] == [name for name in NAMES if name not in left_out]
    mixed = model.reflectance(**x)
    assert steps[-1].values == pytest.approx(mixed(45, VIEWS, 0))
    assert steps[-1].albedo == pytest.approx(float(mixed.albedo(45)))
    for before, step in itertools.pairwise(steps):
        assert step.change is not None
        read = np.abs(VIEWS) <= READ
        assert step.change == pytest.approx(np.abs(step.values[read] / before.values[read] - 1).max())
        at = list(VIEWS).index(step.change_at_deg)
        assert abs(step.values[at] / before.values[at] - 1) == pytest.approx(step.change)
        assert step.ratio == pytest.approx(step.values[list(VIEWS).index(40)] / step.values[list(VIEWS).index(-40)])
        assert step.normalised is not None
        assert step.normalised[list(VIEWS).index(0)] == 1
    by_name = {step.name: step for step in steps}
    if mode == "paper":
        u_diff = paper_terms_any(45, READ_VIEWS, 0, cell=Cell(0.8, gap=0.1))[:, 0]
        assert by_name["hiding"].values[np.abs(VIEWS) <= READ] == pytest.approx(x["u_diff"] * u_diff, rel=0.015)
        assert by_name["flat"].values == pytest.approx(x["u_diff"] * math.cos(math.pi / 4))
    else:
        bounce = radiometric_terms(45, READ_VIEWS, 0, cell=Cell(0.8, gap=0.1))[:, 0]
        assert by_name["floor"].values[np.abs(VIEWS) <= READ] == pytest.approx(next(iter(x.values())) * bounce, rel=0.01)
    if mode == "interreflecting":
        assert by_name["interreflection"].albedo > 1.05 * by_name["floor"].albedo


def test_a_black_epidermis_has_nothing_to_compare_with(models: dict[str, Model]) -> None:
    steps = ablation(models["radiometric"], {"u_diff": 0.0, "u_spec": 0.1}, 45, VIEWS)
    assert [step.change for step in steps] == [None] * len(steps)
    assert steps[0].ratio is None
    assert steps[0].normalised is None
    assert steps[-1].values.max() > 0


@pytest.mark.slow
def test_body_light_without_each_part(body: Model) -> None:
    traced = body.body
    assert traced is not None
    x = X["body"]
    steps: dict[str, Step] = {step.name: step for step in ablation(body, x, 45, VIEWS)}
    whole = steps["whole"]
    read = np.abs(VIEWS) <= 60
    assert whole.values[read] == pytest.approx(body.reflectance(**x)(45, VIEWS[read], 0), rel=0.03)
    assert whole.albedo == pytest.approx(float(traced.albedo(45, **x)))
    assert whole.values - steps["mirror"].values == pytest.approx(traced.mirror_reflectance(45, VIEWS, 0))
    assert whole.values - steps["stray"].values == pytest.approx(traced.stray_reflectance(45, VIEWS, 0, mu=x["mu"]))
    assert np.all(steps["pigment"].values > whole.values)
    budget = traced.budget(45, **(x | {"mu": 0.0}))
    assert steps["pigment"].transmitted == pytest.approx(float(budget["scattered"] + budget["direct"]))
    assert steps["mesophyll"].transmitted == pytest.approx(0)
    assert steps["mesophyll"].albedo < 0.1
    assert steps["far face"].text == "domed far face instead"
    assert steps["far face"].transmitted != pytest.approx(whole.transmitted, rel=1e-3)
    # A flat face mirrors into one direction only: the same towards and away from the light.
    assert steps["domes"].ratio == pytest.approx(1)


@pytest.mark.parametrize(
    ("theta_i", "views"),
    [(90.0, VIEWS), (-1.0, VIEWS), (45.0, VIEWS[::-1]), (45.0, [-30.0, 0.0, 30.0]), (45.0, [-90.0, 0.0, 40.0]), (45.0, VIEWS[:, None])],
)
def test_directions_outside_the_model_are_refused(models: dict[str, Model], theta_i: float, views: list[float]) -> None:
    with pytest.raises(DomainError):
        ablation(models["paper"], X["paper"], theta_i, views)


def test_light_and_view_need_azimuths_opposite_each_other() -> None:
    with pytest.raises(DomainError, match="even number of azimuths"):
        single_bounce(surface(Cell(), 4, 6, 9), 45, VIEWS)
