"""How much a flower shines back towards the light, and how much it glosses: the figure of the paper's Figure 14."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from render.errors import RenderError
from render.raycast import Picture

Single = NDArray[np.float32]

LEAST_PIXELS = 30
"""Fewer pixels than this in a class and its mean says little."""


@dataclass(frozen=True)
class Contrast:
    """Brightness where the petals face the light, over that where they would mirror it.

    Attributes
    ----------
    C : float
        `facing / mirroring`: the larger, the more the petals shine towards the light; to be compared between cultivars, not with 1.
    facing, mirroring : float
        Mean linear radiance of the two classes of pixels.
    facing_pixels, mirroring_pixels : int
        Their numbers; a pixel can be in both where light and view are close.
    """

    C: float
    facing: float
    mirroring: float
    facing_pixels: int
    mirroring_pixels: int


def measure_contrast(picture: Picture, *, facing: float = 15.0, mirroring: float = 10.0) -> Contrast:
    """Compare pixels that face the light with pixels that face halfway between light and viewer.

    Only pixels wholly of the scene and wholly lit count. For a Lambert surface and light at 54.7 deg from the view (the paper's L), C is
    about 1.1.

    Parameters
    ----------
    picture : Picture
        Without colour, or in colours (then their mean counts).
    facing : float, deg
        Largest angle of the normal from the direction of the light.
    mirroring : float, deg
        Largest angle of the normal from the half vector.

    Raises
    ------
    RenderError
        If one of the classes has fewer than `LEAST_PIXELS` pixels or its mean is 0.
    """
    radiance = picture.radiance if picture.radiance.ndim == 2 else picture.radiance.mean(axis=-1)
    whole = (picture.coverage == 1) & (picture.lit == 1)
    half = picture.wi + picture.wo
    means = []
    for what, towards, limit in (("facing the light", picture.wi, facing), ("mirroring it", half, mirroring)):
        chosen = whole & (_angle(picture.normal, towards) <= limit)
        if chosen.sum() < LEAST_PIXELS:
            raise RenderError(
                f"only {chosen.sum()} lit pixels are within {limit:g} deg of {what}, {LEAST_PIXELS} are needed: "
                "picture the flower larger, turn it, or widen the angle"
            )
        means.append((float(radiance[chosen].mean(dtype=float)), int(chosen.sum())))
    (bright, n_bright), (gloss, n_gloss) = means
    if not gloss > 0:
        raise RenderError("the pixels that mirror the light are all black: there is no contrast to speak of")
    return Contrast(bright / gloss, bright, gloss, n_bright, n_gloss)


def _angle(a: Single, b: Single) -> NDArray[np.float64]:
    """Angle between vectors along the last axis, deg."""
    sine = np.linalg.norm(np.cross(a, b).astype(float), axis=-1)
    return np.degrees(np.arctan2(sine, np.sum(a * b, axis=-1, dtype=float)))
