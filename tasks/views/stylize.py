"""Images of a finished run in another weather or at night."""

from pathlib import Path
from typing import Any

from lidarpainter_models.export.styled_views import StyleRequest, write_styled
from lidarpainter_models.export.view_requests import ViewRequest, only_path
from tasks.json_files import write_json
from tasks.progress import listener
from tasks.views.render import POSES_FILE, ViewedRun, followed_paths

STAGE = "stylize"


def stylize(
    viewed: ViewedRun, request: ViewRequest, style: StyleRequest, out: Path
) -> dict[str, Any]:
    """Write a styled image for every recorded moment, the clear one beside it.

    Returns:
        Where the images are and how well their edges are those of the clear ones.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: several cameras are asked for, or what cannot be put in a style.
    """
    style.check(request)
    path = only_path(followed_paths(viewed, request), request)
    listener().started(STAGE)
    total = len(path.views)
    rows, kept = write_styled(
        path, style, out, lambda done: listener().advanced(STAGE, done, total, "")
    )
    described = {"trajectory": request.trajectory.spec, "prompt": style.mix.text}
    write_json(out / POSES_FILE, {**described, "seed": style.seed, "images": rows})
    return {"folder": str(out), "num_images": total, "camera": path.camera_name, **kept}
