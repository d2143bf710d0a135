"""A page on this machine to put petals right by hand: move, turn, see what collides, save."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import RenderError
from render.viewer import (
    COLLIDING,
    Page,
    Petal,
    PetalArrays,
    add_notes,
    add_petal,
    aim_camera,
    bounds,
    checked,
    node_pose,
    open_server,
    petal_colours,
    rigid,
)

if TYPE_CHECKING:
    import viser

_QUIET_S = 0.15

Poses = dict[str, NDArray[np.float64]]
Angles = tuple[float, float]


def serve_editor(
    petals: Mapping[str, PetalArrays],
    *,
    bases: Mapping[str, ArrayLike],
    angles: Callable[[str, NDArray[np.float64]], Angles],
    turned: Callable[[str, NDArray[np.float64], float, float], ArrayLike],
    collisions: Callable[[Poses], Collection[str]],
    save: Callable[[Poses], str | None],
    title: str = "Flower editor",
    notes: Sequence[str] = (),
    port: int = 0,
) -> Editor:
    """Open a page of this machine on which petals are moved by hand.

    Parameters
    ----------
    petals : mapping
        Petal's name to vertices (V, 3) in mm in the scan frame, faces (F, 3), and ``T_flower_scan`` (4, 4) to begin with.
    bases : mapping
        Petal's name to its base point (3,) in mm in the scan frame: where its handle sits.
    angles : callable
        ``angles(name, T_flower_scan)`` gives the stem angle and the azimuth, in degrees, of a petal lying there.
    turned : callable
        ``turned(name, T_flower_scan, stem_angle, azimuth)`` gives the ``T_flower_scan`` of a petal brought from where it lies to
        these angles in degrees: to another stem angle about its base, to another azimuth about the stem, all else as it is.
    collisions : callable
        ``collisions(poses)`` names the petals that touch others, given every petal's ``T_flower_scan``; may be slow.
        It runs in a thread of its own, one call at a time.
    save : callable
        ``save(poses)`` keeps every petal's ``T_flower_scan``; what it returns, e.g. the file's name, is shown on the page.
    title : str
        Heading of the page.
    notes : sequence of str
        Lines to show above the controls.
    port : int
        TCP port; 0 takes a free one.

    Returns
    -------
    Editor
        Already serving.

    Raises
    ------
    RenderError
        The optional viewer is not installed, the port is taken, a petal's arrays are not a mesh and a rigid motion, or it has no base.
    """
    flower = checked(petals)
    if set(bases) != set(flower):
        raise RenderError(f"bases are given for {', '.join(sorted(bases)) or 'no petal'}, but the petals are {', '.join(sorted(flower))}")
    points = {name: _point(name, bases[name]) for name in flower}
    for name, petal in flower.items():
        rigid(name, turned(name, petal.pose, *angles(name, petal.pose)))
    return Editor(open_server(title, port), flower, points, angles, turned, collisions, save, notes)


class Editor(Page):
    """The editor's page being served; see `serve_editor`. What the page's visitor does can be done from a program, too.

    Attributes
    ----------
    url : str
        Address of the page, on this machine only.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        flower: Mapping[str, Petal],
        bases: Mapping[str, NDArray[np.float64]],
        angles: Callable[[str, NDArray[np.float64]], Angles],
        turned: Callable[[str, NDArray[np.float64], float, float], ArrayLike],
        collisions: Callable[[Poses], Collection[str]],
        save: Callable[[Poses], str | None],
        notes: Sequence[str],
    ) -> None:
        super().__init__(server)
        self._bases, self._angles, self._turned, self._save = bases, angles, turned, save
        self._lock = threading.RLock()
        self._saving = threading.Lock()
        self._poses: Poses = {name: petal.pose for name, petal in flower.items()}
        self._saved: Poses = dict(self._poses)
        self._angles_now = {name: angles(name, petal.pose) for name, petal in flower.items()}
        self._selected = next(iter(flower))
        self._save_line, self._move_line, self._collision_line = "Nothing saved yet.", "", ""
        self._colours = petal_colours(flower)
        self._meshes = {name: add_petal(server, name, petal, self._colours[name], bases[name]) for name, petal in flower.items()}
        self._checks = Checks(collisions, self._show_collisions)
        add_notes(server, notes)
        # In the frame of the handle, which sits on the base.
        self._middles = {name: petal.vertices.mean(axis=0) - bases[name] for name, petal in flower.items()}
        self._lay_out(bounds(flower)[1])
        aim_camera(server, flower)
        self._show_selected()
        self._check()

    @property
    def poses(self) -> Poses:
        """Every petal's ``T_flower_scan`` as it lies now."""
        with self._lock:
            return {name: T.copy() for name, T in self._poses.items()}

    @property
    def unsaved(self) -> list[str]:
        """Petals that lie elsewhere than when they were last saved, or than at the opening."""
        with self._lock:
            return [name for name, T in self._poses.items() if not np.array_equal(T, self._saved[name])]

    @property
    def status(self) -> str:
        """What the page says was saved, moved, and collides."""
        return self._status.value

    def select(self, name: str) -> None:
        """Put the handle and the sliders on a petal."""
        with self._lock:
            self._known(name)
            self._selected = name
            self._show_selected()

    def move(self, name: str, T_flower_scan: ArrayLike) -> None:
        """Lay a petal elsewhere: `T_flower_scan` (4, 4).

        Raises
        ------
        RenderError
            There is no such petal, or the transform is no rotation and shift.
        """
        with self._lock:
            self._known(name)
            T = rigid(name, T_flower_scan)
            # All that can fail comes before anything changes.
            self._angles_now[name] = self._angles(name, T)
            self._poses[name], self._move_line = T, ""
            mesh = self._meshes[name]
            with self._server.atomic():
                mesh.wxyz, mesh.position = node_pose(self._poses[name], self._bases[name])
                if name == self._selected:
                    self._show_selected()
            self._check()

    def turn(self, name: str, *, stem_angle: float | None = None, azimuth: float | None = None) -> None:
        """Turn a petal to other angles, in degrees: to a stem angle about its base, to an azimuth about the stem.

        What the hand changed besides (roll, shift of the base) stays.
        """
        with self._lock:
            self._known(name)
            old_stem, old_azimuth = self._angles_now[name]
            new_stem = old_stem if stem_angle is None else stem_angle
            new_azimuth = old_azimuth if azimuth is None else azimuth
            self.move(name, self._turned(name, self._poses[name].copy(), new_stem, new_azimuth))

    def save(self) -> None:
        """Hand all poses to the `save` callable; the status line tells how it went."""
        with self._saving:
            with self._lock:
                poses, moved = self.poses, self.unsaved
            try:
                told = self._save({name: T.copy() for name, T in poses.items()})
            except Exception as error:  # whatever it is, the visitor must read it on the page and go on
                self._tell(save=f"NOT SAVED: {_words(error)}")
                return
            with self._lock:
                self._saved = poses
                what = f"{len(poses)} petals" + (f", of them moved: {', '.join(moved)}" if moved else ", none moved since last time")
                self._tell(save=f"Saved {what}{f' -> {told}' if told else ''}.")

    def settle(self, timeout_s: float | None = None) -> bool:
        """Wait until the collisions of the last change are known and shown; returns whether they are."""
        return self._checks.settle(timeout_s)

    def close(self) -> None:
        """Stop serving; a second time does nothing. What was not saved is lost."""
        self._checks.close()
        super().close()

    def _lay_out(self, radius: float) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.add_markdown("Drag the handle's arrows and squares to shift the petal, its arcs to turn it. Orange petals pass through others.")
        self._list = gui.add_dropdown("Petal", tuple(self._poses), initial_value=self._selected, hint="or click on it")
        self._stem_slider = gui.add_slider("Stem angle (°)", 0.0, 180.0, 0.1, 0.0, hint="turns the petal about its base")
        self._azimuth_slider = gui.add_slider("Azimuth (°)", 0.0, 360.0, 0.1, 0.0, hint="turns the petal about the stem")
        self._save_button = gui.add_button("Save")
        self._status = gui.add_text("Status", "", multiline=True, disabled=True)
        self._handle = scene.add_transform_controls("/handle", scale=0.6 * radius, depth_test=False)
        self._label = scene.add_label("/handle/petal", self._selected, position=self._middles[self._selected], anchor="center-center")

        # Coroutines run in the order of the events; plain functions would run in any. Events of our own (no client) are done with.
        @self._list.on_update
        async def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            if event.client_id is not None:
                self._try(lambda: self.select(event.target.value))

        @self._stem_slider.on_update
        async def _(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client_id is not None:
                self._try(lambda: self.turn(self._selected, stem_angle=event.target.value))

        @self._azimuth_slider.on_update
        async def _(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client_id is not None:
                self._try(lambda: self.turn(self._selected, azimuth=event.target.value))

        @self._handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.phase == "update":
                self._try(self._follow_handle)

        for name, mesh in self._meshes.items():

            @mesh.on_click
            async def _(event: viser.SceneNodePointerEvent[viser.MeshHandle], name: str = name) -> None:
                self._try(lambda: self.select(name))

        @self._save_button.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            self.save()

    def _try(self, change: Callable[[], None]) -> None:
        try:
            change()
        except Exception as error:  # from the callables we were given: the visitor must read it on the page
            self._tell(move=f"NOT MOVED: {_words(error)}")
            self._show_selected()

    def _follow_handle(self) -> None:
        from viser import transforms

        rotation = transforms.SO3(np.asarray(self._handle.wxyz)).normalize().as_matrix()
        T = np.eye(4)
        T[:3, :3] = rotation
        T[:3, 3] = self._handle.position - rotation @ self._bases[self._selected]
        self.move(self._selected, T)

    def _show_selected(self) -> None:
        with self._lock:
            name = self._selected
            stem_angle, azimuth = self._angles_now[name]
            _put(self._list, name)
            if self._label.text != name:
                self._label.text, self._label.position = name, self._middles[name]
            _put(self._stem_slider, round(stem_angle, 1))
            _put(self._azimuth_slider, round(azimuth, 1) % 360)
            rotation, position = node_pose(self._poses[name], self._bases[name])
            if self._handle.wxyz @ rotation < 0:
                rotation = -rotation  # the same turn
            # A handle told where it is already would jump back under a fast hand.
            if not (np.allclose(self._handle.wxyz, rotation, atol=1e-9) and np.allclose(self._handle.position, position, atol=1e-9)):
                self._handle.wxyz, self._handle.position = rotation, position

    def _check(self) -> None:
        self._checks.ask(self.poses)
        self._tell(collision="Looking for collisions ...")

    def _show_collisions(self, poses: Poses, colliding: Collection[str] | Exception) -> None:
        with self._lock:
            if any(not np.array_equal(T, poses[name]) for name, T in self._poses.items()):
                return  # something moved meanwhile; the next check is under way
            if not isinstance(colliding, Exception) and (strange := sorted(set(colliding) - set(self._poses))):
                colliding = RenderError(f"the check names petals that are not here: {', '.join(strange)}")
            if isinstance(colliding, Exception):
                self._tell(collision=f"COLLISIONS UNKNOWN: {_words(colliding)}")
                colliding = ()
            elif colliding:
                self._tell(collision=f"Collide: {', '.join(name for name in self._poses if name in colliding)}.")
            else:
                self._tell(collision="No petal collides.")
            for name, mesh in self._meshes.items():
                mesh.color = COLLIDING if name in colliding else self._colours[name]

    def _tell(self, *, save: str | None = None, move: str | None = None, collision: str | None = None) -> None:
        with self._lock:
            self._save_line = self._save_line if save is None else save
            self._move_line = self._move_line if move is None else move
            self._collision_line = self._collision_line if collision is None else collision
            moved = f"Not saved yet: {', '.join(self.unsaved)}." if self.unsaved else ""
            _put(self._status, "\n".join(line for line in (self._save_line, moved, self._move_line, self._collision_line) if line))

    def _known(self, name: str) -> None:
        if name not in self._poses:
            raise RenderError(f"there is no petal {name!r}; there are {', '.join(self._poses)}")


class Checks:
    """A slow check done in a thread of its own: one at a time, of the latest poses only, once they rest.

    Parameters
    ----------
    check : callable
        The check; gets poses.
    report : callable
        ``report(poses, answer)`` gets what was checked, and the check's answer or what it raised.
    quiet_s : float
        A check begins when nothing changed for so long.
    """

    def __init__(
        self,
        check: Callable[[Poses], Collection[str]],
        report: Callable[[Poses, Collection[str] | Exception], None],
        quiet_s: float = _QUIET_S,
    ) -> None:
        self._check, self._report, self._quiet_s = check, report, quiet_s
        self._changed = threading.Condition()
        self._wanted: Poses | None = None
        self._busy = self._closed = False
        self._asked = 0
        threading.Thread(target=self._run, name="collisions", daemon=True).start()

    def ask(self, poses: Poses) -> None:
        """Have these poses checked; returns at once."""
        with self._changed:
            self._wanted, self._asked = poses, self._asked + 1
            self._changed.notify_all()

    def settle(self, timeout_s: float | None = None) -> bool:
        """Wait until the latest poses are checked and reported; returns whether they are."""
        with self._changed:
            return self._changed.wait_for(lambda: self._wanted is None and not self._busy, timeout_s)

    def close(self) -> None:
        """Begin no other check and report nothing more."""
        with self._changed:
            self._closed, self._wanted = True, None
            self._changed.notify_all()

    def _run(self) -> None:
        while (poses := self._next()) is not None:
            answer: Collection[str] | Exception
            try:
                answer = set(self._check(poses))
            except Exception as error:
                answer = error
            try:
                if not self._closed:
                    self._report(poses, answer)
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()

    def _next(self) -> Poses | None:
        with self._changed:
            self._changed.wait_for(lambda: self._wanted is not None or self._closed)
            asked = -1
            while asked != self._asked and not self._closed:
                asked = self._asked
                self._changed.wait_for(lambda seen=asked: self._asked != seen or self._closed, self._quiet_s)  # type: ignore[misc]
            poses, self._wanted = self._wanted, None
            self._busy = poses is not None
            return poses


def _words(error: Exception) -> str:
    return str(error) or type(error).__name__


def _put(control: Any, value: object) -> None:
    # Viser's typing declares the value read-only; assigning to it is its documented use.
    control.value = value


def _point(name: str, base: ArrayLike) -> NDArray[np.float64]:
    point = np.array(base, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise RenderError(f"petal {name}: expected its base as three finite coordinates in mm, got {base!r}")
    return point
