"""The rungs: each against somebody else's formula, its energy, reciprocity and limits, and the quick designs against the slow ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting.cells import Cell
from fitting.errors import DomainError
from fitting.ladder import ORDERS_GRID, RATIO, REFRACTION, RUNGS, Directions, Rung, Traces, fresnel, rung_of, unit_reflectances
from fitting.model import build
from fitting.orders import EscapeOrders, escape_orders
from fitting.paper import TERMS, paper_terms
from fitting.radiometric import Sampling, radiometric_terms
from fitting.search import usual_bounds
from fitting.table import Grid

VIEWS = np.arange(-70.0, 71, 10)
ROUND_DOME = {"p": 2.0, "q": 2.0}
ROUND = Directions.of(np.repeat([20.0, 60.0], 6), [15, 15, 40, 40, 65, 65] * 2, [0, 90, 30, 180, 60, 150] * 2)
"""In the plane and out of it, on both sides."""

light, view, turn = st.floats(0, 80), st.floats(0, 80), st.floats(-180, 180)


def usual(rung: Rung) -> dict[str, float]:
    return {number.name: number.usual for number in rung.shape}


def f_r(model: str, at: Directions, shape: Mapping[str, float], term: int) -> np.ndarray:
    """One term in 1/sr, for coefficient 1."""
    return np.asarray(RUNGS[model].design(at, shape, Traces())[:, term] / (math.pi * at.cos_i))


def towards(theta: float, phi: float) -> np.ndarray:
    t, p = math.radians(theta), math.radians(phi)
    return np.array([math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)])


def over_the_hemisphere(model: str, theta_i: float, shape: Mapping[str, float], traces: Traces) -> np.ndarray:
    """Reflectance of each term at an incidence, for coefficient 1: means over phi, Gauss and Legendre over sin^2(theta_r)."""
    z, w = np.polynomial.legendre.leggauss(24)
    theta_r, phi = (a.ravel() for a in np.meshgrid(np.degrees(np.arcsin(np.sqrt((z + 1) / 2))), np.arange(7.5, 180, 15), indexing="ij"))
    at = Directions.of(theta_i, theta_r, phi)
    terms = RUNGS[model].design(at, shape, traces) / at.cos_i[:, None]
    return np.asarray(w / 2 @ terms.reshape(24, 12, -1).mean(1))


# Directions


@given(theta_i=light, theta_r=st.floats(-80, 80), phi=turn)
def test_mirrored_is_the_cosine_to_the_mirror_direction(theta_i: float, theta_r: float, phi: float) -> None:
    wi, wo = towards(theta_i, 0), towards(theta_r, phi)
    mirror = np.array([-wi[0], -wi[1], wi[2]])
    assert Directions.of(theta_i, theta_r, phi).mirrored[0] == pytest.approx(mirror @ wo, abs=1e-12)


def test_directions_broadcast_and_are_checked() -> None:
    at = Directions.of([[10.0], [20.0]], VIEWS[:3])
    np.testing.assert_array_equal(at.theta_i, [10, 10, 10, 20, 20, 20])
    np.testing.assert_array_equal(at.theta_r, [-70, -60, -50] * 2)
    for bad, match in (
        ((90, 0), "theta_i = 90 deg"),
        ((-1, 0), "theta_i = -1"),
        ((45, 90), "theta_r = 90"),
        ((45, 0, math.inf), "phi = inf"),
    ):
        with pytest.raises(DomainError, match=match):
            Directions.of(*bad)


def test_the_ladder_is_in_order_and_a_wrong_name_is_told() -> None:
    assert tuple(RUNGS) == ("lambert", "phong", "ggx", "paper", "radiometric", "interreflecting", "body")
    assert rung_of("ggx") is RUNGS["ggx"]
    with pytest.raises(DomainError, match="no model 'oren': expected one of lambert, phong"):
        rung_of("oren")
    for name, rung in RUNGS.items():
        assert rung.name == name
        known = {number.name for number in rung.shape}
        assert set(rung.searched) <= known
        for number in rung.shape:
            assert 0 < number.low <= number.usual <= number.high <= number.most


# Lambert, Phong, GGX


@pytest.mark.parametrize("theta_i", [0.0, 30.0, 70.0])
def test_lambert_sends_all_light_back(theta_i: float, traces: Traces) -> None:
    np.testing.assert_allclose(over_the_hemisphere("lambert", theta_i, {}, traces), 1, rtol=1e-12)


@pytest.mark.parametrize("n", [1.0, 7.5, 40.0, 200.0])
def test_phongs_lobe_sends_all_light_back_along_the_normal_and_less_elsewhere(n: float, traces: Traces) -> None:
    assert unit_reflectances(RUNGS["phong"], {"n": n}, traces)[1] == pytest.approx(1, abs=1e-4)
    slanted = over_the_hemisphere("phong", 60.0, {"n": n}, traces)[1]
    assert 0.2 < slanted < 1


@given(theta_i=light, theta_r=view, phi=turn, n=st.floats(1, 100))
def test_phong_is_its_formula_and_reciprocal(theta_i: float, theta_r: float, phi: float, n: float) -> None:
    wi, wo = towards(theta_i, 0), towards(theta_r, phi)
    expected = (n + 2) / (2 * math.pi) * max(0.0, 2 * wi[2] * wo[2] - float(wi @ wo)) ** n
    assert f_r("phong", Directions.of(theta_i, theta_r, phi), {"n": n}, 1)[0] == pytest.approx(expected, rel=1e-8, abs=1e-12)
    assert f_r("phong", Directions.of(theta_r, theta_i, phi), {"n": n}, 1)[0] == pytest.approx(expected, rel=1e-8, abs=1e-12)


def test_phongs_lobe_peaks_in_the_mirror_direction() -> None:
    at = Directions.of(35.0, np.arange(-89.0, 90))
    assert at.theta_r[f_r("phong", at, {"n": 20.0}, 1).argmax()] == -35


@given(theta_i=light, theta_r=view, phi=turn, alpha=st.floats(0.05, 1))
def test_ggx_is_its_formula_by_vectors_and_reciprocal(theta_i: float, theta_r: float, phi: float, alpha: float) -> None:
    """Half vector, slopes, Smith's shadowing by Lambda (Heitz 2014, separable) and Fresnel by Snell's angles: none as in the package."""
    wi, wo = towards(theta_i, 0), towards(theta_r, phi)
    half = (wi + wo) / np.linalg.norm(wi + wo)
    tan2 = (half[0] ** 2 + half[1] ** 2) / half[2] ** 2
    slopes = math.exp(-2 * math.log(alpha) - 2 * math.log1p(tan2 / alpha**2)) / (math.pi * half[2] ** 4)

    def unshadowed(w: np.ndarray) -> float:
        tangent = math.hypot(w[0], w[1]) / w[2]
        return 1 / (1 + (math.sqrt(1 + (alpha * tangent) ** 2) - 1) / 2)

    outside = math.acos(min(1.0, float(wi @ half)))
    inside = math.asin(math.sin(outside) / REFRACTION)
    s = (math.cos(outside) - REFRACTION * math.cos(inside)) / (math.cos(outside) + REFRACTION * math.cos(inside))
    p = (math.cos(inside) - REFRACTION * math.cos(outside)) / (math.cos(inside) + REFRACTION * math.cos(outside))
    expected = slopes * unshadowed(wi) * unshadowed(wo) * (s * s + p * p) / 2 / (4 * wi[2] * wo[2])
    assert f_r("ggx", Directions.of(theta_i, theta_r, phi), {"alpha": alpha}, 1)[0] == pytest.approx(expected, rel=1e-6)
    assert f_r("ggx", Directions.of(theta_r, theta_i, -phi), {"alpha": alpha}, 1)[0] == pytest.approx(expected, rel=1e-6)


def test_ggx_against_mitsuba() -> None:
    """Its rough dielectric: the same microfacets by others' code."""
    pytest.importorskip("mitsuba", reason="Mitsuba 3 is an optional extra")
    from tests.fitting.mitsuba_patch import mitsuba

    mi = mitsuba()
    for alpha in (0.1, 0.3, 0.8):
        plate = mi.load_dict({"type": "roughdielectric", "distribution": "ggx", "alpha": alpha, "int_ior": REFRACTION, "ext_ior": 1.0})
        at = mi.SurfaceInteraction3f()
        for theta_i, theta_r, phi in ((45.0, 45.0, 180.0), (45.0, 30.0, 90.0), (20.0, 60.0, 170.0), (70.0, 80.0, 150.0), (5.0, 5.0, 0.0)):
            at.wi = mi.Vector3f(*towards(theta_i, 0).tolist())
            value = plate.eval(mi.BSDFContext(), at, mi.Vector3f(*towards(theta_r, phi).tolist()))
            theirs = float(np.ravel(np.array(value))[0]) / math.cos(math.radians(theta_r))
            assert f_r("ggx", Directions.of(theta_i, theta_r, phi), {"alpha": alpha}, 1)[0] == pytest.approx(theirs, rel=1e-4)


