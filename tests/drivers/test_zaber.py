"""Zaber: the codec against the sheet's vectors and against damage, the axis against exchanges spelled out by hand."""

from __future__ import annotations

import math
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import (
    BadChecksum,
    DeviceFault,
    InvalidSetting,
    NotHomed,
    PortClosed,
    TransportTimeout,
    UnexpectedReply,
)
from drivers.kinds import Identity, Stage
from drivers.stages.zaber import ZaberAxis, checksum, encode_command, parse_message

SCALE = 1_536_000 / 360  # microsteps per degree of an RSW60A at its default resolution
SHORT_S = 0.1


def framed(text: str, end: str) -> bytes:
    """Append the checksum, reckoned in another way than the driver does, and the line end."""
    total = 0
    for character in text[1:]:
        total = (total + ord(character)) % 256
    return f"{text}:{(256 - total) % 256:02X}{end}".encode("ascii")


def says(text: str) -> bytes:
    """A line of the computer."""
    return framed(text, "\n")


def answers(text: str) -> bytes:
    """A line of the device."""
    return framed(text, "\r\n")


def talk(script: Any, *lines: str) -> tuple[Any, ...]:
    """Commands and replies in turn."""
    steps: tuple[Any, ...] = script.dialogue(*(says(line) if line.startswith("/") else answers(line) for line in lines))
    return steps


CLEAR = ("/1 1 00 warnings clear", "@01 1 00 OK IDLE -- 00")


# the codec ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0 0 00", "00"), ("1 0 04 get deviceid", "3E"), ("1 1 34 move abs 1000", "E9"), ("01 0 00 OK IDLE WR 0", "BE")],
)
def test_checksums_of_the_sheet(text: str, expected: str) -> None:
    assert checksum(text.encode()) == expected


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ((0, 0, 0, ""), b"/0 0 00:00\n"),
        ((1, 0, 4, "get deviceid"), b"/1 0 04 get deviceid:3E\n"),
        ((1, 1, 34, "move abs 1000"), b"/1 1 34 move abs 1000:E9\n"),
    ],
)
def test_commands_of_the_sheet(arguments: tuple[int, int, int, str], line: bytes) -> None:
    assert encode_command(*arguments) == line


def test_commands_without_checksum() -> None:
    assert encode_command(1, 1, 17, "get pos", with_checksum=False) == b"/1 1 17 get pos\n"


def test_reply_of_the_sheet() -> None:
    message = parse_message(b"@01 0 00 OK IDLE WR 0:BE")
    assert (message.kind, message.device, message.axis, message.message_id) == ("reply", 1, 0, 0)
    assert (message.rejected, message.busy, message.flag, message.data) == (False, False, "WR", "0")


words = st.text(st.sampled_from("abcdefghijklmnopqrstuvwxyz0123456789.- "), max_size=30).map(lambda text: " ".join(text.split()))
data = st.text(st.sampled_from("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-"), min_size=1, max_size=30)
flags = st.sampled_from(["--", "FS", "WR", "NI"])


@given(st.integers(0, 99), st.integers(0, 9), st.integers(0, 99), words)
def test_commands_carry_what_they_were_given(device: int, axis: int, message_id: int, text: str) -> None:
    line = encode_command(device, axis, message_id, text)
    assert line[:1] == b"/"
    assert line[-1:] == b"\n"
    body, _, tail = line[1:-1].partition(b":")
    assert (sum(body) + int(tail, 16)) % 256 == 0
    fields = body.decode().split(" ", 3)
    assert (int(fields[0]), int(fields[1]), fields[2]) == (device, axis, f"{message_id:02d}")
    assert fields[3:] == ([text] if text else [])


@pytest.mark.parametrize("text", ["move: abs", "a@b", "a\nb", "a/b", "a\\", "a#", "!", "grün", "tab\t"])
def test_reserved_characters_are_refused(text: str) -> None:
    with pytest.raises(InvalidSetting):
        encode_command(1, 1, 0, text)


