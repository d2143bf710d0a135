"""Errors of the simulators."""


class SimError(Exception):
    """Root of every error raised by this package."""


class SpecimenError(SimError):
    """A specimen that cannot be made, or that was asked for an angle it does not know."""
