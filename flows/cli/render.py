"""`lidarpainter render`: images of a run along a trajectory."""

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, print_pairs, say_status
from flows.cli.shared_options import (
    AsJson,
    FollowedCamera,
    FollowedFrames,
    RunName,
    TrajectorySpec,
    check_painter,
    parse_frames,
    parse_previous,
)

Postpaint = Annotated[
    bool, typer.Option("--postpaint", help="Paint every image; renders go to `unpainted/`.")
]


def render(  # noqa: PLR0913 - the options of a command
    run: RunName,
    trajectory: TrajectorySpec,
    out: Annotated[Path, typer.Option(help="Folder for the images.")],
    camera: FollowedCamera = None,
    frames: FollowedFrames = None,
    postpaint: Postpaint = False,
    painter: Annotated[
        str | None, typer.Option(help="Painter for --postpaint; the run's own if absent.")
    ] = None,
    prompt: Annotated[
        str, typer.Option(help="What a painter that was trained for styles is asked for.")
    ] = "clear",
    previous: Annotated[
        str | None,
        typer.Option(help="Lean on the image painted before: mixed into the next, or shown."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Render a finished run where nobody drove.

    Example: lidarpainter render latest --trajectory lateral:2 --postpaint --out pictures

    Down a lane and up: lidarpainter render latest --trajectory lane-change:-3.5+up:1 --out p
    """
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from lidarpainter_models.conditioning.settings import SequenceConfig
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from tasks.runs import open_run

    followed, chosen = parse_trajectory(trajectory), parse_frames(frames)
    sequence = SequenceConfig() if previous is None else parse_previous(previous)[0]
    open_run(existing_store(), run)
    say_status(f"opening run {run}")
    check_painter(painter)
    from flows.views import PathRequest, render_run

    path = PathRequest(
        run=run,
        trajectory=followed,
        camera=camera,
        frames=chosen,
        is_painted=postpaint or painter is not None,
        painter=painter,
    )
    with shown_progress():
        result = render_run(
            existing_store(),
            path,
            out.absolute(),
            prompt=prompt,
            sequence=sequence,
        )
    if as_json:
        print_json(result)
    else:
        print_pairs(f"images of {result['scene']}", result)
