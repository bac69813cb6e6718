"""A run as the bundle that simulators load: one .usdz with scene, rig, tracks, meshes and map.

Names and forms are those that AlpaSim reads. Everything stands in the world of the scene (x
forward, y left, z up at the first frame; metres; times in microseconds), which is also the frame of
the served images: `world_to_nre` is the identity. The rig is the recording car's ego frame. A .usdz
is a zip that compresses nothing, whose members begin at multiples of 64 bytes, the layer first.
"""

import json
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.followed_paths import found_camera
from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.score_tables import TRUSTED, least_of
from lidarpainter_models.export.contents import SceneContents
from lidarpainter_models.export.meshes import joined, obstacle_mesh, ply_bytes
from lidarpainter_models.export.opendrive import opendrive
from lidarpainter_models.export.usd_files import MAX_PACKED_BYTES, write_usd
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.transforms import invert_rigid, quaternion_from_rotation
from lidarpainter_models.lidar.surroundings import Surroundings
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.scenes.records import RecordedView

LAYER = "scene.usdc"
ALIGNED_BYTES = 64
_PADDING = 0x1986
"""The kind of extra field by which USD pads a member's header."""
_HEADER_BYTES = 30 + 4
"""Before a member: its header without its name, and the head of the extra field."""
RIG_SIZE_M = (4.8, 1.95, 1.6)
"""Length, width and height of the car, which no log tells: those of a usual one."""
RIG_AHEAD_M = 1.4
"""From the rear axle, which the ego frame is taken to stand on, to the middle of the car."""
WORLD = "x forward, y left, z up at the first frame"


@dataclass(frozen=True, kw_only=True, eq=False)
class BundleContents:
    """A run and what surrounds its path."""

    run_id: str
    software: str
    fitted_on: date
    scene: GaussianScene
    log: DrivingScene
    """As it was recorded."""
    gaussians: SceneContents
    surroundings: Surroundings
    envelope: Mapping[str, Any] | None
    """How far the scene can be trusted (`evaluation/envelope.py`); None where nobody asked."""
    figures: Mapping[str, float]
    """What else the run is judged by."""

    @cached_property
    def recorded(self) -> DrivingScene:
        """The log where its sweeps say that it was."""
        return self.log.corrected(self.scene.cameras.path)

    @property
    def name(self) -> str:
        """Of the scene, as renderers list it."""
        return f"{self.recorded.dataset}/{self.recorded.sequence}"


