"""Carry recorded images into another view by depth.

Backward warping: every pixel of the target is lifted to its world point, moved with its actor to
the time of the source, projected into the source and sampled there, if the source saw the same
surface (its depth agrees). Sky is a surface at infinity.

Frames: world z up; camera x right, y down, z forward; depth is camera z in metres, 0 = none;
pixel centres at half-integers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.moving_boxes import BoxConfig, MovingBoxes
from lidarpainter_models.scenes.driving_scene import ActorTrack

SKY_DEPTH_M = 1e5
"""Far enough for any parallax to vanish, near enough for float32."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WarpConfig:
    """When a recorded pixel may stand for one of another view."""

    depth_tolerance: float = 0.04
    """Relative difference of depth up to which two views see the same surface."""
    sky_alpha: float = 0.5
    """A pixel more transparent than this, and without depth, is sky."""
    boxes: BoxConfig = field(default_factory=BoxConfig)
    time_weight_m_s: float = 2.0
    """Metres a source may stand nearer for each second it is older."""
    angle_weight_m_rad: float = 8.0
    """Metres a source may stand nearer for each radian it looks elsewhere."""

    def __post_init__(self) -> None:
        """Refuse tolerances that accept nothing or everything."""
        if not 0 < self.depth_tolerance < 1:
            raise ConfigError(f"depth_tolerance must be in (0, 1), got {self.depth_tolerance}")
        if not 0 < self.sky_alpha < 1:
            raise ConfigError(f"sky_alpha must be in (0, 1), got {self.sky_alpha}")


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceImage:
    """A recorded image with the surfaces it shows."""

    key: tuple[int, str]
    """(frame index, camera name)."""
    camera: Camera
    timestamp_ns: int
    rgb: Float[Tensor, "height width 3"]
    depth_m: Float[Tensor, "height width"]
    alpha: Float[Tensor, "height width"]


def source_cost_m(
    target_camera: Camera, timestamp_ns: int, camera: Camera, taken_ns: int, config: WarpConfig
) -> float:
    """How far a recorded view is from a target in place, direction and time, as metres."""
    distance_m = (camera.centre_world - target_camera.centre_world).norm()
    axis, target_axis = camera.world_from_camera[:3, 2], target_camera.world_from_camera[:3, 2]
    angle_rad = torch.arccos((axis @ target_axis).clamp(-1, 1))
    seconds = abs(taken_ns - timestamp_ns) * 1e-9
    return float(
        distance_m + config.angle_weight_m_rad * angle_rad + config.time_weight_m_s * seconds
    )


def nearest_sources(
    target_camera: Camera,
    timestamp_ns: int,
    sources: Sequence[SourceImage],
    *,
    count: int,
    exclude: frozenset[tuple[int, str]] = frozenset(),
    config: WarpConfig | None = None,
) -> tuple[SourceImage, ...]:
    """The `count` sources nearest in place, direction and time; ties go to the earlier one."""
    config = config or WarpConfig()
    allowed = [source for source in sources if source.key not in exclude]
    allowed.sort(
        key=lambda source: source_cost_m(
            target_camera, timestamp_ns, source.camera, source.timestamp_ns, config
        )
    )
    return tuple(allowed[:count])


def warp_images(
    target_camera: Camera,
    target_timestamp_ns: int,
    target_depth_m: Float[Tensor, "height width"],
    target_alpha: Float[Tensor, "height width"],
    sources: Sequence[SourceImage],
    tracks: Sequence[ActorTrack],
    *,
    config: WarpConfig | None = None,
) -> tuple[Float[Tensor, "sources height width 3"], Bool[Tensor, "sources height width"]]:
    """Every source as the target camera would see it, and where that is known.

    A pixel without depth is sky if its alpha is low, else nothing is known of it. `tracks` are
    the moving actors. Images are 0 where they are not valid.
    """
    config = config or WarpConfig()
    height_px, width_px = target_depth_m.shape
    has_depth = target_depth_m > 0
    is_sky = ~has_depth & (target_alpha < config.sky_alpha)
    depth_m = torch.where(has_depth, target_depth_m, SKY_DEPTH_M)
    points_world = target_camera.unproject(depth_m).reshape(-1, 3)
    known = (has_depth | is_sky).reshape(-1)
    boxes = MovingBoxes(tracks, config.boxes)
    owners = boxes.owners(points_world, target_timestamp_ns)
    images, valids = [], []
    for source in sources:
        points, present = boxes.moved(
            points_world, owners, from_ns=target_timestamp_ns, to_ns=source.timestamp_ns
        )
        rgb, seen = sample_source(source, points, is_sky.reshape(-1), config=config)
        valid = (seen & present & known).reshape(height_px, width_px)
        images.append(torch.where(valid[..., None], rgb.reshape(height_px, width_px, 3), 0))
        valids.append(valid)
    if not images:
        empty = target_depth_m.new_zeros(0, height_px, width_px)
        return empty[..., None].expand(-1, -1, -1, 3), empty.to(torch.bool)
    return torch.stack(images), torch.stack(valids)


def sample_source(
    source: SourceImage,
    points_world: Float[Tensor, "points 3"],
    is_sky: Bool[Tensor, " points"],
    *,
    config: WarpConfig,
) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
    """Colour of world points in a source, and whether the source saw just these points.

    Inverse depth is interpolated, not depth: on a plane it is linear in the image, so a surface
    at a grazing angle passes the test, while a depth edge lies between both sides and fails it.
    """
    camera = source.camera
    pixels_uv, depth_m = camera.project(points_world)
    size = pixels_uv.new_tensor([camera.width_px, camera.height_px])
    rim_px = 0.49  # half a pixel less rounding: outside it nothing can be interpolated
    inside = ((pixels_uv >= rim_px) & (pixels_uv <= size - rim_px)).all(dim=-1) & (depth_m > 0.1)
    grid = torch.where(inside[:, None], pixels_uv / size * 2 - 1, 0)
    has_depth = source.depth_m > 0
    inverse = torch.where(has_depth, 1 / source.depth_m.clamp(min=1e-3), 0)
    is_source_sky = (~has_depth & (source.alpha < config.sky_alpha)).to(source.rgb)
    layers = torch.cat([source.rgb, inverse[..., None], is_source_sky[..., None]], dim=-1)
    sampled = torch.nn.functional.grid_sample(
        layers.permute(2, 0, 1)[None], grid[None, None], padding_mode="border", align_corners=False
    )[0, :, 0].T
    same = (sampled[:, 3] * depth_m - 1).abs() <= config.depth_tolerance
    same_surface = same & (sampled[:, 4] < config.sky_alpha)
    same_sky = sampled[:, 4] > 1 - 1e-3
    return sampled[:, :3], inside & torch.where(is_sky, same_sky, same_surface)
