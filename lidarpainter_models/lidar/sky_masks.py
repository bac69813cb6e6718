"""Which pixels of a recorded image are sky, from LiDAR returns, colour and geometry.

The sky returns no beam, lies above the horizon, and looks like nothing that returns beams. The
second half matters: the upper floors of a house return none either (they are above the topmost
beam), but their colours are those of the floors below. So colours are compared by how often they
occur where beams return and where none does; what is frequent only without returns, and smooth, is
sure sky, if it is one piece or its other pieces look like the largest: a tower too far for any beam
is smooth and without returns too. From there the mask grows to pixels that have the colour of the
sure sky around them.
Doubt is settled as not sky: wires, foliage, far towers, and overcast skies behind white walls.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera

_GROWTH_ROUNDS = 3
_SMALL_PIECE_PX = 30
LEAST_ELEVATION_RAD = 0.0  # sky is above the horizon
CLEAR_RAD = 0.008  # sure sky has no return nearer than this angle
LEAST_LOG_RATIO = 1.5
"""Sure sky has a colour that is e to this times more frequent without returns than with."""
MOST_TEXTURE = 6.0  # largest standard deviation of a colour channel in a neighbourhood of sure sky
LEAST_AREA = 0.002  # smallest connected piece of sure sky, as a share of the image
PIECE_TOLERANCE = 25.0
"""A piece of sure sky may differ so much from the largest one, in any channel."""
COLOUR_TOLERANCE = 10.0  # a pixel may differ so much from the sure sky around it, in any channel
AROUND_RAD = 0.06  # how far around a pixel the sure sky is averaged


def sky_mask(
    rgb_u8: UInt8[Tensor, "height width 3"], points_world: Float[Tensor, "points 3"], camera: Camera
) -> Bool[Tensor, "height width"]:
    """Sky in a recorded image.

    The points are of the same frame; the camera is on the same grid as the image.
    """
    pixels_uv, depth_m = camera.project(points_world)
    column, row = pixels_uv[camera.contains(pixels_uv, depth_m)].long().unbind(-1)
    has_return = torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
    has_return[row, column] = True
    return sky_from_returns(rgb_u8, has_return, camera)


def sky_from_returns(
    rgb_u8: UInt8[Tensor, "height width 3"],
    has_return: Bool[Tensor, "height width"],
    camera: Camera,
) -> Bool[Tensor, "height width"]:
    """Sky in an image whose LiDAR returns are known; the camera is on the same grid."""
    image, returns = rgb_u8.numpy(), has_return.numpy().astype(np.uint8)
    above = _elevation(camera) > LEAST_ELEVATION_RAD
    clear_px = max(1, round(CLEAR_RAD * camera.fx_px))
    open_sky = above & (_grown(returns, clear_px) == 0)
    surface = _grown(returns, 2) > 0
    sure = open_sky & (_log_ratio(image, open_sky, surface) > LEAST_LOG_RATIO)
    sure &= _texture(image) < MOST_TEXTURE
    around_px = AROUND_RAD * camera.fx_px
    pieces = _large_pieces(sure, LEAST_AREA * sure.size)
    sky = _like_the_largest(image, pieces, around_px)
    candidates = above & (_grown(returns, 1) == 0)
    for _ in range(_GROWTH_ROUNDS):
        if not sky.any():
            break
        differs = _differs(image, sky, around_px)
        like_sky = sky | (candidates & (differs < COLOUR_TOLERANCE))
        # small pieces between wires and branches count once the large ones say what sky looks like
        seeds = _large_pieces(like_sky & (sure | sky), _SMALL_PIECE_PX)
        sky = _connected_to(like_sky, seeds)
    return torch.from_numpy(sky | _bright_holes(image, sky, returns))


def _elevation(camera: Camera) -> np.ndarray:
    """Angle of each pixel's ray above the horizon."""
    rotation = camera.world_from_camera[:3, :3].float()
    directions = torch.nn.functional.normalize(camera.pixel_directions(), dim=-1)
    return torch.asin((directions @ rotation[2]).clamp(-1, 1)).numpy()


def _grown(mask: np.ndarray, radius_px: int) -> np.ndarray:
    size = 2 * radius_px + 1
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))


