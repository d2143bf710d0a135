"""The devices as bluesky sees them, over the simulated instruments' wires."""

import threading
from collections.abc import Callable

import pytest
from bluesky import protocols

from drivers.errors import DeviceFault
from rig.bench import Bench
from rig.errors import InterlockError
from rig.status import Status


def test_they_are_what_bluesky_asks_for(bench: Bench) -> None:
    for axis in bench.axes.values():
        for protocol in (
            protocols.Readable,
            protocols.Movable,
            protocols.Stoppable,
            protocols.Locatable,
            protocols.Checkable,
            protocols.Configurable,
            protocols.HasHints,
        ):
            assert isinstance(axis, protocol), f"{axis.name} is no {protocol.__name__}"
    for protocol in (protocols.Readable, protocols.Triggerable, protocols.Configurable, protocols.HasHints):
        assert isinstance(bench.meter, protocol)
    assert isinstance(Status(), protocols.Status)


def test_reading_and_describing_speak_of_the_same_keys(bench: Bench) -> None:
    bench.meter.trigger().wait(10)
    for device in (*bench.axes.values(), bench.meter, bench.axes["source"].homing):
        assert set(device.read()) == set(device.describe())
        assert set(device.read_configuration()) == set(device.describe_configuration())
        assert not any("." in key or "/" in key for key in device.read())


def test_a_move_arrives(bench: Bench) -> None:
    detector = bench.axes["detector"]
    detector.set(-37.5).wait(10)
    assert detector.locate() == {"setpoint": -37.5, "readback": pytest.approx(-37.5, abs=0.001)}
    assert detector.read()["theta_r"]["value"] == pytest.approx(-37.5, abs=0.001)


def test_both_axes_of_one_port_move_at_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []

    def noted(start: Callable[[float], None]) -> Callable[[float], None]:
        def begin(position: float) -> None:
            start(position)
            order.append("started")

        return begin

    for axis in bench.axes.values():
        monkeypatch.setattr(axis.driver, "start_move", noted(axis.driver.start_move))
    moves = [axis.set(theta) for axis, theta in zip(bench.axes.values(), (10.0, -80.0), strict=True)]
    for move in moves:
        move.add_callback(lambda _: order.append("done"))
    for move in moves:
        move.wait(10)
    assert order == ["started", "started", "done", "done"]


@pytest.mark.parametrize(
    ("axis", "theta"),
    [("detector", 86.0), ("detector", -85.01), ("source", -1.0), ("detector", 44.0), ("detector", float("nan")), ("detector", "10")],
)
def test_what_is_not_allowed_is_refused_before_anything_moves(bench: Bench, axis: str, theta: float) -> None:
    before = bench.axes[axis].driver.state()
    with pytest.raises(InterlockError):
        bench.axes[axis].check_value(theta)
    with pytest.raises((InterlockError, ValueError)):
        bench.axes[axis].set(theta)
    after = bench.axes[axis].driver.state()
    assert (after.position, after.moving) == (before.position, False)


def test_a_stop_that_was_asked_for_ends_the_move_well_and_short(bench: Bench) -> None:
    detector = bench.axes["detector"]
    detector.set(-80.0).wait(10)
    move = detector.set(40.0)
    started = threading.Event()
    while not started.is_set():
        if detector.driver.state().moving:
            started.set()
    detector.stop()
    move.wait(10)
    assert move.success
    assert not detector.driver.state().moving
    assert detector.position < 39.0


def test_a_stop_that_nobody_asked_for_fails_the_move(bench: Bench) -> None:
    detector = bench.axes["detector"]
    detector.set(-80.0).wait(10)
    move = detector.set(40.0)
    while not detector.driver.state().moving:
        pass
    detector.driver.stop()  # as from the front panel: not through the axis
    assert isinstance(move.exception(10), DeviceFault)


def test_a_stopped_move_ends_well_though_the_next_has_begun(bench: Bench) -> None:
    detector = bench.axes["detector"]
    detector.set(-80.0).wait(10)
    first = detector.set(40.0)
    while not detector.driver.state().moving:
        pass
    gate = threading.Event()
    detector._bus.call(lambda: gate.wait(10))  # the bus is busy elsewhere while the arm comes to rest
    detector.stop()
    while detector.driver.state().moving:
        pass
    second = detector.set(-70.0)
    gate.set()
    assert first.exception(10) is None
    second.wait(10)
    assert detector.position == pytest.approx(-70.0, abs=0.01)


def test_set_returns_at_once(bench: Bench) -> None:
    assert not bench.axes["detector"].set(-60.0).done
    bench.axes["detector"].stop()


def test_the_meter_reads_the_light(bench: Bench) -> None:
    bench.meter.trigger().wait(10)
    reading = bench.meter.read()
    assert reading["current_good"]["value"] == 1
    assert 1e-9 < reading["current"]["value"] < 1e-6
    assert bench.meter.describe()["current"]["units"] == "A"
