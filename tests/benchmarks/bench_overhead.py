"""What a sweep costs beyond motion, settling and integration, with the simulated instruments at the speed of time."""

import subprocess
import sys
import tempfile
from pathlib import Path

from rig.config import load_config, parse_config
from rig.kinematics import AxisMap
from rig.runs import Run
from tests.benchmarks.report import verdict
from tests.conftest import rig_environment

SPEED, ACCELERATION, SETTLE, INTEGRATION = 60.0, 600.0, 0.1, 0.1


def trapezoid(distance: float) -> float:
    """Time in s over `distance` deg from rest to rest; from s = a t^2 / 2 and s = v t, not from the drivers."""
    ramp = SPEED / ACCELERATION
    ramps = SPEED * ramp
    return 2 * ramp + (distance - ramps) / SPEED if distance > ramps else 2 * (distance / ACCELERATION) ** 0.5


def main() -> int:
    """Print wall time from the run's start to its stop over what the bench itself needs."""
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "rig.toml"
        simulated = load_config(None).text
        config.write_text(simulated.replace("speed = 10.0", "speed = 1.0"))
        for attempt in range(3):
            out = Path(folder) / f"run-{attempt}"
            subprocess.run(
                [sys.executable, "-m", "rig", "--config", str(config), "sweep", "--cultivar", "RR", "--out", str(out)],
                check=True,
                capture_output=True,
                env=rig_environment(),
            )
            run = Run(out)
            documents = dict(run.documents)
            wall = documents["stop"]["time"] - documents["start"]["time"]
            maps = {name: axis.map for name, axis in parse_config(config.read_text(), "rig.toml").axes.items()}
            needed = ideal(run, maps)
            missed += verdict(
                f"sweep {attempt + 1}: wall over motion, settling and integration",
                wall / needed,
                1.10,
                note=f"{wall:.2f} s over {needed:.2f} s",
            )
    return missed


def ideal(run: Run, maps: dict[str, AxisMap]) -> float:
    """Return the bench seconds that the run's motion (from the home positions on), settling and integration need."""
    source, detector = maps["source"].to_theta(0.0), maps["detector"].to_theta(0.0)
    total = 0.0
    for reading in run.readings:
        moves = [abs(reading.theta_i_setpoint - source), abs(reading.theta_r_setpoint - detector)]
        total += max(map(trapezoid, moves)) + SETTLE + INTEGRATION
        source, detector = reading.theta_i_setpoint, reading.theta_r_setpoint
    return total
