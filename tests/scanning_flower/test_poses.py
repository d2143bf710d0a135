"""The petals' coordinates: frames, motions, measured angles."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from scanning.poses import coordinates, inverse, measured_coordinates, petal_poses, stem_angles, twists

angle = st.floats(-1.2, 1.2)
anywhere = st.tuples(st.floats(-3, 3), st.floats(0.5, 10), st.floats(-3, 3), st.floats(0.1, 1.4), angle, angle)


def test_an_upright_petal_at_azimuth_0_faces_the_stem() -> None:
    pose = petal_poses(np.array([[0.0, 3.0, 1.0, 0.0, 0.0, 0.0]]))[0]
    np.testing.assert_allclose(pose, [[0, 0, -1, 3], [-1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]], atol=1e-15)


@given(anywhere)
def test_poses_are_rigid_and_put_the_base_where_it_was_measured(q: tuple[float, ...]) -> None:
    pose = petal_poses(np.array([q]))[0]
    np.testing.assert_allclose(pose @ inverse(pose), np.eye(4), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) > 0.999
    along = np.array([np.cos(q[0]), np.sin(q[0])])
    np.testing.assert_allclose([along @ pose[:2, 3], pose[2, 3]], q[1:3], atol=1e-12)
    np.testing.assert_allclose(along @ [pose[1, 3], -pose[0, 3]], q[4], atol=1e-12)


@given(anywhere, st.integers(0, 5))
def test_twists_are_the_derivatives_of_the_poses(q: tuple[float, ...], coordinate: int) -> None:
    at, step = np.array([q]), np.zeros(6)
    step[coordinate] = 1e-6
    point = np.array([2.0, 15.0, -3.0, 1.0])
    slope = ((petal_poses(at + step)[0] - petal_poses(at - step)[0]) @ point)[:3] / 2e-6
    omega, v = twists(at)
    p = (petal_poses(at)[0] @ point)[:3]
    np.testing.assert_allclose(np.cross(omega[0, coordinate], p) + v[0, coordinate], slope, atol=1e-7)


@given(st.floats(5, 120), st.floats(-180, 180), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1))
def test_the_measured_stem_angle_is_met(stem: float, azimuth: float, bend: float, aside: float) -> None:
    inflection = np.array([[aside, np.cos(bend), np.sin(bend)]])
    inflection /= np.linalg.norm(inflection)
    q = measured_coordinates(np.array([azimuth]), np.array([3.0]), np.array([1.0]), np.array([stem]), inflection)
    if abs(np.cos(np.radians(stem))) < np.hypot(*inflection[0, 1:]):
        np.testing.assert_allclose(np.degrees(stem_angles(q, inflection)), stem, atol=1e-6)


turn = st.floats(-np.pi, np.pi)


@given(turn, st.one_of(st.just(0.0), st.just(1e-12), turn), turn, st.tuples(*[st.floats(-20, 20)] * 3))
def test_any_pose_is_given_back_by_its_coordinates(azimuth: float, tilt: float, roll: float, base: tuple[float, float, float]) -> None:
    T = petal_poses(np.array([[azimuth, *base[:2], tilt, base[2], roll]]))
    np.testing.assert_allclose(petal_poses(coordinates(T)), T, atol=1e-8)
