"""A scene with the car where it was found to have driven, or taken back to where nothing is known.

Points were measured one after the other: each is moved by what the car's pose is off at its time.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.timed_poses import moved_meanwhile, poses_at
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord
from lidarpainter_models.scenes.rewriting import header_of, write_anew
from lidarpainter_models.scenes.schema import LABELLED, LOCALISED, NO_POSES, POSES
from lidarpainter_models.scenes.tracks import does_move


def write_localised(
    scene: DrivingScene,
    path: DrivenPath,
    store: Path,
    sequence: str,
    *,
    provenance: Mapping[str, Any],
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Path:
    """Write a scene with other poses of the car, one for each frame; returns its folder."""
    labels = {LABELLED: scene.manifest[LABELLED]} if LABELLED in scene.manifest else {}
    old_from_new = scene.world_from_ego[0] @ invert_rigid(path.world_from_body[0])
    header = replace(
        header_of(scene, {**labels, POSES: LOCALISED}),
        global_from_world=scene.global_from_world @ old_from_new,
    )
    frame = _Moved(scene, path).frame
    return write_anew(scene, store, sequence, header, frame, provenance, progress)


def write_without_poses(scene: DrivingScene, store: Path, sequence: str) -> Path:
    """Write a scene as if nobody knew where the car drove, and who is where; returns its folder."""
    eyes = torch.eye(4, dtype=torch.float64).repeat(len(scene.frame_indices), 1, 1)
    moved = _Moved(scene, DrivenPath(timestamps_ns=scene.frame_timestamps_ns, world_from_body=eyes))
    header = replace(header_of(scene, {POSES: NO_POSES}), global_from_world=eyes[0])

    def frame(content: FrameContent) -> FrameContent:
        return replace(moved.frame(content), boxes=[])

    about = {"without_poses": f"{scene.dataset}/{scene.sequence}"}
    return write_anew(scene, store, sequence, header, frame, about)


class _Moved:
    """What stood by a scene's own poses, where it stands by others."""

    def __init__(self, scene: DrivingScene, path: DrivenPath) -> None:
        self._recorded, self._path = driven_road(scene), path
        self._moving = {
            track.actor_id: does_move(self._at(track.timestamps_ns, track.world_from_box)[:, :3, 3])
            for track in scene.tracks
        }

    def frame(self, content: FrameContent) -> FrameContent:
        """A frame with all that it holds."""
        return replace(
            content,
            world_from_ego=self._one(content.timestamp_ns, content.world_from_ego),
            images=[self._image(image) for image in content.images],
            sweeps=[self._sweep(sweep) for sweep in content.sweeps],
            boxes=[self._box(box) for box in content.boxes],
        )

    def _image(self, image: SourceImage) -> SourceImage:
        record = image.record
        pose = self._one(record.timestamp_ns, record.camera.world_from_camera)
        return replace(image, record=replace(record, camera=record.camera.refined(pose)))

    def _sweep(self, sweep: SourceSweep) -> SourceSweep:
        times_ns = sweep.timestamp_ns + sweep.points.time_offset_ns.numpy().astype(np.int64)
        moved_m = moved_meanwhile(
            sweep.points.xyz_m.numpy(), times_ns, self._motion, self._path.timestamps_ns.numpy()
        )
        points = replace(sweep.points, xyz_m=torch.from_numpy(moved_m.astype(np.float32)))
        pose = self._one(sweep.timestamp_ns, sweep.world_from_lidar)
        return replace(sweep, points=points, world_from_lidar=pose)

    def _box(self, box: BoxRecord) -> BoxRecord:
        pose = self._one(box.timestamp_ns, box.world_from_box)
        return replace(box, world_from_box=pose, is_moving=self._moving[box.actor_id])

    def _motion(self, at_ns: np.ndarray) -> Float[Tensor, "times 4 4"]:
        """What moves something that was recorded at a time."""
        was, now = (
            poses_at(path.world_from_body, path.timestamps_ns.numpy(), at_ns)
            for path in (self._recorded, self._path)
        )
        return now @ invert_rigid(was)

    def _at(
        self, times_ns: Tensor, poses: Float[Tensor, "times 4 4"]
    ) -> Float[Tensor, "times 4 4"]:
        return self._motion(times_ns.numpy()) @ poses.double()

    def _one(self, time_ns: int, pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        return self._at(torch.tensor([time_ns]), pose[None])[0]
