"""One simulated instrument on its ports, served from a thread."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

from sim.wire import Instrument, PtyPort, TcpPort

T = TypeVar("T", bound=Instrument)


class Ports(NamedTuple):
    """Where an instrument is."""

    tcp: str
    pty: str


@contextmanager
def served(make: Callable[[], T]) -> Iterator[tuple[T, Ports]]:
    """Make an instrument in the thread of its servers and serve it for the length of a `with` block."""
    started: Future[tuple[T, Ports, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def main() -> None:
        stop = asyncio.Event()
        try:
            instrument = make()
            tcp, pty = TcpPort(instrument), PtyPort(instrument)
            await tcp.open()
            await pty.open()
        except BaseException as error:
            started.set_exception(error)
            return
        started.set_result((instrument, Ports(tcp.url, pty.path), asyncio.get_running_loop(), stop))
        await stop.wait()
        await tcp.close()
        await pty.close()

    thread = threading.Thread(target=asyncio.run, args=(main(),), daemon=True)
    thread.start()
    instrument, ports, loop, stop = started.result()
    try:
        yield instrument, ports
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
