"""The link: framing, timeouts, stale input, unplugging, and what overtakes what."""

from __future__ import annotations

import errno
import logging
import select
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import serial

from drivers.errors import BadChecksum, DeviceFault, InvalidSetting, PortClosed, TransportTimeout, UnexpectedReply
from drivers.incidents import Incident
from drivers.link import Link

SHORT_S = 0.1
PATIENT_S = 0.5  # where one answer is missing and the next must come, on a computer that is busy


def whole(line: bytes) -> bytes:
    """Accept any line."""
    return line


def only(prefix: bytes) -> Any:
    """Accept lines that start so."""
    return lambda line: line if line.startswith(prefix) else None


def ask(link: Link, request: bytes, accept: Any = whole, **options: Any) -> bytes:
    """Exchange with a fixed story around it."""
    reply: bytes = link.exchange(request, accept, attempt="asking", expected="an answer", **options)
    return reply


def test_one_exchange(plug_both: Any, script: Any) -> None:
    link = plug_both(*script.dialogue(b"A?\n", b"42\r\n", b"B?\n", b"43\r\n"))
    assert ask(link, b"A?\n") == b"42"
    assert ask(link, b"B?\n") == b"43"


@pytest.mark.parametrize("terminator", [b"\r", b"\n", b"\r\n", b"\n\r"])
def test_a_reply_in_pieces_is_one_reply(plug: Any, script: Any, terminator: bytes) -> None:
    pieces = [script.send(bytes([byte])) for byte in b"12.5" + terminator]
    link = plug(script.expect(b"?"), *pieces, terminator=terminator)
    assert ask(link, b"?") == b"12.5"


def test_long_reply(plug: Any, script: Any) -> None:
    text = bytes(range(32, 127)) * 100
    reply = text + b"\r\n"
    link = plug(script.expect(b"?"), *(script.send(reply[start : start + 2000]) for start in range(0, len(reply), 2000)))
    assert ask(link, b"?") == text


def test_no_reply_names_device_port_and_request(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"POS?\n"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout) as caught:
        ask(link, b"POS?\n", device="theta_r")
    error = caught.value
    assert (error.device, error.port, error.sent, error.raw) == ("theta_r", link.url, b"POS?\n", b"")
    assert error.elapsed_s is not None
    assert "theta_r on /dev/" in str(error)
    assert "\n" not in str(error)


def test_partial_reply_is_never_returned(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"?"), script.send(b"10.000"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match="broke off") as caught:
        ask(link, b"?")
    assert caught.value.raw == b"10.000"
    assert "31 30 2e 30 30 30" in str(caught.value)


def test_lines_nobody_claims_are_reported(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"?"), script.send(b"other\r\nmore\r\nhal"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout) as caught:
        ask(link, b"?", only(b"mine"))
    assert caught.value.raw == b"other\r\nmore\r\nhal"


def test_what_came_before_the_question_is_not_the_answer(plug_both: Any, script: Any) -> None:
    answered = threading.Event()
    duplicate = [script.wait(answered), script.send(b"one\r\npart")]
    link = plug_both(*script.dialogue(b"1?", b"one\r\n"), *duplicate, *script.dialogue(b"2?", b"two\r\n"))
    assert ask(link, b"1?") == b"one"
    answered.set()
    assert select.select([link._fd], [], [], 5)[0]  # the duplicate has arrived
    assert ask(link, b"2?") == b"two"


def test_a_read_is_repeated_once(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"?"), script.expect(b"?"), script.send(b"7\r\n"), timeout_s=SHORT_S)
    assert ask(link, b"?", repeatable=True) == b"7"


