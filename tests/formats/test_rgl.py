"""RGL files: Mitsuba's `measured` loads and renders what is written, and agrees on what is read."""

from __future__ import annotations

import io
import math
import struct
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fitting.errors import DomainError, FitError, TableError
from fitting.formats.grid import Brdf
from fitting.formats.merl import read_merl, write_merl
from fitting.formats.rgl import MAGIC, read_rgl, write_rgl
from tests.formats.lobes import lobes

SETTINGS = settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def grey(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    return lobes(theta_i, theta_r, phi)[..., 1]


def unit(theta: float, phi: float) -> list[float]:
    theta, phi = math.radians(theta), math.radians(phi)
    return [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]


def evaluated(mi: Any, path: Path, angles: Any, wavelengths: Any = None) -> Any:
    """Mitsuba's f_r for rows of theta_i, phi_i, theta_r, phi_r."""
    bsdf = mi.load_dict({"type": "measured", "filename": str(path)})
    context, point = mi.BSDFContext(), mi.SurfaceInteraction3f()
    if wavelengths is not None:
        point.wavelengths = wavelengths
    found = []
    for theta_i, phi_i, theta_r, phi_r in angles:
        point.wi = unit(theta_i, phi_i)
        found.append(np.array(bsdf.eval(context, point, unit(theta_r, phi_r))) / math.cos(math.radians(theta_r)))
    return np.array(found)


def drawn(seed: int, count: int, steepest: float = 85.0) -> Any:
    """Random rows of theta_i, phi_i, theta_r, phi_r."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(0.1, steepest, (2, count)), rng.uniform(-180, 180, (2, count))])[[0, 2, 1, 3]].T


@pytest.mark.parametrize("function", [lobes, grey])
def test_mitsuba_evaluates_what_was_written(tmp_path: Path, mitsuba: Any, function: Any) -> None:
    path = tmp_path / "lobes.bsdf"
    write_rgl(path, function, description="three lobes")
    angles = drawn(1, 600)
    expected = np.broadcast_to(np.reshape(function(angles[:, 0], angles[:, 2], angles[:, 3] - angles[:, 1]), (600, -1)), (600, 3))
    found = evaluated(mitsuba, path, angles)
    off = np.abs(found / expected - 1)
    assert np.median(off) < 0.001
    assert np.percentile(off, 95) < 0.01
    rgl = read_rgl(path)
    assert rgl.description == "three lobes"
    np.testing.assert_allclose(rgl.evaluate(*angles.T), found, rtol=2e-4)


def test_mitsuba_evaluates_a_spectrum(tmp_path: Path, mitsuba: Any) -> None:
    """Three channels at 400, 550 and 700 nm; between them Mitsuba goes straight."""
    path = tmp_path / "spectrum.bsdf"
    write_rgl(path, lobes, wavelengths_nm=[400, 550, 700])
    mitsuba.set_variant("scalar_spectral")
    angles = drawn(2, 100, 80.0)
    found = evaluated(mitsuba, path, angles, [400.0, 550.0, 625.0, 700.0])
    expected = lobes(angles[:, 0], angles[:, 2], angles[:, 3] - angles[:, 1])
    expected = np.column_stack([expected[:, 0], expected[:, 1], expected[:, 1:].mean(axis=1), expected[:, 2]])
    assert np.percentile(np.abs(found / expected - 1), 95) < 0.01
    rgl = read_rgl(path)
    assert rgl.channels == ("400 nm", "550 nm", "700 nm")
    np.testing.assert_allclose(rgl.evaluate(*angles.T), found[:, [0, 1, 3]], rtol=2e-4)


def test_mitsuba_draws_views_as_light_is_sent(tmp_path: Path, mitsuba: Any) -> None:
    """The mean weight of drawn views is the albedo, and the weights are alike."""
    path = tmp_path / "grey.bsdf"
    write_rgl(path, grey)
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    point, context = mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
    theta, phi = np.meshgrid((np.arange(180) + 0.5) / 2, np.arange(360) + 0.5, indexing="ij")
    area = np.sin(np.radians(theta)) * np.cos(np.radians(theta)) * np.radians(0.5) * np.radians(1)
    rng = np.random.default_rng(3)
    for theta_i in (0.0, 45.0, 75.0):
        point.wi = unit(theta_i, 0)
        weights = np.array([np.array(bsdf.sample(context, point, 0.5, u)[1])[0] for u in rng.random((4000, 2)).tolist()])
        albedo = float((grey(theta_i, theta, phi) * area).sum())
        assert weights.mean() == pytest.approx(albedo, rel=0.02)
        assert weights.std() < 0.3 * albedo
        assert weights.max() < 5 * albedo


def test_a_rendered_sphere(tmp_path: Path, mitsuba: Any) -> None:
    """A white sky about a sphere: each of its points shows its albedo; a Lambertian sphere by Mitsuba's own material beside it."""
    path = tmp_path / "grey.bsdf"
    write_rgl(path, lambda i, r, p: np.full(np.broadcast(i, r, p).shape, 0.5 / np.pi))

    def picture(material: dict[str, Any]) -> Any:
        camera = {
            "type": "perspective",
            "fov": 25,
            "to_world": mitsuba.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}},
        }
        lamp = {"type": "directional", "direction": [-1, -1, -1], "irradiance": 2.0}
        scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 2}, "camera": camera, "lamp": lamp}
        scene |= {"sky": {"type": "constant", "radiance": 0.5}, "ball": {"type": "sphere", "bsdf": material}}
        return np.array(mitsuba.render(mitsuba.load_dict(scene), spp=64, seed=1))[..., 0]

    found = picture({"type": "measured", "filename": str(path)})
    expected = picture({"type": "diffuse", "reflectance": 0.5})
    assert np.all(np.isfinite(found))
    assert np.abs(found - expected).max() < 0.15
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.03
    assert found.mean() == pytest.approx(expected.mean(), rel=0.01)


