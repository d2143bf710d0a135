"""The functional form against closed forms: Lambert, lobes, cubics between uneven nodes, symmetries, energy."""

from __future__ import annotations

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitting.errors import DomainError, EnergyError
from fitting.interpolate import bent
from fitting.reflectance import INTENSITY, PER_SR, Reflectance
from fitting.table import ReflectanceTable

THETA = np.concatenate([np.arange(0, 84.0, 4), [84, 86.5, 88.5, 90]])
PHI = np.linspace(0, 180, 25)
NODES = (THETA, THETA, PHI)
INCIDENCE, VIEW, AROUND = THETA[:, None, None], THETA[:, None], PHI

angles = st.floats(0, 90)
turns = st.floats(-720, 720)


def formed(mode: str = PER_SR, nodes: Any = NODES, **terms: Any) -> ReflectanceTable:
    """A table of terms given as arrays or numbers that broadcast."""
    shape = tuple(len(n) for n in nodes)
    return ReflectanceTable.from_basis(
        tuple(terms), [np.broadcast_to(v, shape) for v in terms.values()], nodes=nodes, mode=mode, provenance={"model": "a test"}
    )


def alone(mode: str = PER_SR, nodes: Any = NODES, **term: Any) -> Reflectance:
    return formed(mode, nodes, **term).mixed(dict.fromkeys(term, 1.0))


