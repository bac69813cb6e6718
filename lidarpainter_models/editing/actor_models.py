"""An actor apart from any scene: its Gaussians and points in its box frame, and its size.

Box frame: x along the length, y left, z up, origin at the centre; metres.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet, sh_from_rgb
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.scenes.tracks import ActorTrack

SHADOW_HEIGHT_M = 0.03
"""Above the bottom of the box: over the road, under the car."""
SHADOW_CELL_M = 0.3
SHADOW_OPACITY = 0.16
"""Of one disc; three lie over one another, and take four tenths of the light."""
SHADOW_REACH_M = 0.9
SHADOW_FALL_PER_M = 3.2
MAX_POINTS = 5000
OPAQUE = 0.5
MAX_GAIN = 2.5
"""Two recordings of asphalt that differ by more in brightness show no difference of exposure."""
MAX_CAST = 1.25
"""Likewise in the share of a channel: then the roads are of different colour, not the light."""
NEUTRAL_ROAD_RGB = (0.4, 0.4, 0.4)
"""What asphalt looks like to a neutral camera: assets are kept so."""
LIGHTEST, DARKEST = 0.9, 0.02


@dataclass(frozen=True, eq=False, kw_only=True)
class ActorModel:
    """What somebody looks like."""

    gaussians: GaussianSet
    """Gaussians of body 0, in the box frame."""
    points: MapPoints
    """Its LiDAR points; none where nobody measured it."""
    size_m: Float[Tensor, "3"]
    category: str
    road_rgb: Float[Tensor, "3"] | None = None
    """Colour of the road where it was recorded, which tells its exposure."""

    @classmethod
    def of_gaussians(cls, gaussians: GaussianSet, category: str) -> "ActorModel":
        """A model of which only Gaussians are known: its box is what the opaque ones fill.

        Raises:
            SceneError: there is nothing opaque.
        """
        seen = gaussians.means[gaussians.opacity > OPAQUE]
        if not len(seen):
            raise SceneError("an actor's Gaussians hold nothing opaque, expected a car")
        low, high = (seen.quantile(share, dim=0) for share in (0.005, 0.995))
        centred = gaussians.of_body(0)
        centred = replace(centred, means=centred.means - (low + high) / 2)
        return cls(
            gaussians=centred,
            points=sampled_points(centred),
            size_m=(high - low).clamp(min=0.1),
            category=category,
        )

    def driving(
        self, name: str, times_ns: Int[Tensor, " times"], poses: Float[Tensor, "times 4 4"]
    ) -> ActorTrack:
        """The track of somebody who looks so, where no LiDAR saw it."""
        return ActorTrack(
            actor_id=name,
            category=self.category,
            is_moving=True,
            size_m=self.size_m,
            frame_indices=torch.arange(len(times_ns)),
            timestamps_ns=times_ns,
            world_from_box=poses,
            num_points=torch.zeros_like(times_ns),
        )

    def scaled(self, factor: float) -> "ActorModel":
        """The same, larger or smaller about the middle of its box."""
        own = self.gaussians
        larger = replace(own, means=own.means * factor, log_scale=own.log_scale + math.log(factor))
        return replace(
            self,
            gaussians=larger,
            points=replace(self.points, xyz_m=self.points.xyz_m * factor),
            size_m=self.size_m * factor,
        )

    def exposed_like(self, road_rgb: Float[Tensor, "3"] | None) -> "ActorModel":
        """The same in the light of another scene, told by the colour of its road."""
        if road_rgb is None or self.road_rgb is None:
            return self
        gain = exposure_gain(self.road_rgb, road_rgb)
        rgb_u8 = (self.points.rgb_u8 * gain).round().clamp(0, 255).to(torch.uint8)
        return replace(
            self,
            gaussians=exposed(self.gaussians, gain),
            points=replace(self.points, rgb_u8=rgb_u8),
            road_rgb=self.road_rgb * gain,
        )

    def with_points_all_round(self) -> "ActorModel":
        """The same with points on all opaque Gaussians in place of those that LiDAR measured.

        LiDAR saw one side: through the others a painter would be shown the street behind.
        """
        return replace(self, points=sampled_points(self.gaussians))

    def of_degree(self, sh_degree: int) -> "ActorModel":
        """The same with harmonics of another degree."""
        return replace(self, gaussians=of_degree(self.gaussians, sh_degree))

    def with_shadow(self) -> "ActorModel":
        """The same with a soft shadow where it touches the road; one that it had goes."""
        black = (self.gaussians.sh_dc == sh_from_rgb(torch.zeros(1, 3))).all(dim=2)[:, 0]
        kept = self.gaussians.select((~black).nonzero()[:, 0])
        shadow = contact_shadow(self.size_m, sh_degree=kept.sh_degree)
        return replace(self, gaussians=kept.append(shadow))


def exposure_gain(
    own_road_rgb: Float[Tensor, "3"], road_rgb: Float[Tensor, "3"]
) -> Float[Tensor, "3"]:
    """What colours are multiplied by, channel by channel, to go from one scene into another.

    A factor, since a camera's curve is nearly a power: exposure and white balance multiply before
    it, hence after it too.
    """
    brightness = (road_rgb.mean() / own_road_rgb.mean()).clamp(1 / MAX_GAIN, MAX_GAIN)
    cast = (road_rgb / road_rgb.mean()) / (own_road_rgb / own_road_rgb.mean())
    return brightness * cast.clamp(1 / MAX_CAST, MAX_CAST)


def of_degree(gaussians: GaussianSet, sh_degree: int) -> GaussianSet:
    """Gaussians with harmonics of another degree: what is more is left out, what lacks is 0."""
    wanted = (sh_degree + 1) ** 2 - 1
    rest = torch.zeros(len(gaussians), wanted, 3)
    kept = min(wanted, gaussians.sh_rest.shape[1])
    rest[:, :kept] = gaussians.sh_rest[:, :kept]
    return replace(gaussians, sh_rest=rest)


def exposed(gaussians: GaussianSet, gain: Float[Tensor, "3"]) -> GaussianSet:
    """Gaussians of other brightness, channel by channel."""
    sh_dc = sh_from_rgb(gaussians.base_rgb * gain)
    return replace(gaussians, sh_dc=sh_dc, sh_rest=gaussians.sh_rest * gain)


def contact_shadow(size_m: Float[Tensor, "3"], *, sh_degree: int) -> GaussianSet:
    """Black discs under a box, fainter the farther they are outside it."""
    half_m = size_m[:2] / 2
    axes = [
        torch.arange(-reach_m, reach_m + 1e-6, SHADOW_CELL_M)
        for reach_m in (half_m + SHADOW_REACH_M).tolist()
    ]
    xy_m = torch.cartesian_prod(*axes)
    outside_m = (xy_m.abs() - half_m).clamp(min=0).norm(dim=1)
    opacity = SHADOW_OPACITY * torch.exp(-SHADOW_FALL_PER_M * outside_m)
    count = len(xy_m)
    height_m = torch.full((count, 1), SHADOW_HEIGHT_M - float(size_m[2]) / 2)
    flat_m = torch.tensor([0.7 * SHADOW_CELL_M, 0.7 * SHADOW_CELL_M, 0.005])
    return GaussianSet(
        means=torch.cat([xy_m, height_m], dim=1),
        rotation_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        log_scale=flat_m.log().repeat(count, 1),
        opacity_logit=opacity.logit(),
        sh_dc=sh_from_rgb(torch.zeros(count, 3)),
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        body_index=torch.zeros(count, dtype=torch.int32),
    )


def sampled_points(gaussians: GaussianSet) -> MapPoints:
    """Points on the opaque Gaussians of somebody whom no LiDAR measured."""
    rows = (gaussians.opacity > OPAQUE).nonzero()[:, 0]
    rows = rows[:: max(1, len(rows) // MAX_POINTS)]
    zeros = torch.zeros(len(rows), dtype=torch.int64)
    rgb_u8 = (gaussians.base_rgb[rows].clamp(0, 1) * 255).round().to(torch.uint8)
    bare = MapPoints.uncoloured(
        xyz_m=gaussians.means[rows].contiguous(),
        frame_index=zeros,
        timestamp_ns=zeros.clone(),  # files of tensors refuse what shares memory
        range_m=torch.full((len(rows),), 10.0),
    )
    return replace(bare, rgb_u8=rgb_u8, has_colour=torch.ones(len(rows), dtype=torch.bool))


def road_colour(lidar_map: LidarMap, xyz_m: Float[Tensor, "places 3"]) -> Float[Tensor, "3"] | None:
    """Median colour of the road along a path on it; None where no image saw it."""
    street = lidar_map.street
    low, high = xyz_m[:, :2].amin(0) - 2, xyz_m[:, :2].amax(0) + 2
    inside = ((street.xyz_m[:, :2] >= low) & (street.xyz_m[:, :2] <= high)).all(dim=1)
    rows = (inside & street.has_colour).nonzero()[:, 0]
    if not len(rows):
        return None
    height_m = street.xyz_m[rows, 2]
    low_rows = rows[height_m <= height_m.quantile(0.5)] if len(rows) < 1_000_000 else rows
    rgb = street.rgb_u8[low_rows].float().median(dim=0).values / 255
    return rgb.clamp(DARKEST, LIGHTEST)
