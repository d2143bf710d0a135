"""Rays among domes in hexagonal packing (numba kernels): through dielectric ones for body light, between opaque ones for interreflection.

A dome is the convex body (z / h)^q + r^p <= 1, z >= 0. It lies inside its own hexagon of the packing, so a ray outside goes from hexagon to
hexagon and meets one dome at a time. Along a ray the body's function is convex too: Newton from outside runs up to the wall and never past
it, and a ray that misses is known to miss.

At every wall the ray splits by Fresnel's equations for unpolarised light; small shares are drawn by lot instead. A ray's light is never
dropped: it reaches the tissue below, leaves into the air, or is counted as lost after EVENTS walls.

Paths are kept as four moments a bin: what `body.gauss` makes two nodes of.

Kernels of both `fitting.body` and `fitting.orders` are in this one file because numba's cache looks at the file of the cached function
only: a kernel that calls `march` from elsewhere would go on with the `march` it was compiled with. They are serial and let go of the
interpreter's lock; `on_all_cores` spreads them over threads. Whatever is drawn by lot or summed belongs to one call, so results are the
same however many threads there are.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fitting.cells import Cell
from fitting.progress import Progress, silent

Array = NDArray[np.float64]
Result = TypeVar("Result")

ESCAPED, DOME, FLOOR, LOST = 0, 1, 2, 3
EVENTS = 1000
"""Walls after which a ray counts as lost."""
HEXAGONS = 100_000
"""Hexagons after which a ray counts as lost."""
SPLIT = 0.004
"""Shares of light smaller than this are drawn by lot."""
STACK = 256


class Domes(NamedTuple):
    """Domes z = h (1 - r^p)^(1/q) and the distance of neighbours, in base radii; h = 0 is a flat face."""

    h: float
    p: float
    q: float
    pitch: float

    @classmethod
    def of(cls, cell: Cell | None) -> Domes:
        """Take a cell's numbers; None is a flat face."""
        if cell is None:
            return cls(0.0, 2.0, 2.0, 2.0)
        return cls(float(cell.stretch), float(cell.p), float(cell.q), float(cell.pitch))


class Layer(NamedTuple):
    """What body light goes through.

    Attributes
    ----------
    domes : Domes
        On top.
    depth : float
        Of the slab below them, base radii.
    n : float
        Refractive index of both.
    edges : ndarray, shape (b,)
        Lower bounds of the bins of path, the first 0, geometric from the second on.
    """

    domes: Domes
    depth: float
    n: float
    edges: Array


class Tally(NamedTuple):
    """Where light went; kernels add to it.

    Attributes
    ----------
    reached : ndarray, shape (j, b, 4)
        Light at the tissue by its stream, even in the square of the sine of its angle, and by its path: moments 0 to 3 in each bin.
    escaped : ndarray, shape (b, 4)
        Light in the air, but for `shares`.
    shares : ndarray, shape (3,)
        Light turned away by one dome, by the floor, and lost.
    stray : ndarray, shape (i, r, p)
        `escaped` by the directions of light and view, `spread`. Of size 0 where nobody asks.
    """

    reached: Array
    escaped: Array
    shares: Array
    stray: Array

    @classmethod
    def empty(cls, rows: int, streams: int, bins: int, nodes: tuple[int, int, int] = (0, 0, 0)) -> Tally:
        """Make tallies of several rows at once, a leading axis each."""
        shapes = (streams, bins, 4), (bins, 4), (3,), nodes
        return cls(*(np.zeros((rows, *shape)) for shape in shapes))

    def row(self, k: int) -> Tally:
        """One of them."""
        return Tally(*(part[k] for part in self))


def on_all_cores(task: Callable[[int], Result], count: int, progress: Progress = silent) -> list[Result]:
    """Results of task(0) to task(count - 1), in this order; `progress` is told the share done."""
    if count == 1:
        return [task(0)]
    found: list[Result] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for result in pool.map(task, range(count)):
            found.append(result)
            progress(len(found) / count)
    return found


