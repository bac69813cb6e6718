"""Who drives in a closed loop: what a policy sees, and those that are built in.

A policy turns an `Observation` into (acceleration in m/s2, steering angle in radians, to the left).
World frame, z up, metres; yaw is counted from x to y. The position is that of the rear axle.
"""

import math
import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from lidarpainter_models.errors import ConfigError

WHEELBASE_M = 2.8
"""Between the axles of the simulated car: that of a usual one, since no log tells."""
FRONT_M = 3.8
"""From the rear axle to the front bumper."""
LOOK_AHEAD_S, LEAST_LOOK_AHEAD_M = 0.9, 3.5
"""How far ahead pure pursuit aims: as far as the car comes in this time, and not nearer."""
COMFORT_MPS2, BRAKING_MPS2 = 1.5, 2.0
"""Acceleration and comfortable deceleration of Treiber et al. (2000)."""
HEADWAY_S, STANDING_GAP_M, EXPONENT = 1.5, 2.0, 4
"""Time headway, gap between cars that stand, and exponent of the same paper."""
SPEED_GAIN_PER_S, LOG_GAIN_PER_S = 1.0, 5.0
"""Acceleration for each m/s that is lacking; who drives as recorded is as quick as the log."""
LEAD_HALF_WIDTH_M = 1.4
"""Whose middle is nearer to the line drives or stands in front."""
MAIN = "drive"
"""The function of a script."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenActor:
    """Somebody on the road."""

    actor_id: str
    category: str
    position_m: tuple[float, float]
    """The middle of its box."""
    yaw_rad: float
    speed_mps: float
    """Along its own heading."""
    length_m: float
    width_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Observation:
    """What a policy is told at one moment."""

    time_s: float
    """Since the drive began."""
    position_m: tuple[float, float]
    yaw_rad: float
    speed_mps: float
    lane_m: Float[np.ndarray, "samples 2"]
    """The middle of the lane to be driven, in its direction."""
    recorded_m: Float[np.ndarray, "samples 2"]
    """The way that the recording car drove."""
    recorded_speed_mps: float
    """How fast it was at this time of the recording."""
    desired_speed_mps: float
    """How fast it was at its fastest."""
    actors: tuple[SeenActor, ...] = ()
    images: Mapping[str, UInt8[np.ndarray, "height width 3"]] = field(default_factory=dict)
    """What the cameras show, RGB, by name."""
    confidence: Mapping[str, float | None] = field(default_factory=dict)
    """How far each image can be trusted, 0 to 1; None where the renderer does not say."""


Policy = Callable[[Observation], tuple[float, float]]


def check_policy(name: str) -> None:
    """Refuse what names no policy, before anything is loaded for it.

    Raises:
        ConfigError: it is neither a built-in policy nor a Python file.
    """
    if name not in BUILT_IN and not (name.endswith(".py") and Path(name).is_file()):
        raise ConfigError(f"--policy {name!r}: expected {', '.join(BUILT_IN)} or a .py file")


def policy_named(name: str) -> Policy:
    """A built-in policy, or the function `drive` of a Python file of the user's own.

    Raises:
        ConfigError: there is no such policy, or the file has no such function.
    """
    check_policy(name)
    if name in BUILT_IN:
        return BUILT_IN[name]
    try:
        found = runpy.run_path(name).get(MAIN)
    except Exception as error:  # the user's code may fail in any way
        raise ConfigError(f"--policy {name}: {type(error).__name__}: {error}") from error
    if not callable(found):
        raise ConfigError(f"--policy {name}: expected a function {MAIN}(observation) in it")
    return checked(found, name)


def checked(policy: Callable[[Observation], object], name: str) -> Policy:
    """A policy of somebody whose failures and answers are told in one line."""

    def drive(seen: Observation) -> tuple[float, float]:
        try:
            acceleration_mps2, steering_rad = map(float, policy(seen))  # type: ignore[call-overload]
        except Exception as error:  # the user's code may fail in any way
            raise ConfigError(
                f"{name} at {seen.time_s:.1f} s: {type(error).__name__}: {error}; expected "
                "(acceleration in m/s2, steering in rad)"
            ) from error
        if not math.isfinite(acceleration_mps2) or not math.isfinite(steering_rad):
            raise ConfigError(f"{name} at {seen.time_s:.1f} s: an answer that is no number")
        return acceleration_mps2, steering_rad

    return drive


def lane_keep(seen: Observation) -> tuple[float, float]:
    """Keep to the middle of the lane, as fast as the recording car was at its fastest."""
    wanted = SPEED_GAIN_PER_S * (seen.desired_speed_mps - seen.speed_mps)
    acceleration_mps2 = min(max(wanted, -2 * BRAKING_MPS2), COMFORT_MPS2)
    return acceleration_mps2, pure_pursuit(seen, seen.lane_m)


def follow_log(seen: Observation) -> tuple[float, float]:
    """Drive the recorded way as fast as it was driven."""
    lacking_mps = seen.recorded_speed_mps - seen.speed_mps
    return LOG_GAIN_PER_S * lacking_mps, pure_pursuit(seen, seen.recorded_m)


def follow_lead(seen: Observation) -> tuple[float, float]:
    """Keep to the lane and behind whoever is in front: the intelligent driver model."""
    gap_m, lead_mps = lead_of(seen)
    acceleration_mps2 = idm_mps2(seen.speed_mps, seen.desired_speed_mps, gap_m, lead_mps)
    return acceleration_mps2, pure_pursuit(seen, seen.lane_m)


def idm_mps2(speed_mps: float, desired_mps: float, gap_m: float, lead_mps: float) -> float:
    """Acceleration of the intelligent driver model, Treiber et al. (2000).

    Args:
        speed_mps: own speed.
        desired_mps: on a free road.
        gap_m: to the one in front, bumper to bumper; infinite where there is none.
        lead_mps: its speed.
    """
    free = (speed_mps / max(desired_mps, 0.1)) ** EXPONENT
    closing_mps = speed_mps - lead_mps
    wanted_m = STANDING_GAP_M + max(
        0.0,
        speed_mps * HEADWAY_S
        + speed_mps * closing_mps / (2 * math.sqrt(COMFORT_MPS2 * BRAKING_MPS2)),
    )
    return COMFORT_MPS2 * (1 - free - (wanted_m / max(gap_m, 0.1)) ** 2)


def pure_pursuit(seen: Observation, line_m: Float[np.ndarray, "samples 2"]) -> float:
    """Steering angle towards a point of the line ahead, Coulter (1992)."""
    reach_m = max(LEAST_LOOK_AHEAD_M, LOOK_AHEAD_S * seen.speed_mps)
    here = np.asarray(seen.position_m)
    nearest = int(np.linalg.norm(line_m - here, axis=1).argmin())
    beyond = np.linalg.norm(line_m[nearest:] - here, axis=1) >= reach_m
    if beyond.any():
        target = line_m[nearest + int(beyond.argmax())]
    else:  # straight on past the end of the line
        ahead = line_m[-1] - line_m[-2]
        target = line_m[-1] + reach_m * ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    away = target - here
    bearing_rad = math.atan2(away[1], away[0]) - seen.yaw_rad
    distance_m = max(float(np.linalg.norm(away)), 0.1)
    return math.atan2(2 * WHEELBASE_M * math.sin(bearing_rad), distance_m)


def lead_of(seen: Observation) -> tuple[float, float]:
    """Gap to whoever is next on the lane ahead, bumper to bumper, and how fast that one is."""
    lane, along_m = seen.lane_m, _travelled(seen.lane_m)
    own = int(np.linalg.norm(lane - seen.position_m, axis=1).argmin())
    found = (math.inf, 0.0)
    for actor in seen.actors:
        away_m = np.linalg.norm(lane - actor.position_m, axis=1)
        place = int(away_m.argmin())
        gap_m = float(along_m[place] - along_m[own]) - actor.length_m / 2 - FRONT_M
        if place > own and away_m[place] < LEAD_HALF_WIDTH_M and gap_m < found[0]:
            found = (gap_m, max(actor.speed_mps, 0.0))
    return found


def _travelled(line_m: Float[np.ndarray, "samples 2"]) -> Float[np.ndarray, " samples"]:
    return np.append(0.0, np.linalg.norm(np.diff(line_m, axis=0), axis=1).cumsum())


def changed_lane(
    line_m: Float[np.ndarray, "samples 2"], start_m: Sequence[float], aside_m: float, over_m: float
) -> Float[np.ndarray, "samples 2"]:
    """A line that leaves another one for its left, smoothly, over so many metres from a place."""
    along_m = _travelled(line_m)
    start = along_m[int(np.linalg.norm(line_m - start_m, axis=1).argmin())]
    share = np.clip((along_m - start) / over_m, 0, 1)
    shift_m = aside_m * share * share * (3 - 2 * share)
    ahead = np.gradient(line_m, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    return line_m + shift_m[:, None] * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


BUILT_IN: dict[str, Policy] = {"lane-keep": lane_keep, "log": follow_log, "idm": follow_lead}
"""Those that need no file."""
