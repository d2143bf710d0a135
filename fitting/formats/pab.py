"""Text of the pab goniophotometers ("Mountain"), one file for each incidence, as Radiance's pabopto2bsdf reads it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from fitting.errors import DomainError, TableError
from fitting.formats.grid import AXES, Array, Brdf, Function, Quantity, Scattered, readings
from fitting.formats.text import lines, numbers, once, one_line, require, whole, write_lines

XYZ = ("X", "Y", "Z")
FORMATS = {"dsf": True, "bsdf": False, "brdf": False, "btdf": False}
"""What "#format: theta phi ..." may name, and whether values are multiplied by cos(theta_r)."""


def read_pab(paths: Path | str | Sequence[Path | str]) -> Scattered:
    """Read the files of one sample.

    Parameters
    ----------
    paths : Path, str, or a sequence of them
        One file for each incidence.

    Returns
    -------
    Scattered
        Channels ("value",), or X, Y, Z. A file with the light behind the sample (theta above 90 deg) is turned over, about the x axis, so
        that theta_i is at most 90. What is scattered to the light's side is "brdf", to the other "btdf".

    Raises
    ------
    TableError
        With the line, if a file is cut or foreign, does not say its incidence or its format, holds both sides, a number is not finite or a
        geometry is there twice; or if the files are not of one kind.
    """
    listed = [paths] if isinstance(paths, Path | str) else list(paths)
    if not listed:
        raise DomainError("no pab files were given")
    parts = [_read(path) for path in listed]
    first = parts[0]
    seen: dict[tuple[float, float], Path | str] = {}
    for path, part in zip(listed, parts, strict=True):
        if (part.channels, part.quantity) != (first.channels, first.quantity):
            found, expected = f"{part.quantity} of {', '.join(part.channels)}", f"{first.quantity} of {', '.join(first.channels)}"
            raise TableError(path, f"holds {found}, expected {expected} as in {listed[0]}: read them one by one")
        incidence = (part.metadata["theta"], part.metadata["phi"])
        if incidence in seen:
            raise TableError(path, f"same incidence, {incidence[0]:g} and {incidence[1]:g} deg, as {seen[incidence]}")
        seen[incidence] = path
    return Scattered(
        theta_i_deg=np.concatenate([p.theta_i_deg for p in parts]),
        phi_i_deg=np.concatenate([p.phi_i_deg for p in parts]),
        theta_r_deg=np.concatenate([p.theta_r_deg for p in parts]),
        phi_r_deg=np.concatenate([p.phi_r_deg for p in parts]),
        values=np.concatenate([p.values for p in parts]),
        channels=first.channels,
        quantity=first.quantity,
        source=first.source if len(parts) == 1 else f"{first.source} and {len(parts) - 1} more",
        metadata={key: value for key, value in first.metadata.items() if key not in ("theta", "phi")},
    )


def write_pab(
    path: Path | str, data: Function | Brdf | Scattered, *, axes: Sequence[Array] = AXES, name: str = "", up_phi_deg: float = 0.0
) -> list[Path]:
    """Write one file for each incidence.

    Parameters
    ----------
    path : Path or str
        The file; where there are several incidences, "petal.txt" becomes "petal_t045p000.txt" and so on.
    data : callable, Brdf or Scattered
        A function is asked at every combination of `axes`, theta_i, theta_r and phi, deg.
    axes : sequence of three ndarray, deg
    name : str
        Of the sample; by default the data's source.
    up_phi_deg : float
        Azimuth of the direction that is up, which Radiance turns to +y.

    Returns
    -------
    list of Path
        The files, by incidence.

    Raises
    ------
    TableError
        If a file cannot be written.
    DomainError
        If the channels are neither one nor X, Y, Z, or two incidences would share a file.
    """
    listed = readings(data, axes)
    if len(listed.channels) != 1 and listed.channels != XYZ:
        raise DomainError(f"{listed.source}: a pab file holds one channel or X, Y, Z, not {', '.join(listed.channels)}")
    incidences = np.unique(np.column_stack([listed.theta_i_deg, listed.phi_i_deg]), axis=0).tolist()
    path = Path(path)
    alone = len(incidences) == 1
    named = {path if alone else path.with_stem(f"{path.stem}_{_at('t', theta)}{_at('p', phi)}"): (theta, phi) for theta, phi in incidences}
    if len(named) < len(incidences):
        raise DomainError(f"{listed.source}: incidences closer than 0.001 deg cannot be told apart in the files' names")
    for file, (theta, phi) in named.items():
        chosen = (listed.theta_i_deg == theta) & (listed.phi_i_deg == phi)
        write_lines(file, _written(listed, chosen, theta, phi, one_line(name or listed.source), up_phi_deg))
    return list(named)


def _written(data: Scattered, chosen: np.ndarray, theta: float, phi: float, name: str, up_phi: float) -> Iterator[str]:
    yield f'#sample_name "{name}"'
    yield f"#incident_angle {theta!r} {phi!r}"
    yield f"#intheta {theta!r}"
    yield f"#inphi {phi!r}"
    yield f"#upphi {float(up_phi)!r}"
    yield f"#colorimetry: {'CIE-XYZ' if data.channels == XYZ else 'CIE-Y'}"
    yield f"#datapoints_in_file: {np.count_nonzero(chosen)}"
    yield f"#format: theta phi {data.quantity.upper()}"
    rows = np.column_stack([data.theta_r_deg[chosen], data.phi_r_deg[chosen], data.values[chosen]])
    for row in rows.tolist():
        yield "\t".join(map(repr, row))


def _at(letter: str, angle: float) -> str:
    """Short name of an angle, in whole degrees where it is."""
    return f"{letter}{angle:03.0f}" if angle == round(angle) else f"{letter}{angle:07.3f}"


def _read(path: Path | str) -> Scattered:
    """Read one incidence; `metadata` has theta and phi as the file gives them."""
    said: dict[str, float] = {}
    about: dict[str, str] = {}
    spectral, times_cos, expected = 1, None, None
    names: list[str] = []
    table: list[list[float]] = []
    rows: list[int] = []
    for number, line in lines(path):
        if not line:
            continue
        if not line.startswith("#"):
            names = names or ["theta", "phi", *(XYZ if spectral == 3 else ("value",))]
            if times_cos is None or "theta" not in said or "phi" not in said:
                what = 'format ("#format: theta phi BRDF")' if times_cos is None else 'incidence ("#incident_angle 45 0")'
                raise TableError(path, f"numbers before any line that says the {what}: not a pab file, or its header is cut", number)
            table.append(numbers(path, number, line.split(), names))
            rows.append(number)
            continue
        if table:
            raise TableError(path, "a header line among the numbers; expected all of them above, one incidence in a file", number)
        words = line[1:].split()
        key = words[0].rstrip(":") if words else ""
        if key in ("incident_angle", "intheta", "inphi", "upphi"):
            wanted = {"incident_angle": ["theta", "phi"], "intheta": ["theta"], "inphi": ["phi"], "upphi": ["up_phi"]}[key]
            for angle, value in zip(wanted, numbers(path, number, words[1:], wanted), strict=True):
                if said.setdefault(angle, value) != value:
                    raise TableError(path, f"{angle} is {value:g} deg, and was {said[angle]:g} deg above", number)
        elif key == "format":
            kind = words[-1].lower()
            if [word.lower() for word in words[1:3]] != ["theta", "phi"] or len(words) != 4 or kind not in FORMATS:
                raise TableError(path, f"format {' '.join(words[1:])!a}, expected theta phi and one of BRDF, BTDF, BSDF, DSF", number)
            times_cos = FORMATS[kind]
        elif key == "colorimetry":
            kind = " ".join(words[1:]).upper()
            if kind not in ("CIE-Y", "CIE-XYZ"):
                raise TableError(path, f"colorimetry {kind!a}, expected CIE-Y or CIE-XYZ", number)
            spectral = 3 if kind == "CIE-XYZ" else 1
        elif key == "datapoints_in_file":
            expected = whole(path, number, " ".join(words[1:]), key, 1 << 31)
        elif key and len(words) > 1:
            about[key] = " ".join(words[1:]).strip('"')
    if not table:
        raise TableError(path, "no readings found: not a pab file, or it is cut")
    if expected is not None and expected != len(table):
        raise TableError(path, f"{len(table)} readings, and its header says {expected}: the file is cut or has been edited", rows[-1])
    return _placed(path, np.array(table), rows, said, about, bool(times_cos))


def _placed(path: Path | str, table: Array, rows: list[int], said: dict[str, float], about: dict[str, str], times_cos: bool) -> Scattered:
    """Bring one file's readings to the house's frame."""
    theta_i, phi_i = said["theta"], said["phi"]
    theta_r, phi_r, values = table[:, 0], table[:, 1], table[:, 2:]
    if not 0 <= theta_i <= 180:
        raise TableError(path, f"the light is at theta = {theta_i:g} deg, expected 0 to 180 deg")
    require(path, rows, (theta_r >= 0) & (theta_r <= 180), "theta is not within 0 to 180 deg")
    once(path, table[:, :2], rows)
    if theta_i > 90:
        theta_i, phi_i, theta_r, phi_r = 180 - theta_i, 0.0 - phi_i, 180 - theta_r, 0.0 - phi_r
    behind = theta_r > 90
    quantity: Quantity = "btdf" if behind[0] else "brdf"
    require(path, rows, behind == behind[0], "scattered to the other side than the readings above: keep the two sides in two files")
    if times_cos:
        require(path, rows, theta_r != 90, "a DSF at theta = 90 deg, which is multiplied by cos(theta) = 0, says nothing of the BSDF")
        values = values / np.abs(np.cos(np.radians(theta_r)))[:, None]
    require(path, rows, np.all(np.isfinite(values), axis=1), "the value is too large")
    n = len(values)
    return Scattered(
        np.full(n, theta_i),
        np.full(n, phi_i),
        theta_r,
        phi_r,
        values=values,
        channels=XYZ if values.shape[1] == 3 else ("value",),
        quantity=quantity,
        source=str(path),
        metadata={**about, **said},
    )
