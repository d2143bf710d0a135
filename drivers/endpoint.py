"""One device at the end of a link: its errors bear its name and port, and once it is closed nothing is sent to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from drivers.errors import DeviceError, DeviceFault, PortClosed, UnexpectedReply
from drivers.link import Link

T = TypeVar("T")
Veto = Callable[[], DeviceError | None]
"""Asked when a request's turn comes: what it returns is raised, and nothing is sent."""


class Endpoint:
    """A device's side of the conversation.

    Parameters
    ----------
    link : Link
        Stays the caller's to close.
    name : str
        For messages.

    Attributes
    ----------
    closed : bool
        Set once the device is let go of.
    """

    def __init__(self, link: Link, name: str) -> None:
        self.link = link
        self.name = name
        self.closed = False

    @property
    def url(self) -> str:
        """The port, for messages."""
        return self.link.url

    def require_open(self, attempt: str) -> None:
        """Raise PortClosed if the device was let go of."""
        if self.closed:
            raise PortClosed("the device was closed", device=self.name, port=self.url, attempt=attempt, hint="open it again")

    def exchange(
        self,
        request: bytes,
        accept: Callable[[bytes], T | None],
        attempt: str,
        expected: str,
        *,
        timeout_s: float | None = None,
        repeatable: bool = False,
        urgent: bool = False,
        veto: Veto | None = None,
    ) -> T:
        """Send a request and wait for its answer, see `Link.exchange`."""
        self.require_open(attempt)
        return self.link.exchange(
            request,
            accept,
            attempt=attempt,
            expected=expected,
            device=self.name,
            timeout_s=timeout_s,
            repeatable=repeatable,
            urgent=urgent,
            veto=veto,
        )

    def fault(
        self, problem: str, attempt: str, *, kind: type[DeviceFault] = DeviceFault, expected: str = "", hint: str = ""
    ) -> DeviceFault:
        """Make the error for what the device reports."""
        return kind(problem, device=self.name, port=self.url, attempt=attempt, expected=expected, hint=hint)

    def unexpected(self, problem: str, attempt: str, expected: str, *, raw: bytes = b"", hint: str = "") -> UnexpectedReply:
        """Make the error for an answer that makes no sense."""
        return UnexpectedReply(problem, device=self.name, port=self.url, attempt=attempt, raw=raw, expected=expected, hint=hint)
