"""The luminance meters: commands and codes of the sheet, timing, ranges."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.konica_minolta import Photometer, PhotometerModel
from tests.sim.lines import Recorder


class Desk:
    """A meter whose luminance and clock are in hand."""

    def __init__(self, luminance: float | Callable[[float], float] = 123.4, *, noise: float = 0.0, colour: bool = False) -> None:
        self.clock = ManualClock(eager=True)
        self.luminance: Callable[[float], float] = luminance if callable(luminance) else lambda t: luminance
        self.chromaticity = (0.31, 0.33)
        self.windows: list[tuple[float, float]] = []
        unit = PhotometerModel(colour=colour, noise=noise, varied=2.0)
        self.meter = Photometer(self.clock, self._signal, np.random.default_rng(2), unit, chroma=lambda t0, t1: self.chromaticity)

    def _signal(self, t0: float, t1: float) -> float:
        self.windows.append((t0, t1))
        return self.luminance((t0 + t1) / 2)

    def ask(self, command: bytes) -> bytes:
        return asyncio.run(self.meter.answer(command))


def test_readings_of_the_sheet() -> None:
    assert Desk().ask(b"MES") == b"OK00,   123.4"
    assert Desk(colour=True).ask(b"MES") == b"OK00,  123.4,.3100,.3300"


@pytest.mark.parametrize(
    ("luminance", "text"),
    [(0.0, b"0.000"), (1.23449, b"1.234"), (9.9996, b"10.00"), (99.996, b"100.0"), (999.96, b"1000"), (54321.4, b"54321")],
)
def test_four_digits(luminance: float, text: bytes) -> None:
    assert Desk(luminance).ask(b"MES").split()[-1] == text


@pytest.mark.parametrize("mode", [b"00", b"01", b"04", b"06", b"07", b"08", b"09"])
def test_modes_of_the_sheet(mode: bytes) -> None:
    assert Desk().ask(b"MDS," + mode) == b"OK00"


@pytest.mark.parametrize(
    ("command", "reply"),
    [(b"MDS,10", b"ER01"), (b"MDS,4", b"ER01"), (b"MDS", b"ER01"), (b"MDS,05", b"ER01"), (b"MEZ", b"ER00"), (b"MES,1", b"ER00"),
     (b"", b"ER00"), (b"TDR", b"ER00"), (b"CLE", b"OK00")],
)  # fmt: skip
def test_codes(command: bytes, reply: bytes) -> None:
    assert Desk().ask(command) == reply


def test_too_bright_and_too_dark() -> None:
    assert Desk(3e5).ask(b"MES") == b"ER10"
    assert Desk(3e5, colour=True).ask(b"MES").startswith(b"OK12")
    assert Desk(1e-4, colour=True).ask(b"MES").startswith(b"OK13")
    saturated = Desk(50.0, colour=True)
    saturated.chromaticity = (0.9, 0.3)
    assert saturated.ask(b"MES").startswith(b"OK11,  50.00")


def test_faults_answer_everything() -> None:
    desk = Desk()
    desk.meter.battery_low = True
    assert desk.ask(b"MES") == desk.ask(b"MDS,04") == b"ER30"
    desk.meter.battery_low, desk.meter.eeprom_fault = False, True
    assert desk.ask(b"MES") == b"ER20"


@pytest.mark.parametrize(("mode", "integration"), [(b"MDS,06", 0.1), (b"MDS,07", 0.4)])
def test_fast_and_slow(mode: bytes, integration: float) -> None:
    desk = Desk()
    desk.ask(mode)
    desk.ask(b"MES")
    begin, end = desk.windows[0]
    assert end - begin == pytest.approx(integration)
    assert desk.clock.now() == pytest.approx(integration + 0.8)


def test_slow_is_steadier() -> None:
    def spread(mode: bytes) -> float:
        desk = Desk(1000.0, noise=1e-2, colour=True)
        desk.ask(mode)
        return float(np.std([float(desk.ask(b"MES").split(b",")[1]) for _ in range(200)]))

    assert spread(b"MDS,06") == pytest.approx(10.0, rel=0.2)
    assert spread(b"MDS,07") == pytest.approx(5.0, rel=0.2)


def test_peak_and_varied_calibration() -> None:
    desk = Desk(lambda t: 200.0 if t < 1 else 100.0)
    desk.ask(b"MDS,08")
    assert [desk.ask(b"MES").split()[-1] for _ in range(2)] == [b"200.0", b"200.0"]
    desk.ask(b"MDS,09")
    assert desk.ask(b"MES").split()[-1] == b"100.0"
    desk.ask(b"MDS,01")
    assert desk.ask(b"MES").split()[-1] == b"200.0"


@pytest.mark.parametrize("wrong", [{"lowest": 0.0}, {"fast": 0.5}, {"overhead": -1.0}, {"varied": 0.0}])
def test_impossible_models(wrong: dict[str, float]) -> None:
    with pytest.raises(SimError):
        PhotometerModel(**wrong)  # type: ignore[arg-type]


def served(*pieces: bytes, remote: bool = True) -> list[bytes]:
    async def scene() -> list[bytes]:
        clock, line = ManualClock(eager=True), Recorder()
        meter = Photometer(clock, lambda t0, t1: 5.0, np.random.default_rng(0), PhotometerModel(noise=0.0))
        meter.remote = remote
        for piece in (*pieces, b""):
            line.said.put_nowait(piece)
        await meter.serve(line)
        return line.heard

    return asyncio.run(scene())


def test_the_wire() -> None:
    assert served(b"MDS,0", b"4\r\nMES\r", b"\n") == [b"OK00\r\n", b"OK00,   5.000\r\n"]
    assert served(b"x" * 100 + b"\r\nCLE\r\n") == [b"OK00\r\n", b"ER00\r\n"]


def test_out_of_remote_mode_it_is_silent() -> None:
    assert served(b"MDS,04\r\nMES\r\n", remote=False) == []


@settings(max_examples=200, deadline=None)
@given(st.one_of(st.binary(max_size=40), st.text("MDSECL,0123456789 ", max_size=12).map(str.encode)))
def test_no_bytes_can_upset_it(command: bytes) -> None:
    desk = Desk()
    reply = desk.ask(command)
    assert re.fullmatch(rb"(OK|ER)\d\d(, *[\d.]+)?", reply)
    desk.ask(b"MDS,00")
    desk.ask(b"MDS,09")
    assert desk.ask(b"MES") == b"OK00,   123.4"
