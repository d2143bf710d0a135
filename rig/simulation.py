"""The simulated bench as a process of its own: real protocols over real sockets."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rig.config import ANGLES, SIMULATED_PORT, AxisConfig, BenchConfig
from rig.errors import ConfigError, RigError


@dataclass(frozen=True)
class SimulatedBench:
    """A running simulated bench: where its instruments listen, and what it was started with."""

    urls: Mapping[str, str]
    parameters: Mapping[str, Any]

    def url(self, port: str) -> str:
        """Return the address behind a port such as `sim:stages`; raise ConfigError where there is none."""
        name = _instrument(port)
        if name not in self.urls:
            raise ConfigError(f"port {port!r}: the simulated bench has {', '.join(SIMULATED_PORT + known for known in self.urls)}")
        return self.urls[name]


@contextmanager
def simulated_bench(config: BenchConfig, specimen: str) -> Iterator[SimulatedBench]:
    """Run the simulated bench with `specimen` (a cultivar's abbreviation) mounted; it ends with this context or this process.

    Raises
    ------
    ConfigError
        Where the simulation has no such specimen.
    RigError
        Where it does not start.
    """
    from sim.petals import names  # only the names: the optics stay in the other process

    if specimen not in names():
        raise ConfigError(f"the simulated bench has petals of {', '.join(names())} only; measure {specimen} on a real one (`rig init`)")
    assert config.simulation is not None
    command = [sys.executable, "-m", "sim", "--specimen", specimen, "--speed", repr(config.simulation.speed), "--until-eof", "--no-pty"]
    seed = config.simulation.seed if config.simulation.seed is not None else int.from_bytes(os.urandom(4), "little")
    command += ["--seed", str(seed)]
    command += ["--instruments", ",".join(sorted({_instrument(device.port) for device in config.devices.values()}))]
    for arm in ANGLES:
        command += [f"--{arm}", _carrier(config.axes[arm])]
    # A new session: a Ctrl-C at the terminal is for us, and the instruments must live to be stopped.
    with (
        tempfile.TemporaryFile() as complaints,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=complaints, start_new_session=True, env=_environment()
        ) as process,
    ):
        assert process.stdout is not None
        assert process.stdin is not None
        try:
            line = process.stdout.readline()
            try:
                parameters = json.loads(line)
                urls = {device["name"]: device.get("tcp") or f"folder:{device['folder']}" for device in parameters["devices"]}
            except (ValueError, KeyError, TypeError):
                complaints.seek(0)
                last = complaints.read().decode(errors="replace").strip().splitlines()[-1:]
                raise RigError(f"the simulated bench did not start: {' '.join(last) or repr(line)}") from None
            yield SimulatedBench(urls, {key: parameters[key] for key in parameters if key not in ("devices", "pid")})
        finally:
            process.stdin.close()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()


def _instrument(port: str) -> str:
    return port.removeprefix(SIMULATED_PORT)


def _carrier(axis: AxisConfig) -> str:
    """Say which axis of which simulated instrument carries an arm."""
    number = axis.options.get("address", axis.options.get("axis", 1))
    return f"{_instrument(axis.port)}:{number}"


def _environment() -> dict[str, str]:
    """Return an environment in which the child finds the same packages as we do."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
