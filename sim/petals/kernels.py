"""The photon tracer: everything numba compiles.

It is one file since numba's cache looks for changes only in the file of the function it compiled.

Frame: z up along the petal's normal, z = 0 at the foot of the domes, lengths in um. Directions `d` are directions of travel.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange

# What a ray in the air meets next.
ESCAPE, HIT_DOME, HIT_FLOOR, LOST = 0, 1, 2, 3
# Tallies of energy.
SURFACE, BODY, TRANSMITTED, ABSORBED, ROULETTE, STRAY = 0, 1, 2, 3, 4, 5
# Detectors in the plane of incidence every 5 deg from -85 to 85, points far away ("views") or acceptance cones that count photons; and
# coarse bins over the hemisphere (theta_r, |phi|).
VIEWS, VIEW_STEP, CONE_HALF_ANGLE = 35, 5.0, 4.0
THETA_BINS, PHI_BINS = 9, 12

ROULETTE_WEIGHT = 0.02  # about what a first reflection carries, so that no path is followed for less than that
FAINT = 0.01  # a contribution [1/sr] below this plays roulette before its line of sight is followed
FAR = 100_000  # cells a ray in the air may cross; only a ray along an aisle of equal cells could cross more

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_SQRT3_2 = math.sqrt(3) / 2


class Scene(NamedTuple):
    """What a photon meets: petal number `lattice`, all below z = `ceiling`, lit from `azimuth` (cos, sin), seen from `views` (VIEWS, 3)."""

    petal: Any
    lattice: Any
    ceiling: Any
    azimuth: Any
    views: Any


class Site(NamedTuple):
    """A point of the surface, in cell (i, j): on its dome or on the floor."""

    x: Any
    y: Any
    z: Any
    i: Any
    j: Any
    on_dome: Any


class Books(NamedTuple):
    """Where a batch keeps its tallies: energy (6,), f_r (2, VIEWS), cones (VIEWS,), bins (THETA_BINS, PHI_BINS)."""

    energy: Any
    seen: Any
    cones: Any
    bins: Any


jit: Any = njit(cache=True, error_model="numpy")


@jit
def mix(z: Any) -> Any:
    """Scramble 64 bits (the finaliser of splitmix64: Steele, Lea & Flood 2014, doi:10.1145/2714064.2660195)."""
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@jit
def uniform(rng: Any) -> Any:
    """Random number in [0, 1); `rng` is one uint64 of state."""
    rng[0] += _GOLDEN
    return float(mix(rng[0]) >> _S11) * 2.0**-53


@jit
def cell_shape(petal: Any, lattice: Any, i: Any, j: Any) -> Any:
    """Height and shear (x, y) of the dome of cell (i, j) in the petal numbered `lattice`: the same whenever it is asked."""
    state = mix(lattice + np.uint64(i) * _MIX_1 + np.uint64(j) * _MIX_2)
    u = float(mix(state + _GOLDEN) >> _S11) * 2.0**-53
    v = float(mix(state + _GOLDEN + _GOLDEN) >> _S11) * 2.0**-53
    t = 2.0 * math.pi * float(mix(state + _GOLDEN + _GOLDEN + _GOLDEN) >> _S11) * 2.0**-53
    shear = math.tan(math.radians(petal.lean)) * math.sqrt(v)
    return petal.height * (1.0 + petal.height_spread * (2.0 * u - 1.0)), shear * math.cos(t), shear * math.sin(t)


@jit
def cell_centre(petal: Any, i: Any, j: Any) -> Any:
    """Centre (x, y) of cell (i, j)."""
    return petal.pitch * (i + 0.5 * j), petal.pitch * _SQRT3_2 * j


@jit
def cell_at(petal: Any, x: Any, y: Any) -> Any:
    """The cell (i, j) whose hexagon holds (x, y)."""
    fj = y / (petal.pitch * _SQRT3_2)
    fi = x / petal.pitch - 0.5 * fj
    fk = -fi - fj
    i, j, k = round(fi), round(fj), round(fk)
    di, dj, dk = abs(i - fi), abs(j - fj), abs(k - fk)
    if di > dj and di > dk:
        i = -j - k
    elif dj > dk:
        j = -i - k
    return int(i), int(j)


@jit
def dome_roots(x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any, radius: Any, shape: Any) -> Any:
    """Distances at which a ray enters and leaves the whole (sheared) ellipsoid of a dome centred at the origin.

    (inf, -inf) if it misses it. Shear and scale carry the ellipsoid to the unit sphere and keep the distances.
    """
    height, sx, sy = shape
    ox, oy, oz = (x - sx * z) / radius, (y - sy * z) / radius, z / height
    ux, uy, uz = (dx - sx * dz) / radius, (dy - sy * dz) / radius, dz / height
    a = ux * ux + uy * uy + uz * uz
    b = ox * ux + oy * uy + oz * uz
    # The distance of the line from the centre, not b^2 - a c: no cancellation for rays that come from far.
    px, py, pz = ox - b / a * ux, oy - b / a * uy, oz - b / a * uz
    q = 1.0 - (px * px + py * py + pz * pz)
    if q <= 0.0:
        return math.inf, -math.inf
    s = math.sqrt(q / a)
    return -b / a - s, -b / a + s


@jit
def dome_normal(x: Any, y: Any, z: Any, radius: Any, shape: Any) -> Any:
    """Outward unit normal of a dome centred at the origin."""
    height, sx, sy = shape
    nx, ny = (x - sx * z) / radius / radius, (y - sy * z) / radius / radius
    nz = z / height / height - sx * nx - sy * ny
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@jit
def next_surface(scene: Any, start: Any, d: Any) -> Any:
    """What a ray in the air meets: (ESCAPE | HIT_DOME | HIT_FLOOR | LOST, distance, cell i, cell j).

    It walks from hexagon to hexagon, each of which holds its dome wholly. The dome that it starts on is convex and so cannot be met again.
    """
    petal = scene.petal
    x, y, z, i, j, leaving = start
    dx, dy, dz = d
    t_floor = -z / dz if dz < 0.0 else math.inf
    t_ceiling = (scene.ceiling - z) / dz if dz > 0.0 else math.inf
    for _ in range(FAR):
        cx, cy = cell_centre(petal, i, j)
        if not leaving and petal.radius > 0.0:
            near, _far = dome_roots(x - cx, y - cy, z, dx, dy, dz, petal.radius, cell_shape(petal, scene.lattice, i, j))
            if 0.0 < near < t_floor and z + near * dz > 0.0:
                return HIT_DOME, near, i, j
        leaving = False
        t_out = math.inf
        next_i, next_j = i, j
        for k in range(3):  # the hexagon's three pairs of sides
            ex = 1.0 if k == 0 else (0.5 if k == 1 else -0.5)
            ey = 0.0 if k == 0 else _SQRT3_2
            v = dx * ex + dy * ey
            if v != 0.0:
                sign = 1 if v > 0.0 else -1
                t = (sign * 0.5 * petal.pitch - ((x - cx) * ex + (y - cy) * ey)) / v
                if t < t_out:
                    t_out = t
                    next_i = i + (sign if k == 0 else (0 if k == 1 else -sign))
                    next_j = j + (0 if k == 0 else sign)
        if dz < 0.0 and t_floor <= t_out:
            return HIT_FLOOR, t_floor, i, j
        if dz > 0.0 and t_ceiling <= t_out:
            return ESCAPE, t_ceiling, i, j
        i, j = next_i, next_j
    return LOST, 0.0, i, j


@jit
def fresnel(cos_in: Any, eta: Any) -> Any:
    """Unpolarised Fresnel reflectance and cosine of refraction; eta = index beyond / index before. (1, 0) at total reflection."""
    q = 1.0 - (1.0 - cos_in * cos_in) / (eta * eta)
    if q <= 0.0:
        return 1.0, 0.0
    cos_out = math.sqrt(q)
    rs = (cos_in - eta * cos_out) / (cos_in + eta * cos_out)
    rp = (eta * cos_in - cos_out) / (eta * cos_in + cos_out)
    return 0.5 * (rs * rs + rp * rp), cos_out


@jit
def visible_facet(wx: Any, wy: Any, wz: Any, alpha: Any, rng: Any) -> Any:
    """GGX microfacet normal as seen from w, which may lie below the horizon (Dupuy & Benyoub 2023, doi:10.1111/cgf.14867)."""
    vx, vy, vz = alpha * wx, alpha * wy, wz
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx / length, vy / length, vz / length
    phi = 2.0 * math.pi * uniform(rng)
    cz = (1.0 - uniform(rng)) * (1.0 + vz) - vz
    s = math.sqrt(max(0.0, 1.0 - cz * cz))
    mx, my, mz = alpha * (s * math.cos(phi) + vx), alpha * (s * math.sin(phi) + vy), max(cz + vz, 1e-12)
    length = math.sqrt(mx * mx + my * my + mz * mz)
    return mx / length, my / length, mz / length


@jit
def climb(cos: Any, level: Any, alpha: Any, rng: Any) -> Any:
    """Level at which a ray of slope `cos` meets a GGX microsurface again: the share of the microsurface below it; -1 if it leaves upwards.

    The random walk of Heitz, Hanika, d'Eon & Dachsbacher 2016 (doi:10.1145/2897824.2925943), for heights distributed uniformly.
    """
    spread = math.sqrt(1.0 + alpha * alpha * (1.0 / (cos * cos) - 1.0))
    smith = 0.5 * (-1.0 + spread) if cos > 0.0 else 0.5 * (-1.0 - spread)
    u = uniform(rng)
    if cos > 0.0 and u >= 1.0 - level**smith:
        return -1.0
    return level / (1.0 - u) ** (1.0 / smith)


@jit
def facet_event(d: Any, outside: Any, alpha: Any, index: Any, rng: Any) -> Any:
    """Meet one facet of the microsurface: (reflectance, reflected direction, refracted direction). Local frame, mean normal +z."""
    wx, wy, wz = -d[0], -d[1], -d[2]
    if alpha == 0.0:
        mx, my, mz = 0.0, 0.0, 1.0 if outside else -1.0
    elif outside:
        mx, my, mz = visible_facet(wx, wy, wz, alpha, rng)
    else:
        mx, my, mz = visible_facet(-wx, -wy, -wz, alpha, rng)
        mx, my, mz = -mx, -my, -mz
    cos = min(1.0, abs(wx * mx + wy * my + wz * mz))
    eta = index if outside else 1.0 / index
    reflectance, cos_out = fresnel(cos, eta)
    reflected = (2.0 * cos * mx - wx, 2.0 * cos * my - wy, 2.0 * cos * mz - wz)
    s = cos / eta - cos_out
    refracted = (s * mx - wx / eta, s * my - wy / eta, s * mz - wz / eta)
    return reflectance, reflected, refracted


@jit
def local_frame(n: Any) -> Any:
    """A right-handed frame (t, s, n) on the unit vector n (Duff et al. 2017, Journal of Computer Graphics Techniques 6(1))."""
    sign = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1]), n


@jit
def to_local(d: Any, frame: Any) -> Any:
    """Components of d along the frame's three vectors."""
    t, s, n = frame
    return (
        d[0] * t[0] + d[1] * t[1] + d[2] * t[2],
        d[0] * s[0] + d[1] * s[1] + d[2] * s[2],
        d[0] * n[0] + d[1] * n[1] + d[2] * n[2],
    )


