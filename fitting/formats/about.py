"""What is in a file of reflectance: its axes, its extremes, how much light it sends back."""

from __future__ import annotations

from typing import Any

import numpy as np

from fitting.errors import DomainError
from fitting.formats.files import Data, listed_of
from fitting.formats.grid import AXES, Array, Brdf, Function, Scattered, channel_names, readings
from fitting.formats.hemisphere import Whole, albedo, gridded, holes
from fitting.formats.merl import BINS, Merl
from fitting.formats.rgl import Rgl

INCIDENCES = (0.0, 30.0, 45.0, 60.0, 75.0)
"""Where the albedo is given, deg."""


def about(data: Data | Function) -> dict[str, Any]:
    """Describe what `read_any` gave, or a function.

    Parameters
    ----------
    data : Brdf, Scattered, Merl, Rgl, or callable

    Returns
    -------
    dict
        "size": what is counted, such as {"readings": 120}; "channels"; "quantity"; "axes": for each angle its first and last value, deg,
        and how many there are; "uncertainties"; "least", "largest" and "largest_at" (theta_i, theta_r and phi), 1/sr; "negative" and
        "invalid": how many values are below 0, or should be there and are not; "albedo": for each of `INCIDENCES` that it covers the share
        of light sent up to "to_theta_r", deg, for each channel; or else "no_albedo", why not. The extremes of a MERL, an RGL file or a
        function are those of a few thousand directions.
    """
    listed = _listed(data)
    size: dict[str, int] = {"readings": len(listed)}
    negative, invalid = int(np.count_nonzero(listed.values < 0)), 0
    axes = _axes(listed)
    if isinstance(data, Merl):
        size, invalid = {"bins": int(np.prod(BINS)), "bins with a value": int(data.valid.sum())}, holes(data)
        axes = {
            "theta_half": {"first": 0.0, "last": 90.0, "count": BINS[0]},
            "theta_diff": {"first": 0.0, "last": 90.0, "count": BINS[1]},
            "phi_diff": {"first": 0.0, "last": 180.0, "count": BINS[2]},
        }
    elif isinstance(data, Rgl):
        size = {"pictures": int(np.prod(data.values.shape[:2])), "points along a side": data.values.shape[-1]}
        negative = int(np.count_nonzero(data.values < 0))
        axes = {"theta_i": _axis(data.theta_i_deg), "phi_i": _axis(data.phi_i_deg)}
    elif not isinstance(data, Scattered | Brdf):
        size, axes = {}, {}
    top = int(np.argmax(listed.values.max(axis=1)))
    at = listed.theta_i_deg[top], listed.theta_r_deg[top], (listed.phi_r_deg - listed.phi_i_deg)[top] % 360
    return {
        "size": size,
        "channels": list(listed.channels),
        "quantity": listed.quantity,
        "axes": axes,
        "uncertainties": listed.sigma is not None,
        "least": float(listed.values.min()),
        "largest": float(listed.values.max()),
        "largest_at": [float(angle) for angle in at],
        "negative": negative,
        "invalid": invalid,
        **_albedos(data),
    }


def _listed(data: Data | Function) -> Scattered:
    if isinstance(data, Merl | Rgl):
        return listed_of(data)
    if isinstance(data, Scattered | Brdf):
        return readings(data)
    return readings(Brdf.sampled(data, *AXES, channels=channel_names(data)))


def _axis(angles: Array) -> dict[str, float]:
    return {"first": float(angles[0]), "last": float(angles[-1]), "count": len(angles)}


def _axes(data: Scattered) -> dict[str, dict[str, float]]:
    names = ("theta_i", "phi_i", "theta_r", "phi_r")
    return {name: _axis(np.unique(np.round(getattr(data, f"{name}_deg"), 6))) for name in names}


def _albedos(data: Data | Function) -> dict[str, Any]:
    """Shares of the light, or why there are none."""
    if not isinstance(data, Scattered | Brdf | Merl | Rgl):
        return {"albedo": [_share(data, theta, 90.0, through=False) for theta in INCIDENCES]}
    try:
        whole = Whole(gridded(data) if isinstance(data, Scattered) else data)
        through = whole.quantity == "btdf"
        (low, high), (first, last) = whole.reach
        end = 180 - first if through else last
        begin = 180 - last if through else first
        if begin > 0:
            raise DomainError(f"{whole.source}: begins {begin:g} deg from the normal")
        shares = [_share(whole, theta, end, through=through) for theta in INCIDENCES if low <= theta <= high]
    except DomainError as error:
        return {"albedo": [], "no_albedo": str(error)}
    return {"albedo": shares}


def _share(function: Function, theta_i: float, end: float, *, through: bool) -> dict[str, Any]:
    return {"theta_i": theta_i, "to_theta_r": end, "share": [float(x) for x in albedo(function, theta_i, end, through=through)]}
