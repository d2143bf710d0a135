"""A package of its own: as a mere folder it would give way to any installed distribution that brings a package `tests`."""
