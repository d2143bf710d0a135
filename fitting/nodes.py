"""A slow function of one or two shape numbers, worked out at nodes as they are needed and interpolated between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Nodes:
    """Cubic interpolation over the logarithms of shape numbers, smooth across nodes (Catmull and Rom 1974).

    Parameters
    ----------
    function : callable
        Takes the numbers by name and returns an array, always of one shape.
    bounds : mapping of str to (float, float)
        Lowest and highest value of each number, above 0. Without any, the function is called as it is.
    ratio : mapping of str to float
        Of neighbouring nodes, at most.
    """

    def __init__(self, function: Callable[..., Array], bounds: Mapping[str, tuple[float, float]], ratio: Mapping[str, float]) -> None:
        self._function, self._known = function, dict[tuple[int, ...], Array]()
        self._low, self._step, self._count = {}, {}, {}
        for name, (low, high) in bounds.items():
            count = max(3, math.ceil(math.log(high / low) / math.log(ratio[name]))) + 1
            self._low[name], self._count[name] = math.log(low), count
            self._step[name] = math.log(high / low) / (count - 1)

    def __call__(self, **numbers: float) -> Array:
        """Interpolate; numbers outside their bounds are an error of the caller."""
        corners = []
        for name, low in self._low.items():
            place = (math.log(numbers[name]) - low) / self._step[name]
            first = min(max(math.floor(place), 0), self._count[name] - 2)
            corners.append(_weights(first, place - first, self._count[name]))
        parts = [math.prod(w for _, w in chosen) * self._at(tuple(k for k, _ in chosen)) for chosen in itertools.product(*corners)]
        return np.asarray(sum(parts[1:], parts[0]))

    def _at(self, node: tuple[int, ...]) -> Array:
        if node not in self._known:
            values = {name: math.exp(self._low[name] + k * self._step[name]) for name, k in zip(self._low, node, strict=True)}
            self._known[node] = self._function(**values)
        return self._known[node]


def _weights(first: int, t: float, count: int) -> list[tuple[int, float]]:
    """Nodes about a place between `first` and the next, and their weights; beyond the ends the row goes on straight."""
    inner = {
        first - 1: -t / 2 + t * t - t**3 / 2,
        first: 1 - 2.5 * t * t + 1.5 * t**3,
        first + 1: t / 2 + 2 * t * t - 1.5 * t**3,
        first + 2: (t**3 - t * t) / 2,
    }
    for outside, edge, within in ((-1, 0, 1), (count, count - 1, count - 2)):
        if outside in inner:
            weight = inner.pop(outside)
            inner[edge] += 2 * weight
            inner[within] -= weight
    return list(inner.items())
