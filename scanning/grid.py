"""Kernels over the grid of a range image: which points hang together, how far the rim is, local fits, triangles.

All take depths (H, W), NaN where there is no point, and know neighbours by the grid alone. Two neighbours are linked where their depths
differ by no more than `jump`; what is not linked is not one surface. A comparison with NaN is false: a missing point is linked to none.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int32]
Mask = NDArray[np.bool_]

# Corners of a square of the grid: 0 (i, j), 1 (i, j+1), 2 (i+1, j+1), 3 (i+1, j). A square's triangles are bits of one number:
# 1 for corners 0 1 2, 2 for 0 2 3, 4 for 1 2 3, 8 for 1 3 0.
_TRIANGLES = ((0, 1, 2), (0, 2, 3), (1, 2, 3), (1, 3, 0))
# By the square's number and a corner: 1 where a triangle has the side from the corner to the next, 2 that to the one before.
_SIDES = np.array(
    [
        [
            max((1 for k in range(4) if square >> k & 1 and {c, (c + 1) % 4} <= set(_TRIANGLES[k])), default=0)
            + max((2 for k in range(4) if square >> k & 1 and {c, (c + 3) % 4} <= set(_TRIANGLES[k])), default=0)
            for c in range(4)
        ]
        for square in range(16)
    ],
    dtype=np.uint8,
)
# The same triangles without those at a corner.
_WITHOUT = np.array(
    [[sum(1 << k for k in range(4) if square >> k & 1 and c not in _TRIANGLES[k]) for c in range(4)] for square in range(16)],
    dtype=np.uint8,
)
_COUNT = np.array([square.bit_count() for square in range(16)], dtype=np.int32)
_CORNER_BITS = np.array(
    [sum(1 << c for c in range(4) if any(square >> k & 1 and c in _TRIANGLES[k] for k in range(4))) for square in range(16)], dtype=np.uint8
)


@njit(cache=True, nogil=True)
def find(root: Indices, v: int) -> int:
    """Root of an entry in a forest, halving the paths on the way."""
    while root[v] != v:
        root[v] = root[root[v]]
        v = root[v]
    return v


@njit(cache=True, nogil=True)
def join(root: Indices, a: int, b: int) -> int:
    """Make two trees of a forest one; its root, the smaller."""
    a, b = find(root, a), find(root, b)
    if a > b:
        a, b = b, a
    root[b] = a
    return a


@njit(cache=True, nogil=True)
def unlabelled(height: int, width: int) -> tuple[Indices, Indices]:
    """Labels of a grid, all 0, and a forest with room for as many trees as the grid has places."""
    root = np.empty(height * width + 1, np.int32)
    root[0] = 0
    return np.zeros((height, width), np.int32), root


@njit(cache=True, nogil=True)
def number_pieces(label: Indices, root: Indices, used: int) -> int:
    """Replace provisional labels by the pieces' numbers, 1 to the count, in the order of their first points."""
    number = np.zeros(used + 1, np.int32)
    count = 0
    for k in range(1, used + 1):
        if root[k] == k:
            count += 1
            number[k] = count
        else:
            number[k] = number[find(root, k)]
    if count < used:
        for i in range(label.shape[0]):
            for j in range(label.shape[1]):
                label[i, j] = number[label[i, j]]
    return count


@njit(cache=True, nogil=True)
def islands(depth: Array, jump: float) -> tuple[Indices, int]:
    """Label the pieces that hang together over the four neighbours: 0 where there is no point, else 1 to the count."""
    height, width = depth.shape
    label, root = unlabelled(height, width)
    used = 0
    for i in range(height):
        for j in range(width):
            here = depth[i, j]
            if math.isnan(here):
                continue
            left = label[i, j - 1] if j and abs(depth[i, j - 1] - here) <= jump else 0
            up = label[i - 1, j] if i and abs(depth[i - 1, j] - here) <= jump else 0
            if left and up:
                label[i, j] = left if left == up else join(root, left, up)
            elif left or up:
                label[i, j] = left or up
            else:
                used += 1
                root[used] = used
                label[i, j] = used
    return label, number_pieces(label, root, used)


