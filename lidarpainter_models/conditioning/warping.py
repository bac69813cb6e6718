"""Carry recorded images into another view by depth, and patch its references together from them.

Backward warping: every pixel of the target is lifted to its world point, moved with its actor to
the time of the source, projected into the source and sampled there, if the source saw the same
surface (its depth agrees). Sky is a surface at infinity.

A pixel is looked for in the recorded images, nearest first, until as many as wanted have shown it;
so one reference is a patchwork of images and covers what any of them saw. A pixel may have several
guesses of its depth (the render's, the LiDAR's): the next one is tried where no image agreed with
the one before.

Frames: world z up; camera x right, y down, z forward; depth is camera z in metres, 0 = none;
pixel centres at half-integers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.points_on_actors import MovingBoxes

SKY_DEPTH_M = 1e5
"""Far enough for any parallax to vanish, near enough for float32."""
DEPTH_TOLERANCE = 0.04  # relative difference of depth up to which two views see the same surface
SKY_ALPHA = 0.5  # a pixel more transparent than this, and without depth, is sky
TIME_WEIGHT_M_S = 2.0  # metres a source may stand nearer for each second it is older
ANGLE_WEIGHT_M_RAD = 8.0  # metres a source may stand nearer for each radian it looks elsewhere


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

    def without(
        self, hidden: Bool[Tensor, "height width"], rgb: Float[Tensor, "height width 3"]
    ) -> "SourceImage":
        """The same image where nothing is found in some pixels; seen whole, it shows others."""
        return replace(
            self,
            rgb=torch.where(hidden[..., None], rgb, self.rgb),
            depth_m=torch.where(hidden, 0.0, self.depth_m),
            alpha=torch.where(hidden, 1.0, self.alpha),
        )

    @cached_property
    def is_sky(self) -> Bool[Tensor, "height width"]:
        """What is clear and has no depth."""
        return (self.depth_m <= 0) & (self.alpha < SKY_ALPHA)

    @cached_property
    def layers(self) -> Float[Tensor, "1 5 height width"]:
        """Colour, inverse depth (0 where there is none) and sky, for sampling."""
        inverse = torch.where(self.depth_m > 0, 1 / self.depth_m.clamp(min=1e-3), 0)
        planes = [*self.rgb.unbind(-1), inverse, self.is_sky.to(self.rgb)]
        return torch.stack(planes)[None]


def source_costs_m(
    target_camera: Camera,
    timestamp_ns: int,
    world_from_cameras: Float[Tensor, "views 4 4"],
    taken_ns: Int[Tensor, " views"],
) -> Float[Tensor, " views"]:
    """How far recorded views are from a target in place, direction and time, as metres."""
    target = target_camera.world_from_camera.to(world_from_cameras)
    distance_m = (world_from_cameras[:, :3, 3] - target[:3, 3]).norm(dim=1)
    cosine = world_from_cameras[:, :3, 2] @ target[:3, 2]
    seconds = (taken_ns - timestamp_ns).abs() * 1e-9
    angle_rad = torch.arccos(cosine.clamp(-1, 1))
    return distance_m + ANGLE_WEIGHT_M_RAD * angle_rad + TIME_WEIGHT_M_S * seconds


def sample_source(
    source: SourceImage, points_world: Float[Tensor, "points 3"], is_sky: Bool[Tensor, " points"]
) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
    """Colour of world points in a source, and whether the source saw just these points.

    Inverse depth is interpolated, not depth: on a plane it is linear in the image, so a surface
    at a grazing angle passes the test, while a depth edge lies between both sides and fails it.
    """
    camera = source.camera
    pixels_uv, depth_m = camera.project(points_world)
    size = torch.tensor([camera.width_px, camera.height_px]).to(pixels_uv, non_blocking=True)
    rim_px = 0.49  # half a pixel less rounding: outside it nothing can be interpolated
    inside = ((pixels_uv >= rim_px) & (pixels_uv <= size - rim_px)).all(dim=-1) & (depth_m > 0.1)
    grid = torch.where(inside[:, None], pixels_uv / size * 2 - 1, 0)
    sampled = torch.nn.functional.grid_sample(
        source.layers, grid[None, None], padding_mode="border", align_corners=False
    )[0, :, 0].T
    same = (sampled[:, 3] * depth_m - 1).abs() <= DEPTH_TOLERANCE
    same_surface = same & (sampled[:, 4] < SKY_ALPHA)
    same_sky = sampled[:, 4] > 1 - 1e-3
    return sampled[:, :3], inside & torch.where(is_sky, same_sky, same_surface)


class WarpTarget(NamedTuple):
    """The view that references are wanted for."""

    camera: Camera
    timestamp_ns: int
    depth_guesses_m: Sequence[Float[Tensor, "height width"]]
    """The most trusted first; 0 where a guess knows nothing."""
    is_sky: Bool[Tensor, "height width"]
    """Looked for at infinity where the first guess knows nothing."""

    @classmethod
    def of_render(
        cls,
        camera: Camera,
        timestamp_ns: int,
        depth_m: Float[Tensor, "height width"],
        alpha: Float[Tensor, "height width"],
    ) -> "WarpTarget":
        """A view of which the render alone is known; what has no depth and is clear is sky."""
        return cls(camera, timestamp_ns, [depth_m], alpha < SKY_ALPHA)


class WarpedReferences(NamedTuple):
    """Recorded colours in another view, best first; 0 where not valid."""

    rgb: Float[Tensor, "references height width 3"]
    valid: Bool[Tensor, "references height width"]


class _Search(NamedTuple):
    """Flat target pixels: where one guess puts them, and the colours found so far."""

    points_world: Float[Tensor, "pixels 3"]
    is_sky: Bool[Tensor, " pixels"]
    looked_for: Bool[Tensor, " pixels"]
    rgb: Float[Tensor, "references pixels 3"]
    num_found: Int[Tensor, " pixels"]


def warped_references(
    target: WarpTarget, sources: Sequence[SourceImage], boxes: MovingBoxes, *, count: int
) -> WarpedReferences:
    """Patch `count` references together from sources given best first."""
    height_px, width_px = target.is_sky.shape
    num_pixels = height_px * width_px
    device = target.is_sky.device
    rgb = torch.zeros(count, num_pixels, 3, device=device)
    num_found = torch.zeros(num_pixels, dtype=torch.int64, device=device)
    for number, guess in enumerate(target.depth_guesses_m):
        is_sky = target.is_sky & (guess == 0) & (number == 0)
        depth_m = torch.where(is_sky, SKY_DEPTH_M, guess)
        search = _Search(
            points_world=target.camera.unproject(depth_m).reshape(-1, 3),
            is_sky=is_sky.reshape(-1),
            looked_for=(depth_m.reshape(-1) > 0) & (num_found == 0),
            rgb=rgb,
            num_found=num_found,
        )
        _look_up(search, target.timestamp_ns, sources, boxes)
    found = torch.arange(count, device=device)[:, None] < num_found
    return WarpedReferences(
        rgb=rgb.reshape(count, height_px, width_px, 3),
        valid=found.reshape(count, height_px, width_px),
    )


def _look_up(
    search: _Search, timestamp_ns: int, sources: Sequence[SourceImage], boxes: MovingBoxes
) -> None:
    """Fill the search's colours in place with what the sources show."""
    count = len(search.rgb)
    owners = boxes.owners(search.points_world, timestamp_ns)
    for source in sources:
        open_pixels = (search.looked_for & (search.num_found < count)).nonzero()[:, 0]
        points, present = boxes.moved(
            search.points_world[open_pixels],
            owners[open_pixels],
            from_ns=timestamp_ns,
            to_ns=source.timestamp_ns,
        )
        rgb, seen = sample_source(source, points, search.is_sky[open_pixels])
        shown = seen & present
        filled = open_pixels[shown]
        search.rgb[search.num_found[filled], filled] = rgb[shown]
        search.num_found[filled] += 1
