"""Virtual petals: reflectance from a photon tracer through petals built cell by cell.

They are an independent truth for whatever is fitted to measurements.

`load(name)` gives the table of one of the four cultivars; it needs NumPy only. `python -m sim.petals` traces the tables anew.
"""

from importlib.resources import as_file, files

from sim.petals.errors import PetalError
from sim.petals.structure import CULTIVARS, Petal
from sim.petals.table import PetalTable, read_table

__all__ = ["Petal", "PetalError", "PetalTable", "load", "names"]


def names() -> tuple[str, ...]:
    """Cultivars, from the strongest texture to none: black, red, pink, white."""
    return tuple(CULTIVARS)


def load(name: str) -> PetalTable:
    """Table of a cultivar, as shipped.

    Raises
    ------
    PetalError
        If there is no such cultivar, or its table file is missing or damaged.
    """
    if name not in CULTIVARS:
        raise PetalError(f"no virtual petal {name!r}: expected one of {', '.join(names())}")
    with as_file(files("sim") / "data" / f"petal_{name}.json") as path:
        return read_table(path)
