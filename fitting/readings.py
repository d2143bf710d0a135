"""Readings from comma-separated tables: named columns, their units, and what a table must not hold."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from fitting.errors import FitError, ReadingError, TableError
from fitting.measurements import NOISE, QUANTITIES, UNITS, Array, Measurements, Quantity, wrapped

Repeats = Literal["refuse", "keep", "mean"]

# Column names understood without being told, in small letters, with the unit taken off (see _split).
ALIASES: Mapping[str, frozenset[str]] = {
    "theta_i": frozenset({"theta_i", "thetai", "theta_l", "theta_light", "incidence", "incidence_angle"}),
    "theta_r": frozenset({"theta_r", "thetar", "theta_v", "thetav", "theta_o", "theta_view", "theta", "view", "view_angle"}),
    "intensity": frozenset({"value", "i", "intensity", "radiance", "reading", "lux", "illuminance"}),
    "reflectance-factor": frozenset({"brf", "reflectance", "reflectance_factor", "rho"}),
    "brdf": frozenset({"brdf", "fr", "f_r"}),
    "sigma": frozenset({"sigma", "u", "std", "sd", "stdev", "uncertainty", "u_value", "sigma_value", "value_sigma", "value_u"}),
    "phi": frozenset({"phi", "dphi", "delta_phi", "phi_rel", "relative_azimuth"}),
    "phi_i": frozenset({"phi_i", "phii", "phi_l", "phi_light"}),
    "phi_r": frozenset({"phi_r", "phir", "phi_v", "phiv", "phi_o", "phi_view"}),
}

ANGLES = ("theta_i", "theta_r", "phi", "phi_i", "phi_r")
NEEDED = ("theta_i", "theta_r", "value")
ROLES = (*NEEDED, "sigma", "phi", "phi_i", "phi_r")

# How units are spelt, in small letters.
UNIT_SPELLINGS: Mapping[str, str] = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("1/sr", "/sr", "sr-1", "sr^-1", "sr**-1", "sr⁻¹", "1_sr", "sr_1", "per_sr", "per sr"), "1/sr"),
    **dict.fromkeys(("%", "percent", "pct"), "%"),
    **dict.fromkeys(("1", "-", "dimensionless", "unitless"), "1"),
}
# Those a name may end in after an underscore; the others need brackets.
UNIT_SUFFIX = re.compile(r"(.+)_(deg|degrees|rad|radians|1_sr|sr_1|per_sr|percent|pct)")

LONGEST_LINE = 1 << 16
"""Characters; what is longer is no line of a table."""

Said = list[tuple[str, int | None]]
"""Units of one column, and the line that names each."""


def read_csv(
    path: Path | str,
    *,
    columns: Mapping[str, str | float] | None = None,
    where: Mapping[str, str | float] | None = None,
    theta_r_positive: Literal["light", "forward"] = "light",
    quantity: Quantity | None = None,
    unit: str = "",
    repeats: Repeats = "refuse",
    covariance: Path | str | None = None,
) -> Measurements:
    """Read readings from a comma-separated table with a header line.

    Blank lines and lines that begin with '#' are passed over. Nothing else is: a chosen row that cannot be used is an error.

    Units may stand in the header ("theta_r [deg]", "theta_r_deg", "brdf_per_sr", "brf [%]"), in a line right below it (",deg,deg,1/sr") or
    in a column named "unit". Angles are in degrees, a BRDF in 1/sr, a reflectance factor in 1 or in %, which is divided by 100; what says
    otherwise, or is said twice in two ways, is an error.

    Parameters
    ----------
    path : Path or str
        The file, UTF-8.
    columns : mapping, optional
        Which column holds "theta_i", "theta_r", "value" and, where there are such, "sigma" and "phi", or "phi_i" and "phi_r". A number
        instead of a name stands for a constant, such as the incidence of the whole table. Those not given are found by their usual names
        (`ALIASES`), a unit's suffix aside.
    where : mapping, optional
        Rows to use: column and the value it must have. Numbers match within 1e-9, text exactly.
    theta_r_positive : {"light", "forward"}
        On which side of the normal the table counts theta_r positive and phi 0. Here it is the light's side; "forward" is turned round.
    quantity : {"intensity", "reflectance-factor", "brdf"}, optional
        What the values are. By default the column's name says it (BRF, BRDF, ...), and any other name means intensity.
    unit : str, optional
        Label of the unit.
    repeats : {"refuse", "keep", "mean"}
        What becomes of several readings at the same angles (to a millionth of a degree): an error; readings each; or their mean, named by
        the line of the first. The mean's uncertainty follows from the table's sigma, taken as independent, or its covariance; if it has
        neither, from the scatter, provided that everything was repeated.
    covariance : Path or str, optional
        A second file, n rows of n numbers separated by commas and no header: the covariance of the table's n rows, in their order, in the
        value's unit squared. Rows that are not chosen are left out of it.

    Returns
    -------
    Measurements

    Raises
    ------
    TableError
        With file and line, if a file cannot be read or is cut short, a column is missing or ambiguous, a unit contradicts the quantity, a
        cell is not a finite number, a reading cannot be light (0 or less without a sigma, or 5 sigma below 0), angles come twice, or
        no reading is left.
    """
    path = Path(path)
    if theta_r_positive not in ("light", "forward"):
        raise FitError(f"theta_r_positive is 'light' or 'forward', not {theta_r_positive!r}")
    if repeats not in ("refuse", "keep", "mean"):
        raise FitError(f"repeats is 'refuse', 'keep' or 'mean', not {repeats!r}")
    lines = _lines(path)
    header_line, names, _ = next(lines, (0, [], True))
    _require_names(path, header_line, names)
    roles = _roles(path, header_line, names, columns or {})
    for name in where or {}:
        if name not in names:
            raise TableError(path, f"no column {name!r} to choose rows by; there are {_some(names)}", header_line)
    rows = _rows(path, names, lines)
    named: dict[str, str] = {role: name for role, name in roles.items() if isinstance(name, str)}
    units: dict[str, Said] = {role: [(unit, header_line) for unit in _split(name)[1]] for role, name in named.items()}
    if rows and _names_units(rows[0][1], named):
        line, row = rows.pop(0)
        for role, name in named.items():
            units[role] += [(_unit(row[name]), line)] if row[name] else []
    kept = [k for k, (_, row) in enumerate(rows) if all(_same(row[name], wanted) for name, wanted in (where or {}).items())]
    _require_rows(path, len(kept), where or {}, {name: {row[name] for _, row in rows} for name in where or {}})
    chosen = [rows[k] for k in kept]
    _require_degrees(path, named, units)
    of_value = units.get("value", []) + _unit_column(path, names, chosen)
    if _unit(unit) in UNIT_SPELLINGS.values():
        of_value.append((_unit(unit), None))
    kind, said = _quantity(path, named.get("value", "value"), quantity, of_value)
    _require_one_unit(path, units.get("sigma", []), said or unit or UNITS[kind])
    percent = kind == "reflectance-factor" and said == "%"
    divisor = 100.0 if percent else 1.0

    def column(role: str) -> Array | None:
        name = roles[role]
        if isinstance(name, str):
            return np.array([_number(path, line, name, row[name]) for line, row in chosen])
        return None if name is None else np.full(len(chosen), name, dtype=float)

    read = {role: values for role in ROLES if (values := column(role)) is not None}
    spread = None if covariance is None else _matrix(Path(covariance), len(rows), path)[np.ix_(kept, kept)] / divisor**2
    try:
        found = Measurements(
            theta_i_deg=read["theta_i"],
            theta_r_deg=read["theta_r"],
            value=read["value"] / divisor,
            sigma=read["sigma"] / divisor if "sigma" in read else None,
            quantity=kind,
            unit="1, from %" if percent else unit or said,
            source=str(path),
            rows=np.array([line for line, _ in chosen]),
            phi_deg=_azimuth(path, read, [line for line, _ in chosen]),
            covariance=spread,
        )
        found = _without_repeats(_turned(found) if theta_r_positive == "forward" else found, repeats)
        _require_light(found)
    except ReadingError as error:
        raise TableError(path, error.problem, error.row) from error
    return found


def _lines(path: Path) -> Iterator[tuple[int, list[str], bool]]:
    """Yield number, stripped cells and whether it ended in a line break, of all lines but comments and blank ones."""
    ended = True

    def text() -> Iterator[str]:
        nonlocal ended
        offset = 0
        with path.open(encoding="utf-8", errors="surrogateescape", newline="") as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ""), 1):
                if bad := re.search("[\0\udc80-\udcff]", line):
                    at = offset + len(line[: bad.start()].encode())
                    kind = "is not text" if bad[0] == "\0" else "is not UTF-8 text"
                    raise TableError(path, f"{kind}: byte {ord(bad[0]) & 0xFF:#04x} at offset {at}; save it as UTF-8 CSV", number)
                if len(line) >= LONGEST_LINE:
                    raise TableError(path, f"is not a table: the line from offset {offset} on is longer than {LONGEST_LINE}", number)
                offset += len(line.encode())
                ended = line[-1] in "\r\n"
                line = line.removeprefix("\ufeff") if number == 1 else line
                yield "\n" if line.lstrip().startswith("#") else line  # a comment's quotes mean nothing

    reader = csv.reader(text(), strict=True)
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield reader.line_num, [cell.strip() for cell in cells], ended
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error
    except csv.Error as error:
        raise TableError(path, f"is not a comma-separated table: {error}", reader.line_num) from error


def _rows(path: Path, names: list[str], lines: Iterator[tuple[int, list[str], bool]]) -> list[tuple[int, dict[str, str]]]:
    """Name the cells of each line."""
    rows = []
    for line, cells, ended in lines:
        _require_width(path, line, cells, len(names), ended)
        rows.append((line, dict(zip(names, cells, strict=True))))
    return rows


def _require_names(path: Path, line: int, names: list[str]) -> None:
    if not names:
        raise TableError(path, "no header line found; expected one naming the columns")
    if len(names) == 1 and (other := re.search(r"[;\t|]", names[0])):
        raise TableError(path, f"the header is separated by {other[0]!r}, expected commas", line)
    if all(_is_number(name) for name in names):
        raise TableError(path, "no header line found: the first line holds numbers, expected names of columns", line)
    if twice := sorted({name for name in names if name and names.count(name) > 1}):
        raise TableError(path, f"column {', '.join(twice)} appears twice in the header", line)


def _require_width(path: Path, line: int, cells: list[str], width: int, ended: bool) -> None:
    if len(cells) != width:
        cut = "" if ended else "; the file ends within this line: it was perhaps cut short"
        raise TableError(path, f"{len(cells)} cells, expected {width}{cut}", line)


def _split(name: str) -> tuple[str, list[str]]:
    """Part a column's name, in small letters, from its units: 'Theta_i [deg]' and 'theta_i_deg' are theta_i in deg, 'BRF%' is brf in %."""
    units = []
    if bracketed := re.fullmatch(r"(.+?)\s*(?:\[([^\[\]]+)\]|\(([^()]+)\)|(%))", name):
        head, square, rounded, percent = bracketed.groups()
        unit = _unit(square or rounded or percent)
        if rounded is None or unit in UNIT_SPELLINGS.values():  # round brackets may hold anything
            name, units = head, [unit]
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    if suffixed := UNIT_SUFFIX.fullmatch(plain):
        plain, units = suffixed[1], [_unit(suffixed[2]), *units]
    return plain, units


