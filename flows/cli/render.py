"""`lidarpainter render`: images of a run along a trajectory."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.output import print_json, print_pairs
from flows.cli.shared_options import (
    AllowCollisions,
    AsJson,
    BesideWhat,
    FollowedCameras,
    FollowedFrames,
    Fps,
    ImageWidth,
    PostpaintPainter,
    RunName,
    TrajectorySpec,
    followed_path,
    parse_previous,
    with_told_collisions,
)
from lidarpainter_models.errors import ConfigError

Postpaint = Annotated[
    bool, typer.Option("--postpaint", help="Paint every image; renders go to `unpainted/`.")
]

Prompt = Annotated[
    str, typer.Option(help="What a painter that was trained for styles is asked for.")
]
Previous = Annotated[
    str | None,
    typer.Option(help="Lean on the image painted before: mixed into the next, or shown."),
]
Video = Annotated[
    bool, typer.Option("--video", help="Add video.mp4: a film of each camera, and one of all.")
]
Depth = Annotated[bool, typer.Option("--depth", help="Add depth: 16-bit PNG, 256ths of a metre.")]
Semantics = Annotated[
    bool, typer.Option("--semantics", help="Add who is where: 16-bit PNG and a legend.")
]


def render(  # noqa: PLR0913 - the options of a command
    run: RunName,
    trajectory: TrajectorySpec,
    out: Annotated[Path, typer.Option(help="Folder for the images.")],
    camera: FollowedCameras = None,
    frames: FollowedFrames = None,
    width: ImageWidth = None,
    postpaint: Postpaint = False,
    painter: PostpaintPainter = None,
    prompt: Prompt = "clear",
    previous: Previous = None,
    video: Video = False,
    fps: Fps = None,
    depth: Depth = False,
    semantics: Semantics = False,
    beside: BesideWhat = None,
    allow_collisions: AllowCollisions = False,
    as_json: AsJson = False,
) -> None:
    """Render a finished run where nobody drove.

    Example: lidarpainter render latest --trajectory lateral:2 --postpaint --out pictures

    Down a lane and up: lidarpainter render latest --trajectory lane-change:-3.5+up:1 --out p

    A film: lidarpainter render latest --trajectory lateral:2 --video --beside recorded --out p
    """
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from lidarpainter_models.conditioning.settings import SequenceConfig

    if fps is not None and not video:
        raise ConfigError("--fps needs --video")
    sequence, *others = parse_previous(previous) or (SequenceConfig(),)
    if others:
        raise ConfigError(f"--previous {previous!r}: expected one of them here")
    path = followed_path(
        run,
        trajectory,
        frames,
        painter,
        camera=camera,
        is_painted=postpaint or painter is not None,
        allows_collisions=allow_collisions,
        width_px=width,
        beside=beside,
    )
    from flows.views import render_run
    from tasks.views.files import ViewKinds

    kinds = ViewKinds(depth=depth, semantics=semantics, video=video, fps=fps)
    with shown_progress():
        result = render_run(
            existing_store(), path, out.absolute(), prompt=prompt, sequence=sequence, kinds=kinds
        )
    _say(result, as_json=as_json)


def _say(result: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print_json(result)
    else:
        print_pairs(f"images of {result['scene']}", with_told_collisions(result))
