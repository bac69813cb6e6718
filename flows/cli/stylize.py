"""`lidarpainter stylize`: images of a run in fog, at night or in rain."""

from pathlib import Path
from typing import Annotated, Any

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
)


def stylize(  # noqa: PLR0913 - the options of a command
    run: RunName,
    prompt: Annotated[str, typer.Option(help="clear, foggy, night or rain.")],
    out: Annotated[Path, typer.Option(help="Folder for the images.")],
    trajectory: TrajectorySpec = "recorded",
    images: Annotated[
        str, typer.Option(help="rendered, or recorded: style what the camera saw.")
    ] = "rendered",
    camera: FollowedCamera = None,
    frames: FollowedFrames = None,
    width: Annotated[
        int | None, typer.Option(help="Width of the images in pixels; that of the fit if absent.")
    ] = None,
    painter: Annotated[
        str | None, typer.Option(help="Paint every image with this before it is styled.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Decides lit windows, drops and noise.", min=0)] = 0,
    as_json: AsJson = False,
) -> None:
    """Show a finished run in another weather or at night, and how well its edges are kept.

    Example: lidarpainter stylize latest --prompt foggy --out foggy
    """
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from tasks.runs import open_run

    followed, chosen = parse_trajectory(trajectory), parse_frames(frames)
    open_run(existing_store(), run)
    say_status(f"opening run {run}")
    check_painter(painter)
    from lidarpainter_models.painter.styles import check_prompt

    check_prompt(prompt)
    from flows.views import PathRequest, stylize_run

    path = PathRequest(
        run=run,
        trajectory=followed,
        camera=camera,
        frames=chosen,
        is_painted=painter is not None,
        painter=painter,
    )
    asked: Any = images  # the request says which there are
    with shown_progress():
        result = stylize_run(
            existing_store(),
            path,
            out.absolute(),
            prompt=prompt,
            images=asked,
            width_px=width,
            seed=seed,
        )
    if as_json:
        print_json(result)
    else:
        print_pairs(f"{prompt} images of {result['scene']}", result)
