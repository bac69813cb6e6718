"""Trajectories by name: what a user writes for where the camera should go.

A trajectory is a shift from the recorded path for every moment of it, so it can be followed at
any speed and for any length of log. Several parts are added with `+`: `lateral:2+up:1.5`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import Shift

LANE_WIDTH_M = 3.5
"""A lane change without a width goes this far to the left."""
KINDS = ("recorded", "lateral:METRES", "up:METRES", "yaw:DEGREES", "lane-change[:METRES]")

_Part = Callable[[float], Shift]


@dataclass(frozen=True)
class Trajectory:
    """A shift for every moment of a log."""

    spec: str
    """As the user wrote it."""
    parts: tuple[_Part, ...]

    @property
    def name(self) -> str:
        """The spec as a file name."""
        return self.spec.replace(":", "-").replace("+", "_")

    def shift_at(self, progress: float) -> Shift:
        """Where to be.

        Args:
            progress: 0 at the first moment of the log, 1 at the last.
        """
        shifts = [part(progress) for part in self.parts]
        return Shift(
            lateral_m=sum(shift.lateral_m for shift in shifts),
            up_m=sum(shift.up_m for shift in shifts),
            yaw_rad=sum(shift.yaw_rad for shift in shifts),
        )


def parse_trajectory(spec: str) -> Trajectory:
    """Read `recorded`, `lateral:2`, `up:1.5`, `yaw:-15`, `lane-change:3.5`, or a sum of them.

    Lateral is to the left of the driving direction; a turn is counter-clockwise seen from above.

    Raises:
        ConfigError: the text is no trajectory, or one that leads too far away.
    """
    found = Trajectory(spec, tuple(_part(text.strip(), spec) for text in spec.split("+")))
    try:
        found.shift_at(1.0)  # every part goes farthest at its end
    except ConfigError as error:
        raise ConfigError(f"trajectory {spec!r}: {error}") from None
    return found


def _part(text: str, spec: str) -> _Part:
    kind, has_value, number = text.partition(":")
    value = _number(number, spec) if has_value else None
    if kind == "recorded" and value is None:
        return lambda _progress: Shift()
    if kind == "lane-change":
        width_m = LANE_WIDTH_M if value is None else value
        return lambda progress: Shift(lateral_m=width_m * _smooth_step(progress))
    if value is not None:
        if kind == "lateral":
            return lambda _progress: Shift(lateral_m=value)
        if kind == "up":
            return lambda _progress: Shift(up_m=value)
        if kind == "yaw":
            return lambda _progress: Shift(yaw_rad=math.radians(value))
    raise ConfigError(f"trajectory {spec!r}: expected one of {', '.join(KINDS)}, or a sum with +")


def _number(text: str, spec: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"trajectory {spec!r}: {text!r} is no number")
    return value


def _smooth_step(progress: float) -> float:
    """From 0 to 1 with neither a jump in speed nor in steering (quintic)."""
    clipped = min(max(progress, 0.0), 1.0)
    return clipped**3 * (10 - 15 * clipped + 6 * clipped**2)
