"""From readings to reflectance: the micro-structure model of a petal and the mixture that explains its readings.

Names are loaded when first asked for, so that `import fitting` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitting.cells import CELL_AREA, Dome
    from fitting.errors import DomainError, FitError, ReadingError, TableError
    from fitting.measurements import Measurements, read_csv
    from fitting.mixture import MixtureFit, fit_mixture
    from fitting.paper import TERMS, Quadrature, paper_terms

_HOME = {
    "CELL_AREA": "cells",
    "Dome": "cells",
    "DomainError": "errors",
    "FitError": "errors",
    "ReadingError": "errors",
    "TableError": "errors",
    "Measurements": "measurements",
    "read_csv": "measurements",
    "MixtureFit": "mixture",
    "fit_mixture": "mixture",
    "TERMS": "paper",
    "Quadrature": "paper",
    "paper_terms": "paper",
}

__all__ = [
    "CELL_AREA",
    "TERMS",
    "DomainError",
    "Dome",
    "FitError",
    "Measurements",
    "MixtureFit",
    "Quadrature",
    "ReadingError",
    "TableError",
    "fit_mixture",
    "paper_terms",
    "read_csv",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
