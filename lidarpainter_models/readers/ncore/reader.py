"""Read NVIDIA's NCore V4, as its converters write it and NuRec takes it in, without its library.

The LiDAR with the most rays is the clock: each of its frames is one of the scene, with the image of
every camera and the frame of every other LiDAR that are nearest to its middle. Images, points and
boxes stand by the poses of their own times. A rolling image has its first row at the start of its
frame and its last at the end; a global one is taken at the start. A box belongs to the frame at
whose end it is stated, else to the one whose middle is nearest.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.timed_poses import compensated
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_rotation
from lidarpainter_models.readers.ncore.lenses import lens_of
from lidarpainter_models.readers.ncore.sequence import (
    NS_PER_US,
    RIG,
    WORLD,
    Component,
    NcoreSequence,
    entry,
    numbers,
    whole_numbers,
)
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S, level_frame
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames
from lidarpainter_models.readers.source_logs.sweep_frames import nearest_images
from lidarpainter_models.readers.source_logs.swept_boxes import with_counts, with_motion
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.image_bytes import as_jpeg
from lidarpainter_models.scenes.records import (
    BoxRecord,
    ImageRecord,
    RollingShutter,
    SweepPoints,
)
from lidarpainter_models.scenes.validation import require_name, require_size
from lidarpainter_models.scenes.writer import SceneHeader

DATASET = "ncore"
LICENCE = "not stated: that of the data set which was converted to NCore"
MAX_FRAME_US, MAX_BEYOND_NS = 1_000_000, 100_000_000
"""How long a frame may take, and how far outside the times of the car's poses it may be."""
_UNIT = 1e-3
"""By so much the length of a direction may differ from 1."""


@dataclass(frozen=True, eq=False)
class _Sensor:
    """A camera or a LiDAR, when its frames are taken, and which of them each frame has, or -1."""

    data: Component
    frames_us: Int64[np.ndarray, "frames 2"]
    taken_ns: Int64[np.ndarray, " frames"]
    chosen: Int64[np.ndarray, " scene_frames"]


