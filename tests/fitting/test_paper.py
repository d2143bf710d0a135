"""The four distributions against closed forms, symmetries and known values."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from fitting import CELL_AREA, Cell, DomainError, Quadrature, paper_terms

VIEWS = np.arange(-70, 71, 10)
COARSE = Quadrature(377)
incidences = st.floats(0, 85)
views = st.floats(-85, 85)
aspects = st.floats(0.2, 2.5)


@pytest.mark.parametrize(("aspect", "expected"), [(0.5, [0.254, 0.493, 0.693, 0.693, 0.487]), (1.9, [0.063, 0.182, 0.707, 0.707, 0.368])])
def test_diffuse_values_of_the_trials(aspect: float, expected: list[float]) -> None:
    found = paper_terms(45, [-70, -40, 0, 40, 70], aspect=aspect)[:, 0]
    np.testing.assert_allclose(found, expected, atol=6e-4)  # three printed digits


@pytest.mark.parametrize("aspect", [0.5, 1.9])
def test_within_half_a_percent_of_the_converged_values(aspect: float) -> None:
    """Two tenths, in fact, with the default quadrature."""
    converged = paper_terms(45, VIEWS, aspect=aspect, quadrature=Quadrature(121393, 40))
    counts = converged > 1e-3 * converged.max(axis=0)
    assert counts[:, :2].all()  # the domes send something everywhere
    for rule, tolerance in ((Quadrature(), 2e-3), (COARSE, 5e-3)):
        found = paper_terms(45, VIEWS, aspect=aspect, quadrature=rule)
        np.testing.assert_allclose(found[counts], converged[counts], rtol=tolerance)


@given(theta_i=st.floats(0, 70), theta_r=st.floats(-70, 70), aspect=aspects)
def test_the_lobe_needs_fewer_slices(theta_i: float, theta_r: float, aspect: float) -> None:
    """By default it takes fewer than the diffuse term's kinks, while light and view stay off the petal: they change nothing."""
    usual, fine = (paper_terms(theta_i, theta_r, aspect=aspect, quadrature=rule)[0, 1] for rule in (Quadrature(), Quadrature(4181, 24)))
    assert usual == pytest.approx(fine, rel=1e-3, abs=1e-6)


def test_halves_in_two_threads_are_the_whole() -> None:
    """Whatever the threads do, a call repeats to the last bit, also from many callers at once."""
    from concurrent.futures import ThreadPoolExecutor

    once = paper_terms(45, VIEWS, aspect=1.9)
    with ThreadPoolExecutor(4) as pool:
        for again in pool.map(lambda _: paper_terms(45, VIEWS, aspect=1.9), range(24)):
            np.testing.assert_array_equal(again, once)


@given(theta_i=incidences, theta_r=views)
def test_flat_domes_act_as_discs(theta_i: float, theta_r: float) -> None:
    found = paper_terms(theta_i, theta_r, aspect=1e-5, quadrature=COARSE)[0]
    mirror = max(0.0, math.cos(math.radians(theta_i + theta_r)))
    disc = math.pi / CELL_AREA
    np.testing.assert_allclose(found, [disc * math.cos(math.radians(theta_i)), disc * mirror**40, found[2], found[3]], rtol=1e-3, atol=2e-5)


@given(theta_i=incidences, theta_r=views)
def test_spongy_boundary_is_flat(theta_i: float, theta_r: float) -> None:
    found = paper_terms(theta_i, theta_r, n_ss=7, quadrature=COARSE)[0, 2:]
    mirror = max(0.0, math.cos(math.radians(theta_i + theta_r)))
    np.testing.assert_allclose(found, [math.cos(math.radians(theta_i)), mirror**7], rtol=1e-12, atol=1e-300)


@given(theta_i=incidences, theta_r=views)
def test_lone_hemisphere_diffuse(theta_i: float, theta_r: float) -> None:
    """Slices y, lit and seen over psi: Int cos^2(eta) deta is pi / 2, and Int cos(psi - theta_i) dpsi has a closed form."""
    i, r = math.radians(theta_i), math.radians(theta_r)
    if theta_r >= theta_i:
        along = math.cos(i) + math.cos(r - i)
    elif theta_r >= 0:
        along = math.cos(i) + 1
    else:
        along = math.cos(r - i) + 1
    found = paper_terms(theta_i, theta_r, quadrature=COARSE, neighbours=False)[0, 0]
    assert found == pytest.approx(math.pi / 2 * along / CELL_AREA, rel=1e-9)


@pytest.mark.parametrize("theta", [0, 20, 45, 60])
@pytest.mark.parametrize("n", [12.0, 40.0, 200.0])
def test_lone_hemisphere_specular_towards_the_light(theta: float, n: float) -> None:
    """With V = L, R.V = 2 (N.L)^2 - 1: a figure of revolution about L, far enough from the rim to be whole."""
    integral, _ = quad(lambda c: 2 * math.pi * (2 * c * c - 1) ** n, math.cos(math.radians(29)), 1, epsabs=0, epsrel=1e-10)
    found = paper_terms(theta, theta, n_us=n, neighbours=False)[0, 1]
    # What the model cuts off is below LOBE_FLOOR of the peak; for n = 12 the cone of 29 deg leaves a little more.
    assert found == pytest.approx(integral / CELL_AREA, rel=2e-4 if n > 12 else 2e-3)


