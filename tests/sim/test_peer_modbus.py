"""The AZ driver as seen by other people's Modbus masters: minimalmodbus, pymodbus and mbpoll."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import serial
from pymodbus.client import ModbusSerialClient

from sim.clock import SimClock
from sim.modbus import ModbusBus
from sim.oriental import AzAxis, AzModel
from tests.sim.served import Ports, served

SPEED = 40.0
MOVE = (0, 1, 4500, 3000, 30_000, 30_000, 1000, 1)  # to 90 deg, as a direct data operation


@pytest.fixture
def ports() -> Iterator[Ports]:
    """Two axes on one bus."""
    clock = SimClock(SPEED)
    with served(lambda: ModbusBus(clock, {1: AzAxis(AzModel(), 77.0), 2: AzAxis(AzModel(), 30.0)}, "az", "az")) as (_, where):
        yield where


def words(*numbers: int) -> list[int]:
    return [word for number in numbers for word in (number >> 16 & 0xFFFF, number & 0xFFFF)]


def rest(outputs: Callable[[], int]) -> None:
    while outputs() & 0x2000:
        pass


# minimalmodbus


@pytest.fixture
def minimalmodbus() -> Any:
    return pytest.importorskip("minimalmodbus", reason="minimalmodbus 2.1.1 is not installed")


@pytest.fixture(params=["tcp", "pty"])
def drive(request: pytest.FixtureRequest, ports: Ports, minimalmodbus: Any) -> Iterator[Any]:
    # It waits this long after every reply that is shorter than the one it hoped for.
    with serial.serial_for_url(ports.tcp if request.param == "tcp" else ports.pty, baudrate=115200, timeout=0.4) as port:
        yield minimalmodbus.Instrument(port, 1)


def test_minimalmodbus_homes_moves_and_reads_back(drive: Any) -> None:
    assert drive.read_register(0x7F) == 0x4020
    drive.write_register(0x7D, 0x10, functioncode=6)
    drive.write_register(0x7D, 0, functioncode=6)
    rest(lambda: drive.read_register(0x7F))
    assert drive.read_register(0x7F) == 0x4030
    drive.write_registers(0x58, words(*MOVE))
    assert drive.read_register(0x7F) & 0x2000
    rest(lambda: drive.read_register(0x7F))
    assert drive.read_long(0xCC, signed=True) == 4500
    drive.write_long(0x5C, -100, signed=True)
    drive.write_long(0x5A, 2)
    drive.write_long(0x66, 1)
    rest(lambda: drive.read_register(0x7F))
    assert drive.read_long(0xCC, signed=True) == 4400
    assert drive._perform_command(8, b"\0\0\xa5\x37") == b"\0\0\xa5\x37"  # it has no method for the echo


def test_minimalmodbus_sees_alarms_and_refusals(drive: Any, minimalmodbus: Any) -> None:
    drive.write_registers(0x58, words(*MOVE))
    assert drive.read_long(0x80) == 0x4A
    with pytest.raises(minimalmodbus.SlaveReportedException):
        drive.write_registers(0x58, words(*MOVE))
    drive.write_long(0x180, 1)
    drive.write_long(0x180, 0)
    assert drive.read_long(0x80) == 0
    with pytest.raises(minimalmodbus.IllegalRequestError, match="illegal data address"):
        drive.read_register(0x1000)
    with pytest.raises(minimalmodbus.IllegalRequestError, match="illegal function"):
        drive.read_register(0x7F, functioncode=4)


def test_minimalmodbus_finds_nobody_at_another_address(drive: Any, minimalmodbus: Any) -> None:
    drive.address = 3
    with pytest.raises(minimalmodbus.NoResponseError):
        drive.read_register(0x7F)


# pymodbus


@pytest.fixture(params=["tcp", "pty"])
def client(request: pytest.FixtureRequest, ports: Ports) -> Iterator[ModbusSerialClient]:
    with ModbusSerialClient(ports.tcp if request.param == "tcp" else ports.pty, baudrate=115200, timeout=5, retries=0) as opened:
        yield opened


def test_pymodbus_homes_moves_and_reads_back_two_axes(client: ModbusSerialClient) -> None:
    for unit in (1, 2):
        assert client.write_register(0x7D, 0x10, device_id=unit).registers == [0x10]
        assert not client.write_register(0x7D, 0, device_id=unit).isError()
    for unit, steps in ((1, 4500), (2, 300)):
        rest(lambda unit=unit: client.read_holding_registers(0x7F, device_id=unit).registers[0])  # type: ignore[misc]
        assert not client.write_registers(0x58, words(*MOVE[:2], steps, *MOVE[3:]), device_id=unit).isError()
    for unit, steps in ((1, 4500), (2, 300)):
        rest(lambda unit=unit: client.read_holding_registers(0x7F, device_id=unit).registers[0])  # type: ignore[misc]
        assert list(client.read_holding_registers(0xCC, count=2, device_id=unit).registers) == words(steps)
    assert client.diag_query_data(b"\xa5\x37").message == b"\xa5\x37"  # type: ignore[attr-defined]
    both = client.readwrite_registers(read_address=0x5C, read_count=2, address=0x5C, values=words(77))
    assert list(both.registers) == words(77)


def test_pymodbus_sees_refusals(client: ModbusSerialClient) -> None:
    assert client.read_holding_registers(0x1000).exception_code == 2
    assert client.read_input_registers(0x7F).exception_code == 1
    assert client.write_registers(0x5E, words(5_000_000)).exception_code == 3


# mbpoll

MBPOLL = shutil.which("mbpoll")


@pytest.mark.skipif(MBPOLL is None, reason="mbpoll (Debian package of that name) is not installed")
def test_mbpoll_presets_and_reads_a_position(ports: Ports) -> None:
    def mbpoll(*options: str) -> str:
        command = [str(MBPOLL), "-m", "rtu", "-a", "1", "-b", "115200", "-P", "none", "-0", "-1", *options]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout

    # -B: the upper word first.
    mbpoll("-t", "4:int", "-B", "-r", str(0x38C), ports.pty, "4321")
    mbpoll("-t", "4:int", "-B", "-r", str(0x18A), ports.pty, "1")
    assert f"[{0xCC}]: \t4321" in mbpoll("-t", "4:int", "-B", "-r", str(0xCC), "-c", "1", ports.pty)
    assert f"[{0x7F}]: \t{0x4030}" in mbpoll("-t", "4", "-r", str(0x7F), "-c", "1", ports.pty)