def test_a_read_is_repeated_only_once(plug: Any, script: Any) -> None:
    link = plug(script.expect(b"?"), script.expect(b"?"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout):
        ask(link, b"?", repeatable=True)


@pytest.mark.parametrize("kind", [BadChecksum, UnexpectedReply])
def test_a_damaged_reply_is_asked_again_only_if_allowed(plug: Any, script: Any, kind: type[Exception]) -> None:
    def accept(line: bytes) -> bytes:
        if line == b"bad":
            raise kind("damaged")
        return line

    link = plug(*script.dialogue(b"?", b"bad\r\n", b"?", b"good\r\n", b"?", b"bad\r\n"))
    assert ask(link, b"?", accept, repeatable=True) == b"good"
    with pytest.raises(kind) as caught:
        ask(link, b"?", accept)
    assert caught.value.raw == b"bad"  # type: ignore[attr-defined]


def test_a_refusal_is_never_asked_again(plug: Any, script: Any) -> None:
    def refuse(line: bytes) -> bytes:
        raise DeviceFault("no")

    link = plug(*script.dialogue(b"?", b"NO\r\n"))
    with pytest.raises(DeviceFault):
        ask(link, b"?", refuse, repeatable=True)


def test_absent_serial_port_names_port_and_device() -> None:
    with pytest.raises(TransportTimeout, match=r"theta_i on /dev/no-such-port: opening the port"):
        Link.open("/dev/no-such-port", device="theta_i")


def test_absent_tcp_port_names_port_and_device() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(TransportTimeout, match=f"theta_i on socket://127.0.0.1:{port}"):
        Link.open(f"socket://127.0.0.1:{port}", device="theta_i")


@pytest.mark.parametrize(("url", "settings"), [("nonsense://x", {}), ("loop://", {"baudrate": "fast"}), ("loop://", {"colour": "red"})])
def test_nonsense_settings_are_named(url: str, settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting):
        Link.open(url, device="x", **settings)


def test_unplugged_while_waiting(plug_both: Any, script: Any) -> None:
    link = plug_both(script.expect(b"?"), script.unplug())
    with pytest.raises(PortClosed) as caught:
        ask(link, b"?", repeatable=True)
    assert caught.value.device == "bench"
    assert caught.value.port == link.url


def test_unplugged_between_questions(plug: Any, script: Any) -> None:
    answered, gone = threading.Event(), threading.Event()
    link = plug(*script.dialogue(b"?", b"1\r\n"), script.wait(answered), script.unplug(), script.tell(gone))
    ask(link, b"?")
    answered.set()
    assert gone.wait(5)
    for _ in range(2):
        with pytest.raises(PortClosed):
            ask(link, b"?")


def test_closed_by_another_thread_while_waiting(plug: Any, script: Any) -> None:
    asked = threading.Event()
    link = plug(script.expect(b"?"), script.tell(asked))
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(ask, link, b"?")
        assert asked.wait(5)
        link.close()
        link.close()
        with pytest.raises(PortClosed):
            waiting.result()
    with pytest.raises(PortClosed):
        ask(link, b"?")


def test_one_port_one_link(plug: Any) -> None:
    link = plug()
    with pytest.raises(TransportTimeout):
        Link.open(link.url, device="intruder")


def test_urgent_bytes_overtake_a_blocked_exchange(plug_both: Any, script: Any) -> None:
    """The peer answers the first question only after the urgent one has reached it and been answered."""
    blocked = threading.Event()
    link = plug_both(
        script.expect(b"move\n"),
        script.tell(blocked),
        script.expect(b"STOP\n"),
        script.send(b"st"),
        script.send(b"opped\r\nmo"),
        script.send(b"ved\r\n"),
    )
    with ThreadPoolExecutor(1) as pool:
        moving = pool.submit(ask, link, b"move\n", only(b"moved"))
        assert blocked.wait(5)
        assert ask(link, b"STOP\n", only(b"stopped"), urgent=True) == b"stopped"
        assert moving.result() == b"moved"


def test_urgent_reply_after_the_blocked_exchange_gave_up(plug: Any, script: Any) -> None:
    """The thread that was reading for both leaves; the urgent one must take over the reading."""
    blocked, gave_up = threading.Event(), threading.Event()
    link = plug(script.expect(b"a\n"), script.tell(blocked), script.expect(b"STOP\n"), script.wait(gave_up), script.send(b"stopped\r\n"))

    def blocked_exchange() -> None:
        with pytest.raises(TransportTimeout):
            ask(link, b"a\n", only(b"a"), timeout_s=SHORT_S)
        gave_up.set()

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(blocked_exchange)
        assert blocked.wait(5)
        assert ask(link, b"STOP\n", only(b"stopped"), urgent=True) == b"stopped"
        first.result()


def test_urgent_wait_survives_the_next_ordinary_exchange(plug: Any, script: Any) -> None:
    """An ordinary exchange that begins while a stop is unanswered must not throw the stop's reply away as stale."""
    stopping = threading.Event()
    link = plug(script.expect(b"STOP\n"), script.tell(stopping), script.expect(b"a\n"), script.send(b"stopped\r\na\r\n"))
    with ThreadPoolExecutor(1) as pool:
        stop = pool.submit(ask, link, b"STOP\n", only(b"stopped"), urgent=True)
        assert stopping.wait(5)
        assert ask(link, b"a\n", only(b"a")) == b"a"
        assert stop.result() == b"stopped"


def test_urgent_reply_that_arrives_while_stale_input_is_dropped(plug: Any, script: Any) -> None:
    """The log holds the dropping up until the urgent reply has come in right behind the stale line."""
    answered, urgent_sent = threading.Event(), threading.Event()
    pool = ThreadPoolExecutor(1)
    stops: list[Any] = []

    def log(_at: float, way: str, data: bytes) -> None:
        if data == b"STOP\n":
            urgent_sent.set()
        if way == "rx" and data == b"stale\r\n":
            stops.append(pool.submit(ask, link, b"STOP\n", only(b"stopped"), urgent=True))
            assert urgent_sent.wait(5)
            assert select.select([link._fd], [], [], 5)[0]

    stale = [script.wait(answered), script.send(b"stale\r\n")]
    later = script.dialogue(b"STOP\n", b"stopped\r\n", b"b\n", b"b\r\n")
    link = plug(*script.dialogue(b"a\n", b"a\r\n"), *stale, *later, traffic=log)
    with pool:
        assert ask(link, b"a\n") == b"a"
        answered.set()
        assert select.select([link._fd], [], [], 5)[0]
        assert ask(link, b"b\n", only(b"b")) == b"b"
        assert stops[0].result() == b"stopped"


def test_a_queued_request_can_be_withdrawn(plug: Any, script: Any) -> None:
    """A request that waits for its turn is dropped if its veto says so when the turn comes: nothing of it is sent."""
    blocked, stop, release = threading.Event(), threading.Event(), threading.Event()
    slow = [script.expect(b"a\n"), script.tell(blocked), script.wait(release), script.send(b"a\r\n")]
    link = plug(*slow, *script.dialogue(b"b\n", b"b\r\n"))
    fault = DeviceFault("stopped")
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(ask, link, b"a\n")
        assert blocked.wait(5)
        queued = pool.submit(ask, link, b"move\n", veto=lambda: fault if stop.is_set() else None)
        stop.set()
        release.set()
        assert first.result() == b"a"
        with pytest.raises(DeviceFault) as caught:
            queued.result()
    assert caught.value.sent == b""
    assert ask(link, b"b\n") == b"b"


def test_many_threads_get_their_own_answers(plug_both: Any, script: Any) -> None:
    threads, each = 4, 25
    link = plug_both(script.serve(threads * each, lambda line: b"<" + line + b">\r\n"))

    def work(number: int) -> None:
        for index in range(each):
            request = f"{number}.{index}".encode()
            assert ask(link, request + b"\n") == b"<" + request + b">"

    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, number) for number in range(threads)]:
            done.result()


