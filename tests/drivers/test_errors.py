"""Errors read as one clear line."""

from __future__ import annotations

import pickle
import subprocess
import sys

import pytest

import drivers
from drivers.errors import BadChecksum, DeviceError, TransportTimeout


def test_everything_is_in_the_line() -> None:
    error = TransportTimeout(
        "no reply",
        device="theta_r",
        port="/dev/ttyUSB0",
        attempt="reading the position",
        sent=b"/1 1 05 get pos:3E\n",
        raw=b"@0",
        expected="a reply",
        elapsed_s=0.3,
        hint="check the cable",
    )
    assert str(error) == (
        "theta_r on /dev/ttyUSB0: reading the position: no reply "
        r"(sent '/1 1 05 get pos:3E\n', got 40 30, expected a reply, after 0.300 s); check the cable"
    )


def test_unknown_parts_leave_no_trace() -> None:
    assert str(DeviceError("odd")) == "odd"


def test_long_replies_are_cut_short() -> None:
    line = str(DeviceError("odd", raw=b"\xff" * 5000))
    assert len(line) < 300
    assert "5000 bytes" in line


def test_completing_keeps_what_is_known() -> None:
    error = DeviceError("odd", device="a", elapsed_s=0.0)
    error.complete(device="b", port="p", elapsed_s=3.0)
    assert (error.device, error.port, error.elapsed_s) == ("a", "p", 0.0)


def test_errors_survive_pickling() -> None:
    error = pickle.loads(pickle.dumps(BadChecksum("odd", device="a", raw=b"\x00")))
    assert isinstance(error, BadChecksum)
    assert (error.problem, error.device, error.raw) == ("odd", "a", b"\x00")


@pytest.mark.parametrize("name", drivers.__all__)
def test_one_root(name: str) -> None:
    assert issubclass(getattr(drivers, name), DeviceError)


def test_importing_the_package_is_light() -> None:
    """Neither pyserial nor NumPy comes along, not even with the catalogue."""
    program = "import sys, drivers, drivers.catalogue; print(sorted({'serial', 'numpy', 'drivers.stages.zaber'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
