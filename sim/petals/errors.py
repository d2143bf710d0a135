"""The one error of the virtual petals."""


class PetalError(Exception):
    """A virtual petal was asked for something it does not have: a name, an angle, a physical value or a table file."""
