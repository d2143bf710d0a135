"""Plans of bluesky's own, and ours, over our devices; and what a pause does to a run."""

import contextlib
import io
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bluesky.plans as bp
import numpy as np
import pytest
from bluesky.run_engine import RunEngine
from bluesky.simulators import check_limits

from drivers.errors import DeviceFault
from rig.bench import Bench
from rig.config import BenchConfig
from rig.engine import run_plan
from rig.errors import InterlockError, Interrupted
from rig.interrupts import Interrupts
from rig.journal import JournalWriter, read_documents
from rig.measuring import measure, new_order
from rig.plans import sweep
from rig.runs import begin_run
from rig.status import Status, StatusTimeout
from rig.trajectory import Trajectory
from rig.workspace import Workspace


@pytest.fixture
def engine():
    with contextlib.redirect_stdout(io.StringIO()):
        engine = RunEngine({}, context_managers=[])
    yield engine
    engine.loop.call_soon_threadsafe(engine.loop.stop)
    engine._th.join(5)
    engine.loop.close()


def never(interrupts: Interrupts) -> bool:
    raise AssertionError("nobody was to be asked")


def test_a_plain_bluesky_scan_works(bench: Bench, engine: RunEngine, tmp_path: Path) -> None:
    with contextlib.closing(JournalWriter(tmp_path / "journal.jsonl")) as journal:
        engine(bp.scan([bench.meter], bench.axes["detector"], -70, 40, 12), lambda name, doc: journal(name, doc))
    events = [doc["data"] for name, doc in read_documents(tmp_path / "journal.jsonl") if name == "event"]
    assert [event["theta_r"] for event in events] == pytest.approx(list(np.linspace(-70, 40, 12)), abs=0.001)
    assert all(event["current"] > 0 for event in events)


def test_bluesky_checks_our_limits_without_moving(bench: Bench, engine: RunEngine) -> None:
    with pytest.raises(InterlockError):
        check_limits(bp.scan([bench.meter], bench.axes["detector"], 0, 100, 3))


def test_our_sweep_stores_readback_of_all_axes_at_each_point(bench: Bench, tmp_path: Path) -> None:
    run = run_sweep(bench, tmp_path, Trajectory((30.0, 45.0), (-20.0, 0.0, 20.0), repeat=2))
    assert [name for name, _ in run] == ["start", "descriptor", *["event"] * 12, "stop"]
    data = [doc["data"] for name, doc in run if name == "event"]
    asked = [(event["theta_i_setpoint"], event["theta_r_setpoint"]) for event in data]
    assert asked == [(30, v) for v in (-20, -20, 0, 0, 20, 20)] + [(45, v) for v in (20, 20, 0, 0, -20, -20)]
    for event in data:
        assert event["theta_i"] == pytest.approx(event["theta_i_setpoint"], abs=0.001)
        assert event["theta_r"] == pytest.approx(event["theta_r_setpoint"], abs=0.001)
    descriptor = run[1][1]
    assert descriptor["configuration"]["detector"]["data"]["detector_vendor"] == "Zaber"
    assert descriptor["data_keys"]["theta_r"]["units"] == "degree"
    assert run[-1][1]["exit_status"] == "success"


def run_sweep(bench: Bench, folder: Path, trajectory: Trajectory, *, ask: bool = False, decide=never, watch=None) -> list[tuple[str, dict]]:
    path = folder / "journal.jsonl"
    with (
        Interrupts(bench.halt, bench.release, ask=ask) as interrupts,
        contextlib.closing(JournalWriter(path, abort_reason=lambda: interrupts.reason)) as journal,
    ):
        plan = sweep(bench, trajectory, {"cultivar": "RR"})
        callbacks = [journal, *([watch] if watch else [])]
        try:
            run_plan(plan, interrupts, callbacks, decide)
        except Interrupted:
            pass
    return list(read_documents(path))


def interrupt_at(event: int, signal_number: int):
    """Send ourselves a signal once reading number `event` has been stored."""
    import os

    seen = 0

    def watch(name: str, doc: dict) -> None:
        nonlocal seen
        if name == "event":
            seen += 1
            if seen == event:
                os.kill(os.getpid(), signal_number)

    return watch


def test_a_pause_and_going_on_leaves_a_complete_run(bench: Bench, tmp_path: Path) -> None:
    asked: list[float] = []

    def go_on(interrupts: Interrupts) -> bool:
        detector = bench.axes["detector"].driver
        while detector.state().moving:  # it was told to stop, and slows down
            pass
        asked.append(detector.state().position)
        return True

    views = tuple(float(v) for v in range(-60, 31, 10))
    run = run_sweep(bench, tmp_path, Trajectory((45.0,), views), ask=True, decide=go_on, watch=interrupt_at(4, signal.SIGINT))
    assert len(asked) == 1
    events = [doc for name, doc in run if name == "event"]
    assert [event["data"]["theta_r_setpoint"] for event in events] == list(views)
    assert [event["data"]["theta_r"] for event in events] == pytest.approx(views, abs=0.001)
    assert [event["seq_num"] for event in events] == list(range(1, 11))
    assert run[-1][1]["exit_status"] == "success"


