"""Whether images are exposed alike: between cameras, and from one image of a camera to the next.

LiDAR points that several images show are compared (see `exposure_matching`), in a few short runs of
frames. A fit of several cameras corrects what changes slowly; jumps of one camera from image to
image it takes for the scene.
"""

from collections.abc import Sequence

import numpy as np
import torch

from lidarpainter_models.errors import SceneError
from lidarpainter_models.lidar.colouring import MapColouring
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.lidar.map_building import MAX_RANGE_M, gather_points
from lidarpainter_models.scenes.driving_scene import DrivingScene

LEAST_BETWEEN, LEAST_JUMP = 0.2, 0.08
"""Shares of a pixel from which on it is said; cameras of PandaSet 002 differ by up to 0.23."""
_NUM_RUNS, _RUN_FRAMES = 3, 4
_MOST_POINTS = 400_000


def exposure_differences(scene: DrivingScene) -> list[str]:
    """What is exposed otherwise than the rest, in sentences; of a scene with LiDAR.

    Raises:
        SceneError: no point lies in range.
    """
    frames = set(_runs(scene.swept_frames))
    views = [view for view in scene.views if view.frame_index in frames]
    street = gather_points(scene, frames).street
    if len(street) == 0:
        raise SceneError(
            f"{scene.dataset}/{scene.sequence}: no LiDAR point within {MAX_RANGE_M:g} m by which "
            "images could be compared"
        )
    some = street.keep(torch.arange(0, len(street), -(-len(street) // _MOST_POINTS)))
    colouring = MapColouring(
        LidarMap(street=some, actors={}), scene.tracks, views, most_age_ns=None
    )
    colouring.add_recorded(scene, views)
    brightness = 1 / colouring.gains().mean(axis=1)
    names = np.array([view.camera_name for view in views])
    return _in_words(names, brightness)


def _runs(frames: Sequence[int]) -> list[int]:
    """A few frames in a row, some times over the log."""
    starts = np.linspace(0, max(len(frames) - _RUN_FRAMES, 0), _NUM_RUNS).round().astype(int)
    return [frame for start in starts for frame in frames[start : start + _RUN_FRAMES]]


def _in_words(names: np.ndarray, brightness: np.ndarray) -> list[str]:
    said, reference = [], str(names[0])
    middle = {str(name): float(np.median(brightness[names == name])) for name in names}
    for name, own in middle.items():
        ratio = own / middle[reference]
        if abs(np.log(ratio)) > LEAST_BETWEEN:
            way = "brighter" if ratio > 1 else "darker"
            said.append(f"{name} is {abs(ratio - 1):.0%} {way} than {reference}")
        jumps = np.abs(brightness[names == name] / own - 1)
        if jumps.max() > LEAST_JUMP:
            said.append(f"images of {name} differ in brightness by up to {jumps.max():.0%}")
    return said
