"""What a user writes for where something should go, read without tensors.

Steps off a path are added with `+`: `lateral:2+up:1.5`; another path may stand before them:
`follow:car-7+up:2`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import MAX_SHIFT_M, Shift

LANE_WIDTH_M = 3.5
"""A lane change without a width goes this far to the left."""
BIRDSEYE_HEIGHT_M = 30.0
RECORDED = "recorded"
KINDS: Mapping[str, str] = {
    RECORDED: "",
    "lateral": ":METRES",
    "up": ":METRES",
    "along": ":METRES",
    "yaw": ":DEGREES",
    "lane-change": "[:METRES][@STARTs+DURATIONs]",
    "waypoints": ":FILE.csv",
    "follow": ":ACTOR",
    "orbit": ":ACTOR",
    "birdseye": "[:METRES]",
}
_PLUS = re.compile(rf"\+(?=\s*(?:{'|'.join(KINDS)})(?:[:@+\s]|$))")
"""Only a plus before a kind parts them: `2s+3s` and names of files hold others."""
_TIMES = re.compile(r"([0-9.]+)s\+([0-9.]+)s")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantStep:
    """The same step at all times; `yaw_rad` turns the body where it is."""

    along_m: float = 0.0
    lateral_m: float = 0.0
    up_m: float = 0.0
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneChange:
    """To the left by a quintic in time, which jumps neither in speed nor in steering."""

    width_m: float
    start_s: float | None = None
    """None changes over all that is followed and keeps the heading."""
    duration_s: float = 0.0


Step = ConstantStep | LaneChange


@dataclass(frozen=True, slots=True)
class PathWords:
    """Another path than the recorded one."""

    kind: str
    value: str = ""
    """An actor or a file."""
    height_m: float = 0.0
    """Of a bird's eye over the car."""


@dataclass(frozen=True, slots=True)
class TrajectoryWords:
    """A trajectory as it was written."""

    steps: tuple[Step, ...]
    path: PathWords | None
    """What the steps lead off; None is the recorded path."""


def read_trajectory_words(spec: str, *, max_shift_m: float | None = MAX_SHIFT_M) -> TrajectoryWords:
    """Read a trajectory, but no file that it names; see `parse_trajectory`.

    Raises:
        ConfigError: the text is no trajectory, or one that leads too far away.
    """
    steps: list[Step] = []
    paths: list[PathWords] = []
    for text in _PLUS.split(spec):
        kind, has_value, value = text.strip().partition(":")
        if kind in ("waypoints", "follow", "orbit") and value:
            paths.append(PathWords(kind, value))
        elif kind == "birdseye":
            height_m = _number(value, spec) if has_value else BIRDSEYE_HEIGHT_M
            paths.append(PathWords(kind, height_m=height_m))
        elif (text.strip(), has_value) != (RECORDED, ""):
            steps.append(_step(text.strip(), spec))
    if len(paths) > 1:
        raise ConfigError(f"trajectory {spec!r}: expected at most one path beside the recorded one")
    if max_shift_m is not None and not paths:
        _check_reach(steps, spec)
    return TrajectoryWords(tuple(steps), paths[0] if paths else None)


def _check_reach(steps: list[Step], spec: str) -> None:
    """Refuse what is too far off; every step goes farthest at its end."""
    sideways = [step.width_m if isinstance(step, LaneChange) else step.lateral_m for step in steps]
    up = [step.up_m for step in steps if isinstance(step, ConstantStep)]
    try:
        Shift(lateral_m=sum(sideways), up_m=sum(up))
    except ConfigError as error:
        raise ConfigError(f"trajectory {spec!r}: {error}") from None


def _step(text: str, spec: str) -> Step:
    name, has_times, times = text.partition("@")
    kind, has_value, number = name.partition(":")
    if kind == "lane-change":
        width_m = _number(number, spec) if has_value else LANE_WIDTH_M
        start_s, duration_s = _times(times, spec) if has_times else (None, 0.0)
        return LaneChange(width_m=width_m, start_s=start_s, duration_s=duration_s)
    if has_value and not has_times and kind in ("lateral", "up", "along", "yaw"):
        value = _number(number, spec)
        if kind == "yaw":
            return ConstantStep(yaw_rad=math.radians(value))
        return ConstantStep(**{f"{kind}_m": value})
    known = ", ".join(f"{kind}{form}" for kind, form in KINDS.items())
    raise ConfigError(f"trajectory {spec!r}: expected one of {known}, or a sum with +")


def _times(text: str, spec: str) -> tuple[float, float]:
    match = _TIMES.fullmatch(text)
    if match is None:
        raise ConfigError(f"trajectory {spec!r}: {text!r} says no times, expected such as 2s+3s")
    start_s, duration_s = (_number(part, spec) for part in match.groups())
    if duration_s <= 0:
        raise ConfigError(f"trajectory {spec!r}: a lane change takes more than {duration_s:g} s")
    return start_s, duration_s


def _number(text: str, spec: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"trajectory {spec!r}: {text!r} is no number")
    return value