@pytest.mark.parametrize("numbers", [(-1, 1, 0), (100, 1, 0), (1, 10, 0), (1, -1, 0), (1, 1, 100), (1, 1, -1)])
def test_numbers_out_of_range_are_refused(numbers: tuple[int, int, int]) -> None:
    with pytest.raises(InvalidSetting):
        encode_command(*numbers, "stop")


@given(st.integers(0, 99), st.integers(0, 9), st.none() | st.integers(0, 99), st.booleans(), st.booleans(), flags, data, st.booleans())
def test_replies_round_trip(
    device: int, axis: int, message_id: int | None, rejected: bool, busy: bool, flag: str, text: str, with_checksum: bool
) -> None:
    number = "" if message_id is None else f" {message_id:02d}"
    line = f"@{device:02d} {axis}{number} {'RJ' if rejected else 'OK'} {'BUSY' if busy else 'IDLE'} {flag} {text}"
    frame = answers(line)[:-2] if with_checksum else line.encode()
    message = parse_message(frame, checksum_required=with_checksum)
    assert message.kind == "reply"
    assert (message.device, message.axis, message.message_id) == (device, axis, message_id)
    assert (message.rejected, message.busy, message.flag, message.data) == (rejected, busy, flag, text)


def test_alerts_and_information() -> None:
    alert = parse_message(answers("!01 1 IDLE FS")[:-2])
    assert (alert.kind, alert.message_id, alert.busy, alert.flag) == ("alert", None, False, "FS")
    info = parse_message(answers("#01 0 17 some text")[:-2])
    assert (info.kind, info.message_id, info.data) == ("info", 17, "some text")


def parse_reply(line: bytes) -> None:
    """Insist on a reply: only the leading character is outside the checksum, but it then makes another kind of line."""
    if parse_message(line).kind != "reply":
        raise UnexpectedReply("another kind")


@given(st.integers(0, 25))
def test_any_truncation_is_noticed(length: int) -> None:
    with pytest.raises((BadChecksum, UnexpectedReply)):
        parse_message(answers("@01 1 17 OK IDLE -- 426667")[:length])


def test_a_reply_in_several_packets_is_refused() -> None:
    with pytest.raises(UnexpectedReply, match="several packets"):
        parse_message(answers("@01 1 17 OK IDLE -- 12\\")[:-2])


# the axis -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def axis(plug: Any, script: Any) -> Any:
    """An axis whose other end follows the dialogue given."""

    def make(*lines: str, **options: Any) -> ZaberAxis:
        return ZaberAxis(plug(*talk(script, *lines)), "theta_r", microsteps_per_unit=SCALE, **options)

    return make


def test_it_is_a_rotary_axis(axis: Any) -> None:
    assert isinstance(axis(), Stage)


def test_open_reads_the_scale(plug: Any, script: Any) -> None:
    link = plug(
        *talk(
            script,
            *("/2 1 00 get limit.cycle.dist", "@02 1 00 OK IDLE WR 1536000"),
            *("/2 1 01 set maxspeed 139810", "@02 1 01 OK IDLE WR 0"),
            *("/2 1 02 set accel 14", "@02 1 02 OK IDLE WR 0"),
        )
    )
    stage = ZaberAxis.open(link, "theta_i", address=2, speed=20, acceleration=20)
    assert stage.microsteps_per_unit == pytest.approx(1 / 0.000234375)  # the step size on the sheet


def test_open_with_a_given_scale_asks_nothing(plug: Any) -> None:
    assert ZaberAxis.open(plug(), "theta_i", microsteps_per_unit=100.0).microsteps_per_unit == 100


