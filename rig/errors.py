"""What can go wrong between the bench, the run and the command line."""


class RigError(Exception):
    """Root of this package's errors; the message is one line a technician can act on."""


class ConfigError(RigError):
    """`rig.toml`, a cultivar or an option is not as it must be; nothing was opened or moved."""


class InterlockError(RigError):
    """A position outside the limits or inside the keep-out was asked for; raised before anything moves."""


class RunError(RigError):
    """A run, fit or note cannot be found, read or written."""


class Interrupted(RigError):
    """The technician (or the system, by SIGTERM) ended the work; the bench is stopped."""
