"""Cubic splines over a grid, in NumPy alone: loading and asking a petal table needs nothing else."""

from collections.abc import Callable

import numpy as np

Weights = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def spline_slopes(nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Slopes at the nodes of the not-a-knot cubic spline through `values` along their first axis.

    Parameters
    ----------
    nodes : ndarray, shape (n,), n >= 4, rising
    values : ndarray, shape (n, ...)

    Returns
    -------
    ndarray, shape (n, ...)

    Notes
    -----
    The second derivative is continuous at inner nodes, and the third too at the second and the last but one (de Boor, A Practical Guide to
    Splines, chapter IV).
    """
    n = len(nodes)
    h = np.diff(nodes)
    chord = np.diff(values, axis=0) / h.reshape(-1, *[1] * (values.ndim - 1))
    matrix = np.zeros((n, n))
    right = np.zeros_like(values)
    for k in range(1, n - 1):
        matrix[k, k - 1 : k + 2] = h[k], 2 * (h[k - 1] + h[k]), h[k - 1]
        right[k] = 3 * (h[k] * chord[k - 1] + h[k - 1] * chord[k])
    for row, a, b, c0, c1 in ((0, h[0], h[1], chord[0], chord[1]), (n - 1, h[-1], h[-2], chord[-1], chord[-2])):
        near = [0, 1] if row == 0 else [n - 1, n - 2]
        matrix[row, near] = b, a + b
        right[row] = ((a + 2 * (a + b)) * b * c0 + a * a * c1) / (a + b)
    return np.linalg.solve(matrix, right.reshape(n, -1)).reshape(values.shape)


def hermite(t: np.ndarray, h: np.ndarray) -> Weights:
    """Weights of (left value, right value, left slope, right slope) at the share t of an interval of length h."""
    return (1 + 2 * t) * (1 - t) ** 2, t * t * (3 - 2 * t), h * t * (1 - t) ** 2, -h * t * t * (1 - t)


def hermite_slope(t: np.ndarray, h: np.ndarray) -> Weights:
    """The same for the slope there."""
    return 6 * t * (t - 1) / h, 6 * t * (1 - t) / h, (1 - t) * (1 - 3 * t), t * (3 * t - 2)


class BicubicSpline:
    """Twice continuously differentiable surface through values on a grid.

    Parameters
    ----------
    x : ndarray, shape (n,), rising
    y : ndarray, shape (m,), rising
    values : ndarray, shape (n, m)
    """

    def __init__(self, x: np.ndarray, y: np.ndarray, values: np.ndarray) -> None:
        self._x, self._y = x, y
        along_x = spline_slopes(x, values)
        along_y = spline_slopes(y, values.T).T
        self._corners = np.stack([values, along_x, along_y, spline_slopes(x, along_y)])  # (4, n, m)

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at points within the grid; x and y have one shape."""
        return self._sum(x, y, hermite)

    def slope_y(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Slopes along y at points within the grid; x and y have one shape."""
        return self._sum(x, y, hermite_slope)

    def _sum(self, x: np.ndarray, y: np.ndarray, weights_y: Callable[[np.ndarray, np.ndarray], Weights]) -> np.ndarray:
        i = np.clip(np.searchsorted(self._x, x, side="right") - 1, 0, len(self._x) - 2)
        j = np.clip(np.searchsorted(self._y, y, side="right") - 1, 0, len(self._y) - 2)
        hx, hy = self._x[i + 1] - self._x[i], self._y[j + 1] - self._y[j]
        wx = hermite((x - self._x[i]) / hx, hx)
        wy = weights_y((y - self._y[j]) / hy, hy)
        total = np.zeros(np.shape(x))
        for a in (0, 1):
            for b in (0, 1):
                value, along_x, along_y, along_both = self._corners[:, i + a, j + b]
                total += wx[a] * (wy[b] * value + wy[2 + b] * along_y) + wx[2 + a] * (wy[b] * along_x + wy[2 + b] * along_both)
        return total
