"""How far a painted view can be trusted, pixel by pixel, and whether it helps at all.

Geometry says where a painter had something to go by:

    support = 1 - (1 - w_warp V) (1 - w_lidar L) (1 - w_surface A)
    confidence = painter confidence * support * seen

V is how well recorded images vouch for a pixel: 0 where none could be warped here, a fixed share
where a single one could, and exp(-excess / scale) where two could, with the excess of their
difference over a slack. L = exp(-d / reach) with d the distance to the nearest pixel a LiDAR point
coloured; A rises smoothly from 0 to 1 with the opacity of the render; `seen` is 1 where the
surface fell into any training image, hidden or not, and 0 outside all of them: nothing is known
there. The weights follow errors measured at shifted views of a synthetic street: mean of render
and warp 25.8 dB where two images are warped, 22.3 dB where one is; render 19 dB at LiDAR hits
without warp, 18 to 15 dB without either, 13 dB in holes; from a difference of 0.16 between two
warped images on, they are no better than the render.

The gate compares: where recorded pixels are known (warped images first, LiDAR colours
elsewhere), a painting that departs from them by more than the plain render did is weighed down,
locally and, if it does so on the whole, as a view; far beyond that it is refused.

Where a painter left the render as it was, `departure_weight`, a painting has nothing to tell: it
would hold the scene to what it was when it was painted, while recorded views still sharpen it.
"""

import math
from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.conditioning.warping import SKY_DEPTH_M
from lidarpainter_models.geometry.cameras import READ_ROUNDS, Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.kernels.backends import may_run_on_host
from lidarpainter_models.kernels.colour_sampling import in_any_image
from lidarpainter_models.painter.protocol import Painting, PaintingConditions

WARP_WEIGHT = 0.9  # support of a pixel that two recorded images show alike
SINGLE_WARP_SHARE = 0.7  # what a single recorded image is worth, of two
WARP_SLACK = 0.05  # mean difference of two warped images that is put down to sampling
WARP_SCALE = 0.1  # further difference at which their worth has fallen to 1/e
LIDAR_WEIGHT = 0.6  # support of a pixel with a coloured LiDAR point in it
SURFACE_WEIGHT = 0.3  # support of an opaque render with nothing else to confirm it
LIDAR_REACH_RAD = 0.006
"""Angle at which LiDAR support has fallen to 1/e: 3 px at 500 px focal length."""
ALPHA_RANGE = (0.5, 0.95)  # opacity where a surface starts to count, and where it counts fully
REACHES = 12  # times its reach beyond which LiDAR supports nothing: exp(-12)
LIKENESS_M = 8.0
"""So much farther a camera may stand that looks in the direction of a view, not across it: those
that are likeliest to have seen it are asked first."""
NEAREST_M = 0.1  # nearer to a camera than this is nothing seen, as in `Camera.contains`
MOST_PROJECTIONS = 2**24
"""Points times cameras projected in one go: a few hundred megabytes."""
GATE_WINDOW_PX = 11  # side of the square over which painting and evidence are compared; odd
GATE_SLACK = 0.01  # mean difference by which a painting may exceed the render unpunished
GATE_SCALE = 0.03  # further difference at which the weight has fallen to 1/e
REFUSE_EXCESS = 0.05  # a view that exceeds the render by this mean difference is refused
DEPARTURE_WINDOW_PX = 5  # side of the square over which painting and render are compared; odd
DEPARTURE_RANGE = (0.01, 0.04)
"""Mean differences from which on a painted pixel counts, and at which it counts fully. A tenth of
the weight is left, which gives up 0.1 to 0.2 dB beside the path
(docs/decisions/what-guides-a-fit.md)."""
MIN_EVIDENCE = 0.02  # share of pixels with evidence under which no view is gated as a whole


