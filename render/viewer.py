"""A page on this machine that shows the flower, to be turned and looked at from all sides."""

from __future__ import annotations

import contextlib
import io
import re
import socket
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import RenderError

if TYPE_CHECKING:
    import viser

# Whoever reaches the page can move petals and save: nobody but this machine may.
HOST = "127.0.0.1"
PETAL_COLOUR = (0.85, 0.30, 0.43)  # linear red, green, blue, 0 to 1
_BACKGROUND = 200  # grey: pale petals must stand out as well as dark ones
_FIELD_OF_VIEW = 45.0  # degrees, vertical
_TOWARDS_VIEWER = np.array([1.0, -1.2, 1.0])

Rgb = tuple[int, int, int]
Hue = tuple[float, float, float]
PetalArrays = tuple[ArrayLike, ArrayLike, ArrayLike]
COLLIDING: Rgb = (214, 74, 0)


@dataclass(frozen=True)
class Petal:
    """One petal as the pages hold it.

    Attributes
    ----------
    vertices : ndarray, shape (V, 3)
        mm, in the petal's scan frame.
    faces : ndarray of int, shape (F, 3)
    pose : ndarray, shape (4, 4)
        ``T_flower_scan``.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    pose: NDArray[np.float64]


class Page:
    """A page being served; it can be used with ``with``.

    Attributes
    ----------
    url : str
        Address of the page, on this machine only.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._closed = threading.Event()
        self.url = f"http://{HOST}:{server.get_port()}"

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the page is closed, from another thread; control-C ends the waiting as usual. Returns whether it is closed."""
        return self._closed.wait(timeout_s)

    def close(self) -> None:
        """Stop serving; a second time does nothing."""
        if not self._closed.is_set():
            with contextlib.redirect_stdout(io.StringIO()):
                self._server.stop()
            self._closed.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def serve_viewer(
    petals: Mapping[str, PetalArrays],
    *,
    title: str = "Flower",
    port: int = 0,
    colours: Mapping[str, Rgb] | None = None,
    hue: Hue | None = None,
    notes: Sequence[str] = (),
) -> Page:
    """Show a flower on a page of this machine.

    Parameters
    ----------
    petals : mapping
        Petal's name to vertices (V, 3) in mm in the scan frame, faces (F, 3), and ``T_flower_scan`` (4, 4).
    title : str
        Heading of the page.
    port : int
        TCP port; 0 takes a free one.
    colours : mapping, optional
        Petal's name to red, green, blue, 0 to 255; for those that are not to have the flower's.
    hue : tuple of float, optional
        The flower's linear red, green, blue, 0 to 1, as for pictures; else pink.
    notes : sequence of str
        Lines to show beside the flower.

    Returns
    -------
    Page
        Already serving.

    Raises
    ------
    RenderError
        The optional viewer is not installed, the port is taken, or a petal's arrays are not a mesh and a rigid motion.
    """
    flower = checked(petals)
    chosen = petal_colours(flower, hue or PETAL_COLOUR)
    if unknown := sorted(set(colours or {}) - set(flower)):
        raise RenderError(f"colours are given for {', '.join(unknown)}, but the flower's petals are {', '.join(flower)}")
    chosen.update(colours or {})
    server = open_server(title, port)
    for name, petal in flower.items():
        add_petal(server, name, petal, chosen[name])
    aim_camera(server, flower)
    add_notes(server, [f"{len(flower)} petals", *notes])
    server.gui.add_markdown("Drag to turn, right drag to shift, wheel to come closer.")
    return Page(server)


def open_server(title: str, port: int) -> viser.ViserServer:
    """Start an empty page with the flower's axis upwards, on this machine only.

    Raises
    ------
    RenderError
        The optional viewer is not installed, or the port is taken.
    """
    try:
        import viser
    except ImportError as error:
        raise RenderError("the viewer's page needs the optional package viser; install it with: pip install 'petal-rig[viewer]'") from error

    # Viser tries the next thousand ports without a word; a port that was asked for must be the one served.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise RenderError(
                f"the page cannot be served on port {port} of {HOST}: {error}; choose another one, or 0 for a free one"
            ) from error
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = viser.ViserServer(host=HOST, port=port, label=title, verbose=False)
        if port and server.get_port() != port:
            server.stop()
            raise RenderError(f"port {port} of {HOST} was taken in the meantime; choose another one, or 0 for a free one")
    # Its share button would open a tunnel for the whole world; a client may ask for it without the button, too.
    server.__dict__["request_share_url"] = _no_sharing
    server.scene.set_background_image(np.full((2, 2, 3), _BACKGROUND, dtype=np.uint8))
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
    return server


def add_notes(server: viser.ViserServer, notes: Sequence[str]) -> None:
    """Show lines of text as they are, each a paragraph of its own."""
    if notes:
        server.gui.add_markdown("\n\n".join(re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", note) for note in notes))


def add_petal(server: viser.ViserServer, name: str, petal: Petal, colour: Rgb, origin: ArrayLike = (0.0, 0.0, 0.0)) -> viser.MeshHandle:
    """Add a petal's mesh to the page, both faces visible; the node's own origin is `origin` (3,), in the scan frame."""
    rotation, position = node_pose(petal.pose, origin)
    return server.scene.add_mesh_simple(
        f"/petals/{name}",
        petal.vertices - np.asarray(origin),
        petal.faces,
        color=colour,
        side="double",
        wxyz=rotation,
        position=position,
    )


def node_pose(T_flower_scan: NDArray[np.float64], origin: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit quaternion (w, x, y, z) and position of a node at `origin` (3,) of the scan frame."""
    from viser import transforms

    rotation = np.asarray(transforms.SO3.from_matrix(T_flower_scan[:3, :3]).wxyz, dtype=np.float64)
    return rotation, T_flower_scan[:3, :3] @ np.asarray(origin, dtype=float) + T_flower_scan[:3, 3]