@jit
def to_world(d: Any, frame: Any) -> Any:
    """Inverse of `to_local`; unit length is restored, for rounding adds up over many bounces."""
    t, s, n = frame
    x = d[0] * t[0] + d[1] * s[0] + d[2] * n[0]
    y = d[0] * t[1] + d[1] * s[1] + d[2] * n[1]
    z = d[0] * t[2] + d[1] * s[2] + d[2] * n[2]
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@jit
def density(d: Any, outside: Any, view: Any, level: Any, alpha: Any, index: Any) -> Any:
    """Probability per sr that a photon, meeting a facet at `level`, goes straight from it to `view`, outside, past all other facets.

    Reflected if it came from outside, refracted if from inside (Walter, Marschner, Li & Torrance 2007, equations 13 to 17,
    doi:10.2312/EGWR/EGSR07/195-206); masked as in `climb`. Local frame, view[2] > 0.
    """
    if outside:
        hx, hy, hz = view[0] - d[0], view[1] - d[1], view[2] - d[2]
    else:
        hx, hy, hz = index * d[0] - view[0], index * d[1] - view[1], index * d[2] - view[2]
    length2 = hx * hx + hy * hy + hz * hz
    length = math.sqrt(length2)
    cos_out = (view[0] * hx + view[1] * hy + view[2] * hz) / length
    cos = hz / length
    if cos_out <= 0.0 or cos <= 0.0:
        return 0.0
    alpha2 = alpha * alpha
    facets = alpha2 / (math.pi * (1.0 + cos * cos * (alpha2 - 1.0)) ** 2)
    slope = d[2] if not outside else -d[2]
    facets /= 0.5 * (slope + math.sqrt(slope * slope + alpha2 * (1.0 - slope * slope)))  # projected area of all that are seen along d
    masking = level ** (0.5 * (math.sqrt(1.0 + alpha2 * (1.0 / (view[2] * view[2]) - 1.0)) - 1.0))
    if outside:
        reflectance, _ = fresnel(cos_out, index)
        return 0.25 * reflectance * facets * masking
    cos_in = (d[0] * hx + d[1] * hy + d[2] * hz) / length
    reflectance, _ = fresnel(cos_in, 1.0 / index)
    return (1.0 - reflectance) * cos_in * cos_out / length2 * facets * masking


