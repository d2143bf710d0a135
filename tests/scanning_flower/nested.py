"""Nested test petals: cups around one axis, each a little outside the one before, so that the order and the clearance are known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanning.contact import Sheet
from scanning.placement import Neighbour, PetalPlacement, Placement
from scanning.poses import Array, inverse

GOLDEN = 137.507


@dataclass(frozen=True)
class Nested:
    """Petals in scan frames, the truth, and what a measurer would have written down."""

    sheets: list[Sheet]
    T_flower_scan: Array
    T_scan_petal: Array
    inflection: Array
    placement: Placement


def profile(k: int, s: NDArray[np.float64]) -> tuple[Array, Array, Array]:
    """Radius, height and slope (from the stem) of cup k at arc length s: bent inwards below, out above."""
    length = 16 + 0.7 * k
    angle = np.radians(8 + 1.6 * k + 22 * np.cos(np.pi * np.clip(s / length, 0, 1)) ** 2)
    step = np.diff(s, prepend=0.0)
    return 1.5 + 0.35 * k + np.cumsum(step * np.sin(angle)), 1.0 + np.cumsum(step * np.cos(angle)), angle


def grow(count: int, seed: int, *, angle_sd: float = 3.0, base_sd: float = 1.0, rows: int = 40, columns: int = 40) -> Nested:
    """Grow a flower of `count` petals at the golden angle, and measure it with the given errors (degrees, mm)."""
    rng = np.random.default_rng(seed)
    sheets, poses, frames, inflections, truth = [], [], [], [], []
    for k in range(count):
        azimuth = np.radians((GOLDEN * k + rng.uniform(-8, 8)) % 360)
        length = 16 + 0.7 * k
        s = np.linspace(0, length, rows)
        radius, height, _ = profile(k, s)
        half = np.clip((0.25 + 0.75 * np.sin(np.pi * np.clip(s / length, 0, 1) ** 0.7) ** 0.8) * 0.55 * length / (2 + radius), 0.02, 1.2)
        u = np.linspace(-1, 1, columns)
        phi = azimuth + u[None, :] * half[:, None] * (1 + 0.08 * rng.normal())
        wave = 0.06 * np.sin(5 * phi)
        points = np.stack([(radius[:, None] + wave) * np.cos(phi), (radius[:, None] + wave) * np.sin(phi), height[:, None] + 0 * phi], -1)
        middle = 0.5 * (points[:, columns // 2 - 1] + points[:, columns // 2])
        base, tip = middle[0], middle[-1]
        y = (tip - base) / np.linalg.norm(tip - base)
        tangent = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        x = -(tangent - (tangent @ y) * y)
        x /= np.linalg.norm(x)
        T_flower_petal = np.eye(4)
        T_flower_petal[:3, :3] = np.stack([x, y, np.cross(x, y)], 1)
        T_flower_petal[:3, 3] = base
        turn, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) * 10
        T_scan_petal = np.eye(4)
        T_scan_petal[:3, :3] = turn * np.sign(np.linalg.det(turn))
        T_scan_petal[:3, 3] = shift
        T_flower_scan = T_flower_petal @ inverse(T_scan_petal)
        back = inverse(T_flower_scan)
        vertices = points.reshape(-1, 3) @ back[:3, :3].T + back[:3, 3]
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        # Rows go up, columns counter-clockwise: this winding faces the stem.
        triangles = np.concatenate(
            [np.stack([corner, corner + columns, corner + 1], 1), np.stack([corner + 1, corner + columns, corner + columns + 1], 1)]
        )
        direction = middle[rows // 2 + 1] - middle[rows // 2]
        direction /= np.linalg.norm(direction)
        sheets.append(Sheet(vertices, triangles))
        poses.append(T_flower_scan)
        frames.append(T_scan_petal)
        inflections.append(T_flower_petal[:3, :3].T @ direction)
        truth.append((np.degrees(np.arctan2(base[1], base[0])), np.hypot(*base[:2]), base[2], np.degrees(np.arccos(direction[2]))))
    names = [f"P{k + 1:02d}" for k in range(count)]
    around = list(np.argsort([t[0] % 360 for t in truth]))
    petals = {}
    for k, name in enumerate(names):
        at = around.index(k)
        left, right = (int(around[(at + step) % count]) for step in (1, -1))
        petals[name] = PetalPlacement(
            name=name,
            left=Neighbour(names[left], "inside" if left < k else "outside"),
            right=Neighbour(names[right], "inside" if right < k else "outside"),
            stem_angle=float(truth[k][3] + angle_sd * rng.normal()),
            stem_angle_u=max(angle_sd, 0.1),
            azimuth=float((truth[k][0] + angle_sd * rng.normal()) % 360),
            azimuth_u=max(angle_sd, 0.1),
            base_radius=float(max(0, truth[k][1] + base_sd * rng.normal())),
            base_height=float(truth[k][2] + base_sd * rng.normal()),
            base_u=max(base_sd, 0.05),
        )
    return Nested(sheets, np.array(poses), np.array(frames), np.array(inflections), Placement("nested", petals))
