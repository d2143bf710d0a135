import threading

import pytest

from rig.bus import BusWorker
from rig.clock import Clock
from rig.status import Status, StatusTimeout


def test_a_status_ends_once_and_tells_everybody() -> None:
    status = Status()
    heard: list[bool] = []
    status.add_callback(lambda s: heard.append(s.success))
    assert not status.done
    assert status.finish()
    assert not status.finish(ValueError("too late"))
    status.add_callback(lambda s: heard.append(s.success))
    assert heard == [True, True]
    assert status.exception() is None


def test_a_failed_status_says_why() -> None:
    status = Status()
    status.finish(ValueError("stalled"))
    assert (status.done, status.success) == (True, False)
    with pytest.raises(ValueError, match="stalled"):
        status.wait(1)


def test_waiting_for_what_never_ends_times_out() -> None:
    with pytest.raises(StatusTimeout):
        Status().exception(0.0)


@pytest.fixture
def worker():
    worker = BusWorker("test", Clock())
    yield worker
    worker.close()


def test_tasks_take_turns(worker: BusWorker) -> None:
    order: list[str] = []

    def task(name: str):
        for step in range(3):
            order.append(f"{name}{step}")
            yield 0.005

    statuses = [worker.start(task("a")), worker.start(task("b"))]
    for status in statuses:
        status.wait(5)
    assert order == ["a0", "b0", "a1", "b1", "a2", "b2"]


def test_a_task_that_fails_fails_its_status_only(worker: BusWorker) -> None:
    def bad():
        yield 0.0
        raise ValueError("no")

    failed, fine = worker.start(bad()), worker.call(lambda: None)
    fine.wait(5)
    assert isinstance(failed.exception(5), ValueError)


def test_closing_fails_what_still_waits() -> None:
    worker = BusWorker("test", Clock())
    started = threading.Event()

    def endless():
        while True:
            started.set()
            yield 60.0

    status = worker.start(endless())
    started.wait(5)
    worker.close()
    assert isinstance(status.exception(5), ConnectionError)
