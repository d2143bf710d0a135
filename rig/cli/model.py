"""`rig model`."""

import csv
import sys

import click

from rig.trajectory import parse_angles


@click.group(epilog="\b\nExample:\n  rig model eval --mode paper --theta-i 45 --theta-r -70:70:10")
def command() -> None:
    """Evaluate the reflection model itself."""


@command.command(
    "eval",
    epilog="""\b
Examples:
  rig model eval --mode paper --theta-i 45 --theta-r -70:70:10
  rig model eval --aspect 1.9 > r.csv
  rig model eval --mode radiometric --aspect 1.9 --phi 90 --theta-r 0:80:10
  rig model eval --mode radiometric --aspect 1.2 --p 1.3 --q 1.6 --gap 0.1""",
)
@click.option(
    "--mode",
    type=click.Choice(["paper", "radiometric"]),
    default="paper",
    show_default=True,
    help="The paper's four r' of eq. (7), or single bounce in 1/sr, floor and foreshortening included.",
)
@click.option("--theta-i", default="45", show_default=True, metavar="DEG", help="Angle of the light.")
@click.option("--theta-r", default="-70:70:10", show_default=True, metavar="DEG", help="Angles of the view, positive on the light's side.")
@click.option("--phi", default=0.0, show_default=True, metavar="DEG", help="Azimuth of the view from the light's; 0 is in plane.")
@click.option(
    "--aspect", type=click.FloatRange(0.01, 10), default=0.5, show_default=True, help="Height over width of the domes; 0.5 is a hemisphere."
)
@click.option("--p", type=click.FloatRange(1, 100), default=2.0, show_default=True, help="Profile z = h (1 - (r/a)^p)^(1/q): p.")
@click.option("--q", type=click.FloatRange(1, 100), default=2.0, show_default=True, help="The same: q; 2 and 2 is an ellipsoid.")
@click.option("--gap", type=click.FloatRange(0, 10), default=0.0, show_default=True, help="Flat floor between domes, over their width.")
def evaluate(mode: str, theta_i: str, theta_r: str, phi: float, aspect: float, p: float, q: float, gap: float) -> None:
    """Write the model's terms as CSV to stdout."""
    import numpy as np

    from fitting.cells import Cell
    from fitting.paper import TERMS, paper_terms
    from fitting.radiometric import BASES, paper_terms_any, radiometric_terms

    incidences, views = parse_angles(theta_i, "--theta-i"), parse_angles(theta_r, "--theta-r")
    cell = Cell(aspect, p, q, gap)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    several = len(incidences) > 1
    writer.writerow([*(["theta_i_deg"] if several else []), "theta_r_deg", *(TERMS if mode == "paper" else BASES)])
    for incidence in incidences:
        light, view_at = np.full(len(views), incidence), np.array(views)
        if mode == "radiometric":
            terms = radiometric_terms(light, view_at, phi, cell=cell)
        elif phi == 0 and cell == Cell(aspect):
            terms = paper_terms(light, view_at, aspect=aspect)  # in plane there is a sharper rule
        else:
            terms = paper_terms_any(light, view_at, phi, cell=cell)
        for view, row in zip(views, terms, strict=True):
            writer.writerow([*([f"{incidence:g}"] if several else []), f"{view:g}", *(f"{value:.6g}" for value in row)])