class NcoreLog:
    """One sequence; poses, lenses and boxes are read at once, images and points frame by frame."""

    dataset = DATASET
    is_drive = True

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Open a sequence, see `open_log`."""
        self.sequence, self._root, self._source = sequence, root, NcoreSequence(root, sequence)
        self.place, self._tree = self._source.place, self._source.tree
        lidars, known = self._source.of_kind("lidars"), self._source.of_kind("cameras")
        clock_us = self._clock_us(lidars)
        self._ends_us, self._frames_ns = clock_us[:, 1], _middles_ns(clock_us)
        steps_ns = np.diff(self._frames_ns)
        self._reach_ns = int(np.median(steps_ns)) // 2 if len(steps_ns) else NS_PER_S
        self.frame_indices = chosen_frames(len(clock_us), frames, self.place)
        first_ns = self._frames_ns[self.frame_indices[:1]]
        level = level_frame(self._tree.poses(WORLD, RIG, first_ns)[0])
        self._world_from_theirs = invert_rigid(level)
        root_frame = self._tree.parent(WORLD) or WORLD
        self.global_from_world = self._tree.poses(root_frame, WORLD, first_ns)[0] @ level
        licence = self._source.told.get("licence")
        self.header = SceneHeader(
            licence=licence if licence and isinstance(licence, str) else LICENCE,
            global_from_world=self.global_from_world,
        )
        self._lidars = {
            name: self._sensor(one, _middles_ns(one.frames_us())) for name, one in lidars.items()
        }
        intrinsics = self._source.one("intrinsics")
        self._lenses = {
            name: lens_of(intrinsics.attributes(f"cameras/{name}"), intrinsics.place(name))
            for name in chosen_cameras(cameras, known, self.place)
        }
        self._cameras: dict[str, _Sensor] = {}
        for name, lens in self._lenses.items():
            frames_us = known[name].frames_us()
            taken_ns = _middles_ns(frames_us) if lens.direction else frames_us[:, 0] * NS_PER_US
            self._cameras[name] = self._sensor(known[name], taken_ns)
        self._boxes = with_motion(self._placed_boxes())

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        time_ns, place = int(self._frames_ns[frame_index]), f"{self.place}, frame {frame_index}"
        self._require_pose(time_ns, place)
        sweeps = [
            self._sweep(name, lidar, int(lidar.chosen[frame_index]))
            for name, lidar in self._lidars.items()
            if lidar.chosen[frame_index] >= 0
        ]
        sweeps = [sweep for sweep in sweeps if sweep.points.num_points]
        boxes = self._boxes.get(frame_index, [])
        if sweeps:
            boxes = with_counts(boxes, torch.cat([sweep.points.xyz_m for sweep in sweeps]))
        return FrameContent(
            frame_index=frame_index,
            place=place,
            timestamp_ns=time_ns,
            world_from_ego=self._pose(RIG, time_ns),
            images=[
                self._image(name, camera, int(camera.chosen[frame_index]))
                for name, camera in self._cameras.items()
                if camera.chosen[frame_index] >= 0
            ],
            sweeps=sweeps,
            boxes=boxes,
        )

    def provenance(self) -> dict[str, object]:
        """The folder, and a digest over what was read of each store."""
        return {"root": self._root.name, "stores": self._source.provenance()}

    def _clock_us(self, lidars: dict[str, Component]) -> Int64[np.ndarray, "frames 2"]:
        """The frames of the LiDAR that has the most rays in its first one."""
        counts = {}
        for name, data in lidars.items():
            if len(frames_us := data.frames_us()):
                first = f"frames/{frames_us[0, 1]}/ray_bundle"
                counts[name] = len(data.array(f"{first}/timestamp_us", None))
        if not counts:
            raise DataError(f"{self.place}: no LiDAR with frames, expected one")
        return lidars[max(counts, key=counts.__getitem__)].frames_us()

    def _sensor(self, data: Component, taken_ns: Int64[np.ndarray, " frames"]) -> _Sensor:
        chosen = nearest_images(self._frames_ns, taken_ns, reach_ns=self._reach_ns)
        return _Sensor(data, data.frames_us(), taken_ns, chosen)

    def _pose(self, frame: str, time_ns: int) -> Float[Tensor, "4 4"]:
        """Where a frame stands in the scene's world."""
        return self._world_from_theirs @ self._tree.poses(WORLD, frame, np.array([time_ns]))[0]

    def _require_pose(self, time_ns: int, where: str) -> None:
        span_ns = self._tree.span_ns(WORLD, RIG) or (time_ns, time_ns)
        if not span_ns[0] - MAX_BEYOND_NS <= time_ns <= span_ns[1] + MAX_BEYOND_NS:
            first_s, time_s, last_s = (one / NS_PER_S for one in (span_ns[0], time_ns, span_ns[1]))
            told = f"poses of {RIG} from {first_s:.3f} to {last_s:.3f} s, expected one"
            raise DataError(f"{where}: at {time_s:.3f} s, {told}")

    def _image(self, name: str, camera: _Sensor, number: int) -> SourceImage:
        start_us, end_us = camera.frames_us[number].tolist()
        time_ns, lens = int(camera.taken_ns[number]), self._lenses[name]
        shutter = None
        if lens.direction is not None:
            duration_s = (end_us - start_us) / 1e6
            shutter = RollingShutter(duration_s=duration_s, direction=lens.direction)
        record = ImageRecord(
            camera_name=name,
            timestamp_ns=time_ns,
            camera=Camera(
                world_from_camera=self._pose(name, time_ns),
                **lens.intrinsics,
                shutter=None,
                width_px=lens.width_px,
                height_px=lens.height_px,
            ),
            distortion=lens.distortion,
            rolling_shutter=shutter,
        )
        where = camera.data.place(f"frames/{end_us}/image")
        jpeg = as_jpeg(camera.data.bytes(f"frames/{end_us}/image"), where)
        return SourceImage(record=record, jpeg=jpeg, source=where)

    def _sweep(self, name: str, lidar: _Sensor, number: int) -> SourceSweep:
        start_us, end_us = lidar.frames_us[number].tolist()
        where, middle_ns = lidar.data.place(f"frames/{end_us}"), int(lidar.taken_ns[number])
        if end_us - start_us > MAX_FRAME_US:
            raise DataError(f"{where}: takes {(end_us - start_us) / 1e6} s, expected 1 at most")
        xyz_m, times_us, points = _returns(lidar.data, f"frames/{end_us}")
        if not ((times_us >= start_us) & (times_us <= end_us)).all():
            raise DataError(f"{where}: a ray is outside the times of its frame")
        times_ns, known_ns = times_us * NS_PER_US, self._tree.times_ns(WORLD, name)
        poses = self._world_from_theirs @ self._tree.poses(WORLD, name, known_ns)
        return SourceSweep(
            lidar_name=name,
            points=replace(
                points,
                xyz_m=compensated(xyz_m, times_ns, poses, known_ns),
                time_offset_ns=torch.from_numpy((times_ns - middle_ns).astype(np.int32)),
            ),
            timestamp_ns=middle_ns,
            world_from_lidar=self._pose(name, middle_ns),
            source=where,
        )

    def _placed_boxes(self) -> dict[int, list[BoxRecord]]:
        """Boxes by frame; of several of one actor the one whose time is nearest to the middle."""
        chosen, found = set(self.frame_indices), dict[int, dict[str, tuple[int, BoxRecord]]]()
        for stated_us, box in self._stated_boxes():
            apart_ns = np.abs(self._frames_ns - box.timestamp_ns)
            ending = np.flatnonzero(self._ends_us == stated_us)
            frame = int(ending[0]) if len(ending) else int(apart_ns.argmin())
            others, apart = found.setdefault(frame, {}), int(apart_ns[frame])
            if frame in chosen and apart <= 2 * self._reach_ns:
                others[box.actor_id] = min(
                    (apart, box), others.get(box.actor_id, (apart, box)), key=lambda one: one[0]
                )
        return {frame: [box for _, box in boxes.values()] for frame, boxes in found.items()}

    def _stated_boxes(self) -> Iterator[tuple[int, BoxRecord]]:
        """All boxes, each with the time at which its reference frame is meant."""
        if not self._source.of_kind("cuboids"):
            return
        cuboids, pose_at = self._source.one("cuboids"), cache(self._pose)
        where, name = cuboids.place("cuboids"), "cuboid_track_observations"
        for row, stated in enumerate(entry(cuboids.attributes("cuboids"), name, list, where)):
            place = f"{where}, row {row}"
            box = entry(stated, "bbox3", dict, place)
            centre_m, sizes_m, turn_rad = (
                numbers(box.get(part), (3,), place) for part in ("centroid", "dim", "rot")
            )
            length_m, width_m, height_m = sizes_m.tolist()
            require_size((length_m, width_m, height_m), place)
            names = ("reference_frame_timestamp_us", "timestamp_us")
            times_us = [stated.get(name) for name in names]
            stated_us, time_us = whole_numbers(times_us, (2,), place).tolist()
            frame_from_box = rigid_from_rotation(
                torch.from_numpy(Rotation.from_euler("xyz", turn_rad).as_matrix()),
                torch.from_numpy(centre_m),
            )
            frame = entry(stated, "reference_frame_id", str, place)
            yield (
                stated_us,
                BoxRecord(
                    actor_id=require_name(entry(stated, "track_id", str, place), f"{place}: actor"),
                    category=entry(stated, "class_id", str, place),
                    timestamp_ns=time_us * NS_PER_US,
                    world_from_box=pose_at(frame, stated_us * NS_PER_US) @ frame_from_box,
                    size_m=(length_m, width_m, height_m),
                    is_moving=False,
                    num_points=0,
                ),
            )