def test_traffic_is_every_byte_in_order(plug: Any, script: Any) -> None:
    log: list[tuple[float, str, bytes]] = []
    link = plug(*script.dialogue(b"A?\n", b"1\r\n", b"B?\n", b"2\r\n"), traffic=lambda *entry: log.append(entry))
    ask(link, b"A?\n")
    ask(link, b"B?\n")
    story = b"".join((b">" if way == "tx" else b"") + data for _, way, data in log)
    assert story == b">A?\n1\r\n>B?\n2\r\n"
    assert [at for at, _, _ in log] == sorted(at for at, _, _ in log)


def full(*_: Any) -> None:
    """A traffic log whose disk is full."""
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_log_that_fails_is_no_matter(plug: Any, script: Any, caplog: pytest.LogCaptureFixture) -> None:
    link = plug(*script.dialogue(b"A?\n", b"1\r\n", b"STOP\n", b"ok\r\n"), traffic=full)
    assert ask(link, b"A?\n") == b"1"
    assert ask(link, b"STOP\n", urgent=True) == b"ok"
    assert [record.message for record in caplog.records] == [f"traffic on {link.url} is not told"]


def test_a_log_that_waits_for_its_disk_keeps_no_stop_from_the_wire(plug: Any, script: Any) -> None:
    """The peer has the stop before the log has taken the request before it."""
    written, stopped = threading.Event(), threading.Event()
    waited: list[bool] = []

    def slow(_: float, way: str, data: bytes) -> None:
        if (way, data) == ("tx", b"MOVE\n"):
            written.set()
            waited.append(stopped.wait(5))

    link = plug(
        script.expect(b"MOVE\n"), script.expect(b"STOP\n"), script.tell(stopped), script.send(b"moved\r\nstopped\r\n"), traffic=slow
    )
    with ThreadPoolExecutor(1) as pool:
        moving = pool.submit(ask, link, b"MOVE\n", only(b"moved"))
        assert written.wait(5)
        assert ask(link, b"STOP\n", only(b"stopped"), urgent=True) == b"stopped"
        assert moving.result() == b"moved"
    assert waited == [True]


