"""A dynamic scene: street, actors and sky, and what was refined about the cameras."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.blinking import Blinking
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.drawing import SceneRender
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.scene_rendering import (
    DrawableScene,
    PosedScene,
    gaussians_at,
)
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.spatial_blocks import SpatialBlocks
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle
from lidarpainter_models.gaussians.model.styling.styled_gaussians import StyledGaussians
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.frustum_culling import MOST_SIGMAS
from lidarpainter_models.kernels.row_motion import MOST_GROWTH
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
    ) -> SceneRender:
        """Draw the view of `camera`, taken as it stands, at a time.

        Args:
            camera: where it is drawn from; an image of a rolling shutter is drawn as it is read.
            timestamp_ns: of the image, as recorded.
            camera_name: whose exposure colours get; None leaves them as they are in the scene.
            view_key: a training view, whose refined pose the camera is first moved to.
        """
        row = None if view_key is None else self.cameras.row_of(view_key)
        if row is not None:
            with torch.no_grad():
                camera = camera.refined(self.cameras.world_from_camera(row))
        return self.drawable(camera, timestamp_ns).render(camera_name=camera_name)

    @torch.no_grad()
    def drawable(self, camera: Camera, timestamp_ns: int) -> DrawableScene:
        """What the image of a camera, taken as it stands, is made of; without gradient.

        Raises:
            ShapeError: Gaussians belong to bodies that the scene does not have.
        """
        return self.drawable_of(self.posed(camera, camera.taken_ns(timestamp_ns)))

    @torch.no_grad()
    def drawable_of(self, posed: PosedScene) -> DrawableScene:
        """What the image of this scene is made of, its bodies posed in whichever way."""
        styled, strengths = self._styled_at(posed.taken_ns)
        if styled is not None:
            return styled.drawable(posed, strengths, self.exposure)
        rows = self._in_view(posed)
        seen = self.gaussians if rows is None else self.gaussians.select(rows)
        if rows is None:
            rows = torch.arange(len(seen), device=self.device)
        return DrawableScene(
            posed=posed,
            gaussians=posed.shown(seen),
            rows=rows,
            sky=self.sky,
            exposure=self.exposure,
        )

    def posed(self, camera: Camera, taken_ns: int) -> PosedScene:
        """The scene before a camera at any time; see `Actors.refined_poses`."""
        poses = self.actors.refined_poses(taken_ns)
        return PosedScene.of(self.actors, self.blinking, camera, taken_ns, poses=poses)

    def posed_in_fit(
        self, camera: Camera, taken_ns: int, world_from_camera: Float[Tensor, "4 4"] | None = None
    ) -> PosedScene:
        """The scene before a camera at a training time; differentiable in poses and bending.

        `world_from_camera` is the camera's pose with its gradient; None lets none reach it.
        """
        return PosedScene.of(
            self.actors,
            self.blinking,
            camera,
            taken_ns,
            poses=self.actors.refined_poses_in_fit(taken_ns),
            world_from_camera=world_from_camera,
        )

    def gaussians_at(self, timestamp_ns: int | None) -> GaussianSet:
        """All Gaussians at a time, in the frames of their bodies; None is on average of all."""
        return gaussians_at(self.gaussians, self.actors, self.blinking, timestamp_ns)

    def _in_view(self, posed: PosedScene) -> Int[Tensor, " seen"] | None:
        """Rows of the Gaussians that an image can show, and some more; None is all."""
        if self.gaussians.means.requires_grad:
            return None
        reach_m = self.actors.bending.reach_m(posed.taken_ns)
        is_seen = self._blocks.in_view(posed.looks(), actor_slack_m=reach_m)
        return is_seen.nonzero()[:, 0]

    @cached_property
    def _blocks(self) -> SpatialBlocks:
        """Of Gaussians that stay as they are, but for what a rolling shutter makes of them."""
        bodies, body_index = 1 + len(self.actors.recorded_tracks), self.gaussians.body_index
        lowest, highest = torch.cat([body_index, body_index.new_zeros(1)]).aminmax()
        if int(lowest) < 0 or int(highest) >= bodies:
            raise ShapeError(
                f"Gaussians of a scene with {bodies - 1} actors belong to bodies {int(lowest)} to "
                f"{int(highest)}"
            )
        return SpatialBlocks.of(self.gaussians, 1.001 * MOST_GROWTH * MOST_SIGMAS)

    def refined_camera(
        self, view: TrainingView | RecordedView, camera: Camera | None = None
    ) -> Camera:
        """The camera of a recorded view at its refined pose; see `CameraCorrections.refined`.

        `camera` is the view's at another size.
        """
        taken = view.camera if camera is None else camera
        return self.cameras.refined(taken, view.key, view.timestamp_ns)

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

    def with_actors(self, actors: Actors) -> "GaussianScene":
        """The same scene whose actors, the same ones, stand elsewhere.

        What was found out about Gaussians in their bodies is kept: no pose changes it.
        """
        other = replace(self, actors=actors)
        other.__dict__.update(_blocks=self._blocks, _styled=self._styled)
        return other

    def baked(
        self, timestamp_ns: int, eye_world: Float[Tensor, "3"] | None = None
    ) -> "GaussianScene":
        """The scene as its style shows it at a time, without the style: for formats without one.

        Air and wet roads look as from `eye_world`; None takes where the car was that recorded.
        Lamps light what they light, but do not shine into the camera themselves.
        """
        styled, strengths = self._styled_at(timestamp_ns)
        if styled is None:
            return replace(self, style=None)
        gaussians, sky = styled.baked(timestamp_ns, strengths, eye_world)
        return replace(self, style=None, gaussians=gaussians, sky=sky)

    def _styled_at(self, timestamp_ns: int) -> tuple[StyledGaussians | None, dict[str, float]]:
        """The Gaussians in their style, and how strong it is; None where it changes nothing."""
        strengths = {} if self.style is None else self.style.strengths(timestamp_ns)
        return (self._styled, strengths) if strengths else (None, {})

    @cached_property
    def _styled(self) -> StyledGaussians | None:
        """What a style makes of the Gaussians, which stay as they are; None without a style."""
        if self.style is None:
            return None
        return StyledGaussians(
            gaussians=self.gaussians, actors=self.actors, sky=self.sky, style=self.style
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
