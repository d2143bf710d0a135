"""bluesky's RunEngine, made quiet, and made to obey `rig.interrupts`."""

import contextlib
import io
import logging
from collections.abc import Callable, Iterable
from typing import Any

from bluesky.run_engine import RunEngine
from bluesky.utils import FailedStatus, Msg, RunEngineInterrupted

from rig.errors import Interrupted
from rig.interrupts import Interrupts


def run_plan(
    plan: Iterable[Msg],
    interrupts: Interrupts,
    callbacks: Iterable[Callable[[str, dict[str, Any]], Any]],
    decide: Callable[[Interrupts], bool],
) -> None:
    """Run `plan` in an engine of its own; pausing, asking and aborting as `interrupts` says.

    Parameters
    ----------
    plan : iterable of Msg
    interrupts : Interrupts
        Entered already.
    callbacks : iterable of callables
        Receive (name, document), in this order; the journal comes first.
    decide : callable
        Asked while paused; True goes on, False aborts.

    Raises
    ------
    Interrupted
        Where the run was aborted.
    Exception
        What a device, a callback or the plan raised; the run is closed as failed.
    """
    log = logging.getLogger("bluesky")
    propagate, log.propagate = log.propagate, False
    handlers, log.handlers = log.handlers, [logging.NullHandler()]
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # the engine prints; results belong on stdout, talk does not
            engine = RunEngine({}, context_managers=[])
        engine.pause_msg = ""
        for callback in callbacks:
            engine.subscribe(_by_text(callback))
        try:
            with interrupts.watching(engine):
                interrupts.check()
                _run(engine, plan, interrupts, decide)
        except FailedStatus as failed:
            raise failed.__cause__ or failed from None  # what the device said
        finally:
            _end_loop(engine)
    finally:
        log.propagate, log.handlers = propagate, handlers


def _run(engine: RunEngine, plan: Iterable[Msg], interrupts: Interrupts, decide: Callable[[Interrupts], bool]) -> None:
    def step() -> Any:
        return engine(plan)

    while True:
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                step()
            return
        except RunEngineInterrupted:
            pass
        if not interrupts.pausing.is_set():  # the plan itself paused
            interrupts.pausing.set()
        if interrupts.aborting.is_set() or not decide(interrupts):
            with contextlib.redirect_stdout(io.StringIO()):
                engine.abort()
            raise Interrupted(interrupts.reason or "aborted")
        interrupts.go_on()
        step = engine.resume


def _by_text(callback: Callable[[str, dict[str, Any]], Any]) -> Callable[[Any, dict[str, Any]], None]:
    def call(name: Any, doc: dict[str, Any]) -> None:
        callback(getattr(name, "name", str(name)), doc)

    return call


def _end_loop(engine: RunEngine) -> None:
    """Stop the engine's loop and its thread, so that nothing outlives the sweep."""
    engine.loop.call_soon_threadsafe(engine.loop.stop)
    engine._th.join()
    engine.loop.close()
