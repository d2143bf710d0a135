"""Kernels over the grid of a range image: which points hang together, how far the rim is, local fits, triangles.

All take depths (H, W) and know neighbours by the grid alone. Two neighbours are linked where both are valid and their depths differ by no
more than `jump`; what is not linked is not one surface.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def islands(depth: Array, valid: Mask, jump: float) -> tuple[NDArray[np.int32], int]:
    """Label the pieces that hang together over the four neighbours: 0 where invalid, else 1 to the count."""
    height, width = depth.shape
    label = np.zeros((height, width), np.int32)
    stack = np.empty(height * width, np.int32)
    count = 0
    for start in range(height * width):
        if label[start // width, start % width] or not valid[start // width, start % width]:
            continue
        count += 1
        label[start // width, start % width] = count
        stack[0] = start
        top = 1
        while top:
            top -= 1
            i, j = stack[top] // width, stack[top] % width
            for side in range(4):
                k, m = i + (side == 0) - (side == 1), j + (side == 2) - (side == 3)
                if 0 <= k < height and 0 <= m < width and valid[k, m] and not label[k, m] and abs(depth[k, m] - depth[i, j]) <= jump:
                    label[k, m] = count
                    stack[top] = k * width + m
                    top += 1
    return label, count


@njit(cache=True, nogil=True)
def rim_distance(depth: Array, valid: Mask, jump: float, most: int) -> NDArray[np.int32]:
    """Steps from each point to the rim, up to `most`; 0 for a point with a neighbour it is not linked to, -1 where invalid.

    A point at distance d has a full, unbroken window of radius d around it.
    """
    height, width = depth.shape
    far = np.empty((height, width), np.int32)
    for i in range(height):
        for j in range(width):
            if not valid[i, j]:
                far[i, j] = -1
                continue
            inside = 0 < i < height - 1 and 0 < j < width - 1
            if inside:
                for k in range(i - 1, i + 2):
                    for m in range(j - 1, j + 2):
                        if not valid[k, m] or abs(depth[k, m] - depth[i, j]) > jump * max(abs(k - i), abs(m - j)):
                            inside = False
            far[i, j] = most if inside else 0
    # Two sweeps of the chessboard distance.
    for i in range(height):
        for j in range(width):
            if far[i, j] > 0:
                nearest = min(far[i - 1, j - 1], far[i - 1, j], far[i - 1, j + 1], far[i, j - 1])
                far[i, j] = min(far[i, j], max(nearest, 0) + 1)
    for i in range(height - 1, -1, -1):
        for j in range(width - 1, -1, -1):
            if far[i, j] > 0:
                nearest = min(far[i + 1, j - 1], far[i + 1, j], far[i + 1, j + 1], far[i, j + 1])
                far[i, j] = min(far[i, j], max(nearest, 0) + 1)
    return far


@njit(cache=True, nogil=True)
def reachable(depth: Array, valid: Mask, jump: float, i: int, j: int, radius: int, seen: Mask, stack: NDArray[np.int32]) -> None:
    """Mark in `seen`, shape (2 radius + 1,) * 2, the points of the window around (i, j) that hang together with it."""
    height, width = depth.shape
    size = 2 * radius + 1
    seen[:, :] = False
    seen[radius, radius] = True
    stack[0] = radius * size + radius
    top = 1
    while top:
        top -= 1
        a, b = stack[top] // size, stack[top] % size
        here = depth[i + a - radius, j + b - radius]
        for side in range(4):
            c, d = a + (side == 0) - (side == 1), b + (side == 2) - (side == 3)
            if c < 0 or d < 0 or c >= size or d >= size or seen[c, d]:
                continue
            k, m = i + c - radius, j + d - radius
            if 0 <= k < height and 0 <= m < width and valid[k, m] and abs(depth[k, m] - here) <= jump:
                seen[c, d] = True
                stack[top] = c * size + d
                top += 1


@njit(cache=True, nogil=True)
def in_window(valid: Mask, i: int, j: int, radius: int, seen: Mask) -> None:
    """Mark in `seen`, shape (2 radius + 1,) * 2, the valid points of the window around (i, j)."""
    height, width = valid.shape
    seen[:, :] = False
    for k in range(max(0, i - radius), min(height, i + radius + 1)):
        for m in range(max(0, j - radius), min(width, j + radius + 1)):
            seen[k - i + radius, m - j + radius] = valid[k, m]


@njit(cache=True, nogil=True)
def has_jump(depth: Array, valid: Mask, jump: float) -> bool:
    """Whether any two valid neighbours along a row or column are not linked."""
    height, width = depth.shape
    for i in range(height):
        for j in range(width):
            if valid[i, j]:
                if i + 1 < height and valid[i + 1, j] and abs(depth[i + 1, j] - depth[i, j]) > jump:
                    return True
                if j + 1 < width and valid[i, j + 1] and abs(depth[i, j + 1] - depth[i, j]) > jump:
                    return True
    return False


@njit(cache=True, nogil=True)
def solve(normal: Array, right: Array, terms: int) -> bool:
    """Solve the normal equations in place by Cholesky; False where they are singular. The solution is left in `right`."""
    for r in range(terms):
        for c in range(r + 1):
            total = normal[r, c]
            for k in range(c):
                total -= normal[r, k] * normal[c, k]
            if r == c:
                if total <= 1e-9 * normal[r, r]:
                    return False
                normal[r, r] = math.sqrt(total)
            else:
                normal[r, c] = total / normal[c, c]
    for r in range(terms):
        for k in range(r):
            right[r] -= normal[r, k] * right[k]
        right[r] /= normal[r, r]
    for r in range(terms - 1, -1, -1):
        for k in range(r + 1, terms):
            right[r] -= normal[k, r] * right[k]
        right[r] /= normal[r, r]
    return True


@njit(cache=True, nogil=True)
def convolve(depth: Array, kernel: Array, out: Array) -> None:
    """Weighted sums over full windows, written to `out` at the points that have one within the grid; NaN where one holds a NaN."""
    height, width = depth.shape
    size = len(kernel)
    radius = size // 2
    if height < size or width < size:
        return
    total = np.empty(width - size + 1)
    for i in range(radius, height - radius):
        total[:] = 0.0
        for a in range(size):
            row = depth[i + a - radius]
            for b in range(size):
                weight = kernel[a, b]
                part = row[b : b + len(total)]
                for j in range(len(total)):  # the long loop innermost, over arrays of its own, so that it is vectorised
                    total[j] += weight * part[j]
        out[i, radius : width - radius] = total


@njit(cache=True, nogil=True)
def local_fit(
    depth: Array, valid: Mask, jump: float, far: NDArray[np.int32], weighted: Array, moments: Array, kernel: Array, outward: bool
) -> Array:
    """Depth that a polynomial through each point's linked window has at the point, shape (H, W); NaN where too few points bear it.

    Parameters
    ----------
    far : ndarray, shape (H, W)
        Steps to the rim.
    weighted : ndarray, shape (window, terms)
        Basis functions times the weight of the fit, at each place of the window, row by row.
    moments : ndarray, shape (window, terms (terms + 1) / 2)
        Products of two basis functions times the weight: the lower triangle of the normal equations, row by row.
    kernel : ndarray, shape (2 radius + 1,) * 2
        The same fit over a full window, as weights of one sum.
    outward : bool
        Within two steps of the rim, fit only to points farther from it than the point is: an error of the rim must not vouch for itself.
    """
    height, width = depth.shape
    size = len(kernel)
    radius = size // 2
    terms = weighted.shape[1]
    fitted = np.full((height, width), np.nan)
    convolve(depth, kernel, fitted)
    seen = np.empty((size, size), np.bool_)
    stack = np.empty(size * size, np.int32)
    cut = has_jump(depth, valid, jump)
    lower = np.empty(moments.shape[1])
    normal, right = np.empty((terms, terms)), np.empty(terms)
    for i in range(height):
        for j in range(width):
            if far[i, j] < 0 or (far[i, j] >= radius and not (outward and far[i, j] < 2)):
                continue
            fitted[i, j] = np.nan
            if cut:
                reachable(depth, valid, jump, i, j, radius, seen, stack)
            else:
                in_window(valid, i, j, radius, seen)
            lower[:] = 0.0
            right[:] = 0.0
            count = 0
            for a in range(size):
                for b in range(size):
                    place = a * size + b
                    if not seen[a, b] or weighted[place, 0] == 0:
                        continue
                    k, m = i + a - radius, j + b - radius
                    if outward and far[i, j] < 2 and far[k, m] <= far[i, j]:
                        continue
                    value = depth[k, m] - depth[i, j]
                    for r in range(terms):
                        right[r] += weighted[place, r] * value
                    for r in range(len(lower)):
                        lower[r] += moments[place, r]
                    count += 1
            entry = 0
            for r in range(terms):
                for c in range(r + 1):
                    normal[r, c] = lower[entry]
                    entry += 1
            if count >= 2 * terms and solve(normal, right, terms):
                fitted[i, j] = depth[i, j] + right[0]
    return fitted


@njit(cache=True, nogil=True)
def grid_triangles(points: Array, valid: Mask, jump: float, turned: bool) -> NDArray[np.int32]:
    """Triangles on the grid's adjacency, shape (m, 3), corners as row * W + column.

    Of the two diagonals of four linked points the shorter is taken; three linked points make one triangle. `turned` exchanges two corners.
    """
    height, width = valid.shape
    triangles = np.empty((2 * height * width, 3), np.int32)
    corner = np.empty(4, np.int32)
    count = 0
    for i in range(height - 1):
        for j in range(width - 1):
            total = 0
            for k in range(2):
                for m in range(2):
                    total += valid[i + k, j + m]
            if total < 3:
                continue
            # Round the square: (i, j), (i, j+1), (i+1, j+1), (i+1, j).
            corner[0], corner[1] = i * width + j, i * width + j + 1
            corner[2], corner[3] = corner[1] + width, corner[0] + width
            first = distance(points, valid, corner[0], corner[2], width, jump)
            second = distance(points, valid, corner[1], corner[3], width, jump)
            if total == 4:
                # Along 0-2: triangles 0 1 2 and 0 2 3; along 1-3: 1 2 3 and 1 3 0.
                best, other = (0, 1) if first <= second else (1, 0)
                made = 0
                for start in (best, other):
                    if made:
                        break
                    for half in range(2):
                        a, b, c = corner[start], corner[(start + 1 + half) % 4], corner[(start + 2 + half) % 4]
                        if linked(points, a, b, c, width, jump):
                            triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, c if turned else b, b if turned else c
                            count += 1
                            made += 1
            else:
                for k in range(4):
                    if not valid[corner[k] // width, corner[k] % width]:
                        a, b, c = corner[(k + 1) % 4], corner[(k + 2) % 4], corner[(k + 3) % 4]
                        if linked(points, a, b, c, width, jump):
                            triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, c if turned else b, b if turned else c
                            count += 1
    return triangles[:count].copy()


@njit(cache=True, nogil=True)
def distance(points: Array, valid: Mask, a: int, b: int, width: int, jump: float) -> float:
    """Squared length of a diagonal, infinite where it crosses a jump."""
    i, j, k, m = a // width, a % width, b // width, b % width
    if not (valid[i, j] and valid[k, m]) or abs(points[i, j, 2] - points[k, m, 2]) > jump:
        return np.inf
    x, y, z = points[i, j, 0] - points[k, m, 0], points[i, j, 1] - points[k, m, 1], points[i, j, 2] - points[k, m, 2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def linked(points: Array, a: int, b: int, c: int, width: int, jump: float) -> bool:
    """Whether three points are free of a jump."""
    first, second, third = points[a // width, a % width, 2], points[b // width, b % width, 2], points[c // width, c % width, 2]
    return max(first, second, third) - min(first, second, third) <= jump


@njit(cache=True, nogil=True)
def keep_one_sheet(triangles: NDArray[np.int32], vertices: int) -> Mask:
    """Choose triangles so that they make one manifold sheet: at every vertex one fan, and all hang together over edges.

    Where fans meet in a point only, those of fewer triangles go; of several sheets the one of most triangles stays. Shape (m,).
    """
    keep = np.ones(len(triangles), np.bool_)
    around = np.zeros((vertices, 8), np.int32)
    count = np.zeros(vertices, np.int32)
    changed = True
    while changed:
        count[:] = 0
        for t in range(len(triangles)):
            if keep[t]:
                for corner in triangles[t]:
                    around[corner, count[corner]] = t
                    count[corner] += 1
        changed = False
        for v in range(vertices):
            if count[v] > 1 and fans(triangles, around[v, : count[v]], v) > 1:
                changed = True
                drop_small_fans(triangles, around[v, : count[v]], keep)
    # One fan at each vertex: triangles that share a vertex hang together over edges.
    root = np.arange(vertices).astype(np.int32)
    for t in range(len(triangles)):
        if keep[t]:
            first = find(root, triangles[t, 0])
            root[find(root, triangles[t, 1])] = first
            root[find(root, triangles[t, 2])] = first
    members = np.zeros(vertices, np.int32)
    for t in range(len(triangles)):
        if keep[t]:
            members[find(root, triangles[t, 0])] += 1
    best = np.argmax(members)
    for t in range(len(triangles)):
        keep[t] = keep[t] and find(root, triangles[t, 0]) == best
    return keep


@njit(cache=True, nogil=True)
def find(root: NDArray[np.int32], v: int) -> int:
    """Root of a vertex in a forest, halving the paths on the way."""
    while root[v] != v:
        root[v] = root[root[v]]
        v = root[v]
    return v


@njit(cache=True, nogil=True)
def fans(triangles: NDArray[np.int32], around: NDArray[np.int32], v: int) -> int:
    """How many fans the triangles around a vertex make: open fans begin with an edge that no other triangle ends with."""
    begun = 0
    for t in around:
        turn = 0 if triangles[t, 0] == v else (1 if triangles[t, 1] == v else 2)
        first = triangles[t, (turn + 1) % 3]
        ended = False
        for s in around:
            turn = 0 if triangles[s, 0] == v else (1 if triangles[s, 1] == v else 2)
            ended = ended or triangles[s, (turn + 2) % 3] == first
        begun += not ended
    return begun


@njit(cache=True, nogil=True)
def drop_small_fans(triangles: NDArray[np.int32], around: NDArray[np.int32], keep: Mask) -> None:
    """Keep the largest of the fans around a vertex only."""
    n = len(around)
    group = np.arange(n)
    for _ in range(n):  # spread the smallest label over shared edges
        for a in range(n):
            for b in range(n):
                if group[b] < group[a] and shares_edge(triangles, around[a], around[b]):
                    group[a] = group[b]
    members = np.bincount(group, minlength=n)
    best = np.argmax(members)
    for a in range(n):
        if group[a] != best:
            keep[around[a]] = False


@njit(cache=True, nogil=True)
def shares_edge(triangles: NDArray[np.int32], s: int, t: int) -> bool:
    """Whether two triangles have two corners in common."""
    common = 0
    for a in triangles[s]:
        for b in triangles[t]:
            common += a == b
    return common >= 2