def test_open_without_any_scale_says_what_to_do(plug: Any, script: Any) -> None:
    link = plug(*talk(script, "/1 1 00 get limit.cycle.dist", "@01 1 00 RJ IDLE -- BADCOMMAND"))
    with pytest.raises(DeviceFault, match="give microsteps_per_degree"):
        ZaberAxis.open(link, "theta_i")


def test_open_with_a_linear_stage_says_what_to_do(plug: Any, script: Any) -> None:
    link = plug(*talk(script, "/1 1 00 get limit.cycle.dist", "@01 1 00 OK IDLE -- 0"))
    with pytest.raises(DeviceFault, match="give microsteps_per_degree"):
        ZaberAxis.open(link, "theta_i")


def test_identity(axis: Any) -> None:
    stage = axis(
        *("/1 0 00 get deviceid", "@01 0 00 OK IDLE -- 50952"),
        *("/1 0 01 get system.serial", "@01 0 01 OK IDLE -- 73825"),
        *("/1 0 02 get version", "@01 0 02 OK IDLE -- 7.30"),
    )
    assert stage.identify() == Identity("Zaber", "device id 50952", "73825", "7.30")


def test_state_at_rest(axis: Any) -> None:
    state = axis("/1 1 00 get pos", "@01 1 00 OK IDLE -- 192000").state()
    assert (state.position, state.moving, state.homed, state.warnings) == (45.0, False, True, ())


def test_state_on_the_way(axis: Any) -> None:
    state = axis("/1 1 00 get pos", "@01 1 00 OK BUSY -- -4267").state()
    assert state.moving
    assert state.position == pytest.approx(-1.0, abs=1e-3)


def test_state_tells_all_flags_and_the_hidden_missing_reference(axis: Any) -> None:
    stage = axis("/1 1 00 get pos", "@01 1 00 OK IDLE FS 0", "/1 1 01 warnings", "@01 1 01 OK IDLE FS 02 FS WR")
    state = stage.state()
    assert state.warnings == ("FS", "WR")
    assert not state.homed


@pytest.mark.parametrize("answer", ["@01 1 00 OK IDLE -- fast", "@01 1 00 OK IDLE -- nan", "@01 1 00 OK IDLE -- 1 2"])
def test_positions_that_are_no_number(axis: Any, answer: str) -> None:
    with pytest.raises(UnexpectedReply, match="one number"):
        axis("/1 1 00 get pos", answer).state()


def test_flags_that_do_not_add_up(axis: Any) -> None:
    with pytest.raises(UnexpectedReply, match="as many flags"):
        axis("/1 1 00 get pos", "@01 1 00 OK IDLE WR 0", "/1 1 01 warnings", "@01 1 01 OK IDLE WR 02 WR").state()


def test_limits(axis: Any) -> None:
    stage = axis("/1 1 00 get limit.min", "@01 1 00 OK IDLE -- -768000", "/1 1 01 get limit.max", "@01 1 01 OK IDLE -- 768000")
    assert stage.limits() == (-180.0, 180.0)


def test_profile(axis: Any) -> None:
    """1.6384 units of maxspeed are one microstep per second."""
    stage = axis("/1 1 00 get maxspeed", "@01 1 00 OK IDLE -- 139810", "/1 1 01 get accel", "@01 1 01 OK IDLE -- 14")
    profile = stage.profile()
    assert profile.speed == pytest.approx(20, rel=1e-5)
    assert profile.acceleration == pytest.approx(14 * 10_000 / 1.6384 / SCALE)


def test_profile_with_another_acceleration_unit(axis: Any) -> None:
    stage = axis(
        *("/1 1 00 get maxspeed", "@01 1 00 OK IDLE -- 139810"), *("/1 1 01 get accel", "@01 1 01 OK IDLE -- 14"), acceleration_unit=SCALE
    )
    assert stage.profile().acceleration == pytest.approx(14)


