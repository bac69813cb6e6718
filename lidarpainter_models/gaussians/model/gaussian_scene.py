"""A dynamic scene: street, rigid actors and sky, and what was corrected about the cameras."""

from dataclasses import dataclass, replace
from typing import Any

import torch

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.scene_rendering import (
    SceneRender,
    camera_from_body,
    draw_over_sky,
)
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend
from lidarpainter_models.scenes.driving_scene import ActorTrack
from lidarpainter_models.scenes.records import ViewKey


@dataclass(frozen=True, eq=False, kw_only=True)
class GaussianScene:
    """Everything needed to draw the scene at any pose and time of the log.

    A fit changes tensors of its own copy in place; elsewhere a scene stays as it is.
    """

    gaussians: GaussianSet
    actors: Actors
    sky: SkyTexture
    cameras: CameraCorrections
    exposure: ExposureCorrections

    @property
    def num_gaussians(self) -> int:
        """How many Gaussians there are."""
        return len(self.gaussians)

    @property
    def tracks(self) -> tuple[ActorTrack, ...]:
        """The actors' tracks with refined poses."""
        return self.actors.refined_tracks()

    def render(
        self,
        camera: Camera,
        timestamp_ns: int,
        *,
        camera_name: str | None = None,
        view_key: ViewKey | None = None,
        backend: Backend = "auto",
    ) -> SceneRender:
        """Draw the view of `camera`, taken as it stands, at a time.

        With `view_key` (a training view) the camera is first moved to its refined pose; with
        `camera_name` the colours are exposed as that camera's.
        """
        with torch.no_grad():
            row = None if view_key is None else self.cameras.row_of(view_key)
            if row is not None:
                camera = camera.at(self.cameras.world_from_camera(row))
            poses = self.actors.likely_poses(timestamp_ns)
            bodies = camera_from_body(camera.world_from_camera, *poses)
            drawn = draw_over_sky(self.gaussians, bodies, self.sky, camera, backend=backend)
            return replace(drawn, rgb=self.exposure.apply(drawn.rgb, camera_name))

    def corrected_camera(
        self,
        camera: Camera,
        *,
        timestamp_ns: int,
        camera_name: str,
        key: ViewKey | None = None,
    ) -> Camera:
        """A recorded camera at its refined pose.

        A training view gets its own correction, any other time one interpolated from the training
        views of the same camera (see `pose_blending`); a camera never trained on stays as it is.
        """
        return self.cameras.corrected(
            camera, key=key, timestamp_ns=timestamp_ns, camera_name=camera_name
        )

    def with_gaussians(self, gaussians: GaussianSet) -> "GaussianScene":
        """The same scene with other Gaussians."""
        return replace(self, gaussians=gaussians)


def describe(scene: GaussianScene) -> dict[str, Any]:
    """Counts worth reporting."""
    body = scene.gaussians.body_index
    return {
        "num_gaussians": len(scene.gaussians),
        "num_actor_gaussians": int((body > 0).sum()),
        "num_actors": len(scene.actors.recorded_tracks),
        "sky_texels": [scene.sky.layout.rows, scene.sky.layout.columns],
    }
