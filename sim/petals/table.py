"""Reflectance tables of the virtual petals: on disk, and asked at any angle."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sim.petals.errors import PetalError
from sim.petals.interpolation import BicubicSpline
from sim.petals.structure import Petal

FORMAT = "virtual petal 1"
ARRAYS = (
    "theta_i",
    "theta_r",
    "f_r_nodes",
    "standard_error",
    "surface",
    "reflectance",
    "reflectance_error",
    "transmittance",
    "transmittance_error",
    "theta_r_bins",
    "phi_bins",
    "f_r_bins",
    "f_r_bins_error",
)


@dataclass(frozen=True, eq=False)
class PetalTable:
    """Reflectance of one virtual petal in the plane of incidence, from the photon tracer.

    Angles in degrees; theta_r is signed, positive on the light's side (retro-reflection at theta_r = theta_i).

    Attributes
    ----------
    name : str
        Cultivar.
    theta_i : ndarray, shape (n,)
        Nodes of incidence, from 0 [deg].
    theta_r : ndarray, shape (m,)
        Nodes of view, -85 to 85 [deg].
    f_r_nodes, standard_error : ndarray, shape (n, m)
        f_r and its standard error, from the scatter of independent batches of photons [1/sr].
    surface : ndarray, shape (n, m)
        The part of f_r that never entered the petal [1/sr].
    reflectance, reflectance_error, transmittance, transmittance_error : ndarray, shape (n,)
        Shares of the light that leave above and below, with standard errors.
    theta_r_bins, phi_bins : ndarray, shape (p + 1,) and (q + 1,)
        Edges of bins over the hemisphere: theta_r from 0, |phi_r - phi_i| from 0 (the light's side) to 180 [deg].
    f_r_bins, f_r_bins_error : ndarray, shape (n, p, q)
        Mean f_r in each bin, weighted with cos theta_r, and its standard error [1/sr].
    parameters : Petal
        What the petal is made of.
    seed : int
    photons : int
        Per angle of incidence.
    tracer : int
        Version of the tracer that made the table.
    """

    name: str
    theta_i: np.ndarray
    theta_r: np.ndarray
    f_r_nodes: np.ndarray
    standard_error: np.ndarray
    surface: np.ndarray
    reflectance: np.ndarray
    reflectance_error: np.ndarray
    transmittance: np.ndarray
    transmittance_error: np.ndarray
    theta_r_bins: np.ndarray
    phi_bins: np.ndarray
    f_r_bins: np.ndarray
    f_r_bins_error: np.ndarray
    parameters: Petal
    seed: int
    photons: int
    tracer: int

    def f_r(self, theta_i: ArrayLike, theta_r: ArrayLike) -> np.ndarray:
        """f_r in the plane of incidence [1/sr].

        A bicubic spline of log f_r, so that it is never negative; it goes through the nodes. A negative theta_i is mirrored:
        f_r(-a, b) = f_r(a, -b). From the last node of theta_r (85 deg) to the horizon log f_r goes on as a parabola that leaves with the
        spline's slope and arrives level at 90 deg.

        Parameters
        ----------
        theta_i : array_like
            Angle of incidence [deg], at most that of the last node (80) either way.
        theta_r : array_like
            Viewing angle [deg], -90 to 90; broadcasts against theta_i.

        Returns
        -------
        ndarray, broadcast shape

        Raises
        ------
        PetalError
            For angles outside the table, or not finite.
        """
        ti, tr = np.broadcast_arrays(np.asarray(theta_i, float), np.asarray(theta_r, float))
        for label, angles, limit in (("theta_i", ti, self.theta_i[-1]), ("theta_r", tr, 90.0)):
            wrong = ~(np.abs(angles) <= limit)
            if wrong.any():
                raise PetalError(
                    f"petal {self.name}: {label} = {angles[wrong][0]:g} deg asked, the table reaches from {-limit:g} to {limit:g} deg"
                )
        edge = self.theta_r[-1]
        inside = np.clip(tr, -edge, edge)
        beyond = np.abs(tr) - edge
        log = self._log_f_r(ti, inside)
        if (beyond > 0).any():
            outward = np.sign(tr) * self._log_f_r.slope_y(ti, inside)
            log = log + np.where(beyond > 0, outward * beyond * (1 - beyond / (2 * (90.0 - edge))), 0.0)
        return np.exp(log)

    @cached_property
    def _log_f_r(self) -> BicubicSpline:
        # Mirrored to negative theta_i first, so that the surface is smooth at normal incidence.
        theta_i = np.concatenate([-self.theta_i[:0:-1], self.theta_i])
        return BicubicSpline(theta_i, self.theta_r, np.log(np.concatenate([self.f_r_nodes[:0:-1, ::-1], self.f_r_nodes])))


def read_table(path: Path) -> PetalTable:
    """Read a table from its JSON file.

    Raises
    ------
    PetalError
        If the file is missing, damaged or not a petal table.
    """
    try:
        data: Mapping[str, Any] = json.loads(path.read_text(encoding="ascii"))
        if data["format"] != FORMAT:
            raise PetalError(f"{path}: format {data['format']!r}, expected {FORMAT!r}; rebuild it with python -m sim.petals")
        arrays = {key: np.array(data[key], float) for key in ARRAYS}
        rest = {key: data[key] for key in ("name", "seed", "photons", "tracer")}
        fields: dict[str, Any] = {**rest, **arrays, "parameters": Petal(**data["parameters"])}
        table = PetalTable(**fields)
    except OSError as error:
        raise PetalError(f"{path}: {error.strerror}; rebuild it with python -m sim.petals") from error
    except (ValueError, KeyError, TypeError) as error:
        raise PetalError(f"{path}: not a petal table ({type(error).__name__}: {error}); rebuild it with python -m sim.petals") from error
    shape = (table.theta_i.size, table.theta_r.size)
    if table.f_r_nodes.shape != shape or not (table.f_r_nodes > 0).all():
        raise PetalError(f"{path}: f_r_nodes: expected {shape} numbers above 0; rebuild it with python -m sim.petals")
    for array in arrays.values():
        array.flags.writeable = False
    return table


def write_table(table: PetalTable, path: Path) -> None:
    """Write a table as JSON, numbers to 6 digits, one row of an array a line."""
    lines = [f'"format": "{FORMAT}"']
    for key in ("name", "seed", "photons", "tracer"):
        lines.append(f'"{key}": {json.dumps(getattr(table, key))}')
    lines.append(f'"parameters": {json.dumps(table.parameters._asdict())}')
    lines.extend(f'"{key}": {_array_text(getattr(table, key))}' for key in ARRAYS)
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="ascii")


def _array_text(array: np.ndarray) -> str:
    if array.ndim == 1:
        return "[" + ", ".join(f"{value:.6g}" for value in array) + "]"
    return "[\n" + ",\n".join(_array_text(row) for row in array) + "]"