@pytest.mark.parametrize("aspect", [0.1, 0.5, 1.9, 4.0])
def test_normal_light_and_view_see_every_dome_whole(aspect: float) -> None:
    assert paper_terms(0, 0, aspect=aspect)[0, 0] == pytest.approx(math.pi / CELL_AREA, rel=1e-9)


@pytest.mark.parametrize(("aspect", "theta"), [(0.5, 70), (1.9, 45), (1.9, 60), (4.0, 30)])
def test_low_light_falls_on_domes_only(aspect: float, theta: float) -> None:
    """With no gap lit, the domes intercept the whole beam: cos(theta_i) per area of patch, all of it seen from the light."""
    assert paper_terms(theta, theta, aspect=aspect)[0, 0] == pytest.approx(math.cos(math.radians(theta)), rel=2e-4)


@given(theta_i=incidences, share=st.floats(0, 1), aspect=aspects)
def test_between_light_and_normal_all_that_is_lit_is_seen(theta_i: float, share: float, aspect: float) -> None:
    found = paper_terms(theta_i, [share * theta_i, theta_i], aspect=aspect, quadrature=COARSE)[:, 0]
    assert found[0] == pytest.approx(found[1], rel=1e-9)


@given(theta_i=incidences, theta_r=views, aspect=aspects)
def test_bounds(theta_i: float, theta_r: float, aspect: float) -> None:
    among, alone = (paper_terms(theta_i, theta_r, aspect=aspect, quadrature=COARSE, neighbours=n)[0] for n in (True, False))
    assert np.all(among >= 0)
    np.testing.assert_array_less(among, alone * (1 + 1e-4) + 1e-12)  # neighbours only ever hide
    caught = paper_terms(theta_i, theta_i, aspect=aspect, quadrature=COARSE)[0, 0]
    assert among[0] <= caught + 1e-12  # no view sees more than the light does


@given(a=incidences, b=incidences, aspect=aspects)
def test_specular_term_does_not_know_light_from_view(a: float, b: float, aspect: float) -> None:
    first, second = (paper_terms(*pair, aspect=aspect, quadrature=COARSE)[0, 1] for pair in ((a, b), (b, a)))
    assert first == pytest.approx(second, rel=1e-7, abs=1e-12)


def test_narrower_lobes_keep_less() -> None:
    values = [paper_terms(45, 30, n_us=n)[0, 1] for n in (1, 5, 40, 400)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 10 * values[-1]


def test_readings_are_independent_of_their_company() -> None:
    theta_i, theta_r = np.array([10.0, 45, 45, 70, 45]), np.array([-60.0, 20, 20, -20, 70])
    together = paper_terms(theta_i, theta_r, aspect=1.9)
    alone = np.concatenate([paper_terms(i, r, aspect=1.9) for i, r in zip(theta_i, theta_r, strict=True)])
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    assert paper_terms(45, [], aspect=1.9).shape == (0, 4)
    assert paper_terms([[10], [20]], [[1, 2, 3]]).shape == (6, 4)


def test_edge_on_view_sees_nothing_of_touching_domes() -> None:
    assert np.all(paper_terms(45, [90, -90], aspect=1.9)[:, :2] < 1e-6)


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        ((45, 90.5), {}, "theta_r = 90.5"),
        ((45, [0, -120]), {}, "behind the petal"),
        ((90, 0), {}, "0 <= theta_i < 90"),
        ((-10, 0), {}, "theta_i = -10"),
        ((math.nan, 0), {}, "theta_i = nan"),
        ((45, math.nan), {}, "theta_r = nan"),
        (([1, 2], [1, 2, 3]), {}, "matching shapes"),
        (("x", 0), {}, "must be numbers"),
        ((45, 0), {"aspect": 0}, "aspect"),
        ((45, 0), {"aspect": math.inf}, "aspect"),
        ((45, 0), {"n_us": 0}, "n_us"),
        ((45, 0), {"n_ss": math.nan}, "n_ss"),
        ((45, 40), {"aspect": 1.9, "n_us": 1e6}, "ask for more"),
    ],
)
def test_outside_the_model(arguments: tuple[Any, Any], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(DomainError, match=message):
        paper_terms(*arguments, **settings)


@pytest.mark.parametrize("slices", [1000, 144, 55, 2584])
def test_only_odd_fibonacci_numbers_of_slices(slices: int) -> None:
    with pytest.raises(DomainError, match="odd Fibonacci"):
        Quadrature(slices)


def test_lobe_needs_nodes() -> None:
    with pytest.raises(DomainError, match="at least 2"):
        Quadrature(377, 1)


def test_cell() -> None:
    assert Cell(1.9).stretch == pytest.approx(3.8)
    assert math.degrees(float(Cell(0.5).sphere_angle(math.radians(30)))) == pytest.approx(30)
    assert math.tan(float(Cell(1.9).sphere_angle(math.radians(45)))) == pytest.approx(3.8)


def test_importing_the_package_loads_nothing_slow() -> None:
    code = (
        "import sys, fitting; print(sorted({'numpy', 'numba', 'scipy'} & set(sys.modules)));"
        "fitting.paper_terms; print('numba' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "False"]


def test_unknown_names_are_attribute_errors() -> None:
    import fitting

    assert set(fitting.__all__) <= set(dir(fitting))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = fitting.nonsense
