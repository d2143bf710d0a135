"""Four degrees of physics behind one door: numbers in, reflectance out, one file on disk."""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fitting.body import Epidermis, trace_body
from fitting.cells import Cell, Spread
from fitting.errors import DomainError, EnergyError, TableError
from fitting.model import MODES, NUMBERS, Model, build, cell_of, chosen, load, save
from fitting.orders import escape_orders
from fitting.paper import TERMS, paper_terms
from fitting.radiometric import radiometric_terms
from fitting.table import Grid

CELL, PAPILLA, BELOW = Cell(1.9), Cell(0.9), Cell(0.6)
"""Of the opaque modes, and of both faces in "body": tall clear domes take long to trace."""

COARSE = Grid(theta_steps=15, phi_steps=18)
TYPICAL = {
    "paper": {"u_diff": 20.0, "u_spec": 300.0, "s_diff": 5.0, "s_spec": 2.0},
    "radiometric": {"u_diff": 0.3, "u_spec": 0.04, "s_diff": 0.1, "s_spec": 0.02},
    "interreflecting": {"albedo": 0.6, "u_spec": 0.04, "s_diff": 0.1},
    "body": {"mu": 0.3, "R_m": 0.5, "T_m": 0.4, "D_m": 0.05, "R_m_below": 0.4},
}


Built = Callable[[str], Model]


@pytest.fixture(scope="session")
def told() -> dict[str, list[float]]:
    """What was said of the progress of each mode's building."""
    return {mode: [] for mode in MODES}


@pytest.fixture(scope="session")
def built(told: dict[str, list[float]]) -> Built:
    """One model a mode, built when first asked for."""

    def of(mode: str) -> Model:
        upper, lower = (PAPILLA, BELOW) if mode == "body" else (CELL, None)
        return build(mode, upper, grid=COARSE, lower=lower, progress=told[mode].append)

    return functools.cache(of)


def test_paper_is_the_paper_in_plane(built: Built) -> None:
    views = np.arange(-60.0, 61, 15)
    exact = paper_terms(30.0, views, aspect=1.9) @ [TYPICAL["paper"][name] for name in TERMS]
    found = built("paper").reflectance(**TYPICAL["paper"])(30.0, views, 0.0)
    assert np.abs(found - exact).max() < 0.03 * exact.mean()


def test_radiometric_is_a_weighted_sum_of_the_terms(built: Built) -> None:
    theta_i, theta_r, phi = COARSE.theta[2], COARSE.theta[[1, 4, 7]], COARSE.phi[[0, 7, 18]]
    exact = radiometric_terms(theta_i, theta_r, phi, cell=CELL) @ [TYPICAL["radiometric"][name] for name in TERMS]
    found = built("radiometric").reflectance(**TYPICAL["radiometric"])(theta_i, theta_r, phi)
    np.testing.assert_allclose(found, exact, rtol=0.03)


def test_interreflecting_adds_the_orders_at_any_albedo(built: Built) -> None:
    model = built("interreflecting")
    nodes = model.table.nodes
    traced = escape_orders(CELL, nodes[0][[3]], *nodes[1:])
    for albedo in (0.0, 0.3, 0.9):
        found = model.reflectance(albedo=albedo)(nodes[0][3], nodes[1][:, None], nodes[2])
        np.testing.assert_allclose(found, traced.reflectance(albedo)[0], rtol=2e-3, atol=1e-4)


def test_a_white_furnace_is_white(built: Built) -> None:
    albedo = built("interreflecting").reflectance(albedo=1.0).albedo([0.0, 30.0, 60.0])
    np.testing.assert_allclose(albedo, 1, atol=0.01)


def test_single_bounce_falls_short_of_all_orders(built: Built) -> None:
    # 10 to 30 % of the shape at 60 deg for pale or tall domes: what makes this mode worth its time.
    views = np.array([-60.0, 0.0, 30.0, 60.0])
    ratio = built("interreflecting").reflectance(albedo=0.8)(60.0, views, 0.0) / built("radiometric").reflectance(u_diff=0.8)(
        60.0, views, 0.0
    )
    assert 0.1 < np.abs(ratio[1:] / ratio[1:].mean() - 1).max() < 0.4
    assert ratio[0] > 2  # the shaded sides of tall domes have little but light from their neighbours


def test_body_light_shares_one_budget_with_transmission(built: Built) -> None:
    model = built("body")
    assert model.body is not None
    angles = np.array([0.0, 30.0, 60.0])
    budget = model.body.budget(angles, **TYPICAL["body"])
    both = model.scattering(**TYPICAL["body"])
    np.testing.assert_allclose(both.reflected.albedo(angles), sum(budget[k] for k in ("mirror", "stray", "body")), atol=0.01)
    np.testing.assert_allclose(both.transmitted.albedo(angles), budget["scattered"] + budget["direct"], atol=0.01)
    without = model.transmittance(direct=False, **TYPICAL["body"])
    np.testing.assert_allclose(without.albedo(angles), budget["scattered"], atol=0.01)


def test_a_lossless_petal_sends_all_light_somewhere(built: Built) -> None:
    model = built("body")
    assert model.body is not None
    both = model.scattering(mu=0.0, R_m=0.6, T_m=0.4)
    angles = np.array([0.0, 45.0, 75.0])
    floor = model.body.budget(angles, mu=0.0, R_m=0.6, T_m=0.4)["floor"]
    np.testing.assert_allclose(both.reflected.albedo(angles) + both.transmitted.albedo(angles) + floor, 1, atol=0.015)


