"""The devices as bluesky sees them, over the simulated instruments' wires."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from bluesky import protocols

from drivers.errors import DeviceFault, TransportTimeout
from rig.axisrecord import AxisRecords
from rig.bench import Bench, Paperwork, open_bench
from rig.errors import InterlockError, RigError
from rig.status import Status
from tests.rig.scripted import ScriptedBench, ScriptedStage, moves, rest, scripted_bench


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


# Opening, stopping and leaving a bench whose instruments are scripted


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> ScriptedBench:
    return scripted_bench(monkeypatch)


AXES = ("source", "detector", "tilt")


def be_silent() -> None:
    raise TransportTimeout("no reply", device="silent one")


def test_by_default_the_arms_and_what_a_sweep_reads_are_opened(scripted: ScriptedBench) -> None:
    with open_bench(scripted.config, "RR") as bench:
        assert list(bench.axes) == ["source", "detector"]
        assert list(bench.sensors) == ["sensor", "lamp"]
        assert [monitor.name for monitor in bench.monitors] == ["lamp"]
        assert bench.meter.name == "current"
    assert scripted.opened == ["four", "five", "one", "two"]
    assert sorted(scripted.closed) == sorted(scripted.opened)
    assert sorted(scripted.connected) == ["detector", "lamp", "sensor", "source"]


@pytest.mark.parametrize(
    ("axes", "sensors", "ports"), [(["tilt"], [], ["three"]), ([], ["other"], ["six"]), (AXES, ["sensor"], ["four", "one", "two", "three"])]
)
def test_what_is_asked_for_is_opened_and_nothing_else(
    scripted: ScriptedBench, axes: list[str], sensors: list[str], ports: list[str]
) -> None:
    with open_bench(scripted.config, "RR", axes=axes, sensors=sensors) as bench:
        assert list(bench.axes) == list(axes)
        assert list(bench.sensors) == sensors
        assert scripted.opened == ports
        assert set(scripted.connected) == {*axes, *sensors}
        assert bench.stop() == []
    assert sorted(scripted.closed) == sorted(ports)


@pytest.mark.parametrize("blocked", AXES)
def test_a_stop_waits_for_no_other_axis(scripted: ScriptedBench, blocked: str) -> None:
    others = {name: threading.Event() for name in AXES if name != blocked}
    late: list[str] = []

    def wait_for_the_others() -> None:
        late.extend(name for name, stopped in others.items() if not stopped.wait(5))

    with open_bench(scripted.config, "RR", axes=AXES, sensors=[]) as bench:
        scripted.stages[blocked].on_stop = wait_for_the_others
        for name, stopped in others.items():
            scripted.stages[name].on_stop = stopped.set
        assert bench.stop() == []
    assert late == []


def test_a_stop_tells_what_could_not_be_stopped(scripted: ScriptedBench) -> None:
    with open_bench(scripted.config, "RR", axes=AXES, sensors=[]) as bench:
        scripted.stages["detector"].on_stop = be_silent
        (failure,) = bench.stop()
        assert isinstance(failure, TransportTimeout)
        scripted.stages["detector"].on_stop = lambda: None
    assert all(stage.told[-1] == ("stop", None) for stage in scripted.stages.values())


def test_a_bench_is_left_stopped_whatever_happens(scripted: ScriptedBench) -> None:
    with pytest.raises(ValueError, match="plan"), open_bench(scripted.config, "RR", axes=AXES, sensors=[]):
        raise ValueError("a plan that fails")
    assert [stage.told for stage in scripted.stages.values()] == [[("stop", None)]] * 3
    assert sorted(scripted.closed) == ["one", "three", "two"]


UNSTOPPED = "AND NOT EVERY AXIS COULD BE STOPPED, it may still be moving: .*silent one"


@pytest.mark.parametrize("hint", ["", "look at it"])
def test_an_error_says_that_an_axis_could_not_be_stopped(scripted: ScriptedBench, hint: str) -> None:
    scripted.stages["detector"].on_stop = be_silent
    with pytest.raises(DeviceFault, match=f"stalled; {hint}.*{UNSTOPPED}"), open_bench(scripted.config, "RR", sensors=[]):
        raise DeviceFault("stalled", hint=hint)
    with pytest.raises(KeyError) as caught, open_bench(scripted.config, "RR", sensors=[]):
        raise KeyError("ours")
    assert caught.value.__notes__[0].startswith("AND NOT EVERY AXIS")
    with pytest.raises(RigError, match=UNSTOPPED), open_bench(scripted.config, "RR", sensors=[]):
        pass  # all went well until the end
    assert sorted(scripted.closed) == sorted(scripted.opened)


def test_an_axis_that_fails_to_open_leaves_the_others_stopped(scripted: ScriptedBench) -> None:
    scripted.stages["detector"].on_look = be_silent
    with pytest.raises(TransportTimeout), open_bench(scripted.config, "RR", sensors=[]):
        raise AssertionError("it did not open")
    assert scripted.stages["source"].told == [("stop", None)]
    assert sorted(scripted.closed) == sorted(scripted.opened)


def test_where_a_motion_that_was_cut_off_came_to_rest_is_written_down(scripted: ScriptedBench, tmp_path: Path) -> None:
    def never_ends(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(12.0))

    records = AxisRecords(tmp_path / "axes.json")
    stage = scripted.stages["detector"]
    stage.starts = [never_ends]
    papers = Paperwork(records=records)

    def fail_on_the_way(bench: Bench) -> None:
        bench.axes["detector"].set(30.0)
        while not stage.state().moving:
            pass
        raise ValueError("a plan that fails")

    with pytest.raises(ValueError, match="plan"), open_bench(scripted.config, "RR", sensors=[], paperwork=papers) as bench:
        fail_on_the_way(bench)
    record = records.get("two scripted-stage")
    assert record is not None
    assert (record.setpoint, record.readback, record.under_way) == (30.0, 12.0, False)
    stage.see(rest(12.0))
    with open_bench(scripted.config, "RR", sensors=[], paperwork=papers) as bench:
        assert bench.notices == []
    stage.see(rest(20.0))
    with open_bench(scripted.config, "RR", sensors=[], paperwork=papers) as bench:
        assert len(bench.notices) == 1
