"""Settings of the property tests, and traces that several files share."""

import os

import pytest
from hypothesis import settings

from fitting.ladder import Traces

# The first example of a test may load or compile a numba kernel: no example is held to a time.
settings.register_profile("kernels", deadline=None)
settings.load_profile("kernels")


@pytest.fixture(scope="session")
def traces(tmp_path_factory: pytest.TempPathFactory) -> Traces:
    """Tracing is what is slow: what one worker has traced the others read. The folder is this run's own."""
    mine = tmp_path_factory.getbasetemp()
    return Traces((mine.parent if "PYTEST_XDIST_WORKER" in os.environ else mine) / "traces")
