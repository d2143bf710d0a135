"""Rays through one face of a petal: smooth dielectric domes in hexagonal packing over a slab of the same stuff (numba kernels).

A dome is the convex body (z / h)^q + r^p <= 1, z >= 0. It lies inside its own hexagon of the packing, so a ray outside goes from hexagon to
hexagon and meets one dome at a time. Along a ray the body's function is convex too: Newton from outside runs up to the wall and never past
it, and a ray that misses is known to miss.

At every wall the ray splits by Fresnel's equations for unpolarised light; small shares are drawn by lot instead. A ray's light is never
dropped: it reaches the tissue below, leaves into the air, or is counted as lost after EVENTS walls.

Paths are kept as four moments a bin: what `body.gauss` makes two nodes of.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[np.float64]

ESCAPED, DOME, FLOOR, LOST = 0, 1, 2, 3
EVENTS = 1000
"""Walls after which a ray counts as lost."""
HEXAGONS = 100_000
"""Hexagons after which a ray counts as lost."""
SPLIT = 0.004
"""Shares of light smaller than this are drawn by lot."""
STACK = 256


@njit(cache=True, nogil=True, inline="always")
def power(x: float, e: float) -> float:
    """x^e, x >= 0; quick for ellipsoids."""
    if e == 2.0:
        return x * x
    if e == 1.0:
        return x
    return float(x**e)


@njit(cache=True, nogil=True)
def wall(x: float, y: float, z: float, dx: float, dy: float, dz: float, h: float, p: float, q: float) -> tuple[float, float]:
    """(z / h)^q + r^p - 1 at a point and its slope along a direction."""
    r = math.sqrt(x * x + y * y)
    s = max(0.0, z) / h
    slope = q * power(s, q - 1) * dz / h
    if r > 0:
        slope += p * power(r, p - 1) * (x * dx + y * dy) / r
    return power(s, q) + power(r, p) - 1, slope


@njit(cache=True, nogil=True)
def enter(x: float, y: float, z: float, dx: float, dy: float, dz: float, h: float, p: float, q: float, end: float) -> float:
    """Way to the dome at the origin from a point outside it, -1 where there is none shorter than `end`."""
    t = 0.0
    for _ in range(100):
        g, slope = wall(x + t * dx, y + t * dy, z + t * dz, dx, dy, dz, h, p, q)
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
def leave(x: float, y: float, z: float, dx: float, dy: float, dz: float, h: float, p: float, q: float) -> tuple[float, bool]:
    """Way out of the dome at the origin, and whether it leads through the base."""
    flat = dx * dx + dy * dy
    t = math.inf
    if flat > 0:
        ahead = x * dx + y * dy
        t = (math.sqrt(max(0.0, ahead * ahead - flat * (x * x + y * y - 1))) - ahead) / flat
    if dz < 0 and -z / dz <= t:
        return max(0.0, -z / dz), True
    if dz > 0:
        t = min(t, (h - z) / dz)
    for _ in range(100):
        g, slope = wall(x + t * dx, y + t * dy, z + t * dz, dx, dy, dz, h, p, q)
        if g <= 0 or slope <= 0:
            break
        step = g / slope
        t -= step
        if step < 1e-13 * (1 + t):
            break
    return max(0.0, t), False


@njit(cache=True, nogil=True)
def march(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, h: float, p: float, q: float, pitch: float, from_dome: bool
) -> tuple[int, float, float, float]:
    """Follow a ray outside the domes, 0 <= z <= h: what it meets, and where as seen from that hexagon's centre."""
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
            t = enter(x, y, z, dx, dy, dz, h, p, q, end)
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
def normal(x: float, y: float, z: float, h: float, p: float, q: float) -> tuple[float, float, float]:
    """Outward normal of a dome at a point of its wall."""
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
    within: int,
    first: int,
    h: float,
    p: float,
    q: float,
    pitch: float,
    depth: float,
    n: float,
    edges: Array,
    reached: Array,
    escaped: Array,
    shares: Array,
    stray: Array,
) -> None:
    """Follow a ray and all that it splits into.

    Parameters
    ----------
    x, y, z, dx, dy, dz : float
        Start, as seen from its hexagon's centre, and direction of flight; lengths in base radii.
    weight, path : float
        Its light, and the way it has already gone in the pigmented medium.
    within : int
        1 where it starts inside the dome, 0 outside.
    first : int
        What it has met: 0 nothing, 1 one dome that turned it away, 2 the floor alike, 3 anything else.
    h, p, q, pitch, depth, n : float
        Of the domes, the slab below them, and the refractive index.
    edges : ndarray, shape (b,)
        Lower bounds of the bins of path, the first 0, geometric from the second on.
    reached : ndarray, shape (j, b, 4)
        Added to: light at the tissue by the square of the sine of its angle.
    escaped : ndarray, shape (b, 4)
        Added to: light in the air, but for `shares`.
    shares : ndarray, shape (3,)
        Added to: light turned away by one dome, by the floor, and lost.
    stray : ndarray, shape (i, r, p)
        Added to: `escaped` by the directions of light and view, `spread`. Of size 0 for rays from below.
    """
    streams = reached.shape[0]
    ix, iy, theta_i = dx, dy, math.acos(min(1.0, abs(dz)))
    stack = np.empty((STACK, 8))
    tags = np.empty((STACK, 2), np.int64)  # within, first
    push(stack[0], x, y, z, dx, dy, dz, weight, path)
    tags[0, 0], tags[0, 1] = within, first
    size = 1
    on_dome = False
    while size:
        size -= 1
        x, y, z, dx, dy, dz, weight, path = stack[size]
        within, first = tags[size]
        for event in range(EVENTS + 1):
            if event == EVENTS:
                shares[2] += weight
                break
            if within:
                t, base = leave(x, y, z, dx, dy, dz, h, p, q)
                x, y, z = x + t * dx, y + t * dy, z + t * dz
                path += t
                what = FLOOR if base else DOME
            else:
                what, x, y, z = march(x, y, z, dx, dy, dz, h, p, q, pitch, on_dome)
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
            nx, ny, nz = (0.0, 0.0, 1.0) if what == FLOOR else normal(x, y, z, h, p, q)
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
                tags[size, 0] = within if refract else 1 - within
                tags[size, 1] = (1 if first == 0 else 3) if refract else 3
                size += 1
                weight *= 1 - part
            else:
                refract = np.random.random() >= share  # noqa: NPY002 - numba's own generator, seeded by the caller
            if refract:
                dx, dy, dz = tx, ty, tz
                within, first = 1 - within, 3
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


