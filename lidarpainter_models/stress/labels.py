"""Faults of poses, clocks, calibration and boxes."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.scenes.records import BoxRecord
from lidarpainter_models.stress.frames import Frame

RAD_PER_M = 0.02
"""Noise of a pose turns it as well: 1.1 degrees beside a metre."""
OTHER = {"car": "pedestrian", "pedestrian": "car"}
GHOST_RANGE_M = (8.0, 30.0)
GHOST_SIZE_M = (4.5, 1.9, 1.6)


def pose_noise(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """The whole car is said to stand so many metres off, elsewhere in every frame."""
    if frame.position == 0:
        return frame  # where it stands is the origin of the world
    scale = level * np.array([RAD_PER_M] * 3 + [1.0] * 3)
    tangent = torch.from_numpy(scale * dice.standard_normal(6))
    here = frame.world_from_ego
    return frame.moved(here @ rigid_from_tangent(tangent) @ invert_rigid(here))


def clock_offset(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Pictures are said to be taken so many milliseconds later than they were."""
    late_ns = round(level * 1e6)
    shots = []
    for shot in frame.images:
        then = shot.record.timestamp_ns
        motion = _driven(frame, then, late_ns)
        late = shot.seen_from(motion @ shot.record.camera.world_from_camera)
        shots.append(replace(late, record=replace(late.record, timestamp_ns=then + late_ns)))
    return replace(frame, images=tuple(shots))


def _driven(frame: Frame, start_ns: int, for_ns: int) -> Float[Tensor, "4 4"]:
    """How the car moved (in the world) in some time; past the end of the log as just before it."""
    start_ns = min(start_ns, frame.log_end_ns - for_ns)
    return frame.pose_at(start_ns + for_ns) @ invert_rigid(frame.pose_at(start_ns))


def camera_yaw(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Every camera is said to look so many degrees further to the right than it does."""
    turn = rigid_from_tangent(torch.tensor([0, math.radians(level), 0, 0, 0, 0]).double())
    shots = (shot.seen_from(shot.record.camera.world_from_camera @ turn) for shot in frame.images)
    return replace(frame, images=tuple(shots))


def focal_length(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Every focal length is said to be longer by a share."""
    shots = []
    for shot in frame.images:
        lens = shot.record.camera
        longer = replace(lens, fx_px=lens.fx_px * (1 + level), fy_px=lens.fy_px * (1 + level))
        shots.append(replace(shot, record=replace(shot.record, camera=longer)))
    return replace(frame, images=tuple(shots))


def box_noise(frame: Frame, level: float, dice: np.random.Generator) -> Frame:
    """Each box stands so many metres off along each level axis."""

    def off(box: BoxRecord) -> BoxRecord:
        moved = box.world_from_box.clone()
        moved[:2, 3] += torch.from_numpy(level * dice.standard_normal(2))
        return replace(box, world_from_box=moved)

    return replace(frame, boxes=tuple(map(off, frame.boxes)))


def missing_boxes(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """A share of the actors has no boxes at all, the same in every frame."""
    return replace(frame, boxes=tuple(b for b in frame.boxes if _lot(b.actor_id) >= level))


def wrong_classes(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """A share of the actors has another class."""
    boxes = (
        replace(box, category=OTHER.get(box.category, "car")) if _lot(box.actor_id) < level else box
        for box in frame.boxes
    )
    return replace(frame, boxes=tuple(boxes))


def false_boxes(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """So many boxes around nothing, which drive along with the car."""
    ghosts = []
    for number in range(int(level)):
        place = np.random.default_rng(number)
        ahead, side = place.uniform(*GHOST_RANGE_M), place.uniform(-6, 6)
        where = torch.tensor([0, 0, 0, ahead, side, GHOST_SIZE_M[2] / 2]).double()
        ghosts.append(
            BoxRecord(
                actor_id=f"ghost-{number}",
                category="car",
                timestamp_ns=frame.timestamp_ns,
                world_from_box=frame.world_from_ego @ rigid_from_tangent(where),
                size_m=GHOST_SIZE_M,
                is_moving=True,
                num_points=0,
            )
        )
    return replace(frame, boxes=(*frame.boxes, *ghosts))


def _lot(actor_id: str) -> float:
    """A number from 0 to 1 that an actor draws once for all."""
    return float(np.random.default_rng(list(actor_id.encode())).uniform())
