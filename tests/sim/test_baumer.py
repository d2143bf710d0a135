"""The distance sensor's registers: whole parameters, low word first, dropout, zero, laser."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.baumer import CRITICAL, WEAK, DistanceSensor, RangeModel
from sim.clock import ManualClock
from sim.errors import SimError
from sim.modbus import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusBus, Refusal, crc

LATE = 10.0


def make(distance: float | Callable[[float], float | None] | None = 69.74261, **model: float) -> DistanceSensor:
    unit = RangeModel(**({"noise": 0.0} | model))  # type: ignore[arg-type]
    return DistanceSensor(lambda t0, t1: distance((t0 + t1) / 2) if callable(distance) else distance, np.random.default_rng(1), unit)


def words(value: float) -> tuple[int, int]:
    high, low = struct.unpack(">2H", struct.pack(">f", value))
    return low, high


def number(pair: Sequence[int]) -> float:
    return float(struct.unpack(">f", struct.pack(">2H", pair[1], pair[0]))[0])


def distance(sensor: DistanceSensor, t: float = LATE) -> float:
    return number(sensor.read_input(t, 202, 2))


def test_the_distance_of_the_sheet() -> None:
    clock = ManualClock()
    clock.set(LATE)
    bus = ModbusBus(clock, {1: make()}, "range", "baumer-om20")
    reply = bytes.fromhex("01 04 04 7C 37 42 8B")
    assert bus.answer(bytes.fromhex("01 04 00 CA 00 02 51 F5")) == reply + crc(reply)


def test_the_block_is_the_rows_in_one_read() -> None:
    sensor = make()
    rows = [(200, 1), (201, 1), (202, 2), (204, 2), (206, 1), (207, 2), (209, 2), (211, 2)]
    block = sensor.read_input(LATE, 200, 13)
    assert block == [word for address, count in rows for word in sensor.read_input(LATE, address, count)]
    assert number(block[4:6]) == 500.0
    assert block[9] == 10  # s


@pytest.mark.parametrize(("address", "count"), [(202, 1), (203, 1), (201, 3), (200, 12), (0, 15), (1, 16), (500, 1), (110, 6)])
def test_only_whole_parameters(address: int, count: int) -> None:
    with pytest.raises(Refusal) as caught:
        make().read_input(LATE, address, count)
    assert caught.value.code == ILLEGAL_ADDRESS


def test_texts() -> None:
    sensor = make()
    vendor = struct.pack(">16H", *sensor.read_input(LATE, 0, 16)).rstrip(b"\0")
    serial_number = struct.pack(">10H", *sensor.read_input(LATE, 95, 10)).rstrip(b"\0")
    assert (vendor, serial_number) == (b"Baumer Electric AG", b"700001234")


def test_a_lost_target_is_held_for_the_dropout_time_and_then_nan() -> None:
    sensor = make(lambda t: 70.0 if t < 1.0 else None)
    assert distance(sensor, 0.999) == 70.0
    assert distance(sensor, 1.05) == 70.0
    assert sensor.read_input(1.05, 200, 1) == [CRITICAL]
    assert sensor.read_discrete(1.05, 0, 2) == [True, True]
    assert math.isnan(distance(sensor, 1.2))
    assert sensor.read_discrete(1.2, 0, 2) == [False, True]
    sensor.write_holding(0.0, 800, (0,))
    assert math.isnan(distance(sensor, 1.01))


@pytest.mark.parametrize("away", [49.0, 151.0, None])
def test_beyond_the_range_there_is_no_target(away: float | None) -> None:
    assert math.isnan(distance(make(away)))


def test_the_range_can_be_narrowed_and_not_widened() -> None:
    sensor = make()
    sensor.write_holding(LATE, 200, words(80.0))
    assert math.isnan(distance(sensor))
    for address, value in ((200, 40.0), (200, 150.0), (202, 151.0), (202, math.nan)):
        with pytest.raises(Refusal) as caught:
            sensor.write_holding(LATE, address, words(value))
        assert caught.value.code == ILLEGAL_VALUE


def test_zero_position() -> None:
    sensor = make(70.0)
    sensor.write_holding(LATE, 180, words(20.0))
    assert distance(sensor) == 50.0
    sensor.write_holding(LATE, 185, (1,))
    assert distance(sensor) == 0.0
    assert sensor.read_holding(LATE, 185, 1) == [0xFFFF]
    sensor.write_holding(LATE, 503, (1,))
    assert distance(sensor) == 70.0


def test_without_the_laser_nothing_new_is_measured() -> None:
    sensor = make(lambda t: 70.0 + t)
    sensor.write_holding(10.0, 410, (0,))
    assert sensor.read_input(10.0, 200, 13)[-4:] == sensor.read_input(20.0, 200, 13)[-4:]
    assert distance(sensor, 20.0) == pytest.approx(80.0, abs=0.01)
    sensor.write_holding(20.0, 410, (1,))
    assert distance(sensor, 21.0) == pytest.approx(91.0, abs=0.01)


def test_timestamps_count_measurements() -> None:
    sensor = make(rate=100.0)
    stamps = [sensor.read_input(t, 211, 2)[0] for t in (1.001, 1.009, 1.011)]
    assert stamps == [0, 0, 10_000]


def test_quality_noise_and_time() -> None:
    sensor = make(70.0, noise=0.05)
    sensor.quality = WEAK
    assert sensor.read_input(LATE, 200, 1) == [WEAK]
    assert np.std([distance(sensor, t) for t in np.arange(10.1, 60.0, 0.1)]) == pytest.approx(0.05, rel=0.15)
    sensor.write_holding(61.0, 1000, (1,))
    assert sensor.read_input(65.0, 301, 2) == [65, 0]
    assert sensor.read_input(65.0, 303, 2) == [4, 0]


@pytest.mark.parametrize(
    ("address", "values", "code"),
    [(101, (4,), ILLEGAL_VALUE), (410, (2,), ILLEGAL_VALUE), (1100, (0,), ILLEGAL_VALUE), (304, (2, 0), ILLEGAL_VALUE),
     (200, (1,), ILLEGAL_ADDRESS), (201, (1,), ILLEGAL_ADDRESS), (999, (1,), ILLEGAL_ADDRESS)],
)  # fmt: skip
def test_refusals(address: int, values: Sequence[int], code: int) -> None:
    with pytest.raises(Refusal) as caught:
        make().write_holding(LATE, address, values)
    assert caught.value.code == code


def test_teaching_without_a_target_is_refused() -> None:
    with pytest.raises(Refusal):
        make(None).write_holding(LATE, 185, (1,))


def test_tags_are_kept() -> None:
    sensor = make()
    sensor.write_holding(LATE, 1066, range(16))
    assert list(sensor.read_holding(LATE, 1066, 16)) == list(range(16))


@pytest.mark.parametrize("wrong", [{"near": 200.0}, {"rate": 0.0}, {"noise": -1.0}, {"dropout": -1}])
def test_impossible_models(wrong: dict[str, float]) -> None:
    with pytest.raises(SimError):
        make(**wrong)


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from([101, 180, 185, 200, 202, 300, 304, 400, 402, 410, 503, 800, 1050, 1100, 7]),
    st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=3),
)
def test_no_writing_can_upset_it(address: int, values: list[int]) -> None:
    sensor = make()
    try:
        sensor.write_holding(1.0, address, values)
    except Refusal:
        pass
    assert len(sensor.read_input(LATE, 200, 13)) == 13
    sensor.write_holding(LATE, 503, (1,))
    assert distance(sensor, 2 * LATE) == pytest.approx(69.74261, abs=1e-5)
