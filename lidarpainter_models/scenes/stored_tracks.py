"""Actor tracks as plain arrays, so that a scene or its observations can be stored."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lidarpainter_models.scenes.driving_scene import ActorTrack

COLUMNS = ("frame_indices", "timestamps_ns", "num_points", "world_from_box", "size_m")


def tracks_to_arrays(
    tracks: Sequence[ActorTrack],
) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """Arrays with all tracks one after another, and per track a JSON-able record."""
    records = [
        {
            "actor_id": track.actor_id,
            "category": track.category,
            "is_moving": track.is_moving,
            "num_times": int(track.timestamps_ns.numel()),
        }
        for track in tracks
    ]
    no_times = torch.zeros(0, dtype=torch.int64)
    arrays = {
        "timestamps_ns": torch.cat([no_times, *(track.timestamps_ns for track in tracks)]),
        "frame_indices": torch.cat([no_times, *(track.frame_indices for track in tracks)]),
        "num_points": torch.cat([no_times, *(track.num_points.long() for track in tracks)]),
        "world_from_box": torch.cat(
            [torch.zeros(0, 4, 4).double(), *(track.world_from_box.double() for track in tracks)]
        ),
        "size_m": torch.stack([track.size_m.float() for track in tracks])
        if tracks
        else torch.zeros(0, 3),
    }
    return arrays, records


def tracks_from_arrays(
    arrays: dict[str, Tensor], records: Sequence[dict[str, Any]]
) -> tuple[ActorTrack, ...]:
    """The inverse of `tracks_to_arrays`."""
    tracks, start = [], 0
    for record, size_m in zip(records, arrays["size_m"], strict=True):
        rows = slice(start, start + record["num_times"])
        start = rows.stop
        known = {name: record[name] for name in ("actor_id", "category", "is_moving")}
        times: dict[str, Any] = {name: arrays[name][rows] for name in COLUMNS if name != "size_m"}
        tracks.append(ActorTrack(**known, size_m=size_m, **times))
    return tuple(tracks)
