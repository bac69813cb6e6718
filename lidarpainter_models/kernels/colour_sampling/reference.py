"""The colouring of points in plain torch, in float64: the law for the fast version."""

import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.kernels.colour_sampling import AGREEMENT, READ_MARGIN, SLOTS, BestSamples


def project_inside(
    xyz_m: Tensor, pixels_from_points: Tensor, width_px: int, height_px: int, near_m: float
) -> tuple[Tensor, Tensor, Tensor]:
    """See `colour_sampling.project_inside`."""
    matrix = pixels_from_points.double().to(xyz_m.device, non_blocking=True)
    u, v, depth_m = (xyz_m.double() @ matrix[:, :3].T + matrix[:, 3]).T
    # as they are given on: what rounds up to the edge is outside
    u, v = (u / depth_m).float(), (v / depth_m).float()
    inside = (depth_m >= near_m) & (u >= 0) & (v >= 0) & (u < width_px) & (v < height_px)
    rows = inside.nonzero()[:, 0]
    pixels_uv = torch.stack([u, v], dim=1).index_select(0, rows)
    return rows, pixels_uv, depth_m.index_select(0, rows).float()


def read_inside(
    xyz_m: Tensor, camera: Tensor, margin_px: float, near_m: float, rounds: int
) -> tuple[Tensor, Tensor, Tensor]:
    """See `colour_sampling.read_inside`."""
    size = camera[16:18].to(xyz_m.device, non_blocking=True) + 2 * margin_px
    standing_uv, standing_m, read_uv, read_m = _read(xyz_m, camera, rounds)
    standing_uv, read_uv = standing_uv + margin_px, (read_uv + margin_px).float()
    near = (standing_uv >= -READ_MARGIN * size) & (standing_uv < (1 + READ_MARGIN) * size)
    inside = (read_uv >= 0) & (read_uv < size) & near
    is_read = inside.all(dim=1) & (standing_m >= near_m) & (read_m > near_m)
    rows = is_read.nonzero()[:, 0]
    return rows, read_uv.index_select(0, rows), read_m.index_select(0, rows).float()


def in_any_image(xyz_m: Tensor, cameras: Tensor, near_m: float, rounds: int) -> Tensor:
    """See `colour_sampling.in_any_image`."""
    inside = torch.zeros_like(xyz_m[:, 0], dtype=torch.bool)
    for camera in cameras:
        _, _, uv, depth_m = _read(xyz_m, camera, rounds)
        size = camera[16:18].to(xyz_m.device, non_blocking=True)
        inside |= ((uv >= 0) & (uv < size)).all(dim=1) & (depth_m > near_m)
    return inside


