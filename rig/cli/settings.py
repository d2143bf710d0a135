"""What the global options say, for every command."""

from dataclasses import dataclass

from rig.workspace import Workspace


@dataclass(frozen=True)
class Settings:
    """The global options."""

    workspace: Workspace
    config: str | None
    debug: bool
