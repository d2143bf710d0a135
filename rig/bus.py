"""One worker thread per port: it owns the traffic of every device on that port."""

import heapq
import itertools
import threading
from collections.abc import Callable, Generator
from typing import Any

from rig.clock import Clock
from rig.status import Status

Task = Generator[float, None, None]
"""Work on a bus: does one transaction at a time and yields how many bench seconds to wait before the next."""


class BusWorker:
    """Runs tasks side by side, holding the port only for one transaction at a time.

    Two axes on one chain move at once because each task yields while its own axis travels.

    Parameters
    ----------
    name : str
        Names the thread.
    clock : Clock
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self._clock = clock
        self._ready = threading.Condition()
        self._queue: list[tuple[float, int, Task, Status]] = []
        self._count = itertools.count()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"bus-{name}", daemon=True)
        self._thread.start()

    def start(self, task: Task) -> Status:
        """Begin `task` as soon as the port is free; the status ends as the task does."""
        status = Status()
        with self._ready:
            if self._closed:
                raise RuntimeError("the bus is closed")
            heapq.heappush(self._queue, (self._clock.monotonic(), next(self._count), task, status))
            self._ready.notify()
        return status

    def call(self, function: Callable[[], Any]) -> Status:
        """Run one blocking `function` on the worker."""

        def task() -> Task:
            function()
            yield from ()

        return self.start(task())

    def close(self) -> None:
        """End the thread; what still waits fails."""
        with self._ready:
            self._closed = True
            self._ready.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while (item := self._next()) is not None:
            _, _, task, status = item
            try:
                delay = next(task)
            except StopIteration:
                status.finish()
            except BaseException as exc:
                status.finish(exc)
            else:
                with self._ready:
                    heapq.heappush(self._queue, (self._clock.monotonic() + delay, next(self._count), task, status))

    def _next(self) -> tuple[float, int, Task, Status] | None:
        with self._ready:
            while not self._closed:
                if not self._queue:
                    self._ready.wait()
                    continue
                wait = (self._queue[0][0] - self._clock.monotonic()) / self._clock.speed
                if wait <= 0:
                    return heapq.heappop(self._queue)
                self._ready.wait(wait)
            pending, self._queue = self._queue, []
        for _, _, task, status in pending:
            task.close()
            status.finish(ConnectionError("the bench was closed while this was under way"))
        return None
