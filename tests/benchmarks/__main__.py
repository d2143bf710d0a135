"""Run all benchmarks, or those whose names are given: `python -m tests.benchmarks [NAME ...]`."""

import importlib
import os
import pkgutil
import platform
import sys
import time

import tests.benchmarks as here


def main(wanted: list[str]) -> int:
    """Run each benchmark's `main`, which prints its figures and returns how many targets it missed."""
    known = [module.name.removeprefix("bench_") for module in pkgutil.iter_modules(here.__path__) if module.name.startswith("bench_")]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(known)}", file=sys.stderr)
        return 2
    print(f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}")
    missed = 0
    started = time.monotonic()
    for name in wanted or known:
        print(f"\n== {name}", flush=True)
        before = time.monotonic()
        missed += importlib.import_module(f"tests.benchmarks.bench_{name}").main()
        print(f"   ({time.monotonic() - before:.0f} s)", flush=True)
    print(f"\n{missed} of the targets missed; {time.monotonic() - started:.0f} s in all")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
