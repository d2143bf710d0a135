"""Text of the ALTA library, the format that carries error bars.

Which angles a row begins with is said by its header (`PARAM_IN`, in radians), what follows by `PARAM_OUT`, and whether error bars come last
by `VS`. After ALTA's `params.h` and `vertical_segment.cpp`: a segment's radius (VS 1) or its two ends (VS 2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitting.errors import DomainError, FitError, TableError
from fitting.formats.grid import AXES, Array, Brdf, Function, Quantity, Scattered, readings
from fitting.formats.text import lines, numbers, once, one_line, require, whole, write_lines

MOST_CHANNELS = 4096
TIMES_COS = "INV_STERADIAN_COSINE_FACTOR"
OUTPUTS = ("INV_STERADIAN", TIMES_COS, "RGB_COLOR", "XYZ_COLOR")
"""What `PARAM_OUT` may be: 1/sr, the same times cos(theta_r), and 1/sr in three channels."""

_SPAN = 1e-9  # rad: a direction may be this far over its limit, as a decimal rounding leaves it


def read_alta(
    path: Path | str, *, param_out: str | None = None, theta_r_below_deg: float | None = None, coverage: float = 1.0
) -> Scattered:
    """Read a file of readings.

    Parameters
    ----------
    path : Path or str
        The file.
    param_out : str, optional
        What its values are, one of `OUTPUTS`, where the header does not say.
    theta_r_below_deg : float, optional
        Leave out readings at this theta_r and beyond; the metadata's "left_out" counts them. A file of f_r cos(theta_r) that reaches 90 deg
        needs it: there it holds nothing of f_r.
    coverage : float
        How many standard uncertainties an error bar's radius is. The format does not say [U].

    Returns
    -------
    Scattered
        sigma is half the segment's length by `coverage`, or None where the header has no VS or 0. An azimuth difference
        is taken as phi_r - phi_i [U]; a sample with mirror symmetry does not care.

    Raises
    ------
    TableError
        With the line, if the file is cut or foreign, its parameters are unknown or are not said, a number is not finite, an angle is out of
        range or a geometry is there twice.
    """
    if not coverage > 0:
        raise DomainError(f"coverage is {coverage}, expected a number above 0")
    header = _Header()
    names: list[str] = []
    table: list[list[float]] = []
    rows: list[int] = []
    ended = False
    for number, line in lines(path):
        if not line:
            continue
        if not line.startswith("#"):
            names = names or header.columns(path, number)
            table.append(numbers(path, number, line.split(), names))
            rows.append(number)
        elif not table and not ended:
            ended = header.take(path, number, line)
    if not table:
        raise TableError(path, "no readings found: not an ALTA text file, or it is cut")
    if header.samples is not None and header.samples != len(table):
        raise TableError(path, f"{len(table)} readings, and its header says {header.samples}: the file is cut or has been edited", rows[-1])
    outputs = param_out or header.about.get("PARAM_OUT")
    if param_out is not None and header.about.get("PARAM_OUT", param_out) != param_out:
        raise TableError(path, f"its header says PARAM_OUT {header.about['PARAM_OUT']!a}, and not {param_out}")
    if outputs not in OUTPUTS:
        raise TableError(path, f"PARAM_OUT is {outputs!a}: say what the values are with param_out, one of {', '.join(OUTPUTS)}")
    return _placed(path, header, np.array(table), rows, outputs, theta_r_below_deg, coverage)


def write_alta(path: Path | str, data: Function | Brdf | Scattered, *, axes: Sequence[Array] = AXES) -> None:
    """Write readings with their uncertainties.

    Parameters
    ----------
    path : Path or str
        The file; what is there is replaced.
    data : callable, Brdf or Scattered
        A function is asked at every combination of `axes`, theta_i, theta_r and phi, deg. Readings with a sigma get an error bar of that
        radius (VS 1): one standard uncertainty. ALTA itself takes up the first channel's.
    axes : sequence of three ndarray, deg

    Raises
    ------
    TableError
        If it cannot be written.
    DomainError
        If a function is no BRDF.
    """
    write_lines(path, _written(readings(data, axes)))


def _written(data: Scattered) -> Iterator[str]:
    count = len(data.channels)
    colours: Mapping[tuple[str, ...], str] = {("R", "G", "B"): "RGB_COLOR", ("X", "Y", "Z"): "XYZ_COLOR"}
    yield f'#SAMPLE "{one_line(data.source)}"'
    yield f"#DIM 4 {count}"
    yield f"#VS{' 0' * count if data.sigma is None else ' 1' * count}"
    yield "#PARAM_IN SPHERICAL_TL_PL_TV_PV"
    yield f"#PARAM_OUT {colours.get(data.channels, 'INV_STERADIAN')}"
    yield f"#SAMPLE_COUNT {len(data)}"
    yield "#ALTA END HEADER"
    angles = np.radians(np.column_stack([data.theta_i_deg, data.phi_i_deg, data.theta_r_deg, data.phi_r_deg]))
    for row in np.column_stack([angles, data.values, *([] if data.sigma is None else [data.sigma])]).tolist():
        yield "\t".join(map(repr, row))


class _Header:
    """What the lines that begin with '#' have said so far."""

    def __init__(self) -> None:
        self.about: dict[str, str] = {}
        self.inputs = self.outputs = 0
        self.samples: int | None = None
        self.segments: list[int] = []

    def take(self, path: Path | str, number: int, line: str) -> bool:
        """Take one line up; True if it ends the header."""
        words = line[1:].split()
        if not words:
            return False
        key, rest = words[0].upper(), words[1:]
        if key == "ALTA" and [word.upper() for word in rest[:2]] == ["END", "HEADER"]:
            return True
        if key in ("DIM", "VS", "PARAM_IN", "PARAM_OUT", "SAMPLE_COUNT") and key in self.about:
            raise TableError(path, f"#{key} is said twice", number)
        self.about[key] = " ".join(rest).strip('"')
        if key == "DIM":
            if len(rest) != 2:
                raise TableError(path, "#DIM wants two whole numbers, of inputs and of outputs", number)
            self.inputs, self.outputs = (whole(path, number, word, "DIM", MOST_CHANNELS) for word in rest)
            if not self.inputs or not self.outputs:
                raise TableError(path, "#DIM says that there is no input or no output", number)
        elif key == "VS":
            self.segments = [whole(path, number, word, "VS", 2) for word in rest]
        elif key == "SAMPLE_COUNT":
            self.samples = whole(path, number, " ".join(rest), key, 1 << 40)
        elif key == "FORMAT" and self.about[key].lower() != "text":
            raise TableError(path, f"#FORMAT {self.about[key]!a}: only the text form is read; convert it with ALTA's data2data", number)
        elif key == "PARAM_IN" and self.about[key] not in _DIRECTIONS:
            raise TableError(path, f"PARAM_IN {self.about[key]!a} is not understood; known are {', '.join(_DIRECTIONS)}", number)
        return False

    def columns(self, path: Path | str, number: int) -> list[str]:
        """Name the numbers of a row."""
        if not self.inputs or "PARAM_IN" not in self.about:
            missing = "DIM" if not self.inputs else "PARAM_IN"
            raise TableError(path, f"numbers before any #{missing}: not an ALTA text file, or its header is cut", number)
        inputs = _DIRECTIONS[self.about["PARAM_IN"]][0]
        if len(inputs) != self.inputs:
            raise TableError(path, f"#DIM says {self.inputs} inputs, and {self.about['PARAM_IN']} has {len(inputs)}", number)
        if len(self.segments) == 1:  # ALTA's later readers take one number, for all outputs
            self.segments *= self.outputs
        if self.segments and (len(self.segments) != self.outputs or len(set(self.segments)) > 1):
            raise TableError(path, f"#VS {self.about['VS']}, expected one number, or {self.outputs} that are alike", number)
        ends = {0: (), 1: ("radius",), 2: ("min", "max")}[self.segments[0] if self.segments else 0]
        outputs = [f"output {k + 1}" for k in range(self.outputs)]
        return [*inputs, *outputs, *(f"{end} of {output}" for output in outputs for end in ends)]


def _placed(
    path: Path | str, header: _Header, table: Array, rows: list[int], param_out: str, theta_r_below: float | None, coverage: float
) -> Scattered:
    """Turn rows into readings in the house's directions."""
    count = header.outputs
    channels: tuple[str, ...] = ("value",) if count == 1 else tuple(f"value_{k + 1}" for k in range(count))
    if param_out in ("RGB_COLOR", "XYZ_COLOR"):
        if count != 3:
            raise TableError(path, f"PARAM_OUT {param_out} has 3 outputs, and #DIM says {count}")
        channels = tuple(param_out[:3])
    columns, convert = _DIRECTIONS[header.about["PARAM_IN"]]
    once(path, table[:, : len(columns)], rows)
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            angles = convert(table[:, : len(columns)])
        except _Outside as outside:
            bad = int(np.flatnonzero(outside.bad)[0])
            raise TableError(path, str(outside), rows[bad]) from None
    angles[:, 2] = np.where(np.abs(angles[:, 2] - 90) < np.degrees(_SPAN), 90.0, angles[:, 2])  # not behind by a rounding
    kept = np.ones(len(table), bool) if theta_r_below is None else angles[:, 2] < theta_r_below
    if not kept.any():
        raise TableError(path, f"no reading has theta_r below {theta_r_below:g} deg")
    angles, table, rows = angles[kept], table[kept], [row for row, keep in zip(rows, kept, strict=True) if keep]
    values, ends = table[:, len(columns) : len(columns) + count], table[:, len(columns) + count :].reshape(len(table), count, -1)
    sigma = None
    if ends.size:
        radius = ends[..., 0] if ends.shape[2] == 1 else (ends[..., 1] - ends[..., 0]) / 2
        require(path, rows, np.all(radius >= 0, axis=1), "an error bar's length is below 0")
        sigma = radius / coverage
    behind = angles[:, 2] > 90
    quantity: Quantity = "btdf" if behind[0] else "brdf"
    require(
        path, rows, behind == behind[0], "behind the sample, and the readings above are not, or the other way round: keep them in two files"
    )
    if param_out == TIMES_COS:
        cosine = np.abs(np.cos(np.radians(angles[:, 2])))[:, None]
        grazing = "f_r cos(theta_r) at theta_r = 90 deg says nothing of f_r: leave such readings out with theta_r_below_deg = 90 or less"
        require(path, rows, cosine[:, 0] > _SPAN, grazing)
        values, sigma = values / cosine, None if sigma is None else sigma / cosine
    require(path, rows, np.all(np.isfinite(values), axis=1), "the value is too large")
    return Scattered(
        theta_i_deg=angles[:, 0],
        phi_i_deg=angles[:, 1],
        theta_r_deg=angles[:, 2],
        phi_r_deg=angles[:, 3],
        values=values,
        sigma=sigma,
        channels=channels,
        quantity=quantity,
        source=str(path),
        metadata={**header.about, "left_out": int(np.count_nonzero(~kept))},
    )


