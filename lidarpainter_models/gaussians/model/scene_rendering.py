"""A scene at one moment before one camera: the one way from a scene to what is drawn of it.

Whoever shows a scene (a fit, an image, its masks, the search for lamps, a browser, an export) asks
here where its bodies stand and what its Gaussians are then: lit by their lamps, bent as people are,
and each where it is when the shutter of the camera reads its pixel. What a style makes of colours
comes before, sky, lens and exposure after (`DrawableScene`).

Camera frame: x right, y down, z forward; world: z up; metres.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import ActorPoses, Actors
from lidarpainter_models.gaussians.model.blinking import Blinking
from lidarpainter_models.gaussians.model.corrections import ExposureCorrections
from lidarpainter_models.gaussians.model.drawing import (
    SceneRender,
    camera_from_body,
    draw_gaussians,
    draw_over_sky,
)
from lidarpainter_models.gaussians.model.rolling_shutter import as_read, bodies_while_read
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians, DrawableGaussians
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.spatial_blocks import View
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster import SplatImage


def gaussians_at(
    gaussians: AnyGaussians, actors: Actors, blinking: Blinking, timestamp_ns: int | None
) -> AnyGaussians:
    """Gaussians of a scene at a time, each still in the frame of its own body.

    Differentiable in centres and colours. None is for what holds many moments and cannot change
    Gaussians from one to the next: lamps are lit as on average, actors have their mean light, and
    nobody bends.
    """
    if timestamp_ns is None:
        return blinking.lit_on_average(gaussians)
    lit = actors.light.lit(blinking.lit(gaussians, timestamp_ns), timestamp_ns)
    return bent_at(lit, actors, timestamp_ns)


def bent_at(gaussians: AnyGaussians, actors: Actors, timestamp_ns: int) -> AnyGaussians:
    """Gaussians as people hold their limbs at a time, in the colours that they have."""
    return actors.bending.bent(gaussians, timestamp_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedScene:
    """Where the bodies of a scene stand before a camera while it takes an image."""

    camera: Camera
    """At its refined pose; where it is differentiable, `bodies` carry the gradient."""
    taken_ns: int
    """When the middle of the image is read."""
    poses: ActorPoses
    """World poses of the actors at that time, and which of them are there."""
    bodies: Float[Tensor, "bodies 4 4"]
    """`camera_from_body` of the street and every actor; float32, on the CPU."""
    actors: Actors
    blinking: Blinking

    @classmethod
    def of(
        cls,
        actors: Actors,
        blinking: Blinking,
        camera: Camera,
        taken_ns: int,
        *,
        poses: ActorPoses,
        world_from_camera: Float[Tensor, "4 4"] | None = None,
    ) -> "PosedScene":
        """Place the bodies before a camera; `world_from_camera` is its own pose with a gradient."""
        pose = camera.world_from_camera if world_from_camera is None else world_from_camera
        return cls(
            camera=camera,
            taken_ns=taken_ns,
            poses=poses,
            bodies=camera_from_body(pose, *poses),
            actors=actors,
            blinking=blinking,
        )

    def held(self) -> "PosedScene":
        """The same, but no gradient reaches poses, bending and the light of actors."""
        bending, light = self.actors.bending, self.actors.light
        still = replace(bending, offset_m=bending.offset_m.detach())
        steady = replace(light, log_gain=light.log_gain.detach())
        world_from_actors, present = self.poses
        return replace(
            self,
            poses=(world_from_actors.detach(), present),
            bodies=self.bodies.detach(),
            actors=replace(self.actors, bending=still, light=steady),
        )

    def looks(self) -> list[View]:
        """The camera and its bodies in moments that show all that the image can show.

        These are the middle of the image and, where a shutter rolls, when its first and its last
        pixel is read; without gradient.
        """
        bodies = self.bodies.detach()
        read = bodies_while_read(bodies, self.camera, self.actors, self.taken_ns)
        return [(self.camera, moment) for moment in (bodies, *read)]

    def shown(self, gaussians: AnyGaussians) -> AnyGaussians:
        """Gaussians of the scene as this image shows them, in the frames of their bodies.

        Lit, bent, and as the shutter reads them; differentiable in centres, sizes and colours.
        """
        then = gaussians_at(gaussians, self.actors, self.blinking, self.taken_ns)
        return as_read(then, self.bodies, self.camera, self.actors, self.taken_ns)

    def draw(
        self,
        gaussians: AnyGaussians,
        *,
        with_actor_alpha: bool = False,
        channel: Float[Tensor, "gaussians 1"] | None = None,
        screen_gradient_out: Float[Tensor, " gaussians"] | None = None,
    ) -> SplatImage:
        """Blend Gaussians of the scene as this image shows them; see `draw_gaussians`."""
        return draw_gaussians(
            self.shown(gaussians),
            self.bodies,
            self.camera,
            with_actor_alpha=with_actor_alpha,
            channels=channel,
            screen_gradient_out=screen_gradient_out,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawableScene:
    """All that an image of a scene is made of; without gradient."""

    posed: PosedScene
    gaussians: DrawableGaussians
    """As the image shows them (`PosedScene.shown`), in the colours of the style if there is one."""
    rows: Int[Tensor, " gaussians"]
    """Which of the scene's Gaussians these are: at least all that the image can show."""
    sky: SkyTexture
    exposure: ExposureCorrections
    lens: Callable[[SceneRender], SceneRender] | None = None
    """What happens in the lens: the glare of lamps at night."""

    @torch.no_grad()
    def render(self, *, camera_name: str | None = None) -> SceneRender:
        """Draw it over its sky, with colours exposed as those of `camera_name`, if there is one."""
        posed = self.posed
        drawn = draw_over_sky(self.gaussians, posed.bodies, self.sky, posed.camera)
        drawn = drawn if self.lens is None else self.lens(drawn)
        rgb = self.exposure.apply(drawn.rgb, camera_name, posed.taken_ns)
        return replace(drawn, rgb=rgb)
