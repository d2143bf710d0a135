"""Waiting for an axis to come to rest."""

from __future__ import annotations

import time
from typing import Protocol

from drivers.errors import DeviceError, MoveTimeout
from drivers.kinds import AxisState, RotaryAxis

POLL_S = 0.005


class Clock(Protocol):
    """Where time comes from; the `time` module is one. A `sleep` that returns early just makes the polling start early."""

    def monotonic(self) -> float:
        """Seconds, never going backwards."""
        ...

    def sleep(self, seconds: float, /) -> None:
        """Wait."""
        ...


def wait_until_idle(axis: RotaryAxis, expected_s: float, *, timeout_s: float, clock: Clock = time) -> AxisState:
    """Wait for a motion that has just been started: sleep until it should be over, then ask every 5 ms.

    That the axis is idle does not mean that it arrived: see `RotaryAxis.check_arrival`.

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
                    f"still moving at {state.position_deg:.4f} deg; it has been told to stop",
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


def _stop_after(error: BaseException, axis: RotaryAxis) -> None:
    try:
        axis.stop()
    except DeviceError as second:
        warning = f"AND IT COULD NOT BE STOPPED, it may still be moving: {second}"
        if isinstance(error, DeviceError):
            error.hint = f"{error.hint}; {warning}" if error.hint else warning
        else:
            error.add_note(warning)
