"""Settings of the property tests."""

from hypothesis import settings

# The first example of a test may load or compile a numba kernel: no example is held to a time.
settings.register_profile("kernels", deadline=None)
settings.load_profile("kernels")