def test_a_silent_wire_holds_up_neither_the_pause_nor_the_brake(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The source's wire is dead: its stop is not acknowledged for seconds. Meanwhile nothing else may begin, nor be read."""
    dead = threading.Event()
    stop = bench.axes["source"].driver.stop

    def unacknowledged() -> None:
        if threading.current_thread().name.startswith("stop"):
            dead.wait(20)
        stop()

    monkeypatch.setattr(bench.axes["source"].driver, "stop", unacknowledged)
    paused_while_dead: list[bool] = []

    def abort(interrupts: Interrupts) -> bool:
        paused_while_dead.append(not dead.is_set() and not interrupts.halted.is_set())
        held = [bench.axes["detector"].set(-70.0), bench.meter.trigger()]
        assert not any(status.done for status in held)
        dead.set()
        interrupts.halted.wait(20)
        return False

    views = tuple(float(v) for v in range(-60, 31, 10))
    try:
        run = run_sweep(bench, tmp_path, Trajectory((45.0,), views), ask=True, decide=abort, watch=interrupt_at(4, signal.SIGINT))
    finally:
        dead.set()
        bench.release()
    assert paused_while_dead == [True]
    for event in (doc["data"] for name, doc in run if name == "event"):
        assert event["theta_r"] == pytest.approx(event["theta_r_setpoint"], abs=0.001)


def test_what_is_held_back_begins_again_when_released(bench: Bench) -> None:
    assert bench.halt() == []
    move, reading = bench.axes["detector"].set(-30.0), bench.meter.trigger()
    assert not move.done
    assert not reading.done
    assert bench.axes["detector"].position == pytest.approx(0.0, abs=0.02)
    bench.release()
    assert move.success
    assert reading.success
    bench.axes["detector"].set(-30.0).wait(10)
    assert bench.axes["detector"].position == pytest.approx(-30.0, abs=0.02)


def test_an_arm_is_not_moved_while_nobody_knows_where_the_other_is(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.axes["source"], "_homed", False)
    with pytest.raises(InterlockError, match="source has no reference"):
        bench.axes["detector"].set(-30.0)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_an_abort_keeps_what_was_measured_and_says_why(bench: Bench, tmp_path: Path, name: str) -> None:
    views = tuple(float(v) for v in range(-60, 31, 10))
    run = run_sweep(bench, tmp_path, Trajectory((45.0,), views), watch=interrupt_at(4, signal.Signals[name]))
    assert 4 <= sum(kind == "event" for kind, _ in run) < 10
    assert run[-1][0] == "stop"
    assert run[-1][1]["exit_status"] == "abort"
    assert run[-1][1]["reason"] == f"interrupted by {name}"
    assert not any(axis.driver.state().moving for axis in bench.axes.values())


def test_a_fault_ends_the_run_as_failed_with_its_name(bench: Bench, tmp_path: Path) -> None:
    def knock(name: str, doc: dict) -> None:
        # An arm is stopped by hand as soon as it moves.
        if name == "event" and doc["seq_num"] == 2:

            def hand() -> None:
                while not bench.axes["detector"].driver.state().moving:
                    pass
                bench.axes["detector"].driver.stop()

            threading.Thread(target=hand).start()

    with pytest.raises(DeviceFault):
        run_sweep(bench, tmp_path, Trajectory((45.0,), (-60.0, -30.0, 30.0)), watch=knock)
    run = list(read_documents(tmp_path / "journal.jsonl"))
    assert sum(kind == "event" for kind, _ in run) == 2
    assert run[-1][1]["exit_status"] == "fail"
    assert "detector" in run[-1][1]["reason"]


def test_a_journal_that_cannot_be_written_ends_the_run(bench: Bench) -> None:
    from rig.errors import RunError

    class Full:
        def __call__(self, name: str, doc: dict) -> None:
            if name == "event":
                raise RunError("journal.jsonl: the journal cannot be written: No space left on device")

    with Interrupts(bench.halt, bench.release, ask=False) as interrupts, pytest.raises(RunError, match="No space left"):
        run_plan(sweep(bench, Trajectory((45.0,), (0.0, 10.0)), {"cultivar": "RR"}), interrupts, [Full()], never)


def test_a_signal_puts_the_brake_on_in_a_sweep_as_it_is_run(bench_config: BenchConfig, tmp_path: Path) -> None:
    """Through `measure` itself: what a plan would begin after the signal is held back until somebody has decided."""
    interrupt = interrupt_at(2, signal.SIGINT)

    class Watcher:
        ask = True
        held: list[Status]

        def opened(self, bench: Bench) -> None:
            self.bench = bench

        def document(self, name: str, doc: Mapping[str, Any]) -> None:
            interrupt(name, dict(doc))

        def decide(self, interrupts: Interrupts) -> bool:
            interrupts.halted.wait(20)
            self.held = [self.bench.meter.trigger(), self.bench.axes["detector"].set(-70.0)]
            with pytest.raises(StatusTimeout):  # a reading takes a hundredth of that here
                self.held[0].exception(0.3)
            return False

    watcher = Watcher()
    order = new_order(bench_config, "RR", Trajectory((45.0,), (-60.0, -30.0, 0.0, 30.0)))
    begin_run(tmp_path / "run", bench_config.text)
    with pytest.raises(Interrupted):
        measure(order, tmp_path / "run", watcher, Workspace(tmp_path))
    assert len(watcher.held) == 2
