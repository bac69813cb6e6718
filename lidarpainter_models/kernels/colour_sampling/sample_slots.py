"""The samples of a point's colour that are kept, and which of them agree."""

from typing import NamedTuple

import numpy as np

SLOTS = 4
"""Best samples that a point keeps."""
AGREEMENT = 32.0
"""Samples further than this (of 255, in any channel) from the typical one are outliers."""


class BestSamples(NamedTuple):
    """The best samples of every point, heaviest first."""

    weight: np.ndarray
    """(points, slots) float32, 0 where a slot is empty."""
    rgb: np.ndarray
    """(points, slots, 3) uint8."""
    view: np.ndarray
    """(points, slots) int16, or int32 of many views: number of the one each sample is from."""

    @classmethod
    def none_yet(cls, num_points: int, num_views: int) -> "BestSamples":
        """Empty slots, for samples of so many views."""
        number = np.result_type(np.int16, np.min_scalar_type(-num_views))
        return cls(
            weight=np.zeros((num_points, SLOTS), np.float32),
            rgb=np.zeros((num_points, SLOTS, 3), np.uint8),
            view=np.zeros((num_points, SLOTS), number),
        )
