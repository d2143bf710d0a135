"""One axis, its stage scripted: motions in doubt, stops, axes astray, time-outs, and what is written down of them."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import BadChecksum, DeviceError, DeviceFault, MoveTimeout, NotHomed, TransportTimeout, UnexpectedReply
from drivers.incidents import Incident
from drivers.kinds import AxisState, ForgetfulStage, Stage
from rig.axisrecord import AxisRecords
from rig.brake import Brake
from rig.bus import BusWorker
from rig.clock import Clock
from rig.devices import ASTRAY, Axis
from rig.errors import InterlockError, RunError
from rig.kinematics import AxisMap
from rig.status import Status
from tests.rig.scripted import ScriptedStage, Start, goes, goes_and_the_answer_is_lost, is_lost, moves, rest

SPEED = 5.0
"""Of bench time: the shortest time-out is a second of real time, and looks are 4 ms apart."""

HASTE = 1000.0
"""For tests of what takes too long: looks are 4 s of bench time apart."""

WHO = "port scripted"
STRAIGHT = AxisMap(1, 0.0)


@dataclass
class Desk:
    """A bus, and axes made of scripted stages on it."""

    bus: BusWorker
    folder: Path
    incidents: list[Incident] = field(default_factory=list)
    clock: Clock = field(default_factory=lambda: Clock(SPEED))

    @property
    def records(self) -> AxisRecords:
        return AxisRecords(self.folder / "axes.json")

    def written(self) -> dict[str, Any]:
        return dict(json.loads((self.folder / "axes.json").read_text())["axes"][WHO])

    def axis(
        self,
        stage: ScriptedStage,
        axis_map: AxisMap = STRAIGHT,
        *,
        limits: tuple[float, float] = (-85.0, 85.0),
        check: Callable[[str, float], None] = lambda name, theta: None,
    ) -> Axis:
        assert isinstance(stage, Stage)
        return Axis(
            "detector",
            "theta_r",
            stage,
            axis_map,
            self.bus,
            self.clock,
            Brake(),
            settle_s=0.01,
            tolerance=0.02,
            limits=limits,
            check=check,
            memory=self.records.of(WHO),
            report=self.incidents.append,
        )


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    bus = BusWorker("scripted", Clock(SPEED))
    yield Desk(bus, tmp_path)
    bus.close()


@pytest.fixture
def hasty(tmp_path: Path) -> Iterator[Desk]:
    """The same, in a hurry."""
    bus = BusWorker("scripted", Clock(HASTE))
    yield Desk(bus, tmp_path, clock=Clock(HASTE))
    bus.close()


@dataclass(frozen=True)
class Motion:
    """A move or a homing: how it is begun, and what the stage is told."""

    begin: Callable[[Axis], Status]
    told: tuple[str, float | None]
    end: float


MOTIONS = {"move": Motion(lambda axis: axis.set(30.0), ("move", 30.0), 30.0), "home": Motion(lambda axis: axis.home(), ("home", None), 0.0)}


@pytest.fixture(params=MOTIONS)
def motion(request: pytest.FixtureRequest) -> Motion:
    return MOTIONS[request.param]


def at(position: float = 10.0, **more: Any) -> ScriptedStage:
    stage = ScriptedStage(**more)
    stage.see(rest(position))
    return stage


# Motions whose start is in doubt


def test_a_motion_whose_answer_is_lost_is_followed_and_never_sent_again(desk: Desk, motion: Motion) -> None:
    stage = at(10.0, starts=[goes_and_the_answer_is_lost])
    axis = desk.axis(stage)
    motion.begin(axis).wait(10)
    assert stage.told == [motion.told]
    assert axis.position == motion.end
    assert [(incident.what, incident.device) for incident in desk.incidents] == [("motion followed", "detector")]
    assert "no reply" in desk.incidents[0].detail


@pytest.mark.parametrize("error", [TransportTimeout, BadChecksum, UnexpectedReply])
def test_a_motion_is_sent_once_more_where_nothing_has_stirred(desk: Desk, motion: Motion, error: type[DeviceError]) -> None:
    def in_vain(stage: ScriptedStage, goal: float | None) -> None:
        raise error("the answer is no answer", device="fake")

    stage = at(10.0, starts=[in_vain])
    axis = desk.axis(stage)
    motion.begin(axis).wait(10)
    assert stage.told == [motion.told] * 2
    assert axis.position == motion.end
    assert [incident.what for incident in desk.incidents] == ["motion sent again"]


def test_lost_twice_it_is_an_error_and_never_sent_a_third_time(desk: Desk, motion: Motion) -> None:
    stage = at(10.0, starts=[is_lost, is_lost])
    error = motion.begin(desk.axis(stage)).exception(10)
    assert isinstance(error, TransportTimeout)
    assert stage.motions == [motion.told] * 2
    assert desk.written()["under_way"]  # the second one may have been taken


def test_a_motion_that_has_ended_already_is_known_by_where_the_axis_is(desk: Desk) -> None:
    def arrives_at_once(stage: ScriptedStage, goal: float | None) -> None:
        assert goal is not None
        stage.see(rest(goal))
        raise TransportTimeout("no reply", device="fake")

    stage = at(10.0, starts=[arrives_at_once])
    desk.axis(stage).set(10.5).wait(10)
    assert stage.told == [("move", 10.5)]
    assert [incident.what for incident in desk.incidents] == ["motion followed"]


def test_a_motion_that_has_only_just_begun_is_followed(desk: Desk, motion: Motion) -> None:
    def begins(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(10.0), moves(10.0), rest(motion.end))
        raise TransportTimeout("no reply", device="fake")

    stage = at(10.0, starts=[begins])
    motion.begin(desk.axis(stage)).wait(10)
    assert stage.told == [motion.told]
    assert [incident.what for incident in desk.incidents] == ["motion followed"]


def test_following_the_wrong_motion_is_an_error(desk: Desk) -> None:
    def goes_elsewhere(stage: ScriptedStage, goal: float | None) -> None:
        goes(stage, 25.0)
        raise BadChecksum("damaged", device="fake")

    stage = at(10.0, starts=[goes_elsewhere])
    assert isinstance(desk.axis(stage).set(30.0).exception(10), DeviceFault)
    assert stage.motions == [("move", 30.0)]


def test_where_the_state_cannot_be_asked_nothing_is_sent_again(desk: Desk, motion: Motion) -> None:
    def goes_silent(stage: ScriptedStage, goal: float | None) -> None:
        def silent() -> None:
            raise TransportTimeout("no reply to the question either", device="fake")

        stage.on_look = silent
        raise TransportTimeout("no reply", device="fake")

    stage = at(10.0, starts=[goes_silent])
    with pytest.raises(TransportTimeout, match="question"):
        motion.begin(desk.axis(stage)).wait(10)
    assert stage.motions == [motion.told]
    assert desk.written()["under_way"]


def test_a_refusal_is_not_sent_again_and_nothing_is_under_way(desk: Desk, motion: Motion) -> None:
    def refuses(stage: ScriptedStage, goal: float | None) -> None:
        raise DeviceFault("no", device="fake")

    stage = at(10.0, starts=[refuses])
    with pytest.raises(DeviceFault, match="no"):
        motion.begin(desk.axis(stage)).wait(10)
    assert stage.told == [motion.told]
    assert not desk.written()["under_way"]


# Stops


def test_a_stop_before_the_bus_is_free_and_nothing_is_sent(desk: Desk, motion: Motion) -> None:
    gate = threading.Event()
    desk.bus.call(lambda: gate.wait(10))
    stage = at(10.0)
    axis = desk.axis(stage)
    status = motion.begin(axis)
    axis.stop()
    gate.set()
    status.wait(10)
    assert stage.told == [("stop", None)]


@pytest.mark.parametrize("when", ["while the start waits for its answer", "while the state is asked"])
def test_after_a_stop_a_motion_in_doubt_is_not_sent_again(desk: Desk, motion: Motion, when: str) -> None:
    stage = at(10.0)
    axis = desk.axis(stage)

    def stop_once() -> None:
        stage.on_look = lambda: None
        axis.stop()

    def lost(stage: ScriptedStage, goal: float | None) -> None:
        if when == "while the state is asked":
            stage.on_look = stop_once
        else:
            axis.stop()
        raise TransportTimeout("no reply", device="fake")

    stage.starts = [lost]
    motion.begin(axis).wait(10)
    assert stage.motions == [motion.told]
    assert stage.told[-1] == ("stop", None)


@pytest.mark.parametrize("before", [[], [is_lost]], ids=["first", "second"])
def test_a_start_that_a_stop_overtook_is_stopped(desk: Desk, motion: Motion, before: list[Start]) -> None:
    stage = at(10.0)
    axis = desk.axis(stage)

    def overtaken(stage: ScriptedStage, goal: float | None) -> None:
        axis.stop()
        goes(stage, goal)

    stage.starts = [*before, overtaken]
    motion.begin(axis).wait(10)
    assert stage.told[-2:] == [("stop", None), ("stop", None)]
    assert not stage.state().moving
    assert not desk.written()["under_way"]


def test_a_stop_on_the_way_ends_the_move_well_and_says_where(desk: Desk, motion: Motion) -> None:
    stage = at(10.0)
    axis = desk.axis(stage)

    def long_way(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(12.0), moves(13.0))
        looks = iter(range(4))

        def look() -> None:
            if next(looks) == 3:
                stage.on_look = lambda: None
                axis.stop()

        stage.on_look = look

    stage.starts = [long_way]
    motion.begin(axis).wait(10)
    assert stage.told == [motion.told, ("stop", None)]
    record = desk.written()
    assert (record["readback"], record["under_way"], record["setpoint"]) == (13.0, False, motion.told[1])


# Astray


@pytest.mark.parametrize("axis_map", [STRAIGHT, AxisMap(-1, 40.0)])
@pytest.mark.parametrize(("theta", "astray"), [(10.0 - ASTRAY + 0.05, False), (9.4, True), (30.0 + ASTRAY - 0.05, False), (30.6, True)])
def test_an_axis_that_leaves_its_way_is_stopped_at_once(desk: Desk, axis_map: AxisMap, theta: float, astray: bool) -> None:
    def strays(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(axis_map.to_axis(20.0)), moves(axis_map.to_axis(theta)), rest(axis_map.to_axis(30.0)))

    stage = at(axis_map.to_axis(10.0), starts=[strays])
    move = desk.axis(stage, axis_map).set(30.0)
    if astray:
        with pytest.raises(DeviceFault, match="not on its way; it was stopped"):
            move.wait(10)
        assert stage.told == [("move", axis_map.to_axis(30.0)), ("stop", None)]
    else:
        move.wait(10)
        assert len(stage.told) == 1


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("seen", "astray"), [(85.4, False), (85.6, True)])
def test_an_axis_that_leaves_its_limits_is_stopped_even_on_its_way(desk: Desk, seen: float, astray: bool, side: int) -> None:
    def goes_far(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(side * 50.0), moves(side * seen), rest(side * 90.0))

    stage = at(10.0, starts=[goes_far])
    error = desk.axis(stage).set(side * 90.0).exception(10)  # nothing forbids it here: the limits are watched as well
    assert isinstance(error, DeviceFault) is astray
    assert (("stop", None) in stage.told) is astray


def test_an_axis_found_outside_its_limits_may_come_in(desk: Desk) -> None:
    def comes_in(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(99.0), moves(90.0), rest(80.0))

    stage = at(100.0, starts=[comes_in])
    desk.axis(stage).set(80.0).wait(10)
    assert stage.told == [("move", 80.0)]


# Motions that take too long


def never_ends(stage: ScriptedStage, goal: float | None) -> None:
    stage.see(moves(12.0))


def test_a_motion_that_never_ends_is_stopped_and_named(hasty: Desk, motion: Motion) -> None:
    stage = at(10.0, starts=[never_ends])
    with pytest.raises(MoveTimeout, match="it was stopped") as caught:
        motion.begin(hasty.axis(stage)).wait(20)
    assert stage.told == [motion.told, ("stop", None)]
    assert caught.value.elapsed_s is not None
    assert caught.value.elapsed_s > 5.0


def test_waiting_for_the_other_axis_is_not_taking_long(hasty: Desk, motion: Motion) -> None:
    def queues(stage: ScriptedStage, goal: float | None) -> None:
        aim = 0.0 if goal is None else goal
        # Looks are 4 s of bench time apart: so many outlast every time-out.
        stage.see(*[moves(10.0, waiting=True)] * 30, rest(aim))
        counted["from"] = hasty.clock.monotonic()

    counted: dict[str, float] = {}
    stage = at(10.0, starts=[queues], speed=1e5, acceleration=1e9)
    motion.begin(hasty.axis(stage)).wait(60)
    assert hasty.clock.monotonic() - counted["from"] > 100.0
    assert stage.told == [motion.told]


def test_homing_that_ends_without_a_reference_is_named(desk: Desk) -> None:
    def fails(stage: ScriptedStage, goal: float | None) -> None:
        stage.see(moves(5.0), AxisState(0.0, moving=False, homed=False))

    stage = ScriptedStage(starts=[fails])
    with pytest.raises(NotHomed, match="without a reference"):
        desk.axis(stage).home().wait(10)


def test_it_does_not_move_to_where_it_stands(desk: Desk) -> None:
    stage = at(10.0)
    desk.axis(stage).set(10.01).wait(10)
    assert stage.told == []


def test_what_the_interlock_forbids_is_not_sent(desk: Desk) -> None:
    def forbid(name: str, theta: float) -> None:
        raise InterlockError(f"{name} {theta:g}")

    stage = at(10.0)
    with pytest.raises(InterlockError, match="detector 30"):
        desk.axis(stage, check=forbid).set(30.0)
    assert stage.told == []


# What is written down


def test_the_command_is_on_the_disk_before_it_is_sent_and_under_way_until_its_end_is_seen(desk: Desk, motion: Motion) -> None:
    seen: list[tuple[str, bool]] = []

    def looks(stage: ScriptedStage, goal: float | None) -> None:
        seen.append(("started", desk.written()["under_way"]))
        assert desk.written()["setpoint"] == motion.told[1]
        assert desk.written()["readback"] == 10.0
        goes(stage, goal)
        stage.on_look = lambda: seen.append(("looked", desk.written()["under_way"]))

    stage = at(10.0, starts=[looks])
    axis = desk.axis(stage)
    motion.begin(axis).wait(10)
    assert seen[0] == ("started", True)
    assert len(seen) >= 4
    assert all(under_way for _, under_way in seen)
    record = axis.last_command
    assert record is not None
    assert (record.setpoint, record.readback, record.under_way, record.homed) == (motion.told[1], motion.end, False, True)


def test_what_cannot_be_written_down_is_not_done(desk: Desk, motion: Motion, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        raise OSError(28, "No space left on device")

    stage = at(10.0)
    axis = desk.axis(stage)
    monkeypatch.setattr("rig.axisrecord.write_atomically", full)
    with pytest.raises(RunError, match="No space left on device; no motion begins without it"):
        motion.begin(axis).wait(10)
    assert stage.told == []


# What the next program is told


def test_a_program_that_died_in_the_middle_leaves_a_notice(desk: Desk) -> None:
    desk.records.put(WHO, setpoint=70.0, readback=10.0, under_way=True, homed=True)
    axis = desk.axis(at(33.0), AxisMap(-1, 90.0))
    assert axis.notices == (
        "detector was on its way to 20.000 deg when the last program that moved it ended without seeing the end; it is at 57.000 deg now",
    )
    desk.records.put(WHO, setpoint=None, readback=10.0, under_way=True, homed=False)
    (notice,) = desk.axis(at(33.0)).notices
    assert notice.startswith("detector was homing when")


def test_an_axis_that_was_moved_meanwhile_leaves_a_notice(desk: Desk) -> None:
    desk.records.put(WHO, setpoint=30.0, readback=30.0, under_way=False, homed=True)
    (notice,) = desk.axis(at(30.03)).notices
    assert notice.startswith("detector was left at 30.000 deg and is at 30.030 deg")
    assert desk.axis(at(30.01)).notices == ()


def test_an_axis_nobody_has_moved_yet_has_no_past(desk: Desk) -> None:
    axis = desk.axis(at(30.0))
    assert axis.notices == ()
    assert axis.last_command is None


class Forgetful(ScriptedStage):
    """A stage that does not know whether it was homed."""

    trusted = 0

    def trust_reference(self) -> None:
        """Take it as homed."""
        self.trusted += 1
        self.see(*(AxisState(state.position, state.moving, homed=True) for state in self.sight))


@pytest.mark.parametrize(
    ("left", "found", "trusted"),
    [
        ({}, {}, True),
        ({"under_way": True}, {}, False),
        ({"homed": False}, {}, False),
        ({"readback": 29.9}, {}, False),
        ({"readback": 0.01}, {"position": 0.01}, False),  # a counter that was switched off would say so too
        ({"readback": -0.03}, {"position": -0.03}, True),
        ({}, {"moving": True}, False),
        ({}, {"homed": True}, False),  # knows it itself
        (None, {}, False),
    ],
)
def test_a_forgetful_stage_is_trusted_exactly_when_nothing_speaks_against_it(
    desk: Desk, left: dict[str, Any] | None, found: dict[str, Any], trusted: bool
) -> None:
    if left is not None:
        desk.records.put(WHO, **({"setpoint": 30.0, "readback": 30.0, "under_way": False, "homed": True} | left))
    stage = Forgetful()
    assert isinstance(stage, ForgetfulStage)
    stage.see(AxisState(**({"position": 30.0, "moving": False, "homed": False} | found)))
    axis = desk.axis(stage)
    assert stage.trusted == trusted
    assert axis.homed == (trusted or found.get("homed", False))


def test_a_stage_that_knows_is_not_told(desk: Desk) -> None:
    desk.records.put(WHO, setpoint=30.0, readback=30.0, under_way=False, homed=True)
    stage = ScriptedStage()
    stage.see(AxisState(30.0, moving=False, homed=False))
    assert not desk.axis(stage).homed


def test_homing_leaves_a_forgetful_stage_off_the_origin_so_that_the_record_can_vouch_for_it(desk: Desk) -> None:
    stage = Forgetful()
    stage.see(rest(5.0))
    axis = desk.axis(stage, limits=(-85.0, 20.0))
    axis.home().wait(10)
    assert stage.told == [("home", None), ("move", -0.1)]  # towards the middle of where it may go
    record = axis.last_command
    assert record is not None
    assert record.vouches(rest(-0.1), axis.tolerance)


def test_a_stage_that_knows_its_reference_stays_at_the_origin(desk: Desk) -> None:
    stage = ScriptedStage()
    stage.see(rest(5.0))
    desk.axis(stage).home().wait(10)
    assert stage.told == [("home", None)]
