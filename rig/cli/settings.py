"""What the global options say, for every command."""

from dataclasses import dataclass

import click

from rig.workspace import Workspace

trace_option = click.option("--trace", metavar="FILE", help="Write every byte, both ways, with times; `rig sim replay FILE` plays it back.")


@dataclass(frozen=True)
class Settings:
    """The global options."""

    workspace: Workspace
    config: str | None
    debug: bool