# line ends ------------------------------------------------------------------------------------------------------------

ENDS = {"CR": b"\r", "LF": b"\n", "CRLF": b"\r\n", "LFCR": b"\n\r"}


@pytest.mark.parametrize(
    ("set_to", "sent", "complaint"),
    [
        ("CR", "LF", 'the reply ended in LF (0a), not CR: set terminator = "LF"'),
        ("LF", "CR", 'the reply ended in CR (0d), not LF: set terminator = "CR"'),
        ("CRLF", "LF", 'the reply ended in LF (0a), not CRLF: set terminator = "LF"'),
        ("CRLF", "LFCR", 'the reply ended in LFCR (0a 0d), not CRLF: set terminator = "LFCR"'),
        ("LFCR", "CRLF", 'the reply ended in CRLF (0d 0a), not LFCR: set terminator = "CRLF"'),
        ("CRLF", "CR", 'the reply ended in CR (0d), not CRLF: if it always does, set terminator = "CR"'),
    ],
)
def test_another_line_end_is_told_with_what_to_set(plug: Any, script: Any, set_to: str, sent: str, complaint: str) -> None:
    link = plug(script.expect(b"?"), script.send(b"1.5" + ENDS[sent]), timeout_s=SHORT_S, terminator=ENDS[set_to])
    with pytest.raises(TransportTimeout) as caught:
        ask(link, b"?")
    assert caught.value.problem == complaint


@pytest.mark.parametrize(("set_to", "sent"), [("CR", "CRLF"), ("LF", "LFCR")])
def test_a_line_end_of_two_where_one_was_expected_is_told(plug: Any, script: Any, set_to: str, sent: str) -> None:
    link = plug(script.expect(b"?"), script.send(b"other" + ENDS[sent]), timeout_s=SHORT_S, terminator=ENDS[set_to])
    with pytest.raises(TransportTimeout, match=f'not {set_to}: set terminator = "{sent}"'):
        ask(link, b"?", only(b"mine"))


