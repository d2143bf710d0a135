"""Waiting for rest, on a clock that the test turns."""

from __future__ import annotations

import pytest

from drivers.errors import MoveTimeout, PortClosed, TransportTimeout
from drivers.kinds import AxisState, Identity, MotionProfile, Stage
from drivers.motion import wait_until_idle


class Clock:
    """Time passes only by sleeping."""

    def __init__(self) -> None:
        self.now = 100.0
        self.sleeps: list[float] = []

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float, /) -> None:
        self.sleeps.append(seconds)
        self.now += seconds


class Axis:
    """Arrives at a time of its own."""

    name = "theta_r"
    unit = "deg"

    def __init__(self, clock: Clock, arrives_s: float) -> None:
        self.clock = clock
        self.arrives = clock.now + arrives_s
        self.stops = 0
        self.polls: list[float] = []
        self.trouble: BaseException | None = None
        self.stop_trouble: Exception | None = None

    def state(self) -> AxisState:
        self.polls.append(self.clock.now)
        if self.trouble is not None:
            raise self.trouble
        return AxisState(12.0, moving=self.clock.now < self.arrives, homed=True)

    def stop(self) -> None:
        self.stops += 1
        if self.stop_trouble is not None:
            raise self.stop_trouble

    def identify(self) -> Identity:
        return Identity("", "", "", "")

    def limits(self) -> tuple[float, float]:
        return 0.0, 360.0

    def profile(self) -> MotionProfile:
        return MotionProfile(1, 1)

    def set_profile(self, speed: float | None = None, acceleration: float | None = None) -> None: ...

    def start_home(self) -> None: ...

    def start_move(self, deg: float) -> None: ...

    def check_arrival(self, deg: float, tolerance: float) -> None: ...

    def close(self) -> None: ...


def test_one_poll_when_the_prediction_holds() -> None:
    clock = Clock()
    axis = Axis(clock, 3.0)
    assert isinstance(axis, Stage)
    state = wait_until_idle(axis, 3.0, timeout_s=5, clock=clock)
    assert not state.moving
    assert axis.polls == [103.0]
    assert axis.stops == 0


def test_polls_every_5_ms_when_late() -> None:
    clock = Clock()
    axis = Axis(clock, 3.0221)
    wait_until_idle(axis, 3.0, timeout_s=5, clock=clock)
    gaps = [later - sooner for sooner, later in zip(axis.polls, axis.polls[1:], strict=False)]
    assert len(gaps) == 5
    assert max(gaps) <= 0.005 + 1e-9


def test_gives_up_and_stops_the_axis() -> None:
    clock = Clock()
    axis = Axis(clock, 1e9)
    with pytest.raises(MoveTimeout, match="theta_r: waiting for the end of the motion: still moving at 12") as caught:
        wait_until_idle(axis, 1.0, timeout_s=1.5, clock=clock)
    assert axis.stops == 1
    assert clock.now - 100 == pytest.approx(1.5, abs=0.006)
    assert caught.value.elapsed_s == pytest.approx(1.5, abs=0.006)


@pytest.mark.parametrize("trouble", [TransportTimeout("no reply"), KeyboardInterrupt()])
def test_whatever_ends_the_wait_stops_the_axis(trouble: BaseException) -> None:
    clock = Clock()
    axis = Axis(clock, 3.0)
    axis.trouble = trouble
    with pytest.raises(type(trouble)):
        wait_until_idle(axis, 1.0, timeout_s=5, clock=clock)
    assert axis.stops == 1


def test_an_axis_that_could_not_be_stopped_is_said_so() -> None:
    clock = Clock()
    axis = Axis(clock, 1e9)
    axis.stop_trouble = PortClosed("the port is gone")
    with pytest.raises(MoveTimeout, match=r"COULD NOT BE STOPPED.*the port is gone"):
        wait_until_idle(axis, 1.0, timeout_s=1.5, clock=clock)


def test_never_sleeps_beyond_the_time_allowed() -> None:
    clock = Clock()
    with pytest.raises(MoveTimeout):
        wait_until_idle(Axis(clock, 1e9), 60.0, timeout_s=2.0, clock=clock)
    assert clock.now - 100 == pytest.approx(2.0)
