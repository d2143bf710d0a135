"""Single bounce for any directions: closed forms, reciprocity, the paper's plane, and an explicit patch of triangles."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from fitting.cells import Cell, Spread
from fitting.errors import DomainError
from fitting.paper import paper_terms
from fitting.radiometric import Sampling, basis_tables, paper_terms_any, radiometric_terms
from fitting.surface import surface

CELLS = [
    Cell(),
    Cell(1.9),
    Cell(0.7, 1.3, 1.6, 0.15),
    Cell(1.2, gap=0.4, spread=Spread(height=0.3, place=0.2, seed=2, cells=3)),
    Cell(0.8, gap=0.3, spread=Spread(height=0.2, tilt=8, place=0.1, seed=4, cells=3)),
]
COARSE = Sampling(300, 4)
VIEWS = np.arange(-70, 71, 10)
thetas = st.floats(0, 80)
phis = st.floats(-360, 360)


@given(theta_i=thetas, theta_r=thetas, phi=phis)
def test_a_flat_patch_is_lambert_and_a_lobe(theta_i: float, theta_r: float, phi: float) -> None:
    i, r, p = np.radians([theta_i, theta_r, phi])
    mirror = max(0.0, math.cos(i) * math.cos(r) - math.sin(i) * math.sin(r) * math.cos(p))
    found = radiometric_terms(theta_i, theta_r, phi, cell=Cell(1e-6, gap=0.2), n_us=20, sampling=COARSE)[0]
    assert found[0] == pytest.approx(1 / math.pi, rel=2e-4)
    assert found[1] == pytest.approx(22 / (2 * math.pi) * mirror**20, rel=1e-3, abs=2e-4)
    np.testing.assert_allclose(found[2:], [1 / math.pi, 7 / (2 * math.pi) * mirror**5], rtol=1e-9, atol=1e-15)


@given(theta_i=thetas, theta_r=thetas, phi=phis, n_ss=st.floats(0.5, 60))
def test_spongy_tissue_is_flat_under_any_domes(theta_i: float, theta_r: float, phi: float, n_ss: float) -> None:
    i, r, p = np.radians([theta_i, theta_r, phi])
    mirror = max(0.0, math.cos(i) * math.cos(r) - math.sin(i) * math.sin(r) * math.cos(p))
    settings: dict[str, Any] = {"cell": Cell(1.9), "n_ss": n_ss, "sampling": Sampling(24, 1)}
    per_sr = radiometric_terms(theta_i, theta_r, phi, **settings)[0, 2:]
    np.testing.assert_allclose(per_sr, [1 / math.pi, (n_ss + 2) / (2 * math.pi) * mirror**n_ss], rtol=1e-9, atol=1e-15)
    paper = paper_terms_any(theta_i, theta_r, phi, **settings)[0, 2:]
    np.testing.assert_allclose(paper, [math.cos(i), mirror**n_ss], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("theta", [0, 20, 45])
@pytest.mark.parametrize("n", [12.0, 40.0, 200.0])
def test_a_lone_hemisphere_shines_back_as_known(theta: float, n: float) -> None:
    """With V = L, R.V = 2 (N.L)^2 - 1: a figure of revolution about L, far enough from the rim to be whole; the floor's lobe beside it."""
    cell, t = Cell(0.5, gap=4.0), math.radians(theta)
    dome, _ = quad(lambda c: 2 * math.pi * c * c * max(0.0, 2 * c * c - 1) ** n, math.cos(math.radians(44)), 1, epsabs=0, epsrel=1e-10)
    floor = (cell.cell_area - math.pi - hidden_floor(t, t)) * math.cos(t) ** 2 * max(0.0, 2 * math.cos(t) ** 2 - 1) ** n
    found = radiometric_terms(theta, theta, 0, cell=cell, n_us=n, sampling=Sampling(30000, 16))[0, 1]
    expected = (n + 2) / (2 * math.pi) * (dome + floor) / cell.cell_area / math.cos(t) ** 2
    assert found == pytest.approx(expected, rel=4e-3)


