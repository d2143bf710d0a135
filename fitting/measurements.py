"""Readings in the plane of incidence, and the tables they come from."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitError, ReadingError, TableError

Quantity = Literal["intensity", "reflectance-factor", "brdf"]
Array = NDArray[np.float64]

UNITS: Mapping[str, str] = {"intensity": "relative", "reflectance-factor": "1", "brdf": "1/sr"}
"""Quantities a reading may have, with the unit a table is taken to be in unless another is named."""

MIN_READINGS = 4
"""The mixture has four coefficients."""

# Column names understood without being told, in small letters, with the unit's suffix taken off (see _plain).
ALIASES: Mapping[str, frozenset[str]] = {
    "theta_i": frozenset({"theta_i", "thetai", "theta_l", "theta_light", "incidence", "incidence_angle"}),
    "theta_r": frozenset({"theta_r", "thetar", "theta_v", "thetav", "theta_o", "theta_view", "theta", "view", "view_angle"}),
    "intensity": frozenset({"value", "i", "intensity", "radiance", "reading", "lux", "illuminance"}),
    "reflectance-factor": frozenset({"brf", "reflectance", "reflectance_factor", "rho"}),
    "brdf": frozenset({"brdf", "fr", "f_r"}),
    "sigma": frozenset({"sigma", "u", "std", "sd", "stdev", "uncertainty", "u_value", "sigma_value", "value_sigma", "value_u"}),
}


@dataclass(frozen=True, eq=False)
class Measurements:
    """Readings of reflected light in the plane of incidence.

    Parameters
    ----------
    theta_i_deg, theta_r_deg : ndarray, shape (n,), deg
        Light, 0 <= theta_i < 90, and view, -180 to 180, positive on the light's side.
    value : ndarray, shape (n,)
        Readings.
    sigma : ndarray, shape (n,), optional
        Standard uncertainty of `value`, in its unit.
    quantity : {"intensity", "reflectance-factor", "brdf"}
        What `value` is: radiance under a constant beam (any unit), pi f_r, or f_r.
    unit : str
        Label of the unit; by default that of the quantity.
    source : str
        Where the readings come from, for messages.
    rows : ndarray of int, shape (n,), optional
        Line of each reading in its source; by default 1, 2, ...

    Raises
    ------
    ReadingError
        If a number is not finite, an angle is out of range or a sigma is negative.
    FitError
        If lengths differ or the quantity is unknown.
    """

    theta_i_deg: Array
    theta_r_deg: Array
    value: Array
    sigma: Array | None = None
    quantity: Quantity = "intensity"
    unit: str = ""
    source: str = "readings"
    rows: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        if self.quantity not in UNITS:
            raise FitError(f"{self.source}: unknown quantity {self.quantity!r}; known are {', '.join(UNITS)}")
        rows = _column(np.arange(1, np.size(self.value) + 1) if self.rows is None else self.rows, "rows", self.source, np.int64)
        object.__setattr__(self, "rows", rows)
        object.__setattr__(self, "unit", self.unit or UNITS[self.quantity])
        for name in ("theta_i_deg", "theta_r_deg", "value", "sigma"):
            given = getattr(self, name)
            if given is None and name == "sigma":
                continue
            column = _column(given, name, self.source, np.float64)
            object.__setattr__(self, name, column)
            if column.size != rows.size:
                raise FitError(f"{self.source}: {name} has {column.size} entries, expected {rows.size}, one for each row")
            self._require(np.isfinite(column), name, column, "a finite number")
        self._require((self.theta_i_deg >= 0) & (self.theta_i_deg < 90), "theta_i", self.theta_i_deg, "0 <= theta_i < 90 deg")
        self._require(np.abs(self.theta_r_deg) <= 180, "theta_r", self.theta_r_deg, "-180 <= theta_r <= 180 deg")
        if self.sigma is not None:
            self._require(self.sigma >= 0, "sigma", self.sigma, "0 or more")

    def __len__(self) -> int:
        return self.value.size

    def _require(self, good: NDArray[np.bool_], name: str, column: Array, expected: str) -> None:
        if not good.all():
            bad = int(np.flatnonzero(~good)[0])
            raise self.error(bad, f"{name} is {column[bad]:g}, expected {expected}")

    def error(self, index: int, problem: str) -> ReadingError:
        """Return an error that names reading `index` (from 0) by its source and row."""
        assert self.rows is not None  # set in __post_init__
        return ReadingError(self.source, int(self.rows[index]), problem)

    @property
    def _per_intensity(self) -> Array:
        if self.quantity == "intensity":
            return np.ones(len(self))
        return np.cos(np.radians(self.theta_i_deg)) * (math.pi if self.quantity == "brdf" else 1.0)

    @property
    def intensity(self) -> Array:
        """The readings as the paper's model sees them: radiance under a beam of constant strength, ndarray of shape (n,).

        A surface of BRDF f_r under a beam of irradiance E across itself has radiance f_r E cos(theta_i). With E = pi, a reflectance factor
        counts rho cos(theta_i) and a BRDF pi f_r cos(theta_i): several incidences then share one scale, on which r'_s_diff = cos(theta_i)
        with x_s_diff = 1 is the perfect diffuser. Readings given as intensity are taken as they are.
        """
        return self.value * self._per_intensity

    @property
    def intensity_sigma(self) -> Array | None:
        """Standard uncertainty of `intensity`, or None."""
        return None if self.sigma is None else self.sigma * self._per_intensity


def read_csv(
    path: Path | str,
    *,
    columns: Mapping[str, str | float] | None = None,
    where: Mapping[str, str | float] | None = None,
    theta_r_positive: Literal["light", "forward"] = "light",
    quantity: Quantity | None = None,
    unit: str = "",
) -> Measurements:
    """Read readings from a comma-separated table with a header line.

    Blank lines and lines that begin with '#' are passed over. Nothing else is: a chosen row that cannot be used is an error.

    Parameters
    ----------
    path : Path or str
        The file, UTF-8.
    columns : mapping, optional
        Which column holds "theta_i", "theta_r", "value" and, if there is one, "sigma". A number instead of a name stands for a constant,
        such as the incidence of the whole table. Those not given are found by their usual names (`ALIASES`), a unit's suffix aside.
    where : mapping, optional
        Rows to use: column and the value it must have. Numbers match within 1e-9, text exactly.
    theta_r_positive : {"light", "forward"}
        On which side of the normal the table counts theta_r positive. Here it is the light's side; "forward" is turned round.
    quantity : {"intensity", "reflectance-factor", "brdf"}, optional
        What the values are. By default the column's name says it (BRF, BRDF, ...), and any other name means intensity.
    unit : str, optional
        Label of the unit.

    Returns
    -------
    Measurements

    Raises
    ------
    TableError
        With file and line, if the file cannot be read, a column is missing or ambiguous, a cell is not a finite number, or fewer than four
        rows are left.
    """
    path = Path(path)
    if theta_r_positive not in ("light", "forward"):
        raise FitError(f"theta_r_positive is 'light' or 'forward', not {theta_r_positive!r}")
    table = _lines(path)
    header_line, names = next(table, (0, []))
    if not names:
        raise TableError(path, "no header line found; expected one naming the columns")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise TableError(path, f"column {', '.join(twice)} appears twice in the header", header_line)
    roles = {role: _find(path, header_line, names, role, (columns or {}).get(role)) for role in ("theta_i", "theta_r", "value", "sigma")}
    if unknown := sorted(set(columns or {}) - set(roles)):
        raise TableError(path, f"no such role: {', '.join(unknown)}; columns may be given for {', '.join(roles)}")
    for name in where or {}:
        if name not in names:
            raise TableError(path, f"no column {name!r} to choose rows by; there are {', '.join(names)}", header_line)

    chosen: list[tuple[int, dict[str, str]]] = []
    seen: dict[str, set[str]] = {name: set() for name in where or {}}
    for line, cells in table:
        if len(cells) != len(names):
            raise TableError(path, f"{len(cells)} cells, expected {len(names)} as in the header", line)
        row = dict(zip(names, cells, strict=True))
        for name, values in seen.items():
            values.add(row[name])
        if all(_same(row[name], wanted) for name, wanted in (where or {}).items()):
            chosen.append((line, row))
    _require_rows(path, len(chosen), where or {}, seen)

    def column(role: str) -> Array:
        name = roles[role]
        if isinstance(name, str):
            return np.array([_number(path, line, name, row[name]) for line, row in chosen])
        return np.full(len(chosen), name, dtype=float)

    value_name = roles["value"]
    named = next((q for q in UNITS if isinstance(value_name, str) and _plain(value_name) in ALIASES[q]), "intensity")
    try:
        return Measurements(
            theta_i_deg=column("theta_i"),
            theta_r_deg=column("theta_r") if theta_r_positive == "light" else 0.0 - column("theta_r"),
            value=column("value"),
            sigma=None if roles["sigma"] is None else column("sigma"),
            quantity=quantity or named,  # type: ignore[arg-type]  # a key of UNITS
            unit=unit,
            source=str(path),
            rows=np.array([line for line, _ in chosen]),
        )
    except ReadingError as error:
        raise TableError(path, error.problem, error.row) from error


def _column(values: object, name: str, source: str, dtype: type[np.generic]) -> NDArray[Any]:
    """Copy to a read-only vector, so that a frozen table stays what it was when it was checked."""
    try:
        column = np.array(values, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise FitError(f"{source}: {name} must be numbers: {error}") from error
    if column.ndim != 1:
        raise FitError(f"{source}: {name} must be one column of numbers, not of shape {column.shape}")
    column.flags.writeable = False
    return column


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and stripped cells of all lines but comments and blank ones."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            for cells in reader:
                if cells and any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#"):
                    yield reader.line_num, [cell.strip() for cell in cells]
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise TableError(path, f"is not UTF-8 text: {error.reason} at byte {error.start}; save it as UTF-8 CSV") from error
    except csv.Error as error:
        raise TableError(path, f"is not a comma-separated table: {error}", reader.line_num) from error


def _plain(name: str) -> str:
    """Column name in small letters without its unit: 'Theta_i [deg]' and 'theta_i_deg' are theta_i, 'f_r_per_sr' is f_r."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return re.sub(r"_(deg|degrees|per_sr|1_sr|sr_1)$", "", plain)


