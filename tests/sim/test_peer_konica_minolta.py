"""The luminance meters as seen by somebody else's client: psychopy-minolta."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from sim.clock import SimClock
from sim.konica_minolta import Photometer, PhotometerModel
from tests.sim.served import served

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    minolta = pytest.importorskip(
        "psychopy_minolta.minolta",
        reason="psychopy-minolta 0.0.2 and psychopy are not installed (both without their dependencies)",
        exc_type=ImportError,
    )

SPEED = 40.0


def photometer(colour: bool, luminance: float = 123.4) -> Photometer:
    unit = PhotometerModel(colour=colour, noise=0.0)
    return Photometer(SimClock(SPEED), lambda t0, t1: luminance, np.random.default_rng(1), unit, chroma=lambda t0, t1: (0.31, 0.33))


@pytest.fixture(params=["tcp", "pty"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return which of an instrument's ports to try, and have the client open it where that is a URL."""
    import serial

    if request.param == "tcp":
        monkeypatch.setattr(minolta.serial, "Serial", lambda port: serial.serial_for_url(port))
    return str(request.param)


def test_ls100(way: str) -> None:
    with served(lambda: photometer(colour=False)) as (_, ports):
        client: Any = minolta.LS100(getattr(ports, way))
        assert client.OK
        assert client.setMode("04")
        assert client.measure() == 123.4
        assert client.getLum() == 123.4
        assert client.clearMemory() is not False
        assert not client.setMode("99")
        client.com.close()


def test_cs100a(way: str) -> None:
    with served(lambda: photometer(colour=True)) as (_, ports):
        client: Any = minolta.CS100A(getattr(ports, way))
        assert client.OK
        client.measure()
        assert client.lastLum == 123.4
        client.com.close()