def tensors(mi: Any, path: Path, arrays: dict[str, Any]) -> None:
    """Write a tensor file by Mitsuba's own writer."""
    with redirect_stdout(io.StringIO()):
        mi.tensor_io.write(str(path), **arrays)


def warped(phi_i: Any) -> dict[str, Any]:
    """Arrays as a measured file has them: facets that are nowhere even, pictures warped by them and divided."""
    rng = np.random.default_rng(5)
    theta_i = np.radians([0, 20, 45, 70, 88]).astype(np.float32)
    lights = len(phi_i), len(theta_i)

    def bumpy(*shape: int) -> Any:
        bumps = rng.uniform(0.2, 2.0, shape).astype(np.float32)
        # Left and right of the light are alike on an isotropic sample; Mitsuba may turn the one into the other.
        return bumps + bumps[..., ::-1, :] if len(phi_i) <= 2 else bumps

    sigma = bumpy(6, 5)
    if len(phi_i) <= 2:
        sigma[:] = sigma[0]
    return {
        "description": "bumps",
        "theta_i": theta_i,
        "phi_i": np.radians(phi_i).astype(np.float32),
        "ndf": bumpy(7, 9),
        "sigma": sigma,
        "vndf": bumpy(*lights, 7, 9),
        "luminance": bumpy(*lights, 8, 8),
        "rgb": bumpy(*lights, 3, 8, 8),
        "jacobian": np.ones(1, np.uint8),
    }


@pytest.mark.parametrize(
    "phi_i",
    [[0], np.linspace(-180, 180, 9), np.linspace(-180, 0, 5), np.linspace(-180, -90, 4)],
    ids=["isotropic", "whole", "half", "quarter"],
)
def test_measured_files_are_read_as_mitsuba_does(tmp_path: Path, mitsuba: Any, phi_i: Any) -> None:
    path = tmp_path / "bumps.bsdf"
    tensors(mitsuba, path, warped(phi_i))
    angles = drawn(6, 500)
    rgl = read_rgl(path)
    assert rgl.isotropic == (len(phi_i) <= 2)
    assert rgl.divided
    np.testing.assert_allclose(rgl.evaluate(*angles.T), evaluated(mitsuba, path, angles), rtol=5e-4)
    with pytest.raises(DomainError, match="outside the file"):
        rgl(89, 10, 0)
    assert not rgl.covers(89, 10, 0)


