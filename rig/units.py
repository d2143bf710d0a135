"""Numbers with units, for people."""

import math

_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M"}


def engineering(value: float, unit: str, digits: int = 4) -> str:
    """Return `value` with an SI prefix, e.g. `31.42 nA`."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g} {unit}"
    power = min(max(3 * math.floor(math.log10(abs(value)) / 3), -15), 6)
    return f"{value / 10.0**power:.{digits}g} {_PREFIXES[power]}{unit}"


def duration(seconds: float) -> str:
    """Return a time as a person would say it: `8 s`, `2 min 05 s`, `1 h 10 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
