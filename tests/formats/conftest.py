"""A renderer for the tests of formats."""

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def mitsuba() -> Iterator[Any]:
    """Mitsuba 3, its variant put back afterwards."""
    mi = pytest.importorskip("mitsuba", reason="Mitsuba 3 is an optional extra")
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield mi
    if before:
        mi.set_variant(before)