def test_a_profile_of_zero_is_not_a_profile(axis: Any) -> None:
    stage = axis("/1 1 00 get maxspeed", "@01 1 00 OK IDLE -- 139810", "/1 1 01 get accel", "@01 1 01 OK IDLE -- 0")
    with pytest.raises(DeviceFault, match="accel 0"):
        stage.profile()


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf, 1e-9])
def test_impossible_speeds_are_not_sent(axis: Any, speed: float) -> None:
    with pytest.raises(InvalidSetting):
        axis().set_profile(speed=speed)
    with pytest.raises(InvalidSetting):
        axis().set_profile(speed=1.0, acceleration=speed * 1e-6)


def test_a_speed_the_stage_refuses(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="rejected with BADDATA"):
        axis("/1 1 00 set maxspeed 13981013", "@01 1 00 RJ IDLE -- BADDATA").set_profile(speed=2000)


def test_home(axis: Any) -> None:
    axis("/1 1 00 warnings clear", "@01 1 00 OK IDLE WR 01 WR", "/1 1 01 home", "@01 1 01 OK BUSY WR 0").start_home()


def test_home_refused(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="DRIVERDISABLED"):
        axis(*CLEAR, "/1 1 01 home", "@01 1 01 RJ IDLE FO DRIVERDISABLED").start_home()


@pytest.mark.parametrize(("deg", "microsteps"), [(45.0, 192000), (-70.0, -298667), (0.0, 0), (0.0001, 0), (0.0002, 1)])
def test_move(axis: Any, deg: float, microsteps: int) -> None:
    axis(*CLEAR, f"/1 1 01 move abs {microsteps}", "@01 1 01 OK BUSY -- 0").start_move(deg)


@pytest.mark.parametrize("deg", [math.nan, math.inf, -math.inf])
def test_moves_to_nowhere_are_not_sent(axis: Any, deg: float) -> None:
    with pytest.raises(InvalidSetting):
        axis().start_move(deg)


def test_move_without_reference(axis: Any) -> None:
    stage = axis(
        *("/1 1 00 warnings clear", "@01 1 00 OK IDLE WR 01 WR"),
        *("/1 1 01 move abs 192000", "@01 1 01 RJ IDLE WR BADDATA"),
        *("/1 1 02 warnings", "@01 1 02 OK IDLE WR 01 WR"),
    )
    with pytest.raises(NotHomed, match=r"theta_r on /dev/.*45.0000 deg.*home the axis first"):
        stage.start_move(45)


def test_move_beyond_the_limits(axis: Any) -> None:
    stage = axis(*CLEAR, "/1 1 01 move abs 1920000", "@01 1 01 RJ IDLE -- BADDATA", "/1 1 02 warnings", "@01 1 02 OK IDLE -- 00")
    with pytest.raises(DeviceFault, match="BADDATA") as caught:
        stage.start_move(450)
    assert not isinstance(caught.value, NotHomed)


@pytest.mark.parametrize("reason", ["BADCOMMAND", "BADAXIS", "AGAIN", "FULL", "STATUSBUSY", "PARKED", "DRIVERDISABLED", "SOMETHINGNEW"])
def test_other_refusals(axis: Any, reason: str) -> None:
    with pytest.raises(DeviceFault, match=f"rejected with {reason}, flag NC"):
        axis(*CLEAR, "/1 1 01 move abs 192000", f"@01 1 01 RJ BUSY NC {reason}").start_move(45)


def test_a_lost_reply_to_a_move_is_not_asked_for_again(plug: Any, script: Any) -> None:
    """Strict script: a second move command would fail it."""
    link = plug(*talk(script, *CLEAR, "/1 1 01 move abs 192000"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match="theta_r on /dev/"):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).start_move(45)


def test_a_lost_reply_to_a_home_is_not_asked_for_again(plug: Any, script: Any) -> None:
    link = plug(*talk(script, *CLEAR, "/1 1 01 home"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match=r"theta_r on /dev/"):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).start_home()