@njit(cache=True, nogil=True, inline="always")
def power(x: float, e: float) -> float:
    """x^e, x >= 0; quick for ellipsoids."""
    if e == 2.0:
        return x * x
    if e == 1.0:
        return x
    return float(x**e)


@njit(cache=True, nogil=True)
def wall(x: float, y: float, z: float, dx: float, dy: float, dz: float, domes: Domes) -> tuple[float, float]:
    """(z / h)^q + r^p - 1 at a point and its slope along a direction."""
    h, p, q, _ = domes
    r = math.sqrt(x * x + y * y)
    s = max(0.0, z) / h
    slope = q * power(s, q - 1) * dz / h
    if r > 0:
        slope += p * power(r, p - 1) * (x * dx + y * dy) / r
    return power(s, q) + power(r, p) - 1, slope


@njit(cache=True, nogil=True)
def enter(x: float, y: float, z: float, dx: float, dy: float, dz: float, domes: Domes, end: float) -> float:
    """Way to the dome at the origin from a point outside it, -1 where there is none shorter than `end`."""
    t = 0.0
    for _ in range(100):
        g, slope = wall(x + t * dx, y + t * dy, z + t * dz, dx, dy, dz, domes)
        if g <= 0 and slope < 0:
            return t
        if slope >= 0:
            return -1.0
        step = -g / slope
        t += step
        if t > end:
            return -1.0
        if step < 1e-13 * (1 + t):
            return t
    return t


@njit(cache=True, nogil=True)
def leave(x: float, y: float, z: float, dx: float, dy: float, dz: float, domes: Domes) -> tuple[float, bool]:
    """Way out of the dome at the origin, and whether it leads through the base."""
    flat = dx * dx + dy * dy
    t = math.inf
    if flat > 0:
        ahead = x * dx + y * dy
        t = (math.sqrt(max(0.0, ahead * ahead - flat * (x * x + y * y - 1))) - ahead) / flat
    if dz < 0 and -z / dz <= t:
        return max(0.0, -z / dz), True
    if dz > 0:
        t = min(t, (domes.h - z) / dz)
    for _ in range(100):
        g, slope = wall(x + t * dx, y + t * dy, z + t * dz, dx, dy, dz, domes)
        if g <= 0 or slope <= 0:
            break
        step = g / slope
        t -= step
        if step < 1e-13 * (1 + t):
            break
    return max(0.0, t), False


@njit(cache=True, nogil=True)
def march(x: float, y: float, z: float, dx: float, dy: float, dz: float, domes: Domes, from_dome: bool) -> tuple[int, float, float, float]:
    """Follow a ray outside the domes, 0 <= z <= h: what it meets, and where as seen from that hexagon's centre."""
    h, pitch = domes.h, domes.pitch
    half, root = pitch / 2, math.sqrt(3) / 2
    skip = from_dome or h == 0
    for _ in range(HEXAGONS):
        floor = -z / dz if dz < 0 else math.inf
        top = (h - z) / dz if dz > 0 else math.inf
        edge, ex, ey = math.inf, 0.0, 0.0
        for side in range(3):
            ax, ay = (1.0, 0.0) if side == 0 else ((0.5, root) if side == 1 else (-0.5, root))
            along = dx * ax + dy * ay
            if along != 0:
                sign = 1.0 if along > 0 else -1.0
                t = (half - sign * (x * ax + y * ay)) / abs(along)
                if t < edge:
                    edge, ex, ey = t, sign * ax, sign * ay
        end = max(0.0, min(edge, floor, top))
        if not skip:
            t = enter(x, y, z, dx, dy, dz, domes, end)
            if t >= 0:
                return DOME, x + t * dx, y + t * dy, max(0.0, z + t * dz)
        skip = h == 0
        x, y, z = x + end * dx, y + end * dy, z + end * dz
        if dz > 0 and top <= edge:
            return ESCAPED, x, y, z
        if dz < 0 and floor <= edge:
            return FLOOR, x, y, 0.0
        x, y, z = x - pitch * ex, y - pitch * ey, min(max(0.0, z), h)
    return LOST, x, y, z


