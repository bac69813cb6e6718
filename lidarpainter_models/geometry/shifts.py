"""Constant offsets from a recorded path, by which trajectories are named."""

import math
from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError

MAX_SHIFT_M = 8.0
"""Two lanes and a bit: farther off, next to nothing in view is near enough to what was recorded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shift:
    """A constant offset from the recorded path."""

    lateral_m: float = 0.0
    """To the left of the driving direction; negative is right."""
    up_m: float = 0.0
    """Above the recorded camera."""
    yaw_rad: float = 0.0
    """Turn about the world's up axis, counter-clockwise."""

    def __post_init__(self) -> None:
        """Refuse places of which a recording says nothing.

        Raises:
            ConfigError: farther away than `MAX_SHIFT_M`, or no number.
        """
        for what, metres in (("sideways", self.lateral_m), ("up", self.up_m)):
            if not abs(metres) <= MAX_SHIFT_M:
                raise ConfigError(
                    f"{metres:g} m {what}: expected at most {MAX_SHIFT_M:g} metres from the "
                    "recorded path, farther off a scene has nothing to show"
                )
        if not math.isfinite(self.yaw_rad):
            raise ConfigError(f"a turn by {self.yaw_rad} rad, expected a number")

    @property
    def name(self) -> str:
        """A short name for tables and files, such as `left-2m` or `up-1.5m`."""
        parts = []
        if self.lateral_m:
            parts.append(f"{'left' if self.lateral_m > 0 else 'right'}-{abs(self.lateral_m):g}m")
        if self.up_m:
            parts.append(f"{'up' if self.up_m > 0 else 'down'}-{abs(self.up_m):g}m")
        if self.yaw_rad:
            side = "left" if self.yaw_rad > 0 else "right"
            parts.append(f"turned-{side}-{abs(math.degrees(self.yaw_rad)):.3g}deg")
        return "+".join(parts) or "recorded"
