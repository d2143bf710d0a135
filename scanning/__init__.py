"""Range images of petals into meshes, and meshes into a flower.

Names are loaded when first asked for, so that `import scanning` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scanning.clean import Cleaned, Cleaning
    from scanning.errors import EmptyScanError, FormatError, PetalError, RegistrationError, ScanError
    from scanning.formats import read_range_image
    from scanning.imports import ImportedPetal, ImportFailed, import_scans
    from scanning.mesh import TriangleMesh
    from scanning.petal import Petal, measure_petal
    from scanning.rangeimage import RangeImage
    from scanning.register import Registration, merge

# No name here is a module's, too: the module would hide it once it is loaded.
_HOME = {
    "Cleaned": "clean",
    "Cleaning": "clean",
    "EmptyScanError": "errors",
    "FormatError": "errors",
    "ImportFailed": "imports",
    "ImportedPetal": "imports",
    "Petal": "petal",
    "PetalError": "errors",
    "RangeImage": "rangeimage",
    "Registration": "register",
    "RegistrationError": "errors",
    "ScanError": "errors",
    "TriangleMesh": "mesh",
    "import_scans": "imports",
    "measure_petal": "petal",
    "merge": "register",
    "read_range_image": "formats",
}

__all__ = [
    "Cleaned",
    "Cleaning",
    "EmptyScanError",
    "FormatError",
    "ImportFailed",
    "ImportedPetal",
    "Petal",
    "PetalError",
    "RangeImage",
    "Registration",
    "RegistrationError",
    "ScanError",
    "TriangleMesh",
    "import_scans",
    "measure_petal",
    "merge",
    "read_range_image",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
