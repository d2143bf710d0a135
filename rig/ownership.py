"""One program at a time moves a bench."""

import fcntl
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rig.errors import RunError

LOOK_S = 0.02


@dataclass(frozen=True)
class Owner:
    """The program that has the bench."""

    pid: int
    command: str


@contextmanager
def owned(path: Path) -> Iterator[None]:
    """Have the bench to ourselves; the lock ends with this process at the latest.

    Raises
    ------
    RunError
        Another program has it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = _read(path)
            who = f"process {owner.pid} ({owner.command})" if owner else "another program"
            raise RunError(f"the bench is in use by {who}; wait for it, or `rig stop` ends it with all axes stopped") from None
        file.truncate(0)
        file.write(json.dumps({"pid": os.getpid(), "command": " ".join(["rig", *sys.argv[1:]])}))
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def end_owner(path: Path, timeout_s: float) -> Owner | None:
    """Ask the program that has the bench to stop all axes and end (SIGTERM); return who it was, or None where nobody has it.

    Raises
    ------
    RunError
        It had not ended after `timeout_s`.
    """
    owner = _read(path)
    if owner is None or _free(path):
        return None
    os.kill(owner.pid, signal.SIGTERM)
    deadline = time.monotonic() + timeout_s
    while not _free(path):
        if time.monotonic() > deadline:
            raise RunError(f"process {owner.pid} ({owner.command}) was told to stop and still has the bench after {timeout_s:g} s")
        time.sleep(LOOK_S)
    return owner


def _free(path: Path) -> bool:
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _read(path: Path) -> Owner | None:
    try:
        return Owner(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
