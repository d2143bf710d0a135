"""Models kept in the workspace."""

import functools
from pathlib import Path

import numpy as np
import pytest

import fitting.model
from fitting.cells import Cell, Spread
from fitting.table import Grid
from rig.models import PETAL, model_path, stored_model
from rig.workspace import Workspace

SETTINGS = {"n_us": 4.0, "n_ss": 2.0, "grid": Grid(10, 9)}
CELL = Cell(0.6)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    workspace = Workspace(tmp_path_factory.mktemp("work"))
    stored_model(workspace, "paper", CELL, **SETTINGS)
    return workspace


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Modes that were built from here on."""
    done: list[str] = []
    build = fitting.model.build

    @functools.wraps(build)
    def counted(mode: str, *arguments: object, **settings: object) -> fitting.model.Model:
        done.append(mode)
        return build(mode, *arguments, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(fitting.model, "build", counted)
    return done


def test_a_stored_model_is_not_built_again(workspace: Workspace, builds: list[str]) -> None:
    path = model_path(workspace, "paper", CELL, **SETTINGS)
    before = path.stat().st_mtime_ns
    model = stored_model(workspace, "paper", CELL, **SETTINGS)
    assert builds == []
    assert path.stat().st_mtime_ns == before
    direct = fitting.model.build("paper", CELL, n_us=4, n_ss=2, grid=Grid(10, 9))
    assert np.array_equal(model.table.values, direct.table.values)


@pytest.mark.parametrize("harm", ["cut", "foreign", "changed", "older"])
def test_a_damaged_or_older_file_is_built_again_and_it_says_so(
    workspace: Workspace, builds: list[str], capsys: pytest.CaptureFixture[str], harm: str
) -> None:
    path = model_path(workspace, "paper", CELL, **SETTINGS)
    whole = path.read_bytes()
    if harm == "older":
        from fitting import archive

        about, arrays = archive.read(path, fitting.model.FORMAT)
        archive.write(path, "petal-rig model 0", about, arrays)
    else:
        middle = len(whole) // 2
        changed = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
        path.write_bytes({"cut": whole[:1000], "foreign": b"theta,phi\n", "changed": changed}[harm])
    model = stored_model(workspace, "paper", CELL, **SETTINGS)
    assert builds == ["paper"]
    said = capsys.readouterr().err
    assert str(path) in said.splitlines()[0]
    assert "building the paper model" in said
    assert np.array_equal(fitting.model.load(path).table.values, model.table.values)
    assert [file.name for file in workspace.models.iterdir()] == [path.name]


def test_a_file_is_named_for_what_its_model_depends_on(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)

    def of(mode: str, cell: Cell = CELL, **settings: object) -> str:
        return model_path(workspace, mode, cell, **settings).name

    assert of("paper").startswith("paper-")
    assert of("paper", Cell(1)) == of("paper", Cell(1.0), n_us=40, grid=Grid())
    others = {of("paper"), of("radiometric"), of("paper", n_us=30.0), of("paper", Cell(0.6, gap=0.1)), of("paper", grid=Grid(10, 9))}
    others.add(of("paper", Cell(0.6, gap=0.5, spread=Spread(0.1, place=0.1))))
    others.add(of("paper", Cell(0.6, gap=0.5, spread=Spread(0.1, place=0.1, seed=1))))
    assert len(others) == 7
    assert of("paper", depth=2.0) == of("paper")
    assert of("body", n_us=30.0) == of("body")
    assert len({of("body"), of("body", depth=2.0), of("body", lower=Cell()), of("body", n=1.5)}) == 4
    with pytest.raises(TypeError, match="colour"):
        of("paper", colour="red")


def test_a_failed_write_leaves_nothing_behind(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(model: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(fitting.model, "save", full)
    names = sorted(workspace.models.iterdir())
    with pytest.raises(OSError, match="no space"):
        stored_model(workspace, "paper", Cell(0.7), **SETTINGS)
    assert sorted(workspace.models.iterdir()) == names


def test_the_petal_to_draw_suits_every_mode() -> None:
    for mode in fitting.model.MODES:
        fitting.model.chosen(mode, PETAL[mode])