def test_upper_and_lower_face_differ_and_light_goes_both_ways(built: Built) -> None:
    model = built("body")
    over = model.turned_over()
    numbers = {"mu": 0.3, "mu_below": 0.1, "R_m": 0.5, "R_m_below": 0.4, "T_m": 0.4}
    mirrored = {"mu": 0.1, "mu_below": 0.3, "R_m": 0.4, "R_m_below": 0.5, "T_m": 0.4}
    above, below = model.reflectance(**numbers)(45.0, [-40.0, 0.0, 40.0], 0.0), over.reflectance(**mirrored)(45.0, [-40.0, 0.0, 40.0], 0.0)
    assert np.abs(above / below - 1).max() > 0.1
    # Helmholtz: from above to below as from below to above.
    through, back = model.transmittance(**numbers), over.transmittance(**mirrored)
    angles = COARSE.theta[:9]
    np.testing.assert_allclose(through(angles[:, None], angles, 0.0), back(angles[:, None], angles, 0.0).T, rtol=2e-3)
    twice = over.turned_over().reflectance(**numbers)
    np.testing.assert_array_equal(twice(45.0, [-40.0, 0.0, 40.0], 0.0), above)


def test_body_is_traced_by_the_geometry_asked_for(built: Built) -> None:
    theta, phi = built("body").table.nodes[0], built("body").table.nodes[2]
    direct = trace_body(Epidermis(PAPILLA, 1.0), Epidermis(BELOW, 1.0))
    views = theta[[0, 3, 8]]
    found = built("body").reflectance(**TYPICAL["body"])(theta[4], views, phi[6])
    np.testing.assert_allclose(found, direct.reflectance(theta[4], views, phi[6], **TYPICAL["body"]), rtol=1e-4)


@pytest.mark.parametrize("mode", ["paper", "radiometric", "interreflecting"])
def test_only_body_knows_the_other_side(built: Built, mode: str) -> None:
    for ask in (lambda m: m.transmittance(**TYPICAL[mode]), Model.turned_over):
        with pytest.raises(DomainError, match="'body'"):
            ask(built(mode))


@pytest.mark.parametrize("mode", MODES)
def test_one_file_holds_all_of_it(built: Built, mode: str, tmp_path: Path) -> None:
    model = built(mode)
    save(model, tmp_path / "model.npz")
    again = load(tmp_path / "model.npz")
    assert again.mode == mode
    assert again.provenance == model.provenance
    assert cell_of(again) == (PAPILLA if mode == "body" else CELL)
    directions = np.meshgrid([0.0, 33.0, 71.0], [-50.0, 5.0, 62.0], [0.0, 70.0])
    first, second = (some.reflectance(**TYPICAL[mode])(*directions) for some in (model, again))
    np.testing.assert_array_equal(first, second)
    assert [path.name for path in tmp_path.iterdir()] == ["model.npz"]


def test_a_file_that_was_changed_is_refused(built: Built, tmp_path: Path) -> None:
    save(built("paper"), tmp_path / "model.npz")
    whole = (tmp_path / "model.npz").read_bytes()
    for name, content in {"cut": whole[: len(whole) // 2], "foreign": b"no model", "empty": b""}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(TableError, match=name):
            load(tmp_path / name)
    with pytest.raises(TableError, match="missing"):
        load(tmp_path / "missing")


def test_a_body_model_without_its_trace_is_refused(built: Built, tmp_path: Path) -> None:
    save(Model("body", built("body").table), tmp_path / "model.npz")
    with pytest.raises(TableError, match="body"):
        load(tmp_path / "model.npz")


@pytest.mark.parametrize(
    ("mode", "numbers", "says"),
    [
        ("paper", {"u_diff": 1.0}, "needs u_spec"),
        ("radiometric", {"u_diff": -0.1}, "0 or more"),
        ("radiometric", {"u_diff": 0.1, "albedo": 0.2}, "has no albedo"),
        ("interreflecting", {"albedo": 1.2}, "0 to 1"),
        ("interreflecting", {"albedo": float("nan")}, "0 to 1"),
        ("body", {"mu": 0.1, "R_m": 0.5}, "needs T_m"),
        ("mirror", {}, "no mode 'mirror'"),
    ],
)
def test_numbers_that_make_no_cultivar_are_refused(mode: str, numbers: dict[str, float], says: str) -> None:
    with pytest.raises(DomainError, match=says):
        chosen(mode, numbers)


def test_what_is_not_said_is_as_usual() -> None:
    assert chosen("body", {"mu": 0.2, "R_m": 0.6, "T_m": 0.1}) == {
        "mu": 0.2, "R_m": 0.6, "T_m": 0.1, "D_m": 0.0, "mu_below": 0.2, "R_m_below": 0.6,
    }  # fmt: skip
    assert list(chosen("interreflecting", {"albedo": 0.5})) == [number.name for number in NUMBERS["interreflecting"]]


def test_too_much_light_is_refused(built: Built) -> None:
    with pytest.raises(EnergyError):
        built("radiometric").reflectance(u_diff=0.9, s_diff=0.9)
    with pytest.raises(DomainError, match="more light than it gets"):
        built("body").reflectance(mu=0.0, R_m=0.7, T_m=0.6)


@pytest.mark.parametrize("mode", ["paper", "interreflecting", "body"])
def test_the_share_done_rises_to_all_of_it(built: Built, told: dict[str, list[float]], mode: str) -> None:
    built(mode)
    shares = told[mode]
    assert shares == sorted(shares)
    assert 0 < shares[0] < 0.2
    assert shares[-1] >= 0.8
    assert len(shares) > 10


def test_only_known_modes_and_cells_are_built() -> None:
    with pytest.raises(DomainError, match="expected one of"):
        build("phong")
    with pytest.raises(DomainError, match="spread"):
        build("interreflecting", Cell(1.0, gap=0.3, spread=Spread(height=0.1, cells=2)), n_us=5.0, grid=Grid(6, 18))
