"""Render a finished run along a trajectory, painted at view time if asked for."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.followed_paths import (
    FollowedPath,
    followed_cameras,
    followed_views,
)
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import ConditionConfig, SequenceConfig
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from tasks.evaluation.shown import condition_builder
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stages import stage_task
from tasks.stored import load_observations, load_scene
from tasks.views.files import POSES_FILE, VIDEO_FILE, Companion, ViewKinds, write_views

__all__ = ["POSES_FILE", "RenderRequest", "followed_path", "followed_paths", "render"]

STAGE = "render"


@dataclass(frozen=True, kw_only=True)
class RenderRequest:
    """Which images are wanted."""

    trajectory: Trajectory
    camera: str | None = None
    """Whose path is shifted: a name, several with commas, `all`, or None for the first fitted."""
    frames: slice | None = None
    """Positions of the recorded frames to follow."""
    is_painted: bool = False
    """Whether the run's painter paints every image; otherwise the scene is shown as it is."""
    prompt: str = DEFAULT_PROMPT
    """What a painter that knows styles is asked for."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """What becomes of the image painted before."""
    observation: ObservationConfig
    """Its width is that of the images."""
    conditions: ConditionConfig
    allows_collisions: bool = False
    """Whether the camera may go through what LiDAR saw standing there."""
    kinds: ViewKinds = field(default_factory=ViewKinds)
    beside: Literal["recorded", "unpainted"] | FittedRef | None = None
    """What is shown to the left: a fitted scene is another one of the same log."""

    def __post_init__(self) -> None:
        """Refuse a prompt that nobody is asked for, and images that nobody painted."""
        if self.sequence.previous != "unused" and not self.is_painted:
            raise ConfigError("--previous needs a painter: --postpaint or --painter")
        if self.prompt != DEFAULT_PROMPT and not self.is_painted:
            raise ConfigError(f"prompt {self.prompt!r} needs a painter: --postpaint or --painter")
        if self.beside == "unpainted" and not self.is_painted:
            raise ConfigError("--beside unpainted needs a painter: --postpaint or --painter")


@stage_task
def render(run: RunSpec, fitted: FittedRef, request: RenderRequest, out: Path) -> dict[str, Any]:
    """Write what is wanted for every recorded moment, and where each image was taken.

    What is painted lies at `0007.png`, the render that it was painted from at
    `unpainted/0007.png`. Several cameras get a folder each, their films one more of all together.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
    """
    paths = followed_paths(run, fitted, request)
    folders = [out / path.camera_name if len(paths) > 1 else out for path in paths]
    films = [folder / VIDEO_FILE for folder in folders] if request.kinds.video else []
    together = out / VIDEO_FILE if len(films) > 1 else None
    made = write_paths(run, paths, request, folders, films=films, together=together)
    first = made[0]
    videos = [str(film) for film in (*([together] if together else []), *films)]
    return {
        "folder": str(out),
        "num_images": sum(one["num_images"] for one in made),
        "camera": first["camera"],
        "cameras": ", ".join(one["camera"] for one in made),
        "collisions": [found for one in made for found in one["collisions"]],
        **({"video": ", ".join(videos), "fps": first["fps"]} if videos else {}),
    }


def write_paths(
    run: RunSpec,
    paths: list[FollowedPath],
    request: RenderRequest,
    folders: list[Path],
    *,
    films: Sequence[Path] = (),
    together: Path | None = None,
) -> list[dict[str, Any]]:
    """Write every path's files to its folder; tells how far it is."""
    done, total = 0, sum(len(path.views) for path in paths)
    listener().started(STAGE)

    def advanced() -> None:
        nonlocal done
        done += 1
        listener().advanced(STAGE, done, total, "")

    return write_views(
        paths,
        folders,
        request.kinds,
        companion=_companion(run, request),
        films=films,
        together=together,
        advanced=advanced,
    )


def _companion(run: RunSpec, request: RenderRequest) -> Companion | None:
    if request.beside is None or isinstance(request.beside, str):
        return None if request.beside is None else Companion(beside=request.beside)
    return Companion(beside=load_scene(opened(run).store, request.beside.gaussians))


def followed_paths(run: RunSpec, fitted: FittedRef, request: RenderRequest) -> list[FollowedPath]:
    """Load what the images of a run are made from, a path for every camera.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: a path leads into a wall.
    """
    this = opened(run)
    trained = load_observations(this.store, fitted.observations).camera_names
    views_of = [
        followed_views(this.scene, name, request.frames)
        for name in followed_cameras(this.scene, trained, request.camera)
    ]
    builder = condition_builder(this.store, fitted, request.conditions, this.device)
    style = builder.scene.style
    if request.is_painted and style is not None:
        raise ConfigError(
            f"the run is in the style {style.mix.text}, and painters know clear days: paint the "
            "run that it was derived from"
        )
    paths, evidence = [], _evidence(builder, request)
    for views in views_of:
        painter = None
        if request.is_painted:
            painter = SequencePainter(
                builder,
                this.painter.load(this.device),
                config=request.sequence,
                camera_name=views[0].camera_name,
                prompt=request.prompt,
            )
        paths.append(
            FollowedPath(
                recorded=this.scene,
                builder=builder,
                views=views,
                trajectory=request.trajectory,
                observation=request.observation,
                painter=painter,
                as_rig=len(views_of) > 1,
                evidence=evidence,
            )
        )
    if not request.allows_collisions:
        for path in paths:
            path.refuse_walls()
    return paths


def _evidence(builder: ConditionBuilder, request: RenderRequest) -> EvidenceGatherer | None:
    """Of images that are written; true images of a style were never recorded."""
    if builder.scene.style is not None or request.prompt != DEFAULT_PROMPT:
        return None
    return EvidenceGatherer(builder.scene, builder.lidar_map, builder.training_views)


def followed_path(run: RunSpec, fitted: FittedRef, request: RenderRequest) -> FollowedPath:
    """What the images of one camera are made from.

    Raises:
        SceneError: the scene has no such camera, or no frame is left.
        ConfigError: several cameras are asked for, or the path leads into a wall.
    """
    paths = followed_paths(run, fitted, request)
    if len(paths) > 1:
        raise ConfigError(f"--camera {request.camera}: expected one camera here")
    return paths[0]