@jit
def score(scene: Any, site: Any, frame: Any, d: Any, outside: Any, level: Any, weight: Any, seen: Any, rng: Any) -> Any:
    """Add to `seen`, for each view, the f_r that this meeting with a facet is expected to give, if nothing stands in the line of sight."""
    petal = scene.petal
    for k in range(VIEWS):
        view = (scene.views[k, 0], scene.views[k, 1], scene.views[k, 2])
        local = to_local(view, frame)
        if local[2] <= 0.0:
            continue
        gain = weight * density(d, outside, local, level, petal.roughness, petal.refraction) / view[2]
        if gain < FAINT:
            if uniform(rng) * FAINT >= gain:
                continue
            gain = FAINT
        if next_surface(scene, site, view)[0] == ESCAPE:
            seen[k] += gain


@jit
def leave_surface(scene: Any, site: Any, frame: Any, d: Any, outside: Any, level: Any, weight: Any, seen: Any, rng: Any) -> Any:
    """Follow a photon among the facets until it leaves them: (direction, outside), local frame. Loses no energy and is reciprocal.

    `level` is 1 above all facets, 0 below all. Each meeting is scored; on a smooth surface none can be: it mirrors to one direction only.
    """
    alpha, refraction = scene.petal.roughness, scene.petal.refraction
    while True:
        if alpha == 0.0:
            if (d[2] > 0.0) == outside:
                return d, outside
        else:
            height = climb(d[2], level, alpha, rng) if outside else climb(-d[2], 1.0 - level, alpha, rng)
            if height < 0.0:
                return d, outside
            level = height if outside else 1.0 - height
            score(scene, site, frame, d, outside, level, weight, seen, rng)
        reflectance, reflected, refracted = facet_event(d, outside, alpha, refraction, rng)
        if uniform(rng) < reflectance:
            d = reflected
        else:
            d = refracted
            outside = not outside