@njit(cache=True, nogil=True)
def rim_distance(depth: Array, jump: float, most: int) -> Indices:
    """Steps from each point to the rim, up to `most`; 0 for a point with a neighbour it is not linked to, -1 where there is none.

    A point at distance d has a full, unbroken window of radius d around it.
    """
    height, width = depth.shape
    far = np.zeros((height, width), np.int32)
    for i in range(1, height - 1):
        above, here, below, out = depth[i - 1], depth[i], depth[i + 1], far[i]
        for j in range(1, width - 1):  # no branches, so that it is vectorised
            z = here[j]
            inside = (abs(here[j - 1] - z) <= jump) & (abs(here[j + 1] - z) <= jump)
            inside &= (abs(above[j - 1] - z) <= jump) & (abs(above[j] - z) <= jump) & (abs(above[j + 1] - z) <= jump)
            inside &= (abs(below[j - 1] - z) <= jump) & (abs(below[j] - z) <= jump) & (abs(below[j + 1] - z) <= jump)
            out[j] = inside * most
    # Two sweeps of the chessboard distance, each first over the row above or below, then along the row.
    for i in range(1, height - 1):
        sweep(far[i - 1], far[i], 1)
    for i in range(height - 2, 0, -1):
        sweep(far[i + 1], far[i], -1)
    for i in range(height):
        for j in range(width):
            if math.isnan(depth[i, j]):
                far[i, j] = -1
    return far


@njit(cache=True, nogil=True)
def sweep(before: Indices, row: Indices, way: int) -> None:
    """One row of a distance transform from the row before it, then along it, to the right (1) or to the left (-1)."""
    width = len(row)
    for j in range(1, width - 1):
        row[j] = min(row[j], min(before[j - 1], before[j], before[j + 1]) + 1)
    last = 0
    for step in range(1, width - 1):
        j = step if way > 0 else width - 1 - step
        last = min(row[j], last + 1)
        row[j] = last


@njit(cache=True, nogil=True)
def near_jumps(depth: Array, jump: float, radius: int) -> Mask:
    """Points within whose window two points of one row or column, next to each other or over a gap, rise faster than a jump each step."""
    height, width = depth.shape
    near = np.zeros((height, width), np.bool_)
    last = np.full(width, -1, np.int32)
    for i in range(height):
        left = -1
        for j in range(width):
            z = depth[i, j]
            if math.isnan(z):
                continue
            up = last[j]
            broken = (left >= 0 and j - left <= 2 * radius and abs(z - depth[i, left]) > jump * (j - left)) or (
                up >= 0 and i - up <= 2 * radius and abs(z - depth[up, j]) > jump * (i - up)
            )
            if broken:
                near[max(0, i - 2 * radius) : i + radius + 1, max(0, j - 2 * radius) : j + radius + 1] = True
            left, last[j] = j, i
    return near


@njit(cache=True, nogil=True)
def reachable(depth: Array, jump: float, i: int, j: int, radius: int, seen: Mask, stack: Indices) -> None:
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
            if 0 <= k < height and 0 <= m < width and abs(depth[k, m] - here) <= jump:
                seen[c, d] = True
                stack[top] = c * size + d
                top += 1


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
def fit_window(depth: Array, i: int, j: int, seen: Mask, weight: Array, normal: Array, right: Array) -> bool:
    """Fit a polynomial of second order to the window's seen points; its terms 1, u, v, u^2, u v, v^2 are left in `right`.

    Coordinates are steps over the radius; heights are above the depth at (i, j).
    """
    size = len(weight)
    radius = size // 2
    basis = np.empty(6)
    normal[:, :] = 0.0
    right[:] = 0.0
    count = 0
    for a in range(size):
        v = (a - radius) / radius
        for b in range(size):
            if not seen[a, b]:
                continue
            u = (b - radius) / radius
            basis[0], basis[1], basis[2], basis[3], basis[4], basis[5] = 1.0, u, v, u * u, u * v, v * v
            w = weight[a] * weight[b]
            value = w * (depth[i + a - radius, j + b - radius] - depth[i, j])
            for r in range(6):
                right[r] += value * basis[r]
                for c in range(r + 1):
                    normal[r, c] += w * basis[r] * basis[c]
            count += 1
    return count >= 12 and solve(normal, right, 6)


@njit(cache=True, nogil=True)
def above_plane(depth: Array, far: Indices, i: int, j: int, seen: Mask, all_seen: bool, beyond: int, weight: Array) -> float:
    """Height of a point above the plane through the window's other seen points more than `beyond` steps from the rim; NaN without one."""
    radius = len(weight) // 2
    here = depth[i, j]
    n, u, v, uu, uv, vv, z, zu, zv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    count = 0
    for k in range(max(0, i - radius), min(depth.shape[0], i + radius + 1)):
        y = k - i
        for m in range(max(0, j - radius), min(depth.shape[1], j + radius + 1)):
            if far[k, m] <= beyond or not (all_seen or seen[y + radius, m - j + radius]):
                continue
            x = m - j
            w = weight[y + radius] * weight[x + radius]
            value = w * (depth[k, m] - here)
            n += w
            u += w * x
            v += w * y
            uu += w * x * x
            uv += w * x * y
            vv += w * y * y
            z += value
            zu += value * x
            zv += value * y
            count += 1
    # The point itself has height, x and y 0: it only counted in the weights.
    if beyond < far[i, j]:
        n -= weight[radius] ** 2
        count -= 1
    determinant = n * (uu * vv - uv * uv) - u * (u * vv - uv * v) + v * (u * uv - uu * v)
    if count < 6 or not determinant > 1e-9 * n * uu * vv:
        return np.nan
    return -(z * (uu * vv - uv * uv) - u * (zu * vv - uv * zv) + v * (zu * uv - uu * zv)) / determinant


