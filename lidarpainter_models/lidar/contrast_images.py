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

from lidarpainter_models.kernels.point_contrasts import LEVELS_PER_OCTAVE

FINEST_PX = 0.8
"""Deviation of the blur of level 0."""
NUM_LEVELS = 6
"""Levels 2 and 3 are compared, of points up to an octave nearer or farther."""
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
        levels = np.empty((NUM_LEVELS, *grey.shape, 3), np.float32)
        for level in range(NUM_LEVELS):
            wide = level + _SURROUNDINGS
            band = blurred[level] - blurred[wide]
            spread = np.sqrt(cv2.GaussianBlur(band**2, (0, 0), blurs_px[wide]))
            contrast = band / (spread + _CALM)
            levels[level, ..., 0] = contrast
            for number, axis in enumerate(_AXES, start=1):
                levels[level, ..., number] = cv2.Sobel(contrast, cv2.CV_32F, *axis, scale=1 / 8)
        return cls(levels)


_AXES = ((1, 0), (0, 1))


def _blur_px(level: int) -> float:
    return FINEST_PX * 2.0 ** (level / LEVELS_PER_OCTAVE)
