"""What the beams of one sweep passed through: places that were empty when it was taken.

A sweep is an image of ranges around its sensor. A place is passed where every beam about its
direction ends well behind it. World: z up; metres.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter

CELL_DEG = 0.5
_ROWS, _COLUMNS = round(180 / CELL_DEG), round(360 / CELL_DEG)


class SeenSpace:
    """The ranges of one sweep by direction."""

    def __init__(
        self, points_m: Float[np.ndarray, "points 3"], origin_m: Float[np.ndarray, "3"]
    ) -> None:
        """Take the points of a sweep and where its rays start."""
        self._origin_m = origin_m
        range_m, row, column = self._directions(points_m)
        nearest = np.full((_ROWS, _COLUMNS), np.inf)
        np.minimum.at(nearest, (row, column), range_m)
        self._is_seen = np.isfinite(nearest)
        self._nearest_m = minimum_filter(nearest, 3, mode="wrap")

    def passed(
        self, points_m: Float[np.ndarray, "points 3"], *, beyond_m: float, beyond_share: float
    ) -> Bool[np.ndarray, " points"]:
        """Which places beams passed through.

        Args:
            points_m: the places.
            beyond_m: so much farther beams must end.
            beyond_share: and so much of the range more.
        """
        range_m, row, column = self._directions(points_m)
        beyond = range_m * (1 + beyond_share) + beyond_m
        passed: np.ndarray = self._is_seen[row, column] & (self._nearest_m[row, column] > beyond)
        return passed

    def _directions(
        self, points_m: Float[np.ndarray, "points 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range, row and column of points in the image."""
        away_m = points_m - self._origin_m
        range_m = np.maximum(np.linalg.norm(away_m, axis=1), 1e-6)
        elevation_deg = np.degrees(np.arcsin(np.clip(away_m[:, 2] / range_m, -1, 1)))
        azimuth_deg = np.degrees(np.arctan2(away_m[:, 1], away_m[:, 0]))
        row = np.minimum(((elevation_deg + 90) / CELL_DEG).astype(int), _ROWS - 1)
        column = ((azimuth_deg + 180) / CELL_DEG).astype(int) % _COLUMNS
        return range_m, row, column
