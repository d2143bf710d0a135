"""A slow function of one or two shape numbers, worked out at nodes as they are needed and interpolated between them.

Lobes fall by decades from one exponent to the next, so logarithms are interpolated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAINTEST = 1e-8
"""Values far below this are as good as 0."""


class Nodes:
    """Cubic interpolation of logarithms over the logarithms of shape numbers, smooth across nodes (Catmull and Rom 1974).

    Parameters
    ----------
    function : callable
        Takes the numbers by name and returns an array, 0 or more, always of one shape.
    bounds : mapping of str to (float, float)
        Lowest and highest value of each number, above 0. Without any, the function is called as it is.
    ratio : mapping of str to float
        Of neighbouring nodes, at most.
    """

    def __init__(self, function: Callable[..., Array], bounds: Mapping[str, tuple[float, float]], ratio: Mapping[str, float]) -> None:
        self._function, self._known = function, dict[tuple[int, ...], Array]()
        self._bounds, self._low, self._step, self._count = dict(bounds), {}, {}, {}
        for name, (low, high) in bounds.items():
            count = max(3, math.ceil(math.log(high / low) / math.log(ratio[name]))) + 1
            self._low[name], self._count[name] = math.log(low), count
            self._step[name] = math.log(high / low) / (count - 1)

    def __call__(self, **numbers: float) -> Array:
        """Interpolate; numbers outside their bounds are an error of the caller."""
        if not self._low:
            return self._function()
        corners = []
        for name, low in self._low.items():
            place = (math.log(numbers[name]) - low) / self._step[name]
            first = min(max(math.floor(place), 0), self._count[name] - 2)
            corners.append(_weights(first, place - first, self._count[name]))
        parts = [math.prod(w for _, w in chosen) * self._at(tuple(k for k, _ in chosen)) for chosen in itertools.product(*corners)]
        return np.exp(np.sum(parts, axis=0)) - FAINTEST

    def _at(self, node: tuple[int, ...]) -> Array:
        if node not in self._known:
            values = {name: self._value(name, k) for name, k in zip(self._low, node, strict=True)}
            self._known[node] = np.log(self._function(**values) + FAINTEST)
        return self._known[node]

    def _value(self, name: str, k: int) -> float:
        low, high = self._bounds[name]
        return min(max(math.exp(self._low[name] + k * self._step[name]), low), high)  # rounding only


def _weights(first: int, t: float, count: int) -> list[tuple[int, float]]:
    """Nodes about a place between `first` and the next, and their weights; beyond the ends the row goes on as a parabola."""
    inner = {
        first - 1: -t / 2 + t * t - t**3 / 2,
        first: 1 - 2.5 * t * t + 1.5 * t**3,
        first + 1: t / 2 + 2 * t * t - 1.5 * t**3,
        first + 2: (t**3 - t * t) / 2,
    }
    for outside, inward in ((-1, 1), (count, -1)):
        if outside in inner:
            weight = inner.pop(outside)
            for step, share in ((1, 3), (2, -3), (3, 1)):
                inner[outside + step * inward] += share * weight
    return list(inner.items())
