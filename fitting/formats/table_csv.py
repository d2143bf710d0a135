"""CSV with named columns, which `fitting.read_csv` also reads."""

from __future__ import annotations

import csv
from itertools import chain
from pathlib import Path

import numpy as np

from fitting.errors import DomainError, TableError
from fitting.formats.grid import Brdf, Function, Quantity, Scattered, readings
from fitting.formats.text import lines, numbers, once, one_line, require, write_lines
from fitting.measurements import Measurements, wrapped

ANGLES = ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg")
VALUE_COLUMNS = {"brdf": "brdf_per_sr", "reflectance-factor": "reflectance_factor", "intensity": "intensity"}


def measurements_of_scattered(data: Scattered, *, channel: str | None = None) -> Measurements:
    """Take the readings of one channel, as the fit wants them.

    Parameters
    ----------
    data : Scattered
        From any file.
    channel : str, optional
        Which; may be left out where there is one.

    Returns
    -------
    Measurements
        In the plane of incidence theta_r is positive on the light's side; its rows count the readings from 1.

    Raises
    ------
    DomainError
        If the channel is not there.
    ReadingError
        If a light is behind the sample.
    """
    name = data.channels[0] if channel is None and len(data.channels) == 1 else channel
    if name not in data.channels:
        raise DomainError(f"{data.source}: no channel {channel!r}; choose one of {', '.join(data.channels)}")
    k = data.channels.index(name)
    return Measurements(
        theta_i_deg=data.theta_i_deg,
        theta_r_deg=data.theta_r_deg,
        value=data.values[:, k],
        sigma=None if data.sigma is None else data.sigma[:, k],
        quantity="brdf",
        source=data.source,
        phi_deg=wrapped(data.phi_r_deg - data.phi_i_deg),
    )


def in_plane(data: Scattered, *, channel: str | None = None) -> Measurements:
    """Take those of `measurements_of_scattered` that are in the plane of incidence."""
    taken = measurements_of_scattered(data, channel=channel)
    return taken.take(taken.in_plane)


def write_csv(path: Path | str, data: Function | Brdf | Scattered | Measurements) -> None:
    """Write readings as CSV with named columns, numbers to the last digit.

    Parameters
    ----------
    path : Path or str
        The file; what is there is replaced.
    data : callable, Brdf, Scattered or Measurements
        Measurements are written as `fitting.read_csv` reads them, theta_r signed, with phi if any is out of the plane of incidence, and
        without correlations; everything else with both azimuths, as `read_table` does.

    Raises
    ------
    TableError
        If it cannot be written.
    DomainError
        If a function is no BRDF.
    """
    if isinstance(data, Measurements):
        columns = {"theta_i_deg": data.theta_i_deg, "theta_r_deg": data.theta_r_deg, VALUE_COLUMNS[data.quantity]: data.value}
        if not data.in_plane.all():
            columns["phi_deg"] = data.phi_deg
        if data.sigma is not None:
            columns["sigma"] = data.sigma
    else:
        listed = readings(data)
        columns = {name: getattr(listed, name) for name in ANGLES}
        parts = [""] if listed.channels == ("value",) else [f"_{name}" for name in listed.channels]
        if any("," in part or '"' in part or "\n" in part for part in parts):
            raise DomainError(f"{listed.source}: channels {listed.channels} cannot be names of columns")
        columns |= {f"{listed.quantity}{part}_per_sr": column for part, column in zip(parts, listed.values.T, strict=True)}
        if listed.sigma is not None:
            columns |= {f"sigma{part}_per_sr": column for part, column in zip(parts, listed.sigma.T, strict=True)}
    source = data.source if isinstance(data, Brdf | Scattered | Measurements) else "a function"
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_lines(path, chain([f"# {one_line(source)}", ",".join(columns)], (",".join(map(repr, row)) for row in rows)))


def read_table(path: Path | str) -> Scattered:
    """Read a table of readings in any direction, as `write_csv` writes them.

    Parameters
    ----------
    path : Path or str
        CSV whose columns are theta_i_deg, phi_i_deg, theta_r_deg, phi_r_deg; brdf_per_sr, or brdf_R_per_sr and so on for channels (btdf
        likewise); and, for all or none, sigma_per_sr or sigma_R_per_sr. Lines that begin with '#' and blank ones are passed over.

    Raises
    ------
    TableError
        With the line, if a column is missing, foreign or in another unit, a cell is not a finite number, or a geometry is there twice.
    """
    names: list[str] = []
    table: list[list[float]] = []
    rows: list[int] = []
    for number, line in lines(path):
        if not line or line.startswith("#"):
            continue
        try:
            cells = [cell.strip() for cell in next(csv.reader([line], strict=True))]
        except (csv.Error, StopIteration) as error:
            raise TableError(path, f"is not a comma-separated table: {error}", number) from error
        if names:
            table.append(numbers(path, number, cells, names))
            rows.append(number)
        else:
            names = cells
            quantity, channels, sigmas = _columns(path, number, names)
    if not table:
        raise TableError(path, "no readings found; expected a line that names the columns, and numbers below it")
    at = np.array(table)
    columns = {name: at[:, k] for k, name in enumerate(names)}
    angles = np.column_stack([columns[name] for name in ANGLES])
    require(path, rows, (angles[:, 0] >= 0) & (angles[:, 0] <= 180), "theta_i is not within 0 to 180 deg")
    require(path, rows, (angles[:, 2] >= 0) & (angles[:, 2] <= 180), "theta_r is not within 0 to 180 deg; the side is said by phi_r")
    once(path, angles, rows)
    part = [f"_{name}" if name != "value" else "" for name in channels]
    sigma = np.column_stack([columns[f"sigma{p}_per_sr"] for p in part]) if sigmas else None
    if sigma is not None:
        require(path, rows, np.all(sigma >= 0, axis=1), "sigma is below 0")
    values = np.column_stack([columns[f"{quantity}{p}_per_sr"] for p in part])
    theta_i, phi_i, theta_r, phi_r = angles.T
    return Scattered(theta_i, phi_i, theta_r, phi_r, values=values, sigma=sigma, channels=channels, quantity=quantity, source=str(path))


def _columns(path: Path | str, line: int, names: list[str]) -> tuple[Quantity, tuple[str, ...], bool]:
    """What a header says: quantity, channels, and whether there are sigmas."""
    if len(set(names)) < len(names):
        raise TableError(path, "a column is named twice", line)
    if missing := [name for name in ANGLES if name not in names]:
        raise TableError(path, f"no column {', '.join(missing)}; there are {', '.join(map(ascii, names[:20]))}", line)
    found: dict[str, list[str]] = {"brdf": [], "btdf": [], "sigma": []}
    for name in names:
        if name in ANGLES:
            continue
        head, _, rest = name.partition("_")
        if head not in found or not name.endswith("_per_sr"):
            raise TableError(path, f"column {name!a} is not understood; expected brdf_per_sr, btdf_per_sr or sigma_per_sr, in 1/sr", line)
        found[head].append(rest.removesuffix("per_sr").rstrip("_") or "value")
    kinds: list[Quantity] = [q for q in ("brdf", "btdf") if found[q]]
    if len(kinds) != 1:
        raise TableError(path, "expected columns of either brdf or btdf", line)
    channels = tuple(found[kinds[0]])
    if len(set(channels)) < len(channels) or (found["sigma"] and sorted(found["sigma"]) != sorted(channels)):
        raise TableError(path, f"sigma is given for {', '.join(found['sigma'])}, expected for each of {', '.join(channels)}", line)
    return kinds[0], channels, bool(found["sigma"])
