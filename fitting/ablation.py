"""What each physical term of the model changes in the plane of incidence: added one after another, or left out one at a time.

The single bounce is taken to pieces on the quadrature points of `fitting.surface`: shadows, hiding, foreshortening and floor are each a
factor that can be left out. What comes on top, interreflection and lobes, is the model's own. Body light has no such order, so there each
part is left out of the whole.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitting.errors import DomainError
from fitting.model import Model, cell_of, chosen
from fitting.reflectance import INTENSITY

if TYPE_CHECKING:
    from fitting.body import BodyTrace
    from fitting.surface import Surface

Array = NDArray[np.float64]

READ = 70.0
"""The paper reads out to this theta_r, deg; further out small numbers make any change look large."""

ROWS, COLUMNS = 64, 96
"""Points along and around a dome: at 45 deg and within `READ`, 0.4 % off direct integration for hemispheres, 0.5 % for rose cells."""


@dataclass(frozen=True, eq=False)
class Step:
    """The reflectance with some of the model's terms.

    Attributes
    ----------
    name, text : str
        What was added or left out.
    theta_r_deg : ndarray, shape (n,), deg
        Views.
    values : ndarray, shape (n,)
        1/sr, or intensity in the paper's mode.
    albedo : float
        Share of the light sent back; of an intensity as `Reflectance.albedo` has it.
    transmitted : float or None
        Share sent through the petal, where the mode knows it.
    change : float or None
        Largest relative change within `READ`, against the step before or against the whole; None where there was nothing to change.
    change_at_deg : float or None
        At which theta_r.
    """

    name: str
    text: str
    theta_r_deg: Array
    values: Array
    albedo: float
    transmitted: float | None = None
    change: float | None = None
    change_at_deg: float | None = None

    def at(self, theta_r_deg: float) -> float:
        """Value at a view, linear in between."""
        return float(np.interp(theta_r_deg, self.theta_r_deg, self.values))

    @property
    def ratio(self) -> float | None:
        """Towards the light over away from it, f(+40) / f(-40); None where nothing is sent away."""
        away = self.at(-40)
        return self.at(40) / away if away > 0 else None

    @property
    def normalised(self) -> Array | None:
        """Values over that along the normal; None where nothing is sent there."""
        middle = self.at(0)
        return self.values / middle if middle > 0 else None


def ablation(
    model: Model, numbers: Mapping[str, float], theta_i_deg: float, theta_r_deg: ArrayLike, *, patch: Surface | None = None
) -> tuple[Step, ...]:
    """Take a cultivar's reflectance to pieces.

    Parameters
    ----------
    model : Model
        Of any mode.
    numbers : mapping of str to float
        The cultivar's, see `fitting.model.NUMBERS`.
    theta_i_deg : float, deg
        0 <= theta_i < 90.
    theta_r_deg : array_like, shape (n,), deg
        Views in the plane of incidence, rising, from -40 or less to 40 or more and less than 90 away from the normal.
    patch : Surface, optional
        Of the model's cell, with an even number of azimuths; by default fine enough.

    Returns
    -------
    tuple of Step
        In "body" the whole first and then without each part; else each with one term more, the last the model itself.

    Raises
    ------
    DomainError
        If a number or a direction is outside the model.
    EnergyError
        If the cultivar would send back more light than falls on it.
    """
    theta_r = np.asarray(theta_r_deg, float)
    if theta_r.ndim != 1 or not (np.all(np.diff(theta_r) > 0) and -90 < theta_r.min() <= -40 and 40 <= theta_r.max() < 90):
        raise DomainError("the views of an ablation must rise within -90 and 90 deg and span at least -40 to 40 deg")
    if not 0 <= theta_i_deg < 90:
        raise DomainError(f"theta_i = {theta_i_deg:g} deg is outside the model: expected 0 <= theta_i < 90 deg")
    x = chosen(model.mode, numbers)
    if model.body is not None:
        return _left_out(model.body, x, theta_i_deg, theta_r)
    if patch is None:
        from fitting.surface import surface

        patch = surface(cell_of(model), ROWS, COLUMNS)
    return _added(model, x, theta_i_deg, theta_r, patch)


def single_bounce(
    patch: Surface,
    theta_i_deg: float,
    theta_r_deg: ArrayLike,
    *,
    shadows: bool = True,
    hiding: bool = True,
    foreshortened: bool = True,
    floor: bool = True,
) -> tuple[Array, float]:
    """Light of Lambert facets of reflectance 1 after one bounce, with or without each of what makes it.

    Parameters
    ----------
    patch : Surface
        With an even number of azimuths.
    theta_i_deg : float, deg
        0 <= theta_i < 90.
    theta_r_deg : array_like, shape (n,), deg
        Views in the plane of incidence, -90 < theta_r < 90.
    shadows, hiding : bool
        Whether domes keep light and view from others. A facet's own back is dark and unseen in any case.
    foreshortened : bool
        Whether facets count by what the view sees of them, or, as in the paper, by their area.
    floor : bool
        Whether the gaps send light, too.

    Returns
    -------
    values : ndarray, shape (n,), 1/sr
        With all four, radiometric u_diff; with shadows and hiding alone, the paper's u_diff over pi cos(theta_i).
    albedo : float
        Integral of values times cos(theta_r) over all views; without `hiding` and foreshortening no share of the light, and above 1 at
        times.
    """
    from numpy.polynomial.legendre import leggauss

    kept = np.ones(len(patch.areas), bool) if floor else ~patch.is_floor
    normals, areas, horizon = patch.normals[kept], patch.areas[kept], patch.horizon[kept]
    around = horizon.shape[1]
    if around % 2:
        raise DomainError(f"light and view stand opposite each other: expected a surface with an even number of azimuths, not {around}")
    psi = np.arange(around) * 2 * np.pi / around
    outward = normals[:, :1] * np.cos(psi) + normals[:, 1:2] * np.sin(psi)

    def facing(theta: float, free: bool) -> Array:
        """Cosine between normals and a direction at each azimuth of the lattice; 0 at the back and, where `free` is not, if hidden."""
        cosine = np.maximum(0.0, math.sin(theta) * outward + math.cos(theta) * normals[:, 2:])
        return cosine if free else cosine * (horizon < (1 / math.tan(theta) if theta > 0 else math.inf))

    def seen(theta: float) -> Array:
        cosine = facing(abs(theta), not hiding)
        found = cosine if foreshortened else (cosine > 0).astype(float)
        return np.roll(found, around // 2, axis=1) if theta < 0 else found

    theta_i = math.radians(theta_i_deg)
    light = areas[:, None] * facing(theta_i, not shadows) / (around * np.pi * math.cos(theta_i))
    values = []
    for theta in np.radians(np.asarray(theta_r_deg, float)):
        values.append(float(np.sum(light * seen(theta))) / (math.cos(theta) if foreshortened else 1.0))
    u, weights = leggauss(32)  # in cos(theta)
    whole = np.zeros(len(areas))
    for cosine, weight in zip((u + 1) / 2, weights / 2, strict=True):
        whole += weight * (1.0 if foreshortened else cosine) * 2 * np.pi * seen(math.acos(cosine)).mean(axis=1)
    return np.array(values), float(light.sum(axis=1) @ whole)


def _added(model: Model, x: dict[str, float], theta_i: float, theta_r: Array, patch: Surface) -> tuple[Step, ...]:
    """Flat Lambert, then one term more each time."""
    diffuse = next(iter(x))  # the epidermis' own number comes first in each of these modes
    intensity = model.table.mode == INTENSITY
    cosine = math.cos(math.radians(theta_i))
    # An intensity holds the cosine of incidence and no 1 / pi.
    scale, scale_albedo = (x[diffuse] * np.pi * cosine, x[diffuse] * np.pi) if intensity else (x[diffuse], x[diffuse])
    steps = [Step("flat", "flat Lambert surface", theta_r, np.full(theta_r.shape, scale / np.pi), scale_albedo)]
    terms = {"shadows": False, "hiding": False, "foreshortened": False, "floor": False}

    def bounce(name: str, text: str, **more: bool) -> None:
        terms.update(more)
        values, albedo = single_bounce(patch, theta_i, theta_r, **terms)
        steps.append(Step(name, text, theta_r, scale * values, scale_albedo * albedo))

    bounce("slopes", "slopes of the domes alone")
    bounce("shadows", "domes shade one another", shadows=True)
    bounce("hiding", "domes hide one another", hiding=True)
    if not intensity:
        bounce("foreshortening", "facets seen aslant", foreshortened=True)
        bounce("floor", "floor in the gaps", floor=True)
    mixed = dict(x) | {"u_spec": 0.0, "s_diff": 0.0, "s_spec": 0.0}

    def mix(name: str, text: str, **more: float) -> None:
        mixed.update(more)
        reflectance = model.reflectance(**mixed)
        steps.append(Step(name, text, theta_r, reflectance(theta_i, theta_r, 0.0), float(reflectance.albedo(theta_i))))

    if model.mode == "interreflecting":
        mix("interreflection", "light thrown from dome to dome")
    mix("lobe", "the domes' lobe, u_spec", u_spec=x["u_spec"])
    if x["s_diff"] or x["s_spec"]:
        mix("spongy", "flat spongy tissue", s_diff=x["s_diff"], s_spec=x["s_spec"])
    return (steps[0], *(_compared(step, before) for before, step in itertools.pairwise(steps)))


def _left_out(body: BodyTrace, x: dict[str, float], theta_i: float, theta_r: Array) -> tuple[Step, ...]:
    """The whole, then without each part."""
    from fitting.body import BodyTrace, Epidermis, trace_face

    def flat(depth: float) -> BodyTrace:
        trace = {name: body.provenance[name] for name in ("rays", "seed")}
        face = trace_face(Epidermis(None, depth), body.upper.n, **trace)
        return BodyTrace(face, face, body.provenance)

    def step(name: str, text: str, of: BodyTrace, without: Sequence[str] = (), **other: float) -> Step:
        tissue = dict(x) | other
        mu = tissue["mu"]
        parts = {
            "mirror": of.mirror_reflectance(theta_i, theta_r, 0.0),
            "stray": of.stray_reflectance(theta_i, theta_r, 0.0, mu=mu),
            "body": of.body_reflectance(theta_i, theta_r, **tissue),
        }
        budget = of.budget(theta_i, **tissue)
        values = sum((values for part, values in parts.items() if part not in without), np.zeros(theta_r.shape))
        reflected = sum(float(budget[part]) for part in ("mirror", "floor", "stray", "body") if part not in without)
        return Step(name, text, theta_r, values, reflected, float(budget["scattered"] + budget["direct"]))

    whole = step("whole", "all of it", body)
    upper, lower = body.upper, body.lower
    if lower.epidermis.cell is None:
        other = "domed far face instead", replace(body, lower=upper)
    else:
        other = "flat far face instead", replace(body, lower=flat(lower.epidermis.depth).lower)
    steps = [
        step("mirror", "no mirror light", body, ["mirror", "floor"]),
        step("stray", "no stray light", body, ["stray"]),
        step("pigment", "no pigment", body, mu=0.0, mu_below=0.0),
        step("far face", *other),
        step("mesophyll", "black mesophyll: the face alone", body, R_m=0.0, R_m_below=0.0, T_m=0.0, D_m=0.0),
        step("domes", "flat lit face instead", replace(body, upper=flat(upper.epidermis.depth).upper)),
    ]
    return (whole, *(_compared(other, whole) for other in steps))


def _compared(step: Step, before: Step) -> Step:
    """Fill in the largest relative change."""
    read = (np.abs(step.theta_r_deg) <= READ) & (before.values > 0)
    if not read.any():
        return step
    change = np.abs(step.values[read] / before.values[read] - 1)
    most = int(np.argmax(change))
    return replace(step, change=float(change[most]), change_at_deg=float(step.theta_r_deg[read][most]))