@njit(cache=True, nogil=True)
def plane_residual(depth: Array, far: Indices, jump: float, weight: Array) -> Array:
    """Height of each point above the plane through the others of its linked window, shape (H, W); NaN where too few bear it.

    Within two steps of the rim only points farther from it than the point itself count: an error of the rim must not vouch for itself.
    `weight`, shape (2 radius + 1,), is that of the fit along either axis.
    """
    height, width = depth.shape
    radius = len(weight) // 2
    size = len(weight)
    total = np.full((height, width), np.nan)
    across = np.full((height, width), np.nan)
    if width >= size and height >= size:
        for i in range(height):
            row, out = depth[i], across[i, radius : width - radius]
            out[:] = 0.0
            for b in range(size):
                w, part = weight[b], row[b : b + len(out)]
                for j in range(len(out)):
                    out[j] += w * part[j]
        middle = weight[radius] ** 2
        norm = 1 / (weight.sum() ** 2 - middle)
        for i in range(radius, height - radius):
            row, out = depth[i], total[i]
            out[:] = 0.0
            for a in range(size):
                w, other = weight[a], across[i + a - radius]
                for j in range(width):
                    out[j] += w * other[j]
            for j in range(width):
                out[j] = row[j] - norm * (out[j] - middle * row[j])
    near = near_jumps(depth, jump, radius)
    seen = np.empty((size, size), np.bool_)
    stack = np.empty(size * size, np.int32)
    for i in range(height):
        for j in range(width):
            if far[i, j] < 0 or far[i, j] >= max(radius, 2):
                continue
            if near[i, j]:
                reachable(depth, jump, i, j, radius, seen, stack)
            total[i, j] = above_plane(depth, far, i, j, seen, not near[i, j], far[i, j] if far[i, j] < 2 else -1, weight)
    return total


@njit(cache=True, nogil=True)
def smoothed(depth: Array, far: Indices, jump: float, weight: Array, move: Array) -> Array:
    """Depth that the polynomial of second order through each point's linked window has at the point, shape (H, W).

    A point that too few others bear out keeps its depth.

    Parameters
    ----------
    depth, far, jump
        As elsewhere; `far` up to the radius at least.
    weight : ndarray, shape (2 radius + 1,)
        Of the fit, along either axis.
    move : ndarray, shape (H, W, 2)
        Where beside the point the polynomial is asked, steps along rows and columns of the grid; at points of the rim only.

    Notes
    -----
    Sums over windows are products of sums along rows and along columns. Full windows share one solution; at the rim the normal equations
    come from the same sums; only windows with a jump are gone through point by point.
    """
    height, width = depth.shape
    size = len(weight)
    radius = size // 2
    fitted = depth.copy()
    middle, there = 0.0, 0
    for i in range(height):
        for j in range(width):
            if far[i, j] >= 0:
                middle += depth[i, j]
                there += 1
    middle /= max(there, 1)

    # Along the rows: sums of u^a (a to 4) and of u^a z (a to 2), u in radii.
    along = np.zeros((8, height, width))
    powers = np.empty((5, size))
    for b in range(size):
        for a in range(5):
            powers[a, b] = ((b - radius) / radius) ** a
    s0, s2, s4 = 0.0, 0.0, 0.0
    for b in range(size):
        s0 += weight[b]
        s2 += weight[b] * powers[2, b]
        s4 += weight[b] * powers[4, b]
    heights = np.empty(width + 2 * radius)
    gaps = np.empty(width + 2 * radius + 1, np.int32)  # places without a point up to each column
    for i in range(height):
        low, high = width, -1
        heights[:] = 0.0
        gaps[: radius + 1] = np.arange(radius + 1)
        for j in range(width):
            inside = far[i, j] >= 0
            gaps[j + radius + 1] = gaps[j + radius] + (not inside)
            if inside:
                heights[j + radius] = depth[i, j] - middle
                low, high = min(low, j), j
        for j in range(width + radius, width + 2 * radius):
            gaps[j + 1] = gaps[j] + 1
        if high < 0:
            continue
        low, high = max(0, low - radius), min(width, high + radius + 1)
        for j in range(low, high):
            empty = gaps[j + size] - gaps[j]
            if empty == 0:
                along[0, i, j], along[2, i, j], along[4, i, j] = s0, s2, s4
            elif empty < size:
                for b in range(size):
                    if gaps[j + b + 1] == gaps[j + b]:
                        for a in range(5):
                            along[a, i, j] += weight[b] * powers[a, b]
        z0, z1, z2 = along[5, i, low:high], along[6, i, low:high], along[7, i, low:high]
        for b in range(size):
            w0 = weight[b]
            w1, w2 = w0 * powers[1, b], w0 * powers[2, b]
            z = heights[low + b : high + b]
            for j in range(high - low):
                z0[j] += w0 * z[j]
                z1[j] += w1 * z[j]
                z2[j] += w2 * z[j]

    # Full windows: by symmetry the value at the middle is a combination of the sums of z, u^2 z and v^2 z.
    spread = s0 * s4 - s2 * s2
    second = -s2 / (s0 * spread)
    first = 1 / s0**2 - 2 * second * s2 / s0
    out = np.empty(width)
    for i in range(radius, height - radius):
        out[:] = middle
        for a in range(size):
            c0 = weight[a] * (first + second * powers[2, a])
            c2 = weight[a] * second
            z0, z2 = along[5, i + a - radius], along[7, i + a - radius]
            for j in range(width):
                out[j] += c0 * z0[j] + c2 * z2[j]
        for j in range(width):
            if far[i, j] >= radius:
                fitted[i, j] = out[j]

    near = near_jumps(depth, jump, radius)
    seen = np.empty((size, size), np.bool_)
    stack = np.empty(size * size, np.int32)
    normal, right = np.empty((6, 6)), np.empty(6)
    for i in range(height):
        for j in range(width):
            if far[i, j] < 0 or far[i, j] >= radius:
                continue
            if near[i, j]:
                reachable(depth, jump, i, j, radius, seen, stack)
                good = fit_window(depth, i, j, seen, weight, normal, right)
                base = depth[i, j]
            else:
                normal_equations(along, i, j, radius, weight, normal, right)
                # Weights are at most 1.
                good = normal[0, 0] >= 12 or enough(far, i, j, radius, 12)
                good = good and solve(normal, right, 6)
                base = middle
            if good:
                u, v = move[i, j, 1] / radius, move[i, j, 0] / radius
                fitted[i, j] = base + right[0] + u * right[1] + v * right[2] + u * u * right[3] + u * v * right[4] + v * v * right[5]
    return fitted


