"""Whether boxes stand where what they hold stands: LiDAR points against their sides.

What a LiDAR sees of a car are its near sides, so its points lie along the sides of a box that
stands right, and few lie just outside. A box is moved about until they do; how far it must go is
how far it is off. Only what stands still is looked at, for moving ones are smeared by their own
speed while they are swept. Box frame: x along the length, y left, z up; metres.
"""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.checks.verdicts import Verdict, sampled_positions
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack

MAX_OFF_M = 0.25
"""Beyond which boxes are said to stand wrong, in the median: sound ones are found within 0.1."""
LEAST_BOXES = 10
NEAR_M = 30.0
_NUM_FRAMES = 6
_LEAST_LENGTH_M = 3.0  # a car: what is smaller has no sides
_LEAST_POINTS, _MOST_POINTS = 60, 1000
_REACH_M = 1.0
_STEPS_M = np.arange(-_REACH_M, _REACH_M + 0.01, 0.1)
_INSIDE_M, _BEYOND_M = 0.3, 0.1  # of a side, points are along it: boxes hold mirrors and wheels
_OVER_ROAD_M, _SILL_M = 0.4, 1.0  # over the lower side: windows lean inwards
_OUTSIDE_COSTS, _WAY_COSTS = 2.0, 0.05  # the latter a metre


def check_box_places(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether the boxes of standing cars lie around their points."""
    swept = scene.swept_frames
    standing = [
        track
        for track in scene.tracks
        if not track.is_moving and track.size_m[0] >= _LEAST_LENGTH_M
    ]
    off_m = []
    for frame_index in (swept[place] for place in sampled_positions(len(swept), _NUM_FRAMES)):
        xyz_m = scene.read_positions(frame_index).double()
        for track in standing:
            row = (track.frame_indices == frame_index).nonzero()[:, 0]
            if len(row) and (found := _off_m(scene, track, int(row[0]), xyz_m)) is not None:
                off_m.append(found)
    if len(off_m) < LEAST_BOXES:
        return "ok", f"only {len(off_m)} boxes of standing cars within {NEAR_M:.0f} m hold enough"
    middle_m = float(np.median(off_m))
    detail = f"{len(off_m)} boxes of standing cars lie {middle_m:.2f} m off their points (median)"
    return ("ok" if middle_m <= MAX_OFF_M else "warn"), detail


def _off_m(
    scene: DrivingScene, track: ActorTrack, row: int, xyz_m: Float[Tensor, "points 3"]
) -> float | None:
    """How far a box must go to lie around the points there; None where there are too few."""
    world_from_box = track.world_from_box[row].double()
    ego_m = scene.world_from_ego[scene.frame_position(int(track.frame_indices[row])), :3, 3]
    if (world_from_box[:3, 3] - ego_m).norm() > NEAR_M:
        return None
    half_m = track.size_m.double() / 2
    around = (xyz_m - world_from_box[:3, 3]).abs().amax(dim=1) < float(half_m[0]) + 2 * _REACH_M
    own_m = transform_points(invert_rigid(world_from_box), xyz_m[around])
    height_m = own_m[:, 2] + half_m[2]
    is_body = (height_m > _OVER_ROAD_M) & (height_m < _SILL_M)
    is_body &= (own_m[:, :2].abs() < half_m[:2] + _REACH_M).all(dim=1)
    body_m = own_m[is_body, :2].numpy()
    if len(body_m) < _LEAST_POINTS:
        return None
    return _best_shift_m(body_m[:: -(-len(body_m) // _MOST_POINTS)], half_m[:2].numpy())


def _best_shift_m(body_m: Float[np.ndarray, "points 2"], half_m: Float[np.ndarray, "2"]) -> float:
    """Length of the shift that puts most points along the sides and fewest outside."""
    x, y = np.meshgrid(_STEPS_M, _STEPS_M, indexing="ij")
    shifts_m = np.stack([x.ravel(), y.ravel()], axis=1)
    beyond_m = (np.abs(body_m[None] - shifts_m[:, None]) - half_m).max(axis=2)
    along = ((beyond_m >= -_INSIDE_M) & (beyond_m <= _BEYOND_M)).mean(axis=1)
    outside = (beyond_m > _BEYOND_M).mean(axis=1)
    score = along - _OUTSIDE_COSTS * outside - _WAY_COSTS * np.linalg.norm(shifts_m, axis=1)
    return float(np.linalg.norm(shifts_m[score.argmax()]))
