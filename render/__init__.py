"""Pictures of the flower with the measured reflectance.

Names are loaded when first asked for, so that `import render` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from render.camera import Box, Camera
    from render.contrast import Contrast, measure_contrast
    from render.errors import RenderError
    from render.images import boxed, develop, exposure, write_exr, write_png
    from render.light import DistantLight, NearLight
    from render.raycast import Lambert, Picture, Raycaster
    from render.scene import Mesh, Scene, read_flower, read_mesh, read_state

_HOME = {
    "Box": "camera",
    "Camera": "camera",
    "Contrast": "contrast",
    "DistantLight": "light",
    "Lambert": "raycast",
    "Mesh": "scene",
    "NearLight": "light",
    "Picture": "raycast",
    "Raycaster": "raycast",
    "RenderError": "errors",
    "Scene": "scene",
    "boxed": "images",
    "develop": "images",
    "exposure": "images",
    "measure_contrast": "contrast",
    "read_flower": "scene",
    "read_state": "scene",
    "read_mesh": "scene",
    "write_exr": "images",
    "write_png": "images",
}

__all__ = [
    "Box",
    "Camera",
    "Contrast",
    "DistantLight",
    "Lambert",
    "Mesh",
    "NearLight",
    "Picture",
    "Raycaster",
    "RenderError",
    "Scene",
    "boxed",
    "develop",
    "exposure",
    "measure_contrast",
    "read_flower",
    "read_mesh",
    "read_state",
    "write_exr",
    "write_png",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
