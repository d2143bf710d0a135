"""Catalogue of instrument models: those built in and those of other packages.

Other packages add models through the entry-point group `GROUP`; an entry point loads to a `DeviceModel` or an iterable of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType

from drivers.builtin import BUILT_IN
from drivers.errors import CatalogueError, UnknownModel
from drivers.models import DeviceModel, did_you_mean

GROUP = "rig.devices"


@dataclass(frozen=True)
class Catalogue:
    """All models found, and what was wrong with those that could not be taken."""

    models: Mapping[str, DeviceModel]
    problems: tuple[CatalogueError, ...] = ()

    def lookup(self, name: str) -> DeviceModel:
        """Find a model by name.

        Raises
        ------
        UnknownModel
            There is none; the message lists those there are, and the entry points that failed.
        """
        if name in self.models:
            return self.models[name]
        hints = [did_you_mean(name, self.models), *map(str, self.problems)]
        known = ", ".join(sorted(self.models))
        raise UnknownModel(f"unknown model {name!r}", expected=f"any of {known}", hint="; ".join(filter(None, hints)))


def load() -> Catalogue:
    """Collect the built-in models and those of installed packages.

    A package cannot take a built-in model's name. When two packages use the same name, neither has it. Either is a problem
    in the catalogue and harms no other model.
    """
    models = {model.name: model for model in BUILT_IN}
    origins = dict.fromkeys(models, "the built-in models")
    contested: set[str] = set()
    problems: list[CatalogueError] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)):
        origin = _origin(entry)
        try:
            added = _load_entry(entry)
        except Exception as error:  # whatever a stranger's import raises
            problems.append(CatalogueError(f"{origin} is broken: {type(error).__name__}: {error}", hint="mend or uninstall the package"))
            continue
        for model in added:
            if models.get(model.name) is model:
                continue
            if model.name in origins:
                clash = f"{origin} and {origins[model.name]} both name a model {model.name!r}"
                problems.append(CatalogueError(clash, hint="uninstall one of the packages"))
                contested.add(model.name)
                continue
            models[model.name] = model
            origins[model.name] = origin
    built_in = {model.name for model in BUILT_IN}
    usable = {name: model for name, model in models.items() if name in built_in or name not in contested}
    return Catalogue(MappingProxyType(usable), tuple(problems))


def lookup(name: str) -> DeviceModel:
    """Find a model by name among all there are; see `Catalogue.lookup`."""
    return load().lookup(name)


def _load_entry(entry: EntryPoint) -> list[DeviceModel]:
    loaded = entry.load()
    added = [loaded] if isinstance(loaded, DeviceModel) else list(loaded) if isinstance(loaded, Iterable) else [loaded]
    for model in added:
        if not isinstance(model, DeviceModel):
            raise TypeError(f"it holds a {type(model).__name__}, not a DeviceModel")
    return added


def _origin(entry: EntryPoint) -> str:
    package = f" of {entry.dist.name}" if entry.dist is not None else ""
    return f"entry point {entry.name} = {entry.value}{package}"