def aim_camera(server: viser.ViserServer, flower: Mapping[str, Petal]) -> None:
    """Have every new visitor see the whole flower, from above and aside."""
    centre, radius = bounds(flower)
    camera = server.initial_camera
    camera.fov = np.radians(_FIELD_OF_VIEW)
    camera.up = np.array([0.0, 0.0, 1.0])
    camera.look_at = centre
    distance = 1.1 * radius / np.sin(np.radians(_FIELD_OF_VIEW / 2))
    camera.position = centre + distance * _TOWARDS_VIEWER / np.linalg.norm(_TOWARDS_VIEWER)
    camera.near, camera.far = radius / 100, 100 * radius


def bounds(flower: Mapping[str, Petal]) -> tuple[NDArray[np.float64], float]:
    """Centre (3,) and radius, in mm, of a sphere around the flower."""
    points = np.concatenate([petal.vertices @ petal.pose[:3, :3].T + petal.pose[:3, 3] for petal in flower.values()])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def petal_colours(flower: Mapping[str, Petal], hue: Hue = PETAL_COLOUR) -> dict[str, Rgb]:
    """One hue (linear red, green, blue, 0 to 1) for all petals, a little lighter or darker than its neighbours so that edges show."""
    linear = np.asarray(hue, dtype=float)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)  # sRGB, IEC 61966-2-1
    shades = 0.74 + 0.26 * np.modf(np.arange(len(flower)) * 0.618)[0]
    return {name: _rgb(255 * shade * encoded) for name, shade in zip(flower, shades, strict=True)}


def checked(petals: Mapping[str, PetalArrays]) -> dict[str, Petal]:
    """Return the petals as arrays of the right kind.

    Raises
    ------
    RenderError
        There is none, or one's arrays are not a mesh and a rigid motion.
    """
    if not petals:
        raise RenderError("there is no petal to show")
    return {name: _checked_petal(name, *arrays) for name, arrays in petals.items()}


def rigid(name: str, transform: ArrayLike) -> NDArray[np.float64]:
    """Return a petal's transform (4, 4) as an array of its own.

    Raises
    ------
    RenderError
        It is no rotation followed by a shift.
    """
    T = np.array(transform, dtype=float)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise RenderError(
            f"petal {name}: expected a finite 4 x 4 transform, got shape {T.shape} with {np.isfinite(T).sum()} finite numbers"
        )
    R = T[:3, :3]
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-5) and np.linalg.det(R) > 0 and np.array_equal(T[3], [0, 0, 0, 1])):
        raise RenderError(f"petal {name}: the transform is no rotation and shift (it would stretch, mirror or project the petal):\n{T}")
    return T


def _checked_petal(name: str, vertices: ArrayLike, faces: ArrayLike, transform: ArrayLike) -> Petal:
    if not name or "/" in name:
        raise RenderError(f"a petal cannot be called {name!r} on the page: the name must not be empty or contain '/'")
    points, corners = np.asarray(vertices, dtype=float), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise RenderError(f"petal {name}: expected finite vertices of shape (V, 3), got shape {points.shape}")
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners) or not np.issubdtype(corners.dtype, np.integer):
        raise RenderError(f"petal {name}: expected whole-number faces of shape (F, 3), got shape {corners.shape} of {corners.dtype}")
    if corners.min() < 0 or corners.max() >= len(points):
        raise RenderError(f"petal {name}: its faces name vertices {corners.min()} to {corners.max()}, it has {len(points)}")
    return Petal(points, corners.astype(np.int64), rigid(name, transform))


def _rgb(colour: NDArray[np.float64]) -> Rgb:
    red, green, blue = (int(part) for part in colour)
    return red, green, blue


def _no_sharing(verbose: bool = True) -> str | None:
    raise RenderError("this page is for this machine only; it is not shared")