@jit
def deflect(d: Any, g: Any, rng: Any) -> Any:
    """New direction after a Henyey-Greenstein scattering of mean cosine g (1941, doi:10.1086/144246)."""
    u = uniform(rng)
    if abs(g) < 1e-6:
        cos = 2.0 * u - 1.0
    else:
        q = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cos = min(1.0, max(-1.0, (1.0 + g * g - q * q) / (2.0 * g)))
    sin = math.sqrt(1.0 - cos * cos)
    phi = 2.0 * math.pi * uniform(rng)
    return to_world((sin * math.cos(phi), sin * math.sin(phi), cos), local_frame(d))


@jit
def spend(weight: Any, depth: Any, energy: Any, rng: Any) -> Any:
    """Weight left after an optical depth; a light photon then plays roulette, whose gain or loss is booked, so the books always balance."""
    left = weight * math.exp(-depth)
    energy[ABSORBED] += weight - left
    if left < ROULETTE_WEIGHT:
        after = ROULETTE_WEIGHT if uniform(rng) * ROULETTE_WEIGHT < left else 0.0
        energy[ROULETTE] += left - after
        return after
    return left


@jit
def cross_body(petal: Any, x: Any, y: Any, d: Any, weight: Any, energy: Any, rng: Any) -> Any:
    """Carry a photon down from z = 0 through epidermis, mesophyll and lower epidermis until it is back at z = 0.

    Returns (x, y, direction, weight); weight 0 says that it left below or was lost in the roulette.
    """
    layer, depth = 0, 0.0  # depth below the top of the layer
    while True:
        down = d[2] < 0.0
        if layer == 1:
            to_edge = (petal.mesophyll - depth) / -d[2] if down else depth / d[2]
            path = -math.log(1.0 - uniform(rng)) / petal.scattering if petal.scattering > 0.0 else math.inf
            if path < to_edge:
                x, y, depth = x + path * d[0], y + path * d[1], depth - path * d[2]
                weight = spend(weight, petal.absorption * path, energy, rng)
                if weight == 0.0:
                    return x, y, d, 0.0
                d = deflect(d, petal.anisotropy, rng)
                continue
            mu = petal.absorption
        else:
            thickness = petal.epidermis if layer == 0 else petal.lower_epidermis
            to_edge = thickness / abs(d[2])  # no scattering here: the photon always crosses all of it
            mu = petal.pigment if layer == 0 else petal.lower_pigment
        x, y = x + to_edge * d[0], y + to_edge * d[1]
        weight = spend(weight, mu * to_edge, energy, rng)
        if weight == 0.0:
            return x, y, d, 0.0
        if down and layer == 2:
            reflectance, _ = fresnel(-d[2], 1.0 / petal.refraction)
            if uniform(rng) >= reflectance + (1.0 - reflectance) * petal.backing:
                energy[TRANSMITTED] += weight
                return x, y, d, 0.0
            d = (d[0], d[1], -d[2])
        elif not down and layer == 0:
            return x, y, d, weight
        else:
            layer += 1 if down else -1
            depth = 0.0 if down else petal.mesophyll  # only the mesophyll asks for it


