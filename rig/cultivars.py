"""The cultivars a lab knows: the paper's Table 1, and those it has added."""

import json
import re
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

from rig.errors import ConfigError
from rig.files import write_atomically

TEXTURES = ("strong", "medium", "weak", "none", "unknown")


@dataclass(frozen=True)
class Cultivar:
    """A cultivar: abbreviation, name, colour, and how strongly its peculiar texture shows."""

    abbreviation: str
    name: str
    colour: str
    texture: str

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9-]{0,15}", self.abbreviation):
            raise ConfigError(f"cultivar {self.abbreviation!r}: an abbreviation has 1 to 16 letters, digits or '-', a letter first")
        if self.texture not in TEXTURES:
            raise ConfigError(f"cultivar {self.abbreviation}: texture {self.texture!r} may be {', '.join(TEXTURES)}")


TABLE_1 = (
    Cultivar("BR", "Black Beauty", "black", "strong"),
    Cultivar("RR", "Rote Rose", "red", "medium"),
    Cultivar("PR", "Eliza", "pink", "weak"),
    Cultivar("WR", "Supless", "white", "none"),
)
"""Tachino et al., Table 1."""


def load_cultivars(path: Path) -> dict[str, Cultivar]:
    """Return the built-in cultivars and those of the file `path` (which need not exist), by abbreviation.

    Raises
    ------
    ConfigError
        Where the file is not as `rig cultivars add` writes it.
    """
    known = {cultivar.abbreviation: cultivar for cultivar in TABLE_1}
    if not path.exists():
        return known
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        added = [Cultivar(abbreviation, **fields) for abbreviation, fields in tables.items()]
    except (tomllib.TOMLDecodeError, TypeError) as exc:
        raise ConfigError(f"{path}: {exc}; each cultivar is a table with name, colour and texture") from exc
    return known | {cultivar.abbreviation: cultivar for cultivar in added}


def find_cultivar(known: dict[str, Cultivar], abbreviation: str) -> Cultivar:
    """Return the cultivar; raise ConfigError with the known ones, and how to add one."""
    try:
        return known[abbreviation]
    except KeyError:
        raise ConfigError(
            f"unknown cultivar {abbreviation!r}; known: {', '.join(known)}. "
            f"Add it: rig cultivars add {abbreviation} --name NAME --colour COLOUR --texture {'|'.join(TEXTURES)}"
        ) from None


def add_cultivar(path: Path, cultivar: Cultivar) -> None:
    """Add `cultivar` to the lab's own in `path`; raise ConfigError where the abbreviation is taken."""
    known = load_cultivars(path)
    if cultivar.abbreviation in known:
        raise ConfigError(f"cultivar {cultivar.abbreviation} is known already: {known[cultivar.abbreviation].name}")
    own = [known[a] for a in known if known[a] not in TABLE_1]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, "\n".join(map(_table, [*own, cultivar])))


def _table(cultivar: Cultivar) -> str:
    fields = {key: value for key, value in asdict(cultivar).items() if key != "abbreviation"}
    # A JSON string is a TOML basic string.
    return "\n".join(
        [f"[{cultivar.abbreviation}]", *(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in fields.items()), ""]
    )
