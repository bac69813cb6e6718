"""Render a finished run along a trajectory, painted at view time if asked for."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from prefect import task
from torch import Tensor

from catalog.store import Store, open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder, ConditionConfig
from lidarpainter_models.conditioning.sequences import SequenceConfig, SequencePainter
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.export.images import write_png
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.observations.observations import ObservationConfig, fit_camera
from lidarpainter_models.painter import load_painter
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView
from tasks.json_files import write_json
from tasks.progress import listener
from tasks.runs import FinishedRun
from tasks.scenes import open_scene
from tasks.stages import STAGE_OPTIONS
from tasks.stored import load_observations, load_scene

STAGE = "render"
POSES_FILE = "trajectory.json"


@dataclass(frozen=True, kw_only=True)
class RenderRequest:
    """Which images are wanted."""

    trajectory: Trajectory
    camera: str | None = None
    """Camera whose path is shifted; None takes the first that was trained on."""
    frames: slice | None = None
    """Positions of the recorded frames to follow."""
    painter: str | None = None
    """Painter applied to every image; None shows the scene as it is."""
    prompt: str = DEFAULT_PROMPT
    """What a painter that knows styles is asked for."""
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    """What becomes of the image painted before."""
    observation: ObservationConfig
    conditions: ConditionConfig

    def __post_init__(self) -> None:
        """Refuse a prompt that nobody is asked for, and a previous image that nobody painted."""
        if self.sequence.previous != "unused" and self.painter is None:
            raise ConfigError("--previous needs a painter: --postpaint or --painter")
        if self.prompt != DEFAULT_PROMPT and self.painter is None:
            raise ConfigError(f"prompt {self.prompt!r} needs a painter: --postpaint or --painter")


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenedRun:
    """A finished run, ready to be looked at along a trajectory."""

    recorded: DrivingScene
    builder: ConditionBuilder
    camera_name: str
    views: Sequence[RecordedView]
    """The recorded moments to follow."""
    request: RenderRequest
    painter: SequencePainter | None
    """To be asked for the moments in their order."""

    def camera(self, number: int) -> Camera:
        """Where the camera stands at the n-th of the moments."""
        progress = number / max(len(self.views) - 1, 1)
        return _shifted(
            self.recorded, self.builder.scene, self.views[number], self.request, progress
        )

    def image(self, camera: Camera, view: RecordedView) -> Float[Tensor, "height width 3"]:
        """What is seen there, painted if asked for; in [0, 1]."""
        return _image(self, camera, view).clamp(0, 1)


def open_views(store: Store, run: FinishedRun, request: RenderRequest) -> OpenedRun:
    """Load what a run's images are made from.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
    """
    recorded = open_scene(store, run.scene_id)
    seen = load_observations(store, run.final.observations)
    scene = load_scene(store, run.final.gaussians)
    camera_name = request.camera or seen.camera_names[0]
    if camera_name not in seen.camera_names:
        raise SceneError(
            f"run {run.run_id} has no camera {camera_name!r}, it has {', '.join(seen.camera_names)}"
        )
    views = recorded.views_of(camera_name)[request.frames or slice(None)]
    if not views:
        raise SceneError(f"{run.scene_id}: no frame of {camera_name} is left to render")
    builder = ConditionBuilder(scene, seen.lidar_map, seen.views, config=request.conditions)
    name = request.painter
    return OpenedRun(
        recorded=recorded,
        builder=builder,
        camera_name=camera_name,
        views=views,
        request=request,
        painter=None if name is None else _path(builder, camera_name, name, request),
    )


def _path(
    builder: ConditionBuilder, camera_name: str, painter: str, request: RenderRequest
) -> SequencePainter:
    return SequencePainter(
        builder,
        load_painter(painter),
        config=request.sequence,
        camera_name=camera_name,
        prompt=request.prompt,
    )


@task(**STAGE_OPTIONS)
def render(store_path: Path, run: FinishedRun, request: RenderRequest, out: Path) -> dict[str, Any]:
    """Write an image for every recorded moment, and where each was taken.

    Raises:
        SceneError: the run did not train on that camera, or no frame is left.
    """
    opened = open_views(open_store(store_path), run, request)
    listener().started(STAGE)
    rows = []
    for number, view in enumerate(opened.views):
        camera = opened.camera(number)
        path = write_png(opened.image(camera, view), out / f"{view.frame_index:04d}.png")
        rows.append(image_record(path, camera, view))
        listener().advanced(STAGE, number + 1, len(opened.views), "")
    write_json(out / POSES_FILE, {"trajectory": request.trajectory.spec, "images": rows})
    return {"folder": str(out), "num_images": len(rows), "camera": opened.camera_name}


def _shifted(
    recorded: DrivingScene,
    scene: GaussianScene,
    view: RecordedView,
    request: RenderRequest,
    progress: float,
) -> Camera:
    """The recorded camera where the fit found it, moved along the trajectory."""
    camera = scene.corrected_camera(
        fit_camera(view, request.observation),
        timestamp_ns=view.timestamp_ns,
        camera_name=view.camera_name,
        key=view.key,
    )
    directions = road_directions(recorded.world_from_ego)
    direction = directions[recorded.frame_position(view.frame_index)]
    shift = request.trajectory.shift_at(progress)
    return camera.at(shift_pose(camera.world_from_camera, direction, shift))


def _image(
    opened: OpenedRun, camera: Camera, view: RecordedView
) -> Float[Tensor, "height width 3"]:
    builder = opened.builder
    if opened.painter is None:
        shown = builder.scene.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        return shown.rgb
    return opened.painter.paint(camera, view.timestamp_ns).painting.rgb


def image_record(path: Path, camera: Camera, view: RecordedView) -> dict[str, Any]:
    """Where and when an image was taken, as JSON types."""
    return {
        "file": path.name,
        "frame_index": view.frame_index,
        "timestamp_ns": view.timestamp_ns,
        "world_from_camera": camera.world_from_camera.reshape(-1).tolist(),
        "fx_px": camera.fx_px,
        "fy_px": camera.fy_px,
        "cx_px": camera.cx_px,
        "cy_px": camera.cy_px,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
    }
