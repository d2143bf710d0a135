"""Any file of reflectance: which kind it is, what is in it, and what another kind cannot carry."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import DomainError, TableError
from fitting.formats.alta import read_alta, write_alta
from fitting.formats.grid import AXES, Array, Brdf, Function, Scattered, channel_names
from fitting.formats.hemisphere import Beyond, Whole, gridded, holes, lights_of, picked
from fitting.formats.klems import read_klems, write_klems
from fitting.formats.merl import BINS, RGB, Merl, read_merl, write_merl
from fitting.formats.pab import XYZ, read_pab, write_pab
from fitting.formats.rgl import MAGIC, Rgl, read_rgl, write_rgl
from fitting.formats.table_csv import ANGLES, read_table, write_csv
from fitting.formats.zemax import write_zemax
from fitting.progress import Progress, silent

Data = Brdf | Scattered | Merl | Rgl

HEAD = 1 << 16
"""Bytes of a file that tell its kind."""


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes
    ----------
    title : str
    suffixes : tuple of str
        What such files end in; the first is what a file to be written is known by. One that two kinds share belongs to the kind listed
        first, unless the format is named.
    hemisphere : bool
        Whether a file holds every direction, rather than a list of readings.
    readable : bool
    """

    title: str
    suffixes: tuple[str, ...]
    hemisphere: bool
    readable: bool = True


FORMATS: Mapping[str, Format] = {
    "merl": Format("MERL", (".binary",), True),
    "rgl": Format("RGL tensor (Mitsuba, pbrt)", (".bsdf",), True),
    "zemax": Format("Zemax tabular BSDF", (".zemax.bsdf", ".zemax"), True, readable=False),
    "klems": Format("Klems matrix, XML (Radiance, WINDOW)", (".xml",), True),
    "alta": Format("ALTA text", (".alta", ".dat"), False),
    "pab": Format("pab Mountain text", (".pab", ".txt"), False),
    "csv": Format("CSV with named columns", (".csv",), False),
}
"""Every kind by its name."""

_ALTA_KEYS = frozenset({"DIM", "VS", "PARAM_IN", "PARAM_OUT", "ALTA", "CMP_OUT"})
_PAB_KEYS = frozenset({"format", "incident_angle", "intheta", "inphi", "upphi", "sample_name", "colorimetry", "datapoints_in_file"})
_ZEMAX_KEYS = frozenset({"Source", "Symmetry", "SpectralContent", "ScatterType", "SampleRotation", "AngleOfIncidence"})


def known() -> str:
    """Name the kinds of files, with what they end in."""
    return ", ".join(f"{name} ({', '.join(form.suffixes)})" for name, form in FORMATS.items())


def format_of(path: Path | str) -> str:
    """Tell a file's kind by its content, and where that does not say, by its name.

    Parameters
    ----------
    path : Path or str
        The file; its first 64 KiB are looked at.

    Returns
    -------
    str
        One of `FORMATS`.

    Raises
    ------
    TableError
        If it cannot be read, is empty or of no known kind.
    """
    try:
        with Path(path).open("rb") as file:
            head = file.read(HEAD)
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error
    if not head:
        raise TableError(path, "is empty; known are " + known())
    if (found := _by_content(head)) is not None:
        return found
    named = format_named(path)
    if named is not None and (b"\0" not in head or named in ("merl", "rgl")):
        return named
    looked_for = (
        "byte 0: neither an RGL file's, a MERL file's nor XML's begin, nor, in its first lines, a header of ALTA, pab, Zemax or CSV"
    )
    raise TableError(path, f"{looked_for}; it begins with {head[:12]!r}. Known are {known()}")


def format_named(path: Path | str) -> str | None:
    """Tell the kind that a file's name says, or None."""
    name = Path(path).name.lower()
    endings = [(len(suffix), kind) for kind, form in FORMATS.items() for suffix in form.suffixes if name.endswith(suffix)]
    return max(endings)[1] if endings else None


def _by_content(head: bytes) -> str | None:
    if head.startswith(MAGIC):
        return "rgl"
    if head.startswith(struct.pack("<3i", *BINS)):
        return "merl"
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<") or head.startswith((b"\xff\xfe<", b"\xfe\xff\0<")):
        return "klems"
    if b"\0" in head:
        return None
    for line in head.decode("utf-8-sig", "replace").splitlines():
        words = line.split()
        if words and line.startswith("#"):
            key = (line[1:].split() or [""])[0]
            if key.upper() in _ALTA_KEYS:
                return "alta"
            if key.rstrip(":") in _PAB_KEYS:
                return "pab"
        elif words:
            if words[0] in _ZEMAX_KEYS:
                return "zemax"
            return "csv" if "," in line and "theta" in line.lower() else None
    return None


