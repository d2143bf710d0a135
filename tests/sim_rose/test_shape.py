"""The petal's form: is it what the true angles say it is?"""

from dataclasses import replace

import numpy as np
import pytest

from sim.rose import RoseError, RosePetal, grow
from sim.rose.mesh import apply, inverse
from sim.rose.shape import Form, sheet

FEW = 1200


@pytest.fixture(scope="module")
def petals() -> tuple[RosePetal, ...]:
    return grow(12, opening=0.6, seed=5, triangles=5000).petals


def column_of_midrib(form: Form) -> np.ndarray:
    """Points of the finished mesh in the vertical half plane of the petal's azimuth, from the base up: (n, 2) of r, z."""
    points = sheet(form, 20_000).vertices
    turned = np.degrees(np.arctan2(points[:, 1], points[:, 0])) - form.azimuth
    on_it = np.abs((turned + 180) % 360 - 180) < 1e-6
    return np.stack([np.hypot(points[on_it, 0], points[on_it, 1]), points[on_it, 2]], axis=1)


def test_the_midrib_is_cupped_then_reflexed_and_the_stem_angle_is_its_direction_in_between(petals: tuple[RosePetal, ...]) -> None:
    for petal in petals:
        line = column_of_midrib(petal.form)
        step = np.diff(line, axis=0)
        angle = np.degrees(np.arctan2(step[:, 0], step[:, 1]))
        bend = np.diff(angle)
        flattest = int(np.argmin(angle))
        assert (bend[: flattest - 1] < 0).all()
        assert (bend[flattest + 1 :] > 0).all()
        assert angle[flattest] == pytest.approx(petal.form.stem_angle, abs=0.05)
        assert flattest / len(angle) == pytest.approx(petal.form.inflection, abs=0.03)


def test_the_midrib_is_as_long_as_the_form_says_and_starts_at_its_base(petals: tuple[RosePetal, ...]) -> None:
    for petal in petals:
        line = column_of_midrib(petal.form)
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).sum() == pytest.approx(petal.form.length, rel=2e-3)
        assert line[0] == pytest.approx([petal.form.base_radius, petal.form.base_height], abs=1e-9)
        base, _, tip = petal.midrib_points()
        assert np.hypot(*base[:2]) == pytest.approx(petal.form.base_radius, abs=1e-9)
        assert [np.hypot(*tip[:2]), tip[2]] == pytest.approx(list(line[-1]), abs=0.01)


def test_normals_point_to_the_inner_face(petals: tuple[RosePetal, ...]) -> None:
    for petal in petals:
        turn = np.radians(petal.form.azimuth)
        outward = np.array([np.cos(turn), np.sin(turn), 0.0])
        inward = petal.mesh.mean_normal()
        # The inner face looks at the stem and, as the flower opens, up.
        assert -(inward @ outward) + inward[2] > 0.7


def test_the_petal_frame_has_its_origin_at_the_base_and_y_to_the_tip(petals: tuple[RosePetal, ...]) -> None:
    for petal in petals:
        frame = petal.t_flower_petal()
        assert frame[:3, :3] @ frame[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
        base, _, tip = apply(inverse(frame), petal.midrib_points())
        assert base == pytest.approx([0, 0, 0], abs=1e-9)
        assert tip[[0, 2]] == pytest.approx([0, 0], abs=1e-9)
        assert tip[1] > 0.6 * petal.form.length
        assert petal.mesh.mean_normal() @ frame[:3, 2] > 0.9


def test_meshes_are_as_fine_as_asked_and_have_no_bad_triangle(petals: tuple[RosePetal, ...]) -> None:
    full = sheet(petals[0].form, 12_500)
    assert 12_000 < len(full.faces) < 13_000
    for petal in petals:
        assert petal.mesh.areas().min() > 1e-4
        # One sheet: every inner edge is shared by two triangles that run along it in opposite directions.
        edges = np.concatenate([petal.mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])
        assert len(np.unique(edges, axis=0)) == len(edges)
        euler = len(petal.mesh.vertices) - len(np.unique(np.sort(edges, axis=1), axis=0)) + len(petal.mesh.faces)
        assert euler == 1


def test_outlines_are_irregular(petals: tuple[RosePetal, ...]) -> None:
    def halves(form: Form) -> tuple[float, float]:
        straight = apply(inverse(replace(petal, form=form).t_flower_petal()), sheet(form, FEW).vertices)
        return float(straight[:, 0].max()), float(-straight[:, 0].min())

    uneven = []
    for petal in petals:
        a, b = halves(petal.form)
        uneven.append(abs(a - b) / (a + b))
    assert max(uneven) > 0.03
    assert {petal.form.point > 0 for petal in petals} == {True, False}


def test_petals_grow_outwards() -> None:
    lengths = [petal.form.length for petal in grow(25, opening=0.3, seed=2, triangles=FEW).petals]
    assert min(lengths) >= 15
    assert max(lengths) <= 45
    assert np.mean(lengths[:8]) > 1.4 * np.mean(lengths[-8:])


@pytest.mark.parametrize(
    ("petals", "opening", "triangles", "said"),
    [
        (4, 0.5, FEW, "4 petals"),
        (46, 0.5, FEW, "46 petals"),
        (5, -0.1, FEW, "opening of -0.1"),
        (5, float("nan"), FEW, "opening of nan"),
        (5, 1.0, 8, "8 triangles"),
    ],
)
def test_what_cannot_be_grown_is_refused(petals: int, opening: float, triangles: int, said: str) -> None:
    with pytest.raises(RoseError, match=said):
        grow(petals, opening=opening, triangles=triangles)
