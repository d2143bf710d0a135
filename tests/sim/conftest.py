"""Benches for the tests of the simulators, and a line of our own to each instrument."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator

import pytest

from sim.bench import Misalignment
from sim.serve import Running, Settings, in_background


@pytest.fixture
def quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Fail the test if a server logged a failure of its own, or asyncio one that nobody caught."""
    yield
    told = [record for when in ("setup", "call") for record in caplog.get_records(when) if record.levelno >= logging.ERROR]
    assert not told, told


@pytest.fixture
def running(quiet: None) -> Iterator[Running]:
    """A fast bench with a white specimen and known misalignments."""
    with in_background(Settings(specimen="lambert:1", seed=5, speed=40, misalignment=Misalignment(0.1, -0.08))) as bench:
        yield bench


class Client:
    """A plain socket that sends and receives whole lines."""

    def __init__(self, url: str) -> None:
        self.socket = socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), timeout=10)
        self._file = self.socket.makefile("rb")

    def send(self, data: bytes) -> None:
        """Send bytes as they are."""
        self.socket.sendall(data)

    def line(self) -> bytes:
        """Wait for one line; empty when the server has hung up."""
        return self._file.readline()

    def ask(self, data: bytes) -> bytes:
        """Send a line and wait for one."""
        self.send(data + b"\n")
        return self.line()

    def close(self) -> None:
        """Hang up."""
        self._file.close()
        self.socket.close()


@pytest.fixture
def connect() -> Iterator[type[Client]]:
    """The class of plain clients; whatever is opened with it is closed at the end."""
    opened: list[Client] = []

    class Tracked(Client):
        def __init__(self, url: str) -> None:
            super().__init__(url)
            opened.append(self)

    yield Tracked
    for client in opened:
        client.close()
