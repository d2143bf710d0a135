"""The quantum sensor and the distance sensor as seen by somebody else's Modbus master: minimalmodbus."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import serial

from sim.apogee import QuantumModel, QuantumSensor
from sim.baumer import DistanceSensor, RangeModel
from sim.clock import SimClock
from sim.modbus import ModbusBus
from tests.sim.served import served

minimalmodbus = pytest.importorskip("minimalmodbus", reason="minimalmodbus 2.1.1 is not installed")

Open = Callable[[Any, Any], Any]


@pytest.fixture(params=["tcp", "pty"])
def master(request: pytest.FixtureRequest) -> Iterator[Open]:
    """Open a master for the device at address 1 of a bus."""
    opened: list[Any] = []

    def make(ports: Any, baud: int) -> Any:
        # Masters wait the time-out out when a reply is short.
        port = serial.serial_for_url(getattr(ports, request.param), baudrate=baud, parity="E", timeout=0.3)
        opened.append(port)
        return minimalmodbus.Instrument(port, 1)

    yield make
    for port in opened:
        port.close()


def test_quantum_sensor(master: Open) -> None:
    def bus() -> ModbusBus:
        sensor = QuantumSensor(lambda t0, t1: 1234.5677, np.random.default_rng(1), QuantumModel(noise=0.0))
        return ModbusBus(SimClock(1000.0), {1: sensor}, "lamp", "apogee-sq-422x")

    with served(bus) as (_, ports):
        client = master(ports, 19200)
        client.read_float(20, 3, 2, 0)
        while client.read_float(0, 3, 2, 0) == 0.0:  # until its first measurement has ended
            pass
        assert client.read_float(0, 3, 2, 0) == pytest.approx(1234.5677)
        assert client.read_register(40, 1, 3) == pytest.approx(1234.6)
        assert client.read_float(18, 3, 2, 0) == 422
        client.write_float(36, 3.0)
        client.write_registers(100, [1])
        assert client.read_float(36) == 3.0
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.read_register(60)


def test_distance_sensor(master: Open) -> None:
    target: list[float | None] = [69.74261]

    def bus() -> ModbusBus:
        sensor = DistanceSensor(lambda t0, t1: target[0], np.random.default_rng(1), RangeModel(noise=0.0, dropout=0))
        return ModbusBus(SimClock(1000.0), {1: sensor}, "range", "baumer-om20")

    with served(bus) as (_, ports):
        client = master(ports, 57600)
        swapped = minimalmodbus.BYTEORDER_LITTLE_SWAP
        while math.isnan(client.read_float(202, 4, 2, swapped)):  # until its first measurement has ended
            pass
        assert client.read_float(202, 4, 2, swapped) == pytest.approx(69.74261, abs=1e-5)
        assert client.read_string(0, 16, 4).rstrip("\0") == "Baumer Electric AG"
        assert len(client.read_registers(200, 13, 4)) == 13
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.read_register(202, 0, 4)
        client.write_register(800, 500, functioncode=6)
        assert client.read_register(800) == 500
        client.write_float(180, 20.0, 2, swapped)
        assert client.read_float(202, 4, 2, swapped) == pytest.approx(49.74261, abs=1e-5)
        target[0] = None
        while not math.isnan(client.read_float(202, 4, 2, swapped)):
            pass
