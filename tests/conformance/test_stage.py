"""What every stage owes, whoever made it; positions in its own unit."""

import pytest

from drivers import catalogue
from drivers.errors import DeviceError, DeviceFault, MoveTimeout, NotHomed
from drivers.kinds import AxisState, ForgetfulStage, MotionProfile, Stage
from drivers.motion import wait_until_idle

# The simulators run faster than time: waiting is done in their time.
from rig.clock import Clock
from sim.faults import Fault
from sim.serve import Running
from tests.conformance.conftest import SPEED, STAGES, SWIFT, opened

CLOCK = Clock(SPEED)

REFERENCED: set[str] = set()
"""What was homed in this world: for those who do not tell."""


def test_every_stage_of_the_catalogue_is_here() -> None:
    from drivers.builtin import BUILT_IN

    assert set(STAGES) == {model.name for model in BUILT_IN if model.kind.endswith("-axis")}


@pytest.fixture
def homed(stage: Stage, request: pytest.FixtureRequest) -> Stage:
    model = request.node.callspec.params["stage"]
    if not stage.state().homed:
        if isinstance(stage, ForgetfulStage) and model in REFERENCED:
            stage.trust_reference()
        else:
            home(stage)
            REFERENCED.add(model)
    return stage


def home(stage: Stage) -> AxisState:
    stage.start_home()
    return wait_until_idle(stage, 0.0, timeout_s=120.0, clock=CLOCK)


def on(stage: Stage, deg: float) -> float:
    """Where a linear stage, whose travel is shorter, goes for an angle."""
    return deg if stage.unit == "deg" else 0.4 * deg


def go(stage: Stage, position: float) -> None:
    expected = stage.profile().duration_s(position - stage.state().position)
    stage.start_move(position)
    wait_until_idle(stage, expected, timeout_s=expected + 10, clock=CLOCK)


def test_it_says_who_it_is(stage: Stage) -> None:
    identity = stage.identify()
    assert all((identity.vendor, identity.model, identity.serial_number, identity.firmware))
    assert stage.name == "axis"


def test_it_counts_in_what_the_catalogue_says(stage: Stage, request: pytest.FixtureRequest) -> None:
    kind = catalogue.load().lookup(request.node.callspec.params["stage"]).kind
    assert stage.unit == {"rotary-axis": "deg", "linear-axis": "mm"}[kind]
    low, high = stage.limits()
    assert low < high


def test_homing_gives_it_a_reference(stage: Stage) -> None:
    state = home(stage)
    assert state.homed
    assert not state.moving
    assert stage.state().homed


def test_it_goes_where_it_is_sent_and_says_so(homed: Stage) -> None:
    for deg in (10.0, 123.4, 33.3):
        position = on(homed, deg)
        go(homed, position)
        homed.check_arrival(position, 0.001)
        assert homed.state().position == pytest.approx(position, abs=0.001)


def test_where_it_says_it_is_it_is(homed: Stage, world: Running, request: pytest.FixtureRequest) -> None:
    instrument, options, _ = STAGES[request.node.callspec.params["stage"]]
    track = world.world.axes[f"{instrument}:{options.get('address', options.get('axis'))}"]
    go(homed, on(homed, 10.0))
    begun = track.nominal(world.world.clock.now())[0]
    go(homed, on(homed, 60.0))
    assert track.nominal(world.world.clock.now())[0] - begun == pytest.approx(on(homed, 50.0), abs=0.001)


def test_a_start_returns_while_it_moves(homed: Stage) -> None:
    go(homed, on(homed, 10.0))
    homed.start_move(on(homed, 200.0))
    assert homed.state().moving
    homed.stop()


def test_a_stop_stops_it_on_the_way_and_the_arrival_is_denied(homed: Stage) -> None:
    go(homed, on(homed, 10.0))
    homed.start_move(on(homed, 300.0))
    while homed.state().position < on(homed, 12.0):
        pass
    homed.stop()
    homed.stop()
    wait_until_idle(homed, 0.0, timeout_s=10, clock=CLOCK)
    assert on(homed, 12.0) < homed.state().position < on(homed, 299.0)
    with pytest.raises(DeviceFault):
        homed.check_arrival(on(homed, 300.0), 0.01)
    go(homed, on(homed, 20.0))
    homed.check_arrival(on(homed, 20.0), 0.001)


def test_beyond_its_limits_it_refuses_and_stays(homed: Stage) -> None:
    go(homed, on(homed, 10.0))
    for position in (limit + beyond for limit, beyond in zip(homed.limits(), (-1.0, 1.0), strict=True)):
        with pytest.raises(DeviceError):
            homed.start_move(position)
    assert homed.state().position == pytest.approx(on(homed, 10.0), abs=0.001)


def test_its_profile_is_what_it_was_set_to(homed: Stage) -> None:
    homed.set_profile(speed=33.0, acceleration=250.0)
    profile = homed.profile()
    assert (profile.speed, profile.acceleration) == pytest.approx((33.0, 250.0), rel=0.01)


