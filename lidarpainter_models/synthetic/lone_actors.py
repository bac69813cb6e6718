"""One actor of a synthetic street as it truly looks from anywhere, with all else left out.

It stands where it stands, in the light of the street: what shades it there shades it here too.
World: x forward, y left, z up; metres.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.synthetic.raytracing.render import render_image
from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    SUN_RGB,
    InstanceArrays,
    SceneArrays,
    ViewArrays,
)
from lidarpainter_models.synthetic.raytracing.sunlight import is_shaded
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.synthetic.world.packing import lone_scene

FINER = 2
"""An image is traced so many times as fine, one ray for each fine pixel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoneImage:
    """An actor before nothing."""

    rgb: Float[Tensor, "height width 3"]
    """The mean of what of a pixel is covered; 0 where nothing is."""
    is_covered: Bool[Tensor, "height width"]
    """Pixels that the actor covers at least half of."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LoneActor:
    """One actor of a street at one time."""

    street: SyntheticStreet
    actor_index: int
    timestamp_ns: int

    def render(self, camera: Camera) -> LoneImage:
        """See it with a camera that stands in the frame of its box."""
        fine = camera.resized(width_px=FINER * camera.width_px, height_px=FINER * camera.height_px)
        pose = self._world_from_box @ fine.world_from_camera.double()
        view = ViewArrays(
            world_from_camera=np.ascontiguousarray(pose[None, :3].numpy()),
            intrinsics=np.array([fine.fx_px, fine.fy_px, fine.cx_px, fine.cy_px], float),
            offsets=np.array([[0.5, 0.5]]),
            footprint_px=1.0,
        )
        size = (fine.height_px, fine.width_px)
        lit, depth_m, _, owner = render_image(self._alone, _nobody(), view, *size)
        shaded = render_image(self._without_sun, _nobody(), view, *size)[0]
        hit = torch.from_numpy(owner >= 0)
        points = fine.at(pose).unproject(torch.from_numpy(depth_m))[hit].double()
        is_dark = torch.from_numpy(self._is_shaded(points.numpy()))
        rgb = torch.from_numpy(lit) * hit[..., None]
        rgb[hit] = torch.where(is_dark[:, None], torch.from_numpy(shaded)[hit], rgb[hit])
        count = _summed(hit.float()[..., None])
        return LoneImage(
            rgb=_summed(rgb) / count.clamp(min=1), is_covered=count[..., 0] >= FINER**2 / 2
        )

    @cached_property
    def _world_from_box(self) -> Float[Tensor, "4 4"]:
        return self.street.actors(self.timestamp_ns)[self.actor_index].world_from_box.double()

    @cached_property
    def _alone(self) -> SceneArrays:
        mesh = self.street.city.actors[self.actor_index].meshes[0]
        return lone_scene(self.street.city.arrays, mesh.transformed(self._world_from_box.numpy()))

    @cached_property
    def _without_sun(self) -> SceneArrays:
        light = self._alone.light.copy()
        light[SUN_RGB : SUN_RGB + 3] = 0
        return self._alone._replace(light=light)

    def _is_shaded(self, points_world: np.ndarray) -> np.ndarray:
        """Whether somebody or something else stands between points (points, 3) and the sun."""
        arrays = self.street.city.arrays
        instances = self.street.instances(self.timestamp_ns)
        return is_shaded(arrays, instances, np.ascontiguousarray(points_world), self.actor_index)


def _summed(values: Float[Tensor, "height width channels"]) -> Float[Tensor, "rows columns n"]:
    """Sums over blocks of fine pixels."""
    rows = values.unflatten(0, (-1, FINER)).sum(1)
    return rows.unflatten(1, (-1, FINER)).sum(2)


def _nobody() -> InstanceArrays:
    """Nothing moves, no lamp switches."""
    return InstanceArrays(
        roots=np.zeros((1, 0), np.int32),
        radius_m=np.zeros(0),
        world_from_box=np.zeros((1, 0, 3, 4)),
        contact=np.zeros((1, 0, 6)),
        is_lit=np.zeros((1, 64), np.float32),
    )
