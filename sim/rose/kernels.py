"""Loops over triangles; numba, imported only when needed."""

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.rose.mesh import Array

Integers = NDArray[np.int64]
jit: Any = njit(cache=True)


@jit
def _boxes(triangles: Array) -> tuple[Array, Array]:
    n = triangles.shape[0]
    low, high = np.empty((n, 3)), np.empty((n, 3))
    for i in range(n):
        for k in range(3):
            low[i, k] = min(triangles[i, 0, k], triangles[i, 1, k], triangles[i, 2, k])
            high[i, k] = max(triangles[i, 0, k], triangles[i, 1, k], triangles[i, 2, k])
    return low, high


@jit
def _grid(low: Array, high: Array, origin: Array, size: Integers, cell: float) -> tuple[Integers, Integers]:
    """Bucket boxes into cells: members of cell c are listed[start[c]:start[c + 1]]."""
    start = np.zeros(size[0] * size[1] * size[2] + 1, np.int64)
    listed = np.empty(0, np.int64)
    for turn in range(2):
        if turn == 1:
            for c in range(start.size - 1):
                start[c + 1] += start[c]
            listed = np.empty(start[-1], np.int64)
            fill = start[:-1].copy()
        for i in range(low.shape[0]):
            x0, x1 = int((low[i, 0] - origin[0]) / cell), int((high[i, 0] - origin[0]) / cell)
            y0, y1 = int((low[i, 1] - origin[1]) / cell), int((high[i, 1] - origin[1]) / cell)
            z0, z1 = int((low[i, 2] - origin[2]) / cell), int((high[i, 2] - origin[2]) / cell)
            for x in range(x0, x1 + 1):
                for y in range(y0, y1 + 1):
                    for z in range(z0, z1 + 1):
                        c = (x * size[1] + y) * size[2] + z
                        if turn == 0:
                            start[c + 1] += 1
                        else:
                            listed[fill[c]] = i
                            fill[c] += 1
    return start, listed


@jit
def _pierces(p: Array, q: Array, triangle: Array) -> bool:
    """Whether the segment p-q meets a triangle (Moller and Trumbore 1997, with the parameter limited to the segment)."""
    d0, d1, d2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    a = triangle[0]
    e0, e1, e2 = triangle[1, 0] - a[0], triangle[1, 1] - a[1], triangle[1, 2] - a[2]
    f0, f1, f2 = triangle[2, 0] - a[0], triangle[2, 1] - a[1], triangle[2, 2] - a[2]
    h0, h1, h2 = d1 * f2 - d2 * f1, d2 * f0 - d0 * f2, d0 * f1 - d1 * f0
    det = e0 * h0 + e1 * h1 + e2 * h2
    if det == 0.0:
        return False
    s0, s1, s2 = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    u = (s0 * h0 + s1 * h1 + s2 * h2) / det
    if u < 0.0 or u > 1.0:
        return False
    g0, g1, g2 = s1 * e2 - s2 * e1, s2 * e0 - s0 * e2, s0 * e1 - s1 * e0
    v = (d0 * g0 + d1 * g1 + d2 * g2) / det
    if v < 0.0 or u + v > 1.0:
        return False
    t = (f0 * g0 + f1 * g1 + f2 * g2) / det
    return 0.0 <= t <= 1.0


@jit
def _cross(a: Array, b: Array) -> bool:
    return (
        _pierces(a[0], a[1], b)
        or _pierces(a[1], a[2], b)
        or _pierces(a[2], a[0], b)
        or _pierces(b[0], b[1], a)
        or _pierces(b[1], b[2], a)
        or _pierces(b[2], b[0], a)
    )


@jit
def _cells_of(low: float, high: float, origin: float, cell: float, size: int) -> tuple[int, int]:
    return max(0, math.floor((low - origin) / cell)), min(size - 1, math.floor((high - origin) / cell))


@jit
def count_crossings(a: Array, b: Array, cell: float) -> int:
    """Count crossing pairs of triangles a (n, 3, 3) and b (m, 3, 3)."""
    return int(_walk(a, b, 0.0, cell, True))


@jit
def least_distance(a: Array, b: Array, bound: float, cell: float) -> float:
    """Least distance between triangles a and b that do not cross; `bound` when none is nearer."""
    return _walk(a, b, bound, cell, False)


