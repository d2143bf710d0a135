"""What can go wrong between a range image and a flower."""

from __future__ import annotations

from pathlib import Path


class ScanError(Exception):
    """Root of this package's errors: a scan, petal or flower that cannot be used as it is.

    Parameters
    ----------
    problem : str
        What was seen, in a few words.
    file : str or Path, optional
        File, or the petal's name where there is no file.
    line : int, optional
        Line of the file, from 1.
    expected : str
        What should have been there.
    hint : str
        What the user can do about it.
    """

    def __init__(
        self, problem: str, *, file: str | Path | None = None, line: int | None = None, expected: str = "", hint: str = ""
    ) -> None:
        super().__init__(problem)
        self.problem = problem
        self.file = None if file is None else str(file)
        self.line = line
        self.expected = expected
        self.hint = hint

    def __str__(self) -> str:
        where = self.file or ""
        if where and self.line is not None:
            where = f"{where}, line {self.line}"
        story = f"{where}: {self.problem}" if where else self.problem
        if self.expected:
            story += f"; expected {self.expected}"
        return f"{story}. {self.hint}" if self.hint else story


class FormatError(ScanError):
    """A file that does not follow its format."""


class EmptyScanError(ScanError):
    """A range image that holds no surface, or none after cleaning."""


class PetalError(ScanError):
    """A surface whose base, tip or midrib cannot be told."""


class RegistrationError(ScanError):
    """Scans whose overlap is too small, or too ambiguous, to trust their relative pose."""
