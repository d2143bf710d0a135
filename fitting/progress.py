"""How far a long computation has come."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float], None]
"""Called with the share done, 0 to 1, by the thread that asked for the computation."""


def silent(share: float) -> None:
    """Tell nobody."""


def stage(progress: Progress, begin: float, end: float) -> Progress:
    """Progress of one stage of a computation, as that of the whole.

    Parameters
    ----------
    progress : callable
        Of the whole.
    begin, end : float
        Shares of the whole at which the stage begins and ends.
    """
    return lambda share: progress(begin + share * (end - begin))