@pytest.mark.parametrize(("theta_i", "theta_r"), [(0, 0), (0, 40), (30, 30), (45, -20), (60, 70), (20, -75)])
def test_a_lone_hemisphere_is_diffuse_as_known(theta_i: float, theta_r: float) -> None:
    """Int N.L N.V over the part lit and seen: on a whole sphere the phase function of Lambert; here by slices along y.

    On slice y = sin(eta) both cosines are cos(eta) times cos(psi - theta); Int cos^3(eta) d eta is 4 / 3. The floor adds what is neither
    in the dome's shadow nor hidden by it.
    """
    i, r = math.radians(theta_i), math.radians(theta_r)
    first, last = max(i, r) - math.pi / 2, min(i, r) + math.pi / 2
    first, last = max(first, -math.pi / 2), min(last, math.pi / 2)
    along, _ = quad(lambda psi: math.cos(psi - i) * math.cos(psi - r), first, last)
    cell = Cell(0.5, gap=4.0)  # no ray below 80 deg meets a neighbour
    among = paper_terms_any(theta_i, theta_r, 0, cell=cell)[0, 0] * cell.cell_area
    lit, _ = quad(lambda psi: math.cos(psi - i), first, last)
    assert among == pytest.approx(math.pi / 2 * lit, rel=4e-3)
    found = radiometric_terms(theta_i, theta_r, 0, cell=cell, sampling=Sampling(24000, 32))[0, 0] * math.pi * cell.cell_area
    dome = 4 / 3 * along / (math.cos(i) * math.cos(r))
    floor = cell.cell_area - math.pi - hidden_floor(i, r)
    assert found == pytest.approx(dome + floor, abs=0.02 * dome + 0.02)


def hidden_floor(i: float, r: float) -> float:
    """Area of the floor in the shadow of a hemisphere, of light or of view: half ellipses drawn out by 1 / cos, beside the base."""

    def shadow(t: float) -> float:
        return math.pi / 2 * (1 / math.cos(t) - 1)  # half of an ellipse with half-axes 1 and 1 / cos, less half of the disc

    return max(shadow(i), shadow(r)) if i * r >= 0 else shadow(i) + shadow(r)


@pytest.mark.parametrize("cell", CELLS, ids=str)
def test_light_and_view_may_be_swapped(cell: Cell) -> None:
    rng = np.random.default_rng(3)
    theta_i, theta_r, phi = rng.uniform(0, 85, 12), rng.uniform(0, 85, 12), rng.uniform(-180, 180, 12)
    there = radiometric_terms(theta_i, theta_r, phi, cell=cell, sampling=COARSE)
    back = radiometric_terms(theta_r, theta_i, phi, cell=cell, sampling=COARSE)
    np.testing.assert_allclose(there, back, rtol=1e-12, atol=1e-300)
    mirrored = radiometric_terms(theta_i, theta_r, -phi, cell=cell, sampling=COARSE)
    np.testing.assert_array_equal(there, mirrored)


@pytest.mark.parametrize(("cell", "theta_i"), [(c, t) for c in CELLS[:3] for t in (0, 45, 75)] + [(CELLS[3], 60)], ids=str)
def test_single_bounce_sends_at_most_what_comes(cell: Cell, theta_i: float) -> None:
    """Directional-hemispherical albedo: at most 1, and for Lambert facets what each point of the lit surface sees of the sky."""
    u, w = np.polynomial.legendre.leggauss(16)  # even in cos^2: the weight of the projected hemisphere
    theta_r = np.degrees(np.arccos(np.sqrt((u + 1) / 2)))
    phi = (np.arange(18) + 0.5) * 10
    bases = basis_tables(cell, [theta_i], theta_r, phi, n_us=10, sampling=Sampling(1000, 16))
    albedo = {name: float(np.pi * np.mean(table[0], axis=1) @ (w / 2)) for name, table in bases.items()}
    assert 0 < albedo["u_spec"] < 1
    assert 0 < albedo["u_diff"] <= 1 + 1e-3
    assert albedo["s_diff"] == pytest.approx(1, rel=1e-12)
    assert 0 < albedo["s_spec"] <= 1 + 1e-3
    patch = surface(cell, 18, 24, 72)
    psi, tangent = np.radians(np.arange(72) * 5), np.tan(np.radians(theta_i))
    elevation = (np.arange(180) + 0.5) / 2
    cos, sin = np.cos(np.radians(elevation)), np.sin(np.radians(elevation))
    sky = np.zeros(len(patch.points))
    for a in range(72):
        facing = patch.normals[:, :2] @ [np.cos(psi[a]), np.sin(psi[a])]
        seen = np.tan(np.radians(elevation)) > patch.horizon[:, a, None]
        sky += np.sum(np.clip(facing[:, None] * cos + patch.normals[:, 2, None] * sin, 0, None) * seen * cos, axis=1)
    sky *= np.radians(0.5) * np.radians(5) / np.pi
    light = np.column_stack([np.cos(psi), np.sin(psi)]) * np.sin(np.radians(theta_i))
    cos_l = np.clip(patch.normals[:, :2] @ light.T + patch.normals[:, 2, None] * np.cos(np.radians(theta_i)), 0, None)
    lit = cos_l * (patch.horizon * tangent < 1)
    caught = patch.areas @ lit.mean(axis=1)
    assert caught == pytest.approx(np.cos(np.radians(theta_i)), rel=0.01)  # all that comes, and no more, meets the surface
    assert albedo["u_diff"] == pytest.approx(float((patch.areas * sky) @ lit.mean(axis=1) / caught), rel=0.015)


