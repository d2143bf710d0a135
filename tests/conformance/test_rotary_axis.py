"""What every rotary axis owes, whoever made it."""

import pytest

from drivers.errors import DeviceError, DeviceFault, MoveTimeout, NotHomed
from drivers.kinds import MotionProfile, Stage
from drivers.motion import wait_until_idle

# The simulators run faster than time: waiting is done in their time.
from rig.clock import Clock
from sim.serve import Running
from tests.conformance.conftest import SPEED

CLOCK = Clock(SPEED)


@pytest.fixture
def homed(axis: Stage) -> Stage:
    if not axis.state().homed:
        axis.start_home()
        wait_until_idle(axis, 0.0, timeout_s=60.0, clock=CLOCK)
    return axis


def go(axis: Stage, deg: float) -> None:
    expected = axis.profile().duration_s(deg - axis.state().position)
    axis.start_move(deg)
    wait_until_idle(axis, expected, timeout_s=expected + 10, clock=CLOCK)


def test_it_says_who_it_is(axis: Stage) -> None:
    identity = axis.identify()
    assert all((identity.vendor, identity.model, identity.serial_number, identity.firmware))


def test_homing_gives_it_a_reference(homed: Stage) -> None:
    state = homed.state()
    assert state.homed
    assert not state.moving


def test_it_goes_where_it_is_sent_and_says_so(homed: Stage) -> None:
    for deg in (10.0, 123.4, 33.3):
        go(homed, deg)
        homed.check_arrival(deg, 0.001)
        assert homed.state().position == pytest.approx(deg, abs=0.001)


def test_a_start_returns_while_it_moves(homed: Stage) -> None:
    go(homed, 10.0)
    homed.start_move(200.0)
    assert homed.state().moving
    homed.stop()


def test_a_stop_stops_it_on_the_way_and_the_arrival_is_denied(homed: Stage) -> None:
    go(homed, 10.0)
    homed.start_move(300.0)
    while homed.state().position < 12.0:
        pass
    homed.stop()
    homed.stop()
    wait_until_idle(homed, 0.0, timeout_s=10, clock=CLOCK)
    assert 12.0 < homed.state().position < 299.0
    with pytest.raises(DeviceFault):
        homed.check_arrival(300.0, 0.01)
    go(homed, 20.0)
    homed.check_arrival(20.0, 0.001)


def test_beyond_its_limits_it_refuses_and_stays(homed: Stage) -> None:
    go(homed, 10.0)
    for deg in (limit + beyond for limit, beyond in zip(homed.limits(), (-1.0, 1.0), strict=True)):
        with pytest.raises(DeviceError):
            homed.start_move(deg)
    assert homed.state().position == pytest.approx(10.0, abs=0.001)


def test_its_profile_is_what_it_was_set_to(homed: Stage) -> None:
    homed.set_profile(speed=33.0, acceleration=250.0)
    profile = homed.profile()
    assert (profile.speed, profile.acceleration) == pytest.approx((33.0, 250.0), rel=0.01)
    homed.set_profile(speed=60.0, acceleration=600.0)


def test_the_profile_predicts_the_arrival(homed: Stage) -> None:
    homed.set_profile(speed=20.0, acceleration=100.0)
    go(homed, 10.0)
    expected = MotionProfile(20.0, 100.0).duration_s(100.0)
    started = CLOCK.monotonic()
    homed.start_move(110.0)
    CLOCK.sleep(0.9 * expected)
    moving_before = homed.state().moving or CLOCK.monotonic() - started > expected  # a busy computer may have overslept
    wait_until_idle(homed, 0.0, timeout_s=30, clock=CLOCK)
    assert moving_before
    assert CLOCK.monotonic() - started >= expected
    homed.set_profile(speed=60.0, acceleration=600.0)


def test_waiting_too_long_stops_it(homed: Stage) -> None:
    go(homed, 10.0)
    homed.start_move(350.0)
    with pytest.raises(MoveTimeout):
        wait_until_idle(homed, 0.0, timeout_s=0.5, clock=CLOCK)
    wait_until_idle(homed, 0.0, timeout_s=10, clock=CLOCK)
    assert homed.state().position < 349.0


def test_without_a_reference_it_will_not_move(world: Running) -> None:
    from drivers import catalogue
    from sim.serve import Settings, in_background

    with in_background(Settings(specimen="lambert:0.5", seed=5, speed=SPEED)) as fresh:
        model = catalogue.load().lookup("zaber-x-rsw60a")
        with model.open_link(fresh.url("stages")) as link:
            axis = model.open_device(link, name="axis")
            assert isinstance(axis, Stage)
            assert not axis.state().homed
            with pytest.raises(NotHomed):
                axis.start_move(10.0)