@njit(cache=True, nogil=True)
def enough(far: Indices, i: int, j: int, radius: int, least: int) -> bool:
    """Whether the window around (i, j) holds at least so many points."""
    count = 0
    for k in range(max(0, i - radius), min(far.shape[0], i + radius + 1)):
        for m in range(max(0, j - radius), min(far.shape[1], j + radius + 1)):
            count += far[k, m] >= 0
    return count >= least


@njit(cache=True, nogil=True)
def normal_equations(along: Array, i: int, j: int, radius: int, weight: Array, normal: Array, right: Array) -> None:
    """Normal equations of the second order around (i, j) from the sums along rows: terms 1, u, v, u^2, u v, v^2."""
    height = along.shape[1]
    m00 = m10 = m20 = m30 = m40 = m01 = m11 = m21 = m31 = m02 = m12 = m22 = m03 = m13 = m04 = 0.0
    r0 = r1 = r2 = r3 = r4 = r5 = 0.0
    for k in range(max(0, i - radius), min(height, i + radius + 1)):
        v = (k - i) / radius
        w = weight[k - i + radius]
        w1 = w * v
        w2 = w1 * v
        w3 = w2 * v
        n0, n1, n2, n3 = along[0, k, j], along[1, k, j], along[2, k, j], along[3, k, j]
        z0, z1 = along[5, k, j], along[6, k, j]
        m00 += w * n0
        m10 += w * n1
        m20 += w * n2
        m30 += w * n3
        m40 += w * along[4, k, j]
        m01 += w1 * n0
        m11 += w1 * n1
        m21 += w1 * n2
        m31 += w1 * n3
        m02 += w2 * n0
        m12 += w2 * n1
        m22 += w2 * n2
        m03 += w3 * n0
        m13 += w3 * n1
        m04 += w3 * v * n0
        r0 += w * z0
        r1 += w * z1
        r2 += w1 * z0
        r3 += w * along[7, k, j]
        r4 += w1 * z1
        r5 += w2 * z0
    normal[0, 0] = m00
    normal[1, 0], normal[1, 1] = m10, m20
    normal[2, 0], normal[2, 1], normal[2, 2] = m01, m11, m02
    normal[3, 0], normal[3, 1], normal[3, 2], normal[3, 3] = m20, m30, m21, m40
    normal[4, 0], normal[4, 1], normal[4, 2], normal[4, 3], normal[4, 4] = m11, m21, m12, m31, m22
    normal[5, 0], normal[5, 1], normal[5, 2], normal[5, 3], normal[5, 4], normal[5, 5] = m02, m12, m03, m22, m13, m04
    right[0], right[1], right[2], right[3], right[4], right[5] = r0, r1, r2, r3, r4, r5


