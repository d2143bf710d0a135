"""Reflection models kept in the workspace: what is slow to work out is worked out once."""

import hashlib
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.workspace import Workspace

if TYPE_CHECKING:
    from fitting.cells import Cell
    from fitting.ladder import Traces
    from fitting.model import Model

PETAL: Mapping[str, Mapping[str, float]] = {
    # x of eq. (8) for the same petal as below: a reflectance over pi, and over 2 pi / (n + 2) for a lobe (n = 40 and 5).
    "paper": {"u_diff": 0.19, "u_spec": 0.33, "s_diff": 0.064, "s_spec": 0.056},
    "radiometric": {"u_diff": 0.6, "u_spec": 0.05, "s_diff": 0.2, "s_spec": 0.05},
    "interreflecting": {"albedo": 0.6, "u_spec": 0.05, "s_diff": 0.2, "s_spec": 0.05},
    "body": {"mu": 0.02, "R_m": 0.55, "T_m": 0.3, "D_m": 0.02},
}
"""A pale petal to draw where no other is given, for each mode; nobody measured it."""

TRACING = "body cells ladder orders power radiometric surface tracing"
"""Modules of fitting that what fits trace depends on."""


def stored_model(workspace: Workspace, mode: str, cell: "Cell", **settings: Any) -> "Model":
    """Return a model from the workspace, built and kept there where it is not.

    Parameters
    ----------
    workspace : Workspace
    mode, cell, **settings
        As `fitting.model.build` takes them.

    Raises
    ------
    DomainError
        If the geometry is outside of what the mode describes.
    """
    from fitting.errors import TableError
    from fitting.model import load

    path = model_path(workspace, mode, cell, **settings)
    if path.exists():
        try:
            return load(path)
        except TableError as exc:
            print(f"rig: {exc}", file=sys.stderr)
    model = built(mode, cell, **settings)
    store_model(model, path)
    print(f"stored in {path}", file=sys.stderr)
    return model


def model_path(workspace: Workspace, mode: str, cell: "Cell", **settings: Any) -> Path:
    """Return where the model of a geometry lies, named for its mode and the sum of what it depends on: settings, and fitting's own code."""
    of = _plain({"mode": mode, "cell": cell} | used(mode, settings))
    return workspace.models / f"{mode}-{_digest(json.dumps(of, sort_keys=True))}.npz"


def kept_traces(workspace: Workspace) -> "Traces":
    """Return what fits trace, kept in the workspace for this version of the code."""
    from fitting.ladder import Traces

    return Traces(workspace.models / f"traces-{_digest('traces', TRACING)}")


def _digest(of: str, modules: str = "*") -> str:
    """Name something made by fitting's code, or some of it, as it is now."""
    import fitting

    digest = hashlib.sha256(of.encode())
    for source in sorted(Path(fitting.__file__).parent.glob("*.py")):
        if modules == "*" or source.stem in modules.split():
            digest.update(source.read_bytes())
    return digest.hexdigest()[:12]


def used(mode: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a mode depends on, of `fitting.model.build`'s settings, those not given at their defaults."""
    import inspect

    from fitting.model import build
    from fitting.table import Grid

    known = {name: p.default for name, p in inspect.signature(build).parameters.items() if p.kind is p.KEYWORD_ONLY and name != "progress"}
    if unknown := set(settings) - set(known):
        raise TypeError(f"no settings {sorted(unknown)} of a model: expected some of {sorted(known)}")
    needless = {"n_us", "n_ss"} if mode == "body" else {"lower", "depth", "n"} | (set() if mode == "interreflecting" else {"seed"})
    found = {name: value for name, value in (known | dict(settings)).items() if name not in needless}
    return found | {"grid": found["grid"] or Grid()}


def built(mode: str, cell: "Cell", **settings: Any) -> "Model":
    """Build a model, with a bar on stderr."""
    from fitting.model import build
    from rig.progress import steps

    what = f"building the {mode} model, aspect {cell.aspect:g}"
    print(what, file=sys.stderr)
    with steps(what) as bar:
        return build(mode, cell, **used(mode, settings), progress=lambda share: bar(round(100 * share), 100, ""))


def store_model(model: "Model", path: Path) -> None:
    """Write a model so that a reader sees the old file or the new one, never half of one."""
    from fitting.model import save

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        save(model, temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """What JSON can hold; 40 and 40.0 are the same."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    return float(value) if isinstance(value, int | float) else value
