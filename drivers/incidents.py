"""What a link did about trouble that nobody else would see, because the answer came in the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from drivers.errors import DeviceError

What = Literal["repeated", "resynchronised", "stale bytes dropped", "foreign line passed over", "motion followed", "motion sent again"]
"""Named for what was done: a request sent once more; a device asked something unmistakable, or left alone, until nothing was owed any more;
bytes dropped that came before the question; a line dropped that came while an answer was waited for and that no request claimed; a motion
whose start was in doubt followed to its end, or, the axis resting where it was, sent once more."""

WHATS: tuple[What, ...] = get_args(What)

_SHOWN_BYTES = 32
_SHOWN_TEXT = 200


@dataclass(frozen=True)
class Incident:
    """One thing done about trouble on the line.

    Attributes
    ----------
    time_s : float, s
        When, since the epoch.
    port : str
        URL of the port.
    device : str
        Who was being asked.
    attempt : str
        What was being attempted.
    what : str
        One of `WHATS`.
    detail : str
        Why, or the bytes in hex; shortened.
    """

    time_s: float
    port: str
    device: str
    attempt: str
    what: What
    detail: str

    def __str__(self) -> str:
        where = " on ".join(part for part in (self.device, self.port) if part)
        return f"{': '.join(part for part in (where, self.attempt, self.what) if part)} ({self.detail})"


Report = Callable[[Incident], None]


def story(error: DeviceError) -> str:
    """Why something was done: the error's name and text and what came instead, shortened."""
    text = f"{type(error).__name__}: {error.problem}"
    shortened = text if len(text) <= _SHOWN_TEXT else f"{text[:_SHOWN_TEXT]}..."
    return f"{shortened}, got {in_hex(error.raw)}" if error.raw else shortened


def in_hex(data: bytes) -> str:
    """Bytes in hex, the first of many."""
    return data[:_SHOWN_BYTES].hex(" ") + (f" ... {len(data)} bytes" if len(data) > _SHOWN_BYTES else "")