@pytest.mark.parametrize("theta_i", [0.0, 30.0, 55.0])
def test_smooth_ggx_reflects_as_a_flat_boundary_does(theta_i: float, traces: Traces) -> None:
    """The lobe is integrated over a fine patch about the mirror direction."""
    alpha, steps = 0.01, np.linspace(-15, 15, 301)
    theta_r, phi = (
        a.ravel() for a in np.meshgrid(theta_i + steps, np.arange(0.25, 180, 0.5) if theta_i < 16 else 180 - np.arange(0.1, 60, 0.2))
    )
    kept = theta_r >= 0
    at = Directions.of(theta_i, theta_r[kept], phi[kept])
    width = math.radians(steps[1] - steps[0]) * math.radians(0.5 if theta_i < 16 else 0.2) * 2  # both sides of the plane
    solid = width * np.sin(np.radians(at.theta_r)) * at.cos_r
    reflected = float(f_r("ggx", at, {"alpha": alpha}, 1) @ solid)
    assert reflected == pytest.approx(float(fresnel(np.array([math.cos(math.radians(theta_i))]), REFRACTION)[0]), rel=0.02)


def test_the_roughest_ggx_has_slopes_of_every_kind_alike() -> None:
    """At alpha 1 the facets' normals are spread evenly: what is left is Fresnel's and shadowing's."""
    at = Directions.of(40.0, [10, 20, 50], 90)
    shadow = 4 / ((1 + at.cos_i) * (1 + at.cos_r)) / 4  # 2 c / (c + 1) for each, over 4 c c
    between = np.arccos(at.cos_i * at.cos_r) / 2
    expected = shadow * fresnel(np.cos(between), REFRACTION) / math.pi
    np.testing.assert_allclose(f_r("ggx", at, {"alpha": 1.0}, 1), expected, rtol=1e-9)


