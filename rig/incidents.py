"""What was done about trouble on the wires, beside the run it happened in."""

import contextlib
import json
import threading
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from drivers.incidents import Incident


class IncidentLog:
    """Collects what links and axes did about trouble; safe from any thread.

    Parameters
    ----------
    path : Path, optional
        JSON lines are appended here as they come; no file is made where nothing happens.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self.incidents: list[Incident] = []

    def __call__(self, incident: Incident) -> None:
        """Take note of one."""
        with self._lock:
            self.incidents.append(incident)
            if self._path is not None:
                # A full disk ends the run where its journal is written, not here in the middle of a motion.
                with contextlib.suppress(OSError), self._path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(incident)) + "\n")

    @property
    def summary(self) -> str:
        """How often what was done for which device, in one line; empty where nothing happened."""
        counts = Counter(f"{incident.device or incident.port}: {incident.what}" for incident in self.incidents)
        return ", ".join(f"{what} {count} times" if count > 1 else what for what, count in counts.items())


def read_incidents(path: Path) -> list[Incident]:
    """Return the incidents of a file; a line that a crash cut off ends it."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            found.append(Incident(**json.loads(line)))
        except (ValueError, TypeError):
            break
    return found


def describe(incident: Incident) -> str:
    """One line for people, with the time of day."""
    return f"{time.strftime('%H:%M:%S', time.localtime(incident.time_s))} {incident}"
