"""Rules of the whole house that no linter knows."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT, rig_environment

ROOMS = ("drivers", "sim", "fitting", "scanning", "render", "rig")
MODULES = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]


def public(tree: ast.Module) -> list[tuple[str, ast.AST]]:
    """Return the public functions and classes of a module, and the public methods of its public classes."""
    found: list[tuple[str, ast.AST]] = []
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            found.append((node.name, node))
            if isinstance(node, ast.ClassDef):
                methods = [m for m in node.body if isinstance(m, ast.FunctionDef | ast.AsyncFunctionDef) and not m.name.startswith("_")]
                found += [(f"{node.name}.{method.name}", method) for method in methods]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_is_public_has_a_docstring(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree) or not tree.body
    bare = [name for name, node in public(tree) if not ast.get_docstring(node)]  # type: ignore[arg-type]
    assert bare == []


def test_no_import_does_work() -> None:
    # Importing every light module at once stays light: nothing pulls in what only a command needs.
    light = "rig.cli.main, rig.config, rig.runs, rig.journal, drivers, drivers.catalogue, fitting, sim.petals"
    code = f"import sys, {light}; print([m for m in ('bluesky', 'open3d', 'numba', 'matplotlib', 'scipy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_an_installed_rig_works_with_its_data_files(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    source = tmp_path / "source"
    # A copy: building leaves folders behind.
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    for name in names:
        if (ROOT / name).exists():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    subprocess.run([*pip, "install", "--no-deps", "--no-build-isolation", "--target", str(tmp_path / "site"), str(source)], check=True)
    environment = rig_environment() | {"PYTHONPATH": str(tmp_path / "site")}
    work = tmp_path / "work"
    work.mkdir()

    def rig(*arguments: str) -> str:
        command = [sys.executable, "-m", "rig", *arguments]
        return subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True, check=True).stdout

    assert (
        str(tmp_path / "site")
        in subprocess.run(
            [sys.executable, "-c", "import rig; print(rig.__file__)"], cwd=work, env=environment, capture_output=True, text=True, check=True
        ).stdout
    )
    rig("init", "--out", "mine.toml")
    rig("sweep", "--cultivar", "WR", "--theta-r", "-40:40:40")
    assert "WR" in rig("runs")


@pytest.mark.skipif(not (ROOT / ".venv" / ".test").exists(), reason="this environment was not made by .ci/setup")
def test_a_second_set_up_installs_nothing() -> None:
    done = subprocess.run([str(ROOT / ".ci" / "setup"), "test"], capture_output=True, text=True, check=True, timeout=10)
    assert done.stdout + done.stderr == ""


def test_no_committed_file_names_a_package_index() -> None:
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    for name in names:
        if name.endswith((".lock", ".toml", ".in", "Makefile")) or name.startswith(".ci/"):
            assert "index-url" not in (ROOT / name).read_text(encoding="utf-8").replace("--no-emit-index-url", "")
