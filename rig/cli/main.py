"""`rig`: global options, lazy commands, errors in one line, exit codes."""

import importlib
import sys
import traceback

import click

from rig.cli.settings import Settings
from rig.errors import ConfigError, Interrupted, RigError
from rig.workspace import Workspace

COMMANDS = {
    "init": ("rig.cli.init", "Write a commented rig.toml to start from."),
    "sweep": ("rig.cli.sweep", "Measure how a petal reflects light by angle."),
    "devices": ("rig.cli.devices", "List the supported instruments; ask the bench's who they are."),
    "status": ("rig.cli.status", "Say where every axis stands and what it was last told."),
    "home": ("rig.cli.home", "Find the reference of axes."),
    "move": ("rig.cli.move", "Send an axis to a position."),
    "stop": ("rig.cli.stop", "Stop every axis, also those another rig command moves."),
    "read": ("rig.cli.read", "Take readings from sensors."),
    "runs": ("rig.cli.runs", "List, show and annotate stored runs."),
    "cultivars": ("rig.cli.cultivars", "List the known cultivars, or add one."),
    "fit": ("rig.cli.fit", "Fit the paper's reflection model to a run or a table."),
    "brdf": ("rig.cli.brdf", "Convert files of reflectance, and fits, for other programs."),
    "model": ("rig.cli.model", "Evaluate the reflection model itself."),
    "scan": ("rig.cli.scan", "Turn range images of petals into meshes."),
    "flower": ("rig.cli.flower", "Put scanned petals together into a flower."),
    "view": ("rig.cli.view", "Show a flower in the browser."),
    "render": ("rig.cli.render", "Ray-cast a flower with a fitted reflectance."),
    "figures": ("rig.cli.figures", "Draw the paper's figures from the newest fits."),
    "sim": ("rig.cli.sim", "Serve simulated instruments to any software."),
    "demo": ("rig.cli.demo", "The whole chain on the simulated bench."),
}


class LazyGroup(click.Group):
    """Knows its commands by name and one line; imports only the one that is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command that was called."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(COMMANDS[cmd_name][0]).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; a wrong name gets the known ones."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            raise click.UsageError(f"no command {args[0]!r}; there are {', '.join(COMMANDS)}", ctx)
        return super().resolve_command(ctx, args)


@click.command(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="""\b
Examples:
  rig demo                        the whole chain, simulated
  rig sweep --cultivar RR         15 angles at 45 deg
  rig fit latest                  the four coefficients of the newest run
  rig figures                     the paper's figures

Without a rig.toml the bench is simulated, and everything made with it says SIMULATED.""",
)
@click.option("--workspace", metavar="DIR", help="Where runs, fits and figures live [default: $RIG_HOME, else ./rig-data].")
@click.option("--config", metavar="FILE", help="The bench's configuration [default: ./rig.toml, else the simulated bench].")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.version_option(package_name="petal-rig", prog_name="rig")
@click.pass_context
def cli(ctx: click.Context, workspace: str | None, config: str | None, debug: bool) -> None:
    """Measure how petals reflect light, fit the micro-structure model, draw what comes out."""
    ctx.obj = Settings(Workspace.locate(workspace), config, debug)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 usage or configuration, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        result = cli.main(args=arguments, prog_name="rig", standalone_mode=False)
        sys.exit(result if isinstance(result, int) else 0)
    except click.exceptions.Exit as exc:
        sys.exit(exc.exit_code)
    except click.UsageError as exc:
        where = f" ({exc.ctx.command_path} --help tells more)" if exc.ctx else ""
        _fail(exc.format_message() + where, 2)
    except click.ClickException as exc:
        _fail(exc.format_message(), 1)
    except ConfigError as exc:
        _fail(_said(exc), 2, exc, arguments)
    except (Interrupted, KeyboardInterrupt, click.Abort) as exc:
        _fail(f"interrupted{f': {_said(exc)}' if _said(exc) else ''}", 130)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)
    except Exception as exc:
        name = _name(exc)
        if name is None:
            raise
        _fail(f"{name}{_said(exc)}", 1, exc, arguments)


def _said(exc: BaseException) -> str:
    """Return an error's text with what was added on its way: that an axis could not be stopped, say."""
    return "; ".join(filter(None, [str(exc), *getattr(exc, "__notes__", ())]))


def _name(exc: Exception) -> str | None:
    """Return what to call an error: '' for our own, which are plain sentences; None for one that should not be.

    Rooms that were not used are not imported.
    """
    if isinstance(exc, RigError):
        return ""
    for module, root in (
        ("drivers.errors", "DeviceError"),
        ("fitting.errors", "FitError"),
        ("scanning.errors", "ScanError"),
        ("render.errors", "RenderError"),
    ):
        if module in sys.modules and isinstance(exc, getattr(sys.modules[module], root)):
            return f"{type(exc).__name__ if root == 'DeviceError' else root}: "  # a device's trouble is known by its own name
    return None


def _fail(message: str, code: int, exc: Exception | None = None, arguments: list[str] | None = None) -> None:
    if exc is not None and arguments is not None and "--debug" in arguments:
        traceback.print_exception(exc)
    print(f"rig: {message}", file=sys.stderr)
    sys.exit(code)
