"""Instruments over serial lines and sockets: rotary stages and light sensors, in degrees and SI units.

The port, the codecs and the instruments live in the modules below; this one only names what can go wrong, so that
importing it costs nothing.
"""

from drivers.errors import (
    BadChecksum,
    CatalogueError,
    DeviceError,
    DeviceFault,
    InvalidSetting,
    MoveTimeout,
    NotHomed,
    PortClosed,
    TransportTimeout,
    UnexpectedReply,
    UnknownModel,
)

__all__ = [
    "BadChecksum",
    "CatalogueError",
    "DeviceError",
    "DeviceFault",
    "InvalidSetting",
    "MoveTimeout",
    "NotHomed",
    "PortClosed",
    "TransportTimeout",
    "UnexpectedReply",
    "UnknownModel",
]
