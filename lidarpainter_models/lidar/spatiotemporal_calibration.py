"""Find what a camera's recording gets wrong: its clock, its mounting angles, how it reads its rows.

LiDAR points of what stands still have a known place, so a point must look alike in all images that
show it. For each camera a turn, a lateness and a readout are sought under which the points do
(`hub_agreement`): photometric bundle adjustment (Alismail et al. 2016) whose structure is measured
and whose colours are eliminated (each point's mean over its images), by Gauss-Newton with a robust
weight (Geman and McClure, 1987), after a search over the lateness. That the structure is held is
what makes the readout visible: geometry that is free to move absorbs it at constant speed.

The variance is divided by the strength of what is compared, else it would be least where images
show least. A fault is believed where it is larger than what is found in sound recordings, stands
out from the scatter between groups of images (Liang and Zeger, 1986), and is found in each half of
the images so that the other half, set aside, agrees better with it, and where depth edges lie on
image edges no worse with it: lamps of the car itself, reflections and bare roads look alike under
many a fault. A car that stands shows neither clock nor readout. Camera frame: x right, y down, z
forward.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from lidarpainter_models.checks.depth_edges import SceneEdges, edge_scores
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.kernels.point_contrasts import LATE, READOUT, TURN
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.hub_agreement import Found, found_in, gains_of
from lidarpainter_models.lidar.hub_images import (
    WIDTH_PX,
    FrameReturns,
    Hub,
    compared_images,
    hubs_of,
    returns_of,
)
from lidarpainter_models.scenes.camera_faults import CameraFault
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

LEAST_TURN_RAD = np.radians([0.25, 0.25, 0.75])
"""Sound cameras of synthetic streets are found within 0.1 degrees, in roll within 0.4."""
LEAST_LATE_S, LEAST_READOUT_S = 0.015, 0.01
"""Sound cameras of synthetic streets are found within 10 and 5 ms."""
MIN_STANDS_OUT = 4.0  # standard errors
LEAST_GAIN, LEAST_GAINING = 0.02, 0.75
"""Of the difference between images set aside, the share by which a fault that is there lessens it
(median over hubs), and the share of hubs in which it does."""
LEAST_IMAGES, LEAST_AGREEING, LEAST_WAY_M = 8, 3, 1.0
"""Images in which a fault may be found, as each half of them must tell; in which a turn is tried,
and the way between the first and the last of them."""
MOST_LOSS = 0.05
"""Of the difference (median over hubs): what costs more is not so, what costs less may be."""
MIN_SPEED_MPS, MAX_SPEED_MPS = 2.0, 60.0
"""A slower car's images look alike whenever they were taken; faster is none, but wrong times."""
MIN_PX_PER_DEG = 2.2  # as in the doctor's check of calibration


def find_faults(
    scene: DrivingScene,
    views: Sequence[RecordedView],
    own_bodies: Mapping[str, Bool[np.ndarray, "rows columns"]] | None = None,
) -> dict[str, CameraFault]:
    """What is wrong about the cameras of some views, each camera's in order of time, by name.

    Nothing of cameras that are sound or that `cannot_be_told` names. `own_bodies` are what of a
    camera's images is the recording car (on any grid), by its name.
    """
    names = sorted({view.camera_name for view in views})
    moved = [_comparable([view for view in views if view.camera_name == name]) for name in names]
    bodies, edges = own_bodies or {}, SceneEdges(scene)
    compared = {own[index][0].frame_index for own in moved for index in compared_images(len(own))}
    returns = returns_of(scene, sorted(compared))
    named = list(zip(moved, (bodies.get(name) for name in names), strict=True))
    faults = side_by_side(lambda own: _fault(scene, own[0], returns, own[1]), named)
    return {
        name: fault
        for name, fault in zip(names, faults, strict=True)
        if fault is not None and _edges_agree(edges, name, views, fault)
    }


def believed(found: Found) -> CameraFault | None:
    """Those parameters that are large and sure enough, None if there are none."""
    size, error = np.abs(found.values), np.maximum(found.errors, 1e-9)
    is_sure = size > MIN_STANDS_OUT * error
    turn = found.values[TURN] * (size[TURN] > LEAST_TURN_RAD) * is_sure[TURN]
    late = found.values[LATE] * (size[LATE] > LEAST_LATE_S) * is_sure[LATE]
    readout = found.values[READOUT] * (size[READOUT] > LEAST_READOUT_S) * is_sure[READOUT]
    if not (turn.any() or late or readout):
        return None
    x, y, z = turn.tolist()
    return CameraFault(turn_rad=(x, y, z), late_s=float(late), readout_s=float(readout))


