"""The promise a device gives when it starts something that takes time."""

import logging
import threading
from collections.abc import Callable
from typing import Any


class StatusTimeout(TimeoutError):
    """Waited for a status that was not done in time."""


class Status:
    """Completes exactly once, with success or with an exception; safe from any thread.

    Follows `bluesky.protocols.Status` without importing it.
    """

    def __init__(self) -> None:
        self._done = threading.Event()
        self._lock = threading.Lock()
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Status], Any]] = []

    def __repr__(self) -> str:
        # The engine gives this as the reason why a run failed.
        return f"<Status: {self._exception or 'done'}>" if self.done else "<Status: under way>"

    @property
    def done(self) -> bool:
        """True once the work has ended, well or badly."""
        return self._done.is_set()

    @property
    def success(self) -> bool:
        """True once the work has ended well."""
        return self.done and self._exception is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """Return what went wrong, or None; wait up to `timeout` seconds for the end.

        Raises
        ------
        StatusTimeout
            Where the work has not ended by then.
        """
        if not self._done.wait(timeout):
            raise StatusTimeout(f"not done after {timeout} s")
        return self._exception

    def wait(self, timeout: float | None = None) -> None:
        """Block until done; raise what went wrong."""
        exception = self.exception(timeout)
        if exception is not None:
            raise exception

    def add_callback(self, callback: Callable[["Status"], Any]) -> None:
        """Call `callback(self)` when done, at once if done already."""
        with self._lock:
            if not self.done:
                self._callbacks.append(callback)
                return
        callback(self)

    def finish(self, exception: BaseException | None = None) -> bool:
        """Complete; the first call decides. Return whether this one did."""
        with self._lock:
            if self.done:
                return False
            self._exception = exception
            callbacks, self._callbacks = self._callbacks, []
            self._done.set()
        for callback in callbacks:
            # A listener that has gone (an engine whose loop is closed) must not stop the others, nor the bus that finished this.
            try:
                callback(self)
            except Exception:
                logging.getLogger(__name__).debug("a listener failed", exc_info=True)
        return True
