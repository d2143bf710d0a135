"""Figure 14 in numbers: what is said where orders agree and where they do not."""

import numpy as np
import pytest

from fitting.fit import fit
from fitting.measurements import Measurements
from rig.contrasts import ContrastRow, contrast_table
from rig.fits import new_fit, refitted


def rows(*C: float, tall: tuple[float, ...] = (1.2, 1.1, 0.8)) -> list[ContrastRow]:
    return [ContrastRow(label, m, 1.0, c, m, t) for label, m, c, t in zip(("BR", "PR", "WR"), (2.1, 1.0, 0.7), C, tall, strict=True)]


def test_agreeing_orders_are_said_to_agree() -> None:
    said = contrast_table(rows(1.3, 1.1, 0.9), 1.07)
    assert said.endswith("C orders the cultivars as the readings do")
    assert "C of a Lambert surface in the same pixels: 1.070" in said


@pytest.mark.parametrize(("tall", "order"), [((1.2, 1.1, 0.8), "that of the readings"), ((1.0, 1.1, 0.8), "still another")])
def test_pairs_that_change_places_are_named_and_explained(tall: tuple[float, ...], order: str) -> None:
    said = contrast_table(rows(1.05, 1.1, 0.9, tall=tall), 1.07)
    assert "C orders BR-PR otherwise than the readings" in said
    assert said.endswith(f"the order is {order}.")


@pytest.mark.parametrize("weights", ["relative", "plain"])
def test_a_fit_is_fitted_again_with_other_cells(weights: str) -> None:
    theta_r = np.arange(-60.0, 61, 20)
    readings = Measurements(
        theta_i_deg=np.full(7, 45.0),
        theta_r_deg=theta_r,
        value=10 + np.abs(theta_r) / 10,
        sigma=None,
        quantity="intensity",
        unit="nA",
        source="test",
        rows=np.arange(7),
    )
    stored = new_fit("RR", False, {}, fit(readings, shape={"aspect": 0.5}, weights=weights))  # type: ignore[arg-type]
    again, directly = refitted(stored, 1.9).fit, fit(readings, shape={"aspect": 1.9}, weights=weights)  # type: ignore[arg-type]
    assert again.x == pytest.approx(directly.x)
    assert (again.shape["aspect"], again.weights) == (1.9, weights)
    np.testing.assert_array_equal(again.measured, stored.fit.measured)