def _log_ratio(image: np.ndarray, without: np.ndarray, with_returns: np.ndarray) -> np.ndarray:
    """Log of how many pixels of each pixel's colour have no return, over how many have one."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.int64)
    bins = np.stack([lab[..., 0] // 16, lab[..., 1] // 4, lab[..., 2] // 4], axis=-1)
    cells = (bins[..., 0] * 64 + bins[..., 1]) * 64 + bins[..., 2]
    counts = [
        _smoothed(np.bincount(cells[chosen], minlength=16 * 64 * 64).reshape(16, 64, 64) + 1.0)
        for chosen in (without, with_returns)
    ]
    return np.log(counts[0] / counts[1]).reshape(-1)[cells]


def _smoothed(counts: np.ndarray) -> np.ndarray:
    """Blur a colour histogram by about a cell along each axis."""
    for axis in range(3):
        before, after = np.roll(counts, 1, axis), np.roll(counts, -1, axis)
        counts = 0.25 * before + 0.5 * counts + 0.25 * after
    return counts


def _texture(image: np.ndarray) -> np.ndarray:
    """Largest standard deviation of a colour channel in 5 x 5 pixels."""
    rgb = image.astype(np.float32)
    mean, square = cv2.blur(rgb, (5, 5)), cv2.blur(rgb * rgb, (5, 5))
    return np.sqrt(_largest_channel(np.maximum(square - mean * mean, 0)))


def _large_pieces(mask: np.ndarray, least_px: float) -> np.ndarray:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    is_large = stats[:, cv2.CC_STAT_AREA] >= max(least_px, 1)
    is_large[0] = False
    return is_large[labels] if count > 1 else np.zeros_like(mask)


def _like_the_largest(image: np.ndarray, pieces: np.ndarray, sigma_px: float) -> np.ndarray:
    """The largest connected piece, and those whose median colour continues it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(pieces.astype(np.uint8))
    if count <= 2:
        return pieces
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    differs = _differs(image, labels == largest, sigma_px)
    alike = [np.median(differs[labels == label]) < PIECE_TOLERANCE for label in range(1, count)]
    alike[largest - 1] = True
    return np.array([False, *alike])[labels]


def _differs(image: np.ndarray, sky: np.ndarray, sigma_px: float) -> np.ndarray:
    """Largest channel difference from the sky around, averaged near and, failing that, far."""
    height, width = sky.shape
    size = (max(1, width // 4), max(1, height // 4))
    share = cv2.resize(sky.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    rgb = image.astype(np.float32)
    masked = cv2.resize(rgb * sky[..., None], size, interpolation=cv2.INTER_AREA)
    mean = rgb[sky].mean(axis=0)
    for sigma in (sigma_px, sigma_px / 4, sigma_px / 16):
        near_share = cv2.GaussianBlur(share, (0, 0), sigma)[..., None]
        near = cv2.GaussianBlur(masked, (0, 0), sigma)
        mean = (near + 1e-3 * mean) / (near_share + 1e-3)
    mean = cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
    return _largest_channel(np.abs(rgb - mean))


def _largest_channel(values: np.ndarray) -> np.ndarray:
    """What `max(axis=-1)` of three channels gives, in a fifth of its time."""
    return np.maximum(np.maximum(values[..., 0], values[..., 1]), values[..., 2])


def _connected_to(mask: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The connected pieces of a mask that hold a seed."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    held = np.unique(labels[seeds])
    return np.isin(labels, held[held > 0])


def _bright_holes(image: np.ndarray, sky: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Holes of the sky that return no beam and are not darker than it: clouds and their rims."""
    holes = np.zeros_like(sky)
    if not sky.any():
        return holes
    height, width = sky.shape
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~sky).astype(np.uint8))
    for label, (left, top, wide, high, _) in enumerate(stats[1:], start=1):
        if left == 0 or top == 0 or left + wide == width or top + high == height:
            continue
        window = slice(top - 1, top + high + 1), slice(left - 1, left + wide + 1)
        hole = labels[window] == label
        around = sky[window] & (_grown(hole.astype(np.uint8), 1) > 0)
        is_bright = grey[window][hole].mean() > np.percentile(grey[window][around], 25)
        if is_bright and not returns[window][hole].any():
            holes[window] |= hole
    return holes