@njit(cache=True, nogil=True)
def normal(x: float, y: float, z: float, domes: Domes) -> tuple[float, float, float]:
    """Outward normal of a dome at a point of its wall."""
    h, p, q, _ = domes
    r = math.sqrt(x * x + y * y)
    along = p * power(r, p - 1)
    up = q * power(max(0.0, z) / h, q - 1) / h
    length = math.sqrt(along * along + up * up)
    if r == 0 or length == 0:
        return 0.0, 0.0, 1.0
    return along * x / r / length, along * y / r / length, up / length


@njit(cache=True, nogil=True)
def fresnel(cos_i: float, n: float) -> tuple[float, float]:
    """Reflected share of unpolarised light and cosine of the refracted ray, 1 and 0 at total reflection; n: index ahead over behind."""
    sin2 = (1 - cos_i * cos_i) / (n * n)
    if sin2 >= 1:
        return 1.0, 0.0
    cos_t = math.sqrt(1 - sin2)
    s = (cos_i - n * cos_t) / (cos_i + n * cos_t)
    p = (n * cos_i - cos_t) / (n * cos_i + cos_t)
    return (s * s + p * p) / 2, cos_t


@njit(cache=True, nogil=True)
def deposit(row: Array, weight: float, path: float, edges: Array) -> None:
    """Add light to its bin of path: moments 0 to 3 about the bin's middle, in half-widths. The last bin has no end."""
    last = len(edges) - 1
    b = 0
    if path >= edges[1]:
        b = min(last, 1 + int(math.log(path / edges[1]) / math.log(edges[2] / edges[1])))
    low = edges[b]
    half = (edges[b + 1] - low) / 2 if b < last else low
    t = (path - low) / half - 1
    for moment in range(4):
        row[b, moment] += weight
        weight *= t


@njit(cache=True, nogil=True)
def push(row: Array, x: float, y: float, z: float, dx: float, dy: float, dz: float, weight: float, path: float) -> None:
    """Keep a ray for later."""
    row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7] = x, y, z, dx, dy, dz, weight, path


@njit(cache=True, nogil=True)
def spread(nodes: Array, weight: float, theta_i: float, theta_r: float, phi: float) -> None:
    """Add light to the nodes around a pair of directions (rad), each even from 0 to 90, 90 and 180 deg, by their hat functions."""
    a = theta_i / (math.pi / 2) * (nodes.shape[0] - 1)
    b = theta_r / (math.pi / 2) * (nodes.shape[1] - 1)
    c = phi / math.pi * (nodes.shape[2] - 1)
    i, j, k = min(int(a), nodes.shape[0] - 2), min(int(b), nodes.shape[1] - 2), min(int(c), nodes.shape[2] - 2)
    a, b, c = a - i, b - j, c - k
    for x in range(2):
        for y in range(2):
            part = weight * (a if x else 1 - a) * (b if y else 1 - b)
            nodes[i + x, j + y, k] += part * (1 - c)
            nodes[i + x, j + y, k + 1] += part * c