def _unit(text: str) -> str:
    """One spelling for each known unit, others as they are."""
    text = text.strip(" []()")
    return UNIT_SPELLINGS.get(text.lower(), text)


def _roles(path: Path, line: int, names: list[str], given: Mapping[str, str | float]) -> dict[str, str | float | None]:
    """Say which column or constant is what."""
    if unknown := sorted(set(given) - set(ROLES)):
        raise TableError(path, f"no such role: {', '.join(unknown)}; columns may be given for {', '.join(ROLES)}")
    # An azimuth that was named makes the others that are there those of something else.
    told = {"phi"} & set(given), {"phi_i", "phi_r"} & set(given)
    if all(told):
        raise TableError(path, "columns may be given for phi, or for phi_i and phi_r, not for both", line)
    passed = ("phi_i", "phi_r") if told[0] else ("phi",) if told[1] else ()
    roles = {role: None if role in passed else _find(path, line, names, role, given.get(role)) for role in ROLES}
    phi, phi_i, phi_r = (roles[role] for role in ("phi", "phi_i", "phi_r"))
    if phi is not None and (phi_i is not None or phi_r is not None):
        raise TableError(path, f"the azimuth may be {phi}, or that from {phi_i} to {phi_r}: say which with columns", line)
    if (phi_i is None) != (phi_r is None):
        there, lacking = ("phi_i", "phi_r") if phi_r is None else ("phi_r", "phi_i")
        raise TableError(
            path, f"{roles[there]} is an azimuth without its {lacking}: give that with columns, or phi=0 for the plane of incidence", line
        )
    return roles


