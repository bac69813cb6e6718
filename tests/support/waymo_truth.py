"""A scene as Waymo's car could have recorded it, made from a synthetic street.

The truth is what the formats can express, so that a reader must give it back as it is:

- Points of TOP are those of the street: each has a pixel of its own (beam and firing) and the
  pose of the car at that moment. A second echo stands half a metre behind every fourth.
- Points of the other LiDARs are the street's points near the car, moved to the centre of the pixel
  they fall into, at most two a pixel; `num_lost` counts the others, which are in no truth.
- Boxes stand upright in the vehicle frame (the street's follow its slope by a degree or so).
- No point lies within a millimetre of a box's faces, where float32 could not tell its side.
- Every camera takes its image at its own moment, with the car's velocity carried that far, and
  through a distorted lens. The pixels of the images are the street's, which nobody looks at.
"""

from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch
from nuscenes_log import FAR_AWAY
from scipy.spatial.transform import Rotation

from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import (
    BoxRecord,
    Distortion,
    ImageRecord,
    RollingShutter,
    SweepPoints,
)
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter
from lidarpainter_models.synthetic import (
    RigCamera,
    RigLidar,
    SyntheticStreet,
    SyntheticStreetConfig,
)
from lidarpainter_models.synthetic.lidar_sensor import beam_inclinations_rad
from lidarpainter_models.synthetic.street import ego_from_camera

LENS_TERMS = (0.04, -0.03, 0.001, -0.0015, 0.002)
NEAR_M = 15.0
SECOND_ECHO_M = 0.5
CLEARANCE_M = 0.001
TURN_S = 0.1


@dataclass(frozen=True)
class CameraSetup:
    """Where a camera looks and when it takes its image."""

    yaw_deg: float
    exposure_ms: float
    """Middle of the exposure, after the frame's pose."""
    readout: Literal["down", "up", "left", "right"]
    position_m: tuple[float, float, float]


CAMERAS = {
    "FRONT": CameraSetup(0.0, -2.0, "right", (1.54, -0.02, 2.1)),
    "FRONT_LEFT": CameraSetup(45.0, -14.0, "left", (1.49, 0.09, 2.1)),
    "FRONT_RIGHT": CameraSetup(-45.0, 11.0, "right", (1.49, -0.09, 2.1)),
    "SIDE_LEFT": CameraSetup(90.0, -26.0, "down", (1.43, 0.11, 2.1)),
    "SIDE_RIGHT": CameraSetup(-90.0, 24.0, "up", (1.43, -0.11, 2.1)),
}
# yaw, pitch, roll in degrees and position on the vehicle
NEAR_LIDARS = {
    "FRONT": ((0.0, 1.2, 0.3), (4.07, 0.0, 0.69)),
    "SIDE_LEFT": ((89.0, -0.4, 1.3), (3.24, 1.02, 0.98)),
    "SIDE_RIGHT": ((-92.0, 0.3, -1.4), (3.24, -1.02, 0.98)),
    "REAR": ((-178.4, 1.6, 0.5), (-1.15, 0.0, 0.46)),
}
NEAR_LIMITS_RAD = (-np.pi / 2, np.pi / 6)
TOP_YAW_DEG = 148.0


@dataclass
class LidarSetup:
    """What is calibrated of a LiDAR, and the size of its image."""

    vehicle_from_lidar: np.ndarray
    beams_rad: np.ndarray | None
    """Rows from the top; None where they are uniform between `NEAR_LIMITS_RAD`."""
    num_rows: int
    num_columns: int


@dataclass
class WaymoTruth:
    """A canonical scene and what the formats hold beside it."""

    street: SyntheticStreet
    lidars: dict[str, LidarSetup]
    vehicle_from_camera: dict[str, torch.Tensor]
    reach_m: float
    scene: DrivingScene | None = None
    velocities: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Per frame: m/s in the global frame, rad/s in the vehicle's."""
    num_lost: int = 0
    """Points near the car that found both echoes of their pixel taken."""

    def global_from_ego(self, timestamp_ns):
        assert self.scene is not None
        return self.scene.global_from_world @ self.street.world_from_ego(timestamp_ns)


