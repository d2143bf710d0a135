"""Readers of range images and meshes: what they read back, and that what is broken is refused by name."""

import contextlib
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanning.errors import EmptyScanError, FormatError, ScanError
from scanning.formats import read_range_image
from scanning.formats.abs import read_abs, write_abs
from scanning.formats.ply import read_mesh, read_range_grid, write_mesh
from scanning.mesh import TriangleMesh
from scanning.rangeimage import RangeImage

ABS = (
    b"2 rows\n3 columns\npixels (flag X Y Z):\n1 1 0 1 1 1\n"
    b"0 0.5 -999999.000000 0 0.5 1\n1 1 -999999.000000 0.5 0.5 0.5\n-9 -9.25 -999999.000000 -9 -9 -9\n"
)
quick = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def ply_grid(encoding: str, points: np.ndarray, grid: list[list[int]]) -> bytes:
    """A range grid, written with nothing of the package's."""
    height, width = len(grid), len(grid[0])
    header = f"ply\nformat {encoding} 1.0\nobj_info is_mesh 0\nbye\nobj_info num_cols {width}\nobj_info num_rows {height}\n"
    header += f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    header += f"element range_grid {width * height}\nproperty list uchar int vertex_indices\nend_header\n"
    entries = [index for row in grid for index in row]
    if encoding == "ascii":
        body = "".join(" ".join(map(repr, map(float, p))) + " \n" for p in points) + "".join(
            f"1 {i} \n" if i >= 0 else "0 \n" for i in entries
        )
        return (header + body).encode()
    order = "<" if "little" in encoding else ">"
    lists = b"".join(b"\x01" + np.array(i, order + "i4").tobytes() if i >= 0 else b"\x00" for i in entries)
    return header.encode() + points.astype(order + "f4").tobytes() + lists


GRID = [[0, -1, 1], [2, 3, -1]]
POINTS = np.array([[0, 0, 0.5], [2, 0, 0.25], [0, -1, 0], [1, -1, 0]])


def test_abs_by_hand(tmp_path: Path) -> None:
    (tmp_path / "P01.abs").write_bytes(ABS)
    image = read_range_image(tmp_path / "P01.abs")
    assert image.shape == (2, 3)
    assert image.valid.tolist() == [[True, True, False], [True, True, True]]
    assert image.points[0, 1].tolist() == [0.5, 1, -9.25]
    assert image.points[1, 2].tolist() == [1, 0.5, -9]
    assert np.isnan(image.points[0, 2]).all()
    assert image.step == pytest.approx(0.5)
    (tmp_path / "P02.abs.gz").write_bytes(gzip.compress(ABS))
    np.testing.assert_array_equal(read_range_image(tmp_path / "P02.abs.gz").points, image.points)
    np.testing.assert_array_equal(read_abs(tmp_path / "P01.abs", unit="cm").points, 10 * image.points)


