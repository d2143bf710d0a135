"""The paper's figures 11, 13 and 14: a petal's polygons, the flower with a detail, and the four cultivars' highlights."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.contrasts import compare, contrast_table
from rig.figures import saved_figure
from rig.pictures import frame, shade_of, show, take

if TYPE_CHECKING:
    from rig.fits import StoredFit
    from rig.workspace import Workspace

SIDE = 640
DETAIL = 0.28
"""Side of figure 13's box, as a part of the picture's."""


def draw_flower(
    flower: Path, fits: "Mapping[str, StoredFit]", folder: Path, *, marks: Sequence[str], workspace: "Workspace", side: int = SIDE
) -> tuple[list[Path], str]:
    """Draw figures 11, 13 and 14 as PNG into `folder`; return the files and the table of contrasts.

    Parameters
    ----------
    flower : Path
        An assembled flower.
    fits : mapping of cultivar (BR, RR, PR, WR) to its fit
    folder : Path
        Made where it is not there.
    marks : sequence of str
        What every figure must say of itself; see `rig.pictures.marks_of`.
    workspace : Workspace
        Keeps the reflection models.
    side : int
        Of the ray-cast pictures, pixels.
    """
    from render.camera import Box
    from render.images import boxed
    from render.raycast import Raycaster
    from render.scene import read_flower, read_mesh

    folder.mkdir(parents=True, exist_ok=True)
    scene = read_flower(flower)
    raycaster, shade = Raycaster(scene), shade_of(fits["RR"], workspace)
    camera = frame(raycaster, side, side)
    written = [folder / f"figure-{number}.png" for number in (11, 13, 14)]

    with saved_figure((9, 4.4), [written[0]], marks) as figure:
        first = sorted(flower.glob("petals/*/mesh.ply"))[0]
        _polygons(figure, read_mesh(first), first.parent.name)

    picture = take(raycaster, camera, shade)
    whole = show(picture, "RR")
    part = round(side * DETAIL)
    box = Box(*_brightest(picture.radiance, part), part, part)
    detail = show(take(raycaster, camera.detail(box, enlarge=side / part), shade), "RR")
    with saved_figure((9, 4.8), [written[1]], marks) as figure:
        _images(figure, {"RR": boxed(whole, box), f"detail, {side / part:.1f} times": detail})

    pictures, rows, matt = compare(raycaster, camera, fits, workspace)
    images = {f"{r.label}: C {r.C:.2f}, I(+40)/I(-40) {r.measured:.2f}": show(pictures[r.label], r.label) for r in rows}
    with saved_figure((9, 9.4), [written[2]], marks) as figure:
        _images(figure, images)
    return written, contrast_table(rows, matt)


def _polygons(figure: Any, mesh: Any, name: str) -> None:
    """Draw a petal's triangles, thinned so that they can be told apart, and some of them enlarged."""
    vertices, triangles = mesh.vertices, mesh.triangles
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.9, bottom=0.1, wspace=0.15)
    left.triplot(vertices[:, 0], vertices[:, 1], triangles, linewidth=0.12, color="#333333")
    middle = vertices[:, :2].mean(axis=0)
    half = 0.08 * np.ptp(vertices[:, :2], axis=0).max()
    left.add_patch(_square(middle, half))
    right.triplot(vertices[:, 0], vertices[:, 1], triangles, linewidth=0.6, color="#333333")
    right.set_xlim(middle[0] - half, middle[0] + half)
    right.set_ylim(middle[1] - half, middle[1] + half)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_xlabel("x, mm")
    left.set_ylabel("y, mm")
    figure.text(0.01, 0.975, f"petal {name}: {len(vertices)} points, {len(triangles)} triangles", va="top")


def _square(middle: Any, half: float) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle(middle - half, 2 * half, 2 * half, fill=False, color="#D55E00", linewidth=1.2)


def _brightest(radiance: Any, side: int) -> tuple[int, int]:
    """Return left and top of the square of `side` pixels that has most light in it."""
    light = radiance.cumsum(axis=0, dtype=float).cumsum(axis=1)
    total = np.pad(light, ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    top, left = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return int(left), int(top)


def _images(figure: Any, images: Mapping[str, Any]) -> None:
    """Show images side by side, two a row, each under its name."""
    rows = (len(images) + 1) // 2
    grid = figure.subplots(rows, 2, squeeze=False)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.9 if rows == 1 else 0.93, bottom=0.01, wspace=0.02, hspace=0.08)
    for axes, (name, image) in zip(grid.flat, images.items(), strict=False):
        axes.imshow(image)
        axes.set_title(name, fontsize=9)
        axes.axis("off")
