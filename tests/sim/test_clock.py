"""Simulated time."""

from __future__ import annotations

import asyncio
import time

import pytest

from sim.clock import ManualClock, SimClock
from sim.errors import SimError


def test_sim_clock_runs_at_its_speed() -> None:
    clock = SimClock(speed=1000)
    before, begin = time.perf_counter(), clock.now()
    while clock.now() - begin < 20:
        pass
    end, after = clock.now(), time.perf_counter()
    assert end - begin <= 1000 * (after - before)
    assert end - begin == pytest.approx(1000 * (after - before), rel=0.05)


def test_sleep_until_never_wakes_early() -> None:
    async def late() -> list[float]:
        clock = SimClock(speed=500)
        lateness = []
        for _ in range(20):
            due = clock.now() + 0.37
            await clock.sleep_until(due)
            lateness.append(clock.now() - due)
        return lateness

    assert min(asyncio.run(late())) >= 0


@pytest.mark.parametrize("speed", [0.0, -1.0, float("inf"), float("nan")])
def test_sim_clock_refuses_impossible_speeds(speed: float) -> None:
    with pytest.raises(SimError, match="clock speed"):
        SimClock(speed)


def test_manual_clock_wakes_sleepers_in_order_at_their_own_times() -> None:
    async def wakings() -> list[tuple[str, float]]:
        clock, seen = ManualClock(), []

        async def sleeper(name: str, *naps: float) -> None:
            for nap in naps:
                await clock.sleep(nap)
                seen.append((name, clock.now()))

        tasks = [asyncio.create_task(sleeper("a", 3.0)), asyncio.create_task(sleeper("b", 1.0, 1.0, 5.0))]
        await clock.advance(4.0)
        assert clock.now() == 4.0
        assert not tasks[1].done()
        await clock.advance(3.0)
        await asyncio.gather(*tasks)
        return seen

    assert asyncio.run(wakings()) == [("b", 1.0), ("b", 2.0), ("a", 3.0), ("b", 7.0)]


def test_manual_clock_does_not_go_back() -> None:
    clock = ManualClock()
    clock.set(2.0)
    with pytest.raises(SimError, match="cannot go back"):
        clock.set(1.0)
