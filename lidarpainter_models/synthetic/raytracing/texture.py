"""Texture look-ups: bilinear in one level of the pyramid, or averaged over a footprint."""

import numba
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import LEVEL_OFFSET, SceneArrays
from lidarpainter_models.synthetic.raytracing.trace import INLINED, RAY

MAX_TAPS = 8


@numba.njit(**INLINED)
def _neighbours(low: int, size: int, repeats: int) -> tuple[int, int]:
    """Two texels next to each other, wrapped around or held at the edge."""
    if repeats > 0:
        return (low if low >= 0 else size - 1), (low + 1 if low + 1 < size else 0)
    return min(max(low, 0), size - 1), min(max(low + 1, 0), size - 1)


@numba.njit(**RAY)
def sample_texture(
    scene: SceneArrays, texture: int, place: tuple, level: int
) -> tuple[float, float, float, float]:
    """Linear colour and fourth channel (0..1) at (s, t), bilinear in one level."""
    index = scene.texture_index[texture]
    level = min(max(level, 0), index[3] - 1)
    width, height = max(index[0] >> level, 1), max(index[1] >> level, 1)
    s, t = place
    if index[2] > 0:
        s, t = s - np.floor(s), t - np.floor(t)
    x, y = s * width - 0.5, t * height - 0.5
    column, line = int(np.floor(x)), int(np.floor(y))
    across, down = x - column, y - line
    left, right = _neighbours(column, width, index[2])
    top, bottom = _neighbours(line, height, index[2])
    first = index[LEVEL_OFFSET + level]
    red, green, blue, fourth = 0.0, 0.0, 0.0, 0.0
    for corner in range(4):
        i = right if corner & 1 else left
        j = bottom if corner >> 1 else top
        weight = across if corner & 1 else 1.0 - across
        weight *= down if corner >> 1 else 1.0 - down
        texel = first + j * width + i
        red += weight * scene.to_linear[scene.texels[texel, 0]]
        green += weight * scene.to_linear[scene.texels[texel, 1]]
        blue += weight * scene.to_linear[scene.texels[texel, 2]]
        fourth += weight * scene.texels[texel, 3]
    return red, green, blue, fourth * (1.0 / 255.0)


@numba.njit(**INLINED)
def filtered_texture(
    scene: SceneArrays, texture: int, place: tuple, first: tuple, second: tuple
) -> tuple[float, float, float, float]:
    """Average over the parallelogram spanned by two uv steps around a place."""
    index = scene.texture_index[texture]
    length_first = np.sqrt((first[0] * index[0]) ** 2 + (first[1] * index[1]) ** 2)
    length_second = np.sqrt((second[0] * index[0]) ** 2 + (second[1] * index[1]) ** 2)
    longer = first if length_first >= length_second else second
    most, least = max(length_first, length_second), min(length_first, length_second)
    width = max(least, most / MAX_TAPS, 1e-3)
    level = int(np.floor(np.log2(width) + 0.4))
    taps = min(max(int(np.ceil(most / (2.0 ** max(level, 0)) - 0.3)), 1), MAX_TAPS)
    red, green, blue, fourth = 0.0, 0.0, 0.0, 0.0
    for tap in range(taps):
        along = (tap + 0.5) / taps - 0.5
        at = (place[0] + along * longer[0], place[1] + along * longer[1])
        sample = sample_texture(scene, texture, at, level)
        red += sample[0]
        green += sample[1]
        blue += sample[2]
        fourth += sample[3]
    return red / taps, green / taps, blue / taps, fourth / taps
