"""Options: how commands tell what theirs mean, and how those that several have are read."""

import re
from collections.abc import Callable, Mapping
from copy import copy
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

import typer

from flows.cli.output import say_status, tell
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_words import trajectory_help
from lidarpainter_models.painter.known_painters import painter_help

if TYPE_CHECKING:
    from lidarpainter_models.conditioning.settings import SequenceConfig

Command = TypeVar("Command", bound=Callable[..., None])
RANGE = re.compile(r"(\d*):(\d*)")
PARAGRAPH = re.compile(r"^([\w.]+): (.*\n(?:  .*\n)*)", re.MULTILINE)

Painter = Annotated[
    str | None,
    typer.Option(
        help=f"Painter of the views beside the path: {painter_help()}. The preset's if absent."
    ),
]
Settings = Annotated[list[str] | None, typer.Option("--set")]
AsJson = Annotated[bool, typer.Option("--json")]
TrajectorySpec = Annotated[str, typer.Option(help=f"Where the camera goes: {trajectory_help()}")]

WORDS = """
as_json: Print one JSON object in place of tables.
scene: Scene as dataset/sequence, such as pandaset/002.
train_cameras: Names of the cameras to fit to, with commas between; all if absent.
accept_stale: Take what older code has made as it is, in place of making it again.
feature_weights: File with weights of SqueezeNet 1.1, for the feature distance; it is left out if
  absent.
run: The run: its id or the beginning of it, a scene such as pandaset/002 (its newest run), or
  latest (the newest run of all).
camera: Camera whose path is followed, several with commas between, or all; also cameras that no fit
  used. The first one fitted to if absent.
frames: Recorded frames to follow as A:B, B excluded, such as 0:40; all if absent.
width: Width of the images in pixels, at most as recorded; that of the fit if absent.
painter: Painter of the images, which it paints without --postpaint too: overlay, warp, nano, a
  .safetensors file, or a model. The run's own if absent.
fps: Images a second of the films; those of the recording if absent.
beside: What is shown to the left of every image: recorded, unpainted (before painting), or another
  run of the same scene.
allow_collisions: Let the camera go through what LiDAR saw standing there.
device: Where fits and painters run: auto (a GPU if there is one), cpu, cuda, or cuda:N for the N-th
  GPU.
settings: Changes one setting, such as fit.steps=500; `lidarpainter settings` lists them all. May be
  repeated.
"""

"""What a parameter of this name means in every command that says nothing else of it."""


def described(words: str = "") -> Callable[[Command], Command]:
    """Give the parameters of a command the help that a text has for them.

    The text has a paragraph `name: What it is.` for each of them, or `function.name: What it is.`
    where another command of the module means something else by the name. A parameter without a
    default is an argument, one with a default an option, unless its annotation says otherwise; a
    flag has no opposite.
    """
    known = {name: " ".join(text.split()) for name, text in PARAGRAPH.findall(WORDS + words)}

    def change(command: Command) -> Command:
        for name, parameter in signature(command).parameters.items():
            if text := known.get(f"{command.__name__}.{name}", known.get(name)):
                command.__annotations__[name] = _with_help(parameter, text)
        return command

    return change


def _with_help(parameter: Parameter, text: str) -> Any:  # noqa: ANN401 - any annotation
    hint, is_argument = parameter.annotation, parameter.default is Parameter.empty
    names = [f"--{parameter.name.replace('_', '-')}"] if hint is bool else []
    info = (typer.Argument if is_argument else typer.Option)(*names)
    if hasattr(hint, "__metadata__"):
        hint, info = hint.__origin__, copy(hint.__metadata__[0])
    info.help = info.help or text
    return Annotated[hint, info]


def named_run(name: str) -> str:
    """The id of a finished run; what `latest` or a scene stands for is said at once on stderr.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
        CatalogError: there is no store, or the run cannot be used.
    """
    from catalog.store import existing_store
    from tasks.runs import open_run

    run = open_run(existing_store(), name)
    if not run.run_id.startswith(name):
        kind = None if run.change is None else str(run.change["kind"])
        tell_run(name, run.run_id, run.scene_id, kind)
    say_status(f"opening run {run.run_id}")
    return run.run_id


def tell_run(name: str, run_id: str, scene_id: str, change: str | None) -> None:
    """Say on stderr which run a name stands for, unless silence is asked for."""
    kind = f" (changed: {change})" if change else ""
    tell(f"{name} is run {run_id} of {scene_id}{kind}")


