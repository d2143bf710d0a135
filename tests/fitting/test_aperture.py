"""The aperture's nodes against integrals over cones and spots, made point by point from where lamp, spot and detector are."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import qmc

from fitting.aperture import Aperture
from fitting.errors import DomainError

Radiance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def unit(theta: Any, phi: Any) -> np.ndarray:
    theta, phi = np.broadcast_arrays(np.radians(theta), np.radians(phi))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def lobe(theta_i: Any, theta_r: Any, phi: Any, n: float = 40) -> np.ndarray:
    """A Phong lobe about the mirror direction."""
    return np.asarray(np.maximum(0, np.sum(unit(theta_i, 180) * unit(theta_r, phi), axis=-1)) ** n)


def glossy(theta_i: Any, theta_r: Any, phi: Any) -> np.ndarray:
    return np.asarray(np.cos(np.radians(theta_i)) * (0.3 + lobe(theta_i, theta_r, phi)))


def read(aperture: Aperture, f: Radiance, theta_i: Any, theta_r: Any, phi: Any = 0.0) -> np.ndarray:
    *directions, weight = aperture.nodes(theta_i, theta_r, phi)
    return np.sum(weight * f(*directions), axis=1)


def towards(axis: np.ndarray, half_deg: float, u: np.ndarray) -> np.ndarray:
    """Unit vectors evenly spread in a cone: about z, then turned by Rodrigues' formula."""
    c = 1 - u[:, 0] * (1 - math.cos(math.radians(half_deg)))
    s, turn = np.sqrt(1 - c * c), 2 * np.pi * u[:, 1]
    about_z = np.column_stack([s * np.cos(turn), s * np.sin(turn), c])
    k, cos = np.cross([0, 0, 1], axis), axis[2]
    return np.asarray(about_z * cos + np.cross(k, about_z) + np.outer(about_z @ k, k) / (1 + cos))


def simulated(aperture: Aperture, f: Radiance, theta_i: float, theta_r: float, phi: float = 0.0, *, falloff: bool = False) -> float:
    """The reading as light travels: point of the lamp's disc, point of the spot, point of the detector's disc."""
    u = qmc.Sobol(6, seed=3).random_base2(16)
    light, view = unit(theta_i, 0.0), unit(theta_r, phi)
    radius, turn = aperture.spot_mm / 2 * np.sqrt(u[:, 4]), 2 * np.pi * u[:, 5]
    # A disc across the beam (or the view), its points carried along the beam down to the specimen.
    beam = light if aperture.sees == "spot" else view
    across = (
        np.cross([0, 1, 0], beam)
        if phi == 0 or aperture.sees == "spot"
        else np.cross([-math.sin(math.radians(phi)), math.cos(math.radians(phi)), 0], beam)
    )
    other = np.cross(beam, across)
    disc = np.outer(radius * np.cos(turn), across / np.linalg.norm(across)) + np.outer(radius * np.sin(turn), other / np.linalg.norm(other))
    spot = disc - np.outer(disc[:, 2] / beam[2], beam)
    wi, wo = towards(light, aperture.beam_deg, u[:, :2]), towards(view, aperture.acceptance_deg, u[:, 2:4])
    weight = np.ones(len(u))
    if aperture.lamp_mm is not None:
        wi = aperture.lamp_mm * wi - spot
        weight /= np.sum(wi**2, axis=1)
    if aperture.detector_mm is not None:
        wo = aperture.detector_mm * wo - spot
        weight /= np.sum(wo**2, axis=1)
    wi, wo = (w / np.linalg.norm(w, axis=1)[:, None] for w in (wi, wo))
    if not falloff:
        weight = np.ones(len(u))
    polar_i, polar_r = (np.degrees(np.arccos(w[:, 2])) for w in (wi, wo))
    azimuth = np.degrees(np.arctan2(wo[:, 1], wo[:, 0]) - np.arctan2(wi[:, 1], wi[:, 0]))
    radiance = f(polar_i, polar_r, azimuth) * (wo[:, 2] / light[2] if aperture.sees == "spot" else 1)
    return float(np.average(radiance, weights=weight))


