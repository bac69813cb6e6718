"""Write what a run shows along a trajectory as a film, as depth, or as who is where."""

from pathlib import Path
from typing import Any

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.view_requests import ViewRequest
from tasks.exports.places import new_folder
from tasks.views.render import ViewedRun, followed_paths, write_paths

VIDEO_ENDING = ".mp4"


def export_video(viewed: ViewedRun, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Write a film: to a name in `.mp4` all cameras together, else a folder with one of each.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: one camera's film is not called as films are, or a folder is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    paths = followed_paths(viewed, request)
    is_film = out.suffix.lower() == VIDEO_ENDING
    if len(paths) == 1 and not is_film:
        raise ConfigError(f"{out.name}: expected a name in {VIDEO_ENDING}")
    if is_film:
        films, together = ([out], None) if len(paths) == 1 else ([], out)
        places = [out.parent] * len(paths)
        made = write_paths(viewed, paths, request, places, films=films, together=together)
    else:
        with new_folder(out) as folder:
            films = [folder / f"{path.camera_name}{VIDEO_ENDING}" for path in paths]
            made = write_paths(viewed, paths, request, [folder] * len(paths), films=films)
    return {"path": str(out), **_without_collisions(made)}


def export_images(viewed: ViewedRun, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Write depth or semantics of every view into a new folder, a folder for each camera.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    paths = followed_paths(viewed, request)
    with new_folder(out) as folder:
        places = [folder / path.camera_name if len(paths) > 1 else folder for path in paths]
        made = write_paths(viewed, paths, request, places)
    return {"path": str(out), **_without_collisions(made)}


def _without_collisions(made: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in made.items() if name != "collisions"}