def read_any(path: Path | str | Sequence[Path | str], format: str | None = None, **options: Any) -> Data:
    """Read a file of any kind.

    Parameters
    ----------
    path : Path or str, or a sequence of them
        The file; several are one sample's pab files.
    format : str, optional
        One of `FORMATS`; by default what `format_of` finds.
    **options
        As that kind's reader takes them: `quantity`, `side` and `wavelength` of a Klems matrix, `param_out`, `theta_r_below_deg` and
        `coverage` of ALTA.

    Raises
    ------
    TableError
        If it is of no known kind, of one that is only written, or damaged.
    DomainError
        If an option is not of that kind.
    """
    paths = [path] if isinstance(path, Path | str) else list(path)
    if not paths:
        raise DomainError("no file was given")
    kinds = [format or format_of(one) for one in paths]
    if kinds[0] not in FORMATS:
        raise DomainError(f"unknown format {kinds[0]!r}; known are {known()}")
    if len(paths) > 1 and (odd := next((k for k, kind in enumerate(kinds) if kind != "pab"), None)) is not None:
        raise TableError(paths[odd], f"{FORMATS[kinds[odd]].title}: only pab files are read several at a time, one for each incidence")
    if not FORMATS[kinds[0]].readable:
        raise TableError(paths[0], f"{FORMATS[kinds[0]].title} is written only; convert from the file that it was made from")
    reader, takes = _READERS[kinds[0]]
    if foreign := set(options) - takes:
        raise DomainError(f"{paths[0]} is {FORMATS[kinds[0]].title}, which has no {', '.join(sorted(foreign))}")
    return reader(paths if kinds[0] == "pab" else paths[0], **options)


def _read_csv(path: Path | str) -> Scattered:
    """Read a table with both azimuths, or else one of measurements in 1/sr or reflectance factors."""
    from fitting.readings import read_csv

    header = next(iter(_cells(path)), [])
    if set(ANGLES) <= set(header) and any(name.startswith(("brdf", "btdf")) for name in header):
        return read_table(path)
    found = read_csv(path)
    if found.quantity == "intensity":
        raise TableError(path, "holds relative readings, which are no reflectance: fit them (rig fit FILE), then convert the fit")
    per_sr = np.pi if found.quantity == "reflectance-factor" else 1.0
    forward = found.theta_r_deg < 0
    phi = np.where(forward, 180.0, found.phi_deg)
    theta_r = np.abs(found.theta_r_deg)
    behind = theta_r > 90
    if np.any(behind != behind[0]):
        raise TableError(path, "holds readings before and behind the sample: keep them in two files")
    return Scattered(
        found.theta_i_deg,
        np.zeros(len(phi)),
        theta_r,
        phi,
        values=found.value[:, None] / per_sr,
        sigma=None if found.sigma is None else found.sigma[:, None] / per_sr,
        quantity="btdf" if behind[0] else "brdf",
        source=str(path),
    )


def _cells(path: Path | str) -> Iterator[list[str]]:
    from fitting.formats.text import lines

    for _, line in lines(path):
        if line and not line.startswith("#"):
            yield [cell.strip() for cell in line.split(",")]


_READERS: Mapping[str, tuple[Callable[..., Data], frozenset[str]]] = {
    "merl": (read_merl, frozenset()),
    "rgl": (read_rgl, frozenset()),
    "klems": (read_klems, frozenset({"quantity", "side", "wavelength"})),
    "alta": (read_alta, frozenset({"param_out", "theta_r_below_deg", "coverage"})),
    "pab": (read_pab, frozenset()),
    "csv": (_read_csv, frozenset()),
}
"""How each kind is read, and the options that it takes."""


class ChannelError(DomainError):
    """A file holds fewer channels than there are, and nobody has said which."""


@dataclass(frozen=True)
class Written:
    """What became of something that was written.

    Attributes
    ----------
    paths : tuple of Path
        The files; several where the format has one for each incidence.
    format : str
        One of `FORMATS`.
    notes : tuple of str
        What the file does not carry as it was.
    """

    paths: tuple[Path, ...]
    format: str
    notes: tuple[str, ...]