def test_a_lost_reply_to_a_setting_is_not_asked_for_again(plug: Any, script: Any) -> None:
    link = plug(*talk(script, "/1 1 00 set maxspeed 139810"), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match=r"theta_r on /dev/"):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).set_profile(speed=20)


def test_a_damaged_reply_to_a_move_is_not_asked_for_again(plug: Any, script: Any) -> None:
    link = plug(*talk(script, *CLEAR, "/1 1 01 move abs 192000"), script.send(b"@01 1 01 OK BUSY -- 0:00\r\n"))
    with pytest.raises(BadChecksum):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).start_move(45)


def test_ids_go_round(plug: Any, script: Any) -> None:
    ids = [number % 100 for number in range(103)]
    lines = [line for number in ids for line in (f"/1 1 {number:02d} get pos", f"@01 1 {number:02d} OK IDLE -- {number}")]
    stage = ZaberAxis(plug(*talk(script, *lines)), "theta_r", microsteps_per_unit=1)
    assert [stage.state().position for _ in ids] == ids


# what else is on the line ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "other",
    [
        answers("@01 1 99 OK IDLE -- 1"),  # late answer to an older question
        answers("@02 1 00 OK IDLE -- 1"),  # another device
        answers("@01 2 00 OK IDLE -- 1"),  # another axis
        answers("@01 1 OK IDLE -- 1"),  # no id
        answers("!01 1 IDLE --"),
        answers("#01 1 00 hello"),
        b"!01 1 IDLE --:00\r\n",  # damaged, but not an answer in any case
        b"\r\n",
        b"\x00\xff noise\r\n",
        b"\xfe\x01@",  # noise right before the answer
    ],
)
def test_other_lines_are_not_the_answer(plug: Any, script: Any, other: bytes) -> None:
    link = plug(script.expect(says("/1 1 00 get pos")), script.send(other + answers("@01 1 00 OK IDLE -- 192000")))
    assert ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).state().position == 45


def test_only_other_lines_is_a_timeout(plug: Any, script: Any) -> None:
    stale = answers("@01 1 99 OK IDLE -- 1")
    question = says("/1 1 00 get pos")
    link = plug(script.expect(question), script.send(stale), script.expect(question), script.send(stale), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout) as caught:
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).state()
    assert caught.value.raw == stale


@pytest.mark.parametrize("damaged", [b"@01 1 00 OK IDLE -- 192000:00\r\n", b"@01 1 00 OK IDLE -- 192000\r\n", b"@01 1 00 OK\r\n"])
def test_a_damaged_answer_to_a_read_is_asked_for_once_more(plug: Any, script: Any, damaged: bytes) -> None:
    question = says("/1 1 00 get pos")
    link = plug(*script.dialogue(question, damaged, question, answers("@01 1 00 OK IDLE -- 192000")))
    assert ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).state().position == 45


def test_a_line_that_stays_bad(plug: Any, script: Any) -> None:
    question, damaged = says("/1 1 00 get pos"), b"@01 1 00 OK IDLE -- 192000:00\r\n"
    link = plug(*script.dialogue(question, damaged, question, damaged))
    with pytest.raises(BadChecksum, match=r"theta_r on /dev/.*reading the position") as caught:
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).state()
    assert caught.value.raw == damaged[:-2]
    assert caught.value.sent == question


def test_an_answer_damaged_in_its_address_is_still_called_damaged(plug: Any, script: Any) -> None:
    question, damaged = says("/1 1 00 get pos"), b"@11 1 00 OK IDLE -- 192000:4C\r\n"
    link = plug(*script.dialogue(question, damaged, question, damaged), timeout_s=SHORT_S)
    with pytest.raises(BadChecksum, match="theta_r"):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).state()


def test_without_checksums(plug: Any, script: Any) -> None:
    link = plug(*script.dialogue(b"/1 1 00 get pos\n", b"@01 1 00 OK IDLE -- 192000\r\n"))
    stage = ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE, checksums=False)
    assert stage.state().position == 45


