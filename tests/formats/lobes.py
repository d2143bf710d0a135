"""A reflectance in three channels to write and read."""

from typing import Any

import numpy as np


def lobes(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    """Reciprocal, and unlike in every channel: diffuse, towards the mirror, back to the light."""
    i, r, p = (np.radians(a) for a in np.broadcast_arrays(theta_i, theta_r, phi))
    across = np.sin(i) * np.sin(r) * np.cos(p)
    mirror, back = np.cos(i) * np.cos(r) - across, np.cos(i) * np.cos(r) + across
    return np.stack([np.full(i.shape, 0.3 / np.pi), 0.1 + 0.2 * np.maximum(mirror, 0) ** 20, 0.1 + 0.3 * np.maximum(back, 0) ** 10], -1)