def _find(path: Path, line: int, names: list[str], role: str, given: str | float | None) -> str | float | None:
    """Name the column of a role, or its constant, or None for one that is not there and need not be."""
    if isinstance(given, str) and given not in names:
        if _is_number(given):
            return float(given)
        raise TableError(path, f"no column {given!r} for {role}; there are {_some(names)}", line)
    if given is not None:
        return given
    wanted = frozenset[str]().union(*(ALIASES[q] for q in UNITS)) if role == "value" else ALIASES[role]
    found = [name for name in names if _split(name)[0] in wanted]
    if len(found) > 1:
        raise TableError(path, f"{role} may be any of {', '.join(found)}: say which with columns", line)
    if not found and role in NEEDED:
        raise TableError(path, f"no column found for {role}; there are {_some(names)}: name one of them with columns", line)
    return found[0] if found else None


def _names_units(row: Mapping[str, str], named: Mapping[str, str]) -> bool:
    """Whether a row holds no reading but the columns' units."""
    angles = [row[name] for role, name in named.items() if role in ANGLES]
    return bool(angles) and all(_unit(cell) in ("deg", "rad") for cell in angles)


def _unit_column(path: Path, names: list[str], rows: list[tuple[int, dict[str, str]]]) -> Said:
    """The unit that a column of units says, which must be one."""
    for name in names:
        if _split(name)[0] in ("unit", "units"):
            said = [(_unit(row[name]), line) for line, row in rows]
            for unit, line in said:
                if unit != said[0][0]:
                    mix = f"{name} is {unit!r}, but {said[0][0]!r} in line {said[0][1]}"
                    raise TableError(path, f"{mix}: readings of one table share one unit; choose the rows", line)
            return [(unit, line) for unit, line in said[:1] if unit]
    return []


