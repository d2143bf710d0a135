"""From the angles of the optics to the angles of the axes, and back."""

from dataclasses import dataclass


@dataclass(frozen=True)
class AxisMap:
    """How an axis of the goniometer realises an angle of the optics: `axis = sign * theta + offset`, all in degrees.

    Parameters
    ----------
    sign : {1, -1}
        -1 where the stage counts against the convention of theta.
    offset_deg : float
        What the stage reads where theta is 0.
    """

    sign: int
    offset_deg: float

    def to_axis(self, theta_deg: float) -> float:
        """Return the stage's position in degrees for the angle `theta_deg`."""
        return self.sign * theta_deg + self.offset_deg

    def to_theta(self, axis_deg: float) -> float:
        """Return the angle in degrees for the stage's position `axis_deg`."""
        return self.sign * (axis_deg - self.offset_deg)
