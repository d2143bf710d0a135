"""The folder in which runs, fits and flowers live."""

import os
from dataclasses import dataclass
from pathlib import Path

from rig.errors import RunError


@dataclass(frozen=True)
class Workspace:
    """Where things lie: `runs/`, `fits/`, `figures/`, `flowers/`, `models/` and `cultivars.toml` under one root."""

    root: Path

    @classmethod
    def locate(cls, option: str | None) -> "Workspace":
        """Return the workspace of `--workspace`, else of RIG_HOME, else `./rig-data`."""
        return cls(Path(option or os.environ.get("RIG_HOME") or "rig-data"))

    @property
    def runs(self) -> Path:
        """Folder of the runs, one folder each."""
        return self.root / "runs"

    @property
    def fits(self) -> Path:
        """Folder of the fits, one JSON file each."""
        return self.root / "fits"

    @property
    def figures(self) -> Path:
        """Folder of the figures."""
        return self.root / "figures"

    @property
    def flowers(self) -> Path:
        """Folder of the flowers, one folder each."""
        return self.root / "flowers"

    @property
    def models(self) -> Path:
        """Folder of the reflection models that were built, one .npz file each; they can be built again."""
        return self.root / "models"

    @property
    def axes(self) -> Path:
        """What each axis was last told."""
        return self.root / "axes.json"

    @property
    def cultivars(self) -> Path:
        """The lab's own cultivars."""
        return self.root / "cultivars.toml"


def pick(folder: Path, names: list[str], wanted: str, what: str) -> str:
    """Return the one of `names` (oldest first) that `wanted` means: itself, a unique prefix or suffix part, or `latest`.

    Raises
    ------
    RunError
        Where there is none, or more than one.
    """
    if not names:
        raise RunError(f"there are no {what}s in {folder}")
    if wanted == "latest":
        return names[-1]
    if wanted in names:
        return wanted
    found = [name for name in names if name.startswith(wanted) or name.rsplit("_", 1)[-1].startswith(wanted)]
    if len(found) == 1:
        return found[0]
    if found:
        raise RunError(f"{what} {wanted!r} may be any of {', '.join(found[:5])}{' ...' if len(found) > 5 else ''}; give more of the name")
    raise RunError(f"no {what} {wanted!r} in {folder}; the newest is {names[-1]}")