def test_other_peoples_files_are_read_as_mitsuba_does(shared_data: Path, mitsuba: Any) -> None:
    """Every RGL file of the reference measurements; Zemax files end in .bsdf too."""
    files = [path for path in sorted(shared_data.rglob("*.bsdf")) if path.read_bytes()[: len(MAGIC)] == MAGIC]
    if not files:
        pytest.skip("the reference measurements have no RGL file")
    for path in files:
        rgl = read_rgl(path)
        if rgl.channels != ("R", "G", "B"):
            mitsuba.set_variant("scalar_spectral")
        nm = [float(name.split()[0]) for name in rgl.channels[:: max(1, len(rgl.channels) // 3)]][:4] if rgl.channels[0] != "R" else None
        angles = drawn(8, 300, min(80.0, rgl.theta_i_deg[-1]))
        found = evaluated(mitsuba, path, angles, nm and nm + [nm[-1]] * (4 - len(nm)))
        ours = rgl.evaluate(*angles.T)
        if nm:
            at = [rgl.channels.index(f"{value:.6g} nm") for value in nm]
            ours, found = ours[:, at], found[:, : len(at)]
        else:
            found = found[:, :3]
        assert np.percentile(np.abs(found / ours - 1), 99) < 0.001, path
        mitsuba.set_variant("scalar_rgb")


def test_mitsuba_reads_the_arrays(tmp_path: Path, mitsuba: Any) -> None:
    path = tmp_path / "arrays.bsdf"
    write_rgl(path, lobes, resolution=5, theta_i_deg=[0, 30, 60])
    with redirect_stdout(io.StringIO()):
        found = mitsuba.tensor_io.read(str(path))
    assert found["rgb"].shape == (1, 3, 3, 5, 5)
    np.testing.assert_allclose(np.degrees(found["theta_i"]), [0, 30, 60], rtol=1e-6)
    assert np.all(found["luminance"] >= 0)
    # Middle of the top edge: the half vector is the normal, the view the mirror's direction.
    np.testing.assert_allclose(found["rgb"][0, 1, :, 2, 0], lobes(30, 30, 180) * math.cos(math.radians(30)), rtol=1e-6)


def test_gridded(tmp_path: Path) -> None:
    write_rgl(tmp_path / "a.bsdf", lobes)
    grid = read_rgl(tmp_path / "a.bsdf").gridded([0, 30, 60], [0, 30, 60], [0, 90, 180])
    assert isinstance(grid, Brdf)
    np.testing.assert_allclose(grid.values[1, 2, 1], lobes(30, 60, 90), rtol=0.01)


def test_to_merl_and_back(tmp_path: Path) -> None:
    """Each step interpolates: a percent, but for the light's way home and near grazing."""
    write_rgl(tmp_path / "a.bsdf", lobes)
    write_merl(tmp_path / "b.binary", read_rgl(tmp_path / "a.bsdf"))
    write_rgl(tmp_path / "c.bsdf", read_merl(tmp_path / "b.binary"), theta_i_deg=np.linspace(0, 85, 33), resolution=64)
    at = drawn(7, 2000, 75.0).T
    at = at[0], at[2], at[3] - at[1]
    for found in (read_merl(tmp_path / "b.binary"), read_rgl(tmp_path / "c.bsdf")):
        off = np.abs(found(*at) / lobes(*at) - 1)
        assert np.median(off) < 0.005
        assert np.percentile(off, 95) < 0.03


def test_what_cannot_be_written_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "old.bsdf"
    path.write_bytes(b"old")
    part = Brdf.sampled(grey, [0, 30], [0, 30], [0, 90, 180])
    two = [lambda i, r, p: np.ones((*np.broadcast(i, r, p).shape, 2)), {}]
    nan = [lambda i, r, p: np.full(np.broadcast(i, r, p).shape, np.nan), {}]
    for (function, options), match in (
        (two, "neither grey nor R, G, B"),
        (nan, "finite"),
        ([part, {}], "outside the grid"),
        ([lobes, {"wavelengths_nm": [400, 500]}], "wavelengths"),
        ([lobes, {"wavelengths_nm": [500, 400, 600]}], "rising"),
        ([grey, {"resolution": 1}], "resolution"),
        ([grey, {"theta_i_deg": [0, 95]}], "theta_i"),
    ):
        with pytest.raises(DomainError, match=match):
            write_rgl(path, function, **options)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(TableError, match="cannot be written"):
        write_rgl(tmp_path / "none" / "x.bsdf", grey)


@pytest.fixture
def small(tmp_path: Path) -> bytes:
    write_rgl(tmp_path / "small.bsdf", lobes, resolution=4, theta_i_deg=[0, 45, 90])
    return (tmp_path / "small.bsdf").read_bytes()


def refused(tmp_path: Path, content: bytes, match: str) -> None:
    path = tmp_path / "bad.bsdf"
    path.write_bytes(content)
    with pytest.raises(TableError, match=match):
        read_rgl(path)


def test_foreign_and_cut_files(tmp_path: Path, small: bytes) -> None:
    refused(tmp_path, b"", "byte 0")
    refused(tmp_path, b'<?xml version="1.0"?><WindowElement/>', "byte 0: does not begin")
    refused(tmp_path, MAGIC + struct.pack("<2BI", 2, 0, 1), r"byte 12: version \(2, 0\)")
    refused(tmp_path, MAGIC + struct.pack("<2BI", 1, 0, 0), "has no array 'theta_i'")
    refused(tmp_path, MAGIC + struct.pack("<2BI", 1, 0, 2**32 - 1), "ends at byte 18, within its table")
    refused(tmp_path, small[:60], "ends at byte 60")
    refused(tmp_path, small[:-1], f"ends at byte {len(small) - 1}: it is cut short")
    with pytest.raises(TableError, match="cannot be read"):
        read_rgl(tmp_path / "none.bsdf")


def test_lying_sizes_cost_no_memory(tmp_path: Path) -> None:
    head = MAGIC + struct.pack("<2BI", 1, 0, 1) + struct.pack("<H", 3) + b"ndf"
    refused(
        tmp_path, head + struct.pack("<HBQ2Q", 2, 10, 64, 2**62, 2**62) + bytes(64), r"byte 18: array 'ndf' of shape .* would end at byte"
    )
    refused(tmp_path, head + struct.pack("<HBQ2Q", 2, 10, 2**63, 2, 2) + bytes(64), "would end at byte")
    refused(tmp_path, head + struct.pack("<HBQ", 65535, 10, 64) + bytes(64), "65535 axes")
    refused(tmp_path, head + struct.pack("<HBQ", 2, 99, 64) + bytes(64), "type 99")


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("theta_i", np.array([0.0, 0.5, 0.4], np.float32), "'theta_i' must rise"),
        ("theta_i", np.array([0.0, 0.5, 2.4], np.float32), "'theta_i' must rise"),
        ("ndf", np.full((7, 9), np.nan, np.float32), r"byte \d+: array 'ndf' holds nan"),
        ("ndf", np.ones((1, 9), np.float32), "two or more each way"),
        ("sigma", np.zeros((6, 5), np.float32), "'sigma' must be more than 0"),
        ("vndf", np.zeros((1, 5, 7, 9), np.float32), "'vndf' must be 0 or more"),
        ("vndf", np.ones((1, 4, 7, 9), np.float32), "expected float32 of 1x5xnxn"),
        ("rgb", np.ones((1, 5, 2, 8, 8), np.float32), "expected float32 of 1x5x3xnxn"),
        ("rgb", np.ones((1, 5, 3, 8, 8), np.float64), "float64"),
        ("rgb", np.ones((1, 5, 3, 8, 9), np.float32), "squares"),
        ("luminance", np.ones((1, 5, 8, 7), np.float32), "'luminance'"),
        ("jacobian", np.ones(2, np.uint8), "'jacobian'"),
    ],
)
def test_arrays_that_make_no_reflectance(tmp_path: Path, mitsuba: Any, name: str, value: Any, match: str) -> None:
    path = tmp_path / "bad.bsdf"
    tensors(mitsuba, path, warped([0]) | {name: value})
    with pytest.raises(TableError, match=match) as raised:
        read_rgl(path)
    assert "byte" in str(raised.value)


def test_missing_arrays_are_named(tmp_path: Path, mitsuba: Any) -> None:
    for name in ("theta_i", "vndf", "luminance", "jacobian", "description"):
        path = tmp_path / "bad.bsdf"
        tensors(mitsuba, path, {key: value for key, value in warped([0]).items() if key != name})
        with pytest.raises(TableError, match=f"has no array '{name}'; it has "):
            read_rgl(path)


@SETTINGS
@given(st.data())
def test_changed_files_give_a_reflectance_or_a_named_error(tmp_path: Path, small: bytes, data: st.DataObject) -> None:
    content = bytearray(small)
    for _ in range(data.draw(st.integers(1, 4))):
        # Half of the changes are to the table of arrays.
        at = data.draw(st.one_of(st.integers(0, 340), st.integers(0, len(content) - 1)))
        piece = data.draw(st.binary(min_size=1, max_size=8))
        content[at : at + len(piece)] = piece
    del content[data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content)))) :]
    path = tmp_path / "changed.bsdf"
    path.write_bytes(content)
    try:
        rgl = read_rgl(path)
        assert np.all(np.isfinite(rgl.values))
        rgl(rgl.theta_i_deg, 30, 90)
    except FitError as error:
        assert str(path) in str(error)  # noqa: PT017  it may as well not be raised
