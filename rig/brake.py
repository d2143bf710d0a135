"""What keeps a stopped bench stopped until somebody lets it go on."""

import threading
from collections.abc import Callable

from rig.status import Status


class Brake:
    """Holds back motions and readings that would begin while it is on; safe from any thread.

    A plan does not know yet that a signal has come: it sees its move end, and would go on with a reading or the next move. Those get
    a status that ends, well, when the brake is released; the engine has gone back to its checkpoint by then and repeats them.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._on = False
        self._held: list[Status] = []

    def apply(self) -> None:
        """Let nothing begin from now on. What began before is known to whoever stops the axes afterwards."""
        with self._lock:
            self._on = True

    def release(self) -> None:
        """Let things begin again."""
        with self._lock:
            self._on = False
            held, self._held = self._held, []
        for status in held:
            status.finish()

    def pass_or_hold(self, begin: Callable[[], Status]) -> Status:
        """Begin, or hold it back where the brake is on."""
        with self._lock:
            if not self._on:
                return begin()
            status = Status()
            self._held.append(status)
            return status
