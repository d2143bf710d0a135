"""bluesky's RunEngine, made quiet, and made to obey Ctrl-C and SIGTERM as a bench must."""

import contextlib
import io
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from bluesky.run_engine import RunEngine
from bluesky.utils import FailedStatus, Msg, RunEngineInterrupted

from rig.errors import Interrupted

RETRY_S = 0.02


class Interrupts:
    """Turns signals into: stop all axes at once, then pause the engine, then either ask or abort.

    The work is done on a thread of its own, woken by the C-level handler, so that neither a busy main thread nor the engine's
    loop can delay the stop.

    Parameters
    ----------
    stop_axes : callable
        Puts the stop on every axis's wire; safe from any thread.
    ask : bool
        True at a terminal: the first Ctrl-C pauses and asks. A second one, or SIGTERM, aborts.
    """

    def __init__(self, stop_axes: Callable[[], Any], *, ask: bool) -> None:
        self.ask = ask
        self.reason = ""
        self.pausing = threading.Event()
        self.aborting = threading.Event()
        self._stop_axes = stop_axes
        self._engine: RunEngine | None = None
        self._engine_lock = threading.Lock()

    def __enter__(self) -> "Interrupts":
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._old_wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._old_handlers = {number: signal.signal(number, lambda *_: None) for number in (signal.SIGINT, signal.SIGTERM)}
        self._thread = threading.Thread(target=self._watch, name="interrupts", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_wakeup)
        os.write(self._writer, b"\0")
        self._thread.join()
        os.close(self._reader)
        os.close(self._writer)

    @contextlib.contextmanager
    def watching(self, engine: RunEngine) -> Iterator[None]:
        """Pause `engine` when a signal comes, as long as this context lasts."""
        self._engine = engine
        try:
            yield
        finally:
            with self._engine_lock:  # a request that is on its way needs the engine's loop to be alive
                self._engine = None

    def go_on(self) -> None:
        """Forget the pause that was asked for."""
        self.pausing.clear()

    def check(self) -> None:
        """Raise Interrupted where a signal has come."""
        if self.pausing.is_set():
            raise Interrupted(self.reason)

    def _watch(self) -> None:
        while (number := os.read(self._reader, 1)[0]) != 0:
            if number not in (signal.SIGINT, signal.SIGTERM):
                continue
            again = self.pausing.is_set()
            self.reason = f"interrupted by {signal.Signals(number).name}"
            self.pausing.set()
            self._stop_axes()
            if number == signal.SIGTERM or again or not self.ask:
                self.aborting.set()
            self._pause_engine()

    def _pause_engine(self) -> None:
        """Ask until the engine has taken it: a request that comes between two states would be lost."""
        while self.pausing.is_set():
            with self._engine_lock:
                engine = self._engine
                if engine is None or engine.state.is_paused:
                    return
                if engine.state.is_running:
                    with contextlib.suppress(Exception):  # the state may change between the question and the request
                        engine.request_pause(defer=False)
            time.sleep(RETRY_S)


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


def ask_at_terminal(interrupts: Interrupts) -> bool:
    """Ask the technician at the terminal whether to go on; a further signal means no."""
    print("\npaused, all axes stopped. Go on (g) or abort (a)? ", end="", file=sys.stderr, flush=True)
    while not interrupts.aborting.is_set():
        ready, _, _ = select.select([sys.stdin], [], [], 0.1)
        if not ready:
            continue
        answer = sys.stdin.readline()
        word = answer.strip().lower()
        if not answer or word in ("a", "abort"):
            return False
        if word in ("g", "go", "go on"):
            return True
        print("g to go on, a to abort: ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return False


def at_terminal() -> bool:
    """Tell whether somebody is there to be asked."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def _by_text(callback: Callable[[str, dict[str, Any]], Any]) -> Callable[[Any, dict[str, Any]], None]:
    def call(name: Any, doc: dict[str, Any]) -> None:
        callback(getattr(name, "name", str(name)), doc)

    return call


def _end_loop(engine: RunEngine) -> None:
    """Stop the engine's loop and its thread, so that nothing outlives the sweep."""
    engine.loop.call_soon_threadsafe(engine.loop.stop)
    engine._th.join()
    engine.loop.close()
