"""Files of reflectance of any kind as one table of readings, ready to be fitted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fitting.formats.files import listed_of, read_any
from fitting.formats.grid import Brdf, Scattered, readings
from fitting.formats.table_csv import measurements_of_scattered
from fitting.measurements import Measurements

TABLE_AXES = np.arange(15.0, 61, 15), np.arange(0.0, 81, 10), np.array([0.0, 90.0, 180.0])
"""theta_i, theta_r and phi, deg, at which a table of the whole hemisphere is read: the paper's plane at four incidences, and across it."""


def measurements_in(path: Path | str, *, channel: str | None = None, **options: Any) -> Measurements:
    """Read a file of reflectance as readings.

    Parameters
    ----------
    path : Path or str
        Of any kind that `fitting.formats.files.read_any` reads. Lists of readings are taken as they are; tables of the whole hemisphere at
        `TABLE_AXES`, as far as they hold values there.
    channel : str, optional
        Which; may be left out where there is one.
    **options
        As `read_any` takes them.

    Raises
    ------
    TableError
        If the file cannot be read.
    DomainError
        If the channel is not there.
    """
    data = read_any(path, **options)
    if isinstance(data, Brdf):
        data = readings(data)
    elif not isinstance(data, Scattered):
        data = listed_of(data, TABLE_AXES)
    return measurements_of_scattered(data, channel=channel)
