"""Zemax tabular BSDF, the interchange format of Radiant Imaging, for optical design programs.

Angles count from the specular direction (BTDF: from straight through): ScatterRadial away from it, and ScatterAzimuth about it, 0 towards
the sample's normal. After "Zemax Tabular BSDF data file format" of the maker's knowledge base.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fitting.errors import DomainError
from fitting.formats.grid import Array, Brdf, Function, ask
from fitting.formats.text import one_line, write_lines

THETA_I = np.arange(0.0, 81, 10)
AZIMUTH = np.arange(0.0, 181, 10)
RADIAL = np.concatenate([np.arange(0.0, 10, 1), np.arange(10.0, 30, 2), np.arange(30.0, 176, 5)])


def write_zemax(
    path: Path | str,
    function: Function | Brdf,
    *,
    theta_i_deg: ArrayLike = THETA_I,
    azimuth_deg: ArrayLike = AZIMUTH,
    radial_deg: ArrayLike = RADIAL,
    through: bool = False,
    name: str = "",
) -> None:
    """Write an isotropic reflectance or transmittance of one channel.

    Directions beyond the sample's horizon are part of the table, and hold 0.

    Parameters
    ----------
    path : Path or str
        The file, usually .bsdf; what is there is replaced.
    function : callable or isotropic Brdf
        f(theta_i, theta_r, phi), 1/sr, the same left and right of the plane of incidence.
    theta_i_deg : array_like, deg
        Incidences, rising, 0 to below 90.
    azimuth_deg : array_like, deg
        About the specular direction, rising from 0 to 180: the other half is its mirror image.
    radial_deg : array_like, deg
        From the specular direction, rising from 0 to at most 180.
    through : bool
        Write what goes through, theta_r from 90 to 180 deg, as BTDF.
    name : str
        For the file's first line.

    Raises
    ------
    TableError
        If it cannot be written.
    DomainError
        If a list of angles is not as said, or the function is no isotropic BRDF of one channel up to 90 deg.
    """
    if isinstance(function, Brdf) and function.phi_i_deg is not None:
        raise DomainError(f"{function.source}: is not isotropic; the optical programs take one sample rotation only")
    theta_i = _axis("theta_i", theta_i_deg, 0, 90)
    azimuth, radial = _axis("azimuth", azimuth_deg, 0, 180), _axis("radial", radial_deg, 0, 180)
    if theta_i[-1] == 90 or azimuth[0] != 0 or azimuth[-1] != 180 or radial[0] != 0:
        raise DomainError("expected theta_i below 90 deg, azimuths from 0 to 180 deg and radial angles from 0")
    tables = [_table(function, theta, azimuth, radial, through=through) for theta in theta_i]
    total = [integrated(function, theta, through=through) for theta in theta_i]
    source = name or (function.source if isinstance(function, Brdf) else "function")
    write_lines(path, _written(theta_i, azimuth, radial, tables, total, "BTDF" if through else "BRDF", one_line(source)))


def directions(theta_i: float, azimuth_deg: ArrayLike, radial_deg: ArrayLike) -> tuple[Array, Array]:
    """Turn angles about the specular direction into angles about the normal.

    Parameters
    ----------
    theta_i : float, deg
        Light.
    azimuth_deg, radial_deg : array_like, deg
        About and from the specular direction.

    Returns
    -------
    theta_r, phi : ndarray, of the broadcast shape, deg
        View; phi = phi_r - phi_i, 0 to 180 for azimuths of 0 to 180. Beyond 90 deg it is behind the sample.
    """
    light, around, away = np.radians(theta_i), np.radians(azimuth_deg), np.radians(radial_deg)
    towards_normal, sideways, along = np.sin(away) * np.cos(around), np.sin(away) * np.sin(around), np.cos(away)
    # The frame: specular (-sin, 0, cos); at right angles to it, in the plane, towards the normal (cos, 0, sin)
    x = -np.sin(light) * along + np.cos(light) * towards_normal
    z = np.cos(light) * along + np.sin(light) * towards_normal
    return np.degrees(np.arctan2(np.hypot(x, sideways), z)), np.degrees(np.arctan2(sideways, x))


def integrated(function: Function, theta_i: float, *, through: bool = False, steps: int = 120) -> float:
    """Share of the light that is scattered, the integral of f cos(theta_r) over the hemisphere: what the file calls TIS.

    Midpoints of equal projected solid angle: `steps` in theta, and half a turn in phi.
    """
    at = (np.arange(steps) + 0.5) / steps
    theta = np.degrees(np.arcsin(np.sqrt(at)))[:, None]
    values = ask(function, theta_i, 180 - theta if through else theta, 180 * at)
    return float(np.pi * values.mean())


def _table(function: Function, theta_i: float, azimuth: Array, radial: Array, *, through: bool) -> Array:
    theta_r, phi = directions(theta_i, azimuth[:, None], radial)
    above = theta_r <= 90 + 1e-9
    theta_r = np.minimum(theta_r[above], 90)
    values = np.zeros(above.shape)
    values[above] = ask(function, theta_i, 180 - theta_r if through else theta_r, phi[above])[..., 0]
    return values


def _axis(name: str, angles: ArrayLike, low: float, high: float) -> Array:
    axis = np.atleast_1d(np.asarray(angles, float))
    if axis.ndim != 1 or not axis.size or not np.all((axis >= low) & (axis <= high)) or np.any(np.diff(axis) <= 0):
        raise DomainError(f"{name} must be one rising list of angles within {low:g} to {high:g} deg")
    return axis


def _written(
    theta_i: Array, azimuth: Array, radial: Array, tables: list[Array], total: list[float], kind: str, source: str
) -> Iterator[str]:
    yield f"#{source}"
    yield "Source  Measured"
    yield "Symmetry  PlaneSymmetrical"
    yield "SpectralContent  Monochrome"
    yield f"ScatterType  {kind}"
    for name, axis in (
        ("SampleRotation", np.zeros(1)),
        ("AngleOfIncidence", theta_i),
        ("ScatterAzimuth", azimuth),
        ("ScatterRadial", radial),
    ):
        yield f"{name}  {len(axis)}"
        yield "  ".join(f"{angle:g}" for angle in axis)
    yield ""
    yield "Monochrome"
    yield "DataBegin"
    for table, share in zip(tables, total, strict=True):
        yield f"TIS  {share:.6f}"
        for row in table.tolist():
            yield "  ".join(f"{value:.6E}" for value in row)
    yield "DataEnd"
