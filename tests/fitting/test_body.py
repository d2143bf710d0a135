"""Body light and transmission: closed forms of a flat face, balances of any face, and photons shot at petals one by one."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import qmc

from fitting import tracing
from fitting.body import EDGES, STREAMS, THETA, BodyTrace, Epidermis, Face, Paths, gauss, hat_weights, trace_body, trace_face
from fitting.cells import Cell, Spread
from fitting.errors import DomainError
from tests.fitting.photons import PARTS, Mesophyll, Side, fresnel, shoot

N = 1.4
ROSE = Epidermis(Cell(1.9))
DOME = Epidermis(Cell(0.5))
LENS = Epidermis(Cell(0.3, p=2.0, q=1.0, gap=0.2), depth=0.5)
PAPILLA = Epidermis(Cell(1.0, p=1.5, q=1.2, gap=0.1), depth=0.0)
ANGLES = np.array([0.0, 20.0, 45.0, 60.0, 80.0, 87.0])


@pytest.fixture(scope="module")
def flat() -> BodyTrace:
    return trace_body(Epidermis(None, depth=0.7), n=N, rays=1024)


@pytest.fixture(scope="module", params=[DOME, ROSE, LENS, PAPILLA], ids=["dome", "rose", "lens", "papilla"])
def petal(request: pytest.FixtureRequest) -> BodyTrace:
    return trace_body(request.param, replace(LENS, depth=1.2), n=N, rays=512, seed=3)


@pytest.fixture(scope="module")
def garden() -> BodyTrace:
    """Hemispheres above, rose cells with gaps below."""
    return trace_body(Epidermis(Cell(0.5)), Epidermis(Cell(1.9, gap=0.15), depth=0.8), n=N, rays=1024)


def internal(mu_depth: float) -> float:
    """Of Lambert light below a flat surface, what comes back down."""
    edge = math.sqrt(1 - 1 / N**2)
    return 2 * sum(quad(lambda c: fresnel(c, 1 / N) * math.exp(-2 * mu_depth / c) * c, a, b)[0] for a, b in ((1e-9, edge), (edge, 1)))


def outward(theta: np.ndarray) -> np.ndarray:
    return np.array([1 - fresnel(math.cos(t), N) for t in np.radians(theta)])


def test_flat_surface_is_fresnel_and_saunderson(flat: BodyTrace) -> None:
    np.testing.assert_allclose(np.interp(ANGLES, THETA, flat.upper.down(0.0).sum(1)), outward(ANGLES), atol=1e-3)
    np.testing.assert_allclose(flat.budget(ANGLES, mu=0.0, R_m=0.5, T_m=0.0)["floor"], 1 - outward(ANGLES), atol=1e-3)
    # What Saunderson calls k2, by its own integral and by 1 - (1 - k1) / n^2.
    assert flat.upper.back(0.0).sum() / STREAMS == pytest.approx(internal(0.0), abs=2e-4)
    k1 = quad(lambda u: fresnel(math.sqrt(1 - u), N), 0, 1)[0]
    assert internal(0.0) == pytest.approx(1 - (1 - k1) / N**2, abs=1e-6)


@pytest.mark.parametrize("r_m", [0.05, 0.5, 0.95])
def test_lambert_base_under_a_flat_surface(flat: BodyTrace, r_m: float) -> None:
    """Saunderson 1942, doi:10.1364/JOSA.32.000727, by direction."""
    theta_i, theta_r = np.meshgrid(ANGLES, ANGLES)
    found = flat.body_reflectance(theta_i, theta_r, mu=0.0, R_m=r_m, T_m=0.0)
    expected = np.outer(outward(ANGLES), outward(ANGLES)) * r_m / (math.pi * N**2 * (1 - r_m * internal(0.0)))
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("mu", [0.05, 1.0, 8.0])
def test_flat_pigment_is_beer_lambert(flat: BodyTrace, mu: float) -> None:
    slant = np.sqrt(1 - (np.sin(np.radians(ANGLES)) / N) ** 2)
    found = np.interp(ANGLES, THETA, flat.upper.down(mu).sum(1))
    np.testing.assert_allclose(found, outward(ANGLES) * np.exp(-mu * 0.7 / slant), rtol=2e-3, atol=1e-3)
    assert flat.upper.back(mu).sum() / STREAMS == pytest.approx(internal(mu * 0.7), abs=2e-4)


def test_clear_flat_petal_is_a_slab(flat: BodyTrace) -> None:
    """No scattering at all: two faces with all reflections between them pass (1 - F) / (1 + F)."""
    theta = np.arange(0.0, 66.0, 5.0)
    f = 1 - outward(theta)
    budget = flat.budget(theta, mu=0.0, R_m=0.0, T_m=0.0, D_m=1.0)
    np.testing.assert_allclose(budget["direct"], (1 - f) / (1 + f), atol=0.02)  # F varies over a stream
    np.testing.assert_allclose(budget["body"], f * (1 - f) / (1 + f), atol=0.02)
    behind = np.linspace(91, 180, 400)
    for theta_i in (30.0, 60.0):
        lobe = flat.transmittance(theta_i, -behind, mu=0.0, R_m=0.0, T_m=0.0, D_m=1.0)
        lit = 180 - behind[lobe > lobe.max() / 2]
        assert lit.min() - 2 <= theta_i <= lit.max() + 2
        assert lit.max() - lit.min() < 20
        assert np.all(flat.transmittance(theta_i, -behind, direct=False, mu=0.0, R_m=0.0, T_m=0.0, D_m=1.0) == 0)


share = st.floats(0, 1)


@settings(max_examples=40)
@given(mu=st.floats(0, 20), mu_below=st.floats(0, 20), r=share, r_below=share, t=share, d=share, theta=st.floats(0, 89.9))
def test_light_is_all_accounted_for(
    petal: BodyTrace, mu: float, mu_below: float, r: float, r_below: float, t: float, d: float, theta: float
) -> None:
    total = max(1.0, max(r, r_below) + t + d)
    budget = petal.budget(
        theta, mu=mu, mu_below=mu_below, R_m=r / total, R_m_below=r_below / total, T_m=t / total, D_m=d / total
    )  # fmt: skip
    assert sum(budget.values()) == pytest.approx(1, abs=1e-11)
    for part, value in budget.items():
        assert -1e-11 <= value <= 1, part


@pytest.mark.parametrize(("r", "t", "d"), [(1.0, 0.0, 0.0), (0.6, 0.4, 0.0), (0.3, 0.3, 0.4), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_white_furnace(petal: BodyTrace, r: float, t: float, d: float) -> None:
    budget = petal.budget(ANGLES, mu=0.0, R_m=r, T_m=t, D_m=d)
    out = petal.albedo(ANGLES, mu=0.0, R_m=r, T_m=t, D_m=d) + budget["scattered"] + budget["direct"]
    np.testing.assert_allclose(out, 1, rtol=0, atol=1e-12)
    if t == d == 0:
        np.testing.assert_allclose(petal.albedo(ANGLES, mu=0.0, R_m=r, T_m=t), 1, rtol=0, atol=1e-12)


def hemisphere(nodes: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Angles and weights: sum of f weights = integral of f cos over the hemisphere, f alike at all phi."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return np.degrees(np.arcsin(np.sqrt((x + 1) / 2))), w * math.pi / 2


def test_reflectance_and_transmittance_integrate_to_the_budget(petal: BodyTrace) -> None:
    theta_r, weights = hemisphere()
    phi = (np.arange(36) + 0.5) * 10
    for theta_i in (0.0, 45.0, 70.0):
        budget = petal.budget(theta_i, mu=0.2, R_m=0.5, T_m=0.2, D_m=0.2)
        body = petal.body_reflectance(theta_i, theta_r, mu=0.2, R_m=0.5, T_m=0.2, D_m=0.2)
        assert body @ weights == pytest.approx(budget["body"], rel=2e-3)
        stray = petal.stray_reflectance(theta_i, theta_r[:, None], phi, mu=0.2).mean(1)
        assert stray @ weights == pytest.approx(budget["stray"], rel=0.2, abs=4e-4)  # linear between nodes 10 deg apart
        through = petal.transmittance(theta_i, theta_r - 180, mu=0.2, R_m=0.5, T_m=0.2, D_m=0.2)
        assert through @ weights == pytest.approx(budget["scattered"] + budget["direct"], rel=2e-3)
        if theta_i or petal.upper.epidermis.cell.q > 1:  # else all normals that mirror lie within a narrow cone
            mirrored = petal.mirror_reflectance(theta_i, theta_r[:, None], phi, turns=24).mean(1)
            assert mirrored @ weights == pytest.approx(budget["mirror"], rel=0.1, abs=3e-4)
        whole = petal.reflectance(theta_i, theta_r[:, None], phi, turns=24, mu=0.2, R_m=0.5, T_m=0.2, D_m=0.2).mean(1)
        expected = petal.albedo(theta_i, mu=0.2, R_m=0.5, T_m=0.2, D_m=0.2) - budget["floor"]
        assert whole @ weights == pytest.approx(expected, abs=4e-3)


@given(i=st.floats(0, 89), r=st.floats(0, 89), phi=st.floats(0, 180), mu=st.floats(0, 3))
@settings(max_examples=25)
def test_light_and_view_may_be_swapped(petal: BodyTrace, i: float, r: float, phi: float, mu: float) -> None:
    tissue = {"mu": mu, "R_m": 0.4, "T_m": 0.3, "D_m": 0.2}
    there, back = petal.body_reflectance(i, r, **tissue), petal.body_reflectance(r, i, **tissue)
    assert there == pytest.approx(float(back), rel=1e-9, abs=0)
    there, back = petal.stray_reflectance(i, r, phi, mu=mu), petal.stray_reflectance(r, i, phi, mu=mu)
    assert there == pytest.approx(float(back), rel=1e-9, abs=0)
    assert there == pytest.approx(float(petal.stray_reflectance(i, -r, 180 - phi, mu=mu)), rel=1e-9, abs=0)


def test_mirror_light_is_reciprocal(petal: BodyTrace) -> None:
    i, r, phi = np.random.default_rng(8).uniform([[0], [0], [0]], [[89], [89], [180]], (3, 500))
    there, back = petal.mirror_reflectance(i, r, phi), petal.mirror_reflectance(r, i, phi)
    assert np.count_nonzero(there) > 100
    np.testing.assert_allclose(there, back, rtol=1e-9)


@given(i=st.floats(0, 89), r=st.floats(0, 89), mu=st.floats(0, 3), mu_below=st.floats(0, 3))
@settings(max_examples=25)
def test_transmission_is_the_same_from_either_side(petal: BodyTrace, i: float, r: float, mu: float, mu_below: float) -> None:
    there = petal.transmittance(i, r - 180, mu=mu, mu_below=mu_below, R_m=0.4, R_m_below=0.2, T_m=0.3, D_m=0.2)
    back = petal.turned_over().transmittance(r, i - 180, mu=mu_below, mu_below=mu, R_m=0.2, R_m_below=0.4, T_m=0.3, D_m=0.2)
    assert there == pytest.approx(float(back), rel=1e-9, abs=0)


def test_stray_light_carries_its_energy(petal: BodyTrace) -> None:
    """At the nodes of its directions: the whole of it, at any pigment."""
    for mu in (0.0, 0.7, 6.0):
        energy = hat_weights() @ petal.upper.astray(mu)
        nodes = np.linspace(0, 90, 10)
        below = np.minimum(nodes, 90 - 1e-9)
        f = petal.stray_reflectance(below[:, None, None], below[:, None], np.arange(0, 181, 30), mu=mu)
        around = np.array([0.5, 1, 1, 1, 1, 1, 0.5]) / 6
        weights = hat_weights(tuple(nodes))
        assert np.einsum("irp,i,r,p->", f, weights, weights, around) * math.pi == pytest.approx(energy, rel=1e-6)


def test_stray_light_has_no_azimuth_along_the_normal(petal: BodyTrace) -> None:
    for i, r in ((0.0, 40.0), (40.0, 0.0)):
        assert np.ptp(petal.stray_reflectance(i, r, np.arange(0, 181, 15), mu=0.3)) < 1e-15


def test_stray_light_goes_forward(petal: BodyTrace) -> None:
    """Two mirrors turn a flat ray little: most stray light of slanting incidence leaves on the far side."""
    forward, back = (petal.stray_reflectance(80.0, 80.0, phi, mu=0.0) for phi in (180.0, 0.0))
    assert forward > 2 * back


def test_faces_differ(petal: BodyTrace) -> None:
    lit, other = (x.albedo(45.0, mu=0.5, R_m=0.5, T_m=0.3) for x in (petal, petal.turned_over()))
    assert abs(lit - other) > 1e-3


def volume(face: Epidermis) -> float:
    """Of pigmented cell over an area of petal, a."""
    cell = face.cell or Cell()
    dome = 2 * math.pi * quad(lambda r: r * float(cell.profile(r)), 0, 1)[0]
    return face.depth + dome / cell.cell_area


def mean_path(paths: Paths) -> np.ndarray:
    return (paths.weights * paths.lengths).sum(-1)


def test_paths_fill_the_volume(petal: BodyTrace) -> None:
    """In a lossless cell lit evenly from all sides the radiance is n^2 everywhere, so paths add up to 4 n^2 V, whatever its shape."""
    face = petal.upper
    w = hat_weights()
    # In and, reciprocally, out; stray light; and what comes back to the mesophyll.
    total = 2 * w @ mean_path(face.down).sum(1) + w @ mean_path(face.astray) + N**2 * mean_path(face.back).sum() / STREAMS
    assert total == pytest.approx(4 * N**2 * volume(face.epidermis), rel=1e-2)


@pytest.mark.parametrize("face", [ROSE, PAPILLA, LENS])
def test_straight_paths(face: Epidermis) -> None:
    """With an index of all but 1 nothing bends: the mean path is volume over cosine, many domes included."""
    angles = np.radians([0.0, 30.0, 60.0, 80.0])
    rays = 4096
    points = qmc.Sobol(4, seed=1).random(rays)
    layer = tracing.Layer(tracing.Domes.of(face.cell), face.depth, 1 + 1e-6, np.array(EDGES))
    tally = tracing.Tally.empty(4, 4, len(EDGES))
    for k, angle in enumerate(angles):
        tracing.trace_down(np.full(rays, angle), points, np.zeros(4), 0, layer, tally.row(k))
    assert tally.escaped[..., 0].sum() + tally.shares.sum() < 1e-4 * rays
    paths = gauss(tally.reached / rays)
    np.testing.assert_allclose(paths(0.0).sum(1), 1, atol=1e-4)
    np.testing.assert_allclose(mean_path(paths).sum(1), volume(face) / np.cos(angles), rtol=4e-3)


def test_lone_dome_mirrors_as_a_sphere() -> None:
    """Far apart, a hemisphere sends F / 4 per solid angle and cross-section into every direction that its normals reach."""
    petal = trace_body(Epidermis(Cell(0.5, gap=30.0)), n=N, rays=64)
    area = (2 * 31) ** 2 * math.sqrt(3) / 2
    for theta_i, theta_r, phi in ((0, 0, 0), (40, 40, 180), (40, 40, 0), (10, 60, 120)):
        i, r = np.radians(theta_i), np.radians(theta_r)
        cosine = math.cos(i) * math.cos(r) + math.sin(i) * math.sin(r) * math.cos(math.radians(phi))
        expected = fresnel(math.sqrt((1 + cosine) / 2), N) / (4 * area * math.cos(i) * math.cos(r))
        assert petal.mirror_reflectance(theta_i, theta_r, phi) == pytest.approx(expected, rel=1e-9, abs=0)


@pytest.mark.slow
@pytest.mark.parametrize("theta", [20.0, 65.0])
@pytest.mark.parametrize("over", [False, True], ids=["above", "below"])
@pytest.mark.parametrize(
    "tissue",
    [
        {"mu": 0.0, "mu_below": 0.0, "R_m": 0.5, "R_m_below": 0.5, "T_m": 0.5, "D_m": 0.0},
        {"mu": 0.05, "mu_below": 0.3, "R_m": 0.6, "R_m_below": 0.4, "T_m": 0.4, "D_m": 0.0},
        {"mu": 0.6, "mu_below": 0.2, "R_m": 0.4, "R_m_below": 0.3, "T_m": 0.3, "D_m": 0.2},
    ],
    ids=["clear", "pale", "dark"],
)
def test_pigment_chosen_afterwards_is_pigment_traced(garden: BodyTrace, theta: float, over: bool, tissue: dict[str, float]) -> None:
    """One trace for all, against photons that are absorbed on their way: where each ends, and under which angle it leaves."""
    count = 150_000
    sides = [Side(1.0, 2.0, 1.0, tissue["mu"]), Side(3.8, 2.3, 0.8, tissue["mu_below"])]
    reflected = [tissue["R_m"], tissue["R_m_below"]]
    petal = garden.turned_over() if over else garden
    if over:
        sides.reverse()
        reflected.reverse()
        tissue = tissue | {"mu": sides[0].mu, "mu_below": sides[1].mu, "R_m": reflected[0], "R_m_below": reflected[1]}
    ends, cosines = shoot(theta, count, *sides, N, Mesophyll(*reflected, tissue["T_m"], tissue["D_m"]), 4)
    assert np.all(ends >= 0)
    budget = petal.budget(theta, **tissue)
    for number, part in enumerate(PARTS):
        share = float(budget[part])
        # Four standard deviations, and what 1024 rays a node leave in error.
        assert np.mean(ends == number) == pytest.approx(share, abs=4 * math.sqrt(max(share, 1 / count) / count) + 0.004 * share + 1e-4), (
            part
        )
    edges = np.linspace(0, 1, 6)
    u, w = np.polynomial.legendre.leggauss(12)
    for part, seen in (
        ("body", lambda view: petal.body_reflectance(theta, view, **tissue)),
        ("scattered", lambda view: petal.transmittance(theta, view - 180, direct=False, **tissue)),
    ):
        counted = np.histogram(cosines[ends == PARTS.index(part)], edges)[0] / count
        for low, high, found in zip(edges, edges[1:], counted, strict=False):
            cos = low + (high - low) * (u + 1) / 2
            expected = math.pi * (high - low) * float((seen(np.degrees(np.arccos(cos))) * cos) @ w)
            assert found == pytest.approx(expected, abs=4 * math.sqrt(expected / count) + 0.015 * expected + 1e-4)


def test_threads_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    views = np.linspace(0, 80, 2000)
    found = []
    for cores in (1, 5):
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        petal = trace_body(DOME, n=N, rays=64)
        found.append([*petal.arrays().values(), petal.mirror_reflectance(30.0, views)])
    for one, five in zip(*found, strict=True):
        np.testing.assert_array_equal(one, five)


@settings(max_examples=150)
@given(
    h=st.floats(0.2, 5),
    p=st.floats(1, 4),
    q=st.floats(1, 4),
    start=st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0, 1)),
    towards=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)),
)
def test_way_to_a_wall_against_small_steps(
    h: float, p: float, q: float, start: tuple[float, float, float], towards: tuple[float, float, float]
) -> None:
    domes = tracing.Domes(h, p, q, 2.0)
    x, d = np.array(start) * [1, 1, h], np.array(towards)
    length = np.linalg.norm(d)
    if length < 0.1:
        return
    d = d / length
    d[2] = 0.0 if abs(d[2]) < 1e-9 else d[2]  # so flat that the way down overflows
    steps = np.linspace(0, 12, 24001)
    at = x + steps[:, None] * d
    end = -x[2] / d[2] if d[2] < 0 else 12.0
    inside = (at[:, 2] >= 0) & (steps <= end) & ((np.maximum(at[:, 2], 0) / h) ** q + np.hypot(at[:, 0], at[:, 1]) ** p < 1 - 1e-6)
    if inside[0]:
        t, base = tracing.leave(*x, *d, domes)
        assert t == pytest.approx(steps[inside.nonzero()[0][-1]], abs=0.02)
        if base:
            assert x[2] + t * d[2] == pytest.approx(0, abs=1e-9)
        else:
            assert tracing.wall(*(x + t * d), *d, domes)[0] == pytest.approx(0, abs=1e-9)
        return
    if tracing.wall(*x, *d, domes)[0] <= 0:
        return
    t = tracing.enter(*x, *d, domes, min(end, 12.0))
    if inside.any():
        assert 0 <= t <= steps[inside.nonzero()[0][0]] + 1e-9
    if t >= 0:
        assert tracing.wall(*(x + t * d), *d, domes)[0] == pytest.approx(0, abs=1e-6)


@given(seed=st.integers(0, 2**32), mu=st.floats(0, 20))
def test_two_nodes_a_bin_keep_absorption_within_their_bound(seed: int, mu: float) -> None:
    rng = np.random.default_rng(seed)
    length = rng.uniform(0.02, 4) * rng.lognormal(0, rng.uniform(0.01, 1), 300).clip(0.1, 10)
    weight = rng.random(300)
    edges = np.array(EDGES)
    row = np.zeros((len(edges), 4))
    for w, x in zip(weight, length, strict=True):
        tracing.deposit(row, w, x, edges)
    paths = gauss(row)
    bound = 3e-5 + (mu * EDGES[1]) ** 4 / 1536 * weight[length < EDGES[1]].sum() / weight.sum()
    assert abs(paths(mu) - weight @ np.exp(-mu * length)) <= bound * weight.sum()
    assert (paths.weights * paths.lengths).sum() == pytest.approx(weight @ length, rel=1e-9)


@pytest.mark.slow
def test_more_rays_come_closer() -> None:
    """What goes up and what comes down are traced apart; they agree better and better before they are made to."""
    departures = [trace_face(DOME, N, rays, 0).closure for rays in (128, 1024, 8192)]
    assert departures[0] < 0.1
    assert departures[1] < departures[0] / 2
    assert departures[2] < departures[1] / 2


def test_same_seed_same_trace_and_back_from_a_file(tmp_path: Path) -> None:
    def equal(a: Face, b: Face) -> bool:
        return all(np.array_equal(getattr(a, part).lengths, getattr(b, part).lengths) for part in ("down", "back", "astray"))

    petal, again, other = (trace_body(DOME, LENS, n=N, rays=256, seed=seed) for seed in (3, 3, 4))
    assert equal(again.upper, petal.upper)
    assert not equal(other.upper, petal.upper)
    np.savez(tmp_path / "petal.npz", **petal.arrays())
    with np.load(tmp_path / "petal.npz") as file:
        arrays = dict(file)
    back = BodyTrace.from_arrays(arrays, petal.provenance)
    assert (back.upper.epidermis, back.lower.epidermis) == (DOME, LENS)
    view = np.linspace(-80, 80, 17)
    tissue = {"mu": 0.4, "R_m": 0.5, "T_m": 0.3}
    np.testing.assert_array_equal(back.reflectance(45.0, view, **tissue), petal.reflectance(45.0, view, **tissue))
    del arrays["lower.back.weights"]
    with pytest.raises(DomainError, match=r"lower\.back\.weights .* found nothing"):
        BodyTrace.from_arrays(arrays)


def test_what_the_model_does_not_describe_is_refused(flat: BodyTrace) -> None:
    for depth in (-1.0, math.inf, math.nan):
        with pytest.raises(DomainError, match="depth"):
            Epidermis(Cell(), depth)
    with pytest.raises(DomainError, match="all alike"):
        Epidermis(Cell(gap=0.2, spread=Spread(place=0.1)))
    for wrong in ({"n": 1.0}, {"rays": 1000}, {"rays": 32}):
        with pytest.raises(DomainError, match=r"refractive index|power of 2"):
            trace_body(DOME, **wrong)
    for wrong in ({"mu": -1.0}, {"R_m": 0.7}, {"R_m_below": 0.7}, {"D_m": math.nan}):
        with pytest.raises(DomainError, match=next(iter(wrong))):
            flat.albedo(30.0, **({"mu": 0.0, "R_m": 0.5, "T_m": 0.4} | wrong))
    with pytest.raises(TypeError, match="Rm"):
        flat.albedo(30.0, mu=0.0, R_m=0.5, T_m=0.4, Rm=0.2)
    with pytest.raises(DomainError, match="theta_r must lie less than 90"):
        flat.reflectance(30.0, 95.0, mu=0.0, R_m=0.5, T_m=0.4)
    with pytest.raises(DomainError, match="above 90"):
        flat.transmittance(30.0, 60.0, mu=0.0, R_m=0.5, T_m=0.4)
    flat_top = BodyTrace(replace(flat.upper, epidermis=Epidermis(Cell(p=3.0, q=3.0))), flat.lower)
    with pytest.raises(DomainError, match="flat at the top"):
        flat_top.mirror_reflectance(30.0, -30.0)
    cone = BodyTrace(replace(flat.upper, epidermis=Epidermis(Cell(p=1.0, q=1.0))), flat.lower)
    with pytest.raises(DomainError, match="cones"):
        cone.mirror_reflectance(30.0, -30.0)
