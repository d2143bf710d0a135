"""The triangulation sensor: commands of the sheet, the stream bit by bit and in time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.optoncdt import OptoNCDT, TriangulationModel, packed
from tests.sim.lines import Recorder

Distance = Callable[[float, float], float | None]


def make(distance: Distance = lambda t0, t1: 25.0, clock: ManualClock | None = None, **model: float) -> OptoNCDT:
    unit = TriangulationModel(**({"noise": 0.0} | model))  # type: ignore[arg-type]
    return OptoNCDT(clock or ManualClock(), distance, np.random.default_rng(3), unit)


def test_a_word_by_hand() -> None:
    # 25 of 50 mm: (0.5 + 0.01) * 65520 / 1.02 = 32760 = 000111 111111 111000
    assert packed(32760) == b"\x38\x7f\x87"
    assert make()._word(0.0, 1.0) == 32760


@pytest.mark.parametrize(
    ("distance", "word"), [(0.0, 642), (50.0, 64878), (-0.5, 0), (50.5, 65520), (51.0, 262077), (-0.6, 262077), (None, 262077)]
)
def test_the_ends_of_the_range(distance: float | None, word: int) -> None:
    assert make(lambda t0, t1: distance)._word(0.0, 1.0) == word


def test_noise() -> None:
    unit = make(noise=0.05)
    words = np.array([unit._word(0.0, 1.0) for _ in range(500)])
    assert np.std(words) * 1.02 / 65520 * 50 == pytest.approx(0.05, rel=0.15)


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        (b"OUTPUT", "OUTPUT NONE"),
        (b"output rs422", "OUTPUT RS422"),
        (b"OUTPUT ANALOG", "OUTPUT ANALOG"),
        (b"OUTPUT USB", "E230 Unknown parameter"),
        (b"OUTPUT RS422 NONE", "E232 Wrong parameter count"),
        (b"MEASRATE 2", "MEASRATE 2"),
        (b"MEASRATE 0.250", "MEASRATE 0.25"),
        (b"MEASRATE 3", "E236 Value is out of range or the format is invalid"),
        (b"ECHO", "ECHO ON"),
        (b"LOGIN 123", "E202 Access denied"),
        (b"LOGIN 000", "LOGIN"),
        (b"GETUSERLEVEL", "GETUSERLEVEL PROFESSIONAL"),
        (b"RESETCNT", "RESETCNT"),
        (b"NONSENSE", "E210 Unknown command"),
        (b"MASTERMV", "E212 Command not available in current context"),
        (b"", ""),
    ],
)
def test_commands(command: bytes, reply: str) -> None:
    assert make().answer(command) == reply


def test_info() -> None:
    lines = make().answer(b"GETINFO").split("\r\n")
    assert [line.partition(":")[0] for line in lines] == [
        "GETINFO", "Name", "Serial", "Option", "Article", "Cable head", "Measuring range", "Version", "Hardware-rev", "Boot-version",
    ]  # fmt: skip
    assert lines[6].split()[-1] == "50.00mm"


def test_users_may_not_change_settings() -> None:
    unit = make()
    unit.answer(b"LOGOUT")
    assert unit.answer(b"OUTPUT RS422") == unit.answer(b"MEASRATE 1") == "E202 Access denied"
    assert unit.answer(b"OUTPUT") == "OUTPUT NONE"
    unit.answer(b"LOGIN 000")
    assert unit.answer(b"OUTPUT RS422") == "OUTPUT RS422"


def test_reset_forgets_and_echo_can_be_off() -> None:
    unit = make()
    assert unit.answer(b"ECHO OFF") == ""
    assert unit.answer(b"MEASRATE 4") == ""
    assert unit.answer(b"MEASRATE") == "MEASRATE 4"
    unit.answer(b"RESET")
    assert unit.answer(b"MEASRATE 2") == "MEASRATE 2"


@pytest.mark.parametrize("wrong", [{"measuring_range": 30.0}, {"noise": -1.0}, {"no_target": 65520}, {"no_target": 1 << 18}])
def test_impossible_models(wrong: dict[str, float]) -> None:
    with pytest.raises(SimError):
        make(**wrong)


def served(*said: bytes | float, distance: Distance = lambda t0, t1: 25.0) -> list[bytes]:
    """Say things and let time pass (s) in turn; return what was heard."""

    async def scene() -> list[bytes]:
        clock, line = ManualClock(), Recorder()
        task = asyncio.create_task(make(distance, clock).serve(line))
        for piece in said:
            if isinstance(piece, bytes):
                line.said.put_nowait(piece)
            await clock.advance(0.0 if isinstance(piece, bytes) else piece)
        line.said.put_nowait(b"")
        await task
        return line.heard

    return asyncio.run(scene())


def test_the_wire() -> None:
    assert served(b"OUT", b"PUT\r\n", b"\r\nECHO\n") == [b"OUTPUT NONE\r\n->", b"ECHO ON\r\n->"]
    assert served(b"x" * 300 + b"\r\n") == [b"E214 Entered command is too long to be processed\r\n->"]


@pytest.mark.parametrize(("rate", "count"), [(b"1", 200), (b"4", 800), (b"0.25", 50)])
def test_the_stream_keeps_its_rate(rate: bytes, count: int) -> None:
    heard = served(b"MEASRATE " + rate + b"\r\n", b"OUTPUT RS422\r\n", 0.2001, b"OUTPUT NONE\r\n", 0.1)
    assert heard[1] == b"OUTPUT RS422\r\n->"
    assert heard[-1] == b"OUTPUT NONE\r\n->"
    assert b"".join(heard[2:-1]) == count * packed(32760)


def test_every_value_is_measured_after_the_stream_was_switched_on() -> None:
    begun: list[float] = []

    def distance(t0: float, t1: float) -> float:
        begun.append(t0)
        return 25.0

    served(0.0123, b"OUTPUT RS422\r\n", 0.0101, b"OUTPUT NONE\r\n", 0.05, b"OUTPUT RS422\r\n", 0.0101, distance=distance)
    assert begun == pytest.approx([0.0123 + 1e-3 * i for i in range(10)] + [0.0724 + 1e-3 * i for i in range(10)])


@settings(max_examples=200, deadline=None)
@given(st.one_of(st.binary(max_size=40), st.text("OUTPENSRA 0142.", max_size=16).map(str.encode)))
def test_no_bytes_can_upset_it(command: bytes) -> None:
    unit = make()
    assert unit.answer(command).isascii()
    unit.answer(b"RESET")
    assert unit.answer(b"OUTPUT RS422") == "OUTPUT RS422"