@njit(cache=True, nogil=True)
def follow(
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    weight: float,
    path: float,
    within: bool,
    first: int,
    layer: Layer,
    tally: Tally,
) -> None:
    """Follow a ray and all that it splits into.

    Parameters
    ----------
    x, y, z, dx, dy, dz : float
        Start, as seen from its hexagon's centre, and direction of flight; lengths in base radii.
    weight, path : float
        Its light, and the way it has already gone in the pigmented medium.
    within : bool
        Whether it starts inside the dome.
    first : int
        What it has met: 0 nothing, 1 one dome that turned it away, 2 the floor alike, 3 anything else.
    layer : Layer
        What it goes through.
    tally : Tally
        Added to.
    """
    domes, depth, n, edges = layer
    reached, escaped, shares, stray = tally
    streams = reached.shape[0]
    ix, iy, theta_i = dx, dy, math.acos(min(1.0, abs(dz)))
    stack = np.empty((STACK, 8))
    inside, met = np.empty(STACK, np.bool_), np.empty(STACK, np.int64)
    push(stack[0], x, y, z, dx, dy, dz, weight, path)
    inside[0], met[0] = within, first
    size = 1
    on_dome = False
    while size:
        size -= 1
        x, y, z, dx, dy, dz, weight, path = stack[size]
        within, first = inside[size], met[size]
        for event in range(EVENTS + 1):
            if event == EVENTS:
                shares[2] += weight
                break
            if within:
                t, base = leave(x, y, z, dx, dy, dz, domes)
                x, y, z = x + t * dx, y + t * dy, z + t * dz
                path += t
                what = FLOOR if base else DOME
            else:
                what, x, y, z = march(x, y, z, dx, dy, dz, domes, on_dome)
            if what == LOST:
                shares[2] += weight
                break
            if what == ESCAPED:
                if first == 1 or first == 2:
                    shares[first - 1] += weight
                else:
                    deposit(escaped, weight, path, edges)
                    if stray.size:
                        turned = abs(math.atan2(ix * dy - iy * dx, -(ix * dx + iy * dy)))
                        spread(stray, weight, theta_i, math.acos(min(1.0, dz)), turned)
                break
            if within and what == FLOOR:
                j = min(streams - 1, int(streams * (dx * dx + dy * dy)))
                deposit(reached[j], weight, path + depth / max(-dz, 1e-9), edges)
                break
            nx, ny, nz = (0.0, 0.0, 1.0) if what == FLOOR else normal(x, y, z, domes)
            ratio = n
            if within:
                nx, ny, nz, ratio = -nx, -ny, -nz, 1 / n
            cos_i = min(1.0, max(0.0, -(dx * nx + dy * ny + dz * nz)))
            share, cos_t = fresnel(cos_i, ratio)
            tx = (dx + cos_i * nx) / ratio - cos_t * nx
            ty = (dy + cos_i * ny) / ratio - cos_t * ny
            tz = (dz + cos_i * nz) / ratio - cos_t * nz
            if what == FLOOR:  # the refracted part meets nothing more
                j = min(streams - 1, int(streams * (tx * tx + ty * ty)))
                deposit(reached[j], weight * (1 - share), path + depth / max(-tz, 1e-9), edges)
                weight *= share
                refract = False
            elif share == 1.0:
                refract = False
            elif weight * min(share, 1 - share) > SPLIT and size < STACK:
                # The smaller part waits.
                refract = share < 0.5
                part = share if refract else 1 - share
                if refract:
                    rx, ry, rz = dx + 2 * cos_i * nx, dy + 2 * cos_i * ny, dz + 2 * cos_i * nz
                else:
                    rx, ry, rz = tx, ty, tz
                push(stack[size], x, y, z, rx, ry, rz, weight * part, path)
                inside[size] = within == refract
                met[size] = 1 if refract and first == 0 else 3
                size += 1
                weight *= 1 - part
            else:
                refract = np.random.random() >= share  # noqa: NPY002 - numba's own generator, seeded by the caller
            if refract:
                dx, dy, dz = tx, ty, tz
                within, first = not within, 3
            else:
                dx, dy, dz = dx + 2 * cos_i * nx, dy + 2 * cos_i * ny, dz + 2 * cos_i * nz
                first = (1 if what == DOME else 2) if first == 0 else 3
            on_dome = what == DOME
            if weight == 0.0:
                break
        on_dome = True  # whatever waits, waits at a dome's wall


