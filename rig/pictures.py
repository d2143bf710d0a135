"""The flower with a fitted reflectance: from flower folder and fit to a picture."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.errors import RunError
from rig.figures import SIMULATED
from rig.fits import StoredFit, latest_fit, list_fits, read_fit
from rig.models import stored_model
from rig.workspace import Workspace

if TYPE_CHECKING:
    from fitting.reflectance import Reflectance
    from render.camera import Camera
    from render.light import Light
    from render.raycast import Picture, Raycaster, Shading

COLOURS = {"BR": (0.42, 0.02, 0.06), "RR": (0.85, 0.04, 0.06), "PR": (0.98, 0.55, 0.66), "WR": (0.98, 0.97, 0.90)}
"""Hues to show the cultivars in: the model has no colour yet, so these are for the eye only."""

BACKGROUND = 0.2
"""Linear grey behind the flower: on black, its own shadows would have no outline."""

MARK = (140, 0, 0)

ABOVE = (0.4, -0.6, 0.85)
"""From where the flower is seen by default: from the front, a good way above its horizon."""


def find_fit(fits: Path, wanted: str) -> StoredFit:
    """Return the fit that `wanted` names: a cultivar's newest, a stored fit's name, or a file."""
    if Path(wanted).is_file():
        return read_fit(Path(wanted))
    stored = {fit.id: fit for fit in list_fits(fits)}
    if wanted in stored:
        return stored[wanted]
    if any(fit.label == wanted for fit in stored.values()):
        return latest_fit(fits, wanted)
    raise RunError(
        f"no fit {wanted!r} in {fits}; give a cultivar that has one, a fit's name or its file (`rig fit --cultivar RR` makes one)"
    )


def is_simulated(flower: Path) -> bool:
    """Tell whether the petals of `flower` are virtual."""
    try:
        return bool(tomllib.loads((flower / "flower.toml").read_text(encoding="utf-8")).get("simulated", False))
    except (OSError, tomllib.TOMLDecodeError) as exc:
        raise RunError(f"{flower / 'flower.toml'}: cannot be read: {exc}; a flower's folder was expected") from exc


def marks_of(flower: Path, *fits: StoredFit) -> list[str]:
    """Return what every picture of `flower` with `fits` must say of itself: that it is simulated, that petals intersect."""
    from render.scene import read_state

    marks = [SIMULATED] if is_simulated(flower) or any(fit.simulated for fit in fits) else []
    return marks if read_state(flower) == "free" else [*marks, "PETALS INTERSECT"]


def marked(image: Any, marks: Sequence[str]) -> Any:
    """Return the image with marks written into its corner."""
    import cv2

    size = image.shape[1] / 800
    place, font = (round(14 * size), round(34 * size)), cv2.FONT_HERSHEY_SIMPLEX
    return cv2.putText(image.copy(), ", ".join(marks), place, font, size, MARK, 2) if marks else image


def shade_of(fit: StoredFit, workspace: Workspace) -> "Reflectance":
    """Return the fitted intensity for any direction; the paper's model is kept in the workspace, the others are tabulated anew."""
    from fitting.ladder import dome

    shape = fit.fit.shape
    if fit.fit.model == "paper":
        model = stored_model(workspace, "paper", dome(shape), n_us=shape["n_us"], n_ss=shape["n_ss"])
        return model.reflectance(**fit.fit.x)
    return fit.fit.tabulated()


def frame(raycaster: "Raycaster", width: int, height: int, towards: tuple[float, float, float] = ABOVE) -> "Camera":
    """Return a camera that has the whole flower in view."""
    from render.camera import Camera

    return Camera.framing(raycaster.scene.vertices, towards, width=width, height=height)


def take(raycaster: "Raycaster", camera: "Camera", shade: "Shading", *, light: "Light | None" = None, samples: int = 4) -> "Picture":
    """Take a picture, lit as the paper's are unless `light` says otherwise."""
    return raycaster.picture(camera, shade, light=light, samples=samples)


def show(picture: "Picture", label: str) -> Any:
    """Return the picture as 8-bit sRGB in the cultivar's hue, exposed for itself."""
    from render.images import develop, exposure

    return develop(picture, exposure(picture), colour=COLOURS.get(label, (1.0, 1.0, 1.0)), background=BACKGROUND)
