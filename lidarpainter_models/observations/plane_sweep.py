"""Depth of what LiDAR never reached, from recorded images alone (plane sweep, Collins 1996).

For each of a set of depths, other images are carried onto a plane at that depth facing the
camera; where the plane passes through the surface, they agree. Depth is camera z in metres.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid

_SMALL_WINDOW_PX = 7
_LARGE_WINDOW_PX = 21
_SAME_DIFFERENCE = 0.01  # of brightness: less tells two depths apart no longer
_HIDDEN_DIFFERENCE = 0.25  # no overlap, or something in front: no worse than this


def sweep_depths(nearest_m: float, farthest_m: float, count: int) -> Float[Tensor, " depths"]:
    """Depths at even steps of inverse depth, which are even steps of parallax; ascending."""
    inverse = torch.linspace(1 / nearest_m, 1 / farthest_m, count)
    return 1 / inverse


def sweep_cost(
    camera: Camera,
    image: Float[Tensor, "height width channels"],
    others: Sequence[tuple[Camera, Float[Tensor, "rows columns channels"]]],
    depths_m: Float[Tensor, " depths"],
) -> Float[Tensor, "depths height width"]:
    """How badly the other images agree with this one at each depth: mean difference.

    Averaged over a small window (detail) and a large one (where there is little texture).
    """
    target = image.permute(2, 0, 1)[None]
    carried = [(_places(camera, other), other_image) for other, other_image in others]
    rows = []
    for depth_m in depths_m:
        total = torch.zeros(image.shape[:2])
        for places, other_image in carried:
            warped, inside = _warped(other_image, *places, float(depth_m))
            difference = (warped - target)[0].abs().mean(dim=0).clamp(max=_HIDDEN_DIFFERENCE)
            total += torch.where(inside, difference, _HIDDEN_DIFFERENCE)
        total = (total / max(len(others), 1))[None, None]
        rows.append((_box(total, _SMALL_WINDOW_PX) + _box(total, _LARGE_WINDOW_PX))[0, 0] / 2)
    return torch.stack(rows)


def _places(
    camera: Camera, other: Camera
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "3 1 1"]]:
    """What a metre of depth adds to each pixel's place in another image, and the place at none.

    Places are homogeneous, the other image reaches from -1 to 1.
    """
    other_from_camera = (
        invert_rigid(other.world_from_camera.double()) @ camera.world_from_camera.double()
    ).float()
    x, y = 2 / other.width_px, 2 / other.height_px
    lens = torch.tensor(
        [
            [x * other.fx_px, 0.0, x * other.cx_px - 1],
            [0.0, y * other.fy_px, y * other.cy_px - 1],
            [0.0, 0.0, 1.0],
        ]
    )
    along = camera.pixel_directions() @ (lens @ other_from_camera[:3, :3]).T
    offset = lens @ other_from_camera[:3, 3]
    return along.permute(2, 0, 1).contiguous(), offset[:, None, None]


def _warped(
    other_image: Float[Tensor, "rows columns channels"],
    along: Float[Tensor, "3 height width"],
    offset: Float[Tensor, "3 1 1"],
    depth_m: float,
) -> tuple[Float[Tensor, "1 channels height width"], Bool[Tensor, "height width"]]:
    """Another image on the camera's plane at a depth, and where it lies inside the other."""
    u, v, z_m = (depth_m * along + offset).unbind(0)
    is_before = z_m > 0.5
    z_m = z_m.clamp(min=1e-3)
    u, v = u / z_m, v / z_m
    warped = torch.nn.functional.grid_sample(
        other_image.permute(2, 0, 1)[None],
        torch.stack([u, v], dim=-1)[None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return warped, (u.abs() < 1) & (v.abs() < 1) & is_before


def choose_depth(
    cost: Float[Tensor, "depths height width"],
    depths_m: Float[Tensor, " depths"],
    expected_m: Float[Tensor, "height width"],
    *,
    prior: float,
) -> Float[Tensor, "height width"]:
    """The depth of least cost, preferring the expected one where images cannot tell.

    `depths_m` are even steps of inverse depth; the depth found may lie between two of them. `prior`
    is the cost of a step of parallax as large as the whole sweep.
    """
    inverse = 1 / depths_m
    span = (inverse.max() - inverse.min()).clamp(min=1e-9)
    expected = (1 / expected_m.clamp(min=float(depths_m.min()))).clamp(max=float(inverse.max()))
    away = (inverse[:, None, None] - expected).abs() / span
    total = cost.clamp(min=_SAME_DIFFERENCE) + prior * away
    return depth_between(total, total.argmin(dim=0), depths_m)


def depth_between(
    cost: Float[Tensor, "depths height width"],
    index: Int[Tensor, "height width"],
    depths_m: Float[Tensor, " depths"],
) -> Float[Tensor, "height width"]:
    """Depth at the vertex of the parabola through the costs at an index and beside it.

    At most half a step of inverse depth from the index; the first and the last depth stay as they
    are: what is farther than all has no parallax, and only the last depth has none.
    """
    middle = index.clamp(1, len(depths_m) - 2)
    before, least, after = (cost.gather(0, middle[None] + step)[0] for step in (-1, 0, 1))
    offset = (before - after) / (2 * (before - 2 * least + after).clamp(min=1e-6))
    offset = torch.where(middle == index, offset.clamp(-0.5, 0.5), 0)
    inverse = 1 / depths_m
    return 1 / (inverse[index] + offset * (inverse[1] - inverse[0]))


def _box(image: Float[Tensor, "1 1 height width"], size: int) -> Float[Tensor, "1 1 height width"]:
    for window in ((size, 1), (1, size)):  # one after the other: a mean of means, and faster
        image = torch.nn.functional.avg_pool2d(
            image,
            window,
            stride=1,
            padding=(window[0] // 2, window[1] // 2),
            count_include_pad=False,
        )
    return image
