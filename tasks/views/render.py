"""Show a finished run along a trajectory: as it is, painted at view time, or in another weather."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from lidarpainter_models.conditioning.followed_paths import FollowedPath
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.evaluation.anchoring import calibration_of
from lidarpainter_models.evaluation.view_confidence import PROMISED, Calibration
from lidarpainter_models.export import view_requests
from lidarpainter_models.export.styled_views import StyleRequest, write_styled
from lidarpainter_models.export.view_files import Delivery, legend, write_views
from lidarpainter_models.export.view_requests import ViewRequest, only_path
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.observations.settings import ObservationConfig
from tasks.evaluation.shown import condition_builder
from tasks.json_files import write_json
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stored import load_observations, load_scene

STAGE, STYLIZE = "render", "stylize"
POSES_FILE, LEGEND_FILE, VIDEO_FILE = "trajectory.json", "semantics.json", "video.mp4"


@dataclass(frozen=True, kw_only=True)
class ViewedRun:
    """A finished run that is looked at, and how its fit saw the recording."""

    run: RunSpec
    """What the run works on, with the painter that paints its views."""
    fitted: FittedRef
    """The fitted scene that is shown."""
    observation: ObservationConfig
    """How the images of the fit were made."""
    conditions: ConditionConfig
    """What painters are told of a view."""
    calibration: Calibration = field(default_factory=partial(calibration_of, None))
    """What its frames can be trusted by: as its envelope says, where it has one."""
    beside: FittedRef | None = None
    """Another fitted scene of the same log, which is shown to the left."""


def render(viewed: ViewedRun, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Write what is wanted for every recorded moment, and where each image was taken.

    What is painted lies at `0007.png`, the render that it was painted from at
    `unpainted/0007.png`. Several cameras get a folder each, their films one more of all together.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: the path leads into a wall.
    """
    paths = followed_paths(viewed, request)
    folders = [out / path.camera_name if len(paths) > 1 else out for path in paths]
    films = [folder / VIDEO_FILE for folder in folders] if request.kinds.video else []
    together = out / VIDEO_FILE if len(films) > 1 else None
    made = write_paths(viewed, paths, request, folders, films=films, together=together)
    videos = [str(film) for film in (*([together] if together else []), *films)]
    return {
        "folder": str(out),
        "num_images": made["num_images"],
        "num_trusted": made["num_trusted"],
        "camera": paths[0].camera_name,
        "cameras": made["cameras"],
        "collisions": made["collisions"],
        **({"video": ", ".join(videos), "fps": made["fps"]} if videos else {}),
    }


def followed_paths(viewed: ViewedRun, request: ViewRequest) -> list[FollowedPath]:
    """Load what the images of a run are made from, a path for every camera.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: a path leads into a wall, or a scene in a style is to be painted.
    """
    this, fitted = opened(viewed.run), viewed.fitted
    return view_requests.followed_paths(
        request,
        this.scene,
        condition_builder(this.store, fitted, viewed.conditions, this.device),
        fitted_cameras=load_observations(this.store, fitted.observations).camera_names,
        observation=viewed.observation,
        load_painter=lambda: this.painter.load(this.device),
    )


def write_paths(
    viewed: ViewedRun,
    paths: Sequence[FollowedPath],
    request: ViewRequest,
    folders: Sequence[Path],
    *,
    films: Sequence[Path] = (),
    together: Path | None = None,
) -> dict[str, Any]:
    """Write the files of every path to its folder, with their poses; tells how far it is.

    Returns:
        `num_images`, `cameras`, `collisions`, `num_trusted` (views that the scene is promised to
        show well before anybody paints them, None where nothing is known of them), and `fps` where
        there are films.
    """
    done, total, kinds = 0, sum(len(path.views) for path in paths), request.kinds
    listener().started(STAGE)

    def advanced() -> None:
        nonlocal done
        done += 1
        listener().advanced(STAGE, done, total, "")

    beside: str | GaussianScene | None = request.beside
    if viewed.beside is not None:
        beside = load_scene(opened(viewed.run).store, viewed.beside.gaussians)
    written, fps = write_views(
        paths,
        folders,
        Delivery(kinds=kinds, calibration=viewed.calibration, beside=beside),
        films=films,
        together=together,
        advanced=advanced,
    )
    collisions = [[asdict(found) for found in path.collisions()] for path in paths]
    for path, folder, rows, met in zip(paths, folders, written, collisions, strict=True):
        if kinds.semantics:
            write_json(folder / LEGEND_FILE, legend(path.builder.scene))
        if kinds.has_poses:
            about = {"trajectory": path.trajectory.spec, "collisions": met}
            write_json(folder / POSES_FILE, {**about, "images": rows})
    known = [row["confidence"] for rows in written for row in rows if "confidence" in row]
    return {
        "num_images": total,
        "num_trusted": None
        if None in known or not known
        else sum(confidence >= PROMISED for confidence in known),
        "cameras": ", ".join(path.camera_name for path in paths),
        "collisions": [found for met in collisions for found in met],
        **({"fps": fps} if kinds.video else {}),
    }


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
    listener().started(STYLIZE)
    total = len(path.views)
    rows, kept = write_styled(
        path, style, out, lambda done: listener().advanced(STYLIZE, done, total, "")
    )
    described = {"trajectory": request.trajectory.spec, "prompt": style.mix.text}
    write_json(out / POSES_FILE, {**described, "seed": style.seed, "images": rows})
    return {"folder": str(out), "num_images": total, "camera": path.camera_name, **kept}
