"""How fast a flower of 25 petals is pictured, and how good the table of directions and the pictures are.

Run as `python -m tests.benchmarks render`.
"""

from __future__ import annotations

import math
import time

import numpy as np

from fitting.cells import Cell
from fitting.table import paper_table
from render import Camera, DistantLight, Lambert, Mesh, Raycaster, Scene
from tests.benchmarks.report import verdict

PETALS, ROWS, COLUMNS = 25, 80, 80  # 12 482 triangles a petal
X = {"u_diff": 0.3, "u_spec": 0.5, "s_diff": 0.2, "s_spec": 0.1}


def petal(number: int) -> Mesh:
    """A cupped sheet about the z axis, further out and lower the higher its number."""
    across, along = np.meshgrid(np.linspace(-1, 1, COLUMNS), np.linspace(0, 1, ROWS))
    azimuth = number * math.radians(137.5) + across * np.sqrt(np.clip(4 * along * (1.05 - along), 0, 1))
    radius = (2 + 0.6 * number) * (0.4 + 0.9 * along) + 1.2 * number * np.clip(along - 0.7, 0, 1) ** 2
    vertices = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), (30 - 0.3 * number) * along], axis=-1).reshape(-1, 3)
    index = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return Mesh(f"P{number:02d}", vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


def lambert_error() -> float:
    """Relative error of a sphere's mean radiance against the phase function, percent; worst of four phases."""
    rows = 300
    t, p = np.meshgrid(np.linspace(1e-6, math.pi - 1e-6, rows + 1), np.linspace(0, 2 * math.pi, 2 * rows + 1), indexing="ij")
    vertices = 10 * np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    index = np.arange(t.size).reshape(t.shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    ball = Raycaster(Scene((Mesh("sphere", vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])),)))
    camera = Camera.look_at((0, -30000, 0), (0, 0, 0), fov=math.degrees(2 * math.atan(11 / 30000)), width=400, height=400)
    worst = 0.0
    for phase in np.radians([0, 40, 90, 130]):
        picture = ball.picture(camera, Lambert(), light=DistantLight((math.sin(phase), 0, math.cos(phase))))
        mean = picture.radiance.sum(dtype=float) / picture.coverage.sum(dtype=float)
        exact = 2 / (3 * math.pi**2) * (math.sin(phase) + (math.pi - phase) * math.cos(phase))
        worst = max(worst, abs(mean / exact - 1))
    return 100 * float(worst)


def main() -> int:
    """Print the figures; return how many targets are missed."""
    missed = 0
    paper_table(Cell(1.2))  # compiles
    for aspect in (0.5, 1.9):
        started = time.perf_counter()
        table = paper_table(Cell(aspect))
        missed += verdict(f"table of all directions, aspect {aspect:g}", time.perf_counter() - started, 10, " s")
        for name, error in table.in_plane_error().items():
            if name.startswith("u"):
                missed += verdict(f"   {name} in plane, rms of its largest value", 100 * error, 1, " %")
    scene = Scene(tuple(petal(number) for number in range(PETALS)))
    started = time.perf_counter()
    caster = Raycaster(scene)
    print(f"   loading {len(scene.triangles)} triangles: {time.perf_counter() - started:.2f} s")
    camera = Camera.framing(scene.vertices, (1, -1, 1.2), width=800, height=800)
    shading = table.mixed(X)
    caster.picture(camera, shading)
    times = []
    for _ in range(3):
        started = time.perf_counter()
        caster.picture(camera, shading, samples=4)
        times.append(time.perf_counter() - started)
    missed += verdict("800 x 800, 4 samples a pixel, shadows, warm", float(np.median(times)), 4, " s")
    missed += verdict("Lambert sphere against its phase function", lambert_error(), 0.5, " %")
    return missed


if __name__ == "__main__":
    raise SystemExit(main())
