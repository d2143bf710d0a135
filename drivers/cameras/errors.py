"""What can go wrong between a picture and a reading."""

from __future__ import annotations

from drivers.errors import DeviceError, UnexpectedReply


class BadFrame(UnexpectedReply):
    """A file that gives no frame. Raise one of its children."""


class NotRaw(BadFrame):
    """Not a RAW file that LibRaw knows: a JPEG beside the RAW, or something foreign."""


class IncompleteFrame(BadFrame):
    """A RAW file that is cut short or damaged; one that is still being written looks the same."""


class UnusableFrame(BadFrame):
    """A whole RAW file that cannot be measured with: without exposure time, of unusable levels, or not of a Bayer mosaic."""


class PatchNotFound(DeviceError):
    """The place to be measured is not in the picture: a marker or the chart is missing, or a rectangle reaches beyond the edge."""