@given(theta=st.floats(0, 89.9), n=st.floats(1.01, 3))
def test_fresnel_by_snells_law(theta: float, n: float) -> None:
    outside = math.radians(theta)
    inside = math.asin(math.sin(outside) / n)
    s = (math.cos(outside) - n * math.cos(inside)) / (math.cos(outside) + n * math.cos(inside))
    p = (math.cos(inside) - n * math.cos(outside)) / (math.cos(inside) + n * math.cos(outside))
    assert fresnel(np.array([math.cos(outside)]), n)[0] == pytest.approx((s * s + p * p) / 2, rel=1e-6)


# The four terms


@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_the_papers_rung_is_eq_7_in_the_plane_and_out_of_it(aspect: float, traces: Traces) -> None:
    """One reading out of the plane takes all to the other quadrature: nothing may jump, by 0.5 % of a term's peak."""
    shape = {"aspect": aspect, **ROUND_DOME, "n_us": 40.0, "n_ss": 5.0}
    inside = Directions.of(45.0, VIEWS)
    both = Directions.of(45.0, np.append(VIEWS, 30.0), np.append(np.zeros(15), 60.0))
    exact = RUNGS["paper"].design(inside, shape, traces)
    np.testing.assert_allclose(exact, paper_terms(45.0, VIEWS, aspect=aspect), rtol=1e-9)
    jump = np.abs(RUNGS["paper"].design(both, shape, traces)[:15] - exact) / exact.max(0)
    assert np.all(jump < 0.005), jump.max(0)


@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_radiometric_is_what_the_tables_hold(aspect: float, traces: Traces) -> None:
    """In 1/sr times pi cos(theta_i), as a model for pictures has it at its nodes; fewer facets here, so 1 % of a term's peak."""
    model = build("radiometric", Cell(aspect), n_us=12.0, grid=Grid(12, 12))
    shape = {"aspect": aspect, **ROUND_DOME, "n_us": 12.0, "n_ss": 5.0}
    at = Directions.of(*np.broadcast_arrays([[15.0], [60.0]], [15.0, 45, 60, 30], [0.0, 90, 120, 180]))
    ours = RUNGS["radiometric"].design(at, shape, traces) / (math.pi * at.cos_i[:, None])
    i, r, p = (np.searchsorted(nodes, column) for nodes, column in zip(model.table.nodes, at, strict=True))
    theirs = np.column_stack([model.table.values[model.table.names.index(name)][i, r, p] for name in TERMS])
    np.testing.assert_allclose(ours, theirs, atol=0.01 * theirs.max(0).max(), rtol=0.01)
    np.testing.assert_allclose(ours[:, 2], 1 / math.pi, rtol=1e-12)


