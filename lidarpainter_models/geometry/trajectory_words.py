"""What a user writes for where something should go, read without tensors.

Steps off a path are added with `+`: `lateral:2+up:1.5`; another path may stand before them:
`follow:car-7+up:2`.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.shifts import MAX_SHIFT_M, Shift

LANE_WIDTH_M = 3.5
"""A lane change without a width goes this far to the left."""
BIRDSEYE_HEIGHT_M = 30.0
RECORDED = "recorded"
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


@dataclass(frozen=True, slots=True, kw_only=True)
class PathWords:
    """Another path than the recorded one: that of a file or of an actor, or one over the car."""

    file: str | None = None
    """A CSV file of waypoints."""
    actor: str | None = None
    """The actor that is followed or circled."""
    height_m: float = 0.0
    """How far a bird's eye is above the car."""
    looks: bool = False
    """Whether the path also says where a single camera looks."""


def read_trajectory_words(
    spec: str, *, max_shift_m: float | None = MAX_SHIFT_M
) -> tuple[tuple[Step, ...], PathWords | None]:
    """The steps of a trajectory and what they lead off, None being the recorded path.

    No file that it names is read; see `parse_trajectory`.

    Raises:
        ConfigError: the text is no trajectory, or one that leads too far away.
    """
    parts = [_read_part(text.strip(), spec) for text in _PLUS.split(spec)]
    steps = [part for part in parts if isinstance(part, Step)]
    paths = [part for part in parts if isinstance(part, PathWords)]
    if len(paths) > 1:
        raise ConfigError(f"trajectory {spec!r}: expected at most one path beside the recorded one")
    if max_shift_m is not None and not paths:
        _check_reach(steps, spec)
    return tuple(steps), paths[0] if paths else None


def _check_reach(steps: list[Step], spec: str) -> None:
    """Refuse what is too far off; every step goes farthest at its end."""
    sideways = [step.width_m if isinstance(step, LaneChange) else step.lateral_m for step in steps]
    up = [step.up_m for step in steps if isinstance(step, ConstantStep)]
    try:
        Shift(lateral_m=sum(sideways), up_m=sum(up))
    except ConfigError as error:
        raise ConfigError(f"trajectory {spec!r}: {error}") from None


def _read_part(text: str, spec: str) -> Step | PathWords | None:
    """Read one word of a trajectory; None for the recorded path."""
    word = TRAJECTORY_WORDS.get(re.split("[:@]", text, maxsplit=1)[0])
    rest = re.fullmatch(word.pattern, text[len(word.name) :]) if word else None
    if word is None or rest is None:
        known = ", ".join(f"{one.name}{one.form}" for one in TRAJECTORY_WORDS.values())
        raise ConfigError(f"trajectory {spec!r}: expected one of {known}, or a sum with +")
    groups = {name: value for name, value in rest.groupdict().items() if value is not None}
    return word.read(groups, spec)


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


_Read = Callable[[Mapping[str, str], str], Step | PathWords | None]


@dataclass(frozen=True, slots=True)
class TrajectoryWord:
    """One word that a trajectory can be made of."""

    name: str
    form: str
    """What follows the name, as errors and help texts show it."""
    meaning: str
    """What a help text says of it, units included."""
    pattern: str
    """What follows the name, as a regular expression with named groups."""
    read: _Read
    """From the groups that were found and the whole text to the step or path; None moves nothing.

    It raises a ConfigError for a number or time that is none.
    """


def _step_along(field: str) -> _Read:
    return lambda found, spec: ConstantStep(**{field: _number(found["number"], spec)})


def _turn(found: Mapping[str, str], spec: str) -> ConstantStep:
    return ConstantStep(yaw_rad=math.radians(_number(found["number"], spec)))


def _lane_change(found: Mapping[str, str], spec: str) -> LaneChange:
    width_m = _number(found["number"], spec) if "number" in found else LANE_WIDTH_M
    start_s, duration_s = _times(found["times"], spec) if "times" in found else (None, 0.0)
    return LaneChange(width_m=width_m, start_s=start_s, duration_s=duration_s)


def _waypoints(found: Mapping[str, str], _spec: str) -> PathWords:
    return PathWords(file=found["name"])


def _by_actor(*, looks: bool) -> _Read:
    return lambda found, _spec: PathWords(actor=found["name"], looks=looks)


def _birdseye(found: Mapping[str, str], spec: str) -> PathWords:
    height_m = _number(found["number"], spec) if "number" in found else BIRDSEYE_HEIGHT_M
    return PathWords(height_m=height_m, looks=True)


_NUMBER = r":(?P<number>[^@]*)"
_NAME = r":(?P<name>.+)"
_WORDS = (
    TrajectoryWord(RECORDED, "", "the path that was driven", "", lambda _found, _spec: None),
    TrajectoryWord("lateral", ":METRES", "left is positive", _NUMBER, _step_along("lateral_m")),
    TrajectoryWord("up", ":METRES", "higher", _NUMBER, _step_along("up_m")),
    TrajectoryWord("along", ":METRES", "ahead", _NUMBER, _step_along("along_m")),
    TrajectoryWord("yaw", ":DEGREES", "a turn; left is positive", _NUMBER, _turn),
    TrajectoryWord(
        "lane-change",
        "[:METRES][@STARTs+DURATIONs]",
        "a smooth curve; left is positive, seconds of the log",
        r"(?::(?P<number>[^@]*))?(?:@(?P<times>.*))?",
        _lane_change,
    ),
    TrajectoryWord("waypoints", ":FILE.csv", "places in a file", _NAME, _waypoints),
    TrajectoryWord("follow", ":ACTOR", "behind an actor", _NAME, _by_actor(looks=False)),
    TrajectoryWord("orbit", ":ACTOR", "once around an actor", _NAME, _by_actor(looks=True)),
    TrajectoryWord(
        "birdseye", "[:METRES]", "down on the car from above", r"(?::(?P<number>.*))?", _birdseye
    ),
)
TRAJECTORY_WORDS: Mapping[str, TrajectoryWord] = {word.name: word for word in _WORDS}
"""Every word of a trajectory; help, checks and reading take their words from here."""
_PLUS = re.compile(rf"\+(?=\s*(?:{'|'.join(TRAJECTORY_WORDS)})(?:[:@+\s]|$))")
"""Only a plus before a word parts a trajectory: `2s+3s` and names of files hold others."""


def trajectory_help() -> str:
    """What the help of an option says of trajectories: every word with its form and meaning."""
    words = "; ".join(f"{one.name}{one.form} ({one.meaning})" for one in TRAJECTORY_WORDS.values())
    return f"{words}. Several with + between; steps lead at most {MAX_SHIFT_M:g} m away."