def _read(xyz_m: Tensor, camera: Tensor, rounds: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel and depth of points in the middle of an image, then where its shutter reads them."""
    camera = camera.to(xyz_m.device, non_blocking=True)
    matrix, focal, middle = camera[:12].view(3, 4), camera[12:14], camera[14:16]
    size, across_s, (turn, speed) = camera[16:18], camera[18:20], camera[20:].split(3)
    standing = xyz_m.double() @ matrix[:, :3].T + matrix[:, 3]
    velocity = -torch.linalg.cross(turn.expand_as(standing), standing) - speed
    standing_uv = uv = _pixels(standing, focal, middle)
    points = standing
    for _ in range(rounds):
        after_s = ((uv / size - 0.5).clamp(-0.5, 0.5) * across_s).sum(dim=1, keepdim=True)
        points = standing + after_s * velocity
        uv = _pixels(points, focal, middle)
    return standing_uv, standing[:, 2], uv, points[:, 2]


def _pixels(points: Tensor, focal: Tensor, middle: Tensor) -> Tensor:
    depth = points[:, 2:]
    return points[:, :2] / torch.where(depth.abs() < 1e-9, 1e-9, depth) * focal + middle


def insert_samples(
    best: BestSamples, rows: np.ndarray, weight: np.ndarray, rgb: np.ndarray, view: int
) -> None:
    """See `colour_sampling.insert_samples`."""
    slot_weight, slot_rgb, slot_view = best
    weights = np.concatenate([slot_weight[rows], weight[:, None]], axis=1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :SLOTS]
    views = np.full((len(rows), 1), view, slot_view.dtype)
    for slots, new in ((slot_weight, weight[:, None]), (slot_view, views)):
        slots[rows] = np.take_along_axis(np.concatenate([slots[rows], new], axis=1), order, axis=1)
    colours = np.concatenate([slot_rgb[rows], rgb[:, None]], axis=1)
    slot_rgb[rows] = np.take_along_axis(colours, order[..., None], axis=1)


def steps_inside(
    cells_uv: np.ndarray, depth_m: np.ndarray, inner_m: np.ndarray, reach: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """See `colour_sampling.steps_inside`."""
    cells, depth = torch.from_numpy(cells_uv), torch.from_numpy(depth_m)
    padded = torch.nn.functional.pad(
        torch.from_numpy(inner_m), [reach] * 4, value=torch.inf
    )  # no surface lies outside
    steps, best = torch.zeros(len(depth), 2), torch.full((len(depth),), reach * reach + 1)
    for row in range(-reach, reach + 1):
        for column in range(-reach, reach + 1):
            found_m = padded[cells[:, 1] + reach + row, cells[:, 0] + reach + column]
            distance = row * row + column * column
            is_nearer = ((found_m - depth).abs() <= tolerance * depth) & (distance < best)
            steps[is_nearer] = torch.tensor([column, row]).float()
            best[is_nearer] = distance
    return steps.numpy(), (best <= reach * reach).numpy()


def sample_levels(
    pixels_uv: np.ndarray,
    level: np.ndarray,
    finest: np.ndarray,
    middle: np.ndarray,
    coarsest: np.ndarray,
) -> np.ndarray:
    """See `colour_sampling.sample_levels`."""
    uv, levels = torch.from_numpy(pixels_uv).double(), torch.from_numpy(level)
    rgb = torch.zeros(len(uv), 3, dtype=torch.uint8)
    for number, image in enumerate((finest, middle, coarsest)):
        chosen = levels.clamp(max=2) == number
        rgb[chosen] = _bilinear(torch.from_numpy(image).double(), uv[chosen] / 2**number)
    return rgb.numpy()


def combine_samples(best: BestSamples, view_gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """See `colour_sampling.combine_samples`."""
    slot_weight, slot_rgb, slot_view = best
    weight = torch.from_numpy(slot_weight).double()
    gain = torch.from_numpy(view_gain).double()[torch.from_numpy(slot_view).long()]
    matched = torch.from_numpy(slot_rgb).double() * gain
    brightness = matched.sum(dim=-1)
    is_used = weight > 0
    below = (weight[:, None] * (brightness[:, None] < brightness[..., None])).sum(dim=-1)
    upto = (weight[:, None] * (brightness[:, None] <= brightness[..., None])).sum(dim=-1)
    half = weight.sum(dim=1, keepdim=True) / 2
    typical = (is_used & (below <= half) & (upto >= half)).int().argmax(dim=1)
    distance = (matched - matched[torch.arange(len(matched)), typical][:, None]).abs()
    share = torch.where(is_used & (distance.amax(dim=-1) <= AGREEMENT), weight.square(), 0.0)
    total = share.sum(dim=1, keepdim=True)
    mean = (share[..., None] * matched).sum(dim=1) / torch.where(total > 0, total, 1.0)
    has_colour = is_used.any(dim=1)
    rgb = torch.where(has_colour[:, None], mean + 0.5, 0.0).clamp(0, 255).to(torch.uint8)
    return rgb.numpy(), has_colour.numpy()


def _bilinear(image: Tensor, pixels_uv: Tensor) -> Tensor:
    """Mix of the four pixels around each position, edges repeated; uint8."""
    height, width = image.shape[:2]
    u = (pixels_uv[:, 0] - 0.5).clamp(0, width - 1)
    v = (pixels_uv[:, 1] - 0.5).clamp(0, height - 1)
    column, row = u.long(), v.long()
    right, below = (column + 1).clamp(max=width - 1), (row + 1).clamp(max=height - 1)
    fu, fv = (u - column)[:, None], (v - row)[:, None]
    top = (1 - fu) * image[row, column] + fu * image[row, right]
    bottom = (1 - fu) * image[below, column] + fu * image[below, right]
    return ((1 - fv) * top + fv * bottom + 0.5).to(torch.uint8)
