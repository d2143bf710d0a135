"""Answers that carry no name, and what to do when one is missing."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from drivers.errors import DeviceError, TransportTimeout, UnexpectedReply
from drivers.incidents import What, story

if TYPE_CHECKING:
    from drivers.link import Link

T = TypeVar("T")


class Doubt:
    """Whether an unclaimed answer may still be on its way from a device that answers in order.

    After a missing or malformed answer the device is asked something whose answer can be told from all others (`resynchronise`, which
    ends by calling `settled`); what comes before that is dropped, so nothing is owed afterwards. Before the first question there is doubt.

    Parameters
    ----------
    link : Link
        What the device hangs on: it is told of every repeat, and of every resynchronisation but the first.

    Attributes
    ----------
    lock : RLock
        Held for whole sequences, but never by a stop.
    """

    def __init__(self, link: Link) -> None:
        self.lock = threading.RLock()
        self._link = link
        self._exists = True
        self._cause: DeviceError | None = None

    def settled(self) -> None:
        """Nothing is owed any more."""
        self._exists, cause, self._cause = False, self._cause, None
        if cause is not None:
            self._tell("resynchronised", cause)

    def _arises(self, cause: DeviceError) -> None:
        self._exists, self._cause = True, cause

    def _tell(self, what: What, cause: DeviceError) -> None:
        self._link.tell(what, story(cause), device=cause.device, attempt=cause.attempt)

    def _settle(self, resynchronise: Callable[[], object]) -> None:
        if self._exists:
            resynchronise()

    def once(self, ask: Callable[[], T], resynchronise: Callable[[], object]) -> T:
        """Ask once: what changes something."""
        with self.lock:
            self._settle(resynchronise)
            try:
                return ask()
            except (TransportTimeout, UnexpectedReply) as error:
                self._arises(error)
                raise

    def twice(self, ask: Callable[[], T], resynchronise: Callable[[], object]) -> T:
        """Ask something that may safely be asked twice, again where the answer was missing or malformed."""
        with self.lock:
            self._settle(resynchronise)
            try:
                return ask()
            except (TransportTimeout, UnexpectedReply) as error:
                self._arises(error)
                self._tell("repeated", error)
            return self.once(ask, resynchronise)

    def urgently(self, ask: Callable[[], T]) -> T:
        """Ask at once, past whoever holds the lock, and again where the answer was missing or malformed: a stop, nothing else."""
        try:
            return ask()
        except (TransportTimeout, UnexpectedReply) as error:
            self._arises(error)
            self._tell("repeated", error)
        return ask()
