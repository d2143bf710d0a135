"""Serve the instruments of the simulated world, in this process or in a thread beside it."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import tempfile
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim.camera import POLL, SHUTTER, SimulatedCamera
from sim.errors import SimError
from sim.faults import Fault, Strike
from sim.wire import PtyPort, TcpPort, beside
from sim.world import CAMERA, INSTRUMENTS, LINES, Settings, Stop, World, build

__all__ = ["INSTRUMENTS", "Running", "Settings", "World", "build", "in_background", "serving"]

log = logging.getLogger(__name__)


@asynccontextmanager
async def serving(world: World) -> AsyncIterator[dict[str, Any]]:
    """Open every instrument's ports and yield the report that tells where they are; close them at the end."""
    devices: list[dict[str, str]] = []
    async with AsyncExitStack() as ports:
        for name in world.settings.instruments:
            if name == CAMERA:
                devices.append(await ports.enter_async_context(_tethered(world)))
                continue
            instrument = world.faulty[name]
            tcp = TcpPort(instrument)
            await tcp.open()
            ports.push_async_callback(tcp.close)
            device = {"name": name, "model": instrument.model, "description": INSTRUMENTS[name], "tcp": tcp.url}
            if world.settings.pty:
                pty = PtyPort(instrument)
                await pty.open()
                ports.push_async_callback(pty.close)
                device["pty"] = pty.path
            device["line"] = LINES[name].format(terminator=world.settings.meter.terminator)
            devices.append(device)
        yield {
            "simulated": True,
            "seed": world.settings.seed,
            "speed": world.settings.speed,
            "specimen": world.settings.specimen,
            **{arm: carried.axis for arm, carried in world.arms.items()},
            "pid": os.getpid(),
            "devices": devices,
        }


@asynccontextmanager
async def _tethered(world: World) -> AsyncIterator[dict[str, str]]:
    """Let the camera wait for its shutter, and yield its part of the report; a folder made for it goes at the end."""
    camera = world.camera
    assert camera is not None
    with _folder(world.settings.camera_folder) as camera.folder:
        # OpenCV takes its time to load, and no instrument shall stand still at the first picture.
        await asyncio.to_thread(camera.scene.draw, camera.model.width, camera.model.height)
        waiting = asyncio.create_task(_take_pictures(camera))
        try:
            yield {"name": CAMERA, "model": "camera-folder", "description": INSTRUMENTS[CAMERA], "folder": str(camera.folder)}
        finally:
            waiting.cancel()
            await asyncio.wait({waiting})


async def _take_pictures(camera: SimulatedCamera) -> None:
    # Not `camera.run()`: waiting for the shutter in simulated time would keep a core busy where that runs fast.
    shutter = camera.folder / SHUTTER
    try:
        while True:
            try:
                shutter.unlink()
            except FileNotFoundError:
                await asyncio.sleep(POLL)
            else:
                await camera.shoot()
    except Exception:  # it must be seen, and must not take the instruments down
        log.exception("simulated camera failed; it takes no more pictures")


@contextmanager
def _folder(path: str | None) -> Iterator[Path]:
    if path is None:
        with tempfile.TemporaryDirectory(prefix="simulated-camera-") as made:
            yield Path(made)
    elif os.path.isdir(path):
        yield Path(path).resolve()
    else:
        folder = Path(path).resolve()
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise SimError(f"camera folder {path}: {error.strerror}") from error
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


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

    def folder(self, name: str) -> Path:
        """Return the folder of the camera `name`."""
        return Path(self._device(name)["folder"])

    def inject(self, name: str, fault: Fault) -> None:
        """Have a fault strike the instrument `name`; from any thread.

        Raises
        ------
        SimError
            It knows no such fault.
        """
        self.world.faulty[name].inject(fault)

    def struck(self, name: str) -> tuple[Strike, ...]:
        """Return what faults did to the instrument `name` so far."""
        return tuple(self.world.faulty[name].struck)

    def stops(self) -> tuple[Stop, ...]:
        """Return the stop commands that arrived so far."""
        return self.world.stops.all()

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
    with beside(serving(world), "simulated bench") as report:
        yield Running(report, world)