def flat_mirror(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    """Cosine between view and mirror direction of a flat surface, 0 or more."""
    i, r, p = (np.radians(a) for a in (theta_i, theta_r, phi))
    return np.maximum(0, np.cos(i) * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(p))


@functools.cache
def lopsided() -> Reflectance:
    """An intensity that is not the same for any two directions of a kind."""
    bright = 1 + np.cos(np.radians(INCIDENCE)) * np.sin(np.radians(VIEW)) ** 2 * (AROUND / 180) + flat_mirror(INCIDENCE, VIEW, AROUND) ** 9
    return alone(INTENSITY, lopsided=bright)


@given(theta_i=angles, theta_r=angles, phi=turns)
def test_left_and_right_are_alike_and_a_turn_is_nothing(theta_i: float, theta_r: float, phi: float) -> None:
    shade = lopsided()
    here = shade(theta_i, theta_r, phi)
    for other in (
        shade(theta_i, theta_r, -phi),
        shade(theta_i, theta_r, phi + 360),
        shade(theta_i, -theta_r, phi + 180),
    ):
        np.testing.assert_allclose(other, here, rtol=1e-5, atol=1e-6)  # of single precision
    assert here >= 0


def test_lambert_has_its_albedo_at_every_incidence_and_is_reciprocal() -> None:
    table = formed(lambert=1 / math.pi)
    lambert = table.mixed({"lambert": 0.7})
    np.testing.assert_allclose(lambert.albedo([0.0, 30, 45, 89, 90]), 0.7, rtol=1e-6)
    assert lambert.reciprocity() < 1e-6
    assert lambert.albedo(20).shape == ()


def test_as_an_intensity_lambert_holds_the_cosine_of_incidence() -> None:
    lambert = alone(INTENSITY, lambert=np.cos(np.radians(INCIDENCE)) / math.pi)
    np.testing.assert_allclose(lambert.albedo([0, 45, 80]), 1, rtol=1e-4)
    assert lambert.reciprocity() < 1e-4
    with pytest.raises(DomainError, match="below 90"):
        lambert.albedo(90)


@settings(max_examples=25)
@given(n=st.floats(1, 20))
def test_lobes_about_the_normal_send_what_their_integral_says(n: float) -> None:
    lobe = alone(INTENSITY, lobe=np.cos(np.radians(VIEW)) ** n * np.cos(np.radians(INCIDENCE)))
    np.testing.assert_allclose(lobe.albedo([0, 60]), 2 * math.pi / (n + 2), rtol=2e-3)


def test_the_paper_s_lobe_is_off_reciprocity_by_its_closed_form() -> None:
    """An intensity of 1 whatever the directions exchanges F = cos(theta_r): mean 1/2, rms of F - F' sqrt(2 (1/3 - 1/4))."""
    assert alone(INTENSITY, one=1.0).reciprocity() == pytest.approx(math.sqrt(1 / 6) / 0.5, rel=1e-4)


@pytest.mark.parametrize(("n", "tolerance"), [(5, 1e-3), (40, 1e-2)])
def test_a_narrow_lobe_between_the_nodes(n: float, tolerance: float) -> None:
    mirror = alone(INTENSITY, lobe=flat_mirror(INCIDENCE, VIEW, AROUND) ** n)
    theta_i, theta_r, phi = np.random.default_rng(1).uniform(0, [[85], [85], [180]], (3, 20000))
    exact = flat_mirror(theta_i, theta_r, phi) ** n
    off = mirror(theta_i, theta_r, phi) - exact
    assert np.sqrt(np.mean(off**2)) < tolerance * exact.mean()


@settings(max_examples=25)
@given(c=st.lists(st.floats(0, 2), min_size=12, max_size=12), theta_i=angles, theta_r=angles, phi=st.floats(0, 180))
def test_cubics_are_reproduced_between_uneven_nodes(c: list[float], theta_i: float, theta_r: float, phi: float) -> None:
    def cubic(coefficients: list[float], x: Any) -> Any:
        return sum(a * (x / 90) ** k for k, a in enumerate(coefficients))

    def product(i: Any, r: Any, p: Any) -> Any:
        return cubic(c[:4], bent(i)) * cubic(c[4:8], bent(r)) * cubic(c[8:], p / 2)

    found = alone(INTENSITY, cubic=product(INCIDENCE, VIEW, AROUND))(theta_i, theta_r, phi)
    assert float(found) == pytest.approx(product(theta_i, theta_r, phi), rel=1e-4, abs=1e-4)


@given(seed=st.integers(0, 2**32 - 1), theta_i=angles, theta_r=st.floats(-90, 90), phi=turns)
def test_whatever_the_nodes_say_no_value_is_negative(seed: int, theta_i: float, theta_r: float, phi: float) -> None:
    spikes = np.random.default_rng(seed).exponential(size=(6, 7, 5)) ** 4
    rough = alone(INTENSITY, (np.linspace(0, 90, 6), np.linspace(0, 90, 7), np.linspace(0, 180, 5)), rough=spikes)
    assert rough(theta_i, theta_r, phi) >= 0
    assert rough.pdf(theta_i, theta_r, phi) >= 0


def test_at_the_nodes_a_table_says_what_it_was_given() -> None:
    given_values = np.random.default_rng(3).uniform(0.5, 1, (len(THETA), len(THETA), len(PHI)))
    found = alone(INTENSITY, some=given_values)(INCIDENCE, VIEW, AROUND)
    np.testing.assert_allclose(found, given_values, rtol=1e-5)


def test_beyond_the_last_node_its_value_is_kept() -> None:
    nodes = (THETA[:-1], THETA[:-1], PHI)
    table = alone(PER_SR, nodes, some=(THETA[:-1, None, None] + THETA[:-1, None]) / 1000)
    assert table(89.9, 90, 10) == pytest.approx(2 * THETA[-2] / 1000, rel=1e-5)


def test_reciprocal_values_stay_reciprocal_between_the_nodes() -> None:
    lobe = alone(PER_SR, lobe=7 / (2 * math.pi) * flat_mirror(INCIDENCE, VIEW, AROUND) ** 5)
    assert lobe.reciprocity() == pytest.approx(0, abs=1e-12)  # the same bits, summed in another order
    theta_i, theta_r, phi = np.random.default_rng(6).uniform([[0], [0], [-400]], [[90], [90], [400]], (3, 50_000))
    np.testing.assert_array_equal(lobe(theta_i, theta_r, phi), lobe(theta_r, theta_i, phi))
    np.testing.assert_allclose(lobe(theta_i, -theta_r, phi), lobe(theta_r, -theta_i, phi), rtol=1e-4, atol=1e-6)


def test_values_that_are_not_reciprocal_are_left_so() -> None:
    """Also where they nearly are, and where light and view have axes of their own: as the light that comes through a petal has."""
    tilted = 0.1 + 0.001 * np.cos(np.radians(INCIDENCE))
    found = alone(PER_SR, tilted=tilted)
    assert found(60, 0, 0) == pytest.approx(0.1005, rel=1e-6)
    assert found(0, 60, 0) == pytest.approx(0.101, rel=1e-6)
    views = np.concatenate([np.arange(0, 81.0, 10), [85, 88]])
    through = alone(PER_SR, (THETA, views, PHI), through=0.1 * np.cos(np.radians(INCIDENCE)))
    assert through(60, 10, 20) == pytest.approx(0.05, rel=1e-5)
    assert through(10, 60, 20) == pytest.approx(0.1 * math.cos(math.radians(10)), rel=1e-5)
    assert through.albedo(60) == pytest.approx(0.05 * math.pi, rel=1e-5)
    assert np.isfinite(through.sample(60, 0.3, 0.4)).all()


def test_many_directions_at_once_and_one_by_one() -> None:
    shade = lopsided()
    theta_i, theta_r, phi = np.random.default_rng(2).uniform([[0], [-90], [-400]], [[90], [90], [400]], (3, 300_000))
    together = shade(theta_i, theta_r, phi)
    some = np.arange(0, 300_000, 7919)
    np.testing.assert_array_equal(together[some], [float(shade(theta_i[n], theta_r[n], phi[n])) for n in some])
    with ThreadPoolExecutor(4) as pool:  # as the bands of a picture call it
        for again in pool.map(lambda _: shade(theta_i, theta_r, phi), range(4)):
            np.testing.assert_array_equal(again, together)
    theta_r[[200_000, 299_999]] = 91, math.nan
    with pytest.raises(DomainError, match="theta_r = 91"):
        shade(theta_i, theta_r, phi)


def test_a_brdf_that_creates_light_is_refused_by_name() -> None:
    with pytest.raises(EnergyError, match=r"bright = 1 .*albedo of 1\.1"):
        formed(dark=0.2 / math.pi, bright=1.1 / math.pi).alone("bright")
    table = formed(a=0.8 / math.pi, b=0.8 / math.pi)
    with pytest.raises(EnergyError, match=r"a = 1, b = 0\.5"):
        table.mixed({"a": 1, "b": 0.5})
    assert table.mixed({"a": 0.6, "b": 0.6}).albedo(50) == pytest.approx(0.96)


def test_an_intensity_may_be_as_bright_as_it_likes() -> None:
    assert alone(INTENSITY, bright=5.0)(10, 20, 30) == pytest.approx(5)
