"""Instruments made of a script: a thread at the other end of a wire that insists on every byte.

Nothing here knows a protocol: the tests spell out what must be sent and what comes back.
"""

from __future__ import annotations

import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import pytest

from drivers.link import Link

PATIENCE_S = 20.0  # for a peer that waits in vain; no test that passes gets near it


class Step:
    """One thing the peer does."""

    def run(self, wire: Wire) -> None:
        """Do it."""
        raise NotImplementedError


class Wire:
    """The instrument's end of a cable."""

    def __init__(self, fd: int, unplug: Callable[[], None]) -> None:
        self.fd = fd
        self.unplug = unplug

    def ready(self, wait_s: float) -> bool:
        """Whether bytes are there."""
        return bool(select.select([self.fd], [], [], wait_s)[0])


class Expect(Step):
    """The next bytes must be exactly these."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def run(self, wire: Wire) -> None:
        """Read and compare."""
        got = b""
        while len(got) < len(self.data):
            assert wire.ready(PATIENCE_S), f"expected {self.data!r}, got only {got!r}"
            chunk = os.read(wire.fd, len(self.data) - len(got))
            assert chunk, f"expected {self.data!r}, got only {got!r} and then the end"
            got += chunk
            assert self.data.startswith(got), f"expected {self.data!r}, got {got!r}"


class Send(Step):
    """Send these bytes."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def run(self, wire: Wire) -> None:
        """Write."""
        assert os.write(wire.fd, self.data) == len(self.data)


class Tell(Step):
    """Set an event, for the test to wait for."""

    def __init__(self, event: threading.Event) -> None:
        self.event = event

    def run(self, wire: Wire) -> None:
        """Set."""
        self.event.set()


class Await(Step):
    """Wait for an event that the test sets."""

    def __init__(self, event: threading.Event) -> None:
        self.event = event

    def run(self, wire: Wire) -> None:
        """Wait."""
        assert self.event.wait(PATIENCE_S)


class Unplug(Step):
    """Pull the cable."""

    def run(self, wire: Wire) -> None:
        """Close this end."""
        wire.unplug()


class Serve(Step):
    """Answer a number of lines, whatever their order."""

    def __init__(self, lines: int, answer: Callable[[bytes], bytes], terminator: bytes = b"\n") -> None:
        self.lines = lines
        self.answer = answer
        self.terminator = terminator

    def run(self, wire: Wire) -> None:
        """Answer."""
        buffer = b""
        left = self.lines
        while left:
            assert wire.ready(PATIENCE_S), f"{left} lines short"
            buffer += os.read(wire.fd, 4096)
            *lines, buffer = buffer.split(self.terminator)
            for line in lines:
                os.write(wire.fd, self.answer(line))
            left -= len(lines)


class Peer:
    """Runs the steps in a thread."""

    def __init__(self, url: str, wire: Wire, steps: tuple[Step, ...], ready: Callable[[], None] = lambda: None) -> None:
        self.url = url
        self._wire = wire
        self._steps = steps
        self._ready = ready
        self._failure: BaseException | None = None
        self._unplugged = any(isinstance(step, Unplug) for step in steps)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._ready()
            for step in self._steps:
                step.run(self._wire)
        except BaseException as error:
            self._failure = error

    def finish(self) -> None:
        """Insist that the whole script ran and nothing was sent beyond it."""
        self._thread.join(PATIENCE_S)
        try:
            assert not self._thread.is_alive(), "the script did not come to its end"
            if self._failure is not None:
                raise self._failure
            if not self._unplugged and self._wire.ready(0):
                pytest.fail(f"sent beyond the script: {os.read(self._wire.fd, 4096)!r}")
        finally:
            if not self._unplugged:
                self._wire.unplug()


def pty_peer(*steps: Step) -> Peer:
    """A peer on a pseudo-terminal."""
    master, slave = os.openpty()
    url = os.ttyname(slave)

    def unplug() -> None:
        os.close(master)
        os.close(slave)

    return Peer(url, Wire(master, unplug), steps)


def tcp_peer(*steps: Step) -> Peer:
    """A peer behind a TCP socket, as serial device servers are."""
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(PATIENCE_S)
    wire = Wire(-1, lambda: None)

    def accept() -> None:
        connection, _ = server.accept()
        server.close()
        wire.fd = connection.fileno()
        wire.unplug = connection.close

    return Peer(f"socket://127.0.0.1:{server.getsockname()[1]}", wire, steps, accept)


class Plug(Protocol):
    """Makes a link to a peer with this script."""

    def __call__(self, *steps: Step, timeout_s: float = ..., **settings: Any) -> Link:
        """Plug in."""
        ...


def _plugs(make: Callable[..., Peer]) -> Iterator[Plug]:
    opened: list[tuple[Peer, Link]] = []

    def plug(*steps: Step, timeout_s: float = PATIENCE_S, **settings: Any) -> Link:
        peer = make(*steps)
        link = Link.open(peer.url, device="bench", timeout_s=timeout_s, **settings)
        opened.append((peer, link))
        return link

    yield plug
    try:
        for peer, _ in opened:
            peer.finish()
    finally:
        for _, link in opened:
            link.close()


@pytest.fixture
def plug() -> Iterator[Plug]:
    """Links over pseudo-terminals; the scripts are checked to their end afterwards."""
    yield from _plugs(pty_peer)


@pytest.fixture(params=[pty_peer, tcp_peer], ids=["pty", "tcp"])
def plug_both(request: pytest.FixtureRequest) -> Iterator[Plug]:
    """Links over pseudo-terminals and over TCP."""
    yield from _plugs(request.param)


@pytest.fixture
def make_peer() -> Iterator[Callable[..., Peer]]:
    """Peers on pseudo-terminals without a link, for those who open their own."""
    made: list[Peer] = []

    def make(*steps: Step) -> Peer:
        made.append(pty_peer(*steps))
        return made[-1]

    yield make
    for peer in made:
        peer.finish()


class Script:
    """The steps, for tests to spell scripts with."""

    expect = Expect
    send = Send
    tell = Tell
    wait = Await
    unplug = Unplug
    serve = Serve

    @staticmethod
    def dialogue(*lines: bytes) -> tuple[Step, ...]:
        """Requests and replies in turn."""
        return tuple(Expect(line) if index % 2 == 0 else Send(line) for index, line in enumerate(lines))


@pytest.fixture
def script() -> type[Script]:
    """The vocabulary of scripts."""
    return Script