@jit
def _walk(a: Array, b: Array, bound: float, cell: float, count: bool) -> float:
    low_a, high_a = _boxes(a)
    low, high = _boxes(b)
    origin = np.empty(3)
    size = np.empty(3, np.int64)
    for k in range(3):
        origin[k] = low[:, k].min()
        size[k] = int((high[:, k].max() - origin[k]) / cell) + 1
    start, listed = _grid(low, high, origin, size, cell)
    seen = np.full(b.shape[0], -1, np.int64)
    found = 0
    best = bound
    for i in range(a.shape[0]):
        margin = 0.0 if count else best
        x0, x1 = _cells_of(low_a[i, 0] - margin, high_a[i, 0] + margin, origin[0], cell, size[0])
        y0, y1 = _cells_of(low_a[i, 1] - margin, high_a[i, 1] + margin, origin[1], cell, size[1])
        z0, z1 = _cells_of(low_a[i, 2] - margin, high_a[i, 2] + margin, origin[2], cell, size[2])
        for x in range(x0, x1 + 1):
            for y in range(y0, y1 + 1):
                for z in range(z0, z1 + 1):
                    c = (x * size[1] + y) * size[2] + z
                    for m in range(start[c], start[c + 1]):
                        j = listed[m]
                        if seen[j] == i:
                            continue
                        seen[j] = i
                        apart = 0.0
                        for k in range(3):
                            gap = max(0.0, low[j, k] - high_a[i, k], low_a[i, k] - high[j, k])
                            apart += gap * gap
                        if count:
                            if apart == 0.0 and _cross(a[i], b[j]):
                                found += 1
                        elif apart < best * best:
                            best = min(best, _apart(a[i], b[j]))
    return float(found) if count else best


@jit
def _apart(a: Array, b: Array) -> float:
    """Distance between two triangles that do not cross: least of vertex to face and edge to edge."""
    best = np.inf
    for k in range(3):
        best = min(best, _point_face(a[k], b), _point_face(b[k], a))
        for m in range(3):
            best = min(best, _edge_edge(a[k], a[(k + 1) % 3], b[m], b[(m + 1) % 3]))
    return math.sqrt(best)


@jit
def _point_face(p: Array, triangle: Array) -> float:
    """Squared distance to the plane where the foot lies inside the face, else inf: the edges have the rest."""
    ee, ef, ff, we, wf = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        e, f, w = triangle[1, k] - triangle[0, k], triangle[2, k] - triangle[0, k], p[k] - triangle[0, k]
        ee += e * e
        ef += e * f
        ff += f * f
        we += w * e
        wf += w * f
    det = ee * ff - ef * ef
    if det <= 0.0:
        return np.inf
    u, v = (ff * we - ef * wf) / det, (ee * wf - ef * we) / det
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return np.inf
    total = 0.0
    for k in range(3):
        d = p[k] - triangle[0, k] - u * (triangle[1, k] - triangle[0, k]) - v * (triangle[2, k] - triangle[0, k])
        total += d * d
    return total


@jit
def _edge_edge(p: Array, q: Array, r: Array, s: Array) -> float:
    """Squared distance between two segments: Ericson, Real-Time Collision Detection (2005), 5.1.9."""
    a, b, c, e, f = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        d1, d2, w = q[k] - p[k], s[k] - r[k], p[k] - r[k]
        a += d1 * d1
        b += d1 * d2
        c += d1 * w
        e += d2 * d2
        f += d2 * w
    det = a * e - b * b
    x = min(1.0, max(0.0, (b * f - c * e) / det)) if det > 1e-14 * a * e else 0.0
    y = (b * x + f) / e
    if y < 0.0:
        y = 0.0
        x = min(1.0, max(0.0, -c / a))
    elif y > 1.0:
        y = 1.0
        x = min(1.0, max(0.0, (b - c) / a))
    total = 0.0
    for k in range(3):
        d = p[k] - r[k] + x * (q[k] - p[k]) - y * (s[k] - r[k])
        total += d * d
    return total


@jit
def rays_hit(origins: Array, directions: Array, triangles: Array, nearest: float) -> NDArray[np.bool_]:
    """Whether each ray (n, 3), (n, 3) meets any triangle (m, 3, 3) further along than `nearest`."""
    n = origins.shape[0]
    met = np.zeros(n, np.bool_)
    for i in range(n):
        near, far = origins[i] + nearest * directions[i], origins[i] + 1e4 * directions[i]
        for j in range(triangles.shape[0]):
            if _pierces(near, far, triangles[j]):
                met[i] = True
                break
    return met


