"""A recorded scene as NVIDIA's NCore V4, written by NVIDIA's own library (extra `ncore`).

The rig is the ego, the world that of the scene. A sensor has one place on the rig, the mean of
those that it is recorded at; beside each image stands the pose as recorded (`world_from_camera`).
Rays are those of the sensor at their own times, motion put back in. Of a LiDAR that is called as a
preset of `lidar.sensors` the frame is the sensor's own, upright, and its model and the row and
column of every ray are told.
"""

import json
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarpainter_models.errors import MissingPackageError, SceneError
from lidarpainter_models.export.ncore_lidar import (
    first_azimuth_deg,
    model_elements,
    model_parameters,
)
from lidarpainter_models.geometry.transforms import invert_rigid, turn_rad
from lidarpainter_models.lidar.firings import mounted_lidar
from lidarpainter_models.lidar.sensors import preset_of
from lidarpainter_models.readers.ncore.lenses import SHUTTERS
from lidarpainter_models.readers.ncore.sequence import NS_PER_US, RIG, WORLD
from lidarpainter_models.readers.source_logs.drive_poses import poses_at
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import ImageRecord, RollingShutter, Sweep
from lidarpainter_models.scenes.tracks import ActorTrack

MOST_OF_A_BYTE = 255.0
"""The largest intensity of a LiDAR that states it in a byte; NCore's go from 0 to 1."""
_NAMES = {direction: name for name, direction in SHUTTERS.items()}
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


def write_ncore(
    folder: Path, scene: DrivingScene, frames: Collection[int], advanced: Callable[[int, int], None]
) -> dict[str, Any]:
    """Write frames of a scene as the sequence `<dataset>_<sequence>`, a store for each sensor.

    `advanced` is told how many images and sweeps of how many are written.

    Returns:
        How much was written, and how far poses of cameras are from the one that is told.

    Raises:
        MissingPackageError: the extra `ncore` is not installed.
        SceneError: NCore has no place for something in it.
    """
    try:
        files = _NcoreFiles(folder, scene, frames, advanced)
    except ImportError:
        hint = "NCore needs nvidia-ncore: pip install 'lidarpainter[ncore]'"
        raise MissingPackageError(hint) from None
    try:
        return files.write()
    except AssertionError as error:  # how the library refuses
        raise SceneError(f"{files.place}: NCore has no place for it: {error}") from None


