"""Eqs. (9) to (12) solved as far as what is known goes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitting import TERMS, FitError
from fitting.layers import mixture_from

share = st.floats(0.01, 0.99)
magnitude = st.floats(0.01, 1)


def mixed(t_u: float, t_s: float, k: tuple[float, ...]) -> dict[str, float]:
    """Eqs. (9) to (12)."""
    return dict(zip(TERMS, ((1 - t_u) * k[0], (1 - t_u) * k[1], t_u * (1 - t_s) * k[2], t_u * (1 - t_s) * k[3]), strict=True))


@given(t_u=share, t_s=share, k=st.tuples(magnitude, magnitude, magnitude, magnitude))
def test_transmittances_give_the_reflectances_and_back(t_u: float, t_s: float, k: tuple[float, ...]) -> None:
    x = mixed(t_u, t_s, k)
    truth = {"t_u": t_u, "t_s": t_s} | {f"k_{name}": value for name, value in zip(TERMS, k, strict=True)}
    for given_names in (("t_u", "t_s"), ("k_u_spec", "k_s_diff"), ("t_u", "k_s_spec"), ("t_s", "k_u_diff"), ("t_s", "k_s_diff")):
        found = mixture_from(x, **{name: truth[name] for name in given_names})
        for name, (low, high) in found.items():
            assert low == pytest.approx(truth[name], rel=1e-6, abs=1e-9), (given_names, name)
            assert high == pytest.approx(truth[name], rel=1e-6, abs=1e-9), (given_names, name)


@given(
    t_u=share,
    t_s=share,
    k=st.tuples(magnitude, magnitude, magnitude, magnitude),
    known=st.sets(st.sampled_from(["t_u", "t_s", "k_u_diff"])),
)
def test_ranges_hold_the_truth_and_both_ends_are_possible(t_u: float, t_s: float, k: tuple[float, ...], known: set[str]) -> None:
    x = mixed(t_u, t_s, k)
    truth = {"t_u": t_u, "t_s": t_s} | {f"k_{name}": value for name, value in zip(TERMS, k, strict=True)}
    found = mixture_from(x, k_max=1, **{name: truth[name] for name in known})
    for name, (low, high) in found.items():
        assert low - 1e-9 <= truth[name] <= high + 1e-9
        for end in (low, high):
            again = mixture_from(x, k_max=1 + 1e-9, **({n: truth[n] for n in known} | {name: min(end, 1.0)}))
            assert again[name] == pytest.approx((end, end))


def test_what_the_ranges_are() -> None:
    x = dict(zip(TERMS, (0.2, 0.1, 0.3, 0.06), strict=True))
    bare = mixture_from(x)
    assert bare["t_u"] == (0, 1)
    assert bare["k_u_diff"] == (0.2, math.inf)
    bounded = mixture_from(x, k_max=1)
    assert bounded["t_u"] == pytest.approx((0.3, 0.8))
    assert bounded["t_s"] == pytest.approx((0, 1 - 0.3 / 0.8))
    assert bounded["k_u_diff"] == pytest.approx((0.2 / 0.7, 1))
    assert bounded["k_s_spec"] == pytest.approx((0.06 / 0.8, 0.2))
    spread = mixture_from({**x, "u_diff": (0.18, 0.22)}, t_u=0.5, t_s=0.2)
    assert spread["k_u_diff"] == pytest.approx((0.36, 0.44))


@pytest.mark.parametrize(
    ("given_values", "problem"),
    [
        ({"t_u": 1.0, "k_max": 1.0}, "contradicts itself"),
        ({"t_u": 1.0}, "contradicts itself"),
        ({"t_s": 1.0}, "contradicts itself"),
        ({"k_u_diff": 0.5, "k_u_spec": 0.5}, "contradicts itself"),
        ({"k_u_diff": 0.0}, "contradicts itself"),
        ({"t_u": 0.9, "k_max": 1.0}, "contradicts itself"),
        ({"t_u": 1.5}, "t_u must lie within 0 to 1"),
        ({"t_s": math.nan}, "t_s must lie"),
        ({"k_s_diff": 2.0, "k_max": 1.0}, "k_s_diff must lie within 0 to 1"),
        ({"k_max": 0.0}, "k_max"),
    ],
)
def test_what_cannot_be_is_refused(given_values: dict[str, float], problem: str) -> None:
    with pytest.raises(FitError, match=problem):
        mixture_from(dict(zip(TERMS, (0.2, 0.1, 0.3, 0.06), strict=True)), **given_values)
    with pytest.raises(FitError, match="lacks s_spec"):
        mixture_from({"u_diff": 1.0, "u_spec": 1.0, "s_diff": 1.0})
