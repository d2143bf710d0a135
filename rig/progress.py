"""A sweep on the screen: a live table above a bar with the time left. All of it on stderr."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rig.units import engineering

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.interrupts import Interrupts

HEADER = f"{'reading':>8} {'theta_i':>9} {'theta_r':>9} {'reading':>12}"


class SweepScreen:
    """Watches a sweep for the technician.

    A row appears only once its reading is on the disk: a row on the screen is a reading in the run.

    Parameters
    ----------
    total : int
        Readings to come.
    title : str
    ask : bool
        True where somebody sits at the terminal.
    """

    def __init__(self, total: int, title: str, *, ask: bool) -> None:
        self.ask = ask
        self.console = Console(stderr=True, highlight=False)
        self._total = total
        self._title = title
        self._units: dict[str, str] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._task = self._progress.add_task(title, total=total)
        self._seen = 0

    def __enter__(self) -> "SweepScreen":
        self.console.print(self._title)
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None) -> None:
        self._progress.stop()

    def opened(self, bench: "Bench") -> None:
        """Say what will happen before the first reading."""
        for notice in bench.notices:
            self.console.print(f"note: {notice}", soft_wrap=True)
        lost = [name for name, axis in bench.axes.items() if not axis.homed]
        if lost:
            self.console.print(f"homing {', '.join(lost)}")

    def document(self, name: str, doc: Mapping[str, Any]) -> None:
        """Show a reading that has been stored."""
        if name == "start":
            self.console.print(HEADER)
        elif name == "descriptor":
            self._units = {key: data.get("units", "") for key, data in doc["data_keys"].items()}
        elif name == "event":
            self._seen += 1
            data = doc["data"]
            value = engineering(data["current"], self._units["current"]) if data["current_good"] else "out of range"
            self.console.print(f"{self._seen:>8} {data['theta_i']:>9.3f} {data['theta_r']:>9.3f} {value:>12}")
            self._progress.update(self._task, completed=self._seen)

    def decide(self, interrupts: "Interrupts") -> bool:
        """Ask whether to go on."""
        from rig.interrupts import ask_at_terminal

        self._progress.stop()
        goes_on = ask_at_terminal(interrupts)
        if goes_on:
            self._progress.start()
        return goes_on


@contextmanager
def steps(what: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar with the time left on stderr; yields `progress(done, total, name)`."""
    console = Console(stderr=True, highlight=False)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what)
        yield lambda done, total, name: bar.update(task, completed=done, total=total, description=f"{what} {name}".rstrip())
