"""Render a finished run along a trajectory, painted at view time if asked for."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from prefect import task

from lidarpainter_models.conditioning.followed_paths import (
    FollowedPath,
    followed_views,
    image_record,
)
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import ConditionConfig, SequenceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from tasks.evaluation.shown import condition_builder
from tasks.json_files import write_json
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stages import STAGE_OPTIONS
from tasks.stored import load_observations

STAGE = "render"
POSES_FILE = "trajectory.json"
UNPAINTED_FOLDER = "unpainted"


@dataclass(frozen=True, kw_only=True)
class RenderRequest:
    """Which images are wanted."""

    trajectory: Trajectory
    camera: str | None = None
    """Camera whose path is shifted; None takes the first that was trained on."""
    frames: slice | None = None
    """Positions of the recorded frames to follow."""
    is_painted: bool = False
    """Whether the run's painter paints every image; otherwise the scene is shown as it is."""
    prompt: str = DEFAULT_PROMPT
    """What a painter that knows styles is asked for."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """What becomes of the image painted before."""
    observation: ObservationConfig
    conditions: ConditionConfig

    def __post_init__(self) -> None:
        """Refuse a prompt that nobody is asked for, and a previous image that nobody painted."""
        if self.sequence.previous != "unused" and not self.is_painted:
            raise ConfigError("--previous needs a painter: --postpaint or --painter")
        if self.prompt != DEFAULT_PROMPT and not self.is_painted:
            raise ConfigError(f"prompt {self.prompt!r} needs a painter: --postpaint or --painter")


@task(**STAGE_OPTIONS)
def render(run: RunSpec, fitted: FittedRef, request: RenderRequest, out: Path) -> dict[str, Any]:
    """Write an image for every recorded moment, and where each was taken.

    What is painted lies at `0007.png`, the render that it was painted from at
    `unpainted/0007.png`.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
    """
    path = followed_path(run, fitted, request)
    listener().started(STAGE)
    rows = []
    for number, view in enumerate(path.views):
        camera = path.camera(number)
        name = f"{view.frame_index:04d}.png"
        row = image_record(name, camera, view)
        if path.painter is None:
            rgb = path.image(camera, view)
        else:
            painted = path.painter.paint(camera, view.timestamp_ns)
            rgb = painted.painting.rgb
            row["unpainted"] = f"{UNPAINTED_FOLDER}/{name}"
            write_png(painted.conditions.render_rgb, out / row["unpainted"])
        write_png(rgb, out / name)
        rows.append(row)
        listener().advanced(STAGE, number + 1, len(path.views), "")
    write_json(out / POSES_FILE, {"trajectory": request.trajectory.spec, "images": rows})
    return {"folder": str(out), "num_images": len(rows), "camera": path.views[0].camera_name}


def followed_path(run: RunSpec, fitted: FittedRef, request: RenderRequest) -> FollowedPath:
    """Load what the images of a run are made from.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
    """
    this = opened(run)
    trained = load_observations(this.store, fitted.observations).camera_names
    views = followed_views(this.scene, trained, request.camera, request.frames)
    builder = condition_builder(this.store, fitted, request.conditions)
    painter = None
    if request.is_painted:
        painter = SequencePainter(
            builder,
            this.painter.load(this.device),
            config=request.sequence,
            camera_name=views[0].camera_name,
            prompt=request.prompt,
        )
    return FollowedPath(
        recorded=this.scene,
        builder=builder,
        views=views,
        trajectory=request.trajectory,
        observation=request.observation,
        painter=painter,
    )
