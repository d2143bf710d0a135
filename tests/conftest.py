"""What tests of several rooms share."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# How long an example takes says more about the machine than about the code.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")

ROOT = Path(__file__).parent.parent
SHARED_DATA = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of other people's measurements; the test is skipped where it is not there."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"reference measurements are not here ({SHARED_DATA.name} folder beside the checkout)")
    return SHARED_DATA


@pytest.fixture
def rig(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the `rig` command in an empty folder with a workspace of its own; returns what it printed and its exit code."""

    def run(*arguments: str, check: int | None = 0, timeout: float = 60) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [sys.executable, "-m", "rig", *arguments], cwd=tmp_path, env=rig_environment(), capture_output=True, text=True, timeout=timeout
        )
        if check is not None:
            assert done.returncode == check, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    return run


def rig_environment() -> dict[str, str]:
    """Environment for a `rig` of this checkout, whatever the current folder."""
    environment = {key: value for key, value in os.environ.items() if key != "RIG_HOME"}
    return environment | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