# what is reported -----------------------------------------------------------------------------------------------------


def told(incidents: list[Incident]) -> list[tuple[str, str]]:
    """What was done and why."""
    return [(incident.what, incident.detail) for incident in incidents]


def hexed(data: bytes) -> str:
    """Bytes as reports show them."""
    return data.hex(" ")


def test_nothing_is_reported_when_nothing_was_wrong(plug_both: Any, script: Any) -> None:
    incidents: list[Incident] = []
    link = plug_both(script.expect(b"A?\n"), script.send(b"4"), script.send(b"2\r\n"), script.serve(50, lambda line: line + b"\r\n"))
    link._report = incidents.append
    ask(link, b"A?\n", repeatable=True)
    for number in range(50):
        assert ask(link, b"%d\n" % number) == b"%d" % number
    assert incidents == []


def test_a_repeat_is_reported(plug: Any, script: Any) -> None:
    incidents: list[Incident] = []
    link = plug(script.expect(b"?"), script.expect(b"?"), script.send(b"7\r\n"), timeout_s=PATIENT_S, report=incidents.append)
    ask(link, b"?", repeatable=True, device="theta_i")
    (incident,) = incidents
    assert (incident.port, incident.device, incident.attempt) == (link.url, "theta_i", "asking")
    assert told(incidents) == [("repeated", "TransportTimeout: no reply")]
    assert f"theta_i on {link.url}: asking: repeated (TransportTimeout: no reply)" == str(incident)
    assert 1.7e9 < incident.time_s < 1e11


def test_what_may_not_be_repeated_is_neither_repeated_nor_reported(plug: Any, script: Any) -> None:
    """The error says it all."""
    incidents: list[Incident] = []
    link = plug(script.expect(b"move\n"), timeout_s=PATIENT_S, report=incidents.append)
    with pytest.raises(TransportTimeout):
        ask(link, b"move\n")
    assert incidents == []


def test_after_a_reply_cut_short_the_next_one_is_right(plug_both: Any, script: Any) -> None:
    incidents: list[Incident] = []
    cut = [script.expect(b"?"), script.send(b"10.0")]
    link = plug_both(*cut, *script.dialogue(b"?", b"10.000\r\n", b"!", b"11.000\r\n"))
    link._report = incidents.append
    assert ask(link, b"?", repeatable=True, timeout_s=PATIENT_S) == b"10.000"
    assert ask(link, b"!") == b"11.000"
    assert told(incidents) == [
        ("repeated", "TransportTimeout: the reply broke off before its terminator (0d 0a), got 31 30 2e 30"),
        ("stale bytes dropped", hexed(b"10.0")),
    ]


def test_after_a_doubled_reply_the_next_one_is_right(plug_both: Any, script: Any) -> None:
    """The copy comes with the reply or after it, but before the next question."""
    incidents: list[Incident] = []
    answered = threading.Event()
    late = [script.wait(answered), script.send(b"two\r\n")]
    link = plug_both(*script.dialogue(b"1?", b"one\r\none\r\n", b"2?", b"two\r\n"), *late, *script.dialogue(b"3?", b"three\r\n"))
    link._report = incidents.append
    assert ask(link, b"1?") == b"one"
    assert ask(link, b"2?") == b"two"
    answered.set()
    assert select.select([link._fd], [], [], 5)[0]
    assert ask(link, b"3?") == b"three"
    assert sorted(told(incidents)) in (
        [("foreign line passed over", hexed(b"one\r\n")), ("stale bytes dropped", hexed(b"two\r\n"))],
        [("stale bytes dropped", hexed(line)) for line in (b"one\r\n", b"two\r\n")],
    )