def street_config(**changes):
    """A small street with Waymo's cameras."""
    cameras = tuple(
        RigCamera(
            name=name,
            focal_per_width=1.0,
            yaw_rad=float(np.radians(setup.yaw_deg)),
            forward_m=setup.position_m[0],
            left_m=setup.position_m[1],
            up_m=setup.position_m[2],
        )
        for name, setup in CAMERAS.items()
    )
    settings = {
        "seed": 5,
        "num_frames": 3,
        "width_px": 96,
        "height_px": 64,
        "samples_per_axis": 1,
        "cameras": cameras,
        "lidar": RigLidar(name="TOP", beams=32, columns=450, up_m=2.18),
    }
    return SyntheticStreetConfig(**{**settings, **changes})


def write_truth(
    street, folder, *, near_lidars=tuple(NEAR_LIDARS), near_size=(24, 90), reach_m=1000.0
):
    """Drive through a street and store what Waymo's car would have seen.

    Args:
        street: what there is, and the cameras and the LiDAR that see it.
        folder: where the scene is stored.
        near_lidars: which of the other four LiDARs there are.
        near_size: rows and columns of their range images.
        reach_m: how far actors are labelled.
    """
    truth = WaymoTruth(
        street=street,
        lidars=_lidars(street.config, near_lidars, near_size),
        vehicle_from_camera={rig.name: ego_from_camera(rig) for rig in street.config.cameras},
        reach_m=reach_m,
    )
    header = SceneHeader(licence="drawn", global_from_world=FAR_AWAY)
    with SceneWriter(folder, "truth", "waymo", header) as writer:
        for frame_index in range(street.config.num_frames):
            _write_frame(truth, frame_index, writer)
    truth.scene = DrivingScene.open(writer.path)
    return truth


def write_tiny_truth(folder):
    """Two frames and two cameras, quick to write and to read."""
    config = street_config(num_frames=2, width_px=32, height_px=24)
    cameras = tuple(rig for rig in config.cameras if rig.name in ("FRONT", "SIDE_LEFT"))
    lidar = RigLidar(name="TOP", beams=32, columns=360, up_m=2.18)
    street = SyntheticStreet(replace(config, cameras=cameras, lidar=lidar))
    return write_truth(street, folder, near_lidars=("REAR",), near_size=(6, 20), reach_m=22.0)


def moved(pose, velocity, turn, seconds):
    """A pose a moment later."""
    later = pose.clone()
    spin = Rotation.from_rotvec(np.asarray(turn) * seconds).as_matrix()
    later[:3, :3] = pose[:3, :3] @ torch.from_numpy(spin)
    later[:3, 3] += torch.from_numpy(np.asarray(velocity) * seconds)
    return later


def top_column(time_offset_ns, num_columns):
    """Which firing of the turn a point of TOP belongs to."""
    share = np.asarray(time_offset_ns) / 1e9 / TURN_S + 0.5
    return np.rint(share * num_columns - 0.5).astype(int)


def _lidars(config, near_lidars, near_size):
    top = np.eye(4)
    top[:3, :3] = Rotation.from_euler("z", TOP_YAW_DEG, degrees=True).as_matrix()
    top[2, 3] = config.lidar.up_m
    beams_rad = beam_inclinations_rad(config.lidar.beams)
    lidars = {"TOP": LidarSetup(top, beams_rad, config.lidar.beams, config.lidar.columns)}
    for name in near_lidars:
        angles_deg, position_m = NEAR_LIDARS[name]
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZYX", angles_deg, degrees=True).as_matrix()
        pose[:3, 3] = position_m
        lidars[name] = LidarSetup(pose, None, *near_size)
    return lidars