@pytest.mark.parametrize(("aspect", "tolerance"), [(0.5, 3e-3), (1.9, 4e-3)])
def test_in_the_plane_it_is_the_papers_model(aspect: float, tolerance: float) -> None:
    exact = paper_terms(45, VIEWS, aspect=aspect)
    found = paper_terms_any(45, VIEWS, 0, cell=Cell(aspect))
    assert np.max(np.abs(found - exact) / exact.max(axis=0)) < tolerance
    np.testing.assert_allclose(found[:, 2:], exact[:, 2:], rtol=1e-9, atol=1e-15)
    across = paper_terms_any(45, np.abs(VIEWS), np.where(VIEWS < 0, 180.0, 0.0), cell=Cell(aspect))
    np.testing.assert_array_equal(across, found)


@pytest.mark.parametrize("cell", CELLS[:3], ids=str)
def test_more_facets_converge(cell: Cell) -> None:
    directions = ([30, 45, 60, 70], [20, 65, 50, 75], [70, 150, 20, 110])
    fine = radiometric_terms(*directions, cell=cell, sampling=Sampling(12000, 16))
    usual = radiometric_terms(*directions, cell=cell)
    np.testing.assert_allclose(usual, fine, rtol=0.02, atol=2e-3 * fine.max())


def triangulated(cell: Cell, around: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of one upright dome, its rings of even steps of the superellipse's angle."""
    tau, turn = np.meshgrid(np.linspace(0, np.pi / 2, up + 1), np.linspace(0, 2 * np.pi, around, endpoint=False), indexing="ij")
    r, z = np.sin(tau) ** (2 / cell.p), cell.stretch * np.cos(tau) ** (2 / cell.q)
    vertices = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1).reshape(-1, 3)
    ring, step = (n.ravel() for n in np.meshgrid(np.arange(up), np.arange(around), indexing="ij"))
    a, b = ring * around + step, ring * around + (step + 1) % around
    quads = np.column_stack([a, a + around, b + around, a, b + around, b]).reshape(-1, 3)
    sides = vertices[quads]
    return vertices, quads[np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1) > 1e-12]


@pytest.mark.slow
@pytest.mark.parametrize("cell", [Cell(1.9), CELLS[2], CELLS[4]], ids=str)
def test_against_an_explicit_patch_of_triangles(cell: Cell) -> None:
    """Every triangle of one period lit and seen by rays, in the lattice's own frame, over many azimuths (all round where domes differ)."""
    o3d = pytest.importorskip("open3d", reason="Open3D needs libusb-1.0-0 on Debian", exc_type=ImportError)
    domes = cell.domes()
    cells = math.isqrt(len(domes))
    vertices, triangles = triangulated(cell, 48, 48)
    scene = o3d.t.geometry.RaycastingScene()
    reach = math.ceil((domes[:, 2].max() * math.tan(math.radians(60)) + 2) / cell.pitch / 0.86) + 1
    inner = []
    for i in range(-reach, cells + reach):
        for j in range(-reach, cells + reach):
            dx, dy, h, tx, ty = domes[(i % cells) * cells + j % cells]
            z = vertices[:, 2] * h / cell.stretch
            corners = vertices * [1, 1, h / cell.stretch] + np.column_stack([z * tx, z * ty, 0 * z])
            corners += [cell.pitch * (i + j / 2) + dx, cell.pitch * math.sqrt(3) / 2 * j + dy, 0]
            scene.add_triangles(corners.astype(np.float32), triangles.astype(np.uint32))
            if 0 <= i < cells and 0 <= j < cells:
                inner.append(corners[triangles])
    corners = np.concatenate(inner)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    normals = cross / (2 * area[:, None])
    starts = corners.mean(axis=1) + 1e-4 * normals
    u = np.stack(np.meshgrid(*2 * [(np.arange(60 * cells) + 0.5) / 60], indexing="ij"), axis=-1).reshape(-1, 2)
    floor = np.column_stack([cell.pitch * (u[:, 0] + u[:, 1] / 2), cell.pitch * math.sqrt(3) / 2 * u[:, 1], 0 * u[:, 0]])
    free = np.ones(len(floor), bool)
    for i in range(-1, cells + 1):
        for j in range(-1, cells + 1):
            centre = [cell.pitch * (i + j / 2), cell.pitch * math.sqrt(3) / 2 * j] + domes[(i % cells) * cells + j % cells, :2]
            free &= np.hypot(*(floor[:, :2] - centre).T) > 1
    floor = floor[free] + [0, 0, 1e-5]
    patch = cell.cell_area * len(domes)
    starts, normals = np.concatenate([starts, floor]), np.concatenate([normals, np.tile([0.0, 0, 1], (len(floor), 1))])
    area = np.concatenate([area, np.full(len(floor), (patch - math.pi * len(domes)) / len(floor))])

    def open_to(towards: np.ndarray) -> np.ndarray:
        rays = np.column_stack([starts, np.broadcast_to(towards, starts.shape)]).astype(np.float32)
        return (normals @ towards > 0) & ~scene.test_occlusions(rays).numpy()

    def unit(theta: float, azimuth: float) -> np.ndarray:
        t = math.radians(theta)
        return np.array([math.sin(t) * math.cos(azimuth), math.sin(t) * math.sin(azimuth), math.cos(t)])

    n, directions = 20.0, [(45, 55, 35), (60, 30, 140)]
    turns = 18 if cells > 1 else 12
    period = 2 * np.pi if cells > 1 else np.pi / 3
    for theta_i, theta_r, phi in directions:
        sums = np.zeros(2)
        for azimuth in (np.arange(turns) + 0.5) * period / turns:
            for way in (1, -1):  # the package averages over phi and -phi, which differ where domes do
                light, view = unit(theta_i, azimuth), unit(theta_r, azimuth + way * math.radians(phi))
                cos_l, cos_v = normals @ light, normals @ view
                lobe = np.maximum(0, 2 * cos_l * cos_v - light @ view) ** n
                weight = area * (open_to(light) & open_to(view)) * cos_l * cos_v / (light[2] * view[2]) / patch / (2 * turns)
                sums += [weight.sum() / np.pi, weight @ lobe * (n + 2) / (2 * np.pi)]
        found = radiometric_terms(theta_i, theta_r, phi, cell=cell, n_us=n, sampling=Sampling(4000, 16))[0, :2]
        np.testing.assert_allclose(found, sums, rtol=0.015)


