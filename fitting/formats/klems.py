"""Matrix BSDF of building science: XML on the patches of Klems (1994), as Radiance and LBNL WINDOW exchange it.

A direction is one of 145 patches (full basis). Radiance's front is WINDOW's back, so what reflects light from the front, the side of the
normal, is "Reflection Back" in the file. The incident patch is named by where its light goes, not where it comes from: a mirror is the
diagonal. After Radiance's bsdf_m.c and bsdf2klems.c.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from xml.parsers import expat
from xml.sax.saxutils import escape

import numpy as np

from fitting.errors import DomainError, TableError
from fitting.formats.grid import Array, Brdf, Function, Quantity, Scattered, ask
from fitting.formats.text import write_lines
from fitting.progress import Progress, silent, stage

Side = Literal["front", "back"]

BASES: Mapping[str, tuple[tuple[float, int], ...]] = {
    "LBNL/Klems Full": ((0, 1), (5, 8), (15, 16), (25, 20), (35, 24), (45, 24), (55, 24), (65, 16), (75, 12), (90, 0)),
    "LBNL/Klems Half": ((0, 1), (6.5, 8), (19.5, 12), (32.5, 16), (46.5, 20), (61.5, 12), (76.5, 4), (90, 0)),
    "LBNL/Klems Quarter": ((0, 1), (9, 8), (27, 12), (46, 12), (66, 8), (90, 0)),
}
"""Rings from the normal outwards: lower bound of theta, deg, and patches; the last is the end."""

_BLOCKS: Mapping[tuple[Quantity, Side], str] = {
    ("brdf", "front"): "Reflection Back",
    ("brdf", "back"): "Reflection Front",
    ("btdf", "front"): "Transmission Back",
    ("btdf", "back"): "Transmission Front",
}
_MOST_PATCHES = 10_000
_DEEPEST = 64


def read_klems(path: Path | str, *, quantity: Quantity = "brdf", side: Side = "front", wavelength: str = "Visible") -> Scattered:
    """Read one matrix of a file.

    Parameters
    ----------
    path : Path or str
        XML of WINDOW, Radiance or another program.
    quantity : {"brdf", "btdf"}
        Reflection or transmission.
    side : {"front", "back"}
        Where the light comes from: Radiance's front, on the normal's side, or its back, which is then turned to it, about the x axis.
    wavelength : str
        What the file calls the band.

    Returns
    -------
    Scattered
        A reading for each pair of patches, at their centres: the mean over both patches, 1/sr.

    Raises
    ------
    TableError
        With the line, if the file is cut, foreign, not a matrix on such patches, does not hold what was asked for, or a number is missing,
        not finite or below 0.
    """
    if (quantity, side) not in _BLOCKS:
        raise DomainError(f"quantity {quantity!r} and side {side!r}: expected brdf or btdf, and front or back")
    root = _parse(path)
    layers = [layer for optical in root.all("Optical") for layer in optical.all("Layer")]
    if root.tag != "WindowElement" or not layers:
        raise TableError(path, f"root element is {root.tag!a}, expected WindowElement with Optical and Layer: not a BSDF file", root.line)
    definition = layers[0].one(path, "DataDefinition")
    structure = definition.one(path, "IncidentDataStructure")
    if structure.words not in ("Columns", "Rows"):
        expected = "Columns or Rows; make a matrix of a tensor tree with Radiance's bsdf2klems"
        raise TableError(path, f"IncidentDataStructure is {structure.words[:40]!a}, expected {expected}", structure.line)
    block, others = _block(path, layers[0], _BLOCKS[quantity, side], wavelength)
    data = block.one(path, "ScatteringData")
    kind = block.one(path, "ScatteringDataType")
    if kind.words not in ("BTDF", "BRDF", "BSDF"):
        raise TableError(path, f"ScatteringDataType is {kind.words[:40]!a}, expected BTDF or BRDF, in 1/sr", kind.line)
    incident = _rings(path, definition, block.one(path, "ColumnAngleBasis"))
    exiting = _rings(path, definition, block.one(path, "RowAngleBasis"))
    (theta_i, light), (theta_r, phi_r) = _centres(incident), _centres(exiting)
    values = _numbers(path, data, theta_i.size * theta_r.size)
    # Columns: one exiting patch after another, each with all incident ones
    matrix = values.reshape(theta_r.size, theta_i.size) if structure.words == "Columns" else values.reshape(theta_i.size, theta_r.size).T
    phi_i = (light + 180) % 360
    if side == "back":
        phi_i, phi_r = (360 - phi_i) % 360, (360 - phi_r) % 360
    if quantity == "btdf":
        theta_r = 180 - theta_r
    return Scattered(
        np.repeat(theta_i, theta_r.size),
        np.repeat(phi_i, theta_r.size),
        np.tile(theta_r, theta_i.size),
        np.tile(phi_r, theta_i.size),
        values=matrix.T.reshape(-1, 1),
        quantity=quantity,
        source=str(path),
        metadata={"side": side, "wavelength": wavelength, "direction": _BLOCKS[quantity, side], "others": others},
    )


def write_klems(
    path: Path | str,
    reflected: Function | Brdf | None,
    *,
    transmitted: Function | Brdf | None = None,
    basis: str = "LBNL/Klems Full",
    samples: int = 4,
    name: str = "petal",
    manufacturer: str = "",
    progress: Progress = silent,
) -> None:
    """Write a matrix that Radiance loads as a material.

    Each number is the mean over the two patches, by projected solid angle, which keeps the energy. Patches are 10 deg wide or more: this
    is for daylighting, not for fitting; lobes narrower than a patch are blurred.

    Parameters
    ----------
    path : Path or str
        The file; what is there is replaced.
    reflected : callable or isotropic Brdf, or None
        f(theta_i, theta_r, phi), 1/sr, for light from the front, up to 90 deg. None where only what goes through is known: the file then
        says nothing of reflection.
    transmitted : callable or isotropic Brdf, optional
        The same for light that goes through, theta_r from 90 to 180 deg.
    basis : str
        One of `BASES`.
    samples : int
        Of each patch in theta and in phi: samples^4 are taken for each number.
    name, manufacturer : str
        Of the material.
    progress : callable
        See `fitting.progress`: with a table that is slow to look up it takes seconds.

    Raises
    ------
    TableError
        If it cannot be written.
    DomainError
        If a function is no BRDF up to 90 deg, a grid is not isotropic, or the basis is unknown.
    """
    if basis not in BASES or samples < 1:
        raise DomainError(f"basis {basis!r} and {samples} samples: expected {', '.join(BASES)}, and 1 or more")
    if reflected is None and transmitted is None:
        raise DomainError("neither what is reflected nor what goes through was given")
    for given in (reflected, transmitted):
        if isinstance(given, Brdf) and given.phi_i_deg is not None:
            raise DomainError(f"{given.source}: is not isotropic; it would be written as if its first phi_i stood for all")
    middle = 1.0 if transmitted is None else 0.0 if reflected is None else 0.5
    blocks = {}
    if reflected is not None:
        blocks["Reflection Back"] = _averaged(reflected, BASES[basis], samples, stage(progress, 0, middle), through=False)
    if transmitted is not None:
        blocks["Transmission Back"] = _averaged(transmitted, BASES[basis], samples, stage(progress, middle, 1), through=True)
    write_lines(path, _written(blocks, basis, name, manufacturer))


def _averaged(function: Function, rings: tuple[tuple[float, int], ...], samples: int, progress: Progress, *, through: bool) -> Array:
    """Mean over pairs of patches, of shape (exiting, incident)."""
    theta, phi = _spread(rings, samples)  # (patch, sample)
    theta_r = 180 - theta if through else theta
    matrix = np.empty((len(theta), len(theta)))
    for k in range(len(theta)):
        difference = phi.ravel() - (phi[k, :, None] + 180)
        values = ask(function, theta[k, :, None], theta_r.ravel(), difference)[..., 0]
        matrix[:, k] = values.reshape(values.shape[0], *theta.shape).mean(axis=(0, 2))
        progress((k + 1) / len(theta))
    return matrix


def _spread(rings: tuple[tuple[float, int], ...], samples: int) -> tuple[Array, Array]:
    """Directions evenly over each patch's projected solid angle, deg, each of shape (patch, samples^2)."""
    at = (np.arange(samples) + 0.5) / samples
    theta, phi = [], []
    for (low, count), (high, _) in pairwise(rings):
        squares = np.sin(np.radians([low, high])) ** 2
        polar = np.degrees(np.arcsin(np.sqrt(squares[0] + at * (squares[1] - squares[0]))))
        for patch in range(count):
            azimuth = (patch + at - 0.5) * 360 / count
            theta.append(np.repeat(polar, samples))
            phi.append(np.tile(azimuth, samples))
    return np.array(theta), np.array(phi)


