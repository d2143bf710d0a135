"""Ctrl-C, SIGTERM and a closed terminal as a bench must obey them: all axes stopped first, everything else afterwards."""

import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from rig.errors import Interrupted
from rig.status import Status, StatusTimeout

RETRY_S = 0.02


class Engine(Protocol):
    """What runs a plan and can be paused: bluesky's RunEngine."""

    state: Any

    def request_pause(self, defer: bool = False) -> Any:
        """Pause at once, or at the next checkpoint."""


PAUSE = frozenset({signal.SIGINT, signal.SIGTSTP})
"""Signals that pause and ask where somebody is at the terminal."""

ABORT = frozenset({signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT})
"""Signals that end the work: a terminal that was closed leaves nobody to watch the arms."""


class Interrupts:
    """Turns signals into: stop all axes at once and pause the engine at the same time, then either ask or abort.

    The work is done on threads of their own, woken by the C-level handler, so that neither a busy main thread, nor the engine's
    loop, nor an axis that does not answer can delay the rest.

    Parameters
    ----------
    halt : callable
        Lets nothing begin any more and puts the stop on every axis's wire; returns what could not be stopped. Safe from any thread.
    release : callable
        Lets things begin again.
    ask : bool
        True at a terminal: the first Ctrl-C pauses and asks. A second one, or SIGTERM, aborts.

    Attributes
    ----------
    halted : threading.Event
        Set once every axis has acknowledged its stop or has failed to.
    unstopped : list
        The failures.
    """

    def __init__(self, halt: Callable[[], list[Any]], release: Callable[[], Any] = lambda: None, *, ask: bool) -> None:
        self.ask = ask
        self.reason = ""
        self.pausing = threading.Event()
        self.aborting = threading.Event()
        self.halted = threading.Event()
        self.unstopped: list[Any] = []
        self._halt_axes = halt
        self._release = release
        self._halting: list[threading.Thread] = []
        self._engine: Engine | None = None
        self._engine_lock = threading.Lock()

    def __enter__(self) -> "Interrupts":
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._old_wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._old_handlers = {number: signal.signal(number, lambda *_: None) for number in PAUSE | ABORT}
        self._thread = threading.Thread(target=self._watch, name="interrupts", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._old_wakeup)
        os.write(self._writer, b"\0")
        self._thread.join()
        self._await_halts()
        self._release()
        os.close(self._reader)
        os.close(self._writer)

    @contextlib.contextmanager
    def watching(self, engine: Engine) -> Iterator[None]:
        """Pause `engine` when a signal comes, as long as this context lasts."""
        self._engine = engine
        try:
            yield
        finally:
            with self._engine_lock:  # a request that is on its way needs the engine's loop to be alive
                self._engine = None

    def go_on(self) -> None:
        """Forget the pause that was asked for, and let things begin again."""
        self._await_halts()  # a stop that is still on its way would end the first motion that begins again
        self._release()
        self.pausing.clear()

    def check(self) -> None:
        """Raise Interrupted where a signal has come."""
        if self.pausing.is_set():
            raise Interrupted(self.reason)

    def wait(self, status: Status, meanwhile: Callable[[], Any] = lambda: None) -> None:
        """Wait until it is done; raise what went wrong, or Interrupted as soon as a signal has come."""
        while not status.done:
            self.check()
            meanwhile()
            with contextlib.suppress(StatusTimeout):
                status.exception(RETRY_S)
        self.check()
        status.wait()

    def _watch(self) -> None:
        while (number := os.read(self._reader, 1)[0]) != 0:
            if number not in PAUSE | ABORT:
                continue
            again = self.pausing.is_set()
            self.reason = f"interrupted by {signal.Signals(number).name}"
            self.halted.clear()
            self.pausing.set()
            if number in ABORT or again or not self.ask:
                self.aborting.set()
            halting = threading.Thread(target=self._halt, name="halt", daemon=True)
            self._halting.append(halting)
            halting.start()
            self._pause_engine()

    def _await_halts(self) -> None:
        while self._halting:
            self._halting.pop().join()

    def _halt(self) -> None:
        self.unstopped = self._halt_axes()
        self.halted.set()

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


def ask_at_terminal(interrupts: Interrupts) -> bool:
    """Ask the technician at the terminal whether to go on; a further signal means no.

    An axis that could not be stopped is named, and then there is no going on.
    """

    def say(text: str) -> None:
        print(text, end="", file=sys.stderr, flush=True)

    if not interrupts.halted.is_set():
        say("\nstopping all axes ...")
        interrupts.halted.wait()
    if interrupts.unstopped:
        say(f"\nNOT EVERY AXIS COULD BE STOPPED, it may still be moving: {'; '.join(map(str, interrupts.unstopped))}\n")
        return False
    say("\npaused, all axes stopped. Go on (g) or abort (a)? ")
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
        say("g to go on, a to abort: ")
    say("\n")
    return False


def at_terminal() -> bool:
    """Tell whether somebody is there to be asked."""
    return sys.stdin.isatty() and sys.stderr.isatty()