@quick
@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_abs_round_trip(tmp_path: Path, height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    valid = rng.random((height, width)) < 0.8
    valid[0, 0] = True
    rows, columns = np.mgrid[:height, :width]
    points = np.round(np.stack([columns, -rows, rng.normal(0, 5, (height, width))], axis=-1), 6)
    write_abs(tmp_path / "a.abs", RangeImage(np.where(valid[..., None], points, np.nan), valid))
    back = read_abs(tmp_path / "a.abs")
    np.testing.assert_array_equal(back.valid, valid)
    np.testing.assert_array_equal(back.points[valid], points[valid])


def sheet(height: int, width: int, filled: float = 1.0) -> RangeImage:
    """A tilted sheet on a grid of 0.35 mm, round where it does not fill the grid."""
    rows, columns = np.mgrid[:height, :width]
    valid = np.hypot(rows / height - 0.5, columns / width - 0.5) < filled
    points = np.stack([columns, -rows, 0.2 * rows], axis=-1) * 0.35
    return RangeImage(np.where(valid[..., None], points, np.nan), valid)


@pytest.mark.parametrize("filled", [1.0, 0.3])
@pytest.mark.parametrize(("height", "width"), [(30, 40), (40, 30), (50, 100), (100, 50), (41, 40), (100, 25)])
def test_swapped_rows_and_columns_are_seen(tmp_path: Path, height: int, width: int, filled: float) -> None:
    image = sheet(height, width, filled)
    write_abs(tmp_path / "a.abs", image)
    assert read_abs(tmp_path / "a.abs").shape == (height, width)
    text = (tmp_path / "a.abs").read_text()
    (tmp_path / "a.abs").write_text(text.replace(f"{height} rows\n{width} columns", f"{width} rows\n{height} columns"))
    with pytest.raises(FormatError, match="rows and columns seem swapped") as caught:
        read_abs(tmp_path / "a.abs")
    assert caught.value.line == 1
    assert f"{width} rows and {height} columns" in str(caught.value)

    number = np.where(image.valid, np.cumsum(image.valid).reshape(height, width) - 1, -1).tolist()
    whole = ply_grid("binary_little_endian", image.points[image.valid], number)
    (tmp_path / "a.ply").write_bytes(whole)
    assert read_range_grid(tmp_path / "a.ply").shape == (height, width)
    swapped = whole.replace(b"num_cols %d" % width, b"num_cols %d" % height).replace(b"num_rows %d" % height, b"num_rows %d" % width)
    (tmp_path / "a.ply").write_bytes(swapped)
    with pytest.raises(FormatError, match=r"a\.ply: rows and columns seem swapped.*num_cols"):
        read_range_grid(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        (b"2 rows", b"rows 2", 1, "rows 2"),
        (b"3 columns", b"4 columns", 4, "6 values of flags"),
        (b"0.5 1\n1 1", b"0.5\n1 1", 5, "5 values of X"),
        (b"-9.25", b"deep", 7, "deep"),
        (b"1 1 0 1 1 1", b"1 1 0 2 1 1", 4, "flag 2"),
        (b"-9.25", b"-999999.000000", 7, "point 1"),
        (b"-9.25", b"nan", 7, "point 1"),
        (b"-9.25", b"inf", 7, "point 1"),
        (b"-9.25", b"1e400", 7, "point 1"),
        (b"-9.25", b"-9e25", 7, "-9e+25"),
        (b"2 rows", b"0 rows", 1, "0 rows"),
        (b"2 rows", b"999999999 rows", 4, "6 values of flags"),
        (b"-9.25", b"9" * 500, 7, "inf"),
        (b"-9 -9.25 -999999.000000 -9 -9 -9\n", b"", 6, "3 lines of values"),
        (b"1 1 0 1 1 1", b"0 0 0 0 0 0", 4, "none of the 6 points"),
        (b"pixels (flag X Y Z):", b"", 3, "pixels"),
    ],
)
def test_broken_abs_names_file_and_line(tmp_path: Path, old: bytes, new: bytes, line: int, said: str) -> None:
    assert old in ABS
    (tmp_path / "bad.abs").write_bytes(ABS.replace(old, new, 1))
    with pytest.raises(ScanError, match=r"bad\.abs") as caught:
        read_abs(tmp_path / "bad.abs")
    assert caught.value.line == line
    assert said in str(caught.value)


@quick
@given(st.data())
def test_mutated_files_raise_only_scan_errors(tmp_path: Path, data: st.DataObject) -> None:
    name, content = data.draw(
        st.sampled_from(
            [("a.abs", ABS), *((f"{e}.ply", ply_grid(e, POINTS, GRID)) for e in ("ascii", "binary_little_endian", "binary_big_endian"))]
        )
    )
    broken = bytearray(content)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(broken)))
        match data.draw(st.sampled_from(["cut", "change", "insert", "repeat"])):
            case "cut":
                del broken[place : place + data.draw(st.integers(1, 40))]
            case "change":
                broken[place : place + 1] = bytes([data.draw(st.integers(0, 255))])
            case "insert":
                broken[place:place] = data.draw(st.sampled_from([b"\n", b" ", b"9", b"-", b"e9", b"nan", b"1e400", b"\xff"]))
            case "repeat":
                broken += broken[place:]
    (tmp_path / name).write_bytes(bytes(broken))
    with contextlib.suppress(ScanError):
        image = read_range_image(tmp_path / name)
        assert np.isfinite(image.points[image.valid]).all()