@njit(cache=True, nogil=True)
def into_hexagon(u: float, v: float, pitch: float) -> tuple[float, float]:
    """Even over the unit square to even over the hexagon about the origin."""
    x, y = pitch * (u + v / 2), pitch * v * math.sqrt(3) / 2
    best, bx, by = math.inf, x, y
    for i in range(2):
        for j in range(2):
            cx, cy = x - pitch * (i + j / 2), y - pitch * j * math.sqrt(3) / 2
            if cx * cx + cy * cy < best:
                best, bx, by = cx * cx + cy * cy, cx, cy
    return bx, by


@njit(cache=True, nogil=True)
def start(point: Array, shift: Array, pitch: float) -> tuple[float, float, float, float]:
    """Place in the hexagon, and cosine and sine of an azimuth within 60 deg, from three numbers 0 .. 1, moved around by `shift`."""
    x, y = into_hexagon((point[0] + shift[0]) % 1, (point[1] + shift[1]) % 1, pitch)
    azimuth = (point[2] + shift[2]) % 1 * math.pi / 3
    return x, y, math.cos(azimuth), math.sin(azimuth)


@njit(cache=True, nogil=True)
def trace_down(theta: Array, points: Array, shift: Array, seed: int, layer: Layer, tally: Tally) -> None:
    """Light from the air.

    Parameters
    ----------
    theta : ndarray, shape (m,), rad
        Incidence of each ray.
    points, shift : ndarray, shape (m, 4) and (4,)
        Place in the cell and azimuth, as `start` takes them; the fourth is not used here.
    seed : int
        Of the shares drawn by lot.
    layer, tally
        As in `follow`.
    """
    np.random.seed(seed)  # noqa: NPY002
    for m in range(len(theta)):
        x, y, ca, sa = start(points[m], shift, layer.domes.pitch)
        sin, cos = math.sin(theta[m]), math.cos(theta[m])
        follow(x, y, layer.domes.h, -sin * ca, -sin * sa, -cos, 1.0, 0.0, False, 0, layer, tally)


@njit(cache=True, nogil=True)
def trace_up(stream: int, points: Array, shift: Array, seed: int, layer: Layer, tally: Tally) -> None:
    """Light from the tissue in one of its streams, the fourth number of a point being the place in it; the rest as for `trace_down`."""
    np.random.seed(seed)  # noqa: NPY002
    h, n = layer.domes.h, layer.n
    for m in range(len(points)):
        x, y, ca, sa = start(points[m], shift, layer.domes.pitch)
        sin2 = (stream + (points[m, 3] + shift[3]) % 1) / len(tally.reached)
        sin, cos = math.sqrt(sin2), max(1e-9, math.sqrt(1 - sin2))
        path = layer.depth / cos
        if h > 0 and x * x + y * y < 1:
            follow(x, y, 0.0, sin * ca, sin * sa, cos, 1.0, path, True, 3, layer, tally)
            continue
        # The floor of a gap, from below.
        share, cos_t = fresnel(cos, 1 / n)
        deposit(tally.reached[stream], share, 2 * path, layer.edges)
        if share < 1:
            follow(x, y, 0.0, n * sin * ca, n * sin * sa, cos_t, 1 - share, path, False, 3, layer, tally)


