"""Shape of one petal: a sheet around the stem, cupped below, reflexed above, with an irregular outline."""

from dataclasses import dataclass

import numpy as np

from sim.rose.mesh import Array, Mesh

_STEPS = 400  # of the midrib's integration; its error is below a micrometre for a 45 mm petal


@dataclass(frozen=True)
class Form:
    """What makes a petal the petal it is. Lengths in mm, angles in degrees, flower frame.

    Parameters
    ----------
    azimuth, base_radius, base_height
        Cylindrical coordinates of the base point.
    length
        Arc length of the midrib.
    half_width, claw
        Half widths at the widest part and at the base, along the sheet.
    stem_angle, base_angle, tip_angle
        Angle between the stem and the midrib at the inflection, the base and the tip.
        base_angle > stem_angle < tip_angle: cupped, then reflexed.
    inflection
        Place of the inflection, fraction of the midrib.
    skew
        The left half is wider by this fraction, the right half narrower.
    shoulder
        How far the rim falls from the tip to the sides, fraction of the length.
    point
        Height of the tip over the rim about it, fraction of the length; negative: a notch.
    wrap
        Half angle about the stem that the sheet never exceeds.
    bulge
        (4,) amplitudes of slow departures from the surface of revolution; zero on the midrib.
    rim
        (2, 2) amplitude and phase (degrees) of the rim's waves, out of the sheet and in the outline (fraction of the length).
    """

    azimuth: float
    base_radius: float
    base_height: float
    length: float
    half_width: float
    claw: float
    stem_angle: float
    base_angle: float
    tip_angle: float
    inflection: float
    skew: float
    shoulder: float
    point: float
    wrap: float
    bulge: tuple[float, float, float, float]
    rim: tuple[tuple[float, float], tuple[float, float]]


def midrib(form: Form, t: Array) -> tuple[Array, Array, Array]:
    """Profile of the midrib in the half plane of its azimuth.

    The angle from the stem falls as a parabola to the inflection and rises as a parabola after it: the curvature passes through zero there,
    once, linearly.

    Parameters
    ----------
    form
        The petal.
    t
        Arc length from the base, fraction of the length, any shape; slightly over 1 is the same parabola going on.

    Returns
    -------
    r, z, angle
        Cylindrical radius and height (mm), angle from the stem (degrees); shaped like `t`.
    """
    path = np.linspace(0.0, 1.2, _STEPS + 1)
    below = np.clip(1 - path / form.inflection, 0, None)
    above = np.clip(path - form.inflection, 0, None) / (1 - form.inflection)
    angle = form.stem_angle + (form.base_angle - form.stem_angle) * below**2 + (form.tip_angle - form.stem_angle) * above**2
    slope = np.radians(angle)
    step = form.length * (path[1] - path[0])

    def integral(f: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2) * step])

    r = form.base_radius + integral(np.sin(slope))
    z = form.base_height + integral(np.cos(slope))
    return np.interp(t, path, r), np.interp(t, path, z), np.interp(t, path, angle)


def sheet(form: Form, triangles: int) -> Mesh:
    """Triangles of a petal in the flower frame.

    Parameters
    ----------
    form
        The petal.
    triangles
        How many, about: 2 n^2 for the nearest n.
    """
    n = max(4, round((triangles / 2) ** 0.5))
    # An odd number of columns, so that one of them is the midrib.
    u, v = np.meshgrid(np.linspace(-1, 1, n + 1 - n % 2), np.linspace(0, 1, n + 1))
    vertices = surface(form, u, v)
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (index[rows, columns].ravel() for rows in (slice(0, -1), slice(1, None)) for columns in (slice(0, -1), slice(1, None)))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return Mesh(vertices.reshape(-1, 3), faces)


def surface(form: Form, u: Array, v: Array) -> Array:
    """Points of the sheet, mm, flower frame, shape of `u` and `v` plus (3,).

    u: -1 right rim (clockwise seen from above), 0 midrib, +1 left rim. v: 0 base, 1 upper rim.
    """
    (wave, wave_phase), (ragged, ragged_phase) = form.rim
    side = np.abs(u)
    top = 1 - form.shoulder * side**2.6 + form.point * np.where(form.point > 0, np.exp(-((u / 0.3) ** 2)), np.exp(-((u / 0.16) ** 2)))
    top = top + ragged * u**2 * np.sin(np.radians(ragged_phase) + 7.0 * u)
    top = top / (1 + form.point)  # the tip itself stays at t = 1, whatever its outline
    t = v * top
    r, z, angle = midrib(form, t)
    slope = np.radians(angle)

    blade = np.sin(np.pi / 2 * np.clip(v / 0.72, 0, 1)) ** 2.0 - 0.25 * np.clip((v - 0.72) / 0.28, 0, 1) ** 2
    width = form.claw + (form.half_width - form.claw) * blade
    width = width * (1 + form.skew * np.sign(u) * v) * (1 + 1.5 * ragged * side * v * np.sin(np.radians(ragged_phase) + 9.0 * v))
    wrap = np.radians(form.wrap)
    turn = np.radians(form.azimuth) + u * wrap * np.tanh(width / (wrap * r))

    # Departures along the outward normal vanish on the midrib and at the base: the true stem angle and base stay what they are.
    b1, b2, b3, b4 = form.bulge
    out = u**2 * (b1 * v + b2 * np.sin(np.pi * v)) + u * side * (b3 * v + b4 * np.sin(np.pi * v))
    out = out + wave * side**3 * v * np.sin(np.radians(wave_phase) + 8.0 * v * np.sign(u) + 5.0 * u)
    r = r + out * np.cos(slope)
    z = z - out * np.sin(slope)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)
