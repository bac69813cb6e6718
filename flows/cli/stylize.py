"""`lidarpainter stylize`: a run in fog, at night or in rain, as images or as a scene."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from flows.cli.output import print_json, print_pairs, print_result
from flows.cli.shared_options import (
    AsJson,
    TrajectorySpec,
    checked_words,
    described,
    parse_frames,
    refuse_unused,
)
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.weather.mix import StyleMix

WORDS = """
stylize.camera: Camera whose path is followed; the first one fitted to if absent.
prompt: The style: clear, foggy, night or rain, or several; foggy:0.5+night:0..1 is half a fog, and
  a night that falls while the log passes.
out: Folder that the images are written to; not with --in-scene.
in_scene: Make a new run whose scene is in the style, in place of images.
strength: Strength of all styles of the prompt, from 0 (the clear scene) to 1.
visibility: Metres that one sees in a fog of strength 1; 120 if absent.
images: Images to style: rendered (what the scene shows), or recorded (what the camera saw, on the
  recorded path alone).
width: Width of the images in pixels, at most as recorded; that of the fit if absent.
painter: Painter that paints every image before it is styled: overlay, warp, nano, a .safetensors
  file, or a model. None if absent.
seed: Number that decides which windows are lit, and where puddles, drops and noise are.
"""


@described(WORDS)
def stylize(  # noqa: PLR0913 - the options of a command
    run: str,
    prompt: Annotated[str, typer.Option()],
    out: Path | None = None,
    in_scene: bool = False,
    strength: float = 1.0,
    visibility: float | None = None,
    trajectory: TrajectorySpec = RECORDED,
    images: Literal["rendered", "recorded"] = "rendered",
    camera: str | None = None,
    frames: str | None = None,
    width: int | None = None,
    painter: str | None = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    allow_collisions: bool = False,
    as_json: AsJson = False,
) -> None:
    """Show a finished run in another weather or at night, or make a run that lives in it.

    Example: lidarpainter stylize latest --prompt foggy --out foggy
    """
    mix = StyleMix.parse(prompt, strength=strength, visibility_m=visibility)
    if in_scene == (out is not None):
        raise ConfigError("stylize needs --out FOLDER for images, or --in-scene for a new run")
    if in_scene:
        optional = {"--camera": camera, "--frames": frames, "--width": width, "--painter": painter}
        given = {
            "--trajectory": trajectory != RECORDED,
            "--images": images != "rendered",
            **{name: value is not None for name, value in optional.items()},
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
    from flows.derive import style_run

    with shown_progress():
        result = style_run(existing_store(), run, mix, seed=seed)
    if as_json:
        print_json(result)
        return
    shown = ("run_id", "scene", "derived_from", "num_gaussians")
    pairs = {name: result[name] for name in shown} | {"seconds": result["seconds"]["total"]}
    print_pairs(f"{result['scene']} in the style {mix.text}", pairs)
