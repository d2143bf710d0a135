"""`python -m sim.rose`: write a virtual rose, taken apart and scanned."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sim.rose import RoseError, write_specimen


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the command line, write the specimen; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim.rose", description="Grow a virtual rose, take it apart and scan its petals.")
    parser.add_argument("--petals", type=int, default=25, help="5 to 45 (default 25)")
    parser.add_argument("--opening", type=float, default=0.5, help="0 a bud, 1 open (default 0.5)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--triangles", type=int, default=12_500, help="of each true mesh (default 12500)")
    parser.add_argument("--no-meshes", action="store_true", help="do not write the true meshes")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write into")
    asked = parser.parse_args(arguments)
    try:
        rose = write_specimen(asked.out, asked.petals, asked.opening, asked.seed, triangles=asked.triangles, meshes=not asked.no_meshes)
    except (RoseError, OSError) as error:
        print(f"python -m sim.rose: {error}", file=sys.stderr)
        return 1
    print(f"{len(rose.petals)} petals in {asked.out}: range images, placement.toml, truth.json{'' if asked.no_meshes else ', true meshes'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
