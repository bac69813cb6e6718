"""A camera as it is assumed to be, and what its image then shows of some points."""

from typing import NamedTuple

from jaxtyping import Bool, Float
from numpy import ndarray

TURN, LATE, READOUT = slice(0, 3), 3, 4
"""Where a camera's turn (rad), lateness and readout (s) stand among its five parameters."""
LEVELS_PER_OCTAVE = 2
"""Of contrasts: the same surface twice as near is looked at so many levels higher."""
NEAR_M = 1.0
"""Nothing nearer is compared."""
BORDER_PX = 3
HIDDEN, HIDDEN_M = 1.15, 0.5
"""A point farther behind a return than this share and length is hidden."""
GUESSES = 3
"""Of when a pixel is read."""
LEAST_AHEAD_M, LEAST_DEPTH_M, LEAST_SCALE_M = 0.1, 0.5, 1.0
"""What depths are taken for where less would be divided by."""


class AssumedCamera(NamedTuple):
    """One image's camera under some parameters: turned, late, and reading its rows in a time."""

    camera_from_world: Float[ndarray, "4 4"]
    """As recorded."""
    twist_per_s: Float[ndarray, "6"]
    """Its turn (rad/s) and velocity (m/s) in its own frame."""
    turned_from_camera: Float[ndarray, "3 3"]
    lens: Float[ndarray, "6"]
    """Focal lengths, centre, width and height, pixels."""
    late_s: float
    across_s: Float[ndarray, "2"]
    """It takes so long to read from the left to the right, and from the top to the bottom."""


class SeenContrasts(NamedTuple):
    """What one image shows of some points."""

    contrast: Float[ndarray, " points"]
    is_seen: Bool[ndarray, " points"]
    slope: Float[ndarray, "points 5"]
    """Derivative of the contrast by the parameters."""
    gradient: Float[ndarray, "points 2"]
    """Of the contrast, a metre of the surface along u and v; 0 where a point is not seen."""
    motion: Float[ndarray, "points 2 5"]
    """By how many metres of its surface a point moves with each parameter."""