def test_two_axes_share_a_link(plug: Any, script: Any) -> None:
    """Each thread asks its own axis; every answer carries the address it is for."""

    def answer(line: bytes) -> bytes:
        address = int(line[1:2])
        return answers(f"@0{address} 1 {line[5:7].decode()} OK IDLE -- {address * 1000}")

    each = 40
    link = plug(script.serve(2 * each, answer))
    axes = [ZaberAxis(link, f"axis {address}", address=address, microsteps_per_unit=1) for address in (1, 2)]
    with ThreadPoolExecutor(2) as pool:
        seen = list(pool.map(lambda stage: {stage.state().position for _ in range(each)}, axes))
    assert seen == [{1000.0}, {2000.0}]


# stopping -------------------------------------------------------------------------------------------------------------


def test_stop_overtakes_a_blocked_exchange(plug: Any, script: Any) -> None:
    """The device answers neither question nor move until the stop has arrived."""
    blocked = threading.Event()
    link = plug(
        script.expect(says("/1 1 00 get pos")),
        script.tell(blocked),
        script.expect(says("/2 1 00 stop")),
        script.send(answers("@02 1 00 OK BUSY -- 0")),
        script.expect(says("/1 1 01 stop")),
        script.send(answers("@01 1 01 OK BUSY -- 0")),
        script.send(answers("@01 1 00 OK BUSY -- 192000")),
    )
    one = ZaberAxis(link, "theta_i", address=1, microsteps_per_unit=SCALE)
    two = ZaberAxis(link, "theta_r", address=2, microsteps_per_unit=SCALE)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(one.state)
        assert blocked.wait(5)
        two.stop()
        one.stop()
        assert waiting.result().position == 45


def test_a_hundred_stops_do_not_answer_the_question_they_overtake(plug: Any, script: Any) -> None:
    """Ids go round, but pass over the one that still waits for its answer."""
    blocked = threading.Event()
    ids = [*range(1, 100), 1, 2]
    stops = [line for number in ids for line in (f"/1 1 {number:02d} stop", f"@01 1 {number:02d} OK IDLE -- 0")]
    question, answer = script.expect(says("/1 1 00 get pos")), script.send(answers("@01 1 00 OK IDLE -- 192000"))
    link = plug(question, script.tell(blocked), *talk(script, *stops), answer)
    stage = ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(stage.state)
        assert blocked.wait(5)
        for _ in ids:
            stage.stop()
        assert waiting.result().position == 45


def test_a_move_that_has_not_gone_out_is_dropped_by_a_stop(plug: Any, script: Any) -> None:
    """A stop while a move waits for its turn on the line: the strict script fails if the move is sent after all."""
    blocked, queued = threading.Event(), threading.Event()
    link = plug(
        script.expect(says("/1 1 00 warnings clear")),
        script.tell(blocked),
        script.expect(says("/1 1 01 stop")),
        script.send(answers("@01 1 01 OK IDLE -- 0")),
        script.wait(queued),
        script.send(answers("@01 1 00 OK IDLE -- 00")),
    )
    stage = ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE)
    with ThreadPoolExecutor(1) as pool:
        moving = pool.submit(stage.start_move, 45)
        assert blocked.wait(5)
        stage.stop()
        queued.set()
        with pytest.raises(DeviceFault, match="stopped before it could start"):
            moving.result()


def test_a_move_after_a_stop_is_a_new_move(axis: Any) -> None:
    stage = axis(
        *("/1 1 00 stop", "@01 1 00 OK IDLE -- 0"),
        *("/1 1 01 stop", "@01 1 01 OK IDLE -- 0"),
        *("/1 1 02 warnings clear", "@01 1 02 OK IDLE -- 00"),
        *("/1 1 03 move abs 192000", "@01 1 03 OK BUSY -- 0"),
    )
    stage.stop()
    stage.stop()
    stage.start_move(45)