@jit
def first_surface(triangles: Array, eye: Array, step: float, rows: int, columns: int) -> tuple[Array, Integers]:
    """What an eye above the plane z = 0 sees through a grid of points on that plane.

    Returns
    -------
    z, face
        (rows, columns): height where each ray first meets a triangle (NaN: it meets none) and which triangle (-1).
    """
    z = np.full((rows, columns), np.nan)
    face = np.full((rows, columns), -1, np.int64)
    nearest = np.zeros((rows, columns))
    g = np.empty((3, 3))
    for i in range(triangles.shape[0]):
        for k in range(3):
            _project(triangles[i, k], eye, g[k])
        det = (g[1, 0] - g[0, 0]) * (g[2, 1] - g[0, 1]) - (g[2, 0] - g[0, 0]) * (g[1, 1] - g[0, 1])
        if det == 0.0:
            continue
        x_low, x_high = min(g[0, 0], g[1, 0], g[2, 0]), max(g[0, 0], g[1, 0], g[2, 0])
        y_low, y_high = min(g[0, 1], g[1, 1], g[2, 1]), max(g[0, 1], g[1, 1], g[2, 1])
        c0 = max(0, math.ceil(x_low / step + (columns - 1) / 2))
        c1 = min(columns - 1, math.floor(x_high / step + (columns - 1) / 2))
        r0 = max(0, math.ceil((rows - 1) / 2 - y_high / step))
        r1 = min(rows - 1, math.floor((rows - 1) / 2 - y_low / step))
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                inverse = _inverse_depth((c - (columns - 1) / 2) * step, ((rows - 1) / 2 - r) * step, g, det)
                # Inverse depth is positive: -1 stands for outside the triangle.
                if inverse > nearest[r, c]:
                    nearest[r, c] = inverse
                    z[r, c] = eye[2] - 1 / inverse
                    face[r, c] = i
    return z, face


@jit
def shadowed(points: Array, triangles: Array, eye: Array, cell: float, bias: float) -> NDArray[np.bool_]:
    """Which points (n, 3) have a triangle between them and the eye, by more than `bias` mm in height."""
    n = points.shape[0]
    hidden = np.zeros(n, np.bool_)
    g = np.empty((3, 3))
    places = np.empty((n, 3))
    for i in range(n):
        _project(points[i], eye, places[i])
    x0, y0 = places[:, 0].min(), places[:, 1].min()
    columns = int((places[:, 0].max() - x0) / cell) + 1
    rows = int((places[:, 1].max() - y0) / cell) + 1
    start = np.zeros(rows * columns + 1, np.int64)
    bucket = np.empty(n, np.int64)
    for i in range(n):
        bucket[i] = int((places[i, 1] - y0) / cell) * columns + int((places[i, 0] - x0) / cell)
        start[bucket[i] + 1] += 1
    for c in range(rows * columns):
        start[c + 1] += start[c]
    fill = start[:-1].copy()
    listed = np.empty(n, np.int64)
    for i in range(n):
        listed[fill[bucket[i]]] = i
        fill[bucket[i]] += 1
    for i in range(triangles.shape[0]):
        for k in range(3):
            _project(triangles[i, k], eye, g[k])
        det = (g[1, 0] - g[0, 0]) * (g[2, 1] - g[0, 1]) - (g[2, 0] - g[0, 0]) * (g[1, 1] - g[0, 1])
        if det == 0.0:
            continue
        c0, c1 = _cells_of(min(g[0, 0], g[1, 0], g[2, 0]), max(g[0, 0], g[1, 0], g[2, 0]), x0, cell, columns)
        r0, r1 = _cells_of(min(g[0, 1], g[1, 1], g[2, 1]), max(g[0, 1], g[1, 1], g[2, 1]), y0, cell, rows)
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                for m in range(start[r * columns + c], start[r * columns + c + 1]):
                    j = listed[m]
                    inverse = _inverse_depth(places[j, 0], places[j, 1], g, det)
                    if inverse > 0.0 and eye[2] - 1 / inverse > points[j, 2] + bias:
                        hidden[j] = True
    return hidden


@jit
def _project(point: Array, eye: Array, out: Array) -> None:
    """Where the ray from the eye through a point meets z = 0, and the inverse depth there (linear over a projected triangle)."""
    inverse = 1.0 / (eye[2] - point[2])
    out[0] = eye[0] + (point[0] - eye[0]) * eye[2] * inverse
    out[1] = eye[1] + (point[1] - eye[1]) * eye[2] * inverse
    out[2] = inverse


@jit
def _inverse_depth(x: float, y: float, g: Array, det: float) -> float:
    u = ((x - g[0, 0]) * (g[2, 1] - g[0, 1]) - (y - g[0, 1]) * (g[2, 0] - g[0, 0])) / det
    v = ((y - g[0, 1]) * (g[1, 0] - g[0, 0]) - (x - g[0, 0]) * (g[1, 1] - g[0, 1])) / det
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        return -1.0
    return float(g[0, 2] + u * (g[1, 2] - g[0, 2]) + v * (g[2, 2] - g[0, 2]))
