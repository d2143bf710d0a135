"""Each mode of the model against an explicit mesh of many domes, traced by Mitsuba 3.

Agreement is within `mitsuba_patch.SURE` (4) standard errors of Mitsuba's estimate plus an allowance, stated with each test, for what is not
noise: flat triangles instead of domes on Mitsuba's side, the stated error of the quadrature or of the traced rays on the model's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fitting.body import BodyTrace, Epidermis, trace_body
from fitting.cells import Cell
from fitting.orders import escape_orders
from fitting.paper import LOBE_FLOOR, paper_terms
from fitting.radiometric import paper_terms_any, radiometric_terms

pytest.importorskip("mitsuba", reason="Mitsuba 3 is an optional extra")

from tests.fitting.mitsuba_patch import SURE, Dielectric, Direction, Estimate, Opaque, Patch, vectorised

pytestmark = pytest.mark.slow

HEMISPHERE, ROSE, PAPILLA = Cell(0.5), Cell(1.9), Cell(1.2, p=1.5, q=1.6, gap=0.15)
CELLS = {"hemisphere": HEMISPHERE, "rose": ROSE, "papilla": PAPILLA}
IN_PLANE: tuple[Direction, ...] = ((45, 20, 0), (45, -30, 0))
OUT_OF_PLANE: tuple[Direction, ...] = ((30, 60, 75), (65, 40, 140))
N, DEPTH = 1.4, 1.0
INCIDENCES = (0, 50, 70)


@pytest.fixture(scope="module", params=CELLS.values(), ids=list(CELLS))
def patch(request: pytest.FixtureRequest) -> tuple[Cell, Patch]:
    return request.param, Patch(request.param)


@pytest.fixture(scope="module")
def opaque(patch: tuple[Cell, Patch]) -> tuple[Cell, Opaque]:
    cell, domes = patch
    return cell, Opaque(domes)


def points() -> int:
    """Of each azimuth; ray by ray it is slow."""
    return 4000 if vectorised() else 2000


def test_paper_mode(opaque: tuple[Cell, Opaque]) -> None:
    """Allowance: 1 % for triangles and for the quadrature, and what the model cuts off its lobe at most, LOBE_FLOOR over the domes."""
    cell, domes = opaque
    tile = domes.patch.tile
    cut = np.array([0.0, LOBE_FLOOR * tile.areas[: tile.dome].sum() / tile.cell_area])
    for direction in (*IN_PLANE, *OUT_OF_PLANE):
        found = domes.terms(direction, 40.0, foreshortened=False, points=points())
        assert np.all(found.error < 0.01 * found.mean), found
        found.check(paper_terms_any(*direction, cell=cell)[0, :2], 0.01, f"{cell} {direction}", cut)
        if cell.is_ellipsoid and direction in IN_PLANE:
            found.check(paper_terms(*direction[:2], aspect=cell.aspect)[0, :2], 0.01, f"{cell} {direction}, in plane", cut)


def test_radiometric_mode_rendered_and_summed(opaque: tuple[Cell, Opaque]) -> None:
    """Diffuse light in a true render and in a sum over points, the lobe in the sum; allowance 1 % as above."""
    cell, domes = opaque
    for direction in (IN_PLANE[1], *OUT_OF_PLANE):
        model = radiometric_terms(*direction, cell=cell)[0, :2]
        rendered = domes.reflectance(direction, rays=4096)
        assert rendered.error < 0.01 * rendered.mean, rendered
        rendered.check(model[0], 0.01, f"{cell} {direction}, rendered")
        summed = domes.terms(direction, 40.0, foreshortened=True, points=points())
        summed.check(model, 0.01, f"{cell} {direction}, summed")


@pytest.mark.parametrize("patch", [ROSE, PAPILLA], ids=["rose", "papilla"], indirect=True)
def test_interreflection_order_by_order_and_all_together(opaque: tuple[Cell, Opaque]) -> None:
    """Allowance: 3 % of an order, whose facets in the model are coarse (14 rings); 2 % of all orders together at albedo 0.8."""
    cell, domes = opaque
    traced = escape_orders(cell, [45, 60], [20, 50], [75, 180], rays=1024)
    for direction, nodes in (((45.0, 20.0, 75.0), (0, 0, 0)), ((60.0, 50.0, 180.0), (1, 1, 1))):
        found = domes.orders(direction, 3, strata=16, rays=8192)
        # Ray by ray the differences of orders are noisier.
        assert np.all(found.error < (0.02 if vectorised() else 0.04) * found.mean), found
        found.check(traced.bases[:3][(slice(None), *nodes)], 0.03, f"{cell} {direction}, orders 1 to 3")
        every = domes.reflectance(direction, bounces=-1, albedo=0.8, strata=16, rays=4096)
        every.check(traced.reflectance(0.8)[nodes], 0.02, f"{cell} {direction}, albedo 0.8")


@pytest.fixture(scope="module")
def petal() -> BodyTrace:
    """Rose cells above, papillae below."""
    return trace_body(Epidermis(ROSE, DEPTH), Epidermis(PAPILLA, DEPTH), n=N, rays=1024)


@pytest.fixture(scope="module")
def faces() -> dict[str, Dielectric]:
    return {name: Dielectric(Patch(CELLS[name]), DEPTH, N) for name in ("rose", "papilla")}


@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_body_light_through_each_face(petal: BodyTrace, faces: dict[str, Dielectric], mu: float) -> None:
    """Light that arrives at the base, that never does, and what of the base's own light comes back or leaves.

    Allowance: 1 % of each, and 0.001 of the light: the model's nodes stand for a degree around them, and its rays have their noise.
    """
    for face, traced in ((petal.upper, faces["rose"]), (petal.lower, faces["papilla"])):
        traced.absorbing(mu)
        for theta in INCIDENCES:
            k = theta  # the nodes are whole degrees here
            model = np.array([face.down(mu)[k].sum(), face.astray(mu)[k] + face.single[k] + face.floor[k]])
            found = traced.from_air(theta, strata=6)
            if mu == 0:
                np.testing.assert_allclose(found.mean.sum(), 1, atol=0.001)
            found.check(model, 0.01, f"{face.epidermis}, mu = {mu}, theta_i = {theta}", absolute=0.001)
        model = np.array([face.back(mu).sum(1).mean(), face.escape(mu).mean()])
        traced.from_base(repeats=4).check(model, 0.01, f"{face.epidermis}, mu = {mu}, from below", absolute=0.001)


def test_both_faces_and_the_mesophyll_together(petal: BodyTrace, faces: dict[str, Dielectric]) -> None:
    """Reflected and scattered light of the whole petal, from Mitsuba's shares of its faces; allowance 1.5 %."""
    mu, r, t = 0.2, 0.5, 0.35
    upper, lower = (faces[name].absorbing(mu) for name in ("rose", "papilla"))
    (back, out), (back_below, out_below) = upper.from_base(repeats=4).mean, lower.from_base(repeats=4).mean
    for theta in INCIDENCES:
        arriving, reflected = upper.from_air(theta, strata=6)
        # x and y arrive at the mesophyll from above and from below, and are thrown back to it by the faces.
        x, y = np.linalg.solve([[1 - back * r, -back * t], [-back_below * t, 1 - back_below * r]], [arriving[0], 0.0])
        model = petal.budget(theta, mu=mu, R_m=r, T_m=t)
        found = Estimate(
            np.array([arriving[1] + out * (r * x + t * y), out_below * (t * x + r * y)]),
            np.array([reflected[1] + reflected[0], reflected[0]]),
        )
        parts = [sum(model[part] for part in ("mirror", "floor", "stray", "body")), model["scattered"]]
        found.check(np.array(parts), 0.015, f"theta_i = {theta}")
        assert parts[0] == pytest.approx(petal.albedo(theta, mu=mu, R_m=r, T_m=t), rel=1e-9)