def test_the_profile_predicts_the_arrival(homed: Stage) -> None:
    homed.set_profile(speed=20.0, acceleration=100.0)
    go(homed, on(homed, 10.0))
    profile = homed.profile()
    assert (profile.speed, profile.acceleration) == pytest.approx((20.0, 100.0), rel=0.01)
    expected = MotionProfile(profile.speed, profile.acceleration).duration_s(on(homed, 100.0))
    started = CLOCK.monotonic()
    homed.start_move(on(homed, 110.0))
    CLOCK.sleep(0.9 * expected)
    moving_before = homed.state().moving or CLOCK.monotonic() - started > expected  # a busy computer may have overslept
    wait_until_idle(homed, 0.0, timeout_s=30, clock=CLOCK)
    assert moving_before
    assert CLOCK.monotonic() - started >= expected


def test_waiting_too_long_stops_it(homed: Stage) -> None:
    go(homed, on(homed, 10.0))
    homed.start_move(on(homed, 350.0))
    with pytest.raises(MoveTimeout):
        wait_until_idle(homed, 0.0, timeout_s=0.5, clock=CLOCK)
    wait_until_idle(homed, 0.0, timeout_s=10, clock=CLOCK)
    assert homed.state().position < on(homed, 349.0)


def test_without_a_reference_it_will_not_move(unhomed: Stage) -> None:
    before = unhomed.state()
    assert not before.homed
    with pytest.raises(NotHomed):
        unhomed.start_move(on(unhomed, 10.0))
    after = unhomed.state()
    assert not after.moving
    assert after.position == pytest.approx(before.position, abs=0.001)


def test_the_next_program_finds_the_reference_or_is_told_of_it(homed: Stage, world: Running, request: pytest.FixtureRequest) -> None:
    go(homed, on(homed, 30.0))
    model = request.node.callspec.params["stage"]
    with opened(world, model, STAGES[model], "next") as next_one:
        assert isinstance(next_one, Stage)
        next_one.set_profile(speed=SWIFT.speed, acceleration=SWIFT.acceleration)
        if isinstance(next_one, ForgetfulStage):
            assert not next_one.state().homed
            with pytest.raises(NotHomed):
                next_one.start_move(on(next_one, 40.0))
            next_one.trust_reference()
        assert next_one.state().homed
        assert next_one.state().position == pytest.approx(on(next_one, 30.0), abs=0.001)
        go(next_one, on(next_one, 40.0))
        next_one.check_arrival(on(next_one, 40.0), 0.001)


# what another program does --------------------------------------------------------------------------------------------


def leave_on_its_way(world: Running, model: str) -> None:
    """Start a long and slow motion as another program does, and cut its link."""
    with opened(world, model, STAGES[model], "mover") as mover:
        assert isinstance(mover, Stage)
        mover.set_profile(speed=on(mover, 2.0), acceleration=on(mover, 20.0))
        if isinstance(mover, ForgetfulStage):
            mover.trust_reference()
        mover.start_move(on(mover, 300.0))


def require_stopped(stage: Stage) -> None:
    state = wait_until_idle(stage, 0.0, timeout_s=20, clock=CLOCK)
    assert on(stage, 9.0) < state.position < on(stage, 295.0)


def test_it_is_opened_asked_and_stopped_by_another_program_while_it_moves(
    homed: Stage, world: Running, request: pytest.FixtureRequest
) -> None:
    model = request.node.callspec.params["stage"]
    go(homed, on(homed, 10.0))
    leave_on_its_way(world, model)
    with opened(world, model, STAGES[model], "other") as other:
        assert isinstance(other, Stage)
        assert other.state().moving
        assert other.identify() == homed.identify()
        assert other.profile().speed > 0
        assert other.limits() == homed.limits()
        assert other.state().moving
        other.stop()
        require_stopped(other)


@pytest.mark.parametrize(
    "trouble", [None, Fault("silence", 1), Fault("silence", 2), Fault("dropped-byte", 1), Fault("garbage", 1)], ids=str
)
def test_it_is_halted_though_nobody_has_opened_it(
    homed: Stage, world: Running, request: pytest.FixtureRequest, trouble: Fault | None
) -> None:
    """One acknowledgement may be missing or wrong, or one stop be lost."""
    model = request.node.callspec.params["stage"]
    instrument, options, line = STAGES[model]
    go(homed, on(homed, 10.0))
    leave_on_its_way(world, model)
    found = catalogue.load().lookup(model)
    assert found.halt is not None
    struck = len(world.struck(instrument))
    with found.open_link(world.url(instrument), timeout_s=0.4, **line) as link:
        if trouble is not None:
            world.inject(instrument, trouble)
        found.halt_device(link, name="axis", **options)
        assert len(world.struck(instrument)) == struck + (trouble is not None)
    require_stopped(homed)
