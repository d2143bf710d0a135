"""How long files of reflectance take: a MERL file read, written and made of or into others, beside numpy moving the same bytes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fitting.formats.files import read_any, write_any
from fitting.formats.merl import HEADER
from tests.benchmarks.report import verdict
from tests.formats.lobes import lobes

TARGET = 2.0
TIMES = 3


def quickest(task: Callable[[], object]) -> float:
    """Least of a few times, s."""
    times = []
    for _ in range(TIMES):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> int:
    """Print the figures; return how many targets were missed."""
    missed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        merl, rgl = folder / "lobes.binary", folder / "lobes.bsdf"
        write_any(merl, lobes)
        write_any(rgl, lobes)
        table = read_any(merl)
        numbers = np.fromfile(merl, "<f8", offset=HEADER)
        plain_read = quickest(lambda: np.fromfile(merl, "<f8", offset=HEADER).copy())
        plain_write = quickest(lambda: numbers.tofile(folder / "plain"))
        print(f"   {merl.stat().st_size / 1e6:.0f} MB by np.fromfile and a copy: {plain_read:.3f} s; by tofile: {plain_write:.3f} s")
        there_and_back = plain_read + plain_write
        for what, task, plain in (
            ("MERL read", lambda: read_any(merl), plain_read),
            ("MERL written", lambda: write_any(folder / "a.binary", table), plain_write),
            ("MERL of a function", lambda: write_any(folder / "b.binary", lobes), plain_write),
            ("MERL into RGL", lambda: write_any(folder / "a.bsdf", read_any(merl)), there_and_back),
            ("RGL into MERL", lambda: write_any(folder / "c.binary", read_any(rgl)), there_and_back),
            ("MERL into CSV", lambda: write_any(folder / "a.csv", read_any(merl)), there_and_back),
        ):
            seconds = quickest(task)
            missed += verdict(what, seconds, TARGET, " s", note=f"{seconds / plain:.0f} times as long as numpy alone")
        for what, task in (
            ("MERL into Klems' XML", lambda: write_any(folder / "a.xml", read_any(merl), channel="G")),
            ("RGL read", lambda: read_any(rgl)),
        ):
            print(f"   {what}: {quickest(task):.2f} s")
    return missed


if __name__ == "__main__":
    raise SystemExit(main())
