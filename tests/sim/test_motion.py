"""Motion profiles and the ringing after them."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.errors import SimError
from sim.motion import Profile, Ringing, Segments, Track, to_rest, to_target, to_velocity

positions = st.floats(-400, 400)
velocities = st.floats(-120, 120)
speeds = st.floats(0.5, 120)
accelerations = st.floats(5, 2000)
STILL = Ringing(amplitude=0.0)

untimed = settings(deadline=None)  # other work on the machine is none of these tests' business


def knots(profile: Profile) -> list[float]:
    times = [profile.start]
    for duration, _ in profile.segments:
        times.append(times[-1] + duration)
    return times


@untimed
@given(positions, velocities, positions, speeds, accelerations)
def test_a_move_arrives_at_rest_and_keeps_its_limits(position: float, velocity: float, target: float, speed: float, accel: float) -> None:
    profile = Profile(10.0, position, velocity, to_target(position, velocity, target, speed, accel))
    assert profile.at(profile.end + 1e-9) == (pytest.approx(target, abs=1e-7), 0.0)
    assert all(abs(push) <= accel * (1 + 1e-12) for _, push in profile.segments)
    times = [profile.start + profile.duration * i / 200 for i in range(201)]
    assert max(abs(profile.at(t)[1]) for t in times) <= max(speed, abs(velocity)) * (1 + 1e-9) + 1e-6


@untimed
@given(positions, velocities, positions, speeds, accelerations)
def test_a_move_is_continuous(position: float, velocity: float, target: float, speed: float, accel: float) -> None:
    profile = Profile(0.0, position, velocity, to_target(position, velocity, target, speed, accel))
    assert profile.at(0.0) == (pytest.approx(position), pytest.approx(velocity) if profile.segments else 0.0)
    times = sorted({*knots(profile), *(profile.end * i / 50 for i in range(51))})
    for before, after in itertools.pairwise(times):
        (p0, v0), (p1, v1) = profile.at(before), profile.at(after)
        # Between knots the acceleration is constant, so the trapezium is exact; a jump anywhere would break it.
        assert p1 - p0 == pytest.approx((v0 + v1) / 2 * (after - before), abs=1e-7)
        assert abs(v1 - v0) <= accel * (after - before) + 1e-6


@untimed
@given(positions, positions, speeds, accelerations)
def test_duration_from_rest_has_the_closed_form(position: float, target: float, speed: float, accel: float) -> None:
    distance = abs(target - position)
    cruises = distance >= speed**2 / accel
    expected = distance / speed + speed / accel if cruises else 2 * math.sqrt(distance / accel)
    assert Profile(0.0, position, 0.0, to_target(position, 0.0, target, speed, accel)).duration == pytest.approx(expected, abs=1e-9)


def test_numbers_by_hand() -> None:
    # 90 deg at 60 deg/s and 600 deg/s^2: 0.1 s and 3 deg to get up to speed, as much to brake, 84 deg between.
    profile = Profile(0.0, 0.0, 0.0, to_target(0.0, 0.0, 90.0, 60.0, 600.0))
    assert profile.segments == (pytest.approx((0.1, 600.0)), pytest.approx((1.4, 0.0)), pytest.approx((0.1, -600.0)))
    assert profile.at(0.1) == pytest.approx((3.0, 60.0))
    assert profile.at(0.8) == pytest.approx((45.0, 60.0))
    # Going 60 deg/s the wrong way, 1 deg short: 3 deg out while braking, then a triangle of 4 deg back.
    back = Profile(0.0, 0.0, -60.0, to_target(0.0, -60.0, 1.0, 60.0, 600.0))
    assert back.at(0.1) == pytest.approx((-3.0, 0.0))
    assert back.duration == pytest.approx(0.1 + 2 * math.sqrt(4.0 / 600.0))


@untimed
@given(positions, velocities, accelerations)
def test_stopping_takes_the_shortest_way(position: float, velocity: float, accel: float) -> None:
    profile = Profile(0.0, position, velocity, to_rest(velocity, accel))
    assert profile.duration == pytest.approx(abs(velocity) / accel)
    assert profile.at(profile.end + 1)[0] == pytest.approx(position + velocity * abs(velocity) / (2 * accel))


@untimed
@given(velocities, velocities, accelerations)
def test_a_velocity_is_reached_and_kept(velocity: float, wanted: float, accel: float) -> None:
    profile = Profile(0.0, 0.0, velocity, to_velocity(velocity, wanted, accel))
    ramp = abs(wanted - velocity) / accel
    assert profile.at(ramp + 1e-9)[1] == pytest.approx(wanted, abs=1e-5)
    assert profile.at(ramp + 100.0)[1] == pytest.approx(wanted, abs=1e-9)
    assert math.isinf(profile.end) == (wanted != 0)


@untimed
@given(positions, positions, positions, st.floats(0, 20), speeds, accelerations)
def test_retargeting_under_way_starts_from_where_the_axis_is(
    start: float, first: float, second: float, moment: float, speed: float, accel: float
) -> None:
    track = Track(start, STILL)
    track.begin(0.0, to_target(start, 0.0, first, speed, accel))
    before = track.nominal(moment)
    track.begin(moment, to_target(*before, second, speed, accel))
    if moment < track.end:
        assert track.nominal(moment) == pytest.approx(before)
    assert track.nominal(track.end + 1e-9)[0] == pytest.approx(second, abs=1e-6)
    # What was, remains: readings that began before the change must find the angles of then.
    old = Profile(0.0, start, 0.0, to_target(start, 0.0, first, speed, accel))
    assert track.nominal(moment / 2)[0] == pytest.approx(old.at(moment / 2)[0])


def moved(ringing: Ringing, segments: Segments) -> Track:
    track = Track(0.0, ringing)
    track.begin(1.0, segments)
    return track


def test_ringing_follows_a_stop_and_dies_away() -> None:
    ringing = Ringing(amplitude=0.02, decay=0.05, frequency=25.0)
    track = moved(ringing, to_target(0.0, 0.0, 90.0, 60.0, 600.0))
    end = track.end
    assert track.mechanical(end - 0.3) == track.nominal(end - 0.3)[0]
    for since in (0.0, 0.004, 0.01, 0.03, 0.1):
        expected = 0.02 * math.exp(-since / 0.05) * math.sin(2 * math.pi * 25 * since)
        assert track.mechanical(end + since) - 90 == pytest.approx(expected, abs=1e-9)
        assert track.nominal(end + since)[0] == pytest.approx(90.0, abs=1e-9)
    assert track.mechanical(end + 0.01) > 90  # one quarter of a swing on, past the target
    assert abs(track.mechanical(end + 1.0) - 90) < 1e-9


def test_ringing_goes_on_in_the_direction_of_arrival() -> None:
    track = moved(Ringing(), to_target(0.0, 0.0, -90.0, 60.0, 600.0))
    assert track.mechanical(track.end + 0.01) < -90


def test_small_moves_ring_less() -> None:
    ringing = Ringing(amplitude=0.02, frequency=25.0)
    long = moved(ringing, to_target(0.0, 0.0, 90.0, 60.0, 600.0))
    short = moved(ringing, to_target(0.0, 0.0, 0.06, 60.0, 600.0))  # brakes for 10 ms, a quarter of a period
    swing = [track.mechanical(track.end + 0.01) - track.nominal(track.end + 1)[0] for track in (short, long)]
    assert swing[0] == pytest.approx(swing[1] / 4, rel=1e-6)


def test_a_motion_cut_short_does_not_ring_at_its_planned_end_and_earlier_ringing_goes_on() -> None:
    track = moved(Ringing(decay=1.0), to_target(0.0, 0.0, 90.0, 60.0, 600.0))
    cut = 1.5
    planned_end = track.end
    track.begin(cut, to_rest(track.nominal(cut)[1], 600.0))
    rest = track.nominal(planned_end)[0]
    rung = Ringing(decay=1.0).after(Profile(cut, *track.nominal(cut), to_rest(60.0, 600.0)), planned_end + 0.01)
    assert rung != 0
    assert track.mechanical(planned_end + 0.01) == pytest.approx(rest + rung)
    # A new motion soon after the stop does not make the arm jump.
    again = track.end + 0.01
    before = track.mechanical(again)
    track.begin(again, to_target(*track.nominal(again), 0.0, 60.0, 600.0))
    assert track.mechanical(again) == pytest.approx(before, abs=1e-12)
    assert abs(before - track.nominal(again)[0]) > 0.01


def test_a_track_says_what_it_has_forgotten() -> None:
    track = Track(0.0, STILL, memory=10.0)
    for t in range(0, 100, 5):
        track.begin(float(t), to_target(track.nominal(t)[0], 0.0, float(t % 7), 60.0, 600.0))
    assert track.nominal(90.0)[0] == pytest.approx(85 % 7)
    with pytest.raises(SimError, match="remembers"):
        track.nominal(20.0)


@pytest.mark.parametrize("values", [(-1.0, 0.1, 25.0), (0.1, 0.0, 25.0), (0.1, 0.1, 0.0), (float("nan"), 0.1, 25.0)])
def test_ringing_refuses_impossible_values(values: tuple[float, float, float]) -> None:
    with pytest.raises(SimError, match="ringing"):
        Ringing(*values)


@st.composite
def histories(draw: st.DrawFn) -> tuple[Track, list[float], float]:
    """A track with motions that are taken over, stopped softly or dead, or let end; when they began, and now; the highest acceleration."""
    track, now, begun, highest = Track(draw(positions), STILL), 0.0, [0.0], 0.0
    for kind in draw(st.lists(st.sampled_from(["move", "run", "brake", "dead"]), min_size=1, max_size=6)):
        now += draw(st.floats(0, 4))
        speed, acceleration, (position, velocity) = draw(speeds), draw(accelerations), track.nominal(now)
        highest = max(highest, acceleration)
        begun.append(now)
        match kind:
            case "move":
                track.begin(now, to_target(position, velocity, draw(positions), speed, acceleration))
            case "run":
                track.begin(now, to_velocity(velocity, draw(velocities), acceleration))
            case "brake":
                track.begin(now, to_rest(velocity, acceleration))
            case "dead":
                track.begin(now, ())
    return track, [*begun, now + draw(st.floats(0, 8))], highest


@untimed
@given(histories(), st.floats(0, 1))
def test_reach_is_that_of_dense_sampling(history: tuple[Track, list[float], float], share: float) -> None:
    track, (*begun, now), acceleration = history
    for begin, reach in ((0.0, track.reach(now)), (share * now, track.reach(now, share * now))):
        step = (now - begin) / 1000
        times = [begin + step * i for i in range(1001)] + [t for t in begun if begin <= t <= now]
        seen = [track.nominal(t)[0] for t in times]
        # Nothing lies outside, and a turning point between two samples no further away than the acceleration takes it in half a step.
        missed = acceleration * step**2 / 8 + 1e-6
        assert reach[0] == pytest.approx(min(seen), abs=missed)
        assert reach[1] == pytest.approx(max(seen), abs=missed)
        assert reach[0] - 1e-9 <= min(seen)
        assert reach[1] + 1e-9 >= max(seen)


@untimed
@given(positions, velocities, positions, speeds, accelerations)
def test_reach_of_one_move_is_that_of_its_stops_and_turning_points(
    position: float, velocity: float, target: float, speed: float, accel: float
) -> None:
    profile = Profile(5.0, position, velocity, to_target(position, velocity, target, speed, accel))
    # A move that starts the wrong way, or too fast to stop in time, turns where it would have braked to a standstill.
    turned = position + velocity * abs(velocity) / (2 * accel)
    astray = velocity * (target - position) < 0 or abs(turned - position) > abs(target - position)
    expected = [position, target, turned] if astray else [position, target]
    assert profile.reach(5.0, profile.end) == (pytest.approx(min(expected), abs=1e-7), pytest.approx(max(expected), abs=1e-7))


def test_reach_by_hand() -> None:
    track = Track(10.0, STILL)
    track.begin(1.0, to_target(10.0, 0.0, 100.0, 60.0, 600.0))  # 0.1 s and 3 deg to get up to speed
    assert track.reach(1.0) == (10.0, 10.0)
    assert track.reach(1.1) == (10.0, pytest.approx(13.0))  # not what it is going to do
    track.begin(2.1, to_target(*track.nominal(2.1), 40.0, 60.0, 600.0))  # at 73 deg: brakes, 3 deg on, and back
    assert track.reach(9.0) == (10.0, pytest.approx(76.0))
    assert track.reach(9.0, 2.1) == (pytest.approx(40.0), pytest.approx(76.0))
    assert track.reach(9.0, 8.0) == (pytest.approx(40.0), pytest.approx(40.0))
    assert track.reach(1.6, 1.1) == (pytest.approx(13.0), pytest.approx(43.0))


def test_reach_outlives_the_memory() -> None:
    track = Track(0.0, STILL, memory=10.0)
    for t, target in ((0.0, -200.0), (20.0, 50.0), (40.0, 0.0), (60.0, 1.0)):
        track.begin(t, to_target(*track.nominal(t), target, 60.0, 600.0))
    assert track.reach(70.0) == (pytest.approx(-200.0), pytest.approx(50.0))
    with pytest.raises(SimError, match="remembers"):
        track.reach(70.0, 5.0)


def test_moving_is_moving_of_the_profile() -> None:
    track = Track(0.0, Ringing())
    track.begin(1.0, to_target(0.0, 0.0, 90.0, 60.0, 600.0))
    assert [track.moving(t) for t in (0.5, 1.0, 2.0, track.end - 1e-6, track.end, track.end + 0.01)] == [
        False,
        True,
        True,
        True,
        False,
        False,
    ]
    track.begin(2.0, ())
    assert [track.moving(t) for t in (1.9, 2.0, 2.1)] == [True, False, False]


def test_a_halt_planned_ahead_happens_unless_something_else_comes_first() -> None:
    def halting() -> Track:
        track = Track(0.0, STILL)
        track.begin(0.0, to_target(0.0, 0.0, 90.0, 60.0, 600.0))
        track.begin(1.1, ())  # at 63 deg
        return track

    track = halting()
    assert track.nominal(0.6) == (pytest.approx(33.0), pytest.approx(60.0))
    assert track.nominal(1.2) == (pytest.approx(63.0), 0.0)
    assert (track.end, track.moving(1.0), track.moving(1.1)) == (1.1, True, False)
    assert track.reach(0.6) == (0.0, pytest.approx(33.0))
    assert track.reach(5.0) == (0.0, pytest.approx(63.0))
    track = halting()
    track.begin(0.6, to_rest(60.0, 600.0))  # 3 deg to brake
    for since in (None, 0.1):
        assert track.reach(5.0, since)[1] == pytest.approx(36.0)
    assert track.nominal(5.0) == (pytest.approx(36.0), 0.0)
    assert track.end == pytest.approx(0.7)


def test_departures_are_motions_from_rest_and_not_what_took_over_from_them() -> None:
    track = Track(0.0, STILL)
    assert track.departures == ()
    track.begin(1.0, to_target(0.0, 0.0, 10.0, 5.0, 5.0))
    track.begin(2.0, to_rest(track.nominal(2.0)[1], 5.0))
    track.begin(5.0, ())
    track.begin(6.0, to_target(track.nominal(6.0)[0], 0.0, 0.0, 5.0, 5.0))
    assert track.departures == (1.0, 6.0)