@given(theta_i=st.floats(0, 70), theta_r=st.floats(0, 70), phi=turn)
def test_the_spongy_terms_are_reciprocal_out_of_the_plane(theta_i: float, theta_r: float, phi: float) -> None:
    rung = RUNGS["radiometric"]
    one, other = Directions.of(theta_i, theta_r, phi), Directions.of(theta_r, theta_i, phi)
    first = rung._spongy(one, 5.0) / one.cos_i[:, None]  # type: ignore[attr-defined]
    np.testing.assert_allclose(first, rung._spongy(other, 5.0) / other.cos_i[:, None], rtol=1e-9)  # type: ignore[attr-defined]


def test_the_domes_are_reciprocal(traces: Traces) -> None:
    shape = {"aspect": 1.2, **ROUND_DOME, "n_us": 40.0, "n_ss": 5.0}
    swapped = Directions(ROUND.theta_r, ROUND.theta_i, ROUND.phi)
    one = RUNGS["radiometric"].design(ROUND, shape, traces) / ROUND.cos_i[:, None]
    other = RUNGS["radiometric"].design(swapped, shape, traces) / swapped.cos_i[:, None]
    np.testing.assert_allclose(one, other, rtol=1e-9)


BETWEEN = np.array([12.5, 57.5]), np.array([20.0, 42.5]), np.array([0.0, 45, 180])
"""Theta_i, theta_r and phi between the nodes."""


@pytest.fixture(scope="module")
def finer() -> EscapeOrders:
    return escape_orders(Cell(0.5), *BETWEEN)


@pytest.mark.slow
@pytest.mark.parametrize("albedo", [0.3, 0.95])
def test_interreflecting_is_the_sum_of_all_orders_between_the_nodes_too(albedo: float, finer: EscapeOrders, traces: Traces) -> None:
    """With u_diff = albedo it is what facets of that albedo reflect. The reference has four times the rays, and nodes of its own."""
    exact = finer.reflectance(albedo)
    at = Directions.of(*(a.ravel() for a in np.meshgrid(*BETWEEN, indexing="ij")))
    rung = RUNGS["interreflecting"]
    ours = albedo * rung.design(at, usual(rung) | {"albedo": albedo}, traces)[:, 0] / (math.pi * at.cos_i)
    np.testing.assert_allclose(ours, exact.ravel(), rtol=0.01)
    single = albedo * RUNGS["radiometric"].design(at, usual(RUNGS["radiometric"]), traces)[:, 0] / (math.pi * at.cos_i)
    assert np.all(ours > single * (1 + 0.05 * albedo))


@pytest.mark.slow
@pytest.mark.parametrize("theta_i", [0.0, 40.0, 70.0])
def test_a_white_furnace_is_white(theta_i: float, traces: Traces) -> None:
    """All light comes back where the domes' surface takes none; half of it does not at albedo 0.5."""
    rung = RUNGS["interreflecting"]
    assert over_the_hemisphere("interreflecting", theta_i, usual(rung) | {"albedo": 1.0}, traces)[0] == pytest.approx(1, abs=0.003)
    grey = 0.5 * over_the_hemisphere("interreflecting", theta_i, usual(rung) | {"albedo": 0.5}, traces)[0]
    assert 0.3 < grey < 0.5


def test_interreflection_that_is_next_to_nothing_leaves_the_radiometric_rung(traces: Traces) -> None:
    rung, single = RUNGS["interreflecting"], RUNGS["radiometric"]
    ours = rung.design(ROUND, usual(rung) | {"albedo": 1e-6}, traces)
    np.testing.assert_allclose(ours, single.design(ROUND, usual(single), traces), rtol=1e-5, atol=1e-6)


def test_low_light_keeps_the_last_node_of_the_orders(traces: Traces) -> None:
    """Beyond the table's last theta nothing is extrapolated."""
    rung = RUNGS["interreflecting"]
    edge = ORDERS_GRID[0][-1]
    single = usual(RUNGS["radiometric"])

    def later(theta_r: float) -> float:
        at = Directions.of(30.0, theta_r)
        return float((rung.design(at, usual(rung), traces) - RUNGS["radiometric"].design(at, single, traces))[0, 0])

    assert later(89.5) == pytest.approx(later(edge), rel=1e-9)


