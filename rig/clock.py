"""Bench time: seconds as the instruments count them."""

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Clock:
    """Bench seconds from the computer's clock.

    A simulated bench may run `speed` times faster than time; everything that waits for a profile, for settling or for
    an integration waits in bench seconds. On a real bench `speed` is 1.
    """

    speed: float = 1.0

    def monotonic(self) -> float:
        """Return bench seconds since an arbitrary start."""
        return time.monotonic() * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` of bench time."""
        if seconds > 0:
            time.sleep(seconds / self.speed)
