"""`lidarpainter stylize`: a run in fog, at night or in rain, as images or as a scene."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.output import print_json, print_pairs
from flows.cli.shared_options import (
    AllowCollisions,
    AsJson,
    FollowedCamera,
    FollowedFrames,
    RunName,
    TrajectorySpec,
    followed_path,
    refuse_unused,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.weather.mix import StyleMix

Prompt = Annotated[
    str,
    typer.Option(
        help="clear, foggy, night or rain, or several: foggy:0.5+night:0..1 is half a fog, and a "
        "night that falls while the log passes."
    ),
]
ImageFolder = Annotated[
    Path | None, typer.Option("--out", help="Folder for the images; not with --in-scene.")
]
InScene = Annotated[
    bool, typer.Option("--in-scene", help="Make a new run whose scene lives in the style.")
]
Strength = Annotated[
    float, typer.Option(help="From 0, the clear scene, to 1; multiplies all of the prompt.")
]
Visibility = Annotated[
    float | None, typer.Option(help="Metres that one sees in fog of strength 1; 120 if absent.")
]
ImageKind = Annotated[str, typer.Option(help="rendered, or recorded: style what the camera saw.")]
Width = Annotated[int | None, typer.Option(help="In pixels; that of the fit if absent.")]
ViewPainter = Annotated[
    str | None, typer.Option(help="Paint every image with this before it is styled.")
]
Seed = Annotated[int, typer.Option(help="Decides lit windows, puddles, drops and noise.", min=0)]


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
    path = followed_path(
        run,
        trajectory,
        frames,
        painter,
        camera=camera,
        is_painted=painter is not None,
        allows_collisions=allow_collisions,
        width_px=width,
    )
    if out is None:
        _style(run, mix, seed, as_json=as_json)
        return
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.views import stylize_run

    asked: dict[str, Any] = {"images": images, "seed": seed}
    with shown_progress():
        result = stylize_run(existing_store(), path, out.absolute(), mix=mix, **asked)
    if as_json:
        print_json(result)
    else:
        print_pairs(f"{mix.text} images of {result['scene']}", result)


def _style(run: str, mix: StyleMix, seed: int, *, as_json: bool) -> None:
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
