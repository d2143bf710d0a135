"""PLY: range grids in (Stanford), meshes in and out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanning.errors import EmptyScanError, FormatError
from scanning.formats.files import content, millimetres, numbers, refuse_absurd, refuse_swapped
from scanning.mesh import TriangleMesh
from scanning.rangeimage import RangeImage

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST = 2**31  # entries of an element, vertices of a mesh


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    counter: str = ""  # type of a list's length; empty for a single value


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    @property
    def is_list(self) -> bool:
        return any(p.counter for p in self.properties)


@dataclass(frozen=True)
class _Header:
    encoding: str
    elements: tuple[_Element, ...]
    info: dict[str, str]
    lines: int
    size: int


def _header(data: bytes, path: str | Path) -> _Header:
    encoding, info, position, line = "", {}, 0, 0
    elements: list[_Element] = []
    while True:
        end = data.find(b"\n", position)
        line += 1
        if end < 0:
            raise FormatError("the header has no end", file=path, line=line, expected="a line `end_header`")
        text = data[position:end].decode("ascii", "backslashreplace").strip()
        position = end + 1
        words = text.split()
        if line == 1:
            if text != "ply":
                raise FormatError(f"starts with {text[:20]!r}", file=path, line=1, expected="`ply`")
            continue
        try:
            match words:
                case ["end_header"]:
                    break
                case ["format", kind, "1.0"] if kind in _ORDERS:
                    encoding = kind
                case ["element", name, count] if 0 <= int(count) < _MOST:
                    elements.append(_Element(name, int(count), ()))
                case ["property", "list", counter, kind, name] if elements and _TYPES[counter][0] in "iu":
                    last = elements[-1]
                    elements[-1] = _Element(last.name, last.count, (*last.properties, _Property(name, _TYPES[kind], _TYPES[counter])))
                case ["property", kind, name] if elements:
                    last = elements[-1]
                    elements[-1] = _Element(last.name, last.count, (*last.properties, _Property(name, _TYPES[kind])))
                case ["obj_info", name, value]:
                    info[name] = value
                case [] | ["comment" | "obj_info", *_] | ["bye"]:  # a stray `bye` stands in some headers of the Stanford set
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError):
            raise FormatError(f"{text[:60]!r} in the header", file=path, line=line, expected="a line of a PLY 1.0 header") from None
    if not encoding:
        raise FormatError("the header names no format", file=path, line=line, expected=f"one of {', '.join(_ORDERS)}")
    for element in elements:
        names = [p.name for p in element.properties]
        if not names or len(set(names)) != len(names):
            raise FormatError(f"element {element.name} has properties {names}", file=path, line=line, expected="at least one, each once")
    return _Header(encoding, tuple(elements), info, line, position)


class _Body:
    """Reads one element after the other from the data behind the header."""

    def __init__(self, data: bytes, header: _Header, path: str | Path) -> None:
        self.path, self.header = path, header
        self.binary = header.encoding != "ascii"
        self.order = _ORDERS[header.encoding]
        self.data = data[header.size :]
        self.values = np.empty(0) if self.binary else numbers(self.data, path, header.lines + 1)
        self.position = 0

    def _short(self, element: _Element) -> FormatError:
        return FormatError(
            f"ends within element {element.name}",
            file=self.path,
            expected=f"{element.count} entries",
            hint="The file is cut off; copy it again",
        )

    def table(self, element: _Element) -> dict[str, NDArray[np.float64]]:
        """Columns of an element without lists."""
        names = [p.name for p in element.properties]
        if self.binary:
            dtype = np.dtype([(p.name, self.order + p.kind) for p in element.properties])
            size = element.count * dtype.itemsize
            if self.position + size > len(self.data):
                raise self._short(element)
            rows = np.frombuffer(self.data, dtype, element.count, self.position)
            self.position += size
            return {name: rows[name].astype(np.float64) for name in names}
        size = element.count * len(names)
        if self.position + size > len(self.values):
            raise self._short(element)
        block = self.values[self.position : self.position + size].reshape(element.count, len(names))
        self.position += size
        return dict(zip(names, block.T, strict=True))

    def lists(self, element: _Element) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Lengths of the entries of an element that is one list, shape (count,), and their items one after the other."""
        if len(element.properties) != 1:
            raise FormatError(f"element {element.name} mixes a list with other properties", file=self.path, expected="one list only")
        entry = element.properties[0]
        if not self.binary:
            return self._text_lists(element)
        counter, item = np.dtype(self.order + entry.counter), np.dtype(self.order + entry.kind)
        triples = np.dtype([("n", counter), ("items", item, (3,))])
        if self.position + element.count * triples.itemsize <= len(self.data):
            rows = np.frombuffer(self.data, triples, element.count, self.position)
            if (rows["n"] == 3).all():  # nearly every mesh
                self.position += element.count * triples.itemsize
                return np.full(element.count, 3), rows["items"].ravel().astype(np.float64)
        lengths, places, position = [], [], self.position
        for _ in range(element.count):
            if position + counter.itemsize > len(self.data):
                raise self._short(element)
            length = int.from_bytes(self.data[position : position + counter.itemsize], "big" if self.order == ">" else "little")
            lengths.append(length)
            places.append(position + counter.itemsize)
            position += counter.itemsize + length * item.itemsize
        if position > len(self.data):
            raise self._short(element)
        self.position = position
        pieces = b"".join(self.data[p : p + n * item.itemsize] for p, n in zip(places, lengths, strict=True) if n)
        return np.array(lengths, dtype=np.int64), np.frombuffer(pieces, item).astype(np.float64)

    def _text_lists(self, element: _Element) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        rest = self.values[self.position :]
        if element.count > len(rest):
            raise self._short(element)
        words, heads, position = rest.tolist(), [], 0
        for _ in range(element.count):
            if position >= len(words):
                raise self._short(element)
            heads.append(position)
            length = words[position]
            if not (length >= 0 and length == int(length)) if np.isfinite(length) else True:
                raise FormatError(
                    f"a list of {length:g} items in element {element.name}", file=self.path, expected="a whole number of them"
                )
            position += 1 + int(length)
        if position > len(words):
            raise self._short(element)
        self.position += position
        head = np.array(heads, dtype=np.int64)
        return rest[head].astype(np.int64), np.delete(rest[:position], head)


