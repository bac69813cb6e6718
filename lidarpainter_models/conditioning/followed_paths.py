"""The path that a recorded camera took, followed along a trajectory beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.observations.fit_size import fit_camera
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView


@dataclass(frozen=True, kw_only=True, eq=False)
class FollowedPath:
    """Recorded moments of one camera, and where a moved camera stands at each."""

    recorded: DrivingScene
    builder: ConditionBuilder
    views: Sequence[RecordedView]
    """The moments."""
    trajectory: Trajectory
    observation: ObservationConfig
    painter: SequencePainter | None
    """To be asked for the moments in their order; None shows the scene as it is."""

    def camera(self, number: int) -> Camera:
        """Where the camera stands at the n-th moment: as the fit found it, then moved."""
        view, scene = self.views[number], self.builder.scene
        camera = scene.corrected_camera(
            fit_camera(view, self.observation),
            timestamp_ns=view.timestamp_ns,
            camera_name=view.camera_name,
            key=view.key,
        )
        directions = road_directions(self.recorded.world_from_ego)
        direction = directions[self.recorded.frame_position(view.frame_index)]
        shift = self.trajectory.shift_at(number / max(len(self.views) - 1, 1))
        return camera.at(shift_pose(camera.world_from_camera, direction, shift))

    def image(self, camera: Camera, view: RecordedView) -> Float[Tensor, "height width 3"]:
        """What is seen there, painted if asked for; in [0, 1]."""
        if self.painter is not None:
            return self.painter.paint(camera, view.timestamp_ns).painting.rgb.clamp(0, 1)
        scene = self.builder.scene
        shown = scene.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        return shown.rgb.clamp(0, 1)


def followed_views(
    recorded: DrivingScene,
    camera_names: Sequence[str],
    camera: str | None = None,
    frames: slice | None = None,
) -> tuple[RecordedView, ...]:
    """The moments of one trained camera, the first of them if none is named.

    Raises:
        SceneError: the fit did not see that camera, or no frame is left.
    """
    name = camera or camera_names[0]
    if name not in camera_names:
        raise SceneError(
            f"the fit of {recorded.path.name} saw no camera {name!r}, it saw "
            f"{', '.join(camera_names)}"
        )
    views = recorded.views_of(name)[frames or slice(None)]
    if not views:
        raise SceneError(f"{recorded.path.name}: no frame of {name} is left to render")
    return views


def image_record(file: str, camera: Camera, view: RecordedView) -> dict[str, Any]:
    """Where and when an image was taken, as JSON types."""
    return {
        "file": file,
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