def _said(path: Path, name: str, said: Said) -> tuple[str, int | None]:
    """The one unit that is said of a column, "" if none is."""
    for unit, line in said:
        if unit != said[0][0]:
            raise TableError(path, f"{name} is said to be in {said[0][0]} and in {unit}", line)
    return said[0] if said else ("", None)


def _require_degrees(path: Path, named: Mapping[str, str], units: Mapping[str, Said]) -> None:
    for role, name in named.items():
        unit, line = _said(path, name, units[role])
        if role in ANGLES and unit not in ("", "deg"):
            raise TableError(path, f"{name} is in {unit}, expected deg", line)


def _quantity(path: Path, name: str, given: Quantity | None, units: Said) -> tuple[Quantity, str]:
    """Say what the values are, and in which unit if that is named."""
    plain, _ = _split(name)
    by_name: Quantity = next((q for q in QUANTITIES if plain in ALIASES[q]), "intensity")
    kind = given or by_name
    if kind not in UNITS:
        raise FitError(f"{path}: unknown quantity {kind!r}; known are {', '.join(UNITS)}")
    unit, line = _said(path, name, units)
    if unit:
        fits = {"intensity": unit not in ("1/sr", "deg", "rad"), "reflectance-factor": unit in ("1", "%"), "brdf": unit == "1/sr"}[kind]
        wanted = {"intensity": "neither 1/sr nor that of an angle", "reflectance-factor": "1 or %", "brdf": "1/sr"}[kind]
        if not fits:
            why = "as asked" if given else "by its name"
            raise TableError(path, f"{name} is in {unit}, but {why} it is {kind}, whose unit is {wanted}: say which quantity it is", line)
    return kind, unit


def _require_one_unit(path: Path, of_sigma: Said, of_value: str) -> None:
    for unit, line in of_sigma:
        if unit != of_value:
            raise TableError(path, f"sigma is in {unit}, but the values are in {of_value}: bring both to one unit", line)


def _azimuth(path: Path, read: Mapping[str, Array], lines: list[int]) -> Array:
    """phi_r - phi_i, -180 to 180; 0 where the table has none."""
    for role in ("phi", "phi_i", "phi_r"):
        if role in read and not np.all(good := np.abs(read[role]) <= 360):
            bad = int(np.flatnonzero(~good)[0])
            raise TableError(path, f"{role} is {read[role][bad]:g}, expected -360 <= {role} <= 360 deg", lines[bad])
    return wrapped(read["phi_r"] - read["phi_i"]) if "phi_r" in read else wrapped(read.get("phi", np.zeros(len(lines))))


