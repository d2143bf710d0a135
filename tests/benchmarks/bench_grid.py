"""A scan of 200 x 200 points cleaned and triangulated: time warm, without file access; beside the same triangulation in plain NumPy."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scanning.clean import clean
from scanning.rangeimage import RangeImage
from scanning.triangulate import triangulate
from tests.benchmarks.report import verdict
from tests.scanning.surfaces import scan

TARGET_MS = 10.0
REPEATS = 100


def numpy_triangles(image: RangeImage, jump: float) -> NDArray[np.intp]:
    """The triangles of the grid by array operations: the shorter diagonal, three corners make one triangle. No manifold is made of them."""
    height, width = image.shape
    number = np.arange(height * width).reshape(height, width)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    points, valid = image.points.reshape(-1, 3), image.valid.ravel()
    ok = valid[corners]
    chosen = []
    four = corners[ok.all(axis=1)]
    first = np.linalg.norm(points[four[:, 0]] - points[four[:, 2]], axis=1)
    second = np.linalg.norm(points[four[:, 1]] - points[four[:, 3]], axis=1)
    along = first <= second
    chosen += [four[along][:, [0, 1, 2]], four[along][:, [0, 2, 3]], four[~along][:, [1, 2, 3]], four[~along][:, [1, 3, 0]]]
    three = ok.sum(axis=1) == 3
    for missing in range(4):
        chosen.append(corners[three & ~ok[:, missing]][:, [(missing + k) % 4 for k in (1, 2, 3)]])
    triangles = np.concatenate(chosen)
    return triangles[np.ptp(points[triangles][..., 2], axis=1) <= jump]


def warm(task: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Shortest time of a call after the first, ms: other work on the machine only adds to it."""
    task()
    times = []
    for _ in range(REPEATS):
        start = clock()
        task()
        times.append(clock() - start)
    return 1e3 * min(times)


def fresh(image: RangeImage) -> RangeImage:
    """The same scan with nothing remembered."""
    return RangeImage(image.points, image.valid)


def main() -> int:
    """Print the figures; count the targets missed."""

    def bowl(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.015 * x**2 - 0.008 * y**2

    def oval(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        return (x / 20) ** 2 + (y / 23) ** 2 < 1

    missed = 0
    for what, image in (
        ("petal, noise 0.08 mm, depth in steps of 0.3 mm", scan(bowl, oval, noise=0.08, quantum=0.3)),
        ("full grid, noise 0.08 mm", scan(bowl, noise=0.08)),
        ("full grid, noise 0.08 mm, depth in steps of 0.3 mm", scan(bowl, noise=0.08, quantum=0.3)),
    ):
        cleaned = clean(image)
        mesh = triangulate(cleaned.image, cleaned.jump)
        before, after = (
            float(np.sqrt(np.mean((i.points[..., 2] - bowl(i.points[..., 0], i.points[..., 1]))[i.valid] ** 2)))
            for i in (image, cleaned.image)
        )
        cleaning = warm(lambda image=image: clean(fresh(image)))  # type: ignore[misc]
        joining = warm(lambda c=cleaned: triangulate(c.image, c.jump))  # type: ignore[misc]
        plain = warm(lambda c=cleaned: numpy_triangles(c.image, c.jump))  # type: ignore[misc]
        print(f"   {what}: {image.valid.sum()} points, {len(mesh.triangles)} triangles; error of depth {before:.3f} to {after:.3f} mm")
        print(
            f"   cleaned in {cleaning:.1f} ms, triangulated in {joining:.1f} ms; NumPy, without the manifold, in {plain:.1f} ms,"
            f" {plain / joining:.0f} times as long"
        )
        missed += verdict("cleaned and triangulated", cleaning + joining, TARGET_MS, " ms")
    return missed


if __name__ == "__main__":
    raise SystemExit(main())
