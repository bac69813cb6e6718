"""Write a stored scene anew, with something changed: where it was recorded, or who is boxed."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord
from lidarpainter_models.scenes.schema import GLOBAL_FRAME, LABELLED, POSES
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

FURTHER_ENTRIES = (GLOBAL_FRAME, POSES, LABELLED, "generator", "stress")
"""Of a manifest, that stay true of a scene whose frames are as they were; by the latter two a drawn
or spoilt street is known."""


def header_of(scene: DrivingScene, entries: Mapping[str, Any]) -> SceneHeader:
    """The header of a scene, with other further entries of its manifest."""
    return SceneHeader(
        licence=scene.manifest["licence"],
        global_from_world=scene.global_from_world,
        semantic_classes=scene.semantic_classes,
        more=entries,
    )


def write_anew(
    scene: DrivingScene,
    store: Path,
    sequence: str,
    header: SceneHeader,
    change: Callable[[FrameContent], FrameContent],
    provenance: Mapping[str, Any],
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Path:
    """Write a scene under another name of its dataset; returns its folder.

    Args:
        scene: what is written, frame by frame.
        store: folder that holds the scenes.
        sequence: the new name.
        header: of the new scene.
        change: what becomes of each frame.
        provenance: what it was made from, no part of the digest.
        progress: told frames done and frames in all.
    """
    with SceneWriter(store, scene.dataset, sequence, header) as writer:
        for done, frame_index in enumerate(scene.frame_indices, start=1):
            change(stored_content(scene, frame_index)).write(writer)
            progress(done, len(scene.frame_indices))
        writer.set_provenance(provenance)
    return writer.path


def stored_content(scene: DrivingScene, frame_index: int) -> FrameContent:
    """Everything that a scene holds of a frame."""
    position = scene.frame_position(frame_index)
    place = f"{scene.path}, frame {frame_index}"
    sweeps = scene.sweeps_of(frame_index)
    semantics = scene.read_semantics(frame_index) if sweeps else None
    counts = [sweep.num_points for sweep in sweeps]
    classes = [None] * len(sweeps) if semantics is None else list(semantics.split(counts))
    return FrameContent(
        frame_index=frame_index,
        place=place,
        timestamp_ns=int(scene.frame_timestamps_ns[position]),
        world_from_ego=scene.world_from_ego[position],
        images=[
            SourceImage(record=scene.image_record(view), jpeg=scene.read_jpeg(view), source=place)
            for view in scene.views
            if view.frame_index == frame_index
        ],
        sweeps=[
            SourceSweep(
                lidar_name=sweep.lidar_name,
                points=scene.read_sweep(sweep),
                timestamp_ns=sweep.timestamp_ns,
                world_from_lidar=sweep.world_from_lidar,
                semantics=of_sweep,
                source=place,
            )
            for sweep, of_sweep in zip(sweeps, classes, strict=True)
        ],
        boxes=track_boxes(scene.tracks, frame_index),
    )


def track_boxes(tracks: Sequence[ActorTrack], frame_index: int) -> list[BoxRecord]:
    """The boxes of some tracks in a frame, each with the size of its track."""
    found = []
    for track in tracks:
        length_m, width_m, height_m = track.size_m.tolist()
        found += [
            BoxRecord(
                actor_id=track.actor_id,
                category=track.category,
                timestamp_ns=int(track.timestamps_ns[row]),
                world_from_box=track.world_from_box[row],
                size_m=(length_m, width_m, height_m),
                is_moving=track.is_moving,
                num_points=int(track.num_points[row]),
            )
            for row in (track.frame_indices == frame_index).nonzero()[:, 0].tolist()
        ]
    return found
