"""Errors of the virtual rose."""

from sim.errors import SimError


class RoseError(SimError):
    """A rose that cannot be grown, scanned or written as asked; says what was asked and what is possible."""