# Cones


@pytest.mark.parametrize(("theta_r", "phi"), [(-45, 0), (-20, 0), (-70, 0), (-15, 0), (45, 150), (30, 170), (60, -160)])
def test_the_mean_of_a_lobe_over_a_cone(theta_r: float, phi: float) -> None:
    """Against a fine grid over the cone's solid angle, wherever the lobe is above a thousandth of its peak."""
    assert lobe(45, theta_r, phi) > 1e-3
    cap, turn = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(360) + 0.5) / 360)
    wo = towards(unit(theta_r, phi), 5.0, np.column_stack([cap.ravel(), turn.ravel()]))
    mean = np.mean(np.maximum(0, wo @ unit(45, 180)) ** 40)
    assert abs(mean / lobe(45, theta_r, phi) - 1) > 0.01  # the cone matters
    assert read(Aperture(acceptance_deg=5), lobe, 45, theta_r, phi)[0] == pytest.approx(mean, rel=1e-3)


def test_the_error_falls_with_the_sixth_power_of_the_angle() -> None:
    """Degree 5, on a function of which every derivative counts."""

    def growing(theta_i: Any, theta_r: Any, phi: Any) -> np.ndarray:
        return np.asarray(np.exp(unit(theta_r, phi) @ [3.0, 0, 1]))

    def error(half: float) -> float:
        c = np.polynomial.legendre.leggauss(12)
        turn = 2 * np.pi * (np.arange(32) + 0.5) / 32
        u = np.column_stack([np.repeat((c[0] + 1) / 2, 32), np.tile(turn / (2 * np.pi), 12)])
        exact = np.average(np.exp(towards(unit(30, 0), half, u) @ [3.0, 0, 1]), weights=np.repeat(c[1], 32))
        return abs(read(Aperture(acceptance_deg=half), growing, 45, 30)[0] / exact - 1)

    assert error(24) / error(12) == pytest.approx(64, rel=0.1)
    assert error(24) < 1e-3


@given(
    theta_i=st.floats(0, 79),
    theta_r=st.floats(-79, 79),
    phi=st.floats(-180, 180),
    acceptance=st.floats(0, 10),
    beam=st.floats(0, 10),
)
def test_nodes_stay_within_their_cones(theta_i: float, theta_r: float, phi: float, acceptance: float, beam: float) -> None:
    incidence, view, azimuth, weight = Aperture(acceptance, beam).nodes(theta_i, theta_r, phi)
    assert weight.sum() == pytest.approx(1, abs=1e-12)
    assert np.all((incidence >= 0) & (incidence < 90) & (np.abs(view) < 90) & (np.abs(azimuth) <= 180))
    assert np.all((azimuth == 0) | (view >= 0))
    assert np.all(np.abs(incidence - theta_i) <= beam + 1e-9)
    between = np.sum(unit(incidence, 0) * unit(view, azimuth), axis=-1)
    axes = math.degrees(math.acos(np.clip(unit(theta_i, 0) @ unit(theta_r, phi), -1, 1)))
    assert np.all(np.abs(np.degrees(np.arccos(np.clip(between, -1, 1))) - axes) <= acceptance + beam + 1e-5)


def test_an_axis_is_in_the_plane_however_it_is_written() -> None:
    cone = Aperture(acceptance_deg=4)
    for written in ((-40, 0), (40, 180), (40, -180), (-40, 360)):
        for given_so, plain in zip(cone.nodes(45, *written), cone.nodes(45, -40), strict=True):
            np.testing.assert_allclose(given_so, plain, atol=1e-12)