def _centres(rings: tuple[tuple[float, int], ...]) -> tuple[Array, Array]:
    """Directions that stand for the patches, deg; azimuths as the basis counts them."""
    theta, phi = [], []
    for (low, count), (high, _) in pairwise(rings):
        theta += [0.0 if count == 1 and low == 0 else (low + high) / 2] * count
        phi += [patch * 360 / count for patch in range(count)]
    return np.array(theta), np.array(phi)


def _written(blocks: Mapping[str, Array], basis: str, name: str, manufacturer: str) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield '<WindowElement xmlns="http://windows.lbl.gov" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
    yield ' xsi:schemaLocation="http://windows.lbl.gov/BSDF-v1.4.xsd">'
    yield "<WindowElementType>System</WindowElementType>"
    yield "<FileType>BSDF</FileType>"
    yield "<Optical><Layer>"
    yield f"<Material><Name>{_text(name)}</Name><Manufacturer>{_text(manufacturer)}</Manufacturer><DeviceType>Other</DeviceType></Material>"
    yield "<DataDefinition>"
    yield "<IncidentDataStructure>Columns</IncidentDataStructure>"
    yield f"<AngleBasis><AngleBasisName>{basis}</AngleBasisName>"
    rings = BASES[basis]
    for (low, count), (high, _) in pairwise(rings):
        bounds = f"<ThetaBounds><LowerTheta>{low:g}</LowerTheta><UpperTheta>{high:g}</UpperTheta></ThetaBounds>"
        yield f"<AngleBasisBlock><Theta>{(low + high) / 2 if low else 0:g}</Theta><nPhis>{count}</nPhis>{bounds}</AngleBasisBlock>"
    yield "</AngleBasis>"
    yield "</DataDefinition>"
    for direction, matrix in blocks.items():
        yield "<WavelengthData>"
        yield "<LayerNumber>System</LayerNumber>"
        yield '<Wavelength unit="Integral">Visible</Wavelength>'
        yield "<SourceSpectrum>CIE Illuminant D65 1nm.ssp</SourceSpectrum>"
        yield "<DetectorSpectrum>ASTM E308 1931 Y.dsp</DetectorSpectrum>"
        yield "<WavelengthDataBlock>"
        yield f"<WavelengthDataDirection>{direction}</WavelengthDataDirection>"
        yield f"<ColumnAngleBasis>{basis}</ColumnAngleBasis>"
        yield f"<RowAngleBasis>{basis}</RowAngleBasis>"
        yield "<ScatteringDataType>BTDF</ScatteringDataType>"  # for reflection too: Radiance takes no other
        yield "<ScatteringData>"
        for row in matrix.tolist():
            yield " ".join(f"{value:.6e}" for value in row)
        yield "</ScatteringData>"
        yield "</WavelengthDataBlock>"
        yield "</WavelengthData>"
    yield "</Layer></Optical>"
    yield "</WindowElement>"