def write_bundle(path: Path, contents: BundleContents) -> dict[str, int]:
    """Write a bundle.

    Args:
        path: where the file appears; the caller sees to it that it does so whole.
        contents: what is written.

    Returns:
        The size of every member in bytes.

    Raises:
        DataError: a member is larger than a .usdz can hold.
        MissingPackageError: the extra `export` is not installed.
        WriteError: the disk refuses.
    """
    import yaml

    around = contents.surroundings
    ground = around.ground.mesh()
    eye_m = np.append(around.road.line.xy_m[len(around.road.line.xy_m) // 2], 2.0)
    obstacles = obstacle_mesh(around.obstacle_points(), eye_m)
    said = f"{contents.name}: {WORLD}; metres"
    metadata = yaml.safe_dump(bundle_metadata(contents), sort_keys=False, allow_unicode=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        layer = Path(folder) / LAYER
        write_usd(layer, contents.gaussians)
        members: dict[str, bytes | Path] = {
            LAYER: layer,
            "metadata.yaml": metadata.encode(),
            "rig_trajectories.json": _json(rig_trajectories(contents)),
            "sequence_tracks.json": _json(sequence_tracks(contents)),
            "mesh.ply": ply_bytes(joined(ground, obstacles), said),
            "mesh_ground.ply": ply_bytes(ground, said),
            "map.xodr": opendrive(around.road, around.ground, contents.name, {"frame": WORLD}),
        }
        return write_usdz(path, members)


def write_usdz(path: Path, members: Mapping[str, bytes | Path]) -> dict[str, int]:
    """Write members, uncompressed and aligned as USD wants them, the first one the layer.

    Raises:
        DataError: a member is larger than a .usdz can hold.
    """
    sizes = {
        name: len(content) if isinstance(content, bytes) else content.stat().st_size
        for name, content in members.items()
    }
    if sum(sizes.values()) > MAX_PACKED_BYTES:
        raise DataError(f"{path}: larger than the 4 GiB of a .usdz, expected fewer Gaussians")
    with path.open("wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as packed:
        for name, content in members.items():
            entry = zipfile.ZipInfo(name)  # dated to 1980: the same run gives the same bytes
            entry.file_size = sizes[name]
            header = file.tell() + _HEADER_BYTES + len(name.encode())
            padding = -header % ALIGNED_BYTES
            entry.extra = struct.pack("<HH", _PADDING, padding) + bytes(padding)
            with packed.open(entry, "w") as target:
                if isinstance(content, bytes):
                    target.write(content)
                else:
                    with content.open("rb") as source:
                        shutil.copyfileobj(source, target, 1 << 20)
    return sizes


def bundle_metadata(contents: BundleContents) -> dict[str, Any]:
    """What `metadata.yaml` says; how far the scene is trusted is among `training_step_outputs`."""
    recorded, envelope = contents.recorded, contents.envelope
    outputs: dict[str, float] = {name: float(value) for name, value in contents.figures.items()}
    if envelope is not None:
        least = {f"envelope_{name}": value for name, value in least_of(envelope).items()}
        outputs |= {name: -1.0 if value is None else value for name, value in least.items()}
        outputs |= {f"envelope_{name}": envelope[name] for name in ("good_db", "promised")}
        for number, stretch in enumerate(envelope["stretches"]):
            place = f"envelope_{number:03d}"
            outputs |= {f"{place}_{name}": stretch[name] for name in ("from_m", "to_m")}
            outputs[f"{place}_confidence"] = stretch["recorded_confidence"]
            outputs |= {
                f"{place}_{name}": -1.0 if stretch[name] is None else stretch[name]
                for name in TRUSTED
            }
    first_us, last_us = _exposures_us(recorded)
    return {
        "scene_id": contents.name,
        "version_string": contents.software,
        "training_date": contents.fitted_on.isoformat(),
        "dataset_hash": recorded.content_digest,
        "uuid": str(uuid5(NAMESPACE_URL, f"lidarpainter:{contents.run_id}")),
        "is_resumable": False,
        "sensors": {
            "camera_ids": list(recorded.camera_names),
            "lidar_ids": list(recorded.lidar_names),
        },
        "logger": {"name": "lidarpainter", "run_id": contents.run_id, "run_url": None},
        "time_range": {"start": first_us * 1e-6, "end": last_us * 1e-6},
        "training_step_outputs": outputs,
    }


def rig_trajectories(contents: BundleContents) -> dict[str, Any]:
    """What `rig_trajectories.json` says: where the rig was, its cameras, and when they exposed."""
    recorded = contents.recorded
    first_us, last_us = _exposures_us(recorded)
    frames_ns = recorded.frame_timestamps_ns
    times_ns = torch.cat([frames_ns, torch.tensor([first_us, last_us]) * 1000]).unique()
    rig = driven_road(recorded).driven_on(times_ns)
    ids = {name: f"{name}@{contents.name}" for name in recorded.camera_names}
    path_m = driven_road(recorded).world_from_body[:, :3, 3].numpy()
    above_m = path_m[:, 2] - contents.surroundings.ground.everywhere().at(path_m[:, :2])
    calibrations = {
        ids[name]: _calibration(contents, name, number)
        for number, name in enumerate(recorded.camera_names)
    }
    trajectory = {
        "sequence_id": contents.name,
        "T_rig_world_timestamps_us": (times_ns // 1000).tolist(),
        "T_rig_worlds": rig.world_from_body.tolist(),
        "cameras_frame_timestamps_us": {
            ids[name]: [_exposure_us(view) for view in recorded.views_of(name)] for name in ids
        },
        "rig_bbox": {
            "centroid": [RIG_AHEAD_M, 0.0, RIG_SIZE_M[2] / 2 - float(np.median(above_m))],
            "dim": list(RIG_SIZE_M),
            "rot": [0.0, 0.0, 0.0],
        },
    }
    return {
        "world_to_nre": {"matrix": np.eye(4).tolist()},
        "camera_calibrations": calibrations,
        "rig_trajectories": [trajectory],
    }


def _calibration(contents: BundleContents, name: str, number: int) -> dict[str, Any]:
    """Lens and place of a camera on the rig; a recorded image is taken without distortion."""
    camera = contents.recorded.views_of(name)[0].camera
    return {
        "sequence_id": contents.name,
        "logical_sensor_name": name,
        "unique_sensor_idx": number,
        "T_sensor_rig": rig_from_camera(contents.scene, contents.log, name).tolist(),
        "camera_model": {
            "type": "opencv-pinhole",
            "parameters": {
                "resolution": [camera.width_px, camera.height_px],
                "shutter_type": camera.shutter_name,
                "principal_point": [camera.cx_px, camera.cy_px],
                "focal_length": [camera.fx_px, camera.fy_px],
                "radial_coeffs": [0.0] * 6,
                "tangential_coeffs": [0.0] * 2,
                "thin_prism_coeffs": [0.0] * 4,
            },
        },
    }


def rig_from_camera(
    scene: GaussianScene, log: DrivingScene, camera_name: str
) -> Float[Tensor, "4 4"]:
    """Where a camera sits on the car (float64): as in the image in the middle of the log.

    Args:
        scene: which refines the poses of cameras and of the car.
        log: as it was recorded.
        camera_name: a camera of the log.
    """
    views = log.views_of(camera_name)
    view = views[len(views) // 2]
    camera = found_camera(scene, log, view, view.camera)
    driven = driven_road(log.corrected(scene.cameras.path))
    rig = driven.driven_on(torch.tensor([view.timestamp_ns])).world_from_body[0]
    return invert_rigid(rig) @ camera.world_from_camera.double()


def _exposure_us(view: RecordedView) -> list[int]:
    """When an image begins to be read and when it is over; an instant takes a microsecond."""
    readout_s = sum(map(abs, view.camera.shutter.across_s)) if view.camera.shutter else 0.0
    start_us = round(view.timestamp_ns * 1e-3 - readout_s * 5e5)
    return [start_us, start_us + max(1, round(readout_s * 1e6))]


def _exposures_us(recorded: DrivingScene) -> tuple[int, int]:
    """From the first exposure to the end of the last one."""
    spans = [_exposure_us(view) for view in recorded.views]
    return min(start for start, _ in spans), max(end for _, end in spans)


def sequence_tracks(contents: BundleContents) -> dict[str, Any]:
    """What `sequence_tracks.json` says: who may be moved, and who stands as part of the street."""
    moving, poses = contents.gaussians, contents.gaussians.world_from_actor
    rows = [
        (actor.actor_id, actor.category, "CONTROLLABLE", actor.size_m, times_ns, placed)
        for actor, times_ns, placed in (
            (actor, moving.timestamps_ns[there], poses[there, column])
            for column, actor in enumerate(moving.actors)
            for there in [moving.is_present[:, column]]
        )
        if len(times_ns)
    ]
    rows += [
        (one.actor_id, one.category, "NONE", one.size_m, one.timestamps_ns, one.world_from_box)
        for one in contents.recorded.tracks
        if not one.is_moving
    ]
    ids, categories, flags, sizes_m, times, placed = zip(*rows, strict=True) if rows else ((),) * 6
    tracks = {
        "tracks_id": list(ids),
        "tracks_label_class": list(categories),
        "tracks_flags": list(flags),
        "tracks_timestamps_us": [(times_ns // 1000).tolist() for times_ns in times],
        "tracks_poses": [_poses_xyz_xyzw(world_from_box).tolist() for world_from_box in placed],
    }
    dims = {"cuboids_dims": [size_m.tolist() for size_m in sizes_m]}
    return {contents.name: {"tracks_data": tracks, "cuboidtracks_data": dims}}


def _poses_xyz_xyzw(world_from_box: Float[Tensor, "times 4 4"]) -> Float[Tensor, "times 7"]:
    """Place and rotation, the scalar last."""
    rotation_wxyz = quaternion_from_rotation(world_from_box[:, :3, :3].double())
    return torch.cat([world_from_box[:, :3, 3].double(), rotation_wxyz.roll(-1, 1)], dim=1)


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
