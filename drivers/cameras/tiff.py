"""The little that must be known of a RAW file before it is decoded: whether it is all there, and which camera made it.

Most RAW formats (DNG, NEF, ARW, CR2, PEF, ...) are TIFF files; of any other nothing is said. Source: TIFF 6.0, Exif 2.3, DNG 1.4.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

_BYTE_ORDERS = {b"II": "<", b"MM": ">"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 7: 1, 13: 4}
_MAKE, _MODEL, _BODY_SERIAL, _CAMERA_SERIAL = 271, 272, 42033, 50735
_EXIF, _SUB_IFDS = 34665, 330
_DATA = ((273, 279), (324, 325))  # offsets and byte counts of strips, and of tiles
_DIRECTORIES, _ENTRIES, _VALUES = 32, 1000, 1 << 20  # a mutilated file must not keep anybody busy


@dataclass(frozen=True)
class Outline:
    """What a TIFF file says about itself.

    Attributes
    ----------
    size : int
        Bytes that its directories and the image data they point to need.
    make, model, serial_number : str
        Empty where it does not say.
    """

    size: int
    make: str = ""
    model: str = ""
    serial_number: str = ""


def outline(data: bytes) -> Outline | None:
    """Read the directories of a TIFF file that may be cut short; None if it is no TIFF file."""
    order = _BYTE_ORDERS.get(data[:2])
    if order is None or len(data) < 8 or data[2:4] not in (struct.pack(f"{order}H", 42), b"RO", b"RS", b"U\0"):
        return None
    texts: dict[int, str] = {}
    size = 8
    waiting = [int(struct.unpack_from(f"{order}I", data, 4)[0])]
    seen: set[int] = set()
    while waiting and len(seen) < _DIRECTORIES:
        offset = waiting.pop(0)
        if offset == 0 or offset in seen:
            continue
        seen.add(offset)
        if offset + 2 > len(data):
            size = max(size, offset + 2)
            continue
        count = int(struct.unpack_from(f"{order}H", data, offset)[0])
        end = offset + 2 + 12 * count
        size = max(size, end)
        if count > _ENTRIES or end > len(data):
            continue
        fields: dict[int, list[int]] = {}
        for tag, kind, number, place in _entries(data, offset, count, order):
            length = _SIZES.get(kind, 0) * number
            size = max(size, place + length) if number <= _VALUES else size
            if not length or number > _VALUES or place + length > len(data):
                continue
            if kind == 2 and tag in (_MAKE, _MODEL, _BODY_SERIAL, _CAMERA_SERIAL):
                texts.setdefault(tag, data[place : place + length].split(b"\0")[0].decode("ascii", "replace").strip())
            elif kind in (3, 4, 13):
                fields[tag] = list(struct.unpack_from(f"{order}{number}{'H' if kind == 3 else 'I'}", data, place))
        waiting += fields.get(_EXIF, []) + fields.get(_SUB_IFDS, [])
        if end + 4 <= len(data):
            waiting += struct.unpack_from(f"{order}I", data, end)
        for offsets, counts in _DATA:
            for begin, length in zip(fields.get(offsets, []), fields.get(counts, []), strict=False):
                if begin != 0xFFFFFFFF:  # Panasonic's way to say that it stands elsewhere
                    size = max(size, begin + length)
    serial_number = texts.get(_CAMERA_SERIAL) or texts.get(_BODY_SERIAL, "")
    return Outline(size, texts.get(_MAKE, ""), texts.get(_MODEL, ""), serial_number)


def _entries(data: bytes, offset: int, count: int, order: str) -> Iterator[tuple[int, int, int, int]]:
    """Tag, type, number of values, and where the values stand."""
    for index in range(count):
        entry = offset + 2 + 12 * index
        tag, kind, number, place = struct.unpack_from(f"{order}HHII", data, entry)
        yield tag, kind, number, entry + 8 if _SIZES.get(kind, 8) * number <= 4 else place
