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
    epilog="\b\nExamples:\n  rig model eval --mode paper --theta-i 45 --theta-r -70:70:10\n  rig model eval --aspect 1.9 > r.csv",
)
@click.option("--mode", type=click.Choice(["paper"]), default="paper", show_default=True, help="Which of the model's modes.")
@click.option("--theta-i", default="45", show_default=True, metavar="DEG", help="Angle of the light.")
@click.option("--theta-r", default="-70:70:10", show_default=True, metavar="DEG", help="Angles of the view, positive on the light's side.")
@click.option(
    "--aspect", type=click.FloatRange(0.01, 10), default=0.5, show_default=True, help="Height over width of the domes; 0.5 is a hemisphere."
)
def evaluate(mode: str, theta_i: str, theta_r: str, aspect: float) -> None:
    """Write the four r' of eq. (7) as CSV to stdout."""
    import numpy as np

    from fitting.paper import paper_terms

    incidences, views = parse_angles(theta_i, "--theta-i"), parse_angles(theta_r, "--theta-r")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    several = len(incidences) > 1
    writer.writerow([*(["theta_i_deg"] if several else []), "theta_r_deg", "u_diff", "u_spec", "s_diff", "s_spec"])
    for incidence in incidences:
        terms = paper_terms(np.full(len(views), incidence), np.array(views), aspect=aspect)
        for view, row in zip(views, terms, strict=True):
            writer.writerow([*([f"{incidence:g}"] if several else []), f"{view:g}", *(f"{value:.6g}" for value in row)])
