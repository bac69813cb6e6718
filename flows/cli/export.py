"""`lidarpainter export`: a run as files of other programs."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.output import print_result
from flows.cli.shared_options import (
    AsJson,
    TrajectorySpec,
    checked_words,
    described,
    parse_frames,
    parse_names,
    refuse_unused,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.formats import ExportFormat, export_format, formats_help
from lidarpainter_models.geometry.trajectory_words import RECORDED

if TYPE_CHECKING:
    from tasks.exports.scene import SceneRequest

FIGURES = {
    "psnr": "PSNR of what the file shows against the scene, dB, higher is better",
    "worst_psnr": "PSNR of the worst of three views, dB, higher is better",
    "psnr_reason": "why there is no PSNR",
}
"""What figures of an exported scene are of."""
OPTIONS = (
    *("--time", "--actors", "--per-actor", "--sky", "--spz-version"),
    *("--trajectory", "--camera", "--frames", "--width", "--postpaint", "--fps", "--beside"),
)
"""The options that some formats read: of scenes, then of views."""
SPZ_VERSION = 3
"""The version of SPZ that most programs read."""

Format = Annotated[
    str, typer.Option("--format", help=f"Format of the file or folder. {formats_help()}")
]

WORDS = """
run: The run, as other commands take it; for ncore also a scene that has none.
out: The file to write, or a new folder.
time: Moment at which actors stand where they are: seconds since the first image, such as 1.5, or
  frame:N, counted from 0.
actors: Ids of the actors to take along, with commas between, or none; all if absent.
per_actor: Write the street and every actor as PLY files of their own, into a new folder.
sky: Take the sky along, as far Gaussians.
spz_version: Version of SPZ: 3 or 4; fewer programs read 4.
postpaint: Paint every image that is rendered.
"""


@described(WORDS)
def export(  # noqa: PLR0913 - the options of a command
    run: str,
    format_: Format,
    out: Annotated[Path, typer.Option()],
    time: str = "0",
    actors: str | None = None,
    per_actor: bool = False,
    sky: bool = False,
    spz_version: int = SPZ_VERSION,
    trajectory: TrajectorySpec = RECORDED,
    camera: str | None = None,
    frames: str | None = None,
    width: int | None = None,
    postpaint: bool = False,
    painter: str | None = None,
    fps: float | None = None,
    beside: str | None = None,
    allow_collisions: bool = False,
    as_json: AsJson = False,
) -> None:
    """Write a finished run in a format that others read.

    Example: lidarpainter export latest --format gltf --out street.glb

    Images with poses: lidarpainter export latest --format colmap --out dataset --camera all

    A film of the whole rig: lidarpainter export latest --format video --camera all --out rig.mp4
    """
    row, followed = export_format(format_), parse_frames(frames)
    time_s, frame = parse_time(time)
    has_time, paints = time_s > 0 or frame is not None, postpaint or painter is not None
    of_scene = (has_time, actors, per_actor, sky, spz_version != SPZ_VERSION)
    of_views = (trajectory != RECORDED, camera, frames, width, paints, fps, beside)
    _refuse_unread(row, (*of_scene, *of_views))
    run_id = _subject(row, run, trajectory, painter)
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.exports import export_run
    from lidarpainter_models.export.view_requests import ViewKinds, ViewRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory

    scene = _scene_request((time_s, frame), actors, per_actor, sky, spz_version)
    request = ViewRequest(
        trajectory=parse_trajectory(trajectory),
        camera=camera,
        frames=followed,
        width_px=width,
        is_painted=paints,
        painter=painter,
        allows_collisions=allow_collisions,
        beside=beside,
        kinds=ViewKinds(fps=fps),
    )
    with shown_progress():
        result = export_run(
            existing_store(), run_id, row.name, request, out.absolute(), scene=scene
        )
    shown = {FIGURES.get(name, name): value for name, value in result.items()}
    print_result(f"{row.name} of {result['scene']}", result if as_json else shown, as_json=as_json)


def _subject(row: ExportFormat, run: str, trajectory: str, painter: str | None) -> str:
    """The id of the run; of a format of logs a scene's name stays one, with a run or without."""
    from catalog.store import existing_store

    is_scene = row.kind == "log" and run in existing_store().scene_ids()
    return run if is_scene else checked_words(run, trajectory, painter)


def _refuse_unread(row: ExportFormat, given: Sequence[object]) -> None:
    """Refuse options, in the order of `OPTIONS`, that are given and the format does not read."""
    values = zip(OPTIONS, given, strict=True)
    unread = {
        name: value is not None and value is not False
        for name, value in values
        if name not in row.options
    }
    refuse_unused(f"--format {row.name}", unread)


def _scene_request(
    moment: tuple[float, int | None],
    actors: str | None,
    is_per_actor: bool,
    with_sky: bool,
    spz_version: int,
) -> "SceneRequest":
    """What a format of scenes is asked for; the moment is in seconds or a position of a frame."""
    from tasks.exports.scene import SceneRequest

    return SceneRequest(
        time_s=moment[0],
        frame=moment[1],
        actors=parse_actors(actors),
        is_per_actor=is_per_actor,
        with_sky=with_sky,
        spz_version=spz_version,
    )


def parse_actors(text: str | None) -> tuple[str, ...] | None:
    """Ids with commas between; `none` for no actor, None for all.

    Raises:
        ConfigError: an id is empty.
    """
    return () if text == "none" else parse_names(text, "--actors")


def parse_time(text: str) -> tuple[float, int | None]:
    """`1.5` as seconds, `frame:12` as a position of the recorded frames.

    Raises:
        ConfigError: the text says something else.
    """
    if match := re.fullmatch(r"frame:(\d{1,9})", text):
        return 0.0, int(match[1])
    if re.fullmatch(r"\d{1,9}(\.\d{1,9})?", text):
        return float(text), None
    raise ConfigError(f"--time {text!r}: expected seconds such as 1.5, or frame:12")
