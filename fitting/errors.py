"""What can go wrong when measurements meet the model."""

from __future__ import annotations

from pathlib import Path


class FitError(Exception):
    """Root of this package's errors: the readings do not suit the fit asked for."""


class DomainError(FitError):
    """A direction, a cell shape or a setting lies outside what the model describes."""


class EnergyError(FitError):
    """A reflectance would send back more light than falls on the petal."""


class ReadingError(FitError):
    """One reading cannot be used.

    Parameters
    ----------
    source : str
        Where the readings come from.
    row : int
        Its row in the source.
    problem : str
        What was found, what was expected and what to do.
    """

    def __init__(self, source: str, row: int, problem: str) -> None:
        self.source, self.row, self.problem = source, row, problem
        super().__init__(f"{source}, row {row}: {problem}")


class TableError(FitError):
    """A file of readings cannot be used as it stands.

    Parameters
    ----------
    path : Path or str
        The file.
    problem : str
        What was found, what was expected and what to do.
    line : int, optional
        Line of the file, from 1.
    """

    def __init__(self, path: Path | str, problem: str, line: int | None = None) -> None:
        self.path, self.problem, self.line = Path(path), problem, line
        super().__init__(f"{path}: {problem}" if line is None else f"{path}, line {line}: {problem}")