def _middles_ns(frames_us: Int64[np.ndarray, "frames 2"]) -> Int64[np.ndarray, " frames"]:
    return frames_us.sum(axis=1) * (NS_PER_US // 2)


def _returns(data: Component, frame: str) -> tuple[np.ndarray, np.ndarray, SweepPoints]:
    """What came back to a LiDAR in a frame, echo by echo.

    Returns:
        Places in the sensor's frame at their own times (float64, metres), these times in
        microseconds, and the points without both.
    """
    where = data.place(frame)
    times_us = data.array(f"{frame}/ray_bundle/timestamp_us", None)
    count = len(times_us)
    direction = data.array(f"{frame}/ray_bundle/direction", count, 3).astype(np.float64)
    distance_m = data.array(f"{frame}/ray_bundle_returns/distance_m", None, count)
    intensity = data.array(f"{frame}/ray_bundle_returns/intensity", *distance_m.shape)
    echo, ray = np.nonzero(np.isfinite(distance_m) & (distance_m > 0))
    length = np.linalg.norm(direction[ray], axis=1)
    if times_us.dtype.kind != "u" or not (np.abs(length - 1) < _UNIT).all():
        raise DataError(f"{where}: expected times, and directions of length 1")
    strength = intensity[echo, ray].astype(np.float32)
    if not np.isfinite(strength).all():
        raise DataError(f"{where}: an intensity is not finite where something came back")
    ring, number = np.full(count, -1), echo
    if data.has(f"{frame}/ray_bundle/model_element"):
        ring = data.array(f"{frame}/ray_bundle/model_element", count, 2)[:, 0]
    if data.has(f"{frame}/generic_data/ring"):
        ring = data.array(f"{frame}/generic_data/ring", count)
    if data.has(f"{frame}/generic_data/return_index"):
        number = data.array(f"{frame}/generic_data/return_index", count)[ray]
    points = SweepPoints.of(
        torch.zeros(len(ray), 3),
        intensity=torch.from_numpy(strength),
        ring=torch.from_numpy(ring[ray].astype(np.int16)),
        return_index=torch.from_numpy(number.astype(np.int8)),
    )
    return direction[ray] * distance_m[echo, ray][:, None], times_us[ray].astype(np.int64), points