def _find(path: Path, line: int, names: list[str], role: str, given: str | float | None) -> str | float | None:
    """Name the column of a role, or its constant, or None for a sigma that is not there."""
    if isinstance(given, str):
        if given not in names:
            raise TableError(path, f"no column {given!r} for {role}; there are {', '.join(names)}", line)
        return given
    if given is not None:
        return given
    wanted = frozenset[str]().union(*(ALIASES[q] for q in UNITS)) if role == "value" else ALIASES[role]
    found = [name for name in names if _plain(name) in wanted]
    if len(found) > 1:
        raise TableError(path, f"{role} may be any of {', '.join(found)}: say which with columns", line)
    if not found and role != "sigma":
        raise TableError(path, f"no column found for {role}; there are {', '.join(names)}: name one of them with columns", line)
    return found[0] if found else None


def _number(path: Path, line: int, name: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise TableError(path, f"{name} is {cell!r}, expected a number", line) from None
    if not math.isfinite(number):
        raise TableError(path, f"{name} is {cell}, expected a finite number", line)
    return number


def _same(cell: str, wanted: str | float) -> bool:
    """Compare as numbers where both are numbers, else as text."""
    if cell == str(wanted):
        return True
    try:
        return math.isclose(float(cell), float(wanted), rel_tol=1e-9, abs_tol=1e-9)
    except ValueError:
        return False


def _require_rows(path: Path, count: int, where: Mapping[str, str | float], seen: Mapping[str, set[str]]) -> None:
    if count >= MIN_READINGS:
        return
    chosen = " where " + " and ".join(f"{name} = {wanted}" for name, wanted in where.items()) if where else ""
    there = "".join(f"; {name} takes {_some(values)}" for name, values in seen.items())
    raise TableError(path, f"{count or 'no'} rows{chosen}, expected at least {MIN_READINGS}{there}")


def _some(values: set[str]) -> str:
    """List a few values, in order."""
    listed = sorted(values)
    return ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "")
