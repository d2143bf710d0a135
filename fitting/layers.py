"""Eqs. (9) to (12): from what each layer sends back to transmittances and reflectances, or the ranges they can lie in."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fitting.errors import FitError
from fitting.paper import TERMS

Range = tuple[float, float]


def mixture_from(
    x: Mapping[str, float | Range],
    *,
    t_u: float | None = None,
    t_s: float | None = None,
    k_u_diff: float | None = None,
    k_u_spec: float | None = None,
    k_s_diff: float | None = None,
    k_s_spec: float | None = None,
    k_max: float = math.inf,
) -> dict[str, Range]:
    """Solve eqs. (9) to (12) for transmittances and reflectances, as far as they can be.

    Four equations hold six unknowns: with t_u and t_s known all k follow, with one k of each layer t_u and t_s do too; anything less leaves
    ranges. Each range is the exact extent of what is possible, the others being free within theirs.

    Parameters
    ----------
    x : mapping of str to float or (float, float)
        Coefficients u_diff, u_spec, s_diff, s_spec, or intervals for them.
    t_u, t_s : float, optional
        Transmittance of epidermis and spongy tissue, 0 to 1.
    k_u_diff, k_u_spec, k_s_diff, k_s_spec : float, optional
        Magnitudes of their reflectances, in the unit of x, 0 to `k_max`.
    k_max : float
        Largest k possible, such as 1 where x are reflectances.

    Returns
    -------
    dict of str to (float, float)
        Lowest and highest t_u, t_s, k_u_diff, k_u_spec, k_s_diff, k_s_spec; equal where determined, infinite where unbounded.

    Raises
    ------
    FitError
        If a number is out of its range, or what is given contradicts itself.
    """
    if missing := [name for name in TERMS if name not in x]:
        raise FitError(f"x lacks {', '.join(missing)}")
    if not k_max > 0:
        raise FitError(f"k_max must be above 0, not {k_max!r}")
    amounts = {name: _range(f"x_{name}", x[name], math.inf) for name in TERMS}
    given = {"u_diff": k_u_diff, "u_spec": k_u_spec, "s_diff": k_s_diff, "s_spec": k_s_spec}
    k = {name: (0.0, k_max) if value is None else _range(f"k_{name}", value, k_max) for name, value in given.items()}
    through_u = (0.0, 1.0) if t_u is None else _range("t_u", t_u, 1.0)
    through_s = (0.0, 1.0) if t_s is None else _range("t_s", t_s, 1.0)

    # What reaches the eye of each layer: x_u = seen_u k_u with seen_u = 1 - t_u, x_s = seen_s k_s with seen_s = t_u (1 - t_s).
    seen_u, seen_s = (1 - through_u[1], 1 - through_u[0]), (0.0, through_u[1] * (1 - through_s[0]))
    for name in TERMS:
        share = _over(amounts[name], k[name])
        if name.startswith("u"):
            seen_u = _both(seen_u, share, f"x_{name} = (1 - t_u) k_{name}")
        else:
            seen_s = _both(seen_s, share, f"x_{name} = t_u (1 - t_s) k_{name}")
    kept_s = (1 - through_s[1], 1 - through_s[0])
    through_u = _both((1 - seen_u[1], 1 - seen_u[0]), _over(seen_s, kept_s), "t_u of both layers")
    seen_u = (1 - through_u[1], 1 - through_u[0])
    seen_s = _both(seen_s, (through_u[0] * kept_s[0], through_u[1] * kept_s[1]), "t_u (1 - t_s)")
    kept_s = _both(kept_s, _over(seen_s, through_u), "1 - t_s")
    out = {"t_u": through_u, "t_s": (1 - kept_s[1], 1 - kept_s[0])}
    for name in TERMS:
        out[f"k_{name}"] = _both(k[name], _over(amounts[name], seen_u if name.startswith("u") else seen_s), f"k_{name}")
    return out


def _range(name: str, value: float | Range, most: float) -> Range:
    low, high = value if isinstance(value, tuple) else (value, value)
    if not 0 <= low <= high <= most:
        raise FitError(f"{name} must lie within 0 to {most:g}, not {value!r}")
    return float(low), float(high)


def _over(numerator: Range, denominator: Range) -> Range:
    """Range of q >= 0 for which q d = n has a solution within the ranges; inf for no bound."""
    low = 0.0 if numerator[0] == 0 else numerator[0] / denominator[1] if denominator[1] > 0 else math.inf
    high = math.inf if denominator[0] == 0 or numerator[1] == math.inf else numerator[1] / denominator[0]
    return low, high


def _both(one: Range, other: Range, what: str) -> Range:
    """Intersect two ranges; ends that miss one another by rounding meet."""
    low, high = max(one[0], other[0]), min(one[1], other[1])
    if low > high or low == math.inf:
        if low == math.inf or low - high > 1e-9 * max(1.0, low):
            raise FitError(f"what is given contradicts itself: {what} would have to be at least {low:.6g} and at most {high:.6g}")
        low = high = (low + high) / 2
    return low, high