@njit(cache=True, nogil=True)
def mirror_density(tilt: float, domes: Domes) -> tuple[float, float, float]:
    """Where a dome's normal has a tilt: r, z, and the dome's area per solid angle of its normals (1 / Gaussian curvature); 0 if nowhere.

    The slope s = h p / q r^(p-1) (1 - r^p)^(1/q-1) of a convex profile grows with r: bisection in r, or in 1 - r^p near the rim.
    """
    h, p, q, _ = domes
    tan = math.tan(tilt)
    if tan < 1e-9:
        return 0.0, h, (0.0 if p < 2 else (math.inf if p > 2 else (q / (2 * h)) ** 2))
    if p == 2.0 and q == 2.0:
        rest = h * h / (h * h + tan * tan)
        r = tan / math.sqrt(h * h + tan * tan)
    else:
        inner = h * p / q * 0.5 ** ((p - 1) / p + 1 / q - 1) >= tan
        low, high = 0.0, (0.5 ** (1 / p) if inner else 0.5)
        middle = r = rest = 0.0
        for _ in range(200):
            middle = (low + high) / 2
            r, rest = (middle, 1 - power(middle, p)) if inner else ((1 - middle) ** (1 / p), middle)
            if middle in (low, high):
                break
            if (h * p / q * power(r, p - 1) * rest ** (1 / q - 1) < tan) == inner:
                low = middle
            else:
                high = middle
        if low == 0.0:  # steeper than the rim, or flatter than a pointed top
            return 0.0, 0.0, 0.0
    # K = s s' / (r (1 + s^2)^2)
    s_over_r = tan / r
    growth = s_over_r * (p - 1 + (1 - 1 / q) * p * power(r, p) / rest)
    cos2 = 1 / (1 + tan * tan)
    return r, h * rest ** (1 / q), 1 / (s_over_r * growth * cos2 * cos2)


