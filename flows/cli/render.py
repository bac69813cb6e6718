"""`lidarpainter render`: images of a run along a trajectory."""

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, print_pairs
from flows.cli.shared_options import AsJson, FollowedCamera, FollowedFrames, RunName, TrajectorySpec


def render(  # noqa: PLR0913 - the options of a command
    run: RunName,
    trajectory: TrajectorySpec,
    out: Annotated[Path, typer.Option(help="Folder for the images.")],
    camera: FollowedCamera = None,
    frames: FollowedFrames = None,
    postpaint: Annotated[
        bool, typer.Option("--postpaint", help="Paint every image as well.")
    ] = False,
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
    """Render a finished run where nobody drove."""
    from catalog.store import open_store
    from flows.cli.flicker import parse_previous
    from flows.cli.ingest import parse_frames
    from flows.cli.progress import shown_progress
    from flows.parameters import view_parameters
    from lidarpainter_models.conditioning.sequences import SequenceConfig
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from tasks.runs import open_run
    from tasks.views.render import RenderRequest
    from tasks.views.render import render as render_task

    path = parse_trajectory(trajectory)
    store = open_store()
    finished = open_run(store, run)
    parameters = view_parameters(finished)
    request = RenderRequest(
        trajectory=path,
        camera=camera,
        frames=parse_frames(frames),
        painter=(painter or parameters.painter) if postpaint or painter else None,
        prompt=prompt,
        sequence=SequenceConfig() if previous is None else parse_previous(previous)[0],
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    with shown_progress():
        made = render_task.fn(store.root, finished, request, out.absolute())
    result = {
        "run_id": finished.run_id,
        "trajectory": path.spec,
        "painter": request.painter,
        "prompt": request.prompt,
        "previous": request.sequence.previous,
        **made,
    }
    if as_json:
        print_json(result)
    else:
        print_pairs(f"images of {finished.scene_id}", result)
