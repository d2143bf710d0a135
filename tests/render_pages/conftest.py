"""What the tests of the pages share."""

import shutil
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.render_pages.browser import Browser


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[Browser]":
    """Give a headless Chromium; the test is skipped where there is none."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("there is no Chromium on this machine to open the page with")
    pytest.importorskip("websockets", reason="the client that drives the browser comes with the optional package viser")
    from tests.render_pages.browser import Browser

    with Browser(program, tmp_path_factory.mktemp("browser")) as opened:
        yield opened
