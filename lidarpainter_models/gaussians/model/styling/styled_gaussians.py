"""Gaussians in a style at any time: the colours in which a camera sees them, their sky, lamps.

What does not change from view to view is kept: surfaces, and the light of the strengths asked for
last. A view costs a pass over the Gaussians in it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import ActorPoses, Actors
from lidarpainter_models.gaussians.model.corrections import ExposureCorrections
from lidarpainter_models.gaussians.model.drawing import SceneRender, camera_from_body
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.scene_rendering import DrawableScene, PosedScene
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.styling.glare import add_glare
from lidarpainter_models.gaussians.model.styling.lamps import (
    CarLamps,
    ego_beam,
    fixed_lamps,
    heads_at,
    lamps_at,
    no_lamps,
)
from lidarpainter_models.gaussians.model.styling.light import (
    StyledLight,
    fixed_irradiance,
    styled_light,
)
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle
from lidarpainter_models.gaussians.model.styling.traits import SurfaceTraits, surface_traits
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.scene_light import Lamps, seen_harmonics


@dataclass(frozen=True, kw_only=True, eq=False)
class StyledGaussians:
    """The parts of a scene that a style changes, and the style."""

    gaussians: GaussianSet
    actors: Actors
    sky: SkyTexture
    style: SceneStyle
    _lit: dict[tuple[tuple[str, float], ...], StyledLight] = field(
        default_factory=dict, init=False, repr=False
    )
    """The light made last, by strengths; at most one."""

    def drawable(
        self, posed: PosedScene, strengths: Mapping[str, float], exposure: ExposureCorrections
    ) -> DrawableScene:
        """What the image of a posed scene is made of, with styles of these strengths."""
        light = self.light(strengths)
        sh = self._seen_sh(light, posed.camera, posed.bodies, posed.poses, posed.taken_ns)
        styled = SeenGaussians.of(self.gaussians, sh)
        return DrawableScene(
            posed=posed,
            gaussians=posed.shown(styled),
            rows=styled.rows,
            sky=light.sky,
            exposure=exposure,
            lens=partial(self._with_glare, posed, light) if "night" in strengths else None,
        )

    def _with_glare(self, posed: PosedScene, light: StyledLight, drawn: SceneRender) -> SceneRender:
        """An image of the night with the lamps that shine into its camera."""
        rgb = add_glare(
            drawn.rgb,
            drawn.depth_m,
            posed.camera,
            heads_at(self.style.place, self._cars, *posed.poses, posed.taken_ns),
            strength=light.strengths["night"],
            extinction_per_m=light.surroundings.extinction_per_m,
        )
        return replace(drawn, rgb=rgb)

    def baked(
        self,
        timestamp_ns: int,
        strengths: Mapping[str, float],
        eye_world: Float[Tensor, "3"] | None,
    ) -> tuple[GaussianSet, SkyTexture]:
        """Gaussians and sky whose own colours are those of the style, from one point at a time.

        Only air and wet roads depend on the point: where the headlamps of the car that recorded
        are, by default. What shines into a lens is left out.
        """
        with torch.no_grad():
            poses = self.actors.refined_poses(timestamp_ns)
            if eye_world is None:
                eye_world = ego_beam(self.style.place, timestamp_ns)[0]
            world_from_eye = torch.eye(4, dtype=torch.float64)
            world_from_eye[:3, 3] = eye_world.double().cpu()
            light = self.light(strengths)
            bodies = camera_from_body(world_from_eye, *poses)
            sh = self._seen_sh(light, None, bodies, poses, timestamp_ns)
            columns = self.gaussians.columns()
            columns |= {"sh_dc": sh[:, :1].contiguous(), "sh_rest": sh[:, 1:].contiguous()}
            return GaussianSet(**columns), light.sky

    def light(self, strengths: Mapping[str, float]) -> StyledLight:
        """What does not depend on the view or on what moves."""
        key = tuple(sorted(strengths.items()))
        if key not in self._lit:
            self._lit.clear()
            self._lit[key] = styled_light(
                self.gaussians, self.sky, self._traits, self.style, strengths, self._lamp_light
            )
        return self._lit[key]

    def _seen_sh(
        self,
        light: StyledLight,
        camera: Camera | None,
        bodies: Float[Tensor, "bodies 4 4"],
        poses: ActorPoses,
        timestamp_ns: int,
    ) -> Float[Tensor, "gaussians coefficients 3"]:
        """Harmonics of every Gaussian as a camera sees it; of None, as from where it stands."""
        like = self.gaussians.means
        lamps = no_lamps(self.style.place)
        if "night" in light.strengths:
            fixed = self._fixed_lamps
            lamps = lamps_at(self.style.place, fixed, self._cars, *poses, timestamp_ns)
        street = torch.eye(4, dtype=torch.float64, device=poses[0].device)[None]
        return seen_harmonics(
            self._traits.surfaces,
            light.appearance,
            light.surroundings,
            lamps,
            camera,
            torch.cat([street, poses[0]]).to(like.device),
            bodies.to(like.device),
        )

    @cached_property
    def _traits(self) -> SurfaceTraits:
        return surface_traits(self.gaussians, self.style.place)

    @cached_property
    def _lamp_light(self) -> Float[Tensor, "gaussians 3"]:
        return fixed_irradiance(self._traits, self.style.place)

    @cached_property
    def _fixed_lamps(self) -> Lamps:
        return fixed_lamps(self.style.place)

    @cached_property
    def _cars(self) -> CarLamps:
        return CarLamps.of(self.actors, self.style.lamps)
