"""The warped references of a view: per pixel, the best recorded images that show its surface.

Every pixel of the target is looked for in the recorded images, nearest first, until as many as
wanted have shown it; so one reference is a patchwork of images and covers what any of them saw.
A pixel may have several guesses of its depth (the render's, the LiDAR's): the next one is tried
where no image agreed with the one before.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.conditioning.warping import (
    SKY_ALPHA,
    SKY_DEPTH_M,
    SourceImage,
    sample_source,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.moving_boxes import MovingBoxes


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
