"""Every decoder against random and mutated frames: what it refuses, by which error, what it takes, and how fast."""

import time
from collections import Counter

import numpy as np

from tests.benchmarks.report import verdict
from tests.drivers.fuzzed import Decoder, decoders, mutated, outcome

CASES = 100_000
SEED = 20261123


def main() -> int:
    """Print one line for each decoder; an unnamed error or a value that the frame does not say is a failure."""
    return sum(_line(number, decoder) for number, decoder in enumerate(decoders()))


def _line(number: int, decoder: Decoder) -> int:
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    started = time.perf_counter()
    for data in mutated(decoder, CASES, np.random.default_rng((SEED, number))):
        try:
            outcomes[outcome(decoder, data)] += 1
        except AssertionError as error:
            failures.append(str(error))
    rate = CASES / (time.perf_counter() - started)
    for failure in failures[:3]:
        print(f"   {failure}")
    seen = ", ".join(f"{count} {kind}" for kind, count in outcomes.most_common())
    return verdict(f"{decoder.name}: failures", len(failures), 0, note=f"{seen}; {rate:.0f} cases/s")
