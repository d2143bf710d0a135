"""The quantum sensor's registers: floats high word first, whole numbers, settings and their saving."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.apogee import QuantumModel, QuantumSensor
from sim.clock import ManualClock
from sim.errors import SimError
from sim.modbus import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusBus, Refusal, crc

LATE = 10.3


def make(flux: float = 1234.5677, **model: float) -> QuantumSensor:
    unit = QuantumModel(**({"noise": 0.0} | model))  # type: ignore[arg-type]
    return QuantumSensor(lambda t0, t1: flux, np.random.default_rng(1), unit)


def number(sensor: QuantumSensor, register: int, t: float = LATE) -> float:
    words = sensor.read_holding(t, register, 2)
    return float(struct.unpack(">f", struct.pack(">2H", *words))[0])


def words(*values: float) -> Sequence[int]:
    return struct.unpack(f">{2 * len(values)}H", struct.pack(f">{len(values)}f", *values))


def test_a_frame_by_hand() -> None:
    clock = ManualClock()
    clock.set(LATE)
    bus = ModbusBus(clock, {1: make()}, "lamp", "apogee-sq-422x")
    reply = bytes.fromhex("01 03 04 44 9A 52 2B")  # 1234.5677
    assert bus.answer(bytes.fromhex("01 03 00 00 00 02 C4 0B")) == reply + crc(reply)
    refused = bytes.fromhex("01 84 01")  # no input registers
    assert bus.answer(bytes.fromhex("01 04 00 CA 00 02 51 F5")) == refused + crc(refused)


@pytest.mark.parametrize(
    ("register", "value"),
    [
        (0, 1234.5677),
        (2, 12.345677),
        (4, 1419.7528),
        (6, 1234.5677),
        (12, 1.0),
        (16, 1),
        (18, 422),
        (20, 1234),
        (22, 3),
        (24, 2),
        (26, 1),
        (28, 100),
    ],
)
def test_floats_of_the_sheet(register: int, value: float) -> None:
    assert number(make(), register) == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize(("register", "value"), [(40, 12346), (41, 123), (42, 14198), (43, 12346), (45, 0), (46, 10)])
def test_whole_numbers_of_the_sheet(register: int, value: int) -> None:
    assert make().read_holding(LATE, register, 1) == [value]


def test_it_measures_every_period_and_is_busy_with_it() -> None:
    windows: list[tuple[float, float]] = []

    def flux(t0: float, t1: float) -> float:
        windows.append((t0, t1))
        return 100 * t1

    sensor = QuantumSensor(flux, np.random.default_rng(1), QuantumModel(noise=0.0, period=0.5, busy=0.02))
    assert [number(sensor, 0, t) for t in (0.3, 0.6, 0.9, 1.1)] == [0.0, 50.0, 50.0, 100.0]
    assert windows == [(0.0, 0.5), (0.5, 1.0)]
    assert [number(sensor, 10, t) for t in (0.51, 0.53, 1.01)] == [1.0, 0.0, 1.0]


def test_noise_and_full_scale() -> None:
    noisy = make(100.0, noise=2.0)
    assert np.std([number(noisy, 0, t) for t in np.arange(1.0, 300.0)]) == pytest.approx(2.0, rel=0.2)
    assert number(make(5000.0), 0) == 4000.0


def test_settings_take_effect_with_the_save() -> None:
    sensor = make()
    sensor.write_holding(LATE, 16, words(7))
    sensor.write_holding(LATE, 22, words(4, 0))
    assert (sensor.address, number(sensor, 22)) == (1, 3)
    sensor.write_holding(LATE, 100, (1,))
    assert (sensor.address, number(sensor, 22), number(sensor, 24)) == (7, 4, 0)
    sensor.write_holding(LATE, 16, words(255))
    sensor.write_holding(LATE, 100, (1,))
    assert (sensor.address, number(sensor, 22)) == (1, 3)
    sensor.write_holding(LATE, 190, (1,))


@pytest.mark.parametrize(
    ("address", "values", "code"),
    [(16, words(0), ILLEGAL_VALUE), (16, words(300), ILLEGAL_VALUE), (16, words(1.5), ILLEGAL_VALUE), (22, words(5), ILLEGAL_VALUE),
     (36, words(float("nan")), ILLEGAL_VALUE), (28, words(2.0), ILLEGAL_ADDRESS), (0, words(1.0), ILLEGAL_ADDRESS),
     (16, (1,), ILLEGAL_ADDRESS), (17, (1, 2), ILLEGAL_ADDRESS)],
)  # fmt: skip
def test_refusals(address: int, values: Sequence[int], code: int) -> None:
    with pytest.raises(Refusal) as caught:
        make().write_holding(LATE, address, values)
    assert caught.value.code == code


@pytest.mark.parametrize("wrong", [{"busy": 1.0}, {"full_scale": 0.0}, {"noise": -1.0}, {"serial_number": 1 << 24}])
def test_impossible_models(wrong: dict[str, float]) -> None:
    with pytest.raises(SimError):
        make(**wrong)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 250), st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=8))
def test_no_writing_can_upset_it(address: int, values: list[int]) -> None:
    sensor = make(100.0)
    try:
        sensor.write_holding(LATE, address, values)
    except Refusal:
        pass
    sensor.write_holding(LATE, 100, (1,))
    assert number(sensor, 0) == 100.0