@njit(cache=True, nogil=True)
def spacing(points: Array, depth: Array) -> Array:
    """Mean step along rows and along columns of the grid, in x and y, shape (2, 2), mm."""
    height, width = depth.shape
    total, count = np.zeros((2, 2)), np.zeros(2)
    for i in range(height):
        for j in range(width):
            if math.isnan(depth[i, j]):
                continue
            if i + 1 < height and not math.isnan(depth[i + 1, j]):
                total[0, 0] += points[i + 1, j, 0] - points[i, j, 0]
                total[0, 1] += points[i + 1, j, 1] - points[i, j, 1]
                count[0] += 1
            if j + 1 < width and not math.isnan(depth[i, j + 1]):
                total[1, 0] += points[i, j + 1, 0] - points[i, j, 0]
                total[1, 1] += points[i, j + 1, 1] - points[i, j, 1]
                count[1] += 1
    for axis in range(2):
        total[axis] /= max(count[axis], 1)
    return total


@njit(cache=True, nogil=True)
def in_notch(depth: Array, i: int, j: int, jump: float, least: int) -> float:
    """Mean depth of the neighbours of a place without a point where it is a notch of one surface, NaN where it is none.

    A notch: of its eight neighbours at least so many, but not all four nearest, follow each other round it and are linked each to the next.
    """
    height, width = depth.shape
    down, right = (-1, -1, 0, 1, 1, 1, 0, -1), (0, 1, 1, 1, 0, -1, -1, -1)
    count, nearest, arcs, total = 0, 0, 0, 0.0
    k, m = i + down[7], j + right[7]
    before = depth[k, m] if 0 <= k < height and 0 <= m < width else np.nan
    for q in range(8):
        k, m = i + down[q], j + right[q]
        here = depth[k, m] if 0 <= k < height and 0 <= m < width else np.nan
        if not math.isnan(here):
            count += 1
            nearest += q % 2 == 0
            total += here
            arcs += not abs(here - before) <= jump
        before = here
    return total / count if count >= least and nearest < 4 and arcs == 1 else np.nan


@njit(cache=True, nogil=True)
def close_notches(points: Array, depth: Array, candidate: Mask, jump: float, least: int, weight: Array) -> Mask:
    """Give places in notches of the surface's rim a point, in `points` and `depth`; where, as a mask of shape (H, W).

    Depth is that of the polynomial of second order through the linked points of the window, asked one step beyond them; x and y are
    those of the place's own line of sight there, from its neighbours' and the grid's spacing. What is closed bears out no other notch.
    """
    height, width = depth.shape
    size = len(weight)
    radius = size // 2
    step = spacing(points, depth)
    seen = np.empty((size, size), np.bool_)
    stack = np.empty(size * size, np.int32)
    normal, right = np.empty((6, 6)), np.empty(6)
    found = np.full((height, width), np.nan)
    for i in range(height):
        for j in range(width):
            if not candidate[i, j]:
                continue
            near = in_notch(depth, i, j, jump, least)
            if math.isnan(near):
                continue
            depth[i, j] = near
            reachable(depth, jump, i, j, radius, seen, stack)
            seen[radius, radius] = False
            if fit_window(depth, i, j, seen, weight, normal, right) and abs(right[0]) <= jump:
                found[i, j] = near + right[0]
            depth[i, j] = np.nan
    closed = ~np.isnan(found)
    for i in range(height):
        for j in range(width):
            if not closed[i, j]:
                continue
            x, y, count = 0.0, 0.0, 0
            for k in range(max(0, i - 1), min(height, i + 2)):
                for m in range(max(0, j - 1), min(width, j + 2)):
                    if not math.isnan(depth[k, m]) and not closed[k, m]:
                        x += points[k, m, 0] - (k - i) * step[0, 0] - (m - j) * step[1, 0]
                        y += points[k, m, 1] - (k - i) * step[0, 1] - (m - j) * step[1, 1]
                        count += 1
            points[i, j, 0], points[i, j, 1], points[i, j, 2] = x / count, y / count, found[i, j]
            depth[i, j] = found[i, j]
    return closed


