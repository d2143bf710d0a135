"""Build the simulated bench and serve its instruments, in this process or in a thread beside it."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Future
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sim.bench import Bench, Lamp, Misalignment, specimen
from sim.clock import Clock, SimClock
from sim.keithley import Keithley6485, MeterModel
from sim.wire import Instrument, PtyPort, TcpPort
from sim.zaber import StageModel, ZaberChain

SOURCE, DETECTOR = 1, 2
"""Addresses of the two arms' stages in the chain."""


@dataclass(frozen=True)
class Settings:
    """What can be chosen about the simulated bench.

    Parameters
    ----------
    specimen : str
        Name of a virtual petal, or `lambert:ALBEDO`.
    seed : int
        Decides the angles at power-up, misalignments, drift, offset and noise.
    speed : float
        Simulated seconds per real second.
    stage, meter
        What the instruments are like.
    misalignment : Misalignment or None
        Of the arms; None draws it.
    pty : bool
        Serve on pseudo-terminals too.
    """

    specimen: str = "RR"
    seed: int = 1
    speed: float = 1.0
    stage: StageModel = field(default_factory=StageModel)
    meter: MeterModel = field(default_factory=MeterModel)
    misalignment: Misalignment | None = None
    pty: bool = True


@dataclass(frozen=True)
class World:
    """The bench and the instruments on it."""

    settings: Settings
    clock: Clock
    stages: ZaberChain
    meter: Keithley6485
    bench: Bench

    @property
    def instruments(self) -> tuple[Instrument, ...]:
        """Everything that has a port."""
        return self.stages, self.meter


def build(settings: Settings, clock: Clock | None = None) -> World:
    """Make the world of these settings; it starts at rest, unhomed, at simulated time zero.

    Raises
    ------
    SimError
        A setting makes no sense, or there is no such specimen.
    """
    clock = clock or SimClock(settings.speed)
    # One stream of random numbers per part: a change to one does not reshuffle the others.
    parked, aligned, lit, diode, meter = (np.random.default_rng(seed) for seed in np.random.SeedSequence(settings.seed).spawn(5))
    stage = settings.stage
    stages = ZaberChain(clock, [float(angle) for angle in parked.uniform(stage.limit_min, stage.limit_max, 2)], stage)
    bench = Bench(
        source=stages.axes[SOURCE - 1].track.mechanical,
        detector=stages.axes[DETECTOR - 1].track.mechanical,
        specimen=specimen(settings.specimen),
        rng=diode,
        lamp=Lamp.drawn(lit),
        misalignment=settings.misalignment or Misalignment.drawn(aligned),
    )
    return World(settings, clock, stages, Keithley6485(clock, bench.signal, meter, settings.meter), bench)


@asynccontextmanager
async def serving(world: World) -> AsyncIterator[dict[str, Any]]:
    """Open every instrument's ports and yield the report that tells where they are; close them at the end."""
    devices = []
    async with AsyncExitStack() as ports:
        for instrument in world.instruments:
            tcp = TcpPort(instrument)
            await tcp.open()
            ports.push_async_callback(tcp.close)
            device: dict[str, Any] = {"name": instrument.name, "model": instrument.model, "tcp": tcp.url}
            if world.settings.pty:
                pty = PtyPort(instrument)
                await pty.open()
                ports.push_async_callback(pty.close)
                device["pty"] = pty.path
            devices.append(device)
        yield {
            "simulated": True,
            "seed": world.settings.seed,
            "speed": world.settings.speed,
            "specimen": world.settings.specimen,
            "pid": os.getpid(),
            "devices": devices,
        }


@dataclass(frozen=True)
class Running:
    """Servers at work in another thread: where they are, and the world behind them, to look at only."""

    report: dict[str, Any]
    world: World

    def url(self, name: str) -> str:
        """Return the TCP URL of the instrument `name`."""
        return self._device(name)["tcp"]

    def pty(self, name: str) -> str:
        """Return the pseudo-terminal of the instrument `name`."""
        return self._device(name)["pty"]

    def _device(self, name: str) -> dict[str, str]:
        return next(device for device in self.report["devices"] if device["name"] == name)


@contextmanager
def in_background(settings: Settings) -> Iterator[Running]:
    """Serve the simulated bench from a thread of its own for the length of a `with` block.

    Raises
    ------
    SimError
        As `build`; whatever else keeps the servers from starting is raised here as well.
    """
    world = build(settings)
    started: Future[tuple[dict[str, Any], asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def main() -> None:
        stop = asyncio.Event()
        try:
            async with serving(world) as report:
                started.set_result((report, asyncio.get_running_loop(), stop))
                await stop.wait()
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    thread = threading.Thread(target=asyncio.run, args=(main(),), name="simulated bench", daemon=True)
    thread.start()
    report, loop, stop = started.result()
    try:
        yield Running(report, world)
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