@njit(cache=True, nogil=True, parallel=True)
def trace_down(
    theta: Array,
    points: Array,
    shifts: Array,
    seed: int,
    h: float,
    p: float,
    q: float,
    pitch: float,
    depth: float,
    n: float,
    edges: Array,
    streams: int,
    nodes: tuple[int, int],
) -> tuple[Array, Array, Array, Array]:
    """Light from the air.

    Parameters
    ----------
    theta : ndarray, shape (k, m), rad
        Incidence of each ray of each row.
    points, shifts : ndarray, shape (m, 3) and (k, 3)
        Place in the cell and azimuth, 0 .. 1, and by how much they are moved in each row.
    seed : int
        Of the shares drawn by lot.
    h, p, q, pitch, depth, n, edges
        As in `follow`.
    streams : int
        Directions at the tissue, even in the square of the sine.
    nodes : tuple of int
        Of the angle in air and of the azimuth in `stray`.

    Returns
    -------
    ndarray, shape (k, j, b, 4); ndarray, shape (k, b, 4); ndarray, shape (k, 3); ndarray, shape (k, i, r, p)
        `reached`, `escaped`, `shares` and `stray` of `follow`, summed over the rays.
    """
    rows, rays = theta.shape
    stray = np.zeros((rows, nodes[0], nodes[0], nodes[1]))
    reached = np.zeros((rows, streams, len(edges), 4))
    escaped = np.zeros((rows, len(edges), 4))
    shares = np.zeros((rows, 3))
    for k in prange(rows):
        np.random.seed(seed + k)  # noqa: NPY002
        for m in range(rays):
            x, y = into_hexagon((points[m, 0] + shifts[k, 0]) % 1, (points[m, 1] + shifts[k, 1]) % 1, pitch)
            azimuth = (points[m, 2] + shifts[k, 2]) % 1 * math.pi / 3
            sin, cos = math.sin(theta[k, m]), math.cos(theta[k, m])
            dx, dy = -sin * math.cos(azimuth), -sin * math.sin(azimuth)
            follow(x, y, h, dx, dy, -cos, 1.0, 0.0, 0, 0, h, p, q, pitch, depth, n, edges, reached[k], escaped[k], shares[k], stray[k])
    return reached, escaped, shares, stray


