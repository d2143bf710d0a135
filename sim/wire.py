"""The wire: an instrument served on a TCP socket and on a pseudo-terminal.

An instrument sees only a `Line`, bytes in and bytes out. Faults are added by wrapping: `sim.faults.Faulty` is an instrument that serves
another one over faulty lines.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import select
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, contextmanager
from typing import Protocol, TypeVar

log = logging.getLogger(__name__)

_T = TypeVar("_T")


class Line(Protocol):
    """One client's connection, as the instrument sees it."""

    hangs_up: bool
    """Whether the client is hung up on when the instrument ceases to serve it; a terminal stays open."""

    async def read(self) -> bytes:
        """Wait for bytes from the client; empty when it has gone."""

    def write(self, data: bytes) -> None:
        """Send bytes to the client, at once or as soon as it takes them; to nobody when it has gone."""

    async def drain(self) -> None:
        """Wait until the client has taken what was written, or has gone."""


class Instrument(Protocol):
    """A simulated instrument: one state, any number of lines to it."""

    name: str
    model: str

    async def serve(self, line: Line) -> None:
        """Answer on `line` until the client has gone."""


class Splitter:
    """Cut a stream of bytes into messages ended by CR and/or LF.

    Parameters
    ----------
    longest : int
        Bytes a message may have; a longer one is dropped up to its end, and `overruns` counts it.
    """

    def __init__(self, longest: int) -> None:
        self.longest = longest
        self.overruns = 0
        self._held = bytearray()
        self._dropping = False

    def clear(self) -> None:
        """Forget a message begun."""
        self._held.clear()
        self._dropping = False

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield the messages that `data` completes, without their ends and without empty ones."""
        for piece in data.replace(b"\r", b"\n").splitlines(keepends=True) if data else ():
            ended = piece.endswith(b"\n")
            if not self._dropping:
                self._held += piece.rstrip(b"\n")
                if len(self._held) > self.longest:
                    self._held.clear()
                    self._dropping = True
                    self.overruns += 1
            if ended:
                self._dropping = False
                message = bytes(self._held)
                self._held.clear()
                if message:
                    yield message


async def _session(instrument: Instrument, line: Line) -> None:
    try:
        await instrument.serve(line)
    except Exception:  # a fault of the simulator must be seen, and must not take the other lines down
        log.exception("simulated %s failed while serving a client; its line is closed", instrument.name)


async def _end(tasks: set[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


class _TcpLine:
    hangs_up = True

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    async def read(self) -> bytes:
        try:
            return await self._reader.read(4096)
        except ConnectionError:
            return b""

    def write(self, data: bytes) -> None:
        if not self._writer.is_closing():
            self._writer.write(data)

    async def drain(self) -> None:
        with contextlib.suppress(ConnectionError):
            await self._writer.drain()


class TcpPort:
    """An instrument on a TCP port of this machine; any number of clients at a time."""

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self.url = ""

    async def open(self) -> None:
        """Listen on a free port and set `url`."""
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.url = f"socket://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.get_running_loop().create_task(self._talk(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(lambda _: writer.close())  # one that is cancelled before its first step closes nothing itself

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            await _session(self._instrument, _TcpLine(reader, writer))
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    async def close(self) -> None:
        """Stop listening and hang up on every client."""
        if self._server is not None:
            self._server.close()
            await _end(self._tasks)
            await self._server.wait_closed()


class _PtyLine:
    """The master side of a pseudo-terminal while a client has the other side open."""

    hangs_up = False

    def __init__(self, master: int) -> None:
        self._master = master
        self._loop = asyncio.get_running_loop()
        self._unsent = bytearray()
        self._sent = asyncio.Event()
        self._sent.set()

    async def read(self) -> bytes:
        while True:
            await asyncio.sleep(0)  # a client that never pauses must not keep the others from being heard
            try:
                data = os.read(self._master, 4096)
            except BlockingIOError:
                await self._readable()
            except OSError:  # EIO: nobody has the other side open
                return b""
            else:
                _unsettle(self._master)  # now, too: the next client may come before it is seen that this one has gone
                return data

    async def _readable(self) -> None:
        ready: asyncio.Future[None] = self._loop.create_future()
        self._loop.add_reader(self._master, _tell, ready)
        try:
            await ready
        finally:
            self._loop.remove_reader(self._master)

    def write(self, data: bytes) -> None:
        self._unsent += data
        self._push()

    def _push(self) -> None:
        try:
            while self._unsent:
                del self._unsent[: os.write(self._master, self._unsent)]
        except BlockingIOError:
            self._sent.clear()
            self._loop.add_writer(self._master, self._push)
            return
        except OSError:  # EIO: the client has gone
            self._unsent.clear()
        self._loop.remove_writer(self._master)
        self._sent.set()

    async def drain(self) -> None:
        await self._sent.wait()

    def close(self) -> None:
        self._loop.remove_writer(self._master)


def _tell(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)


def _unsettle(terminal: int) -> None:
    """Give a terminal a speed that nobody asks for, so that whatever settings come next change something.

    A pseudo-terminal has neither parity nor 7 bits. Asked for them, Linux leaves them out and does what else there is to do, but refuses
    (EINVAL) where nothing is left: when the terminal is opened again with the same settings.
    """
    import termios

    with contextlib.suppress(termios.error):  # gone
        settings = termios.tcgetattr(terminal)
        if settings[4:6] != [termios.B134, termios.B134]:
            settings[4:6] = [termios.B134, termios.B134]
            termios.tcsetattr(terminal, termios.TCSANOW, settings)


class PtyPort:
    """An instrument on a pseudo-terminal; one client at a time, as on a serial port.

    It takes any line settings, and goes by none: neither speed nor parity nor bits are looked at, and all eight bits pass. What stays
    impossible: a client that has the terminal open and changes nothing but the parity or the number of bits is refused (EINVAL), unless
    the instrument has heard from it since its last change. Give them together with the speed, when opening. There are no modem lines
    (DTR, RTS: ENOTTY), and what is read back of the settings is not what was set.
    """

    # Linux tells nobody when a terminal is opened, so it is looked at this often, in real time.
    _LOOK = 0.01

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self._master = -1
        self._task: asyncio.Task[None] | None = None
        self.path = ""

    async def open(self) -> None:
        """Make the terminal, raw and without echo, and set `path`."""
        import tty

        self._master, slave = os.openpty()
        tty.setraw(slave)
        _unsettle(slave)
        self.path = os.ttyname(slave)
        # Kept open here, the terminal would never tell when the client has gone; its settings outlive the closing.
        os.close(slave)
        os.set_blocking(self._master, False)
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def _run(self) -> None:
        hung_up = select.poll()
        hung_up.register(self._master, 0)
        while True:
            while any(event & select.POLLHUP for _, event in hung_up.poll(0)):
                _unsettle(self._master)  # one who said nothing may have been gone before anybody saw
                await asyncio.sleep(self._LOOK)
            line = _PtyLine(self._master)
            try:
                await _session(self._instrument, line)
            finally:
                line.close()
            self._forget()
            await asyncio.sleep(0)

    def _forget(self) -> None:
        """Drop replies the last client did not stay to read, lest the next one takes them for its own; let it choose its settings."""
        with contextlib.suppress(OSError):  # taken by a client that wants it for itself
            slave = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            try:
                _unsettle(slave)
                # Read, not flushed: a flush leaves what the kernel has not yet brought to the terminal.
                while os.read(slave, 65536):
                    pass
            except BlockingIOError:
                pass
            finally:
                os.close(slave)

    async def close(self) -> None:
        """Take the terminal away."""
        if self._task is not None:
            await _end({self._task})
            os.close(self._master)


@contextmanager
def beside(context: AbstractAsyncContextManager[_T], name: str = "simulator") -> Iterator[_T]:
    """Run an async context in an event loop and a thread of its own for the length of a `with` block.

    Whatever keeps the context from being entered is raised here.
    """
    started: Future[tuple[_T, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def main() -> None:
        stop = asyncio.Event()
        try:
            async with context as entered:
                started.set_result((entered, asyncio.get_running_loop(), stop))
                await stop.wait()
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    thread = threading.Thread(target=asyncio.run, args=(main(),), name=name, daemon=True)
    thread.start()
    entered, loop, stop = started.result()
    try:
        yield entered
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
