"""The `lidarpainter` command: global options, groups, and how errors end it.

Exit codes: 0 on success, 2 for input that cannot be used (one line on stderr), 1 for anything
unexpected, 130 after Ctrl-C and 143 after SIGTERM. Commands import what they need when they run, so
that help is fast.
"""

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from catalog.errors import CatalogError
from catalog.store import DEFAULT_STORE, STORE_ENVIRONMENT
from flows.cli import (
    assets,
    bundle,
    catalog,
    demo,
    doctor,
    drive,
    edit,
    evaluate,
    export,
    fleet,
    ingest,
    label,
    lidar_model,
    localise,
    measure,
    painter,
    reconstruct,
    render,
    rig,
    serve,
    settings,
    stylize,
    view,
)
from flows.cli.output import Loudness, complain, loudness, set_loudness
from flows.environment import keep_prefect_in, prepare_environment
from flows.interruption import Interrupted, goes_on, is_interrupted, message
from lidarpainter_models import __version__
from lidarpainter_models.errors import ConfigError, LidarPainterError

BAD_INPUT = 2
UNEXPECTED = 1
INTERRUPTED = 130
LOG_LEVELS: dict[Loudness, str] = {"quiet": "CRITICAL", "usual": "CRITICAL", "verbose": "WARNING"}
"""Log levels of Prefect: its errors reach the user as one line of ours, not as its traceback."""
GLOBAL_OPTIONS = ("--store",)
GLOBAL_FLAGS = ("--debug", "--quiet", "--verbose", "-v")

USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""The parent of typer's errors about words; it has no public name in every version of typer."""
NO_WORDS = "NoArgsIsHelpError"


class OneLineGroup(TyperGroup):
    """The whole command; what it cannot read is raised instead of drawn in a box."""

    def main(self, *args: Any, **options: Any) -> Any:  # noqa: ANN401 - as typer has it
        """Run a command and leave with its code.

        Raises:
            ConfigError: an option or argument is missing, unknown or of the wrong kind.
        """
        try:
            code = super().main(*args, **{**options, "standalone_mode": False})
        except USAGE_ERROR as error:
            if type(error).__name__ == NO_WORDS:
                sys.stdout.write(error.ctx.get_help())
                sys.exit(error.exit_code)
            place = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
            raise ConfigError(f"{error.format_message().rstrip('.')}{place}") from None
        sys.exit(code if isinstance(code, int) else 0)


app = typer.Typer(
    name="lidarpainter",
    help="Editable 3D Gaussian driving scenes that still look right a lane away.",
    cls=OneLineGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(demo.demo)
app.command("doctor")(doctor.doctor)
app.command("ingest")(ingest.ingest)
app.command("rig")(rig.rig)
app.command("reconstruct")(reconstruct.reconstruct)
app.command("settings")(settings.settings)
app.command("render")(render.render)
app.command("export")(export.export)
app.command("drive")(drive.drive)
app.command("check-bundle")(bundle.check_bundle)
app.command("stylize")(stylize.stylize)
app.command("lidar-model")(lidar_model.lidar_model)
app.command("localise")(localise.localise)
app.command("label")(label.label)
app.command("edit")(edit.edit)
app.command("view")(view.view)
app.command("serve")(serve.serve)
app.command("evaluate")(evaluate.evaluate)
app.command("chart")(measure.chart)
app.command("size")(measure.size)
app.command("stress")(measure.stress)
app.command("figures")(measure.figures)
app.add_typer(painter.app, name="painter")
app.add_typer(fleet.app, name="fleet")
app.add_typer(assets.app, name="assets")
app.add_typer(catalog.app, name="catalog")


def _print_version(asked: bool) -> None:
    if asked:
        sys.stdout.write(f"lidarpainter {__version__}\n")
        raise typer.Exit


@app.callback()
def options(
    store: Annotated[
        Path | None,
        typer.Option(
            help="The store that everything is kept in: a folder, or s3://BUCKET/PREFIX; "
            "./lidarpainter-store if absent.",
            envvar=STORE_ENVIRONMENT,
            show_default=False,
        ),
    ] = None,
    debug: Annotated[  # noqa: ARG001 - `main` reads it; here it is only documented
        bool, typer.Option("--debug", help="Show tracebacks and the log of Prefect.")
    ] = False,
    quiet: Annotated[  # noqa: ARG001 - likewise
        bool, typer.Option("--quiet", help="Show no progress and no hints on stderr, only errors.")
    ] = False,
    verbose: Annotated[  # noqa: ARG001 - likewise
        bool,
        typer.Option(
            "--verbose",
            "-v",
            help="Say what each stage depends on and where it lies, and show warnings and details.",
        ),
    ] = False,
    version: Annotated[  # noqa: ARG001 - its callback answers
        bool,
        typer.Option(
            "--version", help="Print the version and end.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Options of every command; they may also stand after it."""
    if store is not None:
        os.environ[STORE_ENVIRONMENT] = str(store)  # for every later `open_store()`
    keep_prefect_in(os.environ.get(STORE_ENVIRONMENT) or DEFAULT_STORE)


def main(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    goes_on()
    words = globals_first(arguments)
    chosen = {word for word in words if word in GLOBAL_FLAGS}
    is_debug = "--debug" in chosen
    set_loudness(_loudness_of(chosen))
    prepare_environment(log_level=None if is_debug else LOG_LEVELS[loudness()])
    try:
        app(args=words, prog_name="lidarpainter")
    except Interrupted:
        return INTERRUPTED  # whoever answers signals says so, see `flows.interruption`
    except SystemExit as leaving:  # typer's way out of everything it knows, Ctrl-C included
        if leaving.code == INTERRUPTED:
            complain(message())
        return leaving.code if isinstance(leaving.code, int) else UNEXPECTED
    except (LidarPainterError, CatalogError) as error:
        _explain(error, str(error), is_debug=is_debug)
        return BAD_INPUT
    except Exception as error:  # noqa: BLE001 - the last resort of a command
        if is_interrupted():  # in a library that makes an error of it
            return INTERRUPTED
        hint = "" if is_debug else " (--debug shows where)"
        _explain(error, f"unexpected {type(error).__name__}: {error}{hint}", is_debug=is_debug)
        return UNEXPECTED
    return 0


def _loudness_of(flags: set[str]) -> Loudness:
    if flags & {"-v", "--verbose", "--debug"}:
        return "verbose"
    return "quiet" if "--quiet" in flags else "usual"


def globals_first(arguments: Sequence[str]) -> list[str]:
    """Move global options to the front, so that they may stand anywhere before a `--`."""
    front: list[str] = []
    rest: list[str] = []
    waiting = list(arguments)
    while waiting:
        word = waiting.pop(0)
        if word == "--":
            rest += [word, *waiting]
            break
        if word in GLOBAL_FLAGS or word.startswith(tuple(f"{name}=" for name in GLOBAL_OPTIONS)):
            front.append(word)
        elif word in GLOBAL_OPTIONS and waiting:
            front += [word, waiting.pop(0)]
        else:
            rest.append(word)
    return front + rest


def _explain(error: Exception, message: str, *, is_debug: bool) -> None:
    if is_debug:
        traceback.print_exception(error)
    complain(message)
