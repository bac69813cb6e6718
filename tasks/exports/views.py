"""Write what a run shows along a trajectory as a film, as depth, or as who is where."""

from pathlib import Path
from typing import Any

from lidarpainter_models.errors import ConfigError
from tasks.exports.places import new_folder
from tasks.specs import FittedRef, RunSpec
from tasks.stages import stage_task
from tasks.views.render import RenderRequest, followed_paths, write_paths

VIDEO_ENDING = ".mp4"


@stage_task
def export_video(
    run: RunSpec, fitted: FittedRef, request: RenderRequest, out: Path
) -> dict[str, Any]:
    """Write a film: to a name in `.mp4` all cameras together, else a folder with one of each.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: one camera's film is not called as films are, or a folder is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    paths = followed_paths(run, fitted, request)
    is_film = out.suffix.lower() == VIDEO_ENDING
    if len(paths) == 1 and not is_film:
        raise ConfigError(f"{out.name}: expected a name in {VIDEO_ENDING}")
    if is_film:
        films, together = ([out], None) if len(paths) == 1 else ([], out)
        places = [out.parent] * len(paths)
        made = write_paths(run, paths, request, places, films=films, together=together)
        return {"path": str(out), **_said(made)}
    with new_folder(out) as folder:
        films = [folder / f"{path.camera_name}{VIDEO_ENDING}" for path in paths]
        made = write_paths(run, paths, request, [folder] * len(paths), films=films)
    return {"path": str(out), **_said(made)}


@stage_task
def export_images(
    run: RunSpec, fitted: FittedRef, request: RenderRequest, out: Path
) -> dict[str, Any]:
    """Write depth or semantics of every view into a new folder, a folder for each camera.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    paths = followed_paths(run, fitted, request)
    with new_folder(out) as folder:
        places = [folder / path.camera_name if len(paths) > 1 else folder for path in paths]
        made = write_paths(run, paths, request, places)
    return {"path": str(out), **_said(made)}


def _said(made: list[dict[str, Any]]) -> dict[str, Any]:
    rates = {"fps": made[0]["fps"]} if "fps" in made[0] else {}
    return {
        "num_images": sum(one["num_images"] for one in made),
        "cameras": ", ".join(one["camera"] for one in made),
        **rates,
    }
