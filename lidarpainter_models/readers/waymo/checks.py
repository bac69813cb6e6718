"""Whether what a Waymo segment states twice about the vehicle's motion fits together.

A single wrong number here (a pose, a time) would spoil a reconstruction without any other sign.
What holds for any drive is checked in drive_checks.py.
"""

from itertools import pairwise

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.drive_checks import apart, require_motion
from lidarpainter_models.readers.waymo.cameras import global_from_vehicle_at
from lidarpainter_models.readers.waymo.log import WaymoFrame, WaymoImage

MAX_POSE_GAP_M = 1.0
MAX_POSE_GAP_RAD = 0.05
"""An image's pose, carried to the frame's time, agrees with the frame's to some centimetres."""
NS_PER_US = 1000


def require_drive(frames: list[WaymoFrame]) -> None:
    """Refuse frames whose times do not ascend, or between which no car could have driven."""
    for before, after in pairwise(frames):
        if after.start_us <= before.start_us:
            raise DataError(
                f"{after.place}, timestamp: {after.start_us} us, expected more than the frame "
                f"before, {before.start_us} us"
            )
        require_motion(
            (before.start_us * NS_PER_US, before.global_from_vehicle),
            (after.start_us * NS_PER_US, after.global_from_vehicle),
            after.place,
        )


def require_agreement(image: WaymoImage, frame: WaymoFrame, time_s: float) -> None:
    """Refuse an image that states another place of the vehicle than its frame does."""
    apart_m, apart_rad = apart(global_from_vehicle_at(image, time_s), frame.global_from_vehicle)
    if apart_m > MAX_POSE_GAP_M or apart_rad > MAX_POSE_GAP_RAD:
        raise DataError(
            f"{image.place}, pose: {apart_m:.2f} m and {apart_rad:.3f} rad from the frame's, "
            f"expected {MAX_POSE_GAP_M:g} m and {MAX_POSE_GAP_RAD:g} rad at most"
        )