def _write_frame(truth, frame_index, writer):
    street = truth.street
    timestamp_ns = street.timestamps_ns[frame_index]
    world_from_ego = street.world_from_ego(timestamp_ns)
    writer.add_frame(frame_index, timestamp_ns=timestamp_ns, world_from_ego=world_from_ego)
    step_ns = 1_000_000
    ahead = street.world_from_ego(timestamp_ns + step_ns)
    velocity = ((ahead - world_from_ego)[:3, 3] / (step_ns / 1e9)).numpy()
    between = (world_from_ego[:3, :3].T @ ahead[:3, :3]).numpy()
    turn = Rotation.from_matrix(between).as_rotvec() / (step_ns / 1e9)
    truth.velocities[frame_index] = FAR_AWAY[:3, :3].numpy() @ velocity, turn
    for rig in street.config.cameras:
        pose = moved(world_from_ego, velocity, turn, CAMERAS[rig.name].exposure_ms / 1e3)
        _write_image(truth, rig.name, timestamp_ns, pose, writer)
    boxes = _upright_boxes(street.actors(timestamp_ns), world_from_ego, truth.reach_m)
    points = _without(street.sweep(frame_index).points, boxes)
    parts = [_write_top(truth, timestamp_ns, points, boxes, writer)]
    parts += [
        _write_near(truth, name, timestamp_ns, points, boxes, writer)
        for name in truth.lidars
        if name != "TOP"
    ]
    _write_boxes(boxes, timestamp_ns, torch.cat(parts), writer)


