"""What a person measures before taking the flower apart, with that person's errors."""

from dataclasses import dataclass

import numpy as np

from sim.rose.arrangement import Neighbour, Rose
from sim.rose.errors import RoseError


@dataclass(frozen=True)
class Placed:
    """Measured placement of one petal: angles in degrees, base in mm, `_u` standard uncertainties."""

    petal: str
    left: Neighbour
    right: Neighbour
    stem_angle: float
    stem_angle_u: float
    azimuth: float
    azimuth_u: float
    base_radius: float
    base_height: float
    base_u: float


def measure(rose: Rose, *, seed: int = 0, angle_sd: float = 3.0, base_sd: float = 1.0) -> tuple[Placed, ...]:
    """Measure the placement of every petal.

    Errors are normal, independent, without bias. A base radius is never below 0.1 mm, a stem angle never below 0: such a reading would be
    taken again, and so it is drawn again. Neighbours and sides are taken to be seen without error; roll is not measured.

    Raises
    ------
    RoseError
        If a standard deviation is negative.
    """
    if angle_sd < 0 or base_sd < 0:
        raise RoseError(f"standard deviations of {angle_sd} deg and {base_sd} mm were asked for: expected 0 or more")
    rng = np.random.default_rng([seed, 1])

    def read(value: float, sd: float, least: float) -> float:
        while (reading := value + rng.normal(0, sd)) < least:
            pass
        return float(reading)

    return tuple(
        Placed(
            petal.name,
            petal.left,
            petal.right,
            stem_angle=read(petal.form.stem_angle, angle_sd, 0.0),
            stem_angle_u=angle_sd,
            azimuth=float((petal.form.azimuth + rng.normal(0, angle_sd)) % 360),
            azimuth_u=angle_sd,
            base_radius=read(petal.form.base_radius, base_sd, 0.1),
            base_height=float(petal.form.base_height + rng.normal(0, base_sd)),
            base_u=base_sd,
        )
        for petal in rose.petals
    )


def toml(placement: tuple[Placed, ...], name: str) -> str:
    """Text of `placement.toml`."""
    lines = ["[flower]", f'name = "{name}"']
    for placed in placement:
        lines += ["", f"[petals.{placed.petal}]"]
        for hand, beside in (("left ", placed.left), ("right", placed.right)):
            lines.append(f'{hand} = {{ petal = "{beside.petal}", side = "{beside.side}" }}')
        for key in ("stem_angle", "stem_angle_u", "azimuth", "azimuth_u", "base_radius", "base_height", "base_u"):
            lines.append(f"{key} = {getattr(placed, key):.3f}")
    return "\n".join(lines) + "\n"