def test_an_unacknowledged_stop_is_sent_again(plug: Any, script: Any) -> None:
    stop = says("/1 1 00 stop")
    link = plug(script.expect(stop), *script.dialogue(stop, answers("@01 1 00 OK BUSY -- 0")), timeout_s=SHORT_S)
    ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).stop()


def test_a_stop_that_never_arrives_is_an_error(plug: Any, script: Any) -> None:
    stop = says("/1 1 00 stop")
    link = plug(script.expect(stop), script.expect(stop), timeout_s=SHORT_S)
    with pytest.raises(TransportTimeout, match=r"theta_r on /dev/.*stopping"):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).stop()


# arriving -------------------------------------------------------------------------------------------------------------


def test_arrival(axis: Any) -> None:
    axis("/1 1 00 get pos", "@01 1 00 OK IDLE -- 192003").check_arrival(45, 0.001)


@pytest.mark.parametrize("flag", ["FS", "FE", "FH", "WL", "NI"])
def test_arrival_disturbed(axis: Any, flag: str) -> None:
    stage = axis("/1 1 00 get pos", f"@01 1 00 OK IDLE {flag} 192000", "/1 1 01 warnings", f"@01 1 01 OK IDLE {flag} 01 {flag}")
    with pytest.raises(DeviceFault, match=rf"theta_r on /dev/.*{flag} \("):
        stage.check_arrival(45, 0.01)


@pytest.mark.parametrize("flag", ["WT", "WV", "NC", "WH"])
def test_arrival_in_spite_of_warnings(axis: Any, flag: str) -> None:
    stage = axis("/1 1 00 get pos", f"@01 1 00 OK IDLE {flag} 192000", "/1 1 01 warnings", f"@01 1 01 OK IDLE {flag} 01 {flag}")
    stage.check_arrival(45, 0.01)


def test_arrival_elsewhere(axis: Any) -> None:
    with pytest.raises(DeviceFault, match=r"rests at 44\.0625 deg"):
        axis("/1 1 00 get pos", "@01 1 00 OK IDLE -- 188000").check_arrival(45, 0.01)


def test_arrival_not_yet(axis: Any) -> None:
    with pytest.raises(DeviceFault, match="still moving"):
        axis("/1 1 00 get pos", "@01 1 00 OK BUSY -- 192000").check_arrival(45, 0.01)


# the end --------------------------------------------------------------------------------------------------------------


def test_unplugged(plug: Any, script: Any) -> None:
    link = plug(script.expect(says("/1 1 00 get pos")), script.unplug())
    with pytest.raises(PortClosed, match="theta_r on /dev/"):
        ZaberAxis(link, "theta_r", microsteps_per_unit=SCALE).state()


def test_closed(plug: Any, script: Any) -> None:
    """Closing one device leaves the link to the other."""
    link = plug(*talk(script, "/2 1 00 get pos", "@02 1 00 OK IDLE -- 7"))
    one = ZaberAxis(link, "theta_i", address=1, microsteps_per_unit=1)
    two = ZaberAxis(link, "theta_r", address=2, microsteps_per_unit=1)
    one.close()
    one.close()
    with pytest.raises(PortClosed, match="theta_i"):
        one.state()
    assert two.state().position == 7


@pytest.mark.parametrize(
    "options",
    [
        {"microsteps_per_unit": 0.0},
        {"microsteps_per_unit": math.nan},
        {"microsteps_per_unit": 1.0, "address": 0},
        {"microsteps_per_unit": 1.0, "address": 100},
        {"microsteps_per_unit": 1.0, "axis": 0},
        {"microsteps_per_unit": 1.0, "acceleration_unit": -1.0},
    ],
)
def test_nonsense_options(plug: Any, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidSetting, match="theta_r"):
        ZaberAxis(plug(), "theta_r", **options)
