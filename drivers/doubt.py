"""Answers that carry no name, and what to do when one is missing."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from drivers.errors import TransportTimeout, UnexpectedReply

T = TypeVar("T")


class Doubt:
    """Whether an unclaimed answer may still be on its way from a device that answers in order.

    After a missing or malformed answer the device is asked something whose answer can be told from all others (`resynchronise`, which
    ends by calling `settled`); what comes before that is dropped, so nothing is owed afterwards. Before the first question there is doubt.

    Attributes
    ----------
    lock : RLock
        Held for whole sequences, but never by a stop.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._exists = True

    def arises(self) -> None:
        """An answer is missing or was malformed."""
        self._exists = True

    def settled(self) -> None:
        """Nothing is owed any more."""
        self._exists = False

    def _settle(self, resynchronise: Callable[[], object]) -> None:
        if self._exists:
            resynchronise()

    def once(self, ask: Callable[[], T], resynchronise: Callable[[], object]) -> T:
        """Ask once: what changes something."""
        with self.lock:
            self._settle(resynchronise)
            try:
                return ask()
            except (TransportTimeout, UnexpectedReply):
                self.arises()
                raise

    def twice(self, ask: Callable[[], T], resynchronise: Callable[[], object]) -> T:
        """Ask something that may safely be asked twice, again where the answer was missing or malformed."""
        with self.lock:
            self._settle(resynchronise)
            try:
                return ask()
            except (TransportTimeout, UnexpectedReply):
                self.arises()
            return self.once(ask, resynchronise)
