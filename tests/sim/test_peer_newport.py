"""The controller as seen by other people's clients: InstrumentKit's NewportESP301 and PyMeasure's ESP300."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from sim.clock import SimClock
from sim.newport import Esp301
from tests.sim.served import Ports, served

if sys.version_info >= (3, 13):
    pytest.skip("InstrumentKit 0.6.0 needs xdrlib, which Python 3.13 no longer has", allow_module_level=True)

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", message="'xdrlib' is deprecated", category=DeprecationWarning)
    import quantities  # type: ignore[import-untyped]
    from instruments.newport import NewportError, NewportESP301  # type: ignore[import-untyped]

no_pymeasure = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("pymeasure", "pyvisa_py")), reason="PyMeasure and PyVISA-py are not installed"
)


@pytest.fixture
def bench(quiet: None) -> Iterator[tuple[Esp301, Ports]]:
    with served(lambda: Esp301(SimClock(40.0), [200.0, 30.0])) as running:
        yield running


# InstrumentKit


@pytest.fixture(params=["tcp", "pty"])
def client(bench: tuple[Esp301, Ports], request: pytest.FixtureRequest) -> Iterator[Any]:
    """The client asks for errors after every command and expects the answers to end in CR alone: it is given CR LF."""
    ports = bench[1]
    if request.param == "tcp":
        opened = NewportESP301.open_tcpip("127.0.0.1", int(ports.tcp.rpartition(":")[2]))
    else:
        opened = NewportESP301.open_serial(ports.pty, baud=19200)
    yield opened
    opened._file._conn.close()  # its own close complains of sockets already shut


def settle(axis: Any) -> None:
    while not axis.is_motion_done:
        pass


def test_instrumentkit_homes_moves_and_reads_back(client: Any, bench: tuple[Esp301, Ports]) -> None:
    axis = client.axis[0]
    assert axis.units == quantities.deg
    axis.enable()
    axis.search_for_home(search_mode=1)
    settle(axis)
    assert float(axis.position) == 0.0
    axis.velocity = 10.0  # slow enough to be caught under way
    axis.move(45.0)
    assert not axis.is_motion_done
    settle(axis)
    assert float(axis.position) == pytest.approx(45.0, abs=1e-3)
    assert float(axis.desired_position) == 45.0
    axis.move(-15.0, absolute=False)
    settle(axis)
    esp = bench[0]
    assert esp.axes[0].track.nominal(esp._clock.now())[0] == pytest.approx(30.0, abs=1e-3)


def test_instrumentkit_reads_and_sets_the_profile_in_its_units(client: Any) -> None:
    axis = client.axis[1]
    assert float(axis.velocity) == 60.0
    axis.velocity = quantities.Quantity(20.0, "deg/s")
    assert float(axis.velocity) == 20.0
    assert float(client.axis[0].velocity) == 60.0
    axis.units = 9
    assert float(axis.velocity) == pytest.approx(0.349066, abs=1e-6)
    assert float(axis.right_limit) == pytest.approx(6.283185, abs=1e-6)


def test_instrumentkit_stops_and_waits(client: Any) -> None:
    axis = client.axis[0]
    axis.enable()
    axis.search_for_home(search_mode=2)
    settle(axis)
    axis.velocity = 2.0
    axis.move(300.0)
    axis.stop_motion()
    axis.wait_for_stop()
    assert axis.is_motion_done
    assert 0 <= float(axis.position) < 299.0


@pytest.mark.parametrize(
    ("provoke", "axis", "code"),
    [
        (lambda client: client.axis[0].move(5.0), 1, 13),
        (lambda client: client.axis[1].search_for_home(search_mode=1), 2, 13),
        (lambda client: client._newport_cmd("ZZ", target=1), None, 6),
        (lambda client: client._newport_cmd("PA", target=1), None, 38),
        (lambda client: client._newport_cmd("PA", params=[1.0]), None, 37),
        (lambda client: setattr(client.axis[0], "velocity", 500.0), 1, 10),
    ],
)
def test_instrumentkit_is_told_of_errors(client: Any, provoke: Callable[[Any], None], axis: int | None, code: int) -> None:
    with pytest.raises(NewportError) as caught:
        provoke(client)
    assert (caught.value.axis, caught.value.errcode) == (axis, code)


# PyMeasure


@pytest.fixture
def esp300(bench: tuple[Esp301, Ports]) -> Iterator[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyVISA-py tells of interfaces it was built without
        from pymeasure.adapters import VISAAdapter  # type: ignore[import-not-found]
        from pymeasure.instruments.newport import ESP300  # type: ignore[import-not-found]

        adapter = VISAAdapter(
            f"ASRL{bench[1].pty}::INSTR",
            visa_library="@py",
            baud_rate=19200,
            write_termination="\r",
            read_termination="\r\n",
            timeout=10_000,
        )
        yield ESP300(adapter)
        adapter.close()


@no_pymeasure
def test_pymeasure_homes_moves_waits_and_reads_back(esp300: Any) -> None:
    esp300.clear_errors()
    for axis in (esp300.x, esp300.y):
        assert axis.units == "degree"
        assert not axis.enabled
        axis.enable()
        assert axis.enabled
        axis.home()
    for axis, deg in ((esp300.x, 90.0), (esp300.y, 12.5)):
        axis.wait_for_stop()
        assert axis.position == 0.0
        axis.position = deg
        axis.wait_for_stop()
        assert axis.motion_done
        assert axis.position == deg
    esp300.x.define_position(1.0)
    assert esp300.x.position == 1.0
    assert (esp300.x.left_limit, esp300.x.right_limit) == (0.0, 360.0)
    assert esp300.errors == []


@no_pymeasure
def test_pymeasure_reads_the_error_queue(esp300: Any) -> None:
    esp300.x.position = 5.0
    esp300.phi.enable()
    esp300.write("1ZZ")
    assert [str(error).rpartition(": ")[2] for error in esp300.errors] == [
        "MOTOR NOT ENABLED",
        "MOTOR / STAGE NOT CONNECTED",
        "COMMAND DOES NOT EXIST",
    ]
    assert esp300.error == 0
