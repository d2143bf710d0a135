"""`python -m sim.petals`: trace the shipped tables anew."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import sim
from sim.petals import names
from sim.petals.build import PHOTONS, SEED, THETA_I, build
from sim.petals.errors import PetalError
from sim.petals.table import write_table


class Progress:
    """One line on stderr: what is done and how long the rest will take, reckoned from the photons traced so far."""

    def __init__(self, photons: dict[str, int]) -> None:
        self._photons = photons
        self._total = sum(photons.values()) * len(THETA_I)
        self._done = 0
        self._start = time.monotonic()

    def __call__(self, name: str, theta_i: float) -> None:
        self._done += self._photons[name]
        left = (time.monotonic() - self._start) * (self._total / self._done - 1)
        end = "\r" if sys.stderr.isatty() else "\n"
        print(
            f"{name} theta_i {theta_i:2.0f} deg   {100 * self._done / self._total:3.0f} %   about {left / 60:.1f} min left ",
            end=end,
            file=sys.stderr,
            flush=True,
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m sim.petals", description="Trace the tables of the virtual petals. Same options, same tables."
    )
    parser.add_argument("--cultivar", action="append", choices=names(), help="only this one (may be repeated); default: all")
    parser.add_argument("--photons", type=int, help="per angle of incidence; default: " + ", ".join(f"{n} {p}" for n, p in PHOTONS.items()))
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, default=Path(sim.__path__[0]) / "data", help="folder; default: the tables that sim ships")
    options = parser.parse_args(arguments)
    photons = {name: options.photons or PHOTONS[name] for name in options.cultivar or names()}
    progress = Progress(photons)
    try:
        for name in photons:
            table = build(name, photons[name], options.seed, lambda theta_i, name=name: progress(name, theta_i))  # type: ignore[misc]
            path = options.out / f"petal_{name}.json"
            write_table(table, path)
            print(path)
    except (PetalError, OSError) as error:
        print(f"sim.petals: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