def write_any(
    path: Path | str,
    data: Data | Function,
    format: str | None = None,
    *,
    channel: str | None = None,
    beyond: Beyond = "refuse",
    axes: Sequence[Array] = AXES,
    name: str = "",
    progress: Progress = silent,
) -> Written:
    """Write a file of any kind.

    Parameters
    ----------
    path : Path or str
        The file; what is there is replaced.
    data : Brdf, Scattered, Merl, Rgl, or callable
        What `read_any` gives, or a function such as a fit's. What is written to a format of the whole hemisphere is made isotropic.
    format : str, optional
        One of `FORMATS`; by default what the path ends in says: ".bsdf" is an RGL file, and ".zemax.bsdf" a Zemax one.
    channel : str, optional
        The one to write; needed where the format holds fewer than there are.
    beyond : {"refuse", "nearest", "zero"}
        What lies beyond the end of the readings, where the file holds the whole hemisphere and they do not. With "refuse" a MERL file marks
        those bins as without a value, and the others are not written.
    axes : sequence of three ndarray, deg
        Where a function, a MERL or an RGL file is looked up for a list of readings: theta_i, theta_r and phi.
    name : str
        What the file calls the sample, where it can; by default the data's source.
    progress : callable
        See `fitting.progress`; called where it may take more than a second or two.

    Raises
    ------
    BeyondError
        If directions are asked for that nobody measured.
    ChannelError
        If a channel must be chosen.
    TableError
        If it cannot be written.
    DomainError
        If the format cannot hold it: the message says what to do.
    """
    kind = format or format_named(path)
    if kind is None or kind not in FORMATS:
        said = f"unknown format {format!r}" if format else f"{path}: what it ends in says no format"
        raise DomainError(f"{said}; known are {known()}")
    if channel is not None and not isinstance(data, Data):
        raise DomainError(f"channel {channel!r} cannot be chosen of what has but one")
    if channel is not None:
        data = picked(data, channel)
    _check_channels(kind, channel_names(data) if callable(data) else data.channels)
    if FORMATS[kind].hemisphere:
        return _write_hemisphere(Path(path), data, kind, beyond, name, progress)
    return _write_list(Path(path), data, kind, axes, name)


def _check_channels(kind: str, channels: tuple[str, ...]) -> None:
    held: dict[str, tuple[tuple[str, ...], ...]] = {"merl": (RGB,), "rgl": (RGB,), "pab": (XYZ,), "klems": (), "zemax": ()}
    if kind not in held or len(channels) == 1 or channels in held[kind] or (kind == "rgl" and wavelengths(channels)):
        return
    others = "".join(f" or {', '.join(names)}" for names in held[kind])
    shown = ", ".join(channels[:6]) + (" ..." if len(channels) > 6 else "")
    raise ChannelError(f"a file of {FORMATS[kind].title} holds one channel{others}, not {shown}: choose one channel")


def wavelengths(channels: Sequence[str]) -> list[float] | None:
    """Wavelengths, nm, that channels such as "550 nm" are called by, rising; None where they are called otherwise."""
    try:
        found = [float(name.removesuffix(" nm")) for name in channels if name.endswith(" nm")]
    except ValueError:
        return None
    return found if found and len(found) == len(channels) and found == sorted(set(found)) else None