@njit(cache=True, nogil=True)
def mirror(wi: Array, wo: Array, domes: Domes, n: float, turns: int) -> Array:
    """Light turned once by the domes' walls, in 1/sr, averaged over `turns` azimuths of the lattice.

    F D G / (4 cos cos), with the normals' density D of the dome itself and G the exact share of azimuths in which light and view both clear
    the neighbours (Torrance and Sparrow; Walter et al. 2007, eq. 20).

    Parameters
    ----------
    wi, wo : ndarray, shape (m, 3)
        Unit vectors away from the surface, above its horizon.
    domes, n : Domes, float
        As in `Layer`.
    turns : int
        As above.

    Returns
    -------
    ndarray, shape (m,)
    """
    area = domes.pitch * domes.pitch * math.sqrt(3) / 2
    out = np.zeros(len(wi))
    for m in range(len(wi)):
        hx, hy, hz = wi[m, 0] + wo[m, 0], wi[m, 1] + wo[m, 1], wi[m, 2] + wo[m, 2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / length, hy / length, hz / length
        flat = math.hypot(hx, hy)
        r, z, density = mirror_density(math.atan2(flat, hz), domes)
        if density == 0.0:
            continue
        share, _ = fresnel(min(1.0, wi[m, 0] * hx + wi[m, 1] * hy + wi[m, 2] * hz), n)
        ux, uy = (hx / flat, hy / flat) if flat > 0 else (1.0, 0.0)
        clear = 0
        for turn in range(turns):
            a = (turn + 0.5) * math.pi / 3 / turns - math.atan2(uy, ux)  # from the half vector, so that light and view may be swapped
            sin, cos = math.sin(a), math.cos(a)
            x, y = r * (ux * cos - uy * sin), r * (ux * sin + uy * cos)
            free = True
            for w in (wi[m], wo[m]):
                dx, dy = w[0] * cos - w[1] * sin, w[0] * sin + w[1] * cos
                what, _x, _y, _z = march(x, y, z, dx, dy, w[2], domes, True)
                if what != ESCAPED:
                    free = False
                    break
            if free:
                clear += 1
        out[m] = share * density / area * clear / turns / (4 * wi[m, 2] * wo[m, 2])
    return out


@njit(cache=True, nogil=True)
def gap_azimuth(share: float, pitch: float) -> float:
    """Azimuth, 0 to 60 deg, below which lies that share of the floor between rim and hexagon."""
    far2 = pitch * pitch / 4
    # The floor up to an azimuth off a neighbour's is far2 tan(off) - off, doubled; Newton from the end, where it is steepest.
    within = min(share, 1 - share) * 2 * (far2 * math.tan(math.pi / 6) - math.pi / 6)
    off = math.pi / 6
    for _ in range(60):
        tan = math.tan(off)
        slope = far2 * (1 + tan * tan) - 1
        step = (far2 * tan - off - within) / slope if slope > 0 else 0.0
        off -= step
        if abs(step) < 1e-12:
            break
    return off if share < 0.5 else math.pi / 3 - off


@njit(cache=True, nogil=True)
def cast(edges: Array, sectors: int, facet: int, move: float, sobol: Array, domes: Domes) -> NDArray[np.int64]:
    """Count where Lambert rays from one facet arrive.

    Parameters
    ----------
    edges : ndarray, shape (rings + 1,), rad
        Bounds of the rings of facets in tau, r = sin(tau)^(2/p), rim last.
    sectors : int
        Facets in a ring. Facets are numbered ring by ring from the tip; then come the six sixths of the floor.
    facet : int
        From which.
    move : float
        By how much the rays' numbers are moved around, 0 .. 1 (Cranley and Patterson): were they the same for all facets, errors would add.
    sobol : ndarray, shape (m, 4)
        Place on the facet and direction of each ray, 0 .. 1.
    domes : Domes
        The shape.

    Returns
    -------
    ndarray of int, shape (facets + 2,)
        The last two are the sky and rays that did not end.
    """
    h, p, q, pitch = domes
    rings = len(edges) - 1
    row, sector = facet // sectors, facet % sectors
    count = rings * sectors + 6
    out = np.zeros(count + 2, np.int64)
    for n in range(len(sobol)):
        aside = (sobol[n, 1] + move) % 1
        azimuth = 2 * math.pi * (sector + aside) / sectors if row < rings else gap_azimuth(aside, pitch) + sector * math.pi / 3
        ca, sa = math.cos(azimuth), math.sin(azimuth)
        if row < rings:
            tau = edges[row] + (edges[row + 1] - edges[row]) * ((sobol[n, 0] + move) % 1)
            r, z = math.sin(tau) ** (2 / p), h * math.cos(tau) ** (2 / q)
            up, along = q * (max(z, 0.0) / h) ** (q - 1) / h, p * r ** (p - 1)
            length = math.hypot(up, along)
            up, along = up / length, along / length
        else:
            # The floor reaches from the rim to the hexagon's edge, wherever that is at this azimuth.
            off = (azimuth + math.pi / 6) % (math.pi / 3) - math.pi / 6
            far = pitch / 2 / math.cos(off)
            r, z = math.sqrt(1 + (far * far - 1) * ((sobol[n, 0] + move) % 1)), 0.0
            up, along = 1.0, 0.0
        sin2 = (sobol[n, 2] + move) % 1
        sin, cos, turn = math.sqrt(sin2), math.sqrt(1 - sin2), 2 * math.pi * ((sobol[n, 3] + move) % 1)
        s, t = sin * math.cos(turn), sin * math.sin(turn)
        # About the normal (along, 0, up) in the plane of azimuth: downhill (up, 0, -along), and sideways.
        radial, dz = cos * along + s * up, cos * up - s * along
        dx, dy = radial * ca - t * sa, radial * sa + t * ca
        if dz >= 0 and z >= h:
            what, x, y, height = ESCAPED, 0.0, 0.0, 0.0
        else:
            what, x, y, height = march(r * ca, r * sa, z, dx, dy, dz, domes, row < rings)
        if what == ESCAPED:
            out[count] += 1
            continue
        if what == LOST:
            out[count + 1] += 1
            continue
        where = math.atan2(y, x) / (2 * math.pi) % 1
        if what == DOME:
            # From whichever coordinate is the better known there.
            flat = min(1.0, math.hypot(x, y)) ** (p / 2)
            steep = min(1.0, max(0.0, height / h)) ** (q / 2)
            angle = math.atan2(flat, steep)
            hit = 0
            while hit < rings - 1 and angle > edges[hit + 1]:
                hit += 1
            out[hit * sectors + min(sectors - 1, int(where * sectors))] += 1
        else:
            out[rings * sectors + min(5, int(where * 6))] += 1
    return out
