"""What a sweep does, as bluesky plans: generators of messages; nothing here touches hardware."""

from collections.abc import Generator, Mapping
from typing import Any

from bluesky.utils import Msg

from rig.bench import Bench
from rig.trajectory import Trajectory

Plan = Generator[Msg, Any, Any]


def home(bench: Bench) -> Plan:
    """Home, one after the other, the axes that have no reference yet."""
    for name, axis in bench.axes.items():
        if not axis.homed:
            yield Msg("checkpoint")
            yield Msg("set", axis.homing, 1, group=f"home-{name}")
            yield Msg("wait", None, group=f"home-{name}")


def sweep(bench: Bench, trajectory: Trajectory, metadata: Mapping[str, Any]) -> Plan:
    """Measure the points of `trajectory` as one run.

    Each reading starts with a checkpoint and sends every axis to its place, so that a run that was paused there goes on rightly
    even if somebody turned an arm meanwhile.
    """
    yield from home(bench)
    yield Msg("open_run", None, **metadata)
    for point in trajectory.points():
        target = {"source": point.theta_i, "detector": point.theta_r}
        for _ in range(trajectory.repeat):
            yield Msg("checkpoint")
            yield from move(bench, target)
            yield from _read(bench)
    yield Msg("close_run", None, exit_status=None, reason=None)


def move(bench: Bench, target: Mapping[str, float]) -> Plan:
    """Send the axes to `target` (degrees of theta), in an order that keeps the arms out of each other's way."""
    for number, group in enumerate(bench.config.interlock.order(bench.position(), target)):
        for axis in group:
            yield Msg("set", bench.axes[axis], target[axis], group=f"move-{number}")
        yield Msg("wait", None, group=f"move-{number}")


def _read(bench: Bench) -> Plan:
    sensors = (bench.meter, *bench.monitors)
    for sensor in sensors:
        yield Msg("trigger", sensor, group="reading")
    yield Msg("wait", None, group="reading")
    yield Msg("create", None, name="primary")
    for device in (*bench.axes.values(), *sensors):
        yield Msg("read", device)
    yield Msg("save")
