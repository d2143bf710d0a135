"""The Zaber chain as a state machine: grammar, checksums, settings, motion."""

from __future__ import annotations

import asyncio
import dataclasses

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim.clock import ManualClock
from sim.errors import SimError
from sim.motion import Ringing
from sim.zaber import Command, LinearModel, StageModel, ZaberChain, checksum, parse
from tests.sim.lines import Recorder

TURN = 1_536_000
VECTORS = [
    (b"/0 0 00", "00"),
    (b"/1 0 04 get deviceid", "3E"),
    (b"/1 1 34 move abs 1000", "E9"),
    (b"@01 0 00 OK IDLE WR 0", "BE"),
]


class Desk:
    """A chain of two stages with a clock in hand."""

    def __init__(self, model: StageModel | LinearModel | None = None, positions: tuple[float, ...] = (200.0, 30.0)) -> None:
        self.clock = ManualClock()
        self.chain = ZaberChain(self.clock, positions, model)

    def send(self, packet: str) -> list[str]:
        return [reply.decode("ascii").removesuffix("\r\n") for reply in self.chain.answer(packet.encode("latin-1"))]

    def ask(self, packet: str) -> str:
        (reply,) = self.send(packet)
        return reply

    def data(self, packet: str) -> str:
        return self.ask(packet).split(" ", 5)[5]

    def wait(self, seconds: float = 60.0) -> None:
        self.clock.set(self.clock.now() + seconds)

    def home(self) -> None:
        self.send("/0 home")
        self.wait()

    def angle(self, axis: int = 0) -> float:
        return self.chain.axes[axis].track.mechanical(self.clock.now())


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def homed(desk: Desk) -> Desk:
    desk.home()
    return desk


# Grammar


@pytest.mark.parametrize(("packet", "check"), VECTORS)
def test_checksum_vectors(packet: bytes, check: str) -> None:
    assert f"{checksum(packet[1:]):02X}" == check


def test_first_contact_is_byte_exact(desk: Desk) -> None:
    assert desk.chain.answer(b"/0 0 00:00") == [b"@01 0 00 OK IDLE WR 0:BE\r\n", b"@02 0 00 OK IDLE WR 0:BD\r\n"]
    assert desk.chain.answer(b"/1 1 17 get pos") == [b"@01 1 17 OK IDLE WR 0\r\n"]


@pytest.mark.parametrize(
    ("packet", "command"),
    [
        (b"/1 1 17 get pos:24", Command(1, 1, "17", ("get", "pos"), True)),
        (b"/1 1 05", Command(1, 1, "05", (), False)),
        (b"/1 1 home", Command(1, 1, None, ("home",), False)),
        (b"/1 home", Command(1, 0, None, ("home",), False)),
        (b"/home", Command(0, 0, None, ("home",), False)),
        (b"/", Command(0, 0, None, (), False)),
        (b"/2 1 -- move rel -5", Command(2, 1, "--", ("move", "rel", "-5"), False)),
        (b"\xff\x00noise/1 1 05", Command(1, 1, "05", (), False)),
        (b"/1 1 34 mo/1 1 05", Command(1, 1, "05", (), False)),
        (b"1 1 17 get pos", None),
        (b"/1 1 17 get pos:25", None),
        (b"/1 1 17 get pos:2", None),
        (b"/1 1 17 get pos:zz", None),
        (b"/100 1 home", None),
    ],
)
def test_parse(packet: bytes, command: Command | None) -> None:
    assert parse(packet) == command


def test_a_bad_checksum_is_ignored_and_nothing_moves(homed: Desk) -> None:
    assert homed.send("/1 1 34 move abs 1000:EA") == []
    assert homed.ask("/1 1") == "@01 1 OK IDLE -- 0"
    assert homed.ask("/1 1 34 move abs 1000:E9").startswith("@01 1 34 OK BUSY -- 0:")


def test_reply_carries_a_checksum_if_the_command_did_or_the_device_is_set_to(desk: Desk) -> None:
    assert ":" not in desk.ask("/1 get version")
    assert desk.ask("/1 0 04 get deviceid:3E").endswith(f":{checksum(b'01 0 04 OK IDLE WR 99999'):02X}")
    desk.ask("/1 set comm.checksum 1")
    assert desk.ask("/1") == "@01 0 OK IDLE WR 0:" + f"{checksum(b'01 0 OK IDLE WR 0'):02X}"
    assert ":" not in desk.ask("/2")


