"""The flower: petals in a spiral about the stem, each moved inwards until it nearly touches those inside it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sim.rose.contact import clearance, crossings, hits
from sim.rose.errors import RoseError
from sim.rose.mesh import Array, Mesh, inverse, rigid
from sim.rose.shape import Form, midrib, sheet

FEWEST, MOST = 5, 45
WHORL = 8
DIVERGENCE = 137.507764  # deg, golden angle
CLEARANCE = (0.2, 1.0)  # mm, between a petal and the nearest of those inside it

_AIM = (0.24, 0.38)  # mm, clearance aimed at
_SURE = (0.21, 0.96)  # mm, CLEARANCE less what the search's coarse triangles may be off
_STEM = 1.6  # mm, base radius of the innermost petal; no other comes nearer to the stem
_STEP = 0.4  # mm of base radius: far below the horizon, so that no sheet is jumped through unseen
_PACE = 1.25  # mm, no point of a sheet moves further when its base radius changes by 1 mm
_HORIZON = 3.0  # mm, what is further off is not looked at
_SEARCH_TRIANGLES = 3000
_SHIELD = 21  # petals inward beyond these are covered by them; the final check looks at every pair


@dataclass(frozen=True)
class Neighbour:
    """A petal beside another, and whether it lies between that one and the stem ("inside") or not ("outside")."""

    petal: str
    side: str


@dataclass(frozen=True)
class RosePetal:
    """One petal as it truly is.

    Parameters
    ----------
    name
        "P01" is the outermost: petals are numbered in the order in which they are taken off.
    form
        Its shape; holds the true stem angle, azimuth, base radius and base height.
    mesh
        Flower frame, mm.
    left, right
        Neighbours in its whorl, counter-clockwise and clockwise seen from above.
    """

    name: str
    form: Form
    mesh: Mesh
    left: Neighbour
    right: Neighbour

    def midrib_points(self) -> Array:
        """Return base, inflection and tip, flower frame, mm, shape (3, 3)."""
        r, z, _ = midrib(self.form, np.array([0.0, self.form.inflection, 1.0]))
        turn = np.radians(self.form.azimuth)
        return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)

    def t_flower_petal(self) -> Array:
        """Return the petal's own frame: origin at the base, y to the tip, z towards the inner face."""
        base, _, tip = self.midrib_points()
        y = (tip - base) / np.linalg.norm(tip - base)
        normal = self.mesh.mean_normal()
        z = normal - (normal @ y) * y
        z /= np.linalg.norm(z)
        return rigid(np.stack([np.cross(y, z), y, z], axis=1), base)


@dataclass(frozen=True)
class Rose:
    """A flower; `petals` from the outermost (P01) to the innermost."""

    petals: tuple[RosePetal, ...]
    opening: float
    seed: int

    def crossings(self) -> dict[tuple[str, str], int]:
        """Return the pairs of petals whose triangles cross, and how many do; empty for every rose that `grow` returns."""
        found = {}
        for i, one in enumerate(self.petals):
            for other in self.petals[i + 1 :]:
                count = crossings(one.mesh, other.mesh)
                if count:
                    found[one.name, other.name] = count
        return found

    def clearances(self) -> dict[str, float]:
        """Return each petal's least distance to those inside it, mm, 3 if it is more; the innermost has none."""
        return {petal.name: _least(petal.mesh, [other.mesh for other in self.petals[i:]]) for i, petal in enumerate(self.petals[:-1], 1)}

    def covered(self) -> dict[str, float]:
        """Return what share of each petal's outer face other petals cover.

        A face of the petal counts as covered when the ray along its outward normal (away from the inner face) meets a petal further out.
        By area. Faces are those of coarser meshes of the same forms (200 triangles asking, 800 answering): the share is good to 0.01 or so.
        """
        walls = [sheet(petal.form, 800) for petal in self.petals]
        shares = {}
        for i, petal in enumerate(self.petals):
            asking = sheet(petal.form, 200)
            middles = asking.vertices[asking.faces].mean(axis=1)
            outward = -asking.face_normals()
            met = np.zeros(len(middles), dtype=bool)
            for wall in walls[:i]:
                left = ~met
                met[left] = hits(middles[left], outward[left], wall)
            areas = asking.areas()
            shares[petal.name] = float(areas[met].sum() / areas.sum())
        return shares

    def outermost_whorl(self) -> tuple[str, ...]:
        """Names of the petals of the outermost whorl: nothing outside covers them."""
        return tuple(petal.name for petal in self.petals[: whorls(len(self.petals))[-1]])


