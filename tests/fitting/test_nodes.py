"""Interpolation between nodes: exact at them, smooth across them, and sparing with the function it stands for."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting.nodes import Array, Nodes

BOUNDS = {"a": (0.1, 4.0), "b": (2.0, 200.0)}
RATIO = {"a": 1.4, "b": 1.8}


def wavy(a: float, b: float) -> Array:
    """Smooth over the logarithms of both numbers, and 0 somewhere."""
    return np.array([1.1 + math.sin(math.log(a)), math.log(b) ** 2, 1 + math.cos(math.log(a) + 0.5 * math.log(b)), 0.0])


def power_laws(a: float, b: float) -> Array:
    """Straight where both axes are logarithmic."""
    return np.array([3 * a**2 * b**-0.7, b**3, a**-1.5])


def places(name: str, ratio: float) -> np.ndarray:
    """Where nodes lie: even over the logarithm, neighbours no further apart than the ratio."""
    low, high = BOUNDS[name]
    return np.geomspace(low, high, math.ceil(math.log(high / low) / math.log(ratio)) + 1)


def test_at_nodes_the_function_itself_is_returned() -> None:
    asked: list[tuple[float, float]] = []

    def noted(a: float, b: float) -> Array:
        asked.append((a, b))
        return wavy(a, b)

    nodes = Nodes(noted, BOUNDS, RATIO)
    for a, b in itertools.product(places("a", 1.4)[[0, 1, 5, -1]], places("b", 1.8)[[0, 2, -2, -1]]):
        np.testing.assert_allclose(nodes(a=float(a), b=float(b)), wavy(a, b), rtol=1e-9, atol=1e-12)
    for name, values in zip(BOUNDS, np.array(asked).T, strict=True):
        seen = np.unique(np.round(values, 9))
        assert np.all(np.min(np.abs(seen[:, None] / places(name, RATIO[name]) - 1), axis=1) < 1e-8)


@given(a=st.floats(*BOUNDS["a"]), b=st.floats(*BOUNDS["b"]))
def test_power_laws_are_met(a: float, b: float) -> None:
    """Up to the bounds themselves, where the row of nodes ends."""
    np.testing.assert_allclose(Nodes(power_laws, BOUNDS, RATIO)(a=a, b=b), power_laws(a, b), rtol=1e-5, atol=1e-7)


def test_a_lobe_that_falls_by_decades_stays_a_lobe() -> None:
    """The nth power of cos(30 deg), from 0.75 down to 1e-13: of what is faint only that it stays faint."""
    nodes = Nodes(lambda n: np.array([math.cos(math.radians(30)) ** n]), {"n": (2.0, 200.0)}, {"n": 1.8})
    for n in np.geomspace(2, 200, 57):
        exact = math.cos(math.radians(30)) ** n
        assert nodes(n=float(n))[0] == pytest.approx(exact, rel=0.03, abs=1e-5)


def test_parabolas_of_logarithms_are_met_to_the_very_ends() -> None:
    nodes = Nodes(lambda b: np.array([math.exp(math.log(b) ** 2)]), {"b": (2.0, 20.0)}, {"b": 1.8})
    for b in np.geomspace(2, 20, 37):
        assert nodes(b=float(b))[0] == pytest.approx(math.exp(math.log(b) ** 2), rel=1e-7)


def test_the_error_falls_with_the_cube_of_the_step_at_least() -> None:
    errors = []
    for ratio in (2.0, math.sqrt(2.0), 2.0**0.25):
        nodes = Nodes(lambda a: np.array([2 + math.sin(3 * math.log(a))]), {"a": (0.125, 8.0)}, {"a": ratio})
        middle = np.geomspace(0.5, 2.0, 101)
        errors.append(max(abs(nodes(a=float(a))[0] - 2 - math.sin(3 * math.log(a))) for a in middle))
    assert errors[1] < errors[0] / 4
    assert errors[2] < errors[0] / 40


def test_no_node_lies_outside_the_bounds() -> None:
    """Not by rounding either: there the function may be refused."""
    asked: list[float] = []

    def noted(albedo: float) -> Array:
        asked.append(albedo)
        return np.array([albedo])

    for ratio in (1.05, 1.08, 1.15, 1.3, 1.7):
        nodes = Nodes(noted, {"albedo": (0.02, 1.0)}, {"albedo": ratio})
        assert nodes(albedo=1.0)[0] == pytest.approx(1, rel=1e-6)
        assert nodes(albedo=0.02)[0] == pytest.approx(0.02, rel=1e-6)
    assert min(asked) == 0.02
    assert max(asked) == 1.0


@pytest.mark.parametrize("node", [0.1, 1.0, 3.0])
def test_neither_value_nor_slope_jumps_at_a_node(node: float) -> None:
    """A search by derivatives needs that. The function is rough on purpose: smoothness must come from the nodes."""
    rough = {k: math.exp(math.sin(12.9898 * k)) for k in range(-2, 40)}
    nodes = Nodes(lambda a: np.array([rough[round(math.log(a / 0.1, 1.4))]]), {"a": (0.1, 0.1 * 1.4**10)}, {"a": 1.4 + 1e-12})
    at, step = 0.1 * 1.4 ** round(math.log(max(node, 0.15) / 0.1, 1.4)), 1e-6

    def value(a: float) -> float:
        return float(nodes(a=a)[0])

    assert value(at * (1 - 1e-9)) == pytest.approx(value(at * (1 + 1e-9)), abs=1e-6)
    before = (value(at) - value(at * (1 - step))) / (at * step)
    after = (value(at * (1 + step)) - value(at)) / (at * step)
    assert before == pytest.approx(after, rel=1e-4, abs=1e-4)
    assert abs(before) > 0.05  # it does change here


def test_each_node_is_worked_out_once_and_only_when_it_is_needed() -> None:
    asked: list[tuple[float, float]] = []

    def noted(a: float, b: float) -> Array:
        asked.append((a, b))
        return wavy(a, b)

    nodes = Nodes(noted, BOUNDS, RATIO)
    assert asked == []
    nodes(a=0.9, b=25.0)
    assert len(asked) == 16
    for a, b in itertools.product((0.85, 0.9, 0.95), (24.0, 28.0)):
        nodes(a=a, b=b)
    assert len(asked) == len(set(asked)) == 16


def test_without_bounds_it_is_the_function() -> None:
    nodes = Nodes(lambda: np.array([3.0]), {}, RATIO)
    assert nodes().tolist() == [3.0]


def test_narrow_bounds_have_nodes_enough_for_a_cubic() -> None:
    nodes = Nodes(lambda a: np.array([math.exp(a)]), {"a": (1.0, 1.01)}, {"a": 1.4})
    for a in np.linspace(1.0, 1.01, 11):
        assert nodes(a=float(a))[0] == pytest.approx(math.exp(a), rel=1e-5)
