"""The colouring of points in plain torch, in float64: the law for the fast version."""

import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.kernels.colour_sampling import AGREEMENT, SLOTS, BestSamples


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