@njit(cache=True, nogil=True)
def shift(bell: Array, rate: float, out: Array) -> None:
    """A table times exp(rate x), x counted from its middle."""
    grown = math.exp(rate)
    factor = math.exp(-rate * (len(bell) // 2))
    for k in range(len(bell)):
        out[k] = bell[k] * factor
        factor *= grown


@njit(cache=True, nogil=True)
def rim_moves(cover: Array, far: Indices, width_of_blur: float, most: float) -> Array:
    """How far points of the rim, with a nearest neighbour missing, lie from the smooth border of what is covered, shape (H, W, 2), steps.

    The border is where `cover` (1 on the surface, 0 beside it, between at mixed points), blurred by a Gaussian, is a half: on a straight
    rim that is the rim, whatever way the grid's staircase runs along it. No move is longer than `most`, and none turns a triangle over.
    Points of the window's own border stay: the surface may go on there.
    """
    height, width = cover.shape
    move = np.zeros((height, width, 2))
    reach = math.ceil(3 * width_of_blur) + 1
    size = 2 * reach + 1
    bell = np.exp(-(((np.arange(size) - reach) / width_of_blur) ** 2) / 2)
    g, h = np.empty(size), np.empty(size)
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if far[i, j] != 0 or min(far[i - 1, j], far[i + 1, j], far[i, j - 1], far[i, j + 1]) >= 0:
                continue
            v, u = 0.0, 0.0
            for _ in range(3):  # Newton's method along the steepest slope
                # A Gaussian about another place is that about the middle times an exponential, but for a factor, which cancels.
                shift(bell, v / width_of_blur**2, g)
                shift(bell, u / width_of_blur**2, h)
                value, slope_v, slope_u = 0.0, 0.0, 0.0
                for a in range(size):
                    row = min(max(i + a - reach, 0), height - 1)
                    s0, s1 = 0.0, 0.0
                    for b in range(size):
                        w = h[b] * cover[row, min(max(j + b - reach, 0), width - 1)]
                        s0 += w
                        s1 += w * (b - reach - u)
                    value += g[a] * s0
                    slope_v += g[a] * (a - reach - v) * s0
                    slope_u += g[a] * s1
                norm = g.sum() * h.sum()
                value /= norm
                slope_v /= norm * width_of_blur**2
                slope_u /= norm * width_of_blur**2
                steepness = slope_v * slope_v + slope_u * slope_u
                if steepness < 1e-4:
                    break
                v += (0.5 - value) * slope_v / steepness
                u += (0.5 - value) * slope_u / steepness
                length = math.hypot(v, u)
                if length > most:
                    v, u = v * most / length, u * most / length
            move[i, j, 0], move[i, j, 1] = v, u
    keep_turn(move, far)
    return move


@njit(cache=True, nogil=True)
def keep_turn(move: Array, far: Indices) -> None:
    """Undo the moves of the corners of every triangle, of three points of a square, that they would turn over or make a sliver."""
    height, width = far.shape
    v, u = np.empty(4), np.empty(4)
    row, column = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 0])
    changed = True
    while changed:
        changed = False
        for i in range(height - 1):
            for j in range(width - 1):
                # A square none of whose corners is of the rim stays as it is.
                if far[i, j] and far[i, j + 1] and far[i + 1, j] and far[i + 1, j + 1]:
                    continue
                still = True
                for c in range(4):
                    v[c], u[c] = row[c] + move[i + row[c], j + column[c], 0], column[c] + move[i + row[c], j + column[c], 1]
                    still &= move[i + row[c], j + column[c], 0] == 0.0 and move[i + row[c], j + column[c], 1] == 0.0
                if still:
                    continue
                for missing in range(4):
                    a, b, c = (missing + 1) % 4, (missing + 2) % 4, (missing + 3) % 4
                    there = True
                    for q in (a, b, c):
                        there &= far[i + row[q], j + column[q]] >= 0
                    if there and (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a]) < 0.1:
                        for q in (a, b, c):
                            k, m = i + row[q], j + column[q]
                            if move[k, m, 0] != 0.0 or move[k, m, 1] != 0.0:
                                move[k, m, 0] = move[k, m, 1] = 0.0
                                v[q], u[q] = row[q], column[q]
                                changed = True


@njit(cache=True, nogil=True)
def moved(points: Array, depth: Array, smooth: Array, move: Array) -> Array:
    """Points with their smooth depths, those of the rim moved along the grid; NaN where `depth` is."""
    height, width = depth.shape
    step = spacing(points, depth)
    out = np.full(points.shape, np.nan)
    for i in range(height):
        for j in range(width):
            if not math.isnan(depth[i, j]):
                v, u = move[i, j]
                out[i, j, 0] = points[i, j, 0] + v * step[0, 0] + u * step[1, 0]
                out[i, j, 1] = points[i, j, 1] + v * step[0, 1] + u * step[1, 1]
                out[i, j, 2] = smooth[i, j]
    return out


