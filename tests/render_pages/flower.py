"""A small made-up flower: cupped petals around a stem, each in a scan frame of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
LENGTH, HALF_WIDTH = 24.0, 9.0  # mm


@dataclass(frozen=True)
class Flower:
    """Arrays of the petals and what the editor asks about them."""

    petals: dict[str, tuple[Matrix, NDArray[np.int64], Matrix]]
    bases: dict[str, Matrix]
    T_petal_scan: dict[str, Matrix]

    def pose(self, name: str, stem_angle: float, azimuth: float) -> Matrix:
        """Place a petal: base 4 mm from the stem's axis and 3 mm up, no roll."""
        s, a = np.radians(stem_angle), np.radians(azimuth)
        out, up = np.array([np.cos(a), np.sin(a), 0]), np.array([0, 0, 1])
        y, z = np.sin(s) * out + np.cos(s) * up, np.sin(s) * up - np.cos(s) * out
        T = np.eye(4)
        T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        T[:3, 3] = 4 * out + 3 * up
        return T @ self.T_petal_scan[name]

    def turned(self, name: str, T_flower_scan: Matrix, stem_angle: float, azimuth: float) -> Matrix:
        """Bend a petal about its base and bring it round the stem, wherever it lies."""
        old_stem, old_azimuth = self.angles(name, T_flower_scan)
        placed, bent = (self.pose(name, stem, old_azimuth) for stem in (old_stem, stem_angle))
        # Bending is a motion in the petal's own frame, so on the right; going round is one in the flower's frame, on the left.
        lying = T_flower_scan @ np.linalg.inv(placed) @ bent
        return self.pose(name, stem_angle, azimuth) @ np.linalg.inv(bent) @ lying

    def angles(self, name: str, T_flower_scan: Matrix) -> tuple[float, float]:
        """Measure stem angle and azimuth of a petal that lies somewhere."""
        y = T_flower_scan[:3, :3] @ np.linalg.inv(self.T_petal_scan[name])[:3, 1]
        base = T_flower_scan[:3, :3] @ self.bases[name] + T_flower_scan[:3, 3]
        return float(np.degrees(np.arccos(np.clip(y[2], -1, 1)))), float(np.degrees(np.arctan2(base[1], base[0])))

    def close_neighbours(self, poses: dict[str, Matrix]) -> set[str]:
        """Name the petals whose azimuths come nearer than 30 degrees."""
        azimuth = {name: self.angles(name, T)[1] for name, T in poses.items()}
        apart = {(a, b): abs((azimuth[a] - azimuth[b] + 180) % 360 - 180) for a in poses for b in poses if a < b}
        return {name for pair, degrees in apart.items() if degrees < 30 for name in pair}


def flower(placed: dict[str, tuple[float, float]]) -> Flower:
    """Make petals at the stem angles and azimuths given, in degrees."""
    rng = np.random.default_rng(7)
    v, u = np.meshgrid(np.linspace(0, 1, 21), np.linspace(-1, 1, 17), indexing="ij")
    width = HALF_WIDTH * np.sin(np.pi * (0.08 + 0.86 * v)) ** 0.7
    points = np.stack([u * width, LENGTH * v, 3 * (u * u - 1) * v + 4 * v**2], axis=-1).reshape(-1, 3)
    points[:, 2] -= points[8, 2]
    corner = np.arange(21 * 17).reshape(21, 17)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    petals, bases, frames = {}, {}, {}
    made = Flower(petals, bases, frames)
    for name, (stem_angle, azimuth) in placed.items():
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        T = np.eye(4)
        T[:3, :3] = turn * np.sign(np.linalg.det(turn))
        T[:3, 3] = rng.uniform(-50, 50, 3)
        frames[name] = T
        back = np.linalg.inv(T)
        bases[name] = back[:3, 3]
        petals[name] = (points @ back[:3, :3].T + back[:3, 3], faces, made.pose(name, stem_angle, azimuth))
    return made
