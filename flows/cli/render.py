"""`lidarpainter render`: images of a run along a trajectory."""

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
    in_words,
    parse_frames,
    parse_previous,
    refuse_unused,
)
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from lidarpainter_models.export.view_requests import ViewRequest

WORDS = """
out: Folder that the images are written to.
postpaint: Paint every image; what it was painted from is written to `unpainted/`.
prompt: What a painter that was trained for styles is asked for: clear, foggy, night or rain; other
  painters know clear alone. Needs --postpaint or --painter.
previous: What becomes of the image painted before: unused, mixed (into what the next one is painted
  from), or shown (to the painter). Needs --postpaint or --painter.
video: Also write video.mp4, a film of each camera, and one of all together.
depth: Also write depth as 16-bit PNG, in 256ths of a metre.
semantics: Also write who is where, as 16-bit PNG with a legend.
lidar: Write simulated sweeps in place of images: of the log's own LiDAR (log), of a sensor by name
  (hdl-32e, hdl-64e, vlp-16, pandar64, pandar128, at128, os1-128), or of one in a .json file.
lidar_format: Files of the sweeps: pcd, pcd.bin, npz or parquet; the last two hold whom each point
  met.
"""

OF_IMAGES = ("--camera", "--width", "--painter", "--previous", "--fps", "--beside")
FLAGS_OF_IMAGES = ("--postpaint", "--video", "--depth", "--semantics", "--prompt")
"""The options that sweeps have no use for."""


@described(WORDS)
def render(  # noqa: PLR0913 - the options of a command
    run: str,
    trajectory: TrajectorySpec,
    out: Annotated[Path, typer.Option()],
    camera: str | None = None,
    frames: str | None = None,
    width: int | None = None,
    postpaint: bool = False,
    painter: str | None = None,
    prompt: str = "clear",
    previous: str | None = None,
    video: bool = False,
    fps: float | None = None,
    depth: bool = False,
    semantics: bool = False,
    beside: str | None = None,
    allow_collisions: bool = False,
    lidar: str | None = None,
    lidar_format: str = "pcd",
    as_json: AsJson = False,
) -> None:
    """Render a finished run where nobody drove.

    Example: lidarpainter render latest --trajectory lateral:2 --postpaint --out pictures

    Down a lane and up: lidarpainter render latest --trajectory lane-change:-3.5+up:1 --out p

    Sweeps of another LiDAR: lidarpainter render latest --trajectory up:1 --lidar vlp-16 --out s

    A film: lidarpainter render latest --trajectory lateral:2 --video --beside recorded --out p
    """
    _check_needs(fps is not None and not video, lidar_format != "pcd" and lidar is None)
    sequences, followed = parse_previous(previous), parse_frames(frames)
    if len(sequences) > 1:
        raise ConfigError(f"--previous {previous!r}: expected one of them here")
    run_id = checked_words(run, trajectory, painter)
    if lidar is not None:
        given = (camera, width, painter, previous, fps, beside)
        _refuse_of_images(given, (postpaint, video, depth, semantics, prompt != "clear"))
        _render_lidar(run_id, trajectory, lidar, lidar_format, followed, out, as_json=as_json)
        return
    from lidarpainter_models.conditioning.settings import SequenceConfig
    from lidarpainter_models.export.view_requests import ViewKinds, ViewRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory

    request = ViewRequest(
        trajectory=parse_trajectory(trajectory),
        camera=camera,
        frames=followed,
        width_px=width,
        is_painted=postpaint or painter is not None,
        painter=painter,
        prompt=prompt,
        sequence=sequences[0] if sequences else SequenceConfig(),
        allows_collisions=allow_collisions,
        beside=beside,
        kinds=ViewKinds(depth=depth, semantics=semantics, video=video, fps=fps),
    )
    _render_images(run_id, request, out, as_json=as_json)


def _check_needs(is_fps_alone: bool, is_format_alone: bool) -> None:
    """Refuse what says something of what is not asked for."""
    if is_fps_alone:
        raise ConfigError("--fps needs --video")
    if is_format_alone:
        raise ConfigError("--lidar-format needs --lidar")


def _render_images(run: str, request: "ViewRequest", out: Path, *, as_json: bool) -> None:
    """Write images along a trajectory."""
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.views import render_run

    with shown_progress():
        result = render_run(existing_store(), run, request, out.absolute())
    shown = result if as_json else in_words(result)
    print_result(f"images of {result['scene']}", shown, as_json=as_json)


def _refuse_of_images(given: Sequence[object], flags: Sequence[bool]) -> None:
    """Refuse what is said of images where sweeps are asked for, in the order of the options."""
    said = {name: value is not None for name, value in zip(OF_IMAGES, given, strict=True)}
    refuse_unused("--lidar", said | dict(zip(FLAGS_OF_IMAGES, flags, strict=True)))


def _render_lidar(
    run: str,
    trajectory: str,
    lidar: str,
    file_format: str,
    frames: slice | None,
    out: Path,
    *,
    as_json: bool,
) -> None:
    """Write sweeps in place of images."""
    from lidarpainter_models.export.formats import SWEEP_FORMATS
    from lidarpainter_models.lidar.sensors import read_sensor

    if file_format not in SWEEP_FORMATS:
        raise ConfigError(f"--lidar-format {file_format!r}: expected {', '.join(SWEEP_FORMATS)}")
    sensor = None if lidar == "log" else read_sensor(lidar)
    from lidarpainter_models.export.simulated_sweeps import SweepRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory

    request = SweepRequest(
        trajectory=parse_trajectory(trajectory),
        sensor=sensor,
        frames=frames,
        file_format=file_format,
    )
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.lidar import sweeps_of_run
    from tasks.runs import open_run

    store = existing_store()
    with shown_progress():
        result = sweeps_of_run(store, open_run(store, run), request, out.absolute())
    print_result(f"sweeps of {result['scene']}", result, as_json=as_json)
