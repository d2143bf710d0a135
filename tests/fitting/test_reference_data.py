"""Published measurements of a leaf and of a diffuser, from the folder of reference data beside a checkout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fitting import MixtureFit, fit_mixture, read_csv

DATA = Path(__file__).parents[2].parent / "shared" / "data"
LEAF = DATA / "leaf" / "principal_plane_dj.csv"
PTFE = DATA / "ptfe" / "ptfe_inplane_extract.csv"

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the reference data are not beside this checkout")


@pytest.mark.parametrize("wavelength", [450, 550, 650, 850])
@pytest.mark.parametrize("theta_i", [20, 40])
def test_leaf(theta_i: int, wavelength: int) -> None:
    taken = read_csv(LEAF, where={"theta_i_deg": theta_i, "wavelength_nm": wavelength}, theta_r_positive="forward")
    assert len(taken) == 12
    assert taken.quantity == "reflectance-factor"
    fit = fit_mixture(taken, aspect=1.9)
    assert fit.determined
    assert fit.E.shape == (12,)
    assert np.isfinite(fit.E).all()
    assert MixtureFit.from_dict(fit.to_dict()).E_mean == fit.E_mean
    assert fit.x["s_spec"] > 0  # the leaf shines in the mirror direction


def test_the_leafs_gloss_is_on_the_far_side_from_the_light() -> None:
    """Only with its sign of theta_r turned round does the table show the mirror lobe that leaves have."""
    chosen = {"theta_i_deg": 40, "wavelength_nm": 550}
    right = fit_mixture(read_csv(LEAF, where=chosen, theta_r_positive="forward"), aspect=1.9)
    wrong = fit_mixture(read_csv(LEAF, where=chosen), aspect=1.9)
    assert right.theta_r_deg[right.measured.argmax()] < 0
    assert right.x["s_spec"] > 0.05
    assert wrong.x["s_spec"] == 0
    assert right.E_mean < wrong.E_mean


def test_all_incidences_of_the_leaf_at_once() -> None:
    taken = read_csv(LEAF, where={"wavelength_nm": 850}, theta_r_positive="forward")
    assert len(taken) == 47
    fit = fit_mixture(taken, aspect=1.9)
    assert fit.determined
    assert np.isfinite(fit.E_mean)


def test_the_diffuser_is_mostly_spongy_tissue() -> None:
    """Sintered PTFE is nearly a Lambert reflector of 1: x_s_diff says so, on the scale where the perfect diffuser is 1."""
    taken = read_csv(PTFE, where={"wavelength_nm": 532}, theta_r_positive="forward")
    assert taken.quantity == "brdf"
    steep = read_csv(PTFE, where={"wavelength_nm": 532, "theta_i_deg": 30}, theta_r_positive="forward")
    for fit in (fit_mixture(taken, aspect=1.9), fit_mixture(steep, aspect=1.9)):
        assert fit.x["s_diff"] == pytest.approx(1, abs=0.1)
        assert fit.x["u_diff"] < 0.1
        assert fit.E_mean < 10