@pytest.mark.parametrize("settings", [{"acceptance_deg": 6}, {"beam_deg": 4}, {"acceptance_deg": 6, "beam_deg": 3}])
@pytest.mark.parametrize("theta_i", [0, 45])
def test_folding_changes_nothing(settings: dict[str, Any], theta_i: float) -> None:
    """A reading out of the plane beside them keeps the others from being folded."""
    aperture, views = Aperture(**settings), np.array([-70.0, -45, 0, 20, 80])
    folded = aperture.nodes(theta_i, views)
    whole = aperture.nodes(theta_i, np.append(views, 30), np.append(np.zeros(5), 50))
    assert folded[0].shape[1] == {7: 4, 49: 25}[whole[0].shape[1]]
    assert np.all(folded[2] >= 0)
    np.testing.assert_allclose(read(aperture, glossy, theta_i, views), np.sum(whole[3] * glossy(*whole[:3]), axis=1)[:5], rtol=1e-12)
    mirrored = whole[2][:5]
    np.testing.assert_array_equal(np.sort(mirrored), np.sort(-mirrored))  # to the last bit


# Spot


SETUPS = [
    Aperture(spot_mm=8, lamp_mm=300, detector_mm=250),
    Aperture(spot_mm=8, lamp_mm=300, detector_mm=250, sees="spot"),
    Aperture(spot_mm=12, detector_mm=200),
    Aperture(spot_mm=12, lamp_mm=200, sees="spot"),
    Aperture(acceptance_deg=4, sees="spot"),
    Aperture(acceptance_deg=3, beam_deg=2, spot_mm=6, lamp_mm=300, detector_mm=250, sees="spot"),
    Aperture(acceptance_deg=3, beam_deg=2, spot_mm=6, lamp_mm=300, detector_mm=250),
]


