"""A lab for tests: instruments that are served already, a rig.toml for them, and `rig` without a process of its own."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from rig.cli.main import main
from rig.config import BenchConfig, parse_config
from sim.serve import Running, Settings, in_background

SPEED = 40.0

MIXED = """\
[bench]
name = "mixed"

[simulation]
speed = {speed}
served = true

[axes.source]
model = "newport-esp301"
port = "{newport}"
axis = 1
offset = 90.0
limits = [0.0, 80.0]
speed = 60.0
acceleration = 600.0

[axes.detector]
model = "zaber-x-rsw60a"
port = "{stages}"
address = 2
offset = 100.0
limits = [-85.0, 85.0]
speed = 60.0
acceleration = 600.0

[axes.x]
model = "zaber-x-lsm"
port = "{linear}"
address = 1
microsteps_per_mm = 20997.375328083987
limits = [0.0, 150.0]

[sensor]
model = "keithley-6485"
port = "{meter}"
integration = 0.1
terminator = "LF"

[sensors.lamp]
model = "apogee-sq-422x"
port = "{apogee}"
monitor = true

[sensors.plate]
model = "baumer-om20"
port = "{om20}"

[keep_out]
within = 3.0
crossing = true
"""
"""A bench of several makers: the source forgets that it was homed, and `x` carries the plate that `plate` looks at."""

INSTRUMENTS = ("newport", "stages", "linear", "meter", "apogee", "om20")


@dataclass(frozen=True)
class Outcome:
    """How a command ended and what it said."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """What it said, for programs."""
        return json.loads(self.out)


@dataclass(frozen=True)
class Lab:
    """A folder to work in, and what is in it.

    Attributes
    ----------
    folder : Path
        The current folder of the commands.
    urls : dict
        Where each instrument is.
    """

    folder: Path
    urls: dict[str, str] = field(default_factory=dict)

    def rig(self, *arguments: str, code: int | None = 0) -> Outcome:
        """Run a command; `code` is how it must end."""
        out, err = io.StringIO(), io.StringIO()
        ended = 0
        without = {key: value for key, value in os.environ.items() if key != "RIG_HOME"}
        with (
            chdir(self.folder),
            redirect_stdout(out),
            redirect_stderr(err),
            patch.dict(os.environ, without, clear=True),
            patch("serial.urlhandler.protocol_socket.time"),  # after closing a socket pyserial sleeps for 0.3 s, lest it be opened at once
        ):
            try:
                main(list(arguments))
            except SystemExit as end:
                ended = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        outcome = Outcome(ended, out.getvalue(), err.getvalue())
        assert code is None or ended == code, outcome
        return outcome

    def configure(self, text: str = MIXED, **changes: str) -> BenchConfig:
        """Write rig.toml, with the instruments' places and the `changes` put in."""
        text = text.format(speed=SPEED, **(self.urls | changes))
        (self.folder / "rig.toml").write_text(text, encoding="utf-8")
        return parse_config(text, "rig.toml")


@contextmanager
def serving(*instruments: str, seed: int = 7, source: str | None = None, detector: str | None = None) -> Iterator[Running]:
    """Serve instruments in a thread beside, forty times faster than time."""
    settings = Settings(
        specimen="lambert:0.5", seed=seed, speed=SPEED, pty=False, instruments=instruments, source=source, detector=detector
    )
    with in_background(settings) as running:
        yield running


def places(running: Running) -> dict[str, str]:
    """Where each instrument is."""
    return {device["name"]: device["tcp"] for device in running.report["devices"]}