@pytest.mark.slow
def test_body_light_is_the_models_without_strays(traces: Traces) -> None:
    """What a table for pictures is made of, with rays of its own: 2 % of each part's peak."""
    rung = RUNGS["body"]
    mu, R_m, T_m = 0.3, 0.6, 0.3
    model = build("body", Cell(0.5), grid=Grid(6, 6))
    table, weights = model.parts(mu=mu, R_m=R_m, T_m=T_m)
    assert set(weights.values()) == {1.0}
    at = Directions.of(*np.broadcast_arrays([[15.0], [60.0]], [15.0, 45, 60, 30], [0.0, 90, 120, 180]))
    ours = rung.design(at, {"aspect": 0.5, **ROUND_DOME, "mu": mu, "R_m": R_m}, traces) / (math.pi * at.cos_i[:, None])
    i, r, p = (np.searchsorted(nodes, column) for nodes, column in zip(table.nodes, at, strict=True))
    for column, name in zip(ours.T, ("mirror", "body"), strict=True):
        theirs = table.values[table.names.index(name)][i, r, p]
        np.testing.assert_allclose(column, theirs, atol=0.02 * theirs.max(), err_msg=name)


def test_more_pigment_leaves_less_body_light_and_the_mirror_alone(traces: Traces) -> None:
    rung = RUNGS["body"]
    faint, strong = (rung.design(ROUND, {"aspect": 0.5, **ROUND_DOME, "mu": mu, "R_m": 0.6}, traces) for mu in (0.01, 1.0))
    np.testing.assert_array_equal(faint[:, 0], strong[:, 0])
    assert np.all(strong[:, 1] < 0.1 * faint[:, 1])
    rich, poor = (rung.design(ROUND, {"aspect": 0.5, **ROUND_DOME, "mu": 0.01, "R_m": R_m}, traces) for R_m in (0.9, 0.3))
    assert np.all(poor[:, 1] < 0.5 * rich[:, 1])


# Reflectances


def test_unit_reflectances(traces: Traces) -> None:
    n_ss = 7.0
    paper = unit_reflectances(RUNGS["paper"], {"aspect": 0.5, **ROUND_DOME, "n_us": 40.0, "n_ss": n_ss}, traces)
    np.testing.assert_allclose(paper[2:], [1, 2 / (n_ss + 2)], rtol=1e-9)
    per_sr = unit_reflectances(RUNGS["radiometric"], {"aspect": 0.5, **ROUND_DOME, "n_us": 40.0, "n_ss": n_ss}, traces)
    np.testing.assert_allclose(per_sr[2:], [1, 1], rtol=1e-9)
    assert 0 < per_sr[0] < 1  # what one bounce of white domes sends back
    smooth = unit_reflectances(RUNGS["ggx"], {"alpha": 0.05}, traces)
    assert smooth[1] == pytest.approx(((REFRACTION - 1) / (REFRACTION + 1)) ** 2, rel=0.01)


# Quick designs

PLACES = Directions.of(
    np.append(np.repeat([15.0, 60.0], 9), [30.0, 30, 45, 60]),
    np.append(np.tile(np.arange(-60.0, 61, 15), 2), [30.0, 60, 45, 70]),
    np.append(np.zeros(18), [60.0, 90, 120, 180]),
)
PLANE = Directions.of(np.repeat([15.0, 60.0], 9), np.tile(np.arange(-60.0, 61, 15), 2))


def off(model: str, at: Directions, shapes: list[dict[str, float]], traces: Traces, **ends: tuple[float, float]) -> np.ndarray:
    """Rms error of each term of the quick design, as a fraction of its peak, for each of some shapes; bounds as usual unless given."""
    rung = RUNGS[model]
    bounds = {name: ends for name, ends in usual_bounds(rung).items() if name in shapes[0]} | ends
    held = {name: value for name, value in usual(rung).items() if name not in bounds}
    quick = rung.quick_design(at, held, bounds, traces)  # type: ignore[arg-type]
    out = []
    for shape in shapes:
        exact = rung.design(at, held | shape, traces)
        out.append(np.sqrt(np.mean((quick(shape) - exact) ** 2, axis=0)) / exact.max(axis=0))
    return np.array(out)


