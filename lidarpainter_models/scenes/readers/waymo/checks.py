"""Whether what a Waymo segment states about the vehicle's motion fits together.

A single wrong number here (a pose, a time) would spoil a reconstruction without any other sign.
"""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.scenes.readers.waymo.cameras import exposure_s, global_from_vehicle_at
from lidarpainter_models.scenes.readers.waymo.log import MAX_LAG_S, WaymoFrame, WaymoImage

MAX_SPEED_MPS = 60.0
MAX_TURN_RADPS = 2.0
MAX_POSE_GAP_M = 1.0
MAX_POSE_GAP_RAD = 0.05
"""A picture's pose, carried to the frame's time, agrees with the frame's to some centimetres."""
_US_PER_S = 1_000_000


def require_drive(frames: list[WaymoFrame]) -> None:
    """Refuse frames whose times do not ascend, or between which no car could have driven."""
    for before, after in pairwise(frames):
        step_s = (after.start_us - before.start_us) / _US_PER_S
        if step_s <= 0:
            raise DataError(
                f"{after.place}, timestamp: {after.start_us} us, expected more than the frame "
                f"before, {before.start_us} us"
            )
        apart_m, apart_rad = _apart(before.global_from_vehicle, after.global_from_vehicle)
        if apart_m > MAX_SPEED_MPS * step_s or apart_rad > MAX_TURN_RADPS * step_s:
            raise DataError(
                f"{after.place}, pose: the vehicle has moved {apart_m:.1f} m and turned "
                f"{apart_rad:.2f} rad in {step_s:.3f} s, expected {MAX_SPEED_MPS:.0f} m/s and "
                f"{MAX_TURN_RADPS:.0f} rad/s at most"
            )


def require_timely(image: WaymoImage, time_s: float, last_s: float | None) -> None:
    """Refuse a picture that was not taken in its frame, or not after its camera's last one."""
    lag_s = exposure_s(image) - time_s
    if abs(lag_s) > MAX_LAG_S:
        raise DataError(
            f"{image.place}: taken {lag_s:+.3f} s after the frame, expected {MAX_LAG_S} s at most"
        )
    if last_s is not None and exposure_s(image) <= last_s:
        raise DataError(f"{image.place}: taken at {exposure_s(image):.6f} s, before the last one")


def require_agreement(image: WaymoImage, frame: WaymoFrame, time_s: float) -> None:
    """Refuse a picture that states another place of the vehicle than its frame does."""
    apart_m, apart_rad = _apart(global_from_vehicle_at(image, time_s), frame.global_from_vehicle)
    if apart_m > MAX_POSE_GAP_M or apart_rad > MAX_POSE_GAP_RAD:
        raise DataError(
            f"{image.place}, pose: {apart_m:.2f} m and {apart_rad:.3f} rad from the frame's, "
            f"expected {MAX_POSE_GAP_M:g} m and {MAX_POSE_GAP_RAD:g} rad at most"
        )


def _apart(first: Float[Tensor, "4 4"], second: Float[Tensor, "4 4"]) -> tuple[float, float]:
    """Distance of the origins, and the angle between the axes."""
    apart_m = float((first[:3, 3] - second[:3, 3]).norm())
    cosine = quaternion_from_rotation(first[:3, :3].T @ second[:3, :3])[0]
    return apart_m, float(2 * torch.arccos(cosine.clamp(max=1.0)))
