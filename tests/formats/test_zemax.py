"""Zemax tabular BSDF, read back by a parser written from the specification, and its angles by vectors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting import DomainError, TableError
from fitting.formats.grid import Brdf
from fitting.formats.zemax import integrated, write_zemax


def lobes(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    i, r, p = map(np.radians, (theta_i, theta_r, phi))
    along, across = np.cos(i) * np.cos(r), np.sin(i) * np.sin(r) * np.cos(p)
    return 0.05 + 0.2 * np.maximum(along - across, 0) ** 8 + 0.1 * np.maximum(along + across, 0) ** 8


def forward(theta_i: Any, theta_r: Any, phi: Any) -> Any:
    i, r, p = map(np.radians, (theta_i, theta_r, phi))
    return 0.2 * np.maximum(-np.cos(i) * np.cos(r) - np.sin(i) * np.sin(r) * np.cos(p), 0) ** 5


def parse(path: Path) -> tuple[dict[str, str], dict[str, list[float]], list[float], Any]:
    """Read header, axes, TIS and values (incidence, azimuth, radial), line by line in the specification's order."""
    lines = [line for line in path.read_text().split("\n") if not line.startswith("#")]
    header = dict(line.split() for line in lines[:4])
    axes = {}
    for k, name in enumerate(("SampleRotation", "AngleOfIncidence", "ScatterAzimuth", "ScatterRadial")):
        said, count = lines[4 + 2 * k].split()
        axes[name] = [float(word) for word in lines[5 + 2 * k].split()]
        assert (said, int(count)) == (name, len(axes[name]))
    assert lines[12:15] == ["", header["SpectralContent"], "DataBegin"]
    body = iter(lines[15:])
    total, values = [], []
    for _ in axes["AngleOfIncidence"]:
        word, share = next(body).split()
        assert word == "TIS"
        total.append(float(share))
        values.append([[float(v) for v in next(body).split()] for _ in axes["ScatterAzimuth"]])
    assert list(body) == ["DataEnd", ""]
    return header, axes, total, np.array(values)


@pytest.mark.parametrize("through", [False, True])
def test_parsed_back(tmp_path: Path, through: bool) -> None:
    path = tmp_path / "petal.bsdf"
    function = forward if through else lobes
    write_zemax(path, function, through=through, name="a rose\npetal")
    assert path.read_text().startswith("#a rose petal\n")
    header, axes, total, values = parse(path)
    kind = "BTDF" if through else "BRDF"
    assert header == {"Source": "Measured", "Symmetry": "PlaneSymmetrical", "SpectralContent": "Monochrome", "ScatterType": kind}
    assert axes["SampleRotation"] == [0]
    down = -1 if through else 1
    for i, theta_i in enumerate(axes["AngleOfIncidence"]):
        light = np.array([np.sin(np.radians(theta_i)), 0, np.cos(np.radians(theta_i))])
        specular = light * [-1, 1, down]
        normal = np.array([0, 0, down])
        towards = normal - (normal @ specular) * specular if theta_i else np.array([1.0, 0, 0])
        towards /= np.linalg.norm(towards)
        sideways = np.array([0, 1, 0])
        for a, azimuth in enumerate(np.radians(axes["ScatterAzimuth"])):
            for r, radial in enumerate(np.radians(axes["ScatterRadial"])):
                view = np.cos(radial) * specular + np.sin(radial) * (np.cos(azimuth) * towards + np.sin(azimuth) * sideways)
                if abs(view[2]) < 1e-9:
                    continue  # on the horizon, to one side or the other
                theta_r, phi = np.degrees(np.arccos(view[2])), np.degrees(np.arctan2(view[1], view[0]))
                expected = function(theta_i, theta_r, phi) if view[2] * down > 0 else 0.0
                assert values[i, a, r] == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert np.all(values[:, 0, 0] > 0)
    assert total[0] == pytest.approx(integrated(function, 0, through=through), abs=1e-6)


def test_integral_of_known_functions() -> None:
    assert integrated(lambda i, r, p: 0.9 / np.pi + 0 * (i + r + p), 45) == pytest.approx(0.9, rel=1e-12)
    assert integrated(lambda i, r, p: np.cos(np.radians(r)) + 0 * (i + p), 10) == pytest.approx(2 * np.pi / 3, rel=1e-4)
    assert integrated(forward, 0, through=True) == pytest.approx(0.2 * 2 * np.pi / 7, rel=1e-4)


def test_bad_requests(tmp_path: Path) -> None:
    path = tmp_path / "petal.bsdf"
    wrongs: tuple[dict[str, Any], ...] = (
        {"theta_i_deg": [0, 90]},
        {"azimuth_deg": [0, 90]},
        {"radial_deg": [5, 10]},
        {"theta_i_deg": [20, 10]},
    )
    for wrong in wrongs:
        with pytest.raises(DomainError):
            write_zemax(path, lobes, **wrong)
    short = Brdf.sampled(lobes, [0, 80], [0, 40, 80], np.arange(0, 360, 30))
    with pytest.raises(DomainError, match="outside the grid"):
        write_zemax(path, short)
    turned = Brdf(np.array([0.0, 80]), np.array([0.0]), np.array([0.0, 90]), np.array([0.0, 180]), np.ones((2, 1, 2, 2, 1)))
    with pytest.raises(DomainError, match="not isotropic"):
        write_zemax(path, turned)
    with pytest.raises(TableError, match="cannot be written"):
        write_zemax(tmp_path / "nowhere" / "petal.bsdf", lobes)
    assert not list(tmp_path.iterdir())
