"""The exact edge of a shadow, against rays shot at a patch of hemispheres one by one."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fitting.slices import dome_terms, reach

MARGIN = 1e-6  # rad


def edge(t: float, y: float, lattice: tuple[float, float, float, float], neighbours: bool) -> float:
    """Where the light of a direction ends on a slice, rad."""
    return t + math.asin(reach(math.sin(t), math.cos(t), y, lattice, neighbours))


def lattice_vectors(azimuth: float) -> tuple[float, float, float, float]:
    further = azimuth + math.pi / 3
    return 2 * math.cos(azimuth), 2 * math.sin(azimuth), 2 * math.cos(further), 2 * math.sin(further)


def arrives(psi: float, y: float, t: float, azimuth: float) -> bool:
    """Whether a ray towards t leaves the point psi of slice y of the dome at the origin, and passes all other unit spheres."""
    rho = math.sqrt(1 - y * y)
    point = np.array([rho * math.sin(psi), y, rho * math.cos(psi)])
    towards = np.array([math.sin(t), 0.0, math.cos(t)])
    i, j = (n.ravel() for n in np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)))
    x1, y1, x2, y2 = lattice_vectors(azimuth)
    others = (i != 0) | (j != 0)
    centres = np.column_stack([i * x1 + j * x2, i * y1 + j * y2, np.zeros(i.size)])[others]
    ahead = (centres - point) @ towards
    missed_by = np.linalg.norm(centres - point - ahead[:, None] * towards, axis=1)
    return bool(point @ towards > 0 and not np.any((ahead > 0) & (missed_by < 1)))


@given(
    t=st.floats(0, 1.5),
    y=st.floats(-0.999, 0.999),
    azimuth=st.floats(-math.pi / 6, math.pi / 6),
    share=st.floats(0.0, 1.0),
)
def test_reach_is_the_edge_of_the_shadow(t: float, y: float, azimuth: float, share: float) -> None:
    first, last = t - math.pi / 2, edge(t, y, lattice_vectors(azimuth), True)
    assert last <= math.pi / 2 + 1e-7  # a sine near 1 tells no more
    if last - first > 3 * MARGIN:
        psi = first + MARGIN + share * (last - first - 2 * MARGIN)
        assert arrives(psi, y, t, azimuth)
    psi = last + MARGIN + share * (math.pi / 2 - last - MARGIN)
    if last + MARGIN < psi < math.pi / 2:
        assert not arrives(psi, y, t, azimuth)


@given(t=st.floats(0, math.pi / 2), y=st.floats(-0.999, 0.999))
def test_a_dome_alone_is_lit_to_its_rim(t: float, y: float) -> None:
    assert math.isclose(edge(t, y, lattice_vectors(0.1), False), math.pi / 2, abs_tol=1e-7)  # a sine near 1 tells no more


def terms(theta_i: float, theta_r: float, k: float, generator: int) -> np.ndarray:
    """u_diff and u_spec of the kernel itself, which takes light from either side, on 89 slices."""
    angles = np.radians([theta_i, theta_r])
    towards = np.column_stack([np.sin(angles), np.cos(angles)])
    whole = np.array([[-np.pi / 2, np.pi / 2, np.pi / 2]])
    return dome_terms(
        k, towards, np.array([[0, 1]]), whole, 40.0, 89, generator, 0, 45, True, True, *np.polynomial.legendre.leggauss(24), True
    )[0]


angle = st.floats(-85, 85)


@given(theta_i=angle, theta_r=angle, k=st.floats(0.5, 4))
def test_light_and_view_may_be_mirrored(theta_i: float, theta_r: float, k: float) -> None:
    """Exactly, on the mirror image of the lattice rule."""
    np.testing.assert_allclose(terms(-theta_i, -theta_r, k, 89 - 55), terms(theta_i, theta_r, k, 55), rtol=1e-7, atol=1e-10)


@given(theta_i=angle, theta_r=angle, k=st.floats(0.5, 4))
def test_light_and_view_may_be_swapped_in_the_specular_term(theta_i: float, theta_r: float, k: float) -> None:
    """Visibility l v and R.V are both symmetric in L and V."""
    np.testing.assert_allclose(terms(theta_i, theta_r, k, 55)[1], terms(theta_r, theta_i, k, 55)[1], rtol=1e-7, atol=1e-10)