@jit
def record(scene: Any, d: Any, weight: Any, order: Any, books: Any) -> Any:
    """Book light that escapes upwards: energy, acceptance cones (they overlap when wider than half their step), bins."""
    books.energy[order] += weight
    cos, sin = scene.azimuth
    along = d[0] * cos + d[1] * sin
    across = d[1] * cos - d[0] * sin
    half = math.radians(CONE_HALF_ANGLE)
    if abs(across) <= math.sin(half):
        theta = math.degrees(math.atan2(along, d[2]))
        centre = 0.5 * (VIEWS - 1)
        first = max(0, math.ceil((theta - CONE_HALF_ANGLE) / VIEW_STEP + centre))
        last = min(VIEWS - 1, math.floor((theta + CONE_HALF_ANGLE) / VIEW_STEP + centre))
        for k in range(first, last + 1):
            node = math.radians((k - centre) * VIEW_STEP)
            if along * math.sin(node) + d[2] * math.cos(node) >= math.cos(half):
                books.cones[k] += weight
    row = min(THETA_BINS - 1, int(math.degrees(math.acos(min(1.0, d[2]))) * THETA_BINS / 90.0))
    column = min(PHI_BINS - 1, int(math.degrees(math.atan2(abs(across), along)) * PHI_BINS / 180.0))
    books.bins[row, column] += weight


@jit
def surface_frame(scene: Any, site: Any) -> Any:
    """Two tangents and the outward normal of the surface at a site."""
    if not site.on_dome:
        return local_frame((0.0, 0.0, 1.0))
    cx, cy = cell_centre(scene.petal, site.i, site.j)
    shape = cell_shape(scene.petal, scene.lattice, site.i, site.j)
    return local_frame(dome_normal(site.x - cx, site.y - cy, site.z, scene.petal.radius, shape))


@jit
def cross_cells(scene: Any, site: Any, d: Any, weight: Any, energy: Any, rng: Any) -> Any:
    """Carry a photon from the inner side of a site to where it meets the upper surface again.

    Returns (site, direction, weight); weight 0 as in `cross_body`.
    """
    petal = scene.petal
    x, y, z, i, j, on_dome = site
    while True:
        if not on_dome:
            x, y, d, weight = cross_body(petal, x, y, d, weight, energy, rng)
            z = 0.0
            i, j = cell_at(petal, x, y)
            cx, cy = cell_centre(petal, i, j)
            on_dome = (x - cx) ** 2 + (y - cy) ** 2 < petal.radius**2
            if weight == 0.0 or not on_dome:
                return Site(x, y, z, i, j, on_dome), d, weight
        # Through the dome, up to its surface or down to its foot.
        cx, cy = cell_centre(petal, i, j)
        _near, t = dome_roots(x - cx, y - cy, z, d[0], d[1], d[2], petal.radius, cell_shape(petal, scene.lattice, i, j))
        t_foot = -z / d[2] if d[2] < 0.0 else math.inf
        on_dome = t < t_foot
        t = max(0.0, min(t, t_foot))
        x, y, z = x + t * d[0], y + t * d[1], z + t * d[2]
        weight = spend(weight, petal.pigment * t, energy, rng)
        if weight == 0.0 or on_dome:
            return Site(x, y, z, i, j, on_dome), d, weight


