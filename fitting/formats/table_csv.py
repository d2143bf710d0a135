"""Tables as text: what the line-by-line formats share, and CSV with named columns, which `fitting.read_csv` also reads."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from fitting.errors import DomainError, TableError
from fitting.formats import replacing
from fitting.formats.grid import Array, Brdf, Function, Quantity, Scattered
from fitting.measurements import Measurements

LONGEST_LINE = 1 << 16
"""Characters; what is longer is no line of a table."""

AXES = (np.arange(0.0, 81, 10), np.arange(0.0, 86, 5), np.arange(0.0, 356, 5))
"""Where a function is asked for a list of readings: theta_i, theta_r and phi_r - phi_i, deg."""

ANGLES = ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg")
VALUE_COLUMNS = {"brdf": "brdf_per_sr", "reflectance-factor": "reflectance_factor", "intensity": "intensity"}


def lines(path: Path | str) -> Iterator[tuple[int, str]]:
    """Read a text file line by line.

    Yields
    ------
    number, line : int, str
        From 1, and without the white space around it. Bytes that are not UTF-8 are passed on as they are: old comments hold them.

    Raises
    ------
    TableError
        If the file cannot be read or is not made of lines.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", errors="surrogateescape") as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ""), 1):
                if len(line) >= LONGEST_LINE or "\0" in line:
                    raise TableError(path, "not a table of text: expected lines of numbers", number)
                yield number, line.strip()
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error


def numbers(path: Path | str, line: int, cells: Sequence[str], names: Sequence[str]) -> list[float]:
    """Read one row of numbers.

    Raises
    ------
    TableError
        With the line, if there are more or fewer than `names`, or one is not a finite number.
    """
    if len(cells) != len(names):
        raise TableError(path, f"{len(cells)} numbers, expected {len(names)}: {', '.join(names)}", line)
    try:
        row = [float(cell) for cell in cells]
        if all(map(math.isfinite, row)) and not any("_" in cell for cell in cells):
            return row
    except ValueError:
        pass
    bad = next(k for k, cell in enumerate(cells) if not _is_number(cell))
    raise TableError(path, f"{names[bad]} is {cells[bad]!a}, expected a finite number", line)


def whole(path: Path | str, line: int, text: str, name: str, most: int) -> int:
    """Read a count, 0 to `most`; TableError with the line if it is none."""
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= most):
        raise TableError(path, f"{name} is {text!a}, expected a whole number of at most {most}", line)
    return int(text)


def write_lines(path: Path | str, written: Iterable[str]) -> None:
    """Write a text file, whole or not at all.

    Raises
    ------
    TableError
        If it cannot be written.
    """
    try:
        with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(line + "\n" for line in written)
    except OSError as error:
        raise TableError(path, f"cannot be written: {error.strerror or error}") from error


def one_line(text: object) -> str:
    """Make a header's value of anything: one line without quotes, of a bounded length."""
    return " ".join(str(text).replace('"', "'").split())[:500]


def once(path: Path | str, directions: Array, rows: Sequence[int]) -> None:
    """Refuse two readings of one geometry.

    Parameters
    ----------
    path : Path or str
        The file.
    directions : ndarray, shape (n, k)
        Angles as the file has them.
    rows : sequence of int
        Line of each.

    Raises
    ------
    TableError
        With the line of the second.
    """
    if not len(directions):
        return
    order = np.lexsort(directions.T[::-1])  # stable: the later line comes second
    same = np.flatnonzero(np.all(np.diff(directions[order], axis=0) == 0, axis=1))
    if same.size:
        first, second = min((rows[order[k]], rows[order[k + 1]]) for k in same)
        raise TableError(path, f"same angles as in line {first}: average the two or leave one out", second)


def readings(data: Function | Brdf | Scattered, axes: Sequence[Array] = AXES) -> Scattered:
    """List what is to be written, reading by reading.

    Parameters
    ----------
    data : callable, Brdf or Scattered
        A function is asked at every combination of `axes`; a grid is written node by node.
    axes : sequence of three ndarray, deg
        theta_i, theta_r and phi_r - phi_i.

    Raises
    ------
    DomainError
        If the function is no BRDF.
    """
    if isinstance(data, Scattered):
        return data
    grid = data if isinstance(data, Brdf) else Brdf.sampled(data, *axes)
    phi_i = np.zeros(1) if grid.phi_i_deg is None else grid.phi_i_deg
    nodes = np.meshgrid(grid.theta_i_deg, phi_i, grid.theta_r_deg, grid.phi_r_deg, indexing="ij")
    return Scattered(
        theta_i_deg=nodes[0].ravel(),
        phi_i_deg=nodes[1].ravel(),
        theta_r_deg=nodes[2].ravel(),
        phi_r_deg=nodes[3].ravel(),
        values=grid.values.reshape(-1, len(grid.channels)),
        channels=grid.channels,
        quantity=grid.quantity,
        source=grid.source,
        metadata=grid.metadata,
    )


def in_plane(data: Scattered, *, channel: str | None = None, tolerance_deg: float = 1e-6) -> Measurements:
    """Take the readings in the plane of incidence, as the fit wants them.

    Parameters
    ----------
    data : Scattered
        From any file.
    channel : str, optional
        Which; may be left out where there is one.
    tolerance_deg : float
        How far phi_r - phi_i may be from 0 or 180 deg. At theta_r = 0 it does not matter.

    Returns
    -------
    Measurements
        theta_r positive on the light's side; its rows count the readings from 1.

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
    off = np.abs((data.phi_r_deg - data.phi_i_deg + 90) % 360 - 90)  # -90 .. 270: 0 is the light's side, 180 the other
    light = (off <= tolerance_deg) | (data.theta_r_deg == 0)
    kept = light | (np.abs(off - 180) <= tolerance_deg)
    return Measurements(
        theta_i_deg=data.theta_i_deg[kept],
        theta_r_deg=np.where(light, data.theta_r_deg, 0.0 - data.theta_r_deg)[kept],
        value=data.values[kept, k],
        sigma=None if data.sigma is None else data.sigma[kept, k],
        quantity="brdf",
        source=data.source,
        rows=np.flatnonzero(kept) + 1,
    )


def write_csv(path: Path | str, data: Function | Brdf | Scattered | Measurements) -> None:
    """Write readings as CSV with named columns, numbers to the last digit.

    Parameters
    ----------
    path : Path or str
        The file; what is there is replaced.
    data : callable, Brdf, Scattered or Measurements
        Measurements are written with theta_r signed, as `fitting.read_csv` reads them; everything else with both azimuths, as `read_table`
        does.

    Raises
    ------
    TableError
        If it cannot be written.
    DomainError
        If a function is no BRDF.
    """
    if isinstance(data, Measurements):
        columns = {"theta_i_deg": data.theta_i_deg, "theta_r_deg": data.theta_r_deg, VALUE_COLUMNS[data.quantity]: data.value}
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


def require(path: Path | str, rows: Sequence[int], good: np.ndarray, problem: str) -> None:
    """Raise a TableError with the line of the first reading that is not good."""
    if not np.all(good):
        raise TableError(path, problem, rows[int(np.flatnonzero(~good)[0])])


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


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell)) and "_" not in cell
    except ValueError:
        return False
