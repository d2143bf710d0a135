"""What a virtual petal is made of: lengths in um, coefficients in 1/um.

One effective band, 500 to 560 nm (green), stands for the visible: there anthocyanin, which colours roses from pink to black, absorbs
most, so the band tells dark petals from pale ones, and flavonols and most of the carotenoids, which absorb below 500 nm, can be left out.
"""

import math
from typing import NamedTuple

from sim.petals.errors import PetalError


class Petal(NamedTuple):
    """The optical structure of a petal: domed upper epidermis, mesophyll, lower epidermis.

    Domes are half-ellipsoids on a hexagonal lattice with a flat floor between them. A cell's height and lean are drawn at random, each cell
    for itself. The cells' walls and sap are one medium of index `refraction`; the air gaps of the mesophyll are its scatterers, so no
    surface parts epidermis from mesophyll.

    Attributes
    ----------
    pitch : float
        Distance of neighbouring cells [um].
    radius : float
        Base radius of a dome [um]; 0 makes a flat petal.
    height : float
        Mean height of a dome [um].
    height_spread : float
        Half-width of the uniform distribution of heights, relative to `height`.
    lean : float
        Largest lean of a dome's axis [deg]; its tangent is uniform over a disk. The dome is sheared, its base stays a circle.
    roughness : float
        GGX slope roughness of the outer surface; 0 is smooth.
    refraction : float
        Refractive index of the cells; air is 1.
    epidermis : float
        Depth of the epidermal cells below the foot of the domes [um].
    pigment : float
        Absorption coefficient in the upper epidermis, domes included [1/um].
    mesophyll : float
        Thickness of the mesophyll [um].
    scattering : float
        Scattering coefficient in the mesophyll [1/um].
    anisotropy : float
        Mean cosine g of the Henyey-Greenstein phase function.
    absorption : float
        Absorption coefficient in the mesophyll [1/um].
    lower_epidermis : float
        Thickness of the flat lower epidermis [um].
    lower_pigment : float
        Absorption coefficient in it [1/um].
    backing : float
        Reflectance of a mirror on the lower face, 0 (air) to 1. For furnace tests; no cultivar has one.
    """

    pitch: float = 20.0
    radius: float = 9.6
    height: float = 9.6
    height_spread: float = 0.1
    lean: float = 3.0
    roughness: float = 0.2
    refraction: float = 1.42
    epidermis: float = 15.0
    pigment: float = 0.0
    mesophyll: float = 120.0
    scattering: float = 0.03
    anisotropy: float = 0.7
    absorption: float = 0.0
    lower_epidermis: float = 15.0
    lower_pigment: float = 0.0
    backing: float = 0.0


# Where the values come from:
#   pitch, tall domes  rose cells are about 20 um wide and a little under 40 um high, as those who measured these cultivars say elsewhere
#   refraction         leaf cell walls 1.41 to 1.43 (Gausman, Allen & Escobar 1974, doi:10.1364/AO.13.000109; Woolley 1975,
#                      doi:10.1104/pp.55.2.172)
#   pigment            mu = ln(10) eps c with eps = 2.7e4 l/(mol cm), cyanidin glucosides: 0.038/um is 6 mmol/l in the vacuole, averaged
#                      over the band; pink has a seventh of it, white next to none. Black is red in taller cells with a little more of it
#   roughness          cuticle folds and wax finer than a cell, from smooth to striate [U]
#   mesophyll          100 to 200 um of cells and air gaps; scattered at the walls every 30 to 50 um or so, mostly forward [U]
#   absorption         none, but for WR: a cream white that holds traces of other pigments [U]
# Cell heights, wax and scattering of the single cultivars were never measured [U]. They are plausible values for which these four petals
# show what was measured on the real ones: the pale ten times brighter than the dark, and the stronger the texture, the more light back to
# the lamp. Tall cells turn their flanks to the lamp and hide the floor; low ones mirror. Change them here and trace the tables anew.
CULTIVARS: dict[str, Petal] = {
    "BR": Petal(height=36.0, pigment=0.038, lower_pigment=0.038, roughness=0.30),
    "RR": Petal(height=26.0, pigment=0.033, lower_pigment=0.033, roughness=0.30),
    "PR": Petal(height=22.0, pigment=0.005, lower_pigment=0.005, roughness=0.25),
    "WR": Petal(height=4.0, pigment=0.0002, lower_pigment=0.0002, roughness=0.40, scattering=0.018, absorption=0.0013),
}


def check(petal: Petal) -> Petal:
    """Return `petal` with every value a float, or say which value cannot be.

    Raises
    ------
    PetalError
        For a value out of range, or domes that would reach into their neighbours' cells.
    """
    petal = Petal(*(float(value) for value in petal))
    for name, value in petal._asdict().items():
        if not math.isfinite(value) or (value < 0 and name != "anisotropy"):
            raise PetalError(f"petal value {name} = {value}: expected a finite number, not negative")
    for name, ok, wanted in (
        ("pitch", petal.pitch > 0, "more than 0"),
        ("height", petal.radius == 0 or petal.height > 0, "more than 0 (a flat petal has radius = 0)"),
        ("height_spread", petal.height_spread < 1, "less than 1"),
        ("lean", petal.lean < 45, "less than 45 deg"),
        ("roughness", petal.roughness == 0 or 0.05 <= petal.roughness <= 1, "0, or 0.05 to 1 (finer lobes are not sampled well)"),
        ("refraction", petal.refraction >= 1.1 or (petal.refraction == 1 and petal.roughness == 0), "at least 1.1, or 1 with roughness 0"),
        ("mesophyll", petal.mesophyll > 0, "more than 0"),
        ("anisotropy", -1 < petal.anisotropy < 1, "between -1 and 1"),
        ("backing", petal.backing <= 1, "0 to 1"),
    ):
        if not ok:
            raise PetalError(f"petal value {name} = {getattr(petal, name)}: expected {wanted}")
    reach = math.hypot(petal.radius, math.tan(math.radians(petal.lean)) * tallest(petal))
    if reach > petal.pitch / 2:
        raise PetalError(
            f"domes of radius {petal.radius} um and height up to {tallest(petal):.1f} um, leaning up to {petal.lean} deg, reach "
            f"{reach:.2f} um from their axis: expected at most half the pitch, {petal.pitch / 2} um; take a smaller radius, height or lean"
        )
    return petal


def tallest(petal: Petal) -> float:
    """Greatest possible height of a dome [um]; 0 for a flat petal."""
    return petal.height * (1 + petal.height_spread) if petal.radius > 0 else 0.0
