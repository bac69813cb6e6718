"""What both releases of the Waymo Open Dataset say about a segment, checked, in plain numbers.

Version 1 (TFRecord) and version 2 (Parquet) hold the same under other names; their readers give
what is defined here and `reader.py` makes a scene of it. Lengths are metres, angles radians, times
seconds since the epoch (float64 holds them to 0.2 us) unless named otherwise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.log import naming
from lidarpainter_models.readers.waymo.calibration import finite_numbers, rigid_pose
from lidarpainter_models.scenes.validation import require_name, require_size

CATEGORIES = {0: "unknown", 1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}
"""By `Label.Type`, without its prefix."""
MAX_LABELS = 10_000
RANGE_CHANNELS, POSE_CHANNELS = 4, 6
"""Of a pixel of a range image, and of its pose."""
MAX_REACH_M = 1000.0
"""No label, point or image belongs to a frame from farther away."""
MAX_LAG_S = 0.15
"""An image taken longer before or after the middle of the sweep is another frame's."""
MAX_SPEED_MPS = 100.0
MAX_TURN_RADPS = 10.0
_MAX_TIMESTAMP_US = 1 << 52
"""In the year 2112."""


@dataclass(frozen=True, slots=True, eq=False)
class UprightBox:
    """A box in the vehicle frame of its frame's pose, turned about the vehicle's z alone."""

    centre_m: np.ndarray
    size_m: tuple[float, float, float]
    """Length, width, height."""
    heading_rad: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WaymoLabel:
    """One labelled actor of one frame."""

    actor_id: str
    category: str
    box: UprightBox
    """As the LiDARs saw the actor."""
    speed_mps: float
    synced: tuple[str, UprightBox] | None
    """The camera that sees most of the actor and the box when it caught its centre, if stated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WaymoFrame:
    """What is known of a frame before its sensors are read."""

    start_us: int
    """First scan of the TOP LiDAR, microseconds since the epoch: the frame's name, too."""
    global_from_vehicle: Float[Tensor, "4 4"]
    """In the middle of the frame, roughly."""
    labels: tuple[WaymoLabel, ...]
    place: str
    """To name in errors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WaymoImage:
    """One image."""

    camera_name: str
    jpeg: bytes
    global_from_vehicle: Float[Tensor, "4 4"]
    """At `pose_time_s`, which is within some milliseconds of the exposure."""
    pose_time_s: float
    velocity_mps: np.ndarray
    """(3) of the vehicle, in the global frame."""
    turn_radps: np.ndarray
    """(3) of the vehicle, in its own frame."""
    shutter_s: float
    """Exposure of one row or column."""
    trigger_s: float
    readout_done_s: float
    place: str


@dataclass(frozen=True, kw_only=True, eq=False)
class WaymoSweep:
    """The range images of one LiDAR."""

    lidar_name: str
    returns: tuple[np.ndarray, ...]
    """Per echo float32 (rows, columns, 4): range, intensity, elongation, in a no-label zone."""
    pixel_poses: np.ndarray | None
    """float32 (rows, columns, 6): roll pitch yaw x y z of the vehicle in the global frame."""
    place: str


def checked_speed(x_mps: float, y_mps: float, place: str) -> float:
    """The level speed of a label.

    Raises:
        DataError: it is not finite.
    """
    speed_mps = math.hypot(x_mps, y_mps)
    if not math.isfinite(speed_mps):
        raise DataError(f"{place}: the speed is not finite")
    return speed_mps


def checked_frame(
    start_us: int, global_from_vehicle: Sequence[float], labels: tuple[WaymoLabel, ...], place: str
) -> WaymoFrame:
    """A frame with a time and a pose that make sense."""
    if not 0 < start_us < _MAX_TIMESTAMP_US:
        raise DataError(f"{place}, timestamp: {start_us} us, expected a time since the epoch")
    return WaymoFrame(
        start_us=start_us,
        global_from_vehicle=rigid_pose(global_from_vehicle, f"{place}, pose"),
        labels=labels,
        place=place,
    )


def checked_image(
    camera_name: str,
    jpeg: bytes,
    global_from_vehicle: Sequence[float],
    velocity: Sequence[float],
    times_s: Sequence[float],
    place: str,
) -> WaymoImage:
    """An image with a pose, velocities and times that make sense.

    The pose is 16 numbers, `velocity` v_x v_y v_z in m/s and w_x w_y w_z in rad/s; `times_s` are of
    the pose, the shutter's opening, the trigger, the end of the readout.

    Raises:
        DataError: something is missing or senseless.
    """
    rates = finite_numbers(velocity, 6, f"{place}, velocity")
    # a hypotenuse beyond float64 is infinite; numpy's norm would warn of it
    if math.hypot(*rates[:3]) > MAX_SPEED_MPS or math.hypot(*rates[3:]) > MAX_TURN_RADPS:
        raise DataError(
            f"{place}, velocity: faster than {MAX_SPEED_MPS:.0f} m/s or {MAX_TURN_RADPS:.0f} rad/s"
        )
    pose_time_s, shutter_s, trigger_s, done_s = finite_numbers(
        times_s, 4, f"{place}, times"
    ).tolist()
    middle_s = (trigger_s + done_s) / 2
    if shutter_s < 0 or not shutter_s <= done_s - trigger_s <= MAX_LAG_S:
        raise DataError(
            f"{place}: triggered at {trigger_s:.6f} s, read at {done_s:.6f} s with a shutter of "
            f"{shutter_s:g} s, expected them in this order within {MAX_LAG_S} s"
        )
    if abs(pose_time_s - middle_s) > MAX_LAG_S:
        raise DataError(
            f"{place}: the pose is {pose_time_s - middle_s:+.3f} s from the exposure, expected "
            f"{MAX_LAG_S} s at most"
        )
    return WaymoImage(
        camera_name=camera_name,
        jpeg=jpeg,
        global_from_vehicle=rigid_pose(global_from_vehicle, f"{place}, pose"),
        pose_time_s=pose_time_s,
        velocity_mps=rates[:3],
        turn_radps=rates[3:],
        shutter_s=shutter_s,
        trigger_s=trigger_s,
        readout_done_s=done_s,
        place=place,
    )


def echoes_present(images: Sequence[np.ndarray | None], place: str) -> tuple[np.ndarray, ...]:
    """The range images of the echoes that a LiDAR has.

    Raises:
        DataError: a later echo without the first one.
    """
    found = tuple(image for image in images if image is not None)
    if found and images[0] is None:
        raise DataError(f"{place}: a range image of the second echo, but none of the first")
    return found


def checked_box(numbers: Sequence[float], place: str) -> UprightBox:
    """A box from its centre (3), length, width, height and heading.

    Raises:
        DataError: a number is missing or senseless.
    """
    x_m, y_m, z_m, length_m, width_m, height_m, heading_rad = finite_numbers(
        numbers, 7, place
    ).tolist()
    size_m = (length_m, width_m, height_m)
    require_size(size_m, place)
    centre_m = np.array([x_m, y_m, z_m])
    if max(np.abs(centre_m).max(), *size_m) > MAX_REACH_M or abs(heading_rad) > 100:
        raise DataError(f"{place}: a box beyond {MAX_REACH_M:.0f} m or of endless turns")
    return UprightBox(centre_m, size_m, heading_rad)


def actor_name(object_id: str, place: str) -> str:
    """The id of an actor as a name.

    Ids are 22 letters of base64; one in thirty begins with `-` or `_`, which a name may not: those
    get `id` in front (24 letters, so no other id can become the same).

    Raises:
        DataError: the id is no name even so.
    """
    name = f"id{object_id}" if object_id[:1] in ("-", "_") else object_id
    with naming(place):
        return require_name(name, "actor")


def category_name(kind: int, place: str) -> str:
    """The class of a label."""
    try:
        return CATEGORIES[kind]
    except KeyError:
        raise DataError(
            f"{place}: label type {kind} is not known, expected 0 to {max(CATEGORIES)}"
        ) from None
