"""What every motion owes: no start after a stop, a wait that ends stopped, an arrival that is made sure of."""

from __future__ import annotations

import threading
import time
from typing import Protocol

from drivers.endpoint import Endpoint, Veto
from drivers.errors import DeviceError, MoveTimeout
from drivers.kinds import AxisState, Stage, Unit

POLL_S = 0.005


class Clock(Protocol):
    """Where time comes from; the `time` module is one. A `sleep` that returns early just makes the polling start early."""

    def monotonic(self) -> float:
        """Seconds, never going backwards."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait."""
        ...


class Stops:
    """How often an axis was told to stop, so that no stop is followed by an older start.

    Attributes
    ----------
    lock : Lock
        Held while it is counted; for what must agree with the count.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.count = 0

    def veto(self, endpoint: Endpoint, attempt: str, count: int | None = None) -> Veto:
        """Make the objection to a start whose turn comes after a stop that was called since `count`, by default since now."""
        known = self.count if count is None else count

        def veto() -> DeviceError | None:
            return endpoint.fault("stopped before it could start; nothing was sent", attempt) if self.count != known else None

        return veto


def require_arrival(endpoint: Endpoint, state: AxisState, position: float, tolerance: float, attempt: str, *, unit: Unit = "deg") -> None:
    """Raise DeviceFault unless an axis rests, and within `tolerance` of a position."""
    if state.moving:
        raise endpoint.fault(f"still moving at {state.position:.4f} {unit}", attempt, expected="rest")
    if not abs(state.position - position) <= tolerance:
        raise endpoint.fault(
            f"rests at {state.position:.4f} {unit}",
            attempt,
            expected=f"{position:.4f} +- {tolerance:g} {unit}",
            hint="was it stopped, or moved by hand?",
        )


def wait_until_idle(axis: Stage, expected_s: float, *, timeout_s: float, clock: Clock = time) -> AxisState:
    """Wait for a motion that has just been started: sleep until it should be over, then ask every 5 ms.

    That the axis is idle does not mean that it arrived: see `Stage.check_arrival`.

    Parameters
    ----------
    expected_s : float, s
        When the motion should be over, from now (`MotionProfile.duration_s`).
    timeout_s : float, s
        When to give up, from now.

    Returns
    -------
    AxisState
        The first one seen at rest.

    Raises
    ------
    MoveTimeout
        The axis was still moving after `timeout_s`.
    DeviceError
        The axis could not be asked.

    Whatever ends the waiting early, the axis is told to stop before the error leaves: nobody is watching it any more.
    """
    started = clock.monotonic()
    try:
        clock.sleep(max(0.0, min(expected_s, timeout_s)))
        while (state := axis.state()).moving:
            elapsed_s = clock.monotonic() - started
            if elapsed_s >= timeout_s:
                raise MoveTimeout(
                    f"still moving at {state.position:.4f} {axis.unit}; it has been told to stop",
                    device=axis.name,
                    attempt="waiting for the end of the motion",
                    expected=f"rest after {expected_s:.3f} s",
                    elapsed_s=elapsed_s,
                    hint="check the load, the speed setting and the time allowed",
                )
            clock.sleep(POLL_S)
        return state
    except BaseException as error:
        _stop_after(error, axis)
        raise


def _stop_after(error: BaseException, axis: Stage) -> None:
    try:
        axis.stop()
    except DeviceError as second:
        warning = f"AND IT COULD NOT BE STOPPED, it may still be moving: {second}"
        if isinstance(error, DeviceError):
            error.hint = f"{error.hint}; {warning}" if error.hint else warning
        else:
            error.add_note(warning)