def _text(text: str) -> str:
    return escape(" ".join("".join(c if c.isprintable() else " " for c in text).split()))


@dataclass
class _Element:
    """An element, its line, its text and its children; names without their namespace."""

    tag: str
    line: int
    text: list[str] = field(default_factory=list)
    children: list[_Element] = field(default_factory=list)

    @property
    def words(self) -> str:
        return " ".join("".join(self.text).split())

    def all(self, tag: str) -> list[_Element]:
        return [child for child in self.children if child.tag == tag]

    def one(self, path: Path | str, tag: str) -> _Element:
        found = self.all(tag)
        if not found:
            raise TableError(path, f"no {tag} in {self.tag}", self.line)
        return found[0]


def _parse(path: Path | str) -> _Element:
    """Read the elements of an XML file; no document type and no entities, which such files do not need."""
    top = _Element("", 0)
    open_elements = [top]
    parser = expat.ParserCreate(namespace_separator=" ")
    parser.buffer_text = True

    def start(name: str, _: dict[str, Any]) -> None:
        if len(open_elements) > _DEEPEST:
            raise TableError(path, f"elements more than {_DEEPEST} deep: not a BSDF file", parser.CurrentLineNumber)
        element = _Element(name.rpartition(" ")[2], parser.CurrentLineNumber)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        open_elements.pop()

    def text(characters: str) -> None:
        open_elements[-1].text.append(characters)

    def doctype(*_: object) -> None:
        raise TableError(path, "has a document type declaration, which a BSDF file does not need", parser.CurrentLineNumber)

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text
    parser.StartDoctypeDeclHandler = doctype
    try:
        with Path(path).open("rb") as file:
            parser.ParseFile(file)
    except OSError as error:
        raise TableError(path, f"cannot be read: {error.strerror or error}") from error
    except expat.ExpatError as error:
        raise TableError(path, f"is not whole XML: {expat.ErrorString(error.code)}", error.lineno) from error
    except (ValueError, LookupError) as error:  # an encoding that Python does not know
        raise TableError(path, f"is not XML that can be read: {error}") from error
    return top.children[0]


