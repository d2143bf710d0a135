"""One simulated instrument on its ports, served from a thread."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import NamedTuple, TypeVar

from sim.wire import Instrument, PtyPort, TcpPort, beside

T = TypeVar("T", bound=Instrument)


class Ports(NamedTuple):
    """Where an instrument is."""

    tcp: str
    pty: str


@asynccontextmanager
async def _open(make: Callable[[], T]) -> AsyncIterator[tuple[T, Ports]]:
    instrument = make()
    tcp, pty = TcpPort(instrument), PtyPort(instrument)
    await tcp.open()
    await pty.open()
    try:
        yield instrument, Ports(tcp.url, pty.path)
    finally:
        await tcp.close()
        await pty.close()


@contextmanager
def served(make: Callable[[], T]) -> Iterator[tuple[T, Ports]]:
    """Make an instrument in the thread of its servers and serve it for the length of a `with` block."""
    with beside(_open(make), "served instrument") as entered:
        yield entered
