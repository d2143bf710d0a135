"""How a benchmark says what it saw."""


def verdict(what: str, seen: float, target: float, unit: str = "", *, note: str = "") -> int:
    """Print a figure beside its target (at most); return 1 where it was missed."""
    missed = not seen <= target
    print(
        f"   {what}: {seen:.4g}{unit}, target {target:g}{unit} or less{' - MISSED' if missed else ''}{f' ({note})' if note else ''}",
        flush=True,
    )
    return int(missed)