def test_the_papers_quick_design(traces: Traces) -> None:
    """Rms, of a term's peak: 0.1 % diffuse and 0.8 % of the lobe, over the whole range, out to its ends."""
    random = np.random.default_rng(5)
    shapes = [
        {"aspect": float(a), "n_us": float(n)}
        for a, n in zip(*(np.exp(random.uniform(*np.log(e), 30)) for e in ((0.1, 4), (2, 200))), strict=True)
    ]
    error = off("paper", PLANE, shapes, traces)
    assert error[:, 0].max() < 0.001
    assert error[:, 1].max() < 0.008
    assert np.all(error[:, 2:] == 0)


@pytest.mark.slow
def test_the_radiometric_quick_design(traces: Traces) -> None:
    """With fewer facets too: 0.1 % diffuse and 0.6 % of the lobe, rms, of the peak."""
    shapes = [{"aspect": a, "n_us": n} for a in (0.55, 1.3) for n in (6.0, 27.0, 35.0)]
    error = off("radiometric", PLACES, shapes, traces)
    assert error[:, 0].max() < 0.0015
    assert error[:, 1].max() < 0.007
    assert np.all(error[:, 2:] == 0)


@pytest.mark.slow
def test_the_interreflecting_quick_design(traces: Traces) -> None:
    """Whatever the albedo, to 1: orders are interpolated over the aspect, and summed exactly.

    Nodes of the aspect are as far apart as they may be, and the first is the hemisphere that is traced anyway.
    """
    step = 0.999 * RATIO["aspect"]
    shapes = [{"aspect": 0.62, "n_us": 30.0, "albedo": albedo} for albedo in (0.1, 0.5, 0.95, 0.99, 1.0)]
    error = off("interreflecting", PLACES, shapes, traces, aspect=(0.5, 0.5 * step**3))
    assert error[:, 0].max() < 0.0015
    assert error[:, 1].max() < 0.003


@pytest.mark.slow
def test_the_quick_design_of_body_light(traces: Traces) -> None:
    """Rms, of the peak: 1 % where at least a twentieth of the light survives the pigment, 2 % where a thousandth does."""
    shapes = [{"aspect": 0.62, "mu": mu} for mu in (0.004, 0.13, 0.5, 0.8, 2.0, 2.8)]
    error = off("body", PLACES, shapes, traces)
    assert error[:, 0].max() < 0.005
    assert error[:4, 1].max() < 0.0125
    assert error[4:, 1].max() < 0.02


def test_a_quick_design_with_nothing_to_find_is_the_design(traces: Traces) -> None:
    for name in ("lambert", "phong", "ggx", "paper"):
        rung = RUNGS[name]
        quick = rung.quick_design(PLANE, usual(rung), {}, traces)
        np.testing.assert_allclose(quick({}), rung.design(PLANE, usual(rung), traces), rtol=1e-12)


def test_fewer_facets_are_what_the_search_uses(traces: Traces) -> None:
    """The price of the radiometric quick design at a node itself: half of the facets, the lobe's 0.4 % of its peak."""
    n_us = 40.0
    few = radiometric_terms(*PLACES, cell=Cell(0.5), n_us=n_us, sampling=Sampling(1200, 32))
    many = radiometric_terms(*PLACES, cell=Cell(0.5), n_us=n_us)
    error = np.abs(few - many).max(0) / many.max(0)
    assert np.all(error[:2] < 0.01)


@pytest.mark.slow
def test_traces_are_kept_in_a_folder_and_made_anew_where_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fitting import body

    flat = Cell(0.15)
    made = Traces(tmp_path / "traces").body(flat)
    made.body_reflectance(30, 20, mu=0.1, R_m=0.5, T_m=0.3)
    (path,) = (tmp_path / "traces").iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(body, "trace_body", lambda *_, **__: pytest.fail("traced again"))
        kept = Traces(tmp_path / "traces").body(flat)
    assert kept.body_reflectance(30, 20, mu=0.1, R_m=0.5, T_m=0.3) == made.body_reflectance(30, 20, mu=0.1, R_m=0.5, T_m=0.3)
    path.write_bytes(path.read_bytes()[:-100])
    again = Traces(tmp_path / "traces").body(flat)
    assert again.body_reflectance(30, 20, mu=0.1, R_m=0.5, T_m=0.3) == made.body_reflectance(30, 20, mu=0.1, R_m=0.5, T_m=0.3)
