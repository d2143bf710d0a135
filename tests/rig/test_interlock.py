import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import InterlockError
from rig.interlock import Interlock, KeepOut

LIMITS = {"source": (0.0, 80.0), "detector": (-85.0, 85.0)}
ANGLES = st.fixed_dictionaries({"source": st.floats(0, 80), "detector": st.floats(-85, 85)})


def interlock(crossing: bool, shadow: float = 0.0) -> Interlock:
    return Interlock(LIMITS, KeepOut(3.0, crossing, shadow))


def test_the_papers_view_next_to_the_lamp_is_allowed() -> None:
    interlock(True).check_position({"source": 45.0, "detector": 40.0})
    interlock(True).check_position({"source": 45.0, "detector": 50.0})


@pytest.mark.parametrize(
    ("position", "names"), [({"source": 81.0, "detector": 0.0}, "source"), ({"source": 45.0, "detector": -85.1}, "detector")]
)
def test_outside_the_limits_is_refused_by_name(position: dict[str, float], names: str) -> None:
    with pytest.raises(InterlockError, match=f"axis {names}: .* outside its limits"):
        interlock(True).check_position(position)


def test_inside_the_keep_out_is_refused() -> None:
    with pytest.raises(InterlockError, match="within 3 deg of the source arm at 45 deg, too close"):
        interlock(True).check_position({"source": 45.0, "detector": 43.0})


def test_arms_that_cannot_cross_are_not_sent_across() -> None:
    with pytest.raises(InterlockError, match="cross"):
        interlock(False).order({"source": 45.0, "detector": 30.0}, {"source": 45.0, "detector": 60.0})


def test_the_arm_in_the_way_goes_first() -> None:
    # The source cannot go to 42 while the detector stands at 40.
    groups = interlock(True).order({"source": 30.0, "detector": 40.0}, {"source": 42.0, "detector": 10.0})
    assert groups == (("detector",), ("source",))


@given(ANGLES, ANGLES, st.booleans())
def test_no_order_stops_an_arm_in_the_keep_out_or_takes_it_across(start: dict[str, float], end: dict[str, float], crossing: bool) -> None:
    guard = interlock(crossing)
    if guard.blocked(start):
        return
    try:
        groups = guard.order(start, end)
    except InterlockError:
        return
    position = dict(start)
    for group in groups:
        for axis in group:
            stopped_here = {**position, axis: end[axis]}
            if len(group) == 1 or axis == group[-1]:
                assert not guard.blocked(stopped_here)
            position = stopped_here
    assert position == end
    if not crossing:
        assert (start["detector"] - start["source"]) * (end["detector"] - end["source"]) > 0


@given(ANGLES, st.sampled_from(["source", "detector"]), st.floats(-200, 200))
def test_a_single_move_is_judged_by_where_both_arms_would_stand(position: dict[str, float], axis: str, target: float) -> None:
    guard = interlock(True)
    after = {**position, axis: target}
    low, high = LIMITS[axis]
    allowed = low <= target <= high and abs(after["detector"] - after["source"]) >= 3.0
    if allowed:
        guard.check_move(position, axis, target)
    else:
        with pytest.raises(InterlockError):
            guard.check_move(position, axis, target)


# Arms that may not cross, sent at once: which one is quicker is not known


FRACTIONS = st.floats(0, 1)


@given(ANGLES, ANGLES, FRACTIONS, FRACTIONS, st.floats(0.1, 20.0))
def test_arms_sent_at_once_come_nowhere_too_close_whichever_is_quicker(
    start: dict[str, float], end: dict[str, float], t: float, u: float, within: float
) -> None:
    guard = Interlock(LIMITS, KeepOut(within, crossing=False))
    if guard.blocked(start):
        return
    try:
        groups = guard.order(start, end)
    except InterlockError:
        return
    position = dict(start)
    for group in groups:
        on_the_way = dict(position)
        for axis, fraction in zip(group, (t, u), strict=False):
            on_the_way[axis] = position[axis] + fraction * (end[axis] - position[axis])
        assert abs(on_the_way["detector"] - on_the_way["source"]) >= within - 1e-9
        position |= {axis: end[axis] for axis in group}
    assert position == end


def test_such_arms_are_sent_at_once_where_nothing_is_in_the_way() -> None:
    assert interlock(False).order({"source": 45.0, "detector": 0.0}, {"source": 60.0, "detector": -20.0}) == (("source", "detector"),)
    # Both go up: the source first, or the detector would run into it.
    assert interlock(False).order({"source": 30.0, "detector": 20.0}, {"source": 60.0, "detector": 50.0}) == (("source",), ("detector",))


@given(ANGLES, st.sampled_from(["source", "detector"]), st.floats(-85, 85), FRACTIONS)
def test_a_single_arm_that_may_not_cross_comes_nowhere_too_close(start: dict[str, float], axis: str, target: float, t: float) -> None:
    guard = interlock(False)
    if guard.blocked(start):
        return
    try:
        guard.check_move(start, axis, target)
    except InterlockError:
        return
    on_the_way = {**start, axis: start[axis] + t * (target - start[axis])}
    assert not guard.blocked(on_the_way) or abs(on_the_way["detector"] - on_the_way["source"]) == pytest.approx(3.0)


# The shadow


def test_in_the_shadow_nothing_is_read_and_arms_may_pass_and_stand() -> None:
    guard = interlock(True, shadow=8.0)
    shaded = {"source": 45.0, "detector": 40.0}
    with pytest.raises(InterlockError, match="within 8 deg of the source arm at 45 deg, where it blocks the light; nothing was moved"):
        guard.check_reading(shaded)
    guard.check_position(shaded)
    guard.check_move({"source": 45.0, "detector": 0.0}, "detector", 40.0)
    assert guard.order({"source": 45.0, "detector": 0.0}, shaded) == (("source", "detector"),)
    guard.check_reading({"source": 45.0, "detector": 37.0})


@given(ANGLES, st.floats(0, 20))
def test_what_may_be_read_may_be_stood_at(position: dict[str, float], shadow: float) -> None:
    guard = interlock(True, shadow)
    try:
        guard.check_reading(position)
    except InterlockError:
        assert abs(position["detector"] - position["source"]) < max(shadow, 3.0)
        return
    guard.check_position(position)
    assert abs(position["detector"] - position["source"]) >= max(shadow, 3.0)


# Axes beside the arms


def test_an_axis_beside_the_arms_has_limits_and_no_keep_out() -> None:
    guard = Interlock({**LIMITS, "x": (0.0, 150.0)}, KeepOut(3.0, crossing=False), units={"x": "mm"})
    arms = {"source": 45.0, "detector": 0.0}
    guard.check_move({**arms, "x": 10.0}, "x", 45.0)
    with pytest.raises(InterlockError, match=r"axis x: 151 mm is outside its limits 0 to 150 mm"):
        guard.check_move(arms, "x", 151.0)
    assert guard.order({**arms, "x": 0.0}, {"source": 30.0, "detector": -5.0, "x": 10.0}) == (("source", "detector", "x"),)