class _NcoreFiles:
    """The stores of one sequence, being written."""

    def __init__(
        self,
        folder: Path,
        scene: DrivingScene,
        frames: Collection[int],
        advanced: Callable[[int, int], None],
    ) -> None:
        import ncore.data as types
        from ncore.data import v4
        from ncore.impl.common.transformations import HalfClosedInterval
        from upath import UPath

        self.place, self._scene, self._advanced, self._done = scene.path.name, scene, advanced, 0
        self._types, self._v4 = types, v4
        self._views = [view for view in scene.views if view.frame_index in frames]
        self._sweeps = [sweep for sweep in scene.sweeps if sweep.frame_index in frames]
        self._boxes = [
            (track, row)
            for track in scene.tracks
            for row, frame in enumerate(track.frame_indices.tolist())
            if frame in frames
        ]
        first_us, last_us = self._span_us()
        ego_ns = scene.frame_timestamps_ns.numpy()
        known_us = _microseconds(ego_ns)
        inside_us = known_us[(known_us > first_us) & (known_us < last_us)]
        self._knots_ns = np.array([first_us, *inside_us, last_us]) * NS_PER_US
        self._world_from_rig = poses_at(scene.world_from_ego, ego_ns, self._knots_ns)
        name = f"{scene.dataset}_{scene.sequence}"
        self._list = folder / f"{name}.json"
        self._writer = v4.SequenceComponentGroupsWriter(
            output_dir_path=UPath(folder),
            store_base_name=name,
            sequence_id=name,
            sequence_timestamp_interval_us=HalfClosedInterval(first_us, last_us + 1),
            generic_meta_data={
                "licence": scene.manifest["licence"],
                "source": f"{scene.dataset}/{scene.sequence}",
                "source_digest": scene.content_digest,
            },
        )
        self._poses = self._component(v4.PosesComponent.Writer)
        self._intrinsics = self._component(v4.IntrinsicsComponent.Writer)
        self._masks = self._component(v4.MasksComponent.Writer)
        self._sensor_from_rig: dict[str, Tensor] = {}
        self._ends_us: dict[int, tuple[str, int]] = {}
        """By frame: a LiDAR, and when its sweep ends."""

    def write(self) -> dict[str, Any]:
        """Write everything, and say how much it is."""
        times_us = (self._knots_ns // NS_PER_US).astype(np.uint64)
        self._poses.store_dynamic_pose(RIG, WORLD, self._world_from_rig.numpy(), times_us)
        global_from_world = self._scene.global_from_world.numpy()
        self._poses.store_static_pose(WORLD, f"{WORLD}_global", global_from_world)
        apart = [self._write_camera(name) for name in self._scene.camera_names]
        for name in self._scene.lidar_names:
            self._write_lidar(name)
        cuboids = self._component(self._v4.CuboidsComponent.Writer)
        cuboids.store_observations([self._observation(track, row) for track, row in self._boxes])
        stores = self._writer.finalize()
        told = self._v4.SequenceComponentGroupsReader(stores).get_sequence_meta().to_dict()
        self._list.write_text(json.dumps(told, indent=2), "utf-8")
        return {
            "num_images": len(self._views),
            "num_sweeps": len(self._sweeps),
            "num_points": sum(sweep.num_points for sweep in self._sweeps),
            "num_boxes": len(self._boxes),
            "camera_apart_m": max(metres for metres, _ in apart),
            "camera_apart_deg": max(degrees for _, degrees in apart),
        }

    def _component(self, kind: Any, name: str | None = None, **told: Any) -> Any:  # noqa: ANN401
        """The writer of a component; a sensor, which has a name, has a store of its own."""
        return self._writer.register_component_writer(kind, name or "default", name, told)

    def _span_us(self) -> tuple[int, int]:
        """First and last time of anything that is written; they differ."""
        times_us = [time for view in self._views for time in self._read_us(view.index)]
        for sweep in self._sweeps:
            measured_us = _microseconds(self._scene.measured_ns(sweep).numpy())
            times_us += [int(measured_us.min()), int(measured_us.max())]
        times_us += [int(_microseconds(track.timestamps_ns[row])) for track, row in self._boxes]
        if not times_us or min(times_us) < 0:
            told = f"begins at {min(times_us)} us" if times_us else "nothing is left to export"
            raise SceneError(f"{self.place}: {told}, expected images or sweeps at times from 0 up")
        return min(times_us), max(*times_us, min(times_us) + 1)

    def _read_us(self, index: int) -> tuple[int, int]:
        """When the first and the last row of an image are read."""
        record = self._scene.image_record(self._scene.views[index])
        shutter = record.rolling_shutter or RollingShutter(duration_s=0.0, direction="down")
        first_s = shutter.middle_s - shutter.duration_s / 2
        first_us = int(_microseconds(record.timestamp_ns + round(first_s * 1e9)))
        return first_us, first_us + round(shutter.duration_s * 1e6)

    def _rig_at(self, times_ns: Int64[np.ndarray, " times"]) -> Float[Tensor, "times 4 4"]:
        """`world_from_rig` at some times, as whoever reads the file finds it."""
        return poses_at(self._world_from_rig, self._knots_ns, times_ns)

    def _mount(
        self, name: str, times_ns: list[int], world_from_sensor: Float[Tensor, "times 4 4"]
    ) -> tuple[float, float]:
        """State where a sensor sits; tells how far off it is recorded, in metres and degrees."""
        placed = invert_rigid(self._rig_at(np.array(times_ns))) @ world_from_sensor
        mean = placed.mean(dim=0)
        left, _, right = torch.linalg.svd(mean[:3, :3])
        mean[:3, :3] = left @ right
        self._poses.store_static_pose(name, RIG, mean.numpy())
        self._sensor_from_rig[name] = invert_rigid(mean)
        apart_m = (placed[:, :3, 3] - mean[:3, 3]).norm(dim=1).max()
        apart_rad = turn_rad(mean.expand_as(placed), placed).max()
        return float(apart_m), float(torch.rad2deg(apart_rad))

    def _write_camera(self, name: str) -> tuple[float, float]:
        views = [view for view in self._views if view.camera_name == name]
        records = [self._scene.image_record(view) for view in views]
        if not records:
            return 0.0, 0.0
        self._intrinsics.store_camera_intrinsics(name, self._camera_model(records))
        self._masks.store_camera_masks(name, {})
        poses = torch.stack([record.camera.world_from_camera for record in records]).double()
        apart = self._mount(name, [record.timestamp_ns for record in records], poses)
        writer = self._component(self._v4.CameraSensorComponent.Writer, name)
        for view, pose in zip(views, poses, strict=True):
            writer.store_frame(
                image_binary_data=self._scene.read_jpeg(view),
                image_format="jpeg",
                frame_timestamps_us=np.array(self._read_us(view.index), dtype=np.uint64),
                generic_data={"world_from_camera": pose.numpy()},
                generic_meta_data={"source_frame": view.frame_index},
            )
            self._tell()
        return apart

    def _camera_model(self, records: list[ImageRecord]) -> Any:  # noqa: ANN401
        """The lens of a camera's images in NCore's words."""
        record, camera = records[0], records[0].camera
        where, model = f"{self.place}: camera {record.camera_name}", record.distortion.model
        if len({(one.distortion, *(getattr(one.camera, n) for n in _LENS)) for one in records}) > 1:
            raise SceneError(f"{where} changes its lens, expected one: NCore knows one of each")
        shutter = record.rolling_shutter.direction if record.rolling_shutter else None
        lens: dict[str, Any] = {
            "resolution": np.array([camera.width_px, camera.height_px], dtype=np.uint64),
            "shutter_type": self._types.ShutterType[_NAMES[shutter]],
            "external_distortion_parameters": None,
            "principal_point": _float32(camera.cx_px, camera.cy_px),
            "focal_length": _float32(camera.fx_px, camera.fy_px),
        }
        terms = record.distortion.terms
        if model == "fisheye":
            fisheye = self._types.OpenCVFisheyeCameraModelParameters
            names = ("resolution", "focal_length", "principal_point", "radial_coeffs")
            lens["radial_coeffs"] = _float32(*terms)
            return fisheye(**lens, max_angle=fisheye.compute_max_angle(*(lens[n] for n in names)))
        if model == "mei":
            raise SceneError(f"{where} has a lens of model mei, expected none, brown or fisheye")
        k1, k2, p1, p2, *more = (*terms, *(0.0,) * (8 - len(terms)))
        return self._types.OpenCVPinholeCameraModelParameters(
            **lens,
            radial_coeffs=_float32(k1, k2, *more),
            tangential_coeffs=_float32(p1, p2),
            thin_prism_coeffs=_float32(0, 0, 0, 0),
        )

    def _write_lidar(self, name: str) -> None:
        sweeps = [sweep for sweep in self._sweeps if sweep.lidar_name == name]
        if not sweeps:
            return
        sensor, first_deg = preset_of(name), 0.0
        poses = torch.stack([sweep.world_from_lidar for sweep in sweeps]).double()
        if sensor is not None:
            poses = poses @ mounted_lidar(self._scene, name).lidar_from_sensor
        self._mount(name, [sweep.timestamp_ns for sweep in sweeps], poses)
        if sensor is not None:
            direction, _, times_us = self._rays(sweeps[0])
            first_deg = first_azimuth_deg(sensor, direction, times_us)
            model = self._types.RowOffsetStructuredSpinningLidarModelParameters
            told = model(**model_parameters(sensor, first_deg))
            self._intrinsics.store_lidar_intrinsics(name, told)
        most = max(float(self._scene.read_column(sweep, "intensity").max()) for sweep in sweeps)
        scale = 1.0 if most <= 1.0 else max(most, MOST_OF_A_BYTE)
        kind = self._v4.LidarSensorComponent.Writer
        writer = self._component(kind, name, intensity_is_divided_by=scale)
        for sweep in sweeps:
            direction, distance_m, times_us = self._rays(sweep)
            points = self._scene.read_sweep(sweep)
            columns = {"ring": points.ring.numpy(), "return_index": points.return_index.numpy()}
            writer.store_frame(
                direction=direction,
                timestamp_us=times_us,
                model_element=sensor and model_elements(sensor, direction, first_deg),
                distance_m=distance_m[None],
                intensity=(points.intensity.numpy() / np.float32(scale)).clip(0, 1)[None],
                frame_timestamps_us=np.array([times_us.min(), times_us.max()]),
                generic_data={key: one for key, one in columns.items() if one.max() > 0},
                generic_meta_data={"source_frame": sweep.frame_index},
            )
            self._ends_us.setdefault(sweep.frame_index, (name, int(times_us.max())))
            self._tell()

    def _rays(self, sweep: Sweep) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions in the sensor's frame at their own times, distances in metres, and times."""
        times_us = _microseconds(self._scene.measured_ns(sweep).numpy())
        different_us, place = np.unique(times_us, return_inverse=True)
        rig_from_world = invert_rigid(self._rig_at(different_us * NS_PER_US))
        moved = (self._sensor_from_rig[sweep.lidar_name] @ rig_from_world).numpy()[place]
        xyz_m = self._scene.read_column(sweep, "xyz_m").double().numpy()
        xyz_m = np.einsum("nij,nj->ni", moved[:, :3, :3], xyz_m) + moved[:, :3, 3]
        distance_m = np.maximum(np.linalg.norm(xyz_m, axis=1), 1e-6)
        xyz_m[distance_m == 1e-6] = (1e-6, 0.0, 0.0)  # a ray has a direction
        direction = (xyz_m / distance_m[:, None]).astype(np.float32)
        return direction, distance_m.astype(np.float32), times_us.astype(np.uint64)

    def _observation(self, track: ActorTrack, row: int) -> Any:  # noqa: ANN401
        """A box, in the frame of a LiDAR at the end of its sweep; without one in the world."""
        time_us, pose = int(_microseconds(track.timestamps_ns[row])), track.world_from_box[row]
        frame, stated_us = self._ends_us.get(int(track.frame_indices[row]), (WORLD, time_us))
        if frame != WORLD:
            rig_from_world = invert_rigid(self._rig_at(np.array([stated_us * NS_PER_US]))[0])
            pose = self._sensor_from_rig[frame] @ rig_from_world @ pose.double()
        turn_xyz_rad = Rotation.from_matrix(pose[:3, :3].numpy()).as_euler("xyz")
        return self._types.CuboidTrackObservation(
            track_id=track.actor_id,
            class_id=track.category,
            timestamp_us=time_us,
            reference_frame_id=frame,
            reference_frame_timestamp_us=stated_us,
            bbox3=self._types.BBox3(
                centroid=tuple(pose[:3, 3].tolist()),
                dim=tuple(track.size_m.tolist()),
                rot=tuple(turn_xyz_rad.tolist()),
            ),
            source=self._types.LabelSource.EXTERNAL,
        )

    def _tell(self) -> None:
        self._done += 1
        self._advanced(self._done, len(self._views) + len(self._sweeps))


def _float32(*values: float) -> Float32[np.ndarray, " values"]:
    return np.array(values, dtype=np.float32)


def _microseconds(times_ns: Any) -> Any:  # noqa: ANN401 - one time or an array of them
    return (times_ns + NS_PER_US // 2) // NS_PER_US
