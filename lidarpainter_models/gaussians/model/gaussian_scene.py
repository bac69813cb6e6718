"""A dynamic scene: street, actors and sky, and what was corrected about the cameras."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.blinking import Blinking
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.rolling_shutter import (
    MOST_GROWTH,
    as_read,
    bodies_while_read,
)
from lidarpainter_models.gaussians.model.scene_rendering import (
    SceneRender,
    camera_from_body,
    draw_over_sky,
)
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.spatial_blocks import SpatialBlocks
from lidarpainter_models.gaussians.model.styling.dressed import DressedScene
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend
from lidarpainter_models.kernels.frustum_culling import MOST_SIGMAS
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.scenes.driving_scene import ActorTrack
from lidarpainter_models.scenes.records import RecordedView, ViewKey


@dataclass(frozen=True, eq=False, kw_only=True)
class GaussianScene:
    """Everything needed to draw the scene at any pose and time of the log.

    A fit changes tensors of its own copy in place, leaves of autograd; elsewhere a scene stays as
    it is, and what was found out when it was rendered holds from then on.
    """

    gaussians: GaussianSet
    actors: Actors
    sky: SkyTexture
    cameras: CameraCorrections
    exposure: ExposureCorrections
    blinking: Blinking = field(default_factory=Blinking.none)
    """Lamps that went on and off."""
    style: SceneStyle | None = None
    """Weather and night that the scene is rendered in."""

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
        `camera_name` the colours are exposed as that camera's. A recorded camera's image is drawn
        as its shutter reads it; a scene in a style is drawn all at once.
        """
        with torch.no_grad():
            row = None if view_key is None else self.cameras.row_of(view_key)
            if row is not None:
                camera = camera.refined(self.cameras.world_from_camera(row))
            timestamp_ns = camera.taken_ns(timestamp_ns)
            dressed = self._dressed
            strengths = {} if dressed is None else dressed.style.strengths(timestamp_ns)
            if dressed is not None and strengths:
                drawn = dressed.render(camera, timestamp_ns, strengths, backend=backend)
            else:
                poses = self.actors.likely_poses(timestamp_ns)
                bodies = camera_from_body(camera.world_from_camera, *poses)
                gaussians = self._in_view(camera, bodies, timestamp_ns)
                lit = self.blinking.lit(gaussians, timestamp_ns)
                bent = self.actors.bending.bent(lit, timestamp_ns)
                read = as_read(bent, bodies, camera, self.actors, timestamp_ns)
                drawn = draw_over_sky(read, bodies, self.sky, camera, backend=backend)
            return replace(drawn, rgb=self.exposure.apply(drawn.rgb, camera_name, timestamp_ns))

    def _in_view(
        self, camera: Camera, bodies: Float[Tensor, "bodies 4 4"], timestamp_ns: int
    ) -> GaussianSet:
        """The Gaussians that an image can show, and some more; of a running fit all."""
        if self.gaussians.means.requires_grad:
            return self.gaussians
        moments = [bodies, *bodies_while_read(bodies, camera, self.actors, timestamp_ns)]
        is_seen = self._blocks.in_view(
            [(camera, moment) for moment in moments],
            actor_slack_m=self.actors.bending.reach_m(timestamp_ns),
        )
        return self.gaussians.select(is_seen.nonzero()[:, 0])

    @cached_property
    def _blocks(self) -> SpatialBlocks:
        """Of Gaussians that stay as they are, but for what a rolling shutter makes of them.

        Raises:
            ShapeError: Gaussians belong to bodies that the scene does not have.
        """
        bodies, body_index = 1 + len(self.actors.recorded_tracks), self.gaussians.body_index
        lowest, highest = torch.cat([body_index, body_index.new_zeros(1)]).aminmax()
        if int(lowest) < 0 or int(highest) >= bodies:
            raise ShapeError(
                f"Gaussians of a scene with {bodies - 1} actors belong to bodies {int(lowest)} to "
                f"{int(highest)}"
            )
        return SpatialBlocks.of(self.gaussians, 1.001 * MOST_GROWTH * MOST_SIGMAS)

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

    def found_camera(
        self, view: TrainingView | RecordedView, camera: Camera | None = None
    ) -> Camera:
        """A view's camera, or the same at another size, as the fit found it."""
        return self.corrected_camera(
            view.camera if camera is None else camera,
            timestamp_ns=view.timestamp_ns,
            camera_name=view.key[1],
            key=view.key,
        )

    @property
    def device(self) -> torch.device:
        """Where the scene is drawn: Gaussians and sky lie there, poses and exposure on the CPU."""
        return self.gaussians.means.device

    def to(self, device: torch.device) -> "GaussianScene":
        """The same scene on another device, itself if it is there."""
        if self.device == device:
            return self
        return replace(
            self,
            gaussians=self.gaussians.to(device),
            actors=self.actors.to(device),
            blinking=self.blinking.to(device),
            sky=self.sky.to(device),
            style=None if self.style is None else self.style.to(device),
        )

    def baked(
        self, timestamp_ns: int, eye_world: Float[Tensor, "3"] | None = None
    ) -> "GaussianScene":
        """The scene as its style shows it at a time, without the style: for formats without one.

        Air and wet roads look as from `eye_world`; None takes where the car was that recorded.
        Lamps light what they light, but do not shine into the camera themselves.
        """
        dressed = self._dressed
        strengths = {} if dressed is None else dressed.style.strengths(timestamp_ns)
        if dressed is None or not strengths:
            return replace(self, style=None)
        gaussians, sky = dressed.baked(timestamp_ns, strengths, eye_world)
        return replace(self, style=None, gaussians=gaussians, sky=sky)

    @cached_property
    def _dressed(self) -> DressedScene | None:
        """Of a scene in a style, which stays as it is."""
        if self.style is None:
            return None
        return DressedScene(
            gaussians=self.gaussians,
            actors=self.actors,
            blinking=self.blinking,
            sky=self.sky,
            style=self.style,
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
        "num_bent_actors": len(scene.actors.bending.bodies),
        "num_blinking_lamps": len(scene.blinking),
        "style": None if scene.style is None else scene.style.mix.text,
        "sky_texels": [scene.sky.layout.rows, scene.sky.layout.columns],
    }