class _Outside(FitError):
    """An angle is out of its range."""

    def __init__(self, problem: str, bad: NDArray[np.bool_]) -> None:
        self.bad = bad
        super().__init__(problem)


def _theta(name: str, theta: Array, most: float = np.pi) -> Array:
    """Check a polar angle, in rad."""
    bad = ~((theta >= -_SPAN) & (theta <= most + _SPAN))
    if bad.any():
        raise _Outside(f"{name} = {theta[bad][0]:g}, expected 0 to {most:.4g} rad; is the file in degrees?", bad)
    return np.clip(theta, 0, most)


def _spherical(x: Array) -> Array:
    return np.degrees(np.column_stack([_theta("theta_l", x[:, 0]), x[:, 1], _theta("theta_v", x[:, 2]), x[:, 3]]))


def _isotropic(x: Array) -> Array:
    """theta_v, theta_l, phi_v - phi_l."""
    theta_i, theta_r = _theta("theta_l", x[:, 1]), _theta("theta_v", x[:, 0])
    return np.degrees(np.column_stack([theta_i, np.zeros(len(x)), theta_r, x[:, 2]]))


def _in_plane(x: Array) -> Array:
    """theta_v, below 0 on the side away from the light, and theta_l."""
    theta_i, theta_r = _theta("theta_l", x[:, 1]), _theta("theta_v", np.abs(x[:, 0]))
    return np.degrees(np.column_stack([theta_i, np.zeros(len(x)), theta_r, np.where(x[:, 0] < 0, np.pi, 0.0)]))