@quick
@given(st.integers(0, len(ABS) - 1))
def test_cut_off_abs_is_refused(tmp_path: Path, kept: int) -> None:
    (tmp_path / "a.abs").write_bytes(ABS[:kept])
    if ABS[:kept].split() == ABS.split():
        assert read_abs(tmp_path / "a.abs").valid.sum() == 5
    else:
        with pytest.raises(ScanError):
            read_abs(tmp_path / "a.abs")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_range_grid_with_stray_line(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "g.ply").write_bytes(ply_grid(encoding, POINTS, GRID))
    image = read_range_grid(tmp_path / "g.ply", unit="m")
    assert image.valid.tolist() == [[True, False, True], [True, True, False]]
    np.testing.assert_array_equal(image.points[image.valid], 1000 * POINTS)
    whole = ply_grid(encoding, POINTS, GRID)
    (tmp_path / "g.ply").write_bytes(whole[: whole.index(b"end_header") + 40])
    with pytest.raises(FormatError, match="ends within element"):
        read_range_grid(tmp_path / "g.ply")
    (tmp_path / "g.ply").write_bytes(whole.replace(b"num_cols 3", b"num_cols 2"))
    with pytest.raises(FormatError, match="6 entries of the grid"):
        read_range_grid(tmp_path / "g.ply")


def test_bunny_grid(shared_data: Path) -> None:
    image = read_range_image(shared_data / "range" / "bunny" / "bun000.ply", unit="m")
    assert image.shape == (400, 512)
    assert image.valid.sum() == 40256
    # First vertex of the file, and the scanner's step of 0.5 mm.
    np.testing.assert_allclose(image.points[image.valid][0], [-63.25, 35.9793, 42.0873])
    np.testing.assert_allclose(np.nanmedian(np.diff(image.points[..., 0], axis=1)), 0.5, atol=1e-9)


def test_mesh_round_trip(tmp_path: Path) -> None:
    mesh = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5], [1, 1, 0.25]]), np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32))
    write_mesh(tmp_path / "m.ply", mesh, comment="petal P01, SIMULATED")
    assert b"comment petal P01, SIMULATED\n" in (tmp_path / "m.ply").read_bytes()
    back = read_mesh(tmp_path / "m.ply")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.triangles, mesh.triangles)
    (tmp_path / "m.ply").write_bytes((tmp_path / "m.ply").read_bytes()[:-3])
    with pytest.raises(FormatError, match="ends within element face"):
        read_mesh(tmp_path / "m.ply")


def test_open3d_reads_our_meshes(tmp_path: Path) -> None:
    import open3d

    mesh = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5], [1, 1, 0.25]]), np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32))
    write_mesh(tmp_path / "m.ply", mesh)
    back = open3d.io.read_triangle_mesh(str(tmp_path / "m.ply"))
    np.testing.assert_allclose(np.asarray(back.vertices), mesh.vertices)
    np.testing.assert_array_equal(np.asarray(back.triangles), mesh.triangles)


def test_what_is_no_scan(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="cannot be read"):
        read_range_image(tmp_path / "none.abs")
    with pytest.raises(FormatError, match=r"Export \.cdm"):
        read_range_image(tmp_path / "a.cdm")
    (tmp_path / "a.abs.gz").write_bytes(gzip.compress(ABS)[:30])
    with pytest.raises(ScanError, match="cannot be read"):
        read_range_image(tmp_path / "a.abs.gz")
    with pytest.raises(FormatError, match="unknown unit"):
        read_range_image(tmp_path / "a.ply", unit="feet")
    write_abs(tmp_path / "one.abs", RangeImage(np.zeros((1, 1, 3)), np.ones((1, 1), dtype=bool)))
    with pytest.raises(EmptyScanError, match="neighbouring"):
        _ = read_abs(tmp_path / "one.abs").step
