"""Writers of range images and meshes."""

from pathlib import Path

import numpy as np

from sim.rose.mesh import Mesh
from sim.rose.scanner import Scan


def write_abs(path: Path, scan: Scan) -> None:
    """Write a range image as VIVID/FRGC ascii: two lines of size, a legend, then flags, X, Y, Z, each one line, row by row."""
    rows, columns = scan.valid.shape
    count = rows * columns
    with path.open("w", encoding="ascii", newline="\n") as out:
        out.write(f"{rows} rows\n{columns} columns\npixels (flag X Y Z):\n")
        out.write(" ".join(np.where(scan.valid.ravel(), "1", "0")) + "\n")
        line = " ".join(["%.6f"] * count) + "\n"
        for axis in range(3):
            # Adding zero turns -0.0 into 0.0.
            out.write(line % tuple((scan.points[..., axis].ravel() + 0.0).tolist()))


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary little-endian PLY (float32 vertices, mm)."""
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = mesh.faces
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes())
