import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import ConfigError
from rig.trajectory import Trajectory, parse_angles


def test_the_papers_angles() -> None:
    angles = parse_angles("-70:70:10", "--theta-r")
    assert angles == tuple(float(a) for a in range(-70, 71, 10))


@pytest.mark.parametrize(
    ("text", "angles"),
    [("45", (45.0,)), ("15, 30,45", (15.0, 30.0, 45.0)), ("20:0:-10", (20.0, 10.0, 0.0)), ("0:1:0.25,7", (0, 0.25, 0.5, 0.75, 1, 7))],
)
def test_numbers_lists_and_ranges(text: str, angles: tuple[float, ...]) -> None:
    assert parse_angles(text, "--x") == angles


@pytest.mark.parametrize("text", ["", "x", "1:2", "1:2:0", "2:1:1", "1:2:3:4", "nan", "inf", "0:10:3", "1,,2", "0:1e9:1e-3"])
def test_nonsense_is_refused_by_the_options_name(text: str) -> None:
    with pytest.raises(ConfigError, match="--theta-r"):
        parse_angles(text, "--theta-r")


@given(st.integers(-80, 80), st.integers(1, 40), st.sampled_from([0.1, 0.25, 0.5, 1.0, 2.5, 10.0]))
def test_a_range_holds_both_its_ends_evenly(first: int, count: int, step: float) -> None:
    last = first + count * step
    angles = parse_angles(f"{first}:{last!r}:{step}", "--x")
    assert len(angles) == count + 1
    assert angles[0] == first
    assert angles[-1] == pytest.approx(last)
    assert all(b - a == pytest.approx(step) for a, b in itertools.pairwise(angles))


def test_rows_run_forth_and_back_so_that_the_detector_never_travels_in_vain() -> None:
    views = [point.theta_r for point in Trajectory((30.0, 45.0), (-10.0, 0.0, 10.0)).points()]
    assert views == [-10, 0, 10, 10, 0, -10]


def test_a_point_named_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="--theta-r names 10 deg twice"):
        Trajectory((45.0,), (10.0, 20.0, 10.0))


def test_its_length_counts_readings() -> None:
    assert len(Trajectory((30.0, 45.0), (-10.0, 0.0, 10.0), repeat=4)) == 24
