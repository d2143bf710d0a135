"""`rig view`, and how every command serves a page."""

import os
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.settings import Settings

if TYPE_CHECKING:
    from render.viewer import Page

port_option = click.option(
    "--port", default=0, metavar="N", type=click.IntRange(0, 65535), help="TCP port of the page [default: a free one]."
)
browser_option = click.option("--no-browser", is_flag=True, help="Only print the page's address.")


@click.command(epilog="\b\nExamples:\n  rig view rose\n  rig view rose --fit RR --port 8080 --no-browser")
@click.argument("folder", metavar="FLOWER", type=click.Path(path_type=Path))
@click.option("--fit", "wanted", metavar="FIT", help="Show it in this fit's hue: a cultivar (its newest fit), a fit's name, or its file.")
@port_option
@browser_option
@click.pass_obj
def command(settings: Settings, folder: Path, wanted: str | None, port: int, no_browser: bool) -> None:
    """Show an assembled flower on a page of this machine, until Ctrl-C."""
    from rig.flowerpages import view
    from rig.pictures import find_fit

    page, notes = view(folder, find_fit(settings.workspace.fits, wanted) if wanted else None, port=port)
    serve(page, notes, browser=not no_browser)


def serve(page: "Page", notes: Sequence[str], *, browser: bool, unsaved: Callable[[], list[str]] = list) -> None:
    """Print the page's address and serve it until Ctrl-C.

    Parameters
    ----------
    page : Page
        Closed at the end.
    notes : sequence of str
        What the page says of its flower, to be said here too.
    browser : bool
        Whether to open it in a browser, where there is a display.
    unsaved : callable
        What would be lost; while there is something, the first Ctrl-C at a terminal only says so.
    """
    with page:
        for note in notes:
            click.echo(note, err=True)
        click.echo(page.url)
        click.echo("Ctrl-C ends", err=True)
        if browser and _has_display():
            threading.Thread(target=_open, args=(page.url,), daemon=True).start()
        told: list[str] = []
        while True:
            try:
                page.wait()
            except KeyboardInterrupt:
                lost = unsaved()
                if not lost or lost == told or not sys.stdin.isatty():
                    break
                told = lost
                click.echo(f"moved and not saved: {', '.join(lost)}; save on the page, or Ctrl-C again to end without", err=True)
        if lost:
            click.echo(f"ended without saving where {', '.join(lost)} had been moved to", err=True)


def _has_display() -> bool:
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open(url: str) -> None:
    import webbrowser

    try:
        opened = webbrowser.open(url)
    except (webbrowser.Error, OSError):
        opened = False
    if not opened:
        click.echo("no browser could be opened: open the address above yourself", err=True)
