"""Sockets and pseudo-terminals: whole lines, comings and goings, noise, more than one client."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import select
import termios
import threading
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from sim.errors import SimError
from sim.serve import Running
from sim.wire import Line, Splitter, beside
from tests.sim.served import served

Connect = Callable[[str], Any]


@given(st.lists(st.binary(max_size=8).filter(lambda piece: b"\r" not in piece and b"\n" not in piece)), st.data())
def test_splitter_gives_the_same_messages_however_the_stream_is_cut(messages: list[bytes], data: st.DataObject) -> None:
    ends = [data.draw(st.sampled_from([b"\r", b"\n", b"\r\n", b"\n\r"])) for _ in messages]
    stream = b"".join(message + end for message, end in zip(messages, ends, strict=True))
    splitter, rest = Splitter(8), stream
    got: list[bytes] = []
    while rest:
        size = data.draw(st.integers(1, len(rest)))
        got += splitter.feed(rest[:size])
        rest = rest[size:]
    assert got == [message for message in messages if message]
    assert splitter.overruns == 0


def test_splitter_drops_a_message_that_is_too_long_and_takes_the_next() -> None:
    splitter = Splitter(8)
    assert list(splitter.feed(b"12345678\n123456789\nok\n")) == [b"12345678", b"ok"]
    assert list(splitter.feed(b"12345")) == list(splitter.feed(b"67890")) == []
    assert list(splitter.feed(b"x\nok\n")) == [b"ok"]
    assert splitter.overruns == 2


def open_pty(path: str) -> serial.Serial:
    return serial.Serial(path, 115200, timeout=10)


def ask(port: serial.Serial, line: bytes) -> bytes:
    port.write(line + b"\n")
    return port.read_until(b"\n")


def test_tcp_byte_by_byte_and_many_at_once(running: Running, connect: Connect) -> None:
    client = connect(running.url("stages"))
    for byte in b"/1 0 33\r\n":
        client.send(bytes([byte]))
    assert client.line() == b"@01 0 33 OK IDLE WR 0\r\n"
    client.send(b"".join(b"/2 0 %02d\n" % i for i in range(100)))
    assert [client.line() for _ in range(100)] == [b"@02 0 %02d OK IDLE WR 0\r\n" % i for i in range(100)]


def test_pty_and_tcp_share_one_instrument(running: Running, connect: Connect) -> None:
    client = connect(running.url("stages"))
    with open_pty(running.pty("stages")) as port:
        assert client.ask(b"/1 1 set maxspeed 12345") == b"@01 1 OK IDLE WR 0\r\n"
        assert ask(port, b"/1 1 get maxspeed") == b"@01 1 OK IDLE WR 12345\r\n"
    other = connect(running.url("stages"))
    assert other.ask(b"/1 1 get maxspeed") == b"@01 1 OK IDLE WR 12345\r\n"


def test_a_pty_neither_echoes_nor_translates(running: Running) -> None:
    fd = os.open(running.pty("stages"), os.O_RDWR | os.O_NOCTTY)  # with the terminal settings as they are
    try:
        os.write(fd, b"/1 0 01\n/1 0 02\r")
        got = b""
        while got.count(b"\n") < 2:
            got += os.read(fd, 100)
        assert got == b"@01 0 01 OK IDLE WR 0\r\n@01 0 02 OK IDLE WR 0\r\n"
    finally:
        os.close(fd)


def test_clients_come_and_go_and_leave_nothing_behind(running: Running, connect: Connect) -> None:
    for i in range(5):
        with open_pty(running.pty("stages")) as port:
            assert ask(port, b"/1 0 %02d" % i) == b"@01 0 %02d OK IDLE WR 0\r\n" % i
            port.write(b"/1 0 98\n/1 1 home no")  # a question whose answer is not stayed for, and half a command
        client = connect(running.url("stages"))
        assert client.ask(b"/2 0 %02d" % i) == b"@02 0 %02d OK IDLE WR 0\r\n" % i
        client.send(b"/2 1 hom")
        client.close()
    client = connect(running.url("stages"))
    assert client.ask(b"/0 1 07").split()[5] == b"WR"


def test_a_reply_not_stayed_for_is_not_kept_for_the_next_client(running: Running, connect: Connect) -> None:
    fd = os.open(running.pty("stages"), os.O_RDWR | os.O_NOCTTY)  # bare, for serial ports empty themselves when opened
    os.write(fd, b"/1 0 98\n")
    assert select.select([fd], [], [], 10)[0] == [fd]
    os.close(fd)
    client = connect(running.url("stages"))
    for i in range(10):  # by then the server has seen the terminal closed
        assert client.ask(b"/2 0 %02d" % i) == b"@02 0 %02d OK IDLE WR 0\r\n" % i
    fd = os.open(running.pty("stages"), os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(fd, b"/1 0 11\n")
        assert os.read(fd, 100).startswith(b"@01 0 11 ")
    finally:
        os.close(fd)


def test_a_pty_client_that_writes_on_and_does_not_read_holds_nobody_else_up(running: Running, connect: Connect) -> None:
    with open_pty(running.pty("meter")) as port:
        heard = threading.Event()

        def flood() -> None:
            while not heard.is_set():
                port.write(b"*IDN?\n" * 5000)  # far more replies than the terminal holds, and more questions than the meter keeps

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            other = connect(running.url("meter"))
            assert other.ask(b"*OPC?") == b"1\n"
            while not other.ask(b"SYST:ERR?").startswith(b"-363,"):
                pass
        finally:
            heard.set()
            thread.join()
    with open_pty(running.pty("meter")) as port:
        # Opened again before the meter could notice, the line still carries what the meter has to say, as a real one would:
        # ^X makes it drop the questions it has not come to.
        line = ask(port, b"\x18*OPC?")
        while line != b"1\n":
            assert line
            line = port.readline()


def test_a_client_that_leaves_during_a_reading_does_not_block_the_meter(running: Running, connect: Connect) -> None:
    client = connect(running.url("meter"))
    client.send(b"CURR:NPLC 60;:TRIG:COUN 2500\nREAD?\n")
    client.close()
    other = connect(running.url("meter"))
    assert other.ask(b"*RST;*OPC?") == b"1\n"


def test_alerts_arrive_unasked(running: Running, connect: Connect) -> None:
    client = connect(running.url("stages"))
    client.ask(b"/1 set comm.alert 1")
    assert client.ask(b"/1 1 move rel 38400").startswith(b"@01 1 OK BUSY")
    assert client.line() == b"!01 1 IDLE WR\r\n"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["stages", "meter"])
def test_noise_on_the_wire_is_survived(running: Running, connect: Connect, name: str, seed: int) -> None:
    rng = random.Random(seed)
    question, answer = {"stages": (b"/1 0 42", b"@01 0 42 OK"), "meter": (b"*OPC?", b"1\n")}[name]
    with open_pty(running.pty(name)) as port:
        port.timeout = 0.5
        client = connect(running.url(name))
        for _ in range(20):
            noise = rng.randbytes(rng.randrange(1, 3000))
            client.send(noise + b"\n")
            port.write(noise[:200] + b"\n")
        client.close()
        port.write(b"\n" + question + b"\n")
        lines: list[bytes] = []
        while not (lines and lines[-1].startswith(answer)):
            lines.append(port.readline())
            assert lines[-1], lines
    assert connect(running.url(name)).ask(question).startswith(answer)


def test_an_async_context_runs_beside_and_is_left_in_its_own_thread() -> None:
    seen: list[tuple[str, int]] = []

    @contextlib.asynccontextmanager
    async def context() -> AsyncIterator[asyncio.AbstractEventLoop]:
        seen.append(("in", threading.get_ident()))
        try:
            yield asyncio.get_running_loop()
        finally:
            seen.append(("out", threading.get_ident()))

    with beside(context()) as loop:
        assert asyncio.run_coroutine_threadsafe(asyncio.sleep(0, "alive"), loop).result(10) == "alive"
        assert [name for name, _ in seen] == ["in"]
    assert [name for name, _ in seen] == ["in", "out"]
    assert {thread for _, thread in seen}.isdisjoint({threading.get_ident()})
    assert loop.is_closed()


def test_what_keeps_a_context_from_being_entered_is_raised() -> None:
    @contextlib.asynccontextmanager
    async def context() -> AsyncIterator[None]:
        raise SimError("no")
        yield

    with pytest.raises(SimError, match="no"), beside(context()):
        pytest.fail("entered")


class Asked:
    """An instrument that notes whether its lines hang up, and serves a client until it says bye."""

    name = model = "asked"

    def __init__(self) -> None:
        self.hang_up: list[bool] = []

    async def serve(self, line: Line) -> None:
        self.hang_up.append(line.hangs_up)
        while data := await line.read():
            line.write(data)
            if data == b"bye\n":
                return


def test_a_socket_is_hung_up_on_and_a_line_says_whether_it_would_be(quiet: None, connect: Connect) -> None:
    with served(Asked) as (instrument, ports):
        client = connect(ports.tcp)
        client.send(b"bye\n")
        assert (client.line(), client.line()) == (b"bye\n", b"")
        assert instrument.hang_up == [True]
        with open_pty(ports.pty) as port:
            assert ask(port, b"again") == b"again\n"
        assert instrument.hang_up[1] is False


@pytest.mark.parametrize("line", [{"parity": "E"}, {"parity": "E", "bytesize": 7, "stopbits": 2}, {"parity": "O", "rtscts": True}])
def test_a_pty_is_opened_again_and_again_with_settings_it_has_not(quiet: None, line: dict[str, Any]) -> None:
    with served(Asked) as (_, ports):
        for text in (b"one\n", b"two\n", b"three\n"):
            with serial.Serial(ports.pty, 57600, timeout=10, **line) as port:
                port.write(text)
                assert port.read_until(b"\n") == text
                port.timeout = 11.0  # a change of nothing that a terminal keeps
                port.write(b"\xe1\x00\n")
                assert port.read_until(b"\n") == b"\xe1\x00\n"


def test_a_pty_can_be_opened_again_though_nothing_was_said(quiet: None) -> None:
    with served(Asked) as (_, ports):
        for _ in range(3):
            until = time.monotonic() + 10
            while True:  # it takes a moment to be seen that a client has come and gone
                try:
                    serial.Serial(ports.pty, 4800, bytesize=7, parity="E", stopbits=2).close()
                    break
                except termios.error:
                    assert time.monotonic() < until