def is_seen(
    camera: Camera, depth_m: Float[Tensor, "height width"], recorded_cameras: Iterable[Camera]
) -> Bool[Tensor, "height width"]:
    """Whether the point in each pixel falls into any recorded image, occluded or not.

    Pixels without depth (0) are taken as sky: only their direction counts.
    """
    points_world = camera.unproject(torch.where(depth_m > 0, depth_m, SKY_DEPTH_M)).reshape(-1, 3)
    cameras = list(recorded_cameras)
    if not may_run_on_host(depth_m.device):
        return _in_any(points_world, cameras).reshape(depth_m.shape)
    if not cameras:
        return torch.zeros_like(depth_m, dtype=torch.bool)
    pose = camera.world_from_camera.double()
    poses = torch.stack([one.world_from_camera.double() for one in cameras])
    likely = (poses[:, :3, 2] @ pose[:3, 2]) * LIKENESS_M
    likely -= (poses[:, :3, 3] - pose[:3, 3]).norm(dim=1)
    packed = torch.stack([one.packed() for one in cameras])[likely.argsort(descending=True)]
    return in_any_image(points_world, packed, NEAREST_M, READ_ROUNDS).reshape(depth_m.shape)


def _projections(
    cameras: Sequence[Camera],
) -> tuple[Float[Tensor, "cameras 3 4"], Float[Tensor, "cameras 2"]]:
    """What takes points of the world to pixels times depth and depth, and sizes; float64."""
    lens = torch.tensor(
        [[[c.fx_px, 0, c.cx_px, 0], [0, c.fy_px, c.cy_px, 0], [0, 0, 1, 0]] for c in cameras],
        dtype=torch.float64,
    )
    poses = torch.stack([camera.world_from_camera.double() for camera in cameras])
    sizes = torch.tensor(
        [[camera.width_px, camera.height_px] for camera in cameras], dtype=torch.float64
    )
    return lens @ invert_rigid(poses), sizes


