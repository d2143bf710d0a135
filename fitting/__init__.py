"""From readings to reflectance: the micro-structure model of a petal and the models that explain its readings.

Names are loaded when first asked for, so that `import fitting` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fitting.aperture import Aperture
    from fitting.body import BodyTrace, Epidermis, trace_body
    from fitting.cells import CELL_AREA, Cell, Spread
    from fitting.compare import Comparison
    from fitting.errors import DomainError, EnergyError, FitError, ReadingError, TableError
    from fitting.fit import Fit, Prediction, fit_joint
    from fitting.ladder import RUNGS
    from fitting.layers import mixture_from
    from fitting.linear import LinearFit, fit_linear
    from fitting.measurements import Measurements
    from fitting.model import Model
    from fitting.orders import EscapeOrders, escape_orders
    from fitting.paper import TERMS, Quadrature, paper_terms
    from fitting.radiometric import Sampling, basis_tables, paper_terms_any, radiometric_terms
    from fitting.readings import read_csv
    from fitting.reflectance import Reflectance
    from fitting.scattering import Scattering
    from fitting.table import Grid, ReflectanceTable, paper_table, radiometric_table

_HOME = {
    "Aperture": "aperture",
    "BodyTrace": "body",
    "Epidermis": "body",
    "trace_body": "body",
    "CELL_AREA": "cells",
    "Cell": "cells",
    "Spread": "cells",
    "Comparison": "compare",
    "DomainError": "errors",
    "EnergyError": "errors",
    "FitError": "errors",
    "ReadingError": "errors",
    "TableError": "errors",
    "Fit": "fit",
    "Prediction": "fit",
    "fit_joint": "fit",
    "RUNGS": "ladder",
    "LinearFit": "linear",
    "fit_linear": "linear",
    "mixture_from": "layers",
    "Measurements": "measurements",
    "read_csv": "readings",
    "Model": "model",
    "EscapeOrders": "orders",
    "escape_orders": "orders",
    "TERMS": "paper",
    "Quadrature": "paper",
    "paper_terms": "paper",
    "Sampling": "radiometric",
    "basis_tables": "radiometric",
    "paper_terms_any": "radiometric",
    "radiometric_terms": "radiometric",
    "Reflectance": "reflectance",
    "Scattering": "scattering",
    "Grid": "table",
    "ReflectanceTable": "table",
    "paper_table": "table",
    "radiometric_table": "table",
}

__all__ = [
    "CELL_AREA",
    "RUNGS",
    "TERMS",
    "Aperture",
    "BodyTrace",
    "Cell",
    "Comparison",
    "DomainError",
    "EnergyError",
    "Epidermis",
    "EscapeOrders",
    "Fit",
    "FitError",
    "Grid",
    "LinearFit",
    "Measurements",
    "Model",
    "Prediction",
    "Quadrature",
    "ReadingError",
    "Reflectance",
    "ReflectanceTable",
    "Sampling",
    "Scattering",
    "Spread",
    "TableError",
    "basis_tables",
    "escape_orders",
    "fit_joint",
    "fit_linear",
    "mixture_from",
    "paper_table",
    "paper_terms",
    "paper_terms_any",
    "radiometric_table",
    "radiometric_terms",
    "read_csv",
    "trace_body",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