@njit(cache=True, nogil=True)
def too_steep(depth: Array, jump: float, rise: float, quantum: float) -> Mask:
    """Points whose depth rises by more than `rise` over two steps, both axes together; what a jump parts is not one slope."""
    height, width = depth.shape
    steep = np.zeros((height, width), np.bool_)
    for i in range(height):
        for j in range(width):
            z = depth[i, j]
            total = 0.0
            if 0 < i < height - 1 and abs(depth[i - 1, j] - z) <= jump and abs(depth[i + 1, j] - z) <= jump:
                total += max(abs(depth[i + 1, j] - depth[i - 1, j]) - quantum, 0.0) ** 2
            if 0 < j < width - 1 and abs(depth[i, j - 1] - z) <= jump and abs(depth[i, j + 1] - z) <= jump:
                total += max(abs(depth[i, j + 1] - depth[i, j - 1]) - quantum, 0.0) ** 2
            steep[i, j] = total > rise * rise
    return steep


@njit(cache=True, nogil=True)
def turn(points: Array, depth: Array) -> float:
    """Area, seen from the sensor, of the squares gone round as right, then down: negative where that is clockwise."""
    total = 0.0
    for i in range(depth.shape[0] - 1):
        for j in range(depth.shape[1] - 1):
            if math.isnan(depth[i, j] + depth[i, j + 1] + depth[i + 1, j]):
                continue
            x, y = points[i, j, 0], points[i, j, 1]
            total += (points[i, j + 1, 0] - x) * (points[i + 1, j, 1] - y) - (points[i, j + 1, 1] - y) * (points[i + 1, j, 0] - x)
    return total


@njit(cache=True, nogil=True)
def squares(points: Array, depth: Array, jump: float) -> NDArray[np.uint8]:
    """Triangles of each square of the grid (see `_TRIANGLES`), shape (H - 1, W - 1).

    Of the two diagonals of four linked points the shorter is taken; three linked points make one triangle.
    """
    height, width = depth.shape
    square = np.empty((height - 1, width - 1), np.uint8)
    for i in range(height - 1):
        for j in range(width - 1):
            a, b, c, d = depth[i, j], depth[i, j + 1], depth[i + 1, j + 1], depth[i + 1, j]
            ab, bc, cd, da = abs(a - b) <= jump, abs(b - c) <= jump, abs(c - d) <= jump, abs(d - a) <= jump
            ac, bd = abs(a - c) <= jump, abs(b - d) <= jump
            falling = 1 * (ab & bc & ac) + 2 * (ac & cd & da)
            rising = 4 * (bc & cd & bd) + 8 * (bd & da & ab)
            if falling and rising:
                x, y = points[i, j, 0] - points[i + 1, j + 1, 0], points[i, j, 1] - points[i + 1, j + 1, 1]
                p, q = points[i, j + 1, 0] - points[i + 1, j, 0], points[i, j + 1, 1] - points[i + 1, j, 1]
                square[i, j] = falling if x * x + y * y + (a - c) ** 2 <= p * p + q * q + (b - d) ** 2 else rising
            else:
                square[i, j] = falling + rising
    return square


@njit(cache=True, nogil=True)
def part_fans(square: NDArray[np.uint8]) -> None:
    """Leave one fan of triangles at every vertex: where fans meet in a point only, those of fewer triangles go."""
    height, width = square.shape[0] + 1, square.shape[1] + 1
    changed = True
    while changed:
        changed = False
        for i in range(height):
            for j in range(width):
                # Round the vertex, the squares before it (it is their corner 2), above (3), after (0) and below (1).
                a = square[i - 1, j - 1] if i and j else np.uint8(0)
                b = square[i - 1, j] if i and j < width - 1 else np.uint8(0)
                c = square[i, j] if i < height - 1 and j < width - 1 else np.uint8(0)
                d = square[i, j - 1] if i < height - 1 and j else np.uint8(0)
                p, q, r, s = _SIDES[a, 2], _SIDES[b, 3], _SIDES[c, 0], _SIDES[d, 1]
                # The side to the corner before, in one square, is the side to the next in the square that follows.
                pq, qr, rs, sp = p & 2 and q & 1, q & 2 and r & 1, r & 2 and s & 1, s & 2 and p & 1
                if (p > 0) + (q > 0) + (r > 0) + (s > 0) - (pq > 0) - (qr > 0) - (rs > 0) - (sp > 0) > 1:
                    keep_largest_fan(square, i, j)
                    changed = True