def whorls(petals: int) -> tuple[int, ...]:
    """Sizes of the whorls from the innermost outwards: about eight petals each, so that neighbours in a whorl overlap."""
    count = max(1, round(petals / WHORL))
    return tuple(petals * (i + 1) // count - petals * i // count for i in range(count))


def grow(petals: int, *, opening: float = 0.5, seed: int = 0, triangles: int = 12_500) -> Rose:
    """Grow a rose.

    Petals are sheets around the stem at the golden angle. From the innermost outwards each is moved towards the stem until its least
    distance to those inside it is 0.2 to 1.0 mm. The finished meshes are then searched for crossing triangles.

    Parameters
    ----------
    petals
        5 to 45.
    opening
        0 a bud, 1 fully open.
    seed
        Same arguments, same rose.
    triangles
        Of each petal, about.

    Raises
    ------
    RoseError
        If the arguments are out of range, or a petal finds no place.
    """
    if not FEWEST <= petals <= MOST:
        raise RoseError(f"a rose of {petals} petals was asked for: {FEWEST} to {MOST} can be grown")
    if not 0 <= opening <= 1:
        raise RoseError(f"an opening of {opening} was asked for: expected 0 (bud) to 1 (open)")
    if triangles < 200:
        raise RoseError(f"{triangles} triangles a petal were asked for: a petal needs 200 or more to keep its shape")
    rng = np.random.default_rng([seed, petals, round(opening * 1e6)])
    placed: list[_Layer] = []
    for form, aim in zip(_forms(petals, opening, rng), rng.uniform(*_AIM, petals), strict=True):
        placed.append(_settle(form, float(aim), placed[-_SHIELD:]))
    forms = [layer.form for layer in placed]
    rose = _named(forms, [sheet(form, triangles) for form in forms], opening, seed)
    if crossed := rose.crossings():
        raise RoseError(
            f"rose of {petals} petals, opening {opening}, seed {seed}: {len(crossed)} pairs cross ({crossed}); take another seed"
        )
    return rose


def _forms(petals: int, opening: float, rng: np.random.Generator) -> list[Form]:
    """Draw the petals from the innermost outwards; base radii are settled later."""
    # Few petals span little of the range from the heart of a full flower to its outermost petal.
    span = min(1.0, (petals - 1) / 24)
    heart = 5 + 16 * opening
    outer = 16 + 58 * opening
    start = rng.uniform(0, 360)
    forms = []
    for k in range(petals):
        x = 1 - span * (1 - k / (petals - 1))
        length = (19 + 21 * x) * rng.uniform(0.94, 1.06)
        stem_angle = heart + (outer - heart) * x**1.3
        notched = rng.random() < 0.4
        small = length / 40
        forms.append(
            Form(
                azimuth=(start + k * DIVERGENCE + rng.normal(0, 3)) % 360,
                base_radius=_STEM,
                base_height=0.0,
                length=length,
                half_width=length * rng.uniform(0.46, 0.54),
                claw=length * 0.09 * rng.uniform(0.95, 1.15) + 0.8,
                stem_angle=stem_angle + rng.normal(0, 0.4),
                base_angle=min(stem_angle + 30 + 14 * (1 - x), 100.0) + rng.normal(0, 0.5),
                tip_angle=stem_angle + 14 + 22 * x * (0.4 + 0.6 * opening) + rng.normal(0, 1.0),
                inflection=float(np.clip(rng.normal(0.6, 0.01), 0.55, 0.65)),
                skew=float(np.clip(rng.normal(0, 0.07), -0.15, 0.15)),
                shoulder=rng.uniform(0.16, 0.3),
                point=rng.uniform(-0.07, -0.02) if notched else rng.uniform(0.02, 0.08),
                wrap=78.0,
                bulge=tuple(rng.normal(0, 0.22 * small, 4)),
                rim=((rng.uniform(0.1, 0.35) * small, rng.uniform(0, 360)), (rng.uniform(0.005, 0.02), rng.uniform(0, 360))),
            )
        )
    return forms


@dataclass(frozen=True)
class _Layer:
    """A petal in a place, ready to be asked how far away others are."""

    form: Form

    @cached_property
    def mesh(self) -> Mesh:
        return sheet(self.form, _SEARCH_TRIANGLES)

    @cached_property
    def outward(self) -> Array:
        return -self.mesh.vertex_normals()

    @cached_property
    def reach(self) -> float:
        return float(np.median(self.mesh.edges))


def _settle(form: Form, aim: float, inner: list[_Layer]) -> _Layer:
    """Move a petal in until its least distance to the inner ones is in CLEARANCE.

    A search over vertices finds the place outside all of them. It is blind between vertices and too careful beside a rim, so the distance
    that it leaves is measured over triangles, and put right where it must be.
    """
    if not inner:
        return _Layer(_at(form, _STEM))
    layer = _outside(form, aim, inner)
    for _ in range(40):
        distance = _least(layer.mesh, [other.mesh for other in reversed(inner)])
        if _SURE[0] <= distance <= _SURE[1]:
            return layer
        # Going in, no point moves further than leaves `aim`: nothing is passed through.
        radius = layer.form.base_radius - (distance - aim) / _PACE
        if radius < _STEM:
            break
        layer = _Layer(_at(form, radius))
    raise _no_place(form, inner)


def _outside(form: Form, aim: float, inner: list[_Layer]) -> _Layer:
    """Bisect for the least base radius at which the petal is clear of the inner ones and on their outer side."""

    def clear(radius: float) -> bool:
        return _clear(_Layer(_at(form, radius)), aim, inner)

    radius = inner[-1].form.base_radius
    if clear(radius):
        while clear(radius - _STEP):
            radius -= _STEP
            if radius - _STEP < _STEM:
                return _Layer(_at(form, radius))
        low, high = radius - _STEP, radius
    else:
        for _ in range(20):
            radius += _STEP
            if clear(radius):
                break
        else:
            raise _no_place(form, inner)
        low, high = radius - _STEP, radius
    while high - low > 0.015:
        middle = (low + high) / 2
        if clear(middle):
            high = middle
        else:
            low = middle
    return _Layer(_at(form, high))


def _at(form: Form, radius: float) -> Form:
    return replace(form, base_radius=radius, base_height=3.0 - 0.25 * radius)


def _no_place(form: Form, inner: list[_Layer]) -> RoseError:
    return RoseError(
        f"the petal at azimuth {form.azimuth:.0f} deg finds no place {CLEARANCE[0]} to {CLEARANCE[1]} mm outside {len(inner)} others;"
        " take another seed"
    )


def _clear(layer: _Layer, aim: float, inner: list[_Layer]) -> bool:
    """Tell whether a sheet lies on the outer side of all inner ones, with every vertex `aim` mm or more from them."""
    for other in reversed(inner):
        distance, index = other.mesh.tree.query(layer.mesh.vertices, distance_upper_bound=_HORIZON)
        near = np.isfinite(distance)
        if not near.any():
            continue
        index = index[near]
        offset = layer.mesh.vertices[near] - other.mesh.vertices[index]
        outward = other.outward[index]
        along = np.einsum("ij,ij->i", offset, outward)
        sideways = np.sqrt(np.clip(distance[near] ** 2 - along**2, 0, None))
        # Beside the rim or on the stem's other side a distance has no sign.
        facing = (np.einsum("ij,ij->i", layer.outward[near], outward) > 0.2) & (sideways < other.reach)
        if np.where(facing, along, distance[near]).min() < aim:
            return False
    return True


def _least(mesh: Mesh, others: list[Mesh]) -> float:
    """Return the least distance to other meshes, mm, exact: 0 where one is crossed, at most the horizon; the likely nearest first."""
    least = _HORIZON
    for other in others:
        least = min(least, clearance(mesh, other, least))
    return least


def _named(forms: list[Form], meshes: list[Mesh], opening: float, seed: int) -> Rose:
    count = len(forms)
    names = [f"P{count - k:02d}" for k in range(count)]
    beside: list[tuple[int, int]] = [(0, 0)] * count
    first = 0
    for size in whorls(count):
        ring = sorted(range(first, first + size), key=lambda k: forms[k].azimuth)
        for place, k in enumerate(ring):
            beside[k] = ring[(place + 1) % size], ring[place - 1]
        first += size
    petals = []
    for k in reversed(range(count)):
        left, right = (Neighbour(names[j], "inside" if j < k else "outside") for j in beside[k])
        petals.append(RosePetal(names[k], forms[k], meshes[k], left, right))
    return Rose(tuple(petals), opening, seed)


def t_flower_scan(petal: RosePetal, t_scan_petal: Array) -> Array:
    """Transform that takes a petal from the range finder's frame to its place in the flower."""
    return petal.t_flower_petal() @ inverse(t_scan_petal)