def test_lines_nobody_claims_are_reported_though_the_reply_came(plug: Any, script: Any) -> None:
    incidents: list[Incident] = []
    link = plug(script.expect(b"?"), script.send(b"other\r\nmine\r\n"), report=incidents.append)
    assert ask(link, b"?", only(b"mine")) == b"mine"
    assert told(incidents) == [("foreign line passed over", hexed(b"other\r\n"))]


def test_much_of_it_is_told_shortened(plug: Any, script: Any) -> None:
    incidents: list[Incident] = []
    link = plug(script.expect(b"?"), script.send(b"babble\r\n" * 100 + b"mine\r\n"), report=incidents.append)
    assert ask(link, b"?", only(b"mine")) == b"mine"
    (incident,) = incidents
    assert incident.detail.startswith(hexed(b"babble\r\n"))
    assert len(incident.detail) < 120


def test_what_a_device_sends_on_its_own_is_no_incident(plug: Any, script: Any) -> None:
    incidents: list[Incident] = []
    link = plug(script.expect(b"?"), script.send(b"!alert\r\nother\r\nmine\r\n"), report=incidents.append)
    link.unasked = (b"!", b"#")
    assert ask(link, b"?", only(b"mine")) == b"mine"
    assert told(incidents) == [("foreign line passed over", hexed(b"other\r\n"))]


def test_the_answer_to_a_stop_that_overtook_is_no_incident(plug_both: Any, script: Any) -> None:
    incidents: list[Incident] = []
    blocked = threading.Event()
    answers = (script.send(b"stopped\r\nmoved\r\n"),)
    link = plug_both(script.expect(b"move\n"), script.tell(blocked), script.expect(b"STOP\n"), *answers)
    link._report = incidents.append
    with ThreadPoolExecutor(1) as pool:
        moving = pool.submit(ask, link, b"move\n", only(b"moved"))
        assert blocked.wait(5)
        assert ask(link, b"STOP\n", only(b"stopped"), urgent=True) == b"stopped"
        assert moving.result() == b"moved"
    assert incidents == []


def test_a_report_that_breaks_spoils_nothing(plug: Any, script: Any, caplog: pytest.LogCaptureFixture) -> None:
    def broken(incident: Incident) -> None:
        raise RuntimeError("disk full")

    link = plug(script.expect(b"?"), script.expect(b"?"), script.send(b"7\r\n"), timeout_s=PATIENT_S, report=broken)
    with caplog.at_level(logging.ERROR, "drivers.link"):
        assert ask(link, b"?", repeatable=True) == b"7"
    assert "repeated (TransportTimeout: no reply)" in caplog.text
    assert "disk full" in caplog.text


def test_a_report_may_use_the_link(plug: Any, script: Any) -> None:
    """It is called while the link is free."""
    answers: list[bytes] = []
    lines = (b"other\r\nmine\r\n", b"why?", b"because\r\n")
    link: Link

    def report(incident: Incident) -> None:
        answers.append(ask(link, b"why?", only(b"because")))

    link = plug(*script.dialogue(b"?", *lines), report=report)
    assert ask(link, b"?", only(b"mine")) == b"mine"
    assert answers == [b"because"]


def test_ports_without_a_file_descriptor_work_too() -> None:
    """The loop:// port has none, like rfc2217:// and COM ports; it echoes."""
    with Link.open("loop://", device="echo", timeout_s=SHORT_S) as link:
        assert ask(link, b"hello\r\n") == b"hello"
        with pytest.raises(TransportTimeout, match="broke off"):
            ask(link, b"no terminator")
        assert ask(link, b"again\r\n") == b"again"


def test_tcp_sends_small_packets_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Any] = []
    real = serial.serial_for_url

    def spy(*args: Any, **settings: Any) -> Any:
        opened.append(real(*args, **settings))
        return opened[-1]

    monkeypatch.setattr(serial, "serial_for_url", spy)
    with socket.create_server(("127.0.0.1", 0)) as server, Link.open(f"socket://127.0.0.1:{server.getsockname()[1]}"):
        assert opened[0]._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
