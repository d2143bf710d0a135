"""Simulated time: the real clock run faster, and a clock advanced by hand."""

from __future__ import annotations

import asyncio
import heapq
import itertools
import time
from typing import Protocol

from sim.errors import SimError


class Clock(Protocol):
    """Simulated seconds, zero when the world was made."""

    def now(self) -> float:
        """Return the simulated time, s."""

    async def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of simulated time; zero or less only lets others run."""

    async def sleep_until(self, t: float) -> None:
        """Wait until the simulated time is `t` or later."""


class SimClock:
    """The real monotonic clock times `speed`.

    Parameters
    ----------
    speed : float
        Simulated seconds per real second, above zero.

    Raises
    ------
    SimError
        The speed is not a positive finite number.
    """

    # Event loops sleep in whole milliseconds. In fast time that is long: the last of it is spent asking again and again.
    _TICK = 1.1e-3
    _FAST = 5.0

    def __init__(self, speed: float = 1.0) -> None:
        if not 0 < speed < float("inf"):
            raise SimError(f"clock speed {speed!r}: expected a positive number of simulated seconds per real second")
        self.speed = speed
        self._origin = time.perf_counter()

    def now(self) -> float:
        """Return the simulated time, s."""
        return (time.perf_counter() - self._origin) * self.speed

    async def sleep(self, seconds: float) -> None:
        """Wait for `seconds` of simulated time."""
        await self.sleep_until(self.now() + seconds)

    async def sleep_until(self, t: float) -> None:
        """Wait until the simulated time is `t` or later."""
        await asyncio.sleep(0)
        while (left := (t - self.now()) / self.speed) > 0:
            if self.speed < self._FAST:
                await asyncio.sleep(left)
            else:
                await asyncio.sleep(max(0.0, left - self._TICK))


class ManualClock:
    """A clock that moves only when told to; for tests, inside one event loop.

    Parameters
    ----------
    eager : bool
        Whoever sleeps moves the clock on at once, so that nobody has to advance it; for one sleeper at a time.
    """

    def __init__(self, eager: bool = False) -> None:
        self._now = 0.0
        self._eager = eager
        self._sleepers: list[tuple[float, int, asyncio.Future[None]]] = []
        self._order = itertools.count()

    def now(self) -> float:
        """Return the simulated time, s."""
        return self._now

    async def sleep(self, seconds: float) -> None:
        """Wait until somebody has advanced the clock by `seconds`."""
        await self.sleep_until(self._now + seconds)

    async def sleep_until(self, t: float) -> None:
        """Wait until somebody has advanced the clock to `t`."""
        if self._eager:
            self._now = max(self._now, t)
        if t <= self._now:
            await asyncio.sleep(0)
            return
        woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (t, next(self._order), woken))
        await woken

    def set(self, now: float) -> None:
        """Jump forward to `now` (s) without waking anybody on the way; for code that runs in no event loop."""
        if now < self._now:
            raise SimError(f"manual clock stands at {self._now} s and cannot go back to {now} s")
        self._now = now

    async def advance(self, seconds: float) -> None:
        """Move on by `seconds`, waking each sleeper at its own time, in order."""
        until = self._now + seconds
        await self._let_others_run()
        while self._sleepers and self._sleepers[0][0] <= until:
            due, _, woken = heapq.heappop(self._sleepers)
            self._now = due
            if not woken.done():
                woken.set_result(None)
            await self._let_others_run()
        self._now = until

    @staticmethod
    async def _let_others_run() -> None:
        # A woken task may wake others before it sleeps again: a handful of turns of the loop covers such chains.
        for _ in range(10):
            await asyncio.sleep(0)
