"""Images as contrasts at several scales, to compare one surface in views from far and near.

A level is the logarithm of the brightness between two blurs, divided by its own deviation around
(local contrast normalisation, Jarrett et al. 2009): exposure, vignetting and shade do not count,
and no part of an image is calmer than another, so that nothing is gained by comparing calm parts.
Levels follow each other by half an octave: the same surface twice as near is looked at two levels
higher.
"""

from dataclasses import dataclass

import cv2
import numpy as np

LEVELS_PER_OCTAVE = 2
FINEST_PX = 0.8
"""Deviation of the blur of level 0."""
NUM_LEVELS = 8
_SURROUNDINGS = 4  # levels; two octaves wider than the level itself
_DARKEST = 0.04
_CALM = 0.02
"""Deviation of plain surfaces: less is noise."""


@dataclass(frozen=True, slots=True)
class ContrastImage:
    """One image at all levels."""

    levels: np.ndarray
    """(levels, height, width, 3) float32: contrast and its derivatives along u and v."""

    @classmethod
    def of(cls, rgb_u8: np.ndarray) -> "ContrastImage":
        """The contrasts of an image."""
        grey = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        blurs_px = [_blur_px(level) for level in range(NUM_LEVELS + _SURROUNDINGS)]
        light = np.log(grey + _DARKEST)
        blurred = [cv2.GaussianBlur(light, (0, 0), blur_px) for blur_px in blurs_px]
        levels = []
        for level in range(NUM_LEVELS):
            wide = level + _SURROUNDINGS
            band = blurred[level] - blurred[wide]
            spread = np.sqrt(cv2.GaussianBlur(band**2, (0, 0), blurs_px[wide]))
            contrast = band / (spread + _CALM)
            slopes = [cv2.Sobel(contrast, cv2.CV_32F, *axis, scale=1 / 8) for axis in _AXES]
            levels.append(np.stack([contrast, *slopes], axis=-1))
        return cls(np.stack(levels))

    def sample(self, pixels_uv: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Contrast and slopes (points, 3) at continuous pixels and levels, linear between."""
        count, height, width, _ = self.levels.shape
        places = (level, pixels_uv[:, 1] - 0.5, pixels_uv[:, 0] - 0.5)
        ends = (count, height, width)
        inside = [np.clip(x, 0, end - 1.001) for x, end in zip(places, ends, strict=True)]
        first = [place.astype(np.int64) for place in inside]
        later = [place - low for place, low in zip(inside, first, strict=True)]
        flat, found = self.levels.reshape(-1, 3), np.zeros((len(level), 3))
        for corner in np.ndindex(2, 2, 2):
            weight = np.ones(len(level))
            for step, share in zip(corner, later, strict=True):
                weight = weight * (share if step else 1 - share)
            level_at, row, column = (low + step for low, step in zip(first, corner, strict=True))
            found += weight[:, None] * flat[(level_at * height + row) * width + column]
        return found


_AXES = ((1, 0), (0, 1))


def _blur_px(level: int) -> float:
    return FINEST_PX * 2.0 ** (level / LEVELS_PER_OCTAVE)
