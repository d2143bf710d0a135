"""What can go wrong between a flower and its picture."""


class RenderError(Exception):
    """Root of this package's errors: the scene, the camera, the light or a file does not allow the picture asked for."""