def test_tables_hold_what_the_terms_give() -> None:
    nodes = ([0, 40, 80], [10, 60], [0, 90, 180])
    for mode in ("radiometric", "paper"):
        tables = basis_tables(Cell(), *nodes, mode, sampling=COARSE)
        assert tuple(tables) == ("u_diff", "u_spec", "s_diff", "s_spec")
        evaluate = radiometric_terms if mode == "radiometric" else paper_terms_any
        one = evaluate(40, 60, 90, cell=Cell(), sampling=COARSE)[0]
        np.testing.assert_allclose([table[1, 1, 1] for table in tables.values()], one, rtol=1e-12)
        assert all(table.shape == (3, 2, 3) for table in tables.values())


def test_sums_do_not_depend_on_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    directions = np.meshgrid([0.0, 50, 80], [10.0, 70], [0.0, 35, 77.7, 180], indexing="ij")
    found = []
    for cores in (1, 3):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found.append(radiometric_terms(*directions, cell=CELLS[2], sampling=COARSE))
    np.testing.assert_array_equal(found[0], found[1])


def test_readings_are_independent_of_their_company() -> None:
    rng = np.random.default_rng(5)
    theta_i, theta_r, phi = rng.choice([10.0, 45, 70], 20), rng.choice([5.0, 30, 60], 20), rng.choice([0.0, 30, 180], 20)
    together = radiometric_terms(theta_i, theta_r, phi, sampling=COARSE)
    alone = np.concatenate([radiometric_terms(*one, sampling=COARSE) for one in zip(theta_i, theta_r, phi, strict=True)])
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    assert radiometric_terms([], [], []).shape == (0, 4)


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        ((90, 0, 0), {}, "0 <= theta_i < 90"),
        ((-1, 0, 0), {}, "theta_i = -1"),
        ((10, 90, 0), {}, "behind the petal"),
        ((10, 10, math.nan), {}, "phi = nan"),
        (([1, 2], [1, 2, 3], 0), {}, "matching shapes"),
        ((10, 10, 0), {"n_us": 0}, "n_us"),
    ],
)
def test_outside_the_model(arguments: tuple[Any, Any, Any], settings: dict[str, Any], message: str) -> None:
    for evaluate in (radiometric_terms, paper_terms_any):
        with pytest.raises(DomainError, match=message):
            evaluate(*arguments, **settings)


def test_other_settings_outside_the_model() -> None:
    with pytest.raises(DomainError, match="turns"):
        Sampling(100, 65)
    with pytest.raises(DomainError, match="mode"):
        basis_tables(Cell(), [0], [0], [0], "photo")
    with pytest.raises(DomainError, match="n_ss"):
        paper_terms_any(0, 0, 0, n_ss=-1)
