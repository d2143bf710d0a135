import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import InterlockError
from rig.interlock import Interlock, KeepOut

LIMITS = {"source": (0.0, 80.0), "detector": (-85.0, 85.0)}
ANGLES = st.fixed_dictionaries({"source": st.floats(0, 80), "detector": st.floats(-85, 85)})


def interlock(crossing: bool) -> Interlock:
    return Interlock(LIMITS, KeepOut(3.0, crossing))


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
    with pytest.raises(InterlockError, match="blocks the light"):
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
