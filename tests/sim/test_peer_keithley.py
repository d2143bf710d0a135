"""The picoammeter as seen by somebody else's client: InstrumentKit's Keithley 6514, with the UNIT element off."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from sim.bench import Misalignment
from sim.serve import Running, Settings, in_background

if sys.version_info >= (3, 13):
    pytest.skip("InstrumentKit 0.6.0 needs xdrlib, which Python 3.13 no longer has", allow_module_level=True)

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message="'xdrlib' is deprecated", category=DeprecationWarning)
    import quantities  # type: ignore[import-untyped]
    from instruments.keithley import Keithley6514  # type: ignore[import-untyped]

Open = Callable[[], Any]


@pytest.fixture(params=["tcp", "pty"])
def meter(running: Running, request: pytest.FixtureRequest) -> Iterator[Any]:
    if request.param == "tcp":
        client = Keithley6514.open_tcpip("127.0.0.1", int(running.url("meter").rpartition(":")[2]))
    else:
        client = Keithley6514.open_serial(running.pty("meter"), 9600)
    client.sendcmd("*RST")
    client.sendcmd("FORM:ELEM READ,TIME,STAT")
    yield client
    client._file._conn.close()  # its own close complains of sockets already shut


def test_identity_and_mode(meter: Any) -> None:
    assert meter.name.startswith("KEITHLEY INSTRUMENTS INC.,MODEL 6485,")
    assert meter.mode == Keithley6514.Mode.current
    assert meter.unit == quantities.amp
    assert meter.op_complete
    assert meter.check_error_queue() == []


def test_range(meter: Any) -> None:
    assert meter.auto_range
    meter.auto_range = False
    assert not meter.auto_range
    meter.input_range = quantities.Quantity(2e-7, "A")
    assert float(meter.input_range) == 2e-7
    assert not meter.auto_range
    meter.auto_config(Keithley6514.Mode.current)
    assert meter.auto_range
    assert meter.check_error_queue() == []


def test_zero_check_and_correct(meter: Any) -> None:
    meter.zero_check = True
    meter.sendcmd("CURR:RANG 2e-9")
    meter.sendcmd("INIT")
    meter.sendcmd("SYST:ZCOR:ACQ")
    meter.zero_correct = True
    current, _ = meter.read_measurements()
    assert abs(float(current)) < 1e-13
    assert float(meter.query("FETC?").split(",")[2]) == (1 << 9) + (1 << 10)
    meter.zero_check = False
    assert float(meter.query("READ?").split(",")[2]) == 1 << 10
    assert meter.check_error_queue() == []


def test_fetch_repeats_the_reading_and_time_goes_on(meter: Any) -> None:
    meter.zero_check = False
    current, time = meter.read_measurements()
    assert meter.fetch() == (current, time)
    assert current.units == quantities.amp
    _, later = meter.read_measurements()
    assert later > time


def test_errors_reach_the_client(meter: Any) -> None:
    meter.sendcmd("NO:SUCH 1")
    meter.sendcmd("CURR:RANG 5")
    assert meter.check_error_queue() == [-113, -222]


def test_it_reads_the_light_of_a_white_specimen() -> None:
    settings = Settings(specimen="lambert:1", speed=40, misalignment=Misalignment(), pty=False)
    with in_background(settings) as running:
        world = running.world
        meter = Keithley6514.open_tcpip("127.0.0.1", int(running.url("meter").rpartition(":")[2]))
        world.bench.source, world.bench.detector = lambda t: 135.0, lambda t: 100.0
        meter.sendcmd("FORM:ELEM READ,TIME,STAT")
        meter.zero_check = False
        current, time = meter.read_measurements()
        lamp = world.bench.lamp.level(time)
        assert float(current) == pytest.approx(1e-6 * lamp, rel=5e-5, abs=0)
        assert lamp == pytest.approx(1.0, abs=2e-3)
        meter._file._conn.close()