def _write_image(truth, name, timestamp_ns, world_from_vehicle, writer):
    """The image is taken with the frame, but stored where the camera is at its exposure."""
    setup, street = CAMERAS[name], truth.street
    camera = street.camera(name, timestamp_ns)
    rgb = street.render(camera, timestamp_ns).rgb.numpy()
    bgr = np.round(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    stored = replace(
        camera,
        world_from_camera=world_from_vehicle @ truth.vehicle_from_camera[name],
        fx_px=camera.fx_px + 0.25,
        cx_px=camera.cx_px - 1.375,
        cy_px=camera.cy_px + 0.8125,
    )
    record = ImageRecord(
        camera_name=name,
        timestamp_ns=timestamp_ns + round(setup.exposure_ms * 1e6),
        camera=stored,
        distortion=Distortion("brown", LENS_TERMS),
        rolling_shutter=RollingShutter(duration_s=0.044, direction=setup.readout),
    )
    writer.add_image(record, cv2.imencode(".jpg", bgr)[1].tobytes())


def _without(points, boxes):
    """The points that are clearly inside or outside of each box."""
    is_clear = torch.ones(points.num_points, dtype=torch.bool)
    for actor, pose in boxes:
        size_m = torch.tensor(actor.size_m)
        inner, outer = (
            is_inside_box(points.xyz_m, pose, size_m, margin_m=margin_m)
            for margin_m in (-CLEARANCE_M, CLEARANCE_M)
        )
        is_clear &= inner == outer
    return SweepPoints(
        **{name: getattr(points, name)[is_clear] for name in SweepPoints.__dataclass_fields__}
    )


def _write_top(truth, timestamp_ns, points, boxes, writer):
    """The street's own points and, behind every fourth, a second echo."""
    setup = truth.lidars["TOP"]
    column = top_column(points.time_offset_ns.numpy(), setup.num_columns)
    origin = np.zeros((points.num_points, 3))
    for place in np.unique(column):
        offset_ns = ((place + 0.5) / setup.num_columns - 0.5) * TURN_S * 1e9
        pose = truth.street.world_from_ego(timestamp_ns + round(offset_ns)).numpy()
        origin[column == place] = (pose @ setup.vehicle_from_lidar)[:3, 3]
    ray = points.xyz_m.numpy() - origin
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    behind = points.xyz_m[::4].double() + SECOND_ECHO_M * torch.from_numpy(ray[::4])
    second = SweepPoints(
        **{
            name: getattr(points, name)[::4]
            for name in ("intensity", "time_offset_ns", "ring", "lidar")
        },
        xyz_m=behind.float(),
        return_index=torch.ones(len(behind), dtype=torch.int32),
    )
    both = SweepPoints.concatenate([points, _without(second, boxes)])
    world_from_lidar = truth.street.world_from_ego(timestamp_ns) @ torch.from_numpy(
        setup.vehicle_from_lidar
    )
    writer.add_sweep("TOP", both, timestamp_ns=timestamp_ns, world_from_lidar=world_from_lidar)
    return both.xyz_m


def _write_near(truth, name, timestamp_ns, points, boxes, writer):
    """Points near the car, on the centres of the pixels of a virtual range image."""
    setup = truth.lidars[name]
    world_from_lidar = truth.street.world_from_ego(timestamp_ns) @ torch.from_numpy(
        setup.vehicle_from_lidar
    )
    xyz_m = transform_points(invert_rigid(world_from_lidar), points.xyz_m.double()).numpy()
    range_m = np.linalg.norm(xyz_m, axis=1)
    inclination = np.arcsin(xyz_m[:, 2] / range_m)
    low, high = NEAR_LIMITS_RAD
    heading = np.arctan2(setup.vehicle_from_lidar[1, 0], setup.vehicle_from_lidar[0, 0])
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) + heading
    share = ((np.pi - azimuth) / (2 * np.pi)) % 1.0
    column = np.minimum((share * setup.num_columns).astype(int), setup.num_columns - 1)
    row = ((high - inclination) / (high - low) * setup.num_rows).astype(int)
    pixels = defaultdict(list)
    for index in np.flatnonzero((range_m < NEAR_M) & (range_m > 1.0) & (inclination < high)):
        pixels[row[index], column[index]].append(float(range_m[index]))
    kept = [
        (*pixel, echo, reach)
        for pixel, reaches in sorted(pixels.items())
        for echo, reach in enumerate(sorted(reaches)[:2])
    ]
    truth.num_lost += sum(max(len(reaches) - 2, 0) for reaches in pixels.values())
    row, column, echo = (np.array([entry[axis] for entry in kept]) for axis in range(3))
    reach = np.array([entry[3] for entry in kept], dtype=np.float32).astype(float)
    inclination = high - (row + 0.5) / setup.num_rows * (high - low)
    azimuth = np.pi - 2 * np.pi * (column + 0.5) / setup.num_columns - heading
    level = reach * np.cos(inclination)
    centres = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), reach * np.sin(inclination)], axis=1
    )
    found = SweepPoints(
        xyz_m=transform_points(world_from_lidar, torch.from_numpy(centres)).float(),
        intensity=torch.full((len(kept),), 0.5),
        time_offset_ns=torch.zeros(len(kept), dtype=torch.int64),
        ring=torch.from_numpy(row.astype(np.int32)),
        return_index=torch.from_numpy(echo.astype(np.int32)),
        lidar=torch.zeros(len(kept), dtype=torch.uint8),
    )
    found = _without(found, boxes)
    writer.add_sweep(name, found, timestamp_ns=timestamp_ns, world_from_lidar=world_from_lidar)
    return found.xyz_m


def _upright_boxes(actors, world_from_ego, reach_m):
    """The actors within reach with their poses, turned upright in the vehicle frame."""
    boxes = []
    for actor in actors:
        ego_from_box = invert_rigid(world_from_ego) @ actor.world_from_box
        if ego_from_box[:2, 3].norm() > reach_m:
            continue
        heading = float(torch.atan2(ego_from_box[1, 0], ego_from_box[0, 0]))
        upright = Rotation.from_euler("z", heading).as_matrix()
        ego_from_box[:3, :3] = torch.from_numpy(upright)
        boxes.append((actor, world_from_ego @ ego_from_box))
    return boxes


def _write_boxes(boxes, timestamp_ns, xyz_m, writer):
    for actor, pose in boxes:
        num_points = int(is_inside_box(xyz_m, pose, torch.tensor(actor.size_m)).sum())
        writer.add_box(
            BoxRecord(
                actor_id=actor.actor_id,
                category="pedestrian" if actor.category == "pedestrian" else "vehicle",
                timestamp_ns=timestamp_ns,
                world_from_box=pose,
                size_m=actor.size_m,
                is_moving=actor.is_moving,
                num_points=num_points,
            )
        )
