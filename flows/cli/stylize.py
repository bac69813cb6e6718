"""`lidarpainter stylize`: images of a run in fog, at night or in rain."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.output import print_json, print_pairs
from flows.cli.shared_options import AsJson, FollowedCamera, FollowedFrames, RunName, TrajectorySpec


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
    """Show a finished run in another weather or at night, and how well its edges are kept."""
    from dataclasses import replace

    from catalog.store import open_store
    from flows.cli.ingest import parse_frames
    from flows.cli.progress import shown_progress
    from flows.parameters import view_parameters
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from tasks.runs import open_run
    from tasks.views.render import RenderRequest
    from tasks.views.stylize import StylizeRequest
    from tasks.views.stylize import stylize as stylize_task

    path = parse_trajectory(trajectory)
    store = open_store()
    finished = open_run(store, run)
    parameters = view_parameters(finished)
    observation = parameters.observation
    if width is not None:
        observation = replace(observation, width_px=width)
    view = RenderRequest(
        trajectory=path,
        camera=camera,
        frames=parse_frames(frames),
        painter=painter,
        observation=observation,
        conditions=parameters.conditions,
    )
    asked: Any = images  # the request says which there are
    request = StylizeRequest(prompt=prompt, view=view, images=asked, seed=seed)
    with shown_progress():
        made = stylize_task.fn(store.root, finished, request, out.absolute())
    result = {"run_id": finished.run_id, "prompt": prompt, "trajectory": path.spec, **made}
    if as_json:
        print_json(result)
    else:
        print_pairs(f"{prompt} images of {finished.scene_id}", result)
