"""What can go wrong between us and an instrument, each named for what happened."""

from __future__ import annotations

_SHOWN_BYTES = 64


class DeviceError(Exception):
    """Root of every error of this package. Raise one of its children.

    Parameters
    ----------
    problem : str
        What happened, in a few words.
    device : str
        Name of the device, as the user calls it.
    port : str
        URL of the port it hangs on.
    attempt : str
        What was being attempted, e.g. ``"reading the position"``.
    sent : bytes
        The request, as it went over the wire.
    raw : bytes
        What came back, shown in hex; empty when nothing came.
    expected : str
        What should have come back.
    elapsed_s : float, optional
        Seconds from the request to the failure.
    hint : str
        What the user can do about it.
    """

    def __init__(
        self,
        problem: str,
        *,
        device: str = "",
        port: str = "",
        attempt: str = "",
        sent: bytes = b"",
        raw: bytes = b"",
        expected: str = "",
        elapsed_s: float | None = None,
        hint: str = "",
    ) -> None:
        super().__init__(problem)
        self.problem = problem
        self.device = device
        self.port = port
        self.attempt = attempt
        self.sent = sent
        self.raw = raw
        self.expected = expected
        self.elapsed_s = elapsed_s
        self.hint = hint

    def complete(
        self, *, device: str = "", port: str = "", attempt: str = "", sent: bytes = b"", expected: str = "", elapsed_s: float | None = None
    ) -> None:
        """Fill in what the place that raised could not know; what is already said stays."""
        self.device = self.device or device
        self.port = self.port or port
        self.attempt = self.attempt or attempt
        self.sent = self.sent or sent
        self.expected = self.expected or expected
        if self.elapsed_s is None:
            self.elapsed_s = elapsed_s

    def __str__(self) -> str:
        where = " on ".join(part for part in (self.device, self.port) if part)
        story = ": ".join(part for part in (where, self.attempt, self.problem) if part)
        details = []
        if self.sent:
            details.append(f"sent {_text(self.sent)}")
        if self.raw:
            details.append(f"got {_hex(self.raw)}")
        if self.expected:
            details.append(f"expected {self.expected}")
        if self.elapsed_s is not None:
            details.append(f"after {self.elapsed_s:.3f} s")
        if details:
            story += f" ({', '.join(details)})"
        return f"{story}; {self.hint}" if self.hint else story


class TransportTimeout(DeviceError):
    """Nobody answers: the port is absent or busy, or no complete reply came in time. For a wrong reply, see `UnexpectedReply`."""


class PortClosed(DeviceError):
    """A port that was open is gone: unplugged, hung up at the other end, or closed by us."""


class BadChecksum(DeviceError):
    """A reply came whose checksum is wrong or missing: the line is noisy, nothing in it can be trusted."""


class UnexpectedReply(DeviceError):
    """A reply came that the protocol does not allow here."""


class DeviceFault(DeviceError):
    """The instrument understood and says no, or reports a fault of its own."""


class NotHomed(DeviceFault):
    """The axis has no reference position: it must be homed before it can be sent to an angle."""


class MoveTimeout(DeviceError):
    """The axis was still moving long after it should have arrived; it has been told to stop."""


class InvalidSetting(DeviceError):
    """A value that the driver or the instrument cannot take; nothing was sent."""


class CatalogueError(DeviceError):
    """An added model cannot be used: its entry point is broken, or its name is taken."""


class UnknownModel(CatalogueError):
    """No model of that name is in the catalogue."""


def _text(data: bytes) -> str:
    shown = data[:_SHOWN_BYTES].decode("ascii", "backslashreplace")
    return repr(shown) + ("..." if len(data) > _SHOWN_BYTES else "")


def _hex(data: bytes) -> str:
    return data[:_SHOWN_BYTES].hex(" ") + (f" ... {len(data)} bytes" if len(data) > _SHOWN_BYTES else "")
