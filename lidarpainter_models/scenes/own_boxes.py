"""Boxes that hold the recording car: labels with the ego among the actors.

Such a box covers whole images and takes the points beside the car. Nothing but the recording car
can be where its cameras, its LiDARs and its origin are, so a box that holds one of them at its own
time is the car's own, however it is called. Box frame: x along the length, y left, z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.scenes.records import RecordedView, Sweep
from lidarpainter_models.scenes.tracks import ActorTrack

GROWN_M = (0.1, 0.1, 0.5)
"""By which boxes are grown to each side: cameras stand on the roof, origins lie on the road."""
LEAST_OWN_SHARE = 0.5
"""A track is left out as a whole where this share of its boxes holds the car."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnBoxes:
    """The boxes of one actor that hold the recording car, and are ignored for it."""

    actor_id: str
    category: str
    num_boxes: int
    num_of_track: int
    """Boxes of the actor, with those that are kept."""

    def __str__(self) -> str:
        held = f"{self.num_boxes} of {self.num_of_track} boxes"
        return f"{self.actor_id} ({self.category}, {held})"


def own_places(
    views: Sequence[RecordedView], sweeps: Sequence[Sweep], ego: DrivenPath
) -> Float[Tensor, "places 3"]:
    """Where on the car its origin, cameras and LiDARs are, in the ego frame (float64)."""
    poses: dict[str, tuple[int, Tensor]] = {}
    for view in views:
        pose = view.camera.world_from_camera
        poses.setdefault(f"camera {view.camera_name}", (view.timestamp_ns, pose))
    for sweep in sweeps:
        poses.setdefault(f"LiDAR {sweep.lidar_name}", (sweep.timestamp_ns, sweep.world_from_lidar))
    times_ns, world_from_sensor = zip(*poses.values(), strict=True)
    ego_from_world = invert_rigid(ego.at(torch.tensor(times_ns)).world_from_body)
    places = (ego_from_world @ torch.stack(world_from_sensor).double())[:, :3, 3]
    return torch.cat([torch.zeros(1, 3, dtype=torch.float64), places])


def holds_own_car(
    track: ActorTrack, places_ego: Float[Tensor, "places 3"], ego: DrivenPath
) -> Bool[Tensor, " times"]:
    """Which boxes of a track hold the recording car, where it is at the time of each box."""
    world_from_own = ego.at(track.timestamps_ns).world_from_body
    box_from_ego = invert_rigid(track.world_from_box.double()) @ world_from_own
    places_box = places_ego @ box_from_ego[:, :3, :3].mT + box_from_ego[:, None, :3, 3]
    half_m = track.size_m.double() / 2 + torch.tensor(GROWN_M, dtype=torch.float64)
    return (places_box.abs() <= half_m).all(dim=-1).any(dim=-1)


def without_own_boxes(
    tracks: Sequence[ActorTrack], places_ego: Float[Tensor, "places 3"], ego: DrivenPath
) -> tuple[tuple[ActorTrack, ...], tuple[OwnBoxes, ...]]:
    """The tracks of other actors, and which boxes were left out."""
    kept, own = [], []
    for track in tracks:
        holds = holds_own_car(track, places_ego, ego)
        if not bool(holds.any()):
            kept.append(track)
            continue
        total, held = len(holds), int(holds.sum())
        named = {"actor_id": track.actor_id, "category": track.category}
        own.append(OwnBoxes(**named, num_boxes=held, num_of_track=total))
        if held < LEAST_OWN_SHARE * total:
            rows = ("frame_indices", "timestamps_ns", "world_from_box", "num_points")
            kept.append(replace(track, **{name: getattr(track, name)[~holds] for name in rows}))
    return tuple(kept), tuple(own)
