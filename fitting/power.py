"""Powers for the lobes of all kernels (numba)."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True)
def power(x: float, exponent: float) -> float:
    """Raise to a power; whole exponents, the usual ones, by squaring, several times quicker."""
    whole = int(exponent)
    if whole != exponent or whole > 4096:
        return x**exponent
    out = 1.0
    while whole:
        if whole & 1:
            out *= x
        x *= x
        whole >>= 1
    return out
