"""`lidarpainter stylize`: a run in fog, at night or in rain, as images or as a scene."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from flows.cli.output import print_json, print_pairs, print_result
from flows.cli.shared_options import (
    AllowCollisions,
    AsJson,
    FollowedCamera,
    FollowedFrames,
    RunName,
    TrajectorySpec,
    checked_words,
    parse_frames,
    refuse_unused,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.weather.mix import StyleMix

Prompt = Annotated[
    str,
    typer.Option(
        help="The style: clear, foggy, night or rain, or several; foggy:0.5+night:0..1 is half a"
        " fog, and a night that falls while the log passes."
    ),
]
ImageFolder = Annotated[
    Path | None,
    typer.Option("--out", help="Folder that the images are written to; not with --in-scene."),
]
InScene = Annotated[
    bool,
    typer.Option(
        "--in-scene", help="Make a new run whose scene is in the style, in place of images."
    ),
]
Strength = Annotated[
    float, typer.Option(help="Strength of all styles of the prompt, from 0 (the clear scene) to 1.")
]
Visibility = Annotated[
    float | None, typer.Option(help="Metres that one sees in a fog of strength 1; 120 if absent.")
]
ImageKind = Annotated[
    Literal["rendered", "recorded"],
    typer.Option(
        help="Images to style: rendered (what the scene shows), or recorded (what the camera saw, "
        "on the recorded path alone)."
    ),
]
Width = Annotated[
    int | None,
    typer.Option(
        help="Width of the images in pixels, at most as recorded; that of the fit if absent."
    ),
]
ViewPainter = Annotated[
    str | None,
    typer.Option(
        help="Painter that paints every image before it is styled: overlay, warp, nano, a "
        ".safetensors file, or a model. None if absent."
    ),
]
Seed = Annotated[
    int,
    typer.Option(
        help="Number that decides which windows are lit, and where puddles, drops and noise are.",
        min=0,
    ),
]


def stylize(  # noqa: PLR0913 - the options of a command
    run: RunName,
    prompt: Prompt,
    out: ImageFolder = None,
    in_scene: InScene = False,
    strength: Strength = 1.0,
    visibility: Visibility = None,
    trajectory: TrajectorySpec = RECORDED,
    images: ImageKind = "rendered",
    camera: FollowedCamera = None,
    frames: FollowedFrames = None,
    width: Width = None,
    painter: ViewPainter = None,
    seed: Seed = 0,
    allow_collisions: AllowCollisions = False,
    as_json: AsJson = False,
) -> None:
    """Show a finished run in another weather or at night, or make a run that lives in it.

    Example: lidarpainter stylize latest --prompt foggy --out foggy
    """
    mix = StyleMix.parse(prompt, strength=strength, visibility_m=visibility)
    if in_scene == (out is not None):
        raise ConfigError("stylize needs --out FOLDER for images, or --in-scene for a new run")
    if in_scene:
        given = {
            "--trajectory": trajectory != RECORDED,
            "--images": images != "rendered",
            "--camera": camera is not None,
            "--frames": frames is not None,
            "--width": width is not None,
            "--painter": painter is not None,
            "--allow-collisions": allow_collisions,
        }
        refuse_unused("--in-scene", given)
    followed = parse_frames(frames)
    run_id = checked_words(run, trajectory, painter)
    if out is None:
        _make_styled_run(run_id, mix, seed, as_json=as_json)
        return
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.views import stylize_run
    from lidarpainter_models.export.styled_views import StyleRequest
    from lidarpainter_models.export.view_requests import ViewRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory

    request = ViewRequest(
        trajectory=parse_trajectory(trajectory),
        camera=camera,
        frames=followed,
        width_px=width,
        is_painted=painter is not None,
        painter=painter,
        allows_collisions=allow_collisions,
    )
    style = StyleRequest(mix=mix, images=images, seed=seed)
    with shown_progress():
        result = stylize_run(existing_store(), run_id, request, style, out.absolute())
    print_result(f"{mix.text} images of {result['scene']}", result, as_json=as_json)


def _make_styled_run(run: str, mix: StyleMix, seed: int, *, as_json: bool) -> None:
    """Make the run in the style and say what it is."""
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.style_run import style_run

    with shown_progress():
        result = style_run(existing_store(), run, mix, seed=seed)
    if as_json:
        print_json(result)
        return
    shown = ("run_id", "scene", "derived_from", "num_gaussians")
    pairs = {name: result[name] for name in shown} | {"seconds": result["seconds"]["total"]}
    print_pairs(f"{result['scene']} in the style {mix.text}", pairs)
