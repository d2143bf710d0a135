"""Requests per second: our link and driver against a bare pyserial loop and against zaber-motion, on the same simulated port.

All ask the same stage for its position, with checksum and message number, over TCP and over a pseudo-terminal; the simulator runs in
a process of its own. The bare loop writes the very bytes that the driver would, reads with `read_until` and checks nothing. A second one,
without target, takes all bytes that are there at a time: on a pseudo-terminal its next request is there before the simulator has gone to
sleep, which spares it the waking.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from statistics import median
from typing import Any
from urllib.parse import urlsplit

import serial

from drivers.link import Link
from drivers.motion import wait_until_idle
from drivers.stages.zaber import ZaberAxis, encode_command
from tests.benchmarks.report import verdict
from tests.conftest import rig_environment

ROUNDS = 31
EXCHANGES = 200


def main() -> int:
    """Interleave rounds of all, so that what else the computer does hits them alike; print the median of the ratios."""
    missed = 0
    with _simulated() as stages:
        for kind in ("tcp", "pty"):
            url = stages[kind]
            _home(url)
            ours, bare, greedy, motion = _rates(url)
            for what, rates, target, note in (
                ("bare pyserial loop", bare, 1 / 0.95, "0.95 or more of it"),
                ("zaber-motion", motion, 1.0, "faster than it"),
            ):
                pace = f"{note}; {median(rates):.0f} against {median(ours):.0f} requests/s"
                missed += verdict(f"{kind}: {what} over ours", _ratio(rates, ours), target, note=pace)
            print(
                f"   {kind}: bare loop that takes all bytes there over ours: {_ratio(greedy, ours):.3g} ({median(greedy):.0f} requests/s)"
            )
    return missed


def _ratio(one: list[float], other: list[float]) -> float:
    return median(first / second for first, second in zip(one, other, strict=True))


@contextmanager
def _simulated() -> Iterator[dict[str, str]]:
    command = [sys.executable, "-m", "sim", "--specimen", "lambert:0.5", "--speed", "1000", "--until-eof"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=rig_environment()) as process:
        assert process.stdout is not None
        report = json.loads(process.stdout.readline())
        yield next(device for device in report["devices"] if device["name"] == "stages")
        process.communicate()


def _home(url: str) -> None:
    """Without a warning flag a state takes one exchange."""
    with Link.open(url) as link:
        axis = ZaberAxis.open(link, "stage")
        axis.start_home()
        assert not wait_until_idle(axis, 0.1, timeout_s=10.0).warnings


def _rates(url: str) -> list[list[float]]:
    """Requests per second of each round: ours, the bare loops', zaber-motion's. Each has the port for itself during its round."""
    contestants = (_ours, _bare, _greedy, _motion)
    rates: list[list[float]] = [[] for _ in contestants]
    for number in range(ROUNDS):
        for turn in range(len(contestants)):
            which = (turn + number) % len(contestants)  # nobody is always first
            rates[which].append(contestants[which](url))
    return rates


def _timed(ask: Callable[[], Any]) -> float:
    for _ in range(20):
        ask()
    started = time.perf_counter()
    for _ in range(EXCHANGES):
        ask()
    return EXCHANGES / (time.perf_counter() - started)


def _ours(url: str) -> float:
    with Link.open(url) as link:
        return _timed(ZaberAxis(link, "stage", microsteps_per_unit=1_536_000 / 360).state)


def _bare(url: str) -> float:
    return _loop(url, lambda port: port.read_until(b"\r\n"))


def _greedy(url: str) -> float:
    def reply(port: Any) -> bytes:
        line = b""
        while not line.endswith(b"\r\n"):
            line += port.read(port.in_waiting or 1)
        return line

    return _loop(url, reply)


def _loop(url: str, reply: Callable[[Any], bytes]) -> float:
    requests = cycle([encode_command(1, 1, number, "get pos") for number in range(100)])
    with serial.serial_for_url(url, timeout=1.0) as port:

        def ask() -> bytes:
            port.write(next(requests))
            return reply(port)

        return _timed(ask)


def _motion(url: str) -> float:
    from zaber_motion.ascii import Connection

    def opened() -> Connection:
        if url.startswith("socket://"):
            where = urlsplit(url)
            return Connection.open_tcp(where.hostname or "", where.port or 0)
        return Connection.open_serial_port(url)

    with opened() as connection:
        return _timed(lambda: connection.generic_command("get pos", device=1, axis=1))