@pytest.mark.parametrize("aperture", SETUPS)
@pytest.mark.parametrize(("theta_i", "theta_r", "phi"), [(45, -45, 0), (45, -65, 0), (60, -40, 0), (20, 70, 0), (50, 40, 160), (0, 10, 0)])
def test_readings_of_a_glossy_spot(aperture: Aperture, theta_i: float, theta_r: float, phi: float) -> None:
    expected = simulated(aperture, glossy, theta_i, theta_r, phi)
    assert read(aperture, glossy, theta_i, theta_r, phi)[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("aperture", [s for s in SETUPS if s.spot_mm])
def test_the_loss_with_distance_may_be_left_out(aperture: Aperture) -> None:
    """On the lobe's flank, where it matters most."""
    lost = simulated(aperture, glossy, 45, -65, falloff=True) / simulated(aperture, glossy, 45, -65)
    assert lost == pytest.approx(1, abs=(aperture.spot_mm / 100) ** 2)


def test_light_and_view_share_the_points_of_the_spot() -> None:
    """Lamp and detector in one place see each point under one angle, so that a retro-reflection stays one."""

    def retro(theta_i: Any, theta_r: Any, phi: Any) -> np.ndarray:
        return np.asarray(np.sum(unit(theta_i, 0) * unit(theta_r, phi), axis=-1) ** 400)

    together, apart = Aperture(spot_mm=20, lamp_mm=300, detector_mm=300), Aperture(spot_mm=20, lamp_mm=300)
    assert read(together, retro, 40, 40)[0] == pytest.approx(1, abs=1e-9)
    assert read(apart, retro, 40, 40)[0] < 0.95


def test_what_sees_all_of_the_spot_reads_its_flux() -> None:
    """A white diffuser, radiance cos(theta_i): flux cos(theta_r) whatever the incidence."""
    views = np.array([-60.0, 0, 30, 80])

    def white(theta_i: Any, theta_r: Any, phi: Any) -> np.ndarray:
        return np.cos(np.radians(theta_i))

    for theta_i in (0, 30, 70):
        np.testing.assert_allclose(read(Aperture(sees="spot"), white, theta_i, views), np.cos(np.radians(views)), rtol=1e-12)
        np.testing.assert_allclose(read(Aperture(), white, theta_i, views), math.cos(math.radians(theta_i)), rtol=1e-12)


def test_behind_the_specimen() -> None:
    """A view from below is the view from above, mirrored, and its cone stays below."""
    cone = Aperture(acceptance_deg=5, spot_mm=5, detector_mm=300)
    _, above, around, _ = cone.nodes(30, [30.0, 60], 20)
    _, below, under, _ = cone.nodes(30, [150.0, 120], 20)
    np.testing.assert_allclose(np.sort(180 - below), np.sort(above), atol=1e-9)
    np.testing.assert_allclose(np.sort(under), np.sort(around), atol=1e-9)


# Settings


def test_without_extent_the_angles_come_back_as_they_are() -> None:
    views, azimuths = np.array([-70.0, 0.1, 33.3, 80]), np.array([0, 0, 12.7, -100.1])
    found = Aperture().nodes(45, views, azimuths)
    for column, expected in zip(found, (np.full(4, 45.0), views, azimuths, np.ones(4)), strict=True):
        np.testing.assert_array_equal(column, expected[:, None])
    assert Aperture().is_ideal
    assert Aperture(lamp_mm=300).is_ideal
    assert not any(a.is_ideal for a in (*SETUPS, Aperture(sees="spot")))


def test_settings_survive_json() -> None:
    for aperture in (Aperture(), *SETUPS):
        assert Aperture.from_dict(json.loads(json.dumps(aperture.to_dict(), allow_nan=False))) == aperture
    assert Aperture.from_dict({"beam_deg": 1}) == Aperture(beam_deg=1)
    with pytest.raises(DomainError, match=r"unknown setting beam; known are acceptance_deg, beam_deg"):
        Aperture.from_dict({"beam": 1})
    with pytest.raises(DomainError, match="must be numbers"):
        Aperture.from_dict({"beam_deg": "wide"})


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"acceptance_deg": -1}, "acceptance_deg is -1"),
        ({"beam_deg": 31}, "0 to 30 deg"),
        ({"beam_deg": math.nan}, "beam_deg is nan"),
        ({"spot_mm": math.inf, "lamp_mm": 300}, "spot_mm is inf"),
        ({"spot_mm": 5}, "lamp_mm or detector_mm"),
        ({"lamp_mm": 0}, "lamp_mm is 0"),
        ({"detector_mm": math.inf}, "detector_mm is inf"),
        ({"sees": "all"}, "'patch' or 'spot'"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(DomainError, match=problem):
        Aperture(**settings)


@pytest.mark.parametrize(
    ("aperture", "directions", "problem"),
    [
        (Aperture(acceptance_deg=6), (45, [10, -85]), "acceptance_deg of 6 deg is too large at theta_r = -85 deg"),
        (Aperture(acceptance_deg=6), (45, 95), "acceptance_deg of 6 deg is too large at theta_r = 95 deg"),
        (Aperture(beam_deg=2), (88, 0), "beam_deg of 2 deg is too large at theta_i = 88 deg"),
        (Aperture(spot_mm=20, lamp_mm=100, sees="spot"), (85, 0), "spot_mm of 20 mm is too large at theta_i = 85 deg.* lamp_mm, 100 mm"),
        (Aperture(spot_mm=20, lamp_mm=500, detector_mm=100), (0, 85), "too large at theta_r = 85 deg.* detector_mm, 100 mm"),
        (Aperture(), (90, 0), "theta_i is 90"),
        (Aperture(), (-1, 0), "theta_i is -1"),
        (Aperture(), (45, math.nan), "theta_r is nan"),
        (Aperture(), (45, 0, math.inf), "phi is inf"),
        (Aperture(), (45, "x"), "must be numbers"),
        (Aperture(), ([45, 45, 45], [1, 2]), "shapes match"),
    ],
)
def test_directions_that_cannot_be(aperture: Aperture, directions: tuple[Any, ...], problem: str) -> None:
    with pytest.raises(DomainError, match=problem):
        aperture.nodes(*directions)