@jit
def follow(scene: Any, site: Any, d: Any, outside: Any, weight: Any, books: Any, rng: Any) -> Any:
    """Follow a photon that leaves a site in direction d, outside or inside, until it escapes, is transmitted or is lost in the roulette."""
    order = SURFACE
    while True:
        if outside:
            kind, t, i, j = next_surface(scene, site, d)
            if kind == ESCAPE:
                record(scene, d, weight, order, books)
                return
            if kind == LOST:
                books.energy[STRAY] += weight
                return
            on_dome = kind == HIT_DOME
            site = Site(site.x + t * d[0], site.y + t * d[1], site.z + t * d[2] if on_dome else 0.0, i, j, on_dome)
        else:
            order = BODY
            site, d, weight = cross_cells(scene, site, d, weight, books.energy, rng)
            if weight == 0.0:
                return
        frame = surface_frame(scene, site)
        d, outside = leave_surface(scene, site, frame, to_local(d, frame), outside, 1.0 if outside else 0.0, weight, books.seen[order], rng)
        d = to_world(d, frame)


@jit
def shine(petal: Any, ceiling: Any, sin2_low: Any, sin2_high: Any, views: Any, books: Any, rng: Any) -> Any:
    """Send one photon of weight 1 on to the petal, and follow both branches of its first meeting with a facet."""
    rng[0] += _GOLDEN
    lattice = mix(rng[0])  # a petal of its own for every photon: the mean over petals
    sin2 = sin2_low + (sin2_high - sin2_low) * uniform(rng)
    turn = 2.0 * math.pi * uniform(rng)
    azimuth = (math.cos(turn), math.sin(turn))
    for k in range(VIEWS):
        node = math.radians((k - (VIEWS - 1) // 2) * VIEW_STEP)
        views[k, 0], views[k, 1], views[k, 2] = math.sin(node) * azimuth[0], math.sin(node) * azimuth[1], math.cos(node)
    scene = Scene(petal, lattice, ceiling, azimuth, views)
    sin = math.sqrt(sin2)
    d = (-sin * azimuth[0], -sin * azimuth[1], -math.sqrt(1.0 - sin2))
    u, v = uniform(rng), uniform(rng)
    x, y = petal.pitch * (u + 0.5 * v), petal.pitch * _SQRT3_2 * v
    i, j = cell_at(petal, x, y)
    kind, t, i, j = next_surface(scene, Site(x, y, ceiling, i, j, False), d)
    if kind == LOST:
        books.energy[STRAY] += 1.0
        return
    on_dome = kind == HIT_DOME
    site = Site(x + t * d[0], y + t * d[1], ceiling + t * d[2] if on_dome else 0.0, i, j, on_dome)
    frame = surface_frame(scene, site)
    local = to_local(d, frame)
    seen = books.seen[SURFACE]
    level = 1.0
    if petal.roughness > 0.0:
        level = climb(local[2], level, petal.roughness, rng)
        score(scene, site, frame, local, True, level, 1.0, seen, rng)
    reflectance, reflected, refracted = facet_event(local, True, petal.roughness, petal.refraction, rng)
    for above in (True, False):
        weight = reflectance if above else 1.0 - reflectance
        if weight > 0.0:
            branch = reflected if above else refracted
            local, outside = leave_surface(scene, site, frame, branch, above, level, weight, seen, rng)
            follow(scene, site, to_world(local, frame), outside, weight, books, rng)


@njit(cache=True, error_model="numpy", parallel=True)
def shine_batches(petal: Any, ceiling: Any, sin2_low: Any, sin2_high: Any, photons: Any, seeds: Any) -> Any:
    """Trace `photons` photons from each seed.

    A batch has its own random numbers and its own tallies, so the result does not depend on how many threads share the work.

    Returns
    -------
    energy (B, 6), f_r seen (B, 2, VIEWS), cones (B, VIEWS), bins (B, THETA_BINS, PHI_BINS) : tuple of ndarray
        Per photon. `cones` and `bins` hold energy.
    """
    batches = seeds.size
    energy = np.zeros((batches, 6))
    seen = np.zeros((batches, 2, VIEWS))
    cones = np.zeros((batches, VIEWS))
    bins = np.zeros((batches, THETA_BINS, PHI_BINS))
    for b in prange(batches):
        rng = np.empty(1, np.uint64)
        rng[0] = seeds[b]
        views = np.empty((VIEWS, 3))
        books = Books(energy[b], seen[b], cones[b], bins[b])
        for _ in range(photons):
            shine(petal, ceiling, sin2_low, sin2_high, views, books, rng)
    return energy / photons, seen / photons, cones / photons, bins / photons