def cannot_be_told(views: Sequence[RecordedView]) -> list[str]:
    """Cameras of which `find_faults` cannot tell: few or coarse images, or a car that stands."""
    names = sorted({view.camera_name for view in views})
    return [n for n in names if not _comparable([v for v in views if v.camera_name == n])]


def images_agree(
    scene: DrivingScene,
    camera_name: str,
    turn_rad: Float[np.ndarray, "3"],
    own_body: Bool[np.ndarray, "rows columns"] | None = None,
) -> bool | None:
    """Whether a camera's images agree better if it is turned by so much about its own axes.

    Returns:
        None where that cannot be told: the car stands, or its images show too little.
        False only where they agree clearly worse.
    """
    views = scene.views_of(camera_name)
    way_m = float((views[-1].camera.centre_world - views[0].camera.centre_world).norm())
    if len(views) < LEAST_AGREEING or way_m < LEAST_WAY_M or not _is_fine_enough(views[0].camera):
        return None
    stands = Shutter(twist_per_s=torch.zeros(6))  # a turn shows without knowing speeds
    moved = [(view, view.camera.shutter or stands) for view in views]
    compared = [moved[place][0].frame_index for place in compared_images(len(moved))]
    hubs = hubs_of(scene, moved, returns_of(scene, sorted(set(compared))), own_body)
    if len(hubs) < LEAST_AGREEING:
        return None
    gains = gains_of(hubs, np.array([*turn_rad, 0.0, 0.0]))
    if _is_gain(gains):
        return True
    return False if np.median(gains) < -MOST_LOSS else None


def _comparable(views: Sequence[RecordedView]) -> list[tuple[RecordedView, Shutter]]:
    """A camera's views with how they moved; none where too little is seen."""
    moved = [(view, shutter) for view in views if (shutter := view.camera.shutter) is not None]
    speeds_mps = [float(shutter.twist_per_s[3:].norm()) for _, shutter in moved]
    if len(moved) < LEAST_IMAGES or not MIN_SPEED_MPS <= np.median(speeds_mps) <= MAX_SPEED_MPS:
        return []
    return moved if _is_fine_enough(views[0].camera) else []


def _is_fine_enough(camera: Camera) -> bool:
    share = min(1.0, WIDTH_PX / camera.width_px)
    return bool(camera.fx_px * share * np.radians(1) >= MIN_PX_PER_DEG)


def _fault(
    scene: DrivingScene,
    moved: Sequence[tuple[RecordedView, Shutter]],
    returns: Mapping[int, FrameReturns],
    own_body: Bool[np.ndarray, "rows columns"] | None,
) -> CameraFault | None:
    """What is wrong about one camera, tried on images set aside; a told readout is kept."""
    hubs = hubs_of(scene, moved, returns, own_body)
    if not hubs:
        return None
    is_told = any(shutter.is_rolling for _, shutter in moved)
    free = np.arange(READOUT if is_told else READOUT + 1)
    fault = believed(found_in(hubs, free))
    return fault if fault is not None and _gains(hubs, fault, free, len(moved)) else None


def _gains(hubs: Sequence[Hub], fault: CameraFault, free: np.ndarray, num_images: int) -> bool:
    """Whether either half of the images agrees better with what the other half tells of a fault."""
    is_said = np.array([*fault.turn_rad, fault.late_s, fault.readout_s]) != 0
    halves = [
        [part for hub in hubs if (part := hub.among(places)) is not None]
        for places in (range(num_images // 2), range(num_images // 2, num_images))
    ]
    if not all(halves):
        return False
    return all(
        _is_gain(gains_of(aside, found_in(seen, free).values * is_said))
        for seen, aside in (halves, halves[::-1])
    )


def _edges_agree(
    edges: SceneEdges, camera_name: str, views: Sequence[RecordedView], fault: CameraFault
) -> bool:
    """Whether depth edges lie on image edges as well with a fault as without it."""
    frames = {view.frame_index for view in views}
    stored = [image for image in edges.images[camera_name] if image.frame_index in frames]
    faulty = [image.seen_from(fault.corrected(image.camera)) for image in stored]
    with_fault, without = (edge_scores(them, np.zeros((1, 3)))[0] for them in (faulty, stored))
    return bool(with_fault >= without)


def _is_gain(gains: Float[np.ndarray, " hubs"]) -> bool:
    return bool(np.median(gains) >= LEAST_GAIN and (gains > 0).mean() >= LEAST_GAINING)