def _block(path: Path | str, layer: _Element, direction: str, wavelength: str) -> tuple[_Element, list[str]]:
    """Find one direction and band, and the names of the others."""
    there: list[str] = []
    wanted: _Element | None = None
    for data in layer.all("WavelengthData"):
        band = data.one(path, "Wavelength").words
        for block in data.all("WavelengthDataBlock"):
            found = block.one(path, "WavelengthDataDirection").words
            if wanted is None and found == direction and band.lower() == wavelength.lower():
                wanted = block
            else:
                there.append(f"{found} ({band})")
    if wanted is not None:
        return wanted, there
    raise TableError(path, f"no {direction} ({wavelength}); there is {', '.join(there)[:200] or 'no data'}", layer.line)


def _rings(path: Path | str, definition: _Element, wanted: _Element) -> tuple[tuple[float, int], ...]:
    """Rings of a basis: those that the file lists, else the known ones."""
    for basis in definition.all("AngleBasis"):
        if basis.one(path, "AngleBasisName").words != wanted.words or not (blocks := basis.all("AngleBasisBlock")):
            continue
        rings: list[tuple[float, int]] = []
        expected = 0.0
        for block in blocks:
            bounds = block.one(path, "ThetaBounds")
            low, high = (_number(path, bounds.one(path, name)) for name in ("LowerTheta", "UpperTheta"))
            count = _number(path, block.one(path, "nPhis"))
            if low != expected or not low < high <= 90 or count != int(count) or not 1 <= count <= _MOST_PATCHES:
                raise TableError(
                    path, f"ring of {low:g} to {high:g} deg with {count:g} patches, expected to go on at {expected:g}", block.line
                )
            rings.append((low, int(count)))
            expected = high
        if sum(count for _, count in rings) > _MOST_PATCHES:
            raise TableError(path, f"more than {_MOST_PATCHES} patches", basis.line)
        if expected != 90:
            raise TableError(path, f"the basis ends at {expected:g} deg, expected 90", basis.line)
        return (*rings, (90.0, 0))
    if wanted.words not in BASES:
        raise TableError(path, f"angle basis {wanted.words[:60]!a} is neither listed nor known; known are {', '.join(BASES)}", wanted.line)
    return BASES[wanted.words]


def _number(path: Path | str, element: _Element) -> float:
    return float(_numbers(path, element, 1)[0])


def _numbers(path: Path | str, element: _Element, count: int) -> Array:
    """Read an element's numbers, with the line of the first that is none."""
    text = "".join(element.text)
    words = text.replace(",", " ").split()
    if len(words) != count:
        raise TableError(path, f"{element.tag} holds {len(words)} numbers, expected {count}", element.line)
    try:
        values = np.array(words, dtype=float)
        if np.all(np.isfinite(values) & (values >= 0)):
            return values
    except ValueError:
        pass
    for offset, line in enumerate(text.split("\n")):
        for word in line.replace(",", " ").split():
            if not _is_good(word):
                raise TableError(path, f"{element.tag} holds {word[:40]!a}, expected finite numbers of 0 or more", element.line + offset)
    raise TableError(path, f"{element.tag} holds something other than numbers", element.line)


def _is_good(word: str) -> bool:
    try:
        return 0 <= float(word) < np.inf
    except ValueError:
        return False