def test_straight_through_a_petal_in_one_piece() -> None:
    """A pigmented body, domes above and flat below, nothing that scatters: what comes out behind.

    Allowance: 2 % for the streams' width. Rose cells and papillae have their turn above.
    """
    body = trace_body(Epidermis(HEMISPHERE, DEPTH), n=N)
    whole = Dielectric(Patch(HEMISPHERE), 2 * DEPTH, N, "air").absorbing(0.3)
    for theta in INCIDENCES:
        model = body.budget(theta, mu=0.3, R_m=0.0, T_m=0.0, D_m=1.0)["direct"]
        found = whole.from_air(theta, strata=6)
        Estimate(found.mean[0], found.error[0]).check(model, 0.02, f"theta_i = {theta}")


def test_a_tile_is_its_dome_and_its_floor() -> None:
    """The mesh itself: closed, of the right height, area and volume; 0.5 % for its triangles."""
    for cell in CELLS.values():
        tile: Any = Patch(cell, reach=10.0).tile
        flat = tile.areas * tile.flat_normals[:, 2]
        assert flat.min() >= -1e-9
        assert flat.sum() == pytest.approx(tile.cell_area, rel=1e-9)
        assert flat[: tile.dome].sum() == pytest.approx(np.pi, rel=0.005)
        volume = (flat * tile.vertices[tile.triangles][:, :, 2].mean(1)).sum()
        r = np.linspace(0, 1, 100_001)
        assert volume == pytest.approx(np.trapezoid(2 * np.pi * r * cell.profile(r), r), rel=0.01)
        np.testing.assert_allclose(np.hypot(*tile.vertices[tile.triangles].reshape(-1, 3).T[:2]).max(), tile.pitch / np.sqrt(3))


def test_estimates_are_refused_beyond_their_error() -> None:
    Estimate(np.array([1.0]), np.array([0.01])).check(1 + 0.9 * SURE * 0.01, 0.0, "near")
    with pytest.raises(AssertionError, match="far"):
        Estimate(np.array([1.0]), np.array([0.01])).check(1 + 1.1 * SURE * 0.01, 0.0, "far")