def _projected(x: Array) -> Array:
    """theta_l, theta_v cos(dphi), theta_v sin(dphi): positive cosine on the light's side."""
    theta_r = _theta("theta_v", np.hypot(x[:, 1], x[:, 2]))
    return np.degrees(np.column_stack([_theta("theta_l", x[:, 0]), np.zeros(len(x)), theta_r, np.arctan2(x[:, 2], x[:, 1])]))


def _cartesian(x: Array) -> Array:
    """View and light, as vectors."""
    view, light = x[:, :3], x[:, 3:]
    for name, vector in (("view", view), ("light", light)):
        bad = ~(np.abs(np.linalg.norm(vector, axis=1) - 1) < 1e-3)
        if bad.any():
            raise _Outside(f"the {name} vector is not of length 1", bad)
    return np.degrees(np.column_stack([*_polar(light), *_polar(view)]))


def _half_and_difference(x: Array) -> Array:
    """theta_h, theta_d, phi_d of Rusinkiewicz (1998), with the half vector at phi = 0."""
    theta_h, theta_d, phi_d = _theta("theta_h", x[:, 0], np.pi / 2), _theta("theta_d", x[:, 1], np.pi / 2), x[:, 2]
    across, up = np.sin(theta_d) * np.cos(phi_d), np.cos(theta_d)
    light = np.stack(
        [np.cos(theta_h) * across + np.sin(theta_h) * up, np.sin(theta_d) * np.sin(phi_d), np.cos(theta_h) * up - np.sin(theta_h) * across]
    )
    half = np.stack([np.sin(theta_h), np.zeros(len(x)), np.cos(theta_h)])
    view = 2 * up * half - light
    return np.degrees(np.column_stack([*_polar(light.T), *_polar(view.T)]))


def _polar(vectors: Array) -> tuple[Array, Array]:
    return np.arctan2(np.hypot(vectors[:, 0], vectors[:, 1]), vectors[:, 2]), np.arctan2(vectors[:, 1], vectors[:, 0])


_DIRECTIONS: Mapping[str, tuple[tuple[str, ...], Callable[[Array], Array]]] = {
    "SPHERICAL_TL_PL_TV_PV": (("theta_l", "phi_l", "theta_v", "phi_v"), _spherical),
    "ISOTROPIC_TV_TL_DPHI": (("theta_v", "theta_l", "dphi"), _isotropic),
    "ISOTROPIC_TV_TL": (("theta_v", "theta_l"), _in_plane),
    "ISOTROPIC_TL_TV_PROJ_DPHI": (("theta_l", "theta_v cos(dphi)", "theta_v sin(dphi)"), _projected),
    "RUSIN_TH_TD_PD": (("theta_h", "theta_d", "phi_d"), _half_and_difference),
    "CARTESIAN": (("view x", "view y", "view z", "light x", "light y", "light z"), _cartesian),
}
"""Inputs of each `PARAM_IN`, and theta_i, phi_i, theta_r, phi_r, deg, from them."""