@njit(cache=True, nogil=True)
def keep_largest_fan(square: NDArray[np.uint8], i: int, j: int) -> None:
    """Take away all triangles at the vertex (i, j) but those of its largest fan."""
    place = np.array([[i - 1, j - 1], [i - 1, j], [i, j], [i, j - 1]])
    side, number, fan = np.zeros(4, np.uint8), np.zeros(4, np.int32), np.arange(4)
    for q in range(4):
        corner = (q + 2) % 4
        if 0 <= place[q, 0] < square.shape[0] and 0 <= place[q, 1] < square.shape[1]:
            kind = square[place[q, 0], place[q, 1]]
            side[q] = _SIDES[kind, corner]
            number[q] = _COUNT[kind] - _COUNT[_WITHOUT[kind, corner]]
    for _ in range(3):  # spread the smallest number over shared sides
        for q in range(4):
            if side[q] & 2 and side[(q + 1) % 4] & 1:
                fan[q] = fan[(q + 1) % 4] = min(fan[q], fan[(q + 1) % 4])
    members = np.zeros(4, np.int32)
    for q in range(4):
        members[fan[q]] += number[q]
    best = np.argmax(members)
    for q in range(4):
        if side[q] and fan[q] != best:
            square[place[q, 0], place[q, 1]] = _WITHOUT[square[place[q, 0], place[q, 1]], (q + 2) % 4]


@njit(cache=True, nogil=True)
def largest_sheet(square: NDArray[np.uint8]) -> None:
    """Leave only the triangles that hang together with most others; every vertex has one fan, so common corners will do."""
    height, width = square.shape
    label, root = unlabelled(height, width)
    used = 0
    for i in range(height):
        for j in range(width):
            corners = _CORNER_BITS[square[i, j]]
            if not corners:
                continue
            mine = 0
            if j and _CORNER_BITS[square[i, j - 1]] & ((corners & 1) << 1 | (corners & 8) >> 1):
                mine = label[i, j - 1]
            if i:
                for m in range(max(0, j - 1), min(width, j + 2)):
                    theirs = _CORNER_BITS[square[i - 1, m]]
                    if m == j:
                        common = theirs & ((corners & 1) << 3 | (corners & 2) << 1)
                    elif m < j:
                        common = theirs & (corners & 1) << 2
                    else:
                        common = theirs & (corners & 2) << 2
                    if common and label[i - 1, m] != mine:
                        mine = join(root, mine, label[i - 1, m]) if mine else label[i - 1, m]
            if not mine:
                used += 1
                root[used] = used
                mine = used
            label[i, j] = mine
    count = number_pieces(label, root, used)
    if count < 2:
        return
    members = np.zeros(count + 1, np.int64)
    for i in range(height):
        for j in range(width):
            members[label[i, j]] += _COUNT[square[i, j]]
    members[0] = 0
    best = np.argmax(members)
    for i in range(height):
        for j in range(width):
            if label[i, j] != best:
                square[i, j] = 0


@njit(cache=True, nogil=True)
def sheet(points: Array, square: NDArray[np.uint8], turned: bool) -> tuple[Array, Indices]:
    """Vertices (n, 3) and triangles (m, 3) of the squares, vertices row by row; `turned` exchanges two corners of each triangle."""
    height, width = square.shape[0] + 1, square.shape[1] + 1
    number = np.zeros((height, width), np.int32)
    made = 0
    for i in range(height - 1):
        for j in range(width - 1):
            kind = square[i, j]
            if kind:
                corners = _CORNER_BITS[kind]
                number[i, j] |= corners & 1
                number[i, j + 1] |= corners & 2
                number[i + 1, j + 1] |= corners & 4
                number[i + 1, j] |= corners & 8
                made += _COUNT[kind]
    used = 0
    for i in range(height):
        for j in range(width):
            used += number[i, j] != 0
    vertices = np.empty((used, 3))
    used = 0
    for i in range(height):
        for j in range(width):
            if number[i, j]:
                vertices[used, 0], vertices[used, 1], vertices[used, 2] = points[i, j, 0], points[i, j, 1], points[i, j, 2]
                number[i, j] = used
                used += 1
    triangles = np.empty((made, 3), np.int32)
    second, third = (2, 1) if turned else (1, 2)
    made = 0
    for i in range(height - 1):
        for j in range(width - 1):
            kind = square[i, j]
            if not kind:
                continue
            a, b, c, d = number[i, j], number[i, j + 1], number[i + 1, j + 1], number[i + 1, j]
            if kind & 1:
                triangles[made, 0], triangles[made, second], triangles[made, third] = a, b, c
                made += 1
            if kind & 2:
                triangles[made, 0], triangles[made, second], triangles[made, third] = a, c, d
                made += 1
            if kind & 4:
                triangles[made, 0], triangles[made, second], triangles[made, third] = b, c, d
                made += 1
            if kind & 8:
                triangles[made, 0], triangles[made, second], triangles[made, third] = b, d, a
                made += 1
    return vertices, triangles
