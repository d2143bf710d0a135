"""Traces read and played again, from files written by hand."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.errors import SimError
from sim.replay import Divergence, Event, Replay, Replayed, Trace, in_background, load
from tests.sim.lines import Recorder

STARTED = datetime(2024, 5, 1, 12, tzinfo=UTC)
HEAD = '{"trace": 1, "started": "2024-05-01T12:00:00+00:00", "program": "rig"}'


def line(way: str, data: bytes, port: str = "a", t: float = 0.5) -> str:
    return json.dumps({"t": t, "port": port, "way": way, "hex": data.hex()})


def written(folder: Path, *lines: str, end: str = "\n") -> Path:
    path = folder / "trace.jsonl"
    path.write_text("\n".join([HEAD, *lines]) + end, encoding="utf-8")
    return path


def trace(*said: tuple[str, bytes] | tuple[str, bytes, str]) -> Trace:
    path = Path("trace.jsonl")
    events = (Event(0.0, *(rest or ["a"]), way, data, number) for number, (way, data, *rest) in enumerate(said, 2))
    return Trace(path, STARTED, tuple(events))


def played(replay: Replay, *said: bytes) -> list[bytes]:
    """Say things to a replay over one connection; return what was written, in as many pieces."""

    async def play() -> list[bytes]:
        tape = Recorder()
        for piece in (*said, b""):
            tape.said.put_nowait(piece)
        await replay.serve(tape)
        return [data for data in tape.heard if data]

    return asyncio.run(play())


# Files


def test_a_trace_by_hand(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        '{"t": 0, "port": "sim:stages", "way": "tx", "hex": "2f310a"}',
        '{"t": 0.0125, "port": "sim:stages", "way": "rx", "hex": "403031"}',
        '{"t": 0.2, "port": "sim:meter", "way": "rx", "hex": "", "more": null}',
    )
    found = load(path)
    assert (found.path, found.started, found.about["program"]) == (path, STARTED, "rig")
    assert found.events == (
        Event(0, "sim:stages", "tx", b"/1\n", 2),
        Event(0.0125, "sim:stages", "rx", b"@01", 3),
        Event(0.2, "sim:meter", "rx", b"", 4),
    )
    assert found.ports == ("sim:stages", "sim:meter")
    assert load(written(tmp_path)).events == ()


def test_a_torn_last_line_is_left_out(tmp_path: Path) -> None:
    whole = (line("tx", b"A"), line("rx", b"1"))
    last = line("rx", "µ".encode())
    for cut in range(len(last)):
        assert len(load(written(tmp_path, *whole, last[:cut], end="")).events) == 2
    assert len(load(written(tmp_path, *whole, last, end="")).events) == 3


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ("", "not a JSON object"),
        ("{", "not a JSON object"),
        ("[1, 2]", "not a JSON object"),
        ("[" * 100_000, "not a JSON object"),
        ('{"port": "a", "way": "tx", "hex": "00"}', "t None"),
        ('{"t": -1, "port": "a", "way": "tx", "hex": "00"}', "t -1"),
        ('{"t": NaN, "port": "a", "way": "tx", "hex": "00"}', "t nan"),
        ('{"t": true, "port": "a", "way": "tx", "hex": "00"}', "t True"),
        ('{"t": "1", "port": "a", "way": "tx", "hex": "00"}', "t '1'"),
        ('{"t": 1, "port": "", "way": "tx", "hex": "00"}', "port ''"),
        ('{"t": 1, "port": 3, "way": "tx", "hex": "00"}', "port 3"),
        ('{"t": 1, "port": "a", "way": "up", "hex": "00"}', "way 'up'"),
        ('{"t": 1, "port": "a", "way": ["tx"], "hex": "00"}', "way"),
        ('{"t": 1, "port": "a", "way": "tx", "hex": "0"}', "hex '0'"),
        ('{"t": 1, "port": "a", "way": "tx", "hex": "zz"}', "hex 'zz'"),
        ('{"t": 1, "port": "a", "way": "tx"}', "hex None"),
    ],
)
def test_damage_is_named_with_its_line(tmp_path: Path, wrong: str, why: str) -> None:
    with pytest.raises(SimError) as caught:
        load(written(tmp_path, line("tx", b"A"), wrong, line("rx", b"1")))
    assert str(caught.value).startswith(f"trace {tmp_path / 'trace.jsonl'}, line 3: {why}")


@pytest.mark.parametrize(
    "head",
    ["", "{", "[]", "{}", '{"trace": "1"}', '{"trace": true}', '{"trace": 2, "started": "2024-05-01"}', '{"trace": 1}',
     '{"trace": 1, "started": "yesterday"}', '{"trace": 1, "started": 3}'],
)  # fmt: skip
def test_what_does_not_begin_as_a_trace_is_refused(tmp_path: Path, head: str) -> None:
    path = tmp_path / "trace.jsonl"
    for end in ("", "\n", "\n" + line("tx", b"A") + "\n"):
        path.write_text(head + end, encoding="utf-8")
        with pytest.raises(SimError, match="line 1"):
            load(path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(SimError, match="No such file"):
        load(tmp_path / "none.jsonl")


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 400), st.binary(max_size=4), st.integers(0, 4))
def test_damaged_files_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, place: int, noise: bytes, lost: int) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.jsonl"
    text = "\n".join([HEAD, line("tx", b"ABC"), line("rx", b"123"), line("tx", b"DEF", "b"), ""]).encode()
    path.write_bytes(text[:place] + noise + text[place + lost :])
    with contextlib.suppress(SimError):
        assert len(load(path).events) <= 4


# Replays


def test_requests_are_answered_as_they_were() -> None:
    replay = Replay(trace(("tx", b"A\n"), ("rx", b"1"), ("rx", b"2\n"), ("tx", b"B\n"), ("tx", b"C\n"), ("rx", b"3\n")), "a")
    assert not replay.finished
    assert played(replay, b"A\n", b"B\n", b"C\n") == [b"12\n", b"3\n"]
    assert replay.finished
    assert replay.divergences == []


def test_identical_requests_are_used_up_in_their_order_on_any_connection() -> None:
    replay = Replay(trace(*((way, data) for i in b"123" for way, data in (("tx", b"P?\n"), ("rx", bytes([i]))))), "a")
    assert played(replay, b"P?\n") == [b"1"]
    assert played(replay, b"P?\nP?\n") == [b"2", b"3"]
    assert replay.finished
    assert played(replay, b"P?\n") == []
    assert replay.divergences == [Divergence(b"P?\n", None, b"")]
    assert "nothing more was expected" in str(replay.divergences[0])


def test_another_order_is_served_too() -> None:
    replay = Replay(trace(("tx", b"A\n"), ("rx", b"1"), ("tx", b"B\n"), ("rx", b"2"), ("tx", b"C\n"), ("rx", b"3")), "a")
    assert played(replay, b"C\n", b"A\n", b"B\n") == [b"3", b"1", b"2"]
    assert replay.finished


def test_ports_do_not_mix() -> None:
    said = trace(("tx", b"A"), ("tx", b"A", "b"), ("rx", b"2", "b"), ("rx", b"1"), ("tx", b"C", "b"), ("rx", b"late"))
    first, second = Replay(said, "a"), Replay(said, "b")
    assert played(first, b"A") == [b"1late"]
    assert played(second, b"A", b"C") == [b"2"]
    assert first.finished
    assert second.finished


def test_requests_in_pieces_and_requests_that_begin_alike() -> None:
    replay = Replay(trace(("tx", b"P\x00\x01"), ("rx", b"1"), ("tx", b"P"), ("rx", b"2"), ("tx", b"PQ"), ("rx", b"3")), "a")
    assert played(replay, b"P\x00", b"\x01") == [b"2"]  # P alone is a request, too
    assert replay.divergences == [Divergence(b"\x00", 2, b"P\x00\x01"), Divergence(b"\x01", 2, b"P\x00\x01")]
    replay = Replay(trace(("tx", b"P\x00\x01"), ("rx", b"1"), ("tx", b"Q"), ("rx", b"2"), ("tx", b"QR"), ("rx", b"3")), "a")
    assert played(replay, b"P", b"\x00", b"\x01QQR") == [b"1", b"2", b"3"]
    assert replay.divergences == []
    assert replay.finished
    replay = Replay(trace(("tx", b"Q"), ("rx", b"1"), ("tx", b"R"), ("rx", b"2"), ("tx", b"QR"), ("rx", b"3")), "a")
    assert played(replay, b"QRQR") == [b"1", b"2", b"3"]  # two writes that came together, for that is what is next
    replay = Replay(trace(("tx", b"N"), ("rx", b"0"), ("tx", b"Q"), ("rx", b"1"), ("tx", b"QR"), ("rx", b"2")), "a")
    assert played(replay, b"QR", b"Q", b"N") == [b"2", b"1", b"0"]  # out of turn, the longest is meant


def test_a_divergence_is_told_and_not_answered() -> None:
    replay = Replay(trace(("tx", b"A\n"), ("rx", b"1"), ("tx", b"B\n"), ("rx", b"2")), "a")
    assert played(replay, b"A\n", b"X\n", b"B\n") == [b"1", b"2"]
    assert replay.divergences == [Divergence(b"X\n", 4, b"B\n")]
    assert str(replay.divergences[0]) == r"b'X\n' came where b'B\n' (line 4 of the trace) was expected"
    assert replay.finished


def test_what_was_received_first_is_sent_upon_connection_once() -> None:
    replay = Replay(trace(("rx", b"hello"), ("rx", b"!"), ("tx", b"A"), ("rx", b"1")), "a")
    assert played(replay) == [b"hello!"]
    assert played(replay, b"A") == [b"1"]


def test_no_such_port() -> None:
    with pytest.raises(SimError, match="no port 'c'; it has a, b"):
        Replay(trace(("tx", b"A"), ("tx", b"A", "b")), "c")


@settings(max_examples=100, deadline=None)
@given(st.data(), st.lists(st.tuples(st.binary(min_size=1, max_size=5), st.binary(max_size=8)), max_size=12))
def test_a_client_that_says_the_same_hears_the_same(data: st.DataObject, talk: Sequence[tuple[bytes, bytes]]) -> None:
    said = [event for request, reply in talk for event in (("tx", request), ("rx", reply))] or [("rx", b"x")]
    replay = Replay(trace(*said), "a")
    assert played(replay, *(request for request, _ in talk)) == [reply for _, reply in talk if reply] or [b"x"]
    assert replay.finished
    # However the stream is cut, if the requests cannot be taken for one another.
    ended = [(request.hex().encode() + b"\n", reply) for request, reply in talk]
    stream, pieces = b"".join(request for request, _ in ended), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        pieces.append(stream[:size])
        stream = stream[size:]
    again = Replay(trace(*(event for request, reply in ended for event in (("tx", request), ("rx", reply)))), "a") if ended else replay
    assert b"".join(played(again, *pieces)) == b"".join(reply for _, reply in ended)
    assert again.divergences == []


# Served


def ask(bench: Replayed, port: str, *requests: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", int(bench.url(port).rpartition(":")[2])), timeout=10) as client:
        for request in requests:
            client.sendall(request)
        client.shutdown(socket.SHUT_WR)
        with client.makefile("rb") as heard:
            return heard.read()


def test_in_background(tmp_path: Path, quiet: None) -> None:
    lines = [line("tx", b"A"), line("tx", b"A", "b"), line("rx", b"2", "b"), line("rx", b"1"), line("tx", b"B")]
    found = load(written(tmp_path, *lines))
    with in_background(found) as bench:
        assert bench.report["replayed"] == str(found.path)
        assert [device["name"] for device in bench.report["devices"]] == ["a", "b"]
        assert all(device["tcp"].startswith("socket://127.0.0.1:") for device in bench.report["devices"])
        assert ask(bench, "b", b"A") == b"2"
        assert ask(bench, "a", b"A", b"X") == b"1"
        assert not bench.finished
        assert bench.divergences == {"a": [Divergence(b"X", 6, b"B")]}
        assert ask(bench, "a", b"B") == b""
        assert bench.finished
        url = bench.url("a")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2])), timeout=10)