def _turned(found: Measurements) -> Measurements:
    """Count directions from the other side of the normal: half a turn about it."""
    theta_r = np.where(found.in_plane, 0.0 - found.theta_r_deg, found.theta_r_deg)
    phi = np.where(found.in_plane, 0.0, found.phi_deg - np.copysign(180, found.phi_deg))
    return replace(found, theta_r_deg=theta_r, phi_deg=phi)


def _without_repeats(found: Measurements, repeats: Repeats) -> Measurements:
    """Refuse, keep or average readings at the same angles."""
    angles = np.round(np.column_stack([found.theta_i_deg, found.theta_r_deg, found.phi_deg]), 6) + 0.0
    _, first, which, count = np.unique(angles, axis=0, return_index=True, return_inverse=True, return_counts=True)
    if repeats == "keep" or len(first) == len(found):
        return found
    which = which.reshape(-1)
    if repeats == "refuse":
        again = int(np.flatnonzero(first[which] != np.arange(len(found)))[0])
        problem = f"the same angles as in line {found.rows[first[which[again]]]}: choose rows, or say with repeats that they are repeats"
        raise found.error(again, problem)
    order = np.argsort(which, kind="stable")
    starts = np.cumsum(count) - count

    def summed(values: Array) -> Array:
        return np.add.reduceat(values[order], starts, axis=0)

    with np.errstate(over="ignore", invalid="ignore"):  # what is too large is refused as not finite
        value = summed(found.value) / count
        sigma, covariance = None, None
        if found.covariance is not None:
            covariance = summed(summed(found.covariance).T) / count[:, None] / count
            covariance = (covariance + covariance.T) / 2
        elif found.sigma is not None:
            sigma = np.sqrt(summed(found.sigma**2)) / count
        elif np.all(count > 1):
            sigma = np.sqrt(summed((found.value - value[which]) ** 2) / np.maximum(count - 1, 1) / count)
        merged = replace(found.take(first), value=value, sigma=sigma, covariance=covariance)
    return merged.take(np.argsort(first))


def _require_light(found: Measurements) -> None:
    """Refuse readings that cannot be light: 0 is noise only where there is noise."""
    noise = np.zeros(len(found)) if found.sigma is None else found.sigma
    if np.any(dark := (found.value <= 0) & (found.value / NOISE <= -noise)):
        bad = int(np.flatnonzero(dark)[0])
        known = "no sigma says that this is noise" if found.sigma is None else f"its sigma is {noise[bad]:g}"
        raise found.error(
            bad, f"reading is {found.value[bad]:g} and {known}: no light can be that; look at the dark reading or leave it out"
        )


def _matrix(path: Path, n: int, table: Path) -> Array:
    """Read the n rows of n numbers that belong to a table."""
    rows = []
    for line, cells, ended in _lines(path):
        _require_width(path, line, cells, n, ended)
        rows.append([_number(path, line, f"column {k}", cell) for k, cell in enumerate(cells, 1)])
    if len(rows) != n:
        raise TableError(path, f"{len(rows)} rows, expected {n}, one for each row of {table}")
    return np.array(rows)


def _number(path: Path, line: int, name: str, cell: str) -> float:
    if not _is_number(cell):
        hint = ": name the unit in the header, as in 'brf [%]'" if cell.endswith("%") else ""
        raise TableError(path, f"{name} is {cell!r}, expected a number{hint}", line)
    number = float(cell)
    if not math.isfinite(number):
        raise TableError(path, f"{name} is {cell}, expected a finite number", line)
    return number


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell  # float takes more than tables hold


def _same(cell: str, wanted: str | float) -> bool:
    """Compare as numbers where both are numbers, else as text."""
    if cell == str(wanted):
        return True
    try:
        return math.isclose(float(cell), float(wanted), rel_tol=1e-9, abs_tol=1e-9)
    except ValueError:
        return False


def _require_rows(path: Path, count: int, where: Mapping[str, str | float], seen: Mapping[str, set[str]]) -> None:
    if count:
        return
    chosen = " where " + " and ".join(f"{name} = {wanted}" for name, wanted in where.items()) if where else ""
    there = "".join(f"; {name} takes {_some(sorted(values))}" for name, values in seen.items())
    raise TableError(path, f"no rows{chosen}, expected at least 1{there}")


def _some(values: Sequence[str]) -> str:
    """List a few."""
    return ", ".join(values[:12]) + (f" and {len(values) - 12} more" if len(values) > 12 else "")