def test_no_reply_is_wanted_with_two_dashes(homed: Desk) -> None:
    assert homed.send("/1 1 -- move abs 1000") == []
    homed.wait()
    assert homed.data("/1 1 get pos") == "1000"


@pytest.mark.parametrize(
    ("packet", "reply"),
    [
        ("/1 1 09 get nothing", "@01 1 09 RJ IDLE -- BADCOMMAND"),
        ("/1 1 get encoder.pos", "@01 1 RJ IDLE -- BADCOMMAND"),
        ("/1 dance", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 HOME", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 home now", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 move", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 move up 3", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 move abs", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 move abs 1 2 3 4", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 move abs ten", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 move abs 1.5", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 move abs -1", "@01 0 RJ IDLE -- BADDATA"),
        (f"/1 move abs {TURN + 1}", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 move rel -1", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 move abs 1000 0", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 move abs 1000 99999999", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 set maxspeed 0", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 set maxspeed", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 set peripheralid 5", "@01 0 RJ IDLE -- BADCOMMAND"),
        ("/1 set limit.min 2000000", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 2 home", "@01 2 RJ IDLE -- BADAXIS"),
        ("/1 1 123 home", "@01 1 RJ IDLE -- BADMESSAGEID"),
        ("/1 1 get deviceid", "@01 1 RJ IDLE -- DEVICEONLY"),
        ("/1 1 system reset", "@01 1 RJ IDLE -- DEVICEONLY"),
        ("/1 set comm.alert 2", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 renumber 100", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 renumber", "@01 0 RJ IDLE -- BADDATA"),
        ("/1 get pos\\", "@01 0 RJ IDLE -- BADCOMMAND"),
    ],
)
def test_rejections(homed: Desk, packet: str, reply: str) -> None:
    assert homed.ask(packet) == reply
    assert homed.ask("/1 1 get pos") == "@01 1 OK IDLE -- 0"


def test_nobody_answers_for_an_address_that_is_not_there(desk: Desk) -> None:
    assert desk.send("/3 1 home") == []


# Settings


def test_identity_and_scales_in_native_units(desk: Desk) -> None:
    assert desk.data("/1 get limit.cycle.dist") == str(TURN)
    assert desk.data("/1 1 get limit.max") == str(TURN)
    assert desk.data("/1 1 get limit.min") == "0"
    assert desk.data("/1 1 get resolution") == "64"
    # 60 deg/s = 256 000 usteps/s, times 1.6384; 600 deg/s^2 = 2 560 000 usteps/s^2, times 1.6384/10 000.
    assert desk.data("/1 1 get maxspeed") == "419430"
    assert desk.data("/1 1 get accel") == "419"
    assert [desk.data(f"/{n} get system.serial") for n in (1, 2)] == ["10001", "10002"]
    assert desk.data("/1 get system.axiscount") == "1"


@pytest.mark.parametrize(("name", "value"), [("maxspeed", 200000), ("accel", 100), ("limit.min", -500), ("limit.max", 5), ("pos", -77)])
def test_settings_are_kept(homed: Desk, name: str, value: int) -> None:
    assert homed.ask(f"/1 1 set {name} {value}") == "@01 1 OK IDLE -- 0"
    assert homed.data(f"/1 1 get {name}") == str(value)
    assert homed.data(f"/2 1 get {name}") != str(value)


def test_resolution_scales_what_counts_in_microsteps_and_loses_the_reference(homed: Desk) -> None:
    homed.ask("/1 1 move abs 384000")
    homed.wait()
    homed.ask("/1 1 set resolution 128")
    assert homed.data("/1 1 get limit.cycle.dist") == str(2 * TURN)
    assert homed.data("/1 1 get maxspeed") == "838860"
    assert homed.data("/1 1 get pos") == "768000"
    assert homed.ask("/1 1 move abs 0") == "@01 1 RJ IDLE WR BADDATA"
    assert homed.angle() == pytest.approx(90.0)


def test_some_settings_cannot_change_under_way(homed: Desk) -> None:
    homed.ask("/1 1 move abs 384000")
    assert homed.ask("/1 1 set pos 0") == "@01 1 RJ BUSY -- STATUSBUSY"


# Motion


def test_power_up_without_reference(desk: Desk) -> None:
    assert desk.data("/1 1 get pos") == "0"
    assert desk.angle() == 200.0
    assert desk.data("/1 1 warnings") == "01 WR"
    assert desk.data("/1 1 warnings clear") == "01 WR"
    assert desk.ask("/1 1") == "@01 1 OK IDLE WR 0"
    for packet in ("/1 1 move abs 1000", "/1 1 move max", "/1 1 move min"):
        assert desk.ask(packet) == "@01 1 RJ IDLE WR BADDATA"
    assert desk.ask("/1 1 move rel 128000").split()[2] == "OK"
    desk.wait()
    assert desk.angle() == pytest.approx(230.0)
    assert desk.data("/1 1 get pos") == "128000"


def test_homing_takes_real_motion_time_and_finds_the_index(desk: Desk) -> None:
    assert desk.ask("/1 1 home") == "@01 1 OK BUSY WR 0"
    travel = 199.0 / 30.0  # fast to beside the index, at 30 deg/s
    desk.wait(travel)
    assert desk.ask("/1 1") == "@01 1 OK BUSY WR 0"
    desk.wait(2.0)
    assert desk.ask("/1 1") == "@01 1 OK IDLE -- 0"
    assert desk.data("/1 1 warnings") == "00"
    assert desk.data("/1 1 get pos") == "0"
    assert desk.angle() == pytest.approx(0.0, abs=1e-6)
    assert desk.ask("/2 1").split()[4] == "WR"  # the other stage was not told to home


def test_limit_home_pos_names_the_index(desk: Desk) -> None:
    desk.ask("/1 1 set limit.home.pos 5000")
    desk.home()
    assert desk.data("/1 1 get pos") == "5000"
    desk.ask("/1 1 move abs 389000")
    desk.wait()
    assert desk.angle() == pytest.approx(90.0)


def test_a_stopped_homing_leaves_no_reference(desk: Desk) -> None:
    desk.ask("/1 1 home")
    desk.wait(1.0)
    assert desk.ask("/1 1 stop") == "@01 1 OK BUSY WR 0"
    desk.wait()
    assert desk.data("/1 1 warnings") == "02 WR NI"
    assert desk.ask("/1 1 move abs 0").endswith("WR BADDATA")


def test_flags_before_homing_can_be_chosen() -> None:
    desk = Desk(StageModel(unhomed_flags=("WR", "WH")))
    assert desk.data("/1 1 warnings") == "02 WR WH"
    desk.home()
    assert desk.data("/1 1 warnings") == "00"


def test_a_move_follows_the_trapezoid_of_its_settings(homed: Desk) -> None:
    begin = homed.clock.now()
    homed.ask("/1 1 move abs 384000")
    speed, accel = 419430 / 1.6384, 419 / 1.6384e-4
    duration = 384000 / speed + speed / accel
    assert homed.chain.axes[0].track.end - begin == pytest.approx(duration, rel=1e-12)
    homed.wait(duration / 2)
    assert int(homed.data("/1 1 get pos")) == pytest.approx(192000, abs=1)
    homed.wait(duration / 2 - 1e-6)
    assert homed.ask("/1 1").split()[3] == "BUSY"
    homed.wait(2e-6)
    assert homed.ask("/1 1 get pos") == "@01 1 OK IDLE -- 384000"


def test_speed_and_acceleration_of_one_move(homed: Desk) -> None:
    begin = homed.clock.now()
    homed.ask("/1 1 move abs 384000 100000 50")
    speed, accel = 100000 / 1.6384, 50 / 1.6384e-4
    assert homed.chain.axes[0].track.end - begin == pytest.approx(384000 / speed + speed / accel)
    homed.wait()
    begin = homed.clock.now()
    homed.ask("/1 1 move abs 0")
    assert homed.chain.axes[0].track.end - begin < 2.0


def test_idle_comes_before_the_arm_is_quiet_and_readback_does_not_show_it() -> None:
    desk = Desk(StageModel(ringing=Ringing(0.02, 0.05, 25.0)))
    desk.home()
    desk.ask("/1 1 move abs 384000")
    desk.wait(desk.chain.axes[0].track.end - desk.clock.now() + 0.01)
    assert desk.ask("/1 1 get pos") == "@01 1 OK IDLE -- 384000"
    assert desk.angle() - 90.0 > 0.01
    desk.wait(1.0)
    assert desk.angle() == pytest.approx(90.0, abs=1e-6)


def test_readback_is_in_whole_microsteps(homed: Desk) -> None:
    homed.ask("/1 1 move abs 384000")
    for _ in range(50):
        homed.wait(0.0301)
        true = homed.chain.axes[0].track.nominal(homed.clock.now())[0]
        assert abs(int(homed.data("/1 1 get pos")) - true * TURN / 360) <= 0.5 + 1e-6


def test_stop_brakes_from_where_it_is_and_notes_the_interruption(homed: Desk) -> None:
    homed.ask("/1 1 move max")
    homed.wait(1.0)
    before = int(homed.data("/1 1 get pos"))
    assert homed.ask("/1 1 stop") == "@01 1 OK BUSY NI 0"
    homed.wait(1.0)
    speed, accel = 419430 / 1.6384, 419 / 1.6384e-4
    assert int(homed.data("/1 1 get pos")) - before == pytest.approx(speed**2 / (2 * accel), abs=1)
    assert homed.data("/1 1 warnings clear") == "01 NI"
    assert homed.ask("/1 1 stop") == "@01 1 OK IDLE -- 0"


def test_a_new_target_under_way_interrupts(homed: Desk) -> None:
    homed.ask("/1 1 move abs 384000")
    homed.wait(0.5)
    assert homed.ask("/1 1 move abs 1000") == "@01 1 OK BUSY NI 0"
    homed.wait()
    assert homed.data("/1 1 get pos") == "1000"


@pytest.mark.parametrize(("velocity", "end"), [(100000, TURN), (-100000, 0)])
def test_velocity_moves_end_at_the_limits(homed: Desk, velocity: int, end: int) -> None:
    homed.ask("/1 1 move abs 768000")
    homed.wait()
    homed.ask(f"/1 1 move vel {velocity}")
    begin, before = homed.clock.now(), int(homed.data("/1 1 get pos"))
    homed.wait(2.0)
    homed.wait(1.0)
    after = int(homed.data("/1 1 get pos"))
    assert abs(after - before) == pytest.approx(3.0 * abs(velocity) / 1.6384, rel=0.02)
    assert homed.clock.now() - begin == 3.0
    homed.wait(100.0)
    assert homed.ask("/1 1 get pos") == f"@01 1 OK IDLE -- {end}"


def test_velocity_zero_stops(homed: Desk) -> None:
    homed.ask("/1 1 move vel 100000")
    homed.wait(1.0)
    homed.ask("/1 1 move vel 0")
    homed.wait(1.0)
    assert homed.ask("/1 1").split()[3] == "IDLE"


def test_without_reference_a_velocity_move_turns_until_stopped(desk: Desk) -> None:
    desk.ask("/2 1 move vel 400000")
    desk.wait(100.0)
    assert desk.ask("/2 1").split()[3] == "BUSY"
    assert int(desk.data("/2 1 get pos")) > 10 * TURN
    desk.ask("/2 1 stop")
    desk.wait(1.0)
    assert desk.ask("/2 1").split()[3] == "IDLE"


def test_broadcast_moves_every_stage(homed: Desk) -> None:
    assert homed.send("/0 1 07 move abs 128000") == ["@01 1 07 OK BUSY -- 0", "@02 1 07 OK BUSY -- 0"]
    homed.wait()
    assert homed.send("/get pos") == ["@01 0 OK IDLE -- 128000", "@02 0 OK IDLE -- 128000"]
    assert [homed.angle(i) for i in (0, 1)] == pytest.approx([30.0, 30.0])


def test_set_pos_moves_the_counter_and_not_the_arm(homed: Desk) -> None:
    homed.ask("/1 1 set pos 384000")
    homed.ask("/1 1 move abs 512000")
    homed.wait()
    assert homed.angle() == pytest.approx(30.0)


def test_renumber(desk: Desk) -> None:
    assert desk.send("/0 0 68 renumber 3") == ["@03 0 68 OK IDLE WR 0", "@04 0 68 OK IDLE WR 0"]
    assert desk.send("/1") == []
    assert desk.ask("/4 renumber 9") == "@09 0 OK IDLE WR 0"
    assert [reply[:3] for reply in desk.send("/renumber")] == ["@01", "@02"]


def test_system_reset_forgets_the_reference_and_keeps_the_angle(homed: Desk) -> None:
    homed.ask("/1 1 move abs 384000")
    homed.wait(0.8)
    assert homed.ask("/1 system reset").startswith("@01 0 OK")
    homed.wait(1.0)
    stopped = homed.angle()
    assert 30.0 < stopped < 60.0
    assert homed.data("/1 1 get pos") == "0"
    assert homed.data("/1 1 warnings") == "01 WR"
    assert homed.ask("/2 1").split()[4] == "--"


def test_alerts_come_once_per_motion_and_only_if_wanted(homed: Desk) -> None:
    homed.chain.alerts()
    homed.send("/0 1 move abs 1000")
    homed.ask("/1 set comm.alert 1")
    assert homed.chain.alerts() == []
    homed.wait()
    assert homed.chain.alerts() == [b"!01 1 IDLE --\r\n"]
    assert homed.chain.alerts() == []


def test_alerts_reach_every_line_when_the_motion_ends() -> None:
    async def scene() -> None:
        clock = ManualClock()
        chain = ZaberChain(clock, [10.0])
        one, other = Recorder(), Recorder()
        tasks = [asyncio.create_task(chain.serve(line)) for line in (one, other)]
        one.said.put_nowait(b"/1 set comm.alert 1\n/1 1 move rel 38")
        one.said.put_nowait(b"4000\r\n")
        await clock.advance(1.0)
        assert one.heard == [b"@01 0 OK IDLE WR 0\r\n", b"@01 1 OK BUSY WR 0\r\n"]
        await clock.advance(5.0)
        assert one.heard[2:] == other.heard == [b"!01 1 IDLE WR\r\n"]
        for line in (one, other):
            line.said.put_nowait(b"")
        await asyncio.gather(*tasks)

    asyncio.run(scene())


def test_an_overlong_packet_is_dropped_whole() -> None:
    async def scene() -> None:
        chain, line = ZaberChain(ManualClock(), [10.0]), Recorder()
        for piece in (b"/1 " + b"x" * 200, b"/1 1 01", b"\n/1 1 02\n", b""):
            line.said.put_nowait(piece)
        await chain.serve(line)
        assert line.heard == [b"@01 1 02 OK IDLE WR 0\r\n"]

    asyncio.run(scene())


# Whatever arrives

WORDS = st.sampled_from(
    ["/", "/1", "/0", " 1", " 0", " 05", " --", " move", " abs", " rel", " vel", " max", " set", " get", " pos", " accel", " limit.max",
     " 1000",
     " -9", " home", " stop", " warnings", " clear", " renumber", " system", " reset", " resolution", " 999999999999", ":", ":FF", "\\",
     "\u00b2",
     " maxspeed"]
)  # fmt: skip


@given(st.one_of(st.binary(max_size=60), st.lists(WORDS, max_size=9).map(lambda words: "".join(words).encode("latin-1"))), st.floats(0, 3))
@example("/1 1 \u00b2".encode("latin-1"), 0.0)
@example(b"/1 1 " + b"9" * 5000, 0.0)
def test_no_bytes_can_upset_it(packet: bytes, pause: float) -> None:
    desk = Desk()
    desk.home()
    for reply in desk.chain.answer(packet):
        body = reply.decode("ascii").removesuffix("\r\n")
        assert body[0] == "@"
        text, _, check = body[1:].partition(":")
        assert not check or int(check, 16) == checksum(text.encode())
        assert text.split()[-1].isupper() or text.split()[-1].replace(".", "").lstrip("-").isdigit() or text.endswith("--")
    desk.wait(pause)
    desk.send("/0 1 stop")
    desk.wait(300.0)
    assert len(desk.send("/0 0 33")) == 2
    assert [reply.split()[4] for reply in desk.send("/0 1 34")] == ["IDLE", "IDLE"]


@pytest.mark.parametrize("change", [{"speed": 0.0}, {"acceleration": -1.0}, {"limit_min": 400.0}, {"speed": float("nan")}, {"speed": 1e-9}])
def test_impossible_stages_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(SimError):
        ZaberChain(ManualClock(), [0.0], dataclasses.replace(StageModel(), **change))  # type: ignore[arg-type]


# Linear stages

MICROSTEP = 0.047625e-3  # mm


@pytest.fixture
def rail() -> Desk:
    return Desk(LinearModel(ringing=Ringing(0.0)), (80.0, 30.0))


def test_a_linear_stage_counts_microsteps_of_its_lead_screw(rail: Desk) -> None:
    assert (rail.chain.model, Desk().chain.model) == ("zaber-x-lsm", "zaber-x-rsw60a")
    assert rail.ask("/1 1 get limit.cycle.dist") == "@01 1 RJ IDLE WR BADCOMMAND"
    rail.home()
    assert (rail.data("/1 1 get limit.min"), rail.data("/1 1 get limit.max")) == ("0", "3149606")  # 150 mm
    assert rail.data("/1 1 get maxspeed") == str(round(20 / MICROSTEP * 1.6384))
    assert rail.data("/1 1 get accel") == str(round(200 / MICROSTEP * 1.6384e-4))
    rail.ask("/1 1 move abs 1000000")
    rail.wait()
    assert rail.angle() == pytest.approx(47.625)
    assert rail.angle(1) == pytest.approx(0.0)
    assert rail.ask("/1 1 move abs 3149607").endswith("RJ IDLE -- BADDATA")
    # 20 mm/s at 200 mm/s^2: 40 mm take 2.1 s.
    rail.ask(f"/1 1 move rel {round(40 / MICROSTEP)}")
    rail.wait(2.09)
    assert " BUSY " in rail.ask("/1 1")
    rail.wait(0.02)
    assert rail.ask("/1 1") == "@01 1 OK IDLE -- 0"


@pytest.mark.parametrize(("command", "end"), [("move vel 500000", 150.5), ("move vel -500000", -0.5), ("move rel 9000000", 150.5)])
def test_a_carriage_without_reference_ends_where_the_rail_ends_and_says_it_stalled(rail: Desk, command: str, end: float) -> None:
    assert rail.ask(f"/1 1 {command}") == "@01 1 OK BUSY WR 0"
    rail.wait()
    assert rail.ask("/1 1") == "@01 1 OK IDLE FS 0"
    assert rail.angle() == pytest.approx(end)
    rail.home()
    assert rail.angle() == pytest.approx(0.0)


def test_resolution_scales_a_linear_stage(rail: Desk) -> None:
    rail.home()
    rail.ask("/1 1 set resolution 128")
    rail.home()
    assert rail.data("/1 1 get limit.max") == "6299212"
    rail.ask("/1 1 move abs 1000000")
    rail.wait()
    assert rail.angle() == pytest.approx(47.625 / 2)


@pytest.mark.parametrize("change", [{"microstep": 0.0}, {"limit_max": -1.0}, {"speed": 0.0}])
def test_an_impossible_linear_stage_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(SimError, match="above zero"):
        ZaberChain(ManualClock(), [0.0], dataclasses.replace(LinearModel(), **change))  # type: ignore[arg-type]


def test_stop_commands_are_told_axis_by_axis(homed: Desk) -> None:
    told: list[str] = []
    homed.chain.on_stop = told.append
    homed.ask("/2 renumber 7")
    homed.ask("/1 1 move abs 700000")
    for packet in ("/7 1 stop", "/1 stop", "/stop", "/1 1 stop now", "/1 2 stop", "/1 1 stop:00", "/1 1 move vel 0"):
        homed.send(packet)
    assert told == ["2", "1", "1", "2"]
