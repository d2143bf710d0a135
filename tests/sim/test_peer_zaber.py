"""The stages as seen by other people's clients: the maker's zaber-motion, and zaber.serial."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from queue import Queue

import pytest
from zaber.serial import AsciiCommand, AsciiDevice, AsciiSerial  # type: ignore[import-untyped]
from zaber_motion.ascii import AlertEvent, Axis, Connection, Device
from zaber_motion.exceptions import (
    BadCommandException,
    BadDataException,
    MovementInterruptedException,
    NoDeviceFoundException,
    RequestTimeoutException,
)

from sim.serve import Running

DEGREE = 1 / 0.000234375


# zaber-motion


@pytest.fixture(params=["tcp", "pty"])
def connection(running: Running, request: pytest.FixtureRequest) -> Iterator[Connection]:
    if request.param == "tcp":
        opened = Connection.open_tcp("127.0.0.1", int(running.url("stages").rpartition(":")[2]))
    else:
        opened = Connection.open_serial_port(running.pty("stages"))
    with opened:
        yield opened


@pytest.fixture
def stages(connection: Connection) -> list[Device]:
    return [connection.get_device(address) for address in (1, 2)]


def test_the_chain_is_found(connection: Connection) -> None:
    found = connection.detect_devices(identify_devices=False)
    assert [device.device_address for device in found] == [1, 2]
    assert found[1].get_axis(1).get_position() == 0


def test_home_move_and_read_back(stages: list[Device], running: Running) -> None:
    axis = stages[0].get_axis(1)
    assert not axis.is_homed()
    assert axis.warnings.get_flags() == {"WR"}
    with pytest.raises(BadDataException):
        axis.move_absolute(1000)
    axis.home()
    assert axis.is_homed()
    assert axis.warnings.get_flags() == set()
    assert axis.get_position() == 0
    axis.move_absolute(round(45 * DEGREE))
    assert not axis.is_busy()
    assert axis.get_position() == 192_000
    axis.move_relative(-round(15 * DEGREE))
    assert axis.get_position() == 128_000
    now = running.world.clock.now()
    assert running.world.stages.axes[0].track.nominal(now) == (pytest.approx(30.0), 0.0)
    axis.move_max()
    assert axis.get_position() == axis.settings.get("limit.max") == 1_536_000
    axis.move_min()
    assert axis.get_position() == 0
    with pytest.raises(BadDataException):
        axis.move_absolute(1_536_001)
    with pytest.raises(BadDataException):
        axis.move_relative(-1)


def test_velocity_stop_and_waiting(stages: list[Device]) -> None:
    axis = stages[1].get_axis(1)
    axis.home()
    axis.move_velocity(20_000)  # two minutes to the limit, seconds even of fast time
    assert axis.is_busy()
    axis.stop()
    assert not axis.is_busy()
    assert 0 < axis.get_position() < 1_536_000
    axis.move_absolute(0, wait_until_idle=False)
    axis.wait_until_idle()
    assert axis.get_position() == 0


def test_all_axes_and_settings(stages: list[Device]) -> None:
    stages[0].all_axes.home()
    axis = stages[0].get_axis(1)
    assert axis.settings.get("maxspeed") == 419_430
    axis.settings.set("maxspeed", 300_000)
    assert axis.settings.get("maxspeed") == 300_000
    assert stages[0].settings.get("deviceid") == 99_999
    assert stages[0].settings.get_string("version") == "7.30"
    with pytest.raises(BadCommandException):
        axis.settings.get("encoder.pos")
    with pytest.raises(BadDataException):
        axis.settings.set("maxspeed", 0)
    with pytest.raises(BadCommandException):
        stages[0].generic_command("make tea")
    replies = [reply.data for reply in stages[0].connection.generic_command_multi_response("get system.serial")]
    assert replies == ["10001", "10002"]


def test_another_client_s_stop_is_an_interruption(stages: list[Device], running: Running) -> None:
    axis = stages[0].get_axis(1)
    axis.home()
    axis.settings.set("maxspeed", 20_000)  # slow enough to be caught under way
    outcome: Queue[BaseException | None] = Queue()

    def move() -> None:
        try:
            axis.move_max()
            outcome.put(None)
        except MovementInterruptedException as error:
            outcome.put(error)

    thread = threading.Thread(target=move)
    thread.start()
    with Connection.open_tcp("127.0.0.1", int(running.url("stages").rpartition(":")[2])) as other:
        while other.generic_command("", 1, 1).status != "BUSY":
            pass
        other.generic_command("stop", 1, 1)
        assert isinstance(outcome.get(timeout=30), MovementInterruptedException)
    thread.join()


def test_alerts(stages: list[Device], connection: Connection) -> None:
    told: Queue[AlertEvent] = Queue()
    subscription = connection.alert.subscribe(told.put)
    connection.enable_alerts()
    stages[1].get_axis(1).home()
    alert = told.get(timeout=10)
    assert (alert.device_address, alert.axis_number, alert.status, alert.warning_flag) == (2, 1, "IDLE", "--")
    subscription.dispose()


def test_renumbering(stages: list[Device], connection: Connection) -> None:
    assert connection.renumber_devices(first_address=4) == 2
    found = connection.detect_devices(identify_devices=False)
    assert [device.device_address for device in found] == [4, 5]
    assert Axis(found[0], 1).get_position() == 0


def test_checksums_off(connection: Connection) -> None:
    connection.checksum_enabled = False
    assert [reply.data for reply in connection.generic_command_multi_response("get comm.address")] == ["1", "2"]


def test_nobody_at_an_address(connection: Connection) -> None:
    with pytest.raises(RequestTimeoutException):
        connection.generic_command("get pos", 7, timeout=100)


def test_the_client_would_notice_an_empty_chain(running: Running) -> None:
    # The meter answers nothing a stage would: the detection above is no accident.
    with (
        Connection.open_tcp("127.0.0.1", int(running.url("meter").rpartition(":")[2])) as connection,
        pytest.raises(NoDeviceFoundException),
    ):
        connection.detect_devices(identify_devices=False)


# zaber.serial


@pytest.fixture(params=["tcp", "pty"])
def port(running: Running, request: pytest.FixtureRequest) -> Iterator[AsciiSerial]:
    with AsciiSerial(running.url("stages") if request.param == "tcp" else running.pty("stages"), timeout=10) as opened:
        yield opened


def test_zaber_serial_homes_moves_and_stops(port: AsciiSerial) -> None:
    device = AsciiDevice(port, 1)
    axis = device.axis(1)
    reply = axis.home()
    assert (reply.reply_flag, reply.device_status, reply.warning_flag) == ("OK", "BUSY", "WR")
    reply = axis.move_abs(192_000)
    assert (reply.reply_flag, reply.warning_flag) == ("OK", "--")
    assert axis.get_position() == device.get_position() == 192_000
    axis.move_rel(-64_000)
    assert axis.get_position() == 128_000
    axis.move_vel(20_000)
    assert axis.get_status() == "BUSY"
    axis.stop()
    assert axis.get_status() == "IDLE"
    assert axis.get_position() > 128_000
    assert AsciiDevice(port, 2).get_status() == "IDLE"


def test_zaber_serial_sees_rejections_and_ids(port: AsciiSerial) -> None:
    device = AsciiDevice(port, 2)
    reply = device.send("move abs 5")
    assert (reply.reply_flag, reply.data) == ("RJ", "BADDATA")
    reply = device.send(AsciiCommand("get nothing"))
    assert (reply.reply_flag, reply.data) == ("RJ", "BADCOMMAND")
    reply = device.send(AsciiCommand(2, 1, 42, "get resolution"))
    assert (reply.message_id, reply.data) == (42, "64")