@njit(cache=True, nogil=True, parallel=True)
def trace_up(
    points: Array,
    shifts: Array,
    seed: int,
    h: float,
    p: float,
    q: float,
    pitch: float,
    depth: float,
    n: float,
    edges: Array,
    streams: int,
) -> tuple[Array, Array, Array]:
    """Light from the tissue, each row one stream of directions, `points` and `shifts` with a fourth column for the place in the stream.

    The rest as for `trace_down`; all light in the air is `escaped`.
    """
    reached = np.zeros((streams, streams, len(edges), 4))
    escaped = np.zeros((streams, len(edges), 4))
    shares = np.zeros((streams, 3))
    none = np.zeros((0, 0, 0))
    for k in prange(streams):
        np.random.seed(seed + k)  # noqa: NPY002
        for m in range(len(points)):
            x, y = into_hexagon((points[m, 0] + shifts[k, 0]) % 1, (points[m, 1] + shifts[k, 1]) % 1, pitch)
            azimuth = (points[m, 2] + shifts[k, 2]) % 1 * math.pi / 3
            sin2 = (k + (points[m, 3] + shifts[k, 3]) % 1) / streams
            sin, cos = math.sqrt(sin2), max(1e-9, math.sqrt(1 - sin2))
            dx, dy = sin * math.cos(azimuth), sin * math.sin(azimuth)
            path = depth / cos
            if h > 0 and x * x + y * y < 1:
                follow(x, y, 0.0, dx, dy, cos, 1.0, path, 1, 3, h, p, q, pitch, depth, n, edges, reached[k], escaped[k], shares[k], none)
                continue
            # The floor of a gap, from below.
            share, cos_t = fresnel(cos, 1 / n)
            deposit(reached[k, k], share, 2 * path, edges)
            if share < 1:
                dx, dy = n * dx, n * dy
                part = 1 - share
                follow(x, y, 0.0, dx, dy, cos_t, part, path, 0, 3, h, p, q, pitch, depth, n, edges, reached[k], escaped[k], shares[k], none)
    return reached, escaped, shares


@njit(cache=True, nogil=True)
def mirror_density(tilt: float, h: float, p: float, q: float) -> tuple[float, float, float]:
    """Where a dome's normal has a tilt: r, z, and the dome's area per solid angle of its normals (1 / Gaussian curvature); 0 if nowhere.

    The slope s = h p / q r^(p-1) (1 - r^p)^(1/q-1) of a convex profile grows with r: bisection in r, or in 1 - r^p near the rim.
    """
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


@njit(cache=True, nogil=True, parallel=True)
def mirror(wi: Array, wo: Array, h: float, p: float, q: float, pitch: float, n: float, turns: int) -> Array:
    """Light turned once by the domes' walls, in 1/sr, averaged over `turns` azimuths of the lattice.

    F D G / (4 cos cos), with the normals' density D of the dome itself and G the exact share of azimuths in which light and view both clear
    the neighbours (Torrance and Sparrow; Walter et al. 2007, eq. 20).

    Parameters
    ----------
    wi, wo : ndarray, shape (m, 3)
        Unit vectors away from the surface, above its horizon.
    h, p, q, pitch, n : float
        As in `follow`.
    turns : int
        As above.

    Returns
    -------
    ndarray, shape (m,)
    """
    area = pitch * pitch * math.sqrt(3) / 2
    out = np.zeros(len(wi))
    for m in prange(len(wi)):
        hx, hy, hz = wi[m, 0] + wo[m, 0], wi[m, 1] + wo[m, 1], wi[m, 2] + wo[m, 2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / length, hy / length, hz / length
        flat = math.hypot(hx, hy)
        r, z, density = mirror_density(math.atan2(flat, hz), h, p, q)
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
                what, _x, _y, _z = march(x, y, z, dx, dy, w[2], h, p, q, pitch, True)
                if what != ESCAPED:
                    free = False
                    break
            if free:
                clear += 1
        out[m] = share * density / area * clear / turns / (4 * wi[m, 2] * wo[m, 2])
    return out
