"""Range images of petals into meshes, and meshes into a flower."""