def checked_words(run: str, trajectory: str, painter: str | None) -> str:
    """The id of the run; wrong words are refused before anything slow is imported.

    Raises:
        LidarPainterError: no such trajectory or painter.
        CatalogError: no such run.
    """
    from lidarpainter_models.geometry.trajectory_words import read_trajectory_words

    read_trajectory_words(trajectory)
    run_id = named_run(run)
    check_painter(painter)
    return run_id


def in_words(result: dict[str, Any]) -> dict[str, Any]:
    """What `render` gives, for a table: what the camera ran into, how far to trust the scene."""
    from lidarpainter_models.evaluation.view_confidence import GOOD_DB, PROMISED
    from lidarpainter_models.lidar.collisions import Collision

    met = "; ".join(str(Collision(**found)) for found in result["collisions"])
    shown = {**result, "collisions": met or "none"}
    trusted = shown.pop("num_trusted")
    if trusted is not None:
        shown["promised"] = (
            f"{trusted} of {result['num_images']} views: before any painting the scene shows them "
            f"with {GOOD_DB:g} dB or more, at a probability of at least {PROMISED:g}"
        )
    return shown


def refuse_unused(by: str, given: Mapping[str, bool]) -> None:
    """Refuse an option that is given and would change nothing.

    Raises:
        ConfigError: there is one.
    """
    if unused := [name for name, is_given in given.items() if is_given]:
        raise ConfigError(f"{by} has no use for {unused[0]}")


def parse_frames(text: str | None) -> slice | None:
    """`A:B`, `A:` or `:B` as a slice of frames.

    Raises:
        ConfigError: the text says something else.
    """
    if text is None:
        return None
    match = RANGE.fullmatch(text)
    if match is None:
        raise ConfigError(f"--frames {text!r}: expected A:B, such as 0:17")
    start, stop = (int(part) if part else None for part in match.groups())
    if stop is not None and stop <= (start or 0):
        raise ConfigError(f"--frames {text!r}: expected A < B")
    return slice(start, stop)


def parse_names(text: str | None, option: str = "names") -> tuple[str, ...] | None:
    """The names that an option lists with commas between.

    Raises:
        ConfigError: a name is empty.
    """
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ConfigError(f"{option} {text!r}: expected names with commas between")
    return names


def check_painter(name: str | None) -> None:
    """Refuse what no painter is called, before anything else is loaded.

    Raises:
        WeightsError: it cannot be the name of a painter.
    """
    if name is not None:
        from lidarpainter_models.painter.selection import PainterChoice

        PainterChoice.of(name)


def parse_previous(text: str | None) -> tuple["SequenceConfig", ...]:
    """What becomes of the frame before: `mixed`, `shown`, or both with a comma between.

    Raises:
        ConfigError: the text says something else.
    """
    from lidarpainter_models.conditioning.settings import PreviousUse, SequenceConfig

    if text is None:
        return ()
    names = dict.fromkeys(name.strip() for name in text.split(","))
    uses: dict[str, PreviousUse] = {use: use for use in get_args(PreviousUse)}
    if not names.keys() <= uses.keys():
        raise ConfigError(f"--previous {text!r}: expected {', '.join(uses)}")
    return tuple(SequenceConfig(previous=uses[name]) for name in names)


def parse_bytes(text: str) -> int:
    """The bytes of `--memory`, such as 6GB or 800MB.

    Raises:
        ConfigError: it is none.
    """
    return round(_amount("--memory", text, {"MB": 1e6, "GB": 1e9}, "a size such as 6GB"))


def parse_seconds(text: str) -> float:
    """The seconds of `--time-limit`, such as 90s, 10min or 2h.

    Raises:
        ConfigError: it is none.
    """
    return _amount(
        "--time-limit", text, {"s": 1.0, "min": 60.0, "h": 3600.0}, "a time such as 10min"
    )


def _amount(option: str, text: str, units: dict[str, float], expected: str) -> float:
    """A positive number with one of the units behind it, in the basic one."""
    found = re.fullmatch(rf"(\d+(?:\.\d+)?) ?({'|'.join(units)})", text.strip())
    if not found or float(found[1]) == 0:
        raise ConfigError(f"{option} {text!r}: expected {expected}, in {', '.join(units)}")
    return float(found[1]) * units[found[2]]