def _write_hemisphere(path: Path, data: Data | Function, kind: str, beyond: Beyond, name: str, progress: Progress) -> Written:
    notes: list[str] = []
    function: Function = data  # type: ignore[assignment]
    if isinstance(data, Scattered):
        if data.sigma is not None:
            notes.append("no error bars")
        data = gridded(data)
        notes += [f"only {data.metadata['direction']}, without {', '.join(others)}"] if (others := data.metadata.get("others")) else []
        if data.metadata["filled_in"]:
            notes.append("values between the readings' azimuths are interpolated")
        if (count := data.metadata["azimuths"]) > 1:
            notes.append(f"isotropic: the mean over {count} azimuths of the light")
    if isinstance(data, Brdf | Merl | Rgl):
        function = whole = Whole(data, beyond)
        if whole.azimuths > 1:
            notes.append(f"isotropic: the mean over {whole.azimuths} azimuths of the light")
        notes += _beyond(whole, holes(data) if isinstance(data, Merl) else 0, kind)
    names, through = channel_names(function), getattr(function, "quantity", "brdf") == "btdf"
    source = name or getattr(function, "source", "")
    if through and kind in ("merl", "rgl"):
        raise DomainError(f"{source}: goes through the sample, and {FORMATS[kind].title} holds reflection only: write .xml or .zemax.bsdf")
    waves = wavelengths(names)
    if kind == "merl":
        if not isinstance(data, Merl):
            notes.append("light and view are taken to be exchangeable: the mean of both ways")
        write_merl(path, whole.table if isinstance(data, Merl) and beyond != "zero" else function)
    elif kind == "rgl":
        write_rgl(path, function, wavelengths_nm=waves if waves and len(waves) > 1 else None, description=source)
    elif kind == "klems":
        notes.append("means over patches 10 deg wide or more")
        write_klems(path, None if through else function, transmitted=function if through else None, name=source, progress=progress)
    else:
        notes.append("left of the plane of incidence is taken to be like right")
        write_zemax(path, function, through=through, name=source)
    if kind in ("merl", "rgl") and len(names) == 1 and not (waves and len(waves) > 1):
        notes.append("R, G and B are alike")
    return Written((path,), kind, tuple(notes))


def _beyond(whole: Whole, holes: int, kind: str) -> list[str]:
    """What is to be said of directions without a value."""
    does = {"nearest": "as at their end", "zero": "taken as 0", "refuse": "marked as without a value"}[whole.beyond]
    if not whole.complete:
        (low_i, high_i), (low_r, high_r) = whole.reach
        there = f"theta_i {low_i:g} to {high_i:g} and theta_r {low_r:g} to {high_r:g} deg"
        return [f"readings at {there}, beyond them {does}"] if kind == "merl" or whole.beyond != "refuse" else []
    return [f"{holes} bins without a value, {does}"] if holes and whole.beyond != "refuse" else []


def _write_list(path: Path, data: Data | Function, kind: str, axes: Sequence[Array], name: str) -> Written:
    notes = []
    if not isinstance(data, Scattered | Brdf):
        notes.append(f"looked up at {' x '.join(str(len(axis)) for axis in axes)} directions (theta_i, theta_r, phi)")
    listed = listed_of(data, axes) if isinstance(data, Merl | Rgl) else data
    if not isinstance(listed, Scattered | Brdf):
        listed = Brdf.sampled(listed, *axes, channels=channel_names(listed), source=name or "function")
    if isinstance(listed, Scattered):
        if left_out := listed.metadata.get("left_out"):
            notes.append(f"{left_out} without a value are left out")
        if listed.sigma is not None and kind == "pab":
            notes.append("no error bars")
        notes += [f"only {listed.metadata['direction']}, without {', '.join(others)}"] if (others := listed.metadata.get("others")) else []
    channels = channel_names(listed) if callable(listed) else listed.channels
    if kind != "csv" and channels not in (("value",), RGB, XYZ):
        notes.append(f"channels without their names ({', '.join(channels[:6])})")
    if kind == "pab":
        return Written(tuple(write_pab(path, listed, axes=axes, name=name)), kind, tuple(notes))
    if kind == "alta":
        write_alta(path, listed, axes=axes)
    else:
        write_csv(path, listed)
    return Written((path,), kind, tuple(notes))


def listed_of(table: Merl | Rgl, axes: Sequence[Array] = AXES) -> Scattered:
    """Look a table up direction by direction, for each of the light's azimuths; directions without a value are left out.

    Raises
    ------
    DomainError
        If there is no value anywhere.
    """
    lights = np.zeros(1) if isinstance(table, Merl) else lights_of(table)
    theta_i, phi_i, theta_r, phi = (at.ravel() for at in np.meshgrid(axes[0], lights, axes[1], axes[2], indexing="ij"))
    known = table.covers(theta_i, theta_r, phi)
    if not known.any():
        raise DomainError(f"{table.source}: has no value at any of {known.size} directions")
    theta_i, phi_i, theta_r, phi = (at[known] for at in (theta_i, phi_i, theta_r, phi))
    values = table.evaluate(theta_i, phi_i, theta_r, phi_i + phi) if isinstance(table, Rgl) else table(theta_i, theta_r, phi)
    about = {"left_out": int(np.count_nonzero(~known))}
    return Scattered(theta_i, phi_i, theta_r, phi_i + phi, values=values, channels=table.channels, source=table.source, metadata=about)