def _in_any(
    points_world: Float[Tensor, "points 3"], cameras: Sequence[Camera]
) -> Bool[Tensor, " points"]:
    """Whether a point falls into the image of any camera: all points against many cameras at once.

    What `Camera.project` and `contains` find one by one.
    """
    found = torch.zeros_like(points_world[:, 0], dtype=torch.bool)
    if not cameras:
        return found
    matrices, sizes = (each.to(points_world, non_blocking=True) for each in _projections(cameras))
    each = max(1, MOST_PROJECTIONS // max(len(points_world), 1))
    for matrix, size in zip(matrices.split(each), sizes.split(each), strict=True):
        u, v, depth_m = (points_world @ matrix[:, :3, :3].mT + matrix[:, None, :3, 3]).unbind(-1)
        is_in = (u >= 0) & (u < size[:, :1] * depth_m) & (v >= 0) & (v < size[:, 1:] * depth_m)
        found |= (is_in & (depth_m > NEAREST_M)).any(dim=0)
    return found


def geometric_confidence(
    conditions: PaintingConditions, camera: Camera, seen: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """`support * seen` of the module's formula, in [0, 1]."""
    warp = _vouched(conditions)
    reach_px = LIDAR_REACH_RAD * camera.fx_px
    lidar = torch.exp(-_distance_px(conditions.lidar_hit, reach_px) / reach_px)
    lidar = lidar.to(conditions.render_alpha)
    low, high = ALPHA_RANGE
    rise = ((conditions.render_alpha - low) / (high - low)).clamp(0, 1)
    surface = rise * rise * (3 - 2 * rise)
    doubt = (1 - WARP_WEIGHT * warp) * (1 - LIDAR_WEIGHT * lidar)
    return (1 - doubt * (1 - SURFACE_WEIGHT * surface)) * seen


def view_support(
    conditions: PaintingConditions, camera: Camera, recorded_cameras: Iterable[Camera]
) -> Float[Tensor, "height width"]:
    """`geometric_confidence` of what the render shows, or the LiDAR where it shows nothing."""
    render_m, lidar_m = conditions.render_depth_m, conditions.lidar_depth_m
    seen = is_seen(camera, torch.where(render_m > 0, render_m, lidar_m), recorded_cameras)
    return geometric_confidence(conditions, camera, seen)


def _distance_px(
    hit: Bool[Tensor, "height width"], reach_px: float
) -> Float[Tensor, "height width"]:
    """Distance of each pixel to the nearest hit one; infinite if there is none."""
    if may_run_on_host(hit.device):
        if not bool(hit.any()):
            return torch.full(hit.shape, torch.inf)
        from scipy.ndimage import distance_transform_edt  # likewise: not for settings

        return torch.as_tensor(distance_transform_edt(~hit.numpy())).float()
    height_px = hit.shape[0]
    row = torch.arange(height_px, device=hit.device, dtype=torch.float32)[:, None]
    above = torch.where(hit, row, -torch.inf).cummax(dim=0).values
    below = torch.where(hit, row, torch.inf).flip(0).cummin(dim=0).values.flip(0)
    along = torch.minimum(row - above, below - row).square()
    most_px = min(math.ceil(REACHES * reach_px), hit.shape[1] - 1)
    padded = torch.nn.functional.pad(along, (most_px, most_px), value=torch.inf)
    nearest = along
    for step in range(-most_px, most_px + 1):
        beside = padded[:, most_px + step : most_px + step + hit.shape[1]] + step * step
        nearest = torch.minimum(nearest, beside)
    return nearest.sqrt()


def _vouched(conditions: PaintingConditions) -> Float[Tensor, "height width"]:
    """V of the module's formula."""
    num_valid = conditions.warp_valid.sum(dim=0)
    vouched = SINGLE_WARP_SHARE * (num_valid == 1).to(torch.float32)
    if len(conditions.warp_valid) < 2:
        return vouched
    first, second = conditions.warp_rgb[:2]
    difference = _box_sum((first - second).abs().mean(dim=-1), 3) / 9
    agreement = torch.exp(-(difference - WARP_SLACK).clamp(min=0) / WARP_SCALE)
    return torch.where(num_valid >= 2, agreement, vouched)


def guidance_gate(
    painting: Painting, conditions: PaintingConditions
) -> Float[Tensor, "height width"]:
    """Factor on a painting's weight, in [0, 1]; all 0 where it is refused.

    It falls where the painting departs from recorded pixels more than the render did.
    """
    evidence, known = _evidence(conditions)
    share = float(known.to(torch.float32).mean())
    painted = (painting.rgb - evidence).abs().mean(dim=-1) * known
    rendered = (conditions.render_rgb - evidence).abs().mean(dim=-1) * known
    if share == 0:
        return torch.ones_like(painted)
    count = known.sum()
    view_weight = 1.0
    if share >= MIN_EVIDENCE:
        excess = float(painted.sum() / count) - float(rendered.sum() / count)
        view_weight = 0.0 if excess > REFUSE_EXCESS else _falloff(excess)
    local = _box_sum(painted - rendered, GATE_WINDOW_PX) / _box_sum(
        known.to(torch.float32), GATE_WINDOW_PX
    ).clamp(min=1.0)
    fall = torch.exp(-(local - GATE_SLACK).clamp(min=0) / GATE_SCALE)
    return view_weight * fall


def departure_weight(
    painting: Painting, conditions: PaintingConditions
) -> Float[Tensor, "height width"]:
    """How far a painting departs from its render: 0 where not at all, 1 where much."""
    low, high = DEPARTURE_RANGE
    difference = (painting.rgb - conditions.render_rgb).abs().mean(dim=-1)
    in_window = _box_sum(torch.ones_like(difference), DEPARTURE_WINDOW_PX)
    mean = _box_sum(difference, DEPARTURE_WINDOW_PX) / in_window
    return ((mean - low) / (high - low)).clamp(0, 1)


def _evidence(
    conditions: PaintingConditions,
) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """The best recorded colour known for each pixel: warped images, then LiDAR."""
    rgb, known = conditions.lidar_rgb, conditions.lidar_hit
    for source in reversed(range(len(conditions.warp_valid))):
        valid = conditions.warp_valid[source]
        rgb = torch.where(valid[..., None], conditions.warp_rgb[source], rgb)
        known = known | valid
    return rgb, known


def _falloff(excess: float) -> float:
    """1 up to the slack, then an exponential fall."""
    beyond = torch.tensor(max(excess - GATE_SLACK, 0.0))
    return float(torch.exp(-beyond / GATE_SCALE))


def _box_sum(image: Float[Tensor, "height width"], side_px: int) -> Float[Tensor, "height width"]:
    """Sum over a square window around each pixel; outside the image is 0."""
    mean = torch.nn.functional.avg_pool2d(
        image[None, None], side_px, stride=1, padding=side_px // 2
    )
    return mean[0, 0] * side_px**2
