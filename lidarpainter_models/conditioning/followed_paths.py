"""The path that a recorded camera took, followed along a trajectory beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.moved_cameras import MovedCameras
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import LENS, Camera
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.lidar.collisions import Collision
from lidarpainter_models.observations.image_shrinking import fit_camera
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

ALL_CAMERAS = "all"


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownMoment:
    """What a camera on a path shows at a moment."""

    rgb: Float[Tensor, "height width 3"]
    """In [0, 1], painted if asked for."""
    unpainted_rgb: Float[Tensor, "height width 3"] | None
    """What was painted over."""
    depth_m: Float[Tensor, "height width"]
    """Camera z as rendered; 0 where there is none."""


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

    as_rig: bool = False
    """Move the car and its cameras on it, not this camera alone: then a turn is the car's."""

    evidence: EvidenceGatherer | None = None
    """Measures what speaks for each view; None where nobody says how far it can be trusted."""

    @property
    def camera_name(self) -> str:
        """Whose path is followed."""
        return self.views[0].camera_name

    def camera(self, number: int) -> Camera:
        """Where the camera stands at the n-th moment: as the fit found it, then moved."""
        return self._cameras[number]

    def collisions(self) -> list[Collision]:
        """What the camera runs into where nobody drove."""
        return self._moving.collisions(self.views, self._cameras, self.builder.lidar_map.street)

    def refuse_walls(self) -> None:
        """Refuse a path into a wall.

        Raises:
            ConfigError: it leads into points of the street.
        """
        if walls := [one for one in self.collisions() if one.is_wall]:
            raise ConfigError(
                f"trajectory {self.trajectory.spec!r} leads the camera into a wall: {walls[0]} "
                "within half a metre; --allow-collisions goes through"
            )

    @cached_property
    def _moving(self) -> MovedCameras:
        return MovedCameras(
            recorded=self.recorded,
            tracks=self.builder.boxes.tracks,
            trajectory=self.trajectory,
            as_rig=self.as_rig,
        )

    @cached_property
    def _cameras(self) -> tuple[Camera, ...]:
        found = [
            found_camera(
                self.builder.scene, self.recorded, view, fit_camera(view, self.observation)
            )
            for view in self.views
        ]
        return self._moving.moved(self.views, found)

    def shown(self, camera: Camera, view: RecordedView) -> ShownMoment:
        """What is seen there, and what is known beside it."""
        if self.painter is not None:
            painted = self.painter.paint(camera, view.timestamp_ns)
            return ShownMoment(
                rgb=painted.painting.rgb.clamp(0, 1),
                unpainted_rgb=painted.conditions.render_rgb,
                depth_m=painted.conditions.render_depth_m,
            )
        scene = self.builder.scene
        seen = scene.render(camera, view.timestamp_ns, camera_name=view.camera_name)
        return ShownMoment(rgb=seen.rgb.clamp(0, 1), unpainted_rgb=None, depth_m=seen.depth_m)


def found_camera(
    scene: GaussianScene, recorded: DrivingScene, view: RecordedView, camera: Camera
) -> Camera:
    """Where the fit found a camera; one that it did not see rides on the rig of one it saw.

    `camera` is the view's at the size that is wanted.
    """
    fitted = scene.cameras.camera_names
    if view.camera_name in fitted or not fitted:
        return scene.refined_camera(view, camera)
    views = recorded.views_of(fitted[0])
    other = next((one for one in views if one.frame_index == view.frame_index), None)
    if other is None:
        return camera
    return scene.cameras.riding(
        camera, view.timestamp_ns, other.camera, other.key, other.timestamp_ns
    )


def followed_cameras(
    recorded: DrivingScene, fitted_names: Sequence[str], wanted: str | None = None
) -> tuple[str, ...]:
    """The cameras to follow: `all`, names with commas between, or None for the first fitted one.

    Raises:
        SceneError: the scene has no such camera.
    """
    if wanted is None:
        return (fitted_names[0],)
    if wanted == ALL_CAMERAS:
        return recorded.camera_names
    names = tuple(dict.fromkeys(name.strip() for name in wanted.split(",")))
    if unknown := [name for name in names if name not in recorded.camera_names]:
        raise SceneError(
            f"{recorded.path.name} has no camera {unknown[0]!r}, it has "
            f"{', '.join(recorded.camera_names)}; {ALL_CAMERAS} takes every one"
        )
    return names


def followed_views(
    recorded: DrivingScene, camera: str, frames: slice | None = None
) -> tuple[RecordedView, ...]:
    """The moments of one camera.

    Raises:
        SceneError: there is no such camera, or no frame is left.
    """
    views = recorded.views_of(camera)[frames or slice(None)]
    if not views:
        raise SceneError(f"{recorded.path.name}: no frame of {camera} is left to render")
    return views


def image_record(file: str, camera: Camera, view: RecordedView) -> dict[str, Any]:
    """Where and when an image was taken, as JSON types."""
    return {
        "file": file,
        "frame_index": view.frame_index,
        "timestamp_ns": view.timestamp_ns,
        "world_from_camera": camera.world_from_camera.reshape(-1).tolist(),
        **{name: getattr(camera, name) for name in LENS},
    }
