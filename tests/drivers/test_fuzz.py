"""Decoders against random and mutated frames: a true value, a line passed over or a named error, and nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceError
from drivers.rangefinders.optoncdt1420 import ValueSplitter
from drivers.stages.zaber import parse_message
from tests.drivers.fuzzed import NAMED, Decoder, decoders, edited, mutated, outcome, tally, triple, with_crc, with_lrc

CASES = 100_000
SEED = 20261123
DECODERS = decoders()

edits = st.lists(st.tuples(*[st.integers(0, 1 << 20)] * 3), min_size=1, max_size=4)
noise = st.binary(min_size=1, max_size=64)


@pytest.mark.slow
def test_a_hundred_thousand_cases() -> None:
    """All decoders together; each takes some frames and refuses others, so that neither branch is idle."""
    seen = {}
    for number, decoder in enumerate(DECODERS):
        count = CASES // len(DECODERS) + (number < CASES % len(DECODERS))
        seen[decoder.name] = tally(decoder, mutated(decoder, count, np.random.default_rng((SEED, number))))
    assert sum(seen.values(), Counter[str]()).total() == CASES
    idle = {name for name, outcomes in seen.items() if not outcomes["accepted"] or (outcomes["accepted"] == outcomes.total())}
    assert idle == {"optoNCDT stream", "optoNCDT GETINFO"}  # a stream of values or texts is never refused, only thinned


@pytest.mark.parametrize("decoder", DECODERS, ids=lambda decoder: decoder.name)
def test_frames_of_the_sheet_are_taken(decoder: Decoder) -> None:
    """The first one of each; the others include refusals and frames for somebody else."""
    assert outcome(decoder, decoder.seal(decoder.frames[0])) == "accepted"
    for frame in decoder.frames:
        outcome(decoder, decoder.seal(frame))


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(DECODERS), st.integers(0, 99), edits, noise, st.booleans())
def test_any_edits(decoder: Decoder, which: int, edits: list[tuple[int, int, int]], noise: bytes, sealed_afterwards: bool) -> None:
    frame = decoder.frames[which % len(decoder.frames)]
    other = decoder.seal(decoder.frames[(which + 1) % len(decoder.frames)])
    if sealed_afterwards:
        outcome(decoder, decoder.seal(edited(frame, edits, other, noise)))
    else:
        outcome(decoder, edited(decoder.seal(frame), edits, other, noise))


@settings(deadline=None)
@given(st.sampled_from(DECODERS), st.binary(max_size=300))
def test_any_bytes(decoder: Decoder, data: bytes) -> None:
    outcome(decoder, data)
    outcome(decoder, decoder.seal(data))


FOUND = [
    ("ESP error", b"0, 451322, "),
    ("ESP version", b"ESP301    "),
    ("Keithley reading", b"+1.040564E-06A,+2.236299E+02,+1"),
    ("Keithley reading", b"+1.40564E-06A,+2.236299E+02,+1.380000E+02"),
    ("Keithley identity", b"KEITHLEY INSTRUMENTS INC.,MODEL 6485,40\xb879,C01"),
    ("Keithley error", b'0,"No error\x9d"'),
    ("LS-100 reading", b"OK13,\xe6 0.001"),
    ("CS-100A reading", b"OK11,  123\xa2.4,.3100,.3300"),
    ("Minolta setting", b"OK00\x1f"),
    ("optoNCDT answer", b"MEASRATE 1.00_0\r\n"),
]


@pytest.mark.parametrize(("name", "data"), FOUND)
def test_what_was_once_taken_is_not_any_more(name: str, data: bytes) -> None:
    (decoder,) = (decoder for decoder in DECODERS if decoder.name == name)
    assert outcome(decoder, data) in ("UnexpectedReply", "passed over")


CHECKED = [decoder for decoder in DECODERS if decoder.seal is with_crc or decoder.name == "Zaber message"]


@settings(deadline=None)
@given(st.sampled_from(CHECKED), st.integers(0, 99), st.data())
def test_one_damaged_byte_behind_a_checksum_is_noticed(decoder: Decoder, which: int, source: st.DataObject) -> None:
    """Zaber's covers all but the first character, which makes another kind of line."""
    whole = decoder.seal(decoder.frames[which % len(decoder.frames)])
    at = source.draw(st.integers(decoder.seal is with_lrc, len(whole) - 1))
    damaged = whole[:at] + bytes([source.draw(st.integers(0, 255).filter(lambda value: value != whole[at]))]) + whole[at + 1 :]
    assert outcome(decoder, damaged) not in ("accepted", "passed over")


KEITHLEY = next(decoder for decoder in DECODERS if decoder.name == "Keithley reading")


@given(st.sampled_from(KEITHLEY.frames[:2]), st.data())
def test_a_byte_lost_or_doubled_in_a_reading_of_the_meter_is_noticed(whole: bytes, source: st.DataObject) -> None:
    """There is no checksum, but all numbers have the same length."""
    at = source.draw(st.integers(0, len(whole) - 1))
    lost, doubled = whole[:at] + whole[at + 1 :], whole[: at + 1] + whole[at:]
    assert {outcome(KEITHLEY, lost), outcome(KEITHLEY, doubled), outcome(KEITHLEY, whole[:at])} == {"UnexpectedReply"}


@given(st.lists(st.tuples(st.integers(0, (1 << 18) - 1), st.booleans()), max_size=20), st.lists(st.integers(1, 7), min_size=1))
def test_a_stream_is_the_same_in_any_pieces(values: list[tuple[int, bool]], sizes: list[int]) -> None:
    data = b"".join(triple(word, first) for word, first in values)

    def pieces() -> Iterator[bytes]:
        at = number = 0
        while at < len(data):
            yield data[at : at + sizes[number % len(sizes)]]
            at += sizes[number % len(sizes)]
            number += 1

    splitter = ValueSplitter()
    assert [frame for piece in pieces() for frame in splitter.feed(piece)] == [triple(word, first) for word, first in values]


@pytest.mark.parametrize("frame", ["01 06 00 7D 00 10 18 1E", "01 03 00 CC 00 02 04 34", "01 04 00 CA 00 02 51 F5"])
def test_checksums_are_those_of_the_sheet(frame: str) -> None:
    assert with_crc(bytes.fromhex(frame)[:-2]) == bytes.fromhex(frame)
    assert with_lrc(b"/1 1 34 move abs 1000") == b"/1 1 34 move abs 1000:E9"


def test_mutations_are_those_of_the_seed() -> None:
    """And differ from frame to frame."""
    one, again, other = (list(mutated(DECODERS[0], 500, np.random.default_rng(seed))) for seed in (1, 1, 2))
    assert one == again != other
    assert len(set(one)) > 450


# a check that could not fail would prove nothing ----------------------------------------------------------------------


def deaf(data: bytes) -> object:
    """Read without looking at the checksum."""
    return parse_message(data.partition(b":")[0], checksum_required=False)


def careless(data: bytes) -> object:
    """Break in an unnamed way on what is not ASCII."""
    return parse_message(data.decode("ascii").encode())


@pytest.mark.parametrize("broken", [deaf, careless])
def test_a_decoder_that_is_wrong_is_found_out(broken: object) -> None:
    right = DECODERS[0]
    wrong = Decoder(right.name, broken, right.frames, right.says, right.seal)  # type: ignore[arg-type]
    with pytest.raises(AssertionError, match="Zaber message"):
        tally(wrong, mutated(wrong, 1000, np.random.default_rng(SEED)))


def test_only_what_a_frame_can_cause_is_named() -> None:
    assert all(issubclass(kind, DeviceError) for kind in NAMED)
