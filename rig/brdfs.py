"""A stored fit as a reflectance that can be asked for millions of directions."""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from rig.errors import ConfigError
from rig.fits import StoredFit
from rig.models import stored_model
from rig.workspace import Workspace

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from fitting.fit import Fit
    from fitting.model import Model
    from fitting.table import ReflectanceTable

GRAZING_DEG = 89.99
"""Directions are moved down to this: along the surface itself the models have no value."""


def brdf_of(stored: StoredFit, workspace: Workspace, white: float | None) -> "Callable[[ArrayLike, ArrayLike, ArrayLike], NDArray[Any]]":
    """Return f(theta_i, theta_r, phi) in deg -> 1/sr.

    The models with domes integrate over a dome for each direction, far too slowly for a file: their tables of all directions are taken,
    which the workspace keeps. The others are `fitting.fit.Fit.brdf`.

    Parameters
    ----------
    stored : StoredFit
    workspace : Workspace
    white : float, optional
        What the perfect diffuser, lit and seen along its normal, would have read; for fits of relative readings, and only for those.

    Raises
    ------
    ConfigError
        If it is missing, needless or not above 0.
    """
    import numpy as np

    fit = stored.fit
    if fit.quantity == "intensity" and white is None:
        raise ConfigError(
            f"{stored.id} is a fit of relative readings, in {fit.unit}: "
            "say with --white VALUE what the perfect diffuser, lit and seen along its normal, would have read"
        )
    if white is not None and not 0 < white < math.inf:
        raise ConfigError(f"--white {white:g}: expected a reading above 0")
    if fit.quantity != "intensity" and white is not None:
        raise ConfigError(f"--white is for fits of relative readings, and {stored.id} is one of readings in {fit.unit}")
    per_white = 1 / (white or 1.0)
    tabulated = _TABULATED.get(fit.model)
    exact = fit.brdf(white) if tabulated is None else tabulated(fit, workspace, per_white)

    def f_r(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return exact(np.minimum(theta_i, GRAZING_DEG), np.minimum(theta_r, GRAZING_DEG), phi)

    return f_r


def _paper(fit: "Fit", workspace: Workspace, per_white: float) -> Any:
    """Eq. (8) is radiance under a constant beam: pi f_r cos(theta_i)."""
    import numpy as np

    intensity = _model("paper", fit, workspace).reflectance(**fit.x)

    def f_r(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return intensity(theta_i, theta_r, phi) * per_white / (np.pi * np.cos(np.radians(theta_i)))

    return f_r


def _radiometric(fit: "Fit", workspace: Workspace, per_white: float) -> Any:
    return _mixed(_model("radiometric", fit, workspace).table, fit.x, per_white)


def _interreflecting(fit: "Fit", workspace: Workspace, per_white: float) -> Any:
    """The fit's u_diff holds one factor of the albedo, which it does not take from its shape number."""
    albedo, others = fit.shape["albedo"], {name: x for name, x in fit.x.items() if name != "u_diff"}
    table, weights = _model("interreflecting", fit, workspace).parts(albedo=albedo, **others)
    first = fit.x["u_diff"] / albedo
    return _mixed(table, {name: weight * (first if name.startswith("order") else 1) for name, weight in weights.items()}, per_white)


def _body(fit: "Fit", workspace: Workspace, per_white: float) -> Any:
    """The fit has no light that strays within the domes, and two coefficients where the model has none."""
    from fitting.ladder import LEFT, REFRACTION, dome

    model = stored_model(workspace, "body", dome(fit.shape), n=REFRACTION)
    R_m = fit.shape["R_m"]
    table, weights = model.parts(mu=fit.shape["mu"], R_m=R_m, T_m=LEFT * (1 - R_m))
    return _mixed(table, {name: fit.x.get(name, 0.0) for name in weights}, per_white)


def _mixed(table: "ReflectanceTable", x: Mapping[str, float], per_white: float) -> Any:
    """Mix, also what sends back more light than falls on it: a fit need not know better, and the command says so."""
    share = max(sum(x.values()), 1.0)
    part = table.mixed({name: weight / share for name, weight in x.items()})

    def f_r(theta_i: Any, theta_r: Any, phi: Any) -> Any:
        return part(theta_i, theta_r, phi) * (share * per_white)

    return f_r


def _model(mode: str, fit: "Fit", workspace: Workspace) -> "Model":
    from fitting.ladder import dome

    return stored_model(workspace, mode, dome(fit.shape), n_us=fit.shape["n_us"], n_ss=fit.shape["n_ss"])


_TABULATED: Mapping[str, Callable[["Fit", Workspace, float], Any]] = {
    "paper": _paper,
    "radiometric": _radiometric,
    "interreflecting": _interreflecting,
    "body": _body,
}
"""By a rung of the ladder's name."""