def _element(header: _Header, name: str, path: str | Path) -> _Element:
    for element in header.elements:
        if element.name == name:
            return element
    raise FormatError(
        f"no element {name} among {', '.join(e.name for e in header.elements) or 'none'}",
        file=path,
        expected="a range grid (elements vertex and range_grid)" if name == "range_grid" else f"an element {name}",
    )


def _read(path: str | Path, list_name: str) -> tuple[_Header, NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Header, vertices (n, 3), and lengths and items of the lists of one element."""
    data = content(path)
    header = _header(data, path)
    for wanted in ("vertex", list_name):
        _element(header, wanted, path)
    body = _Body(data, header, path)
    vertices, lengths, items = np.empty((0, 3)), np.empty(0, dtype=np.int64), np.empty(0)
    for element in header.elements:
        if element.is_list:
            found = body.lists(element)
            if element.name == list_name:
                lengths, items = found
        else:
            columns = body.table(element)
            if element.name == "vertex":
                if not {"x", "y", "z"} <= columns.keys():
                    raise FormatError(f"vertices have {', '.join(columns)}", file=path, expected="x, y and z")
                vertices = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    if not np.isfinite(vertices).all():
        raise FormatError(f"vertex {int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])} is not finite", file=path)
    wrong = items[~((items >= 0) & (items < len(vertices)) & (items == np.floor(items)))]
    if wrong.size:
        raise FormatError(f"element {list_name} points to vertex {wrong[0]:g}", file=path, expected=f"0 to {len(vertices) - 1}")
    return header, vertices, lengths, items.astype(np.int64)


def read_range_grid(path: str | Path, *, unit: str = "mm") -> RangeImage:
    """Read a range grid: the points that were measured, and a grid of lists of none or one of them.

    Parameters
    ----------
    path : str or Path
        The file, ascii or binary of either byte order.
    unit : str
        Unit of its coordinates: PLY names none. The Stanford scans are in ``m``.

    Raises
    ------
    FormatError
        Where the file is no range grid, is cut off, or contradicts itself.
    EmptyScanError
        Where no point was measured.
    """
    scale = millimetres(unit)
    header, vertices, lengths, items = _read(path, "range_grid")
    try:
        width, height = (int(header.info[name]) for name in ("num_cols", "num_rows"))
    except (KeyError, ValueError):
        raise FormatError(
            "the header does not say how large the grid is", file=path, expected="`obj_info num_cols W` and `obj_info num_rows H`"
        ) from None
    if min(width, height) < 1 or width * height != len(lengths):
        raise FormatError(f"{len(lengths)} entries of the grid", file=path, expected=f"{height} rows x {width} columns = {height * width}")
    if lengths.size and lengths.max() > 1:
        raise FormatError(f"{lengths.max()} points at one place of the grid", file=path, expected="none or one")
    valid = lengths == 1
    if not valid.any():
        raise EmptyScanError("no point was measured", file=path, hint="Scan again, nearer or with more light returned")
    refuse_absurd(vertices, np.ones(len(vertices), dtype=bool), scale, path)
    points = np.full((height * width, 3), np.nan)
    points[valid] = vertices[items] * scale
    refuse_swapped(points, valid, height, width, path, where="the numbers of num_cols and num_rows")
    return RangeImage(points.reshape(height, width, 3), valid.reshape(height, width), str(path))


def read_mesh(path: str | Path, *, unit: str = "mm") -> TriangleMesh:
    """Read a triangle mesh, ascii or binary; its coordinates come out in mm.

    Raises
    ------
    FormatError
        Where the file is cut off, contradicts itself or holds faces that are no triangles.
    """
    scale = millimetres(unit)
    _, vertices, lengths, items = _read(path, "face")
    if (lengths != 3).any():
        raise FormatError(f"a face of {int(lengths[lengths != 3][0])} corners", file=path, expected="triangles only")
    return TriangleMesh(vertices * scale, items.reshape(-1, 3).astype(np.int32))


def write_mesh(path: str | Path, mesh: TriangleMesh, *, comment: str = "") -> None:
    """Write a triangle mesh as binary PLY, mm, 32-bit floats; the folder must be there."""
    header = ["ply", "format binary_little_endian 1.0", "comment unit mm"]
    header += [f"comment {line}" for line in comment.encode("ascii", "backslashreplace").decode().splitlines()]
    header += [f"element vertex {len(mesh.vertices)}", "property float x", "property float y", "property float z"]
    header += [f"element face {len(mesh.triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    faces = np.empty(len(mesh.triangles), dtype=[("n", "u1"), ("corners", "<i4", (3,))])
    faces["n"], faces["corners"] = 3, mesh.triangles
    Path(path).write_bytes("\n".join(header).encode("ascii") + mesh.vertices.astype("<f4").tobytes() + faces.tobytes())
