"""Simulated sweeps, from the LiDAR of a log or any other, where it went or where nobody drove."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from lidarpainter_models.conditioning.moved_cameras import MovedCameras
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.export.formats import SWEEP_ENDINGS
from lidarpainter_models.export.lidar_files import (
    write_npz,
    write_parquet,
    write_pcd,
    write_pcd_bin,
)
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.returns.channel import LidarChannel
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.lidar.firings import MountedLidar
from lidarpainter_models.lidar.sensors import LidarSensor
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep, SweepPoints


@dataclass(frozen=True, kw_only=True)
class SweepRequest:
    """Which sweeps are wanted."""

    trajectory: Trajectory
    """Where the car goes; the sensor rides on it where it was mounted."""
    sensor: LidarSensor | None = None
    """Another sensor in its place, which stands upright; None is the log's own."""
    lidar_name: str | None = None
    """The log's LiDAR in whose place it is; None is the first."""
    frames: slice | None = None
    file_format: str = "pcd"
    """One of `SWEEP_ENDINGS`."""
    seed: int | None = 0
    """Draws noise and what is lost; None takes what is likelier."""

    def __post_init__(self) -> None:
        """Refuse a format that nobody writes."""
        if self.file_format not in SWEEP_ENDINGS:
            raise ConfigError(
                f"format {self.file_format!r} of sweeps, expected {', '.join(SWEEP_ENDINGS)}"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class WrittenSweep:
    """A sweep as it is written."""

    sweep: Sweep
    points: SweepPoints
    actor_ids: tuple[str, ...]
    """Whom each point has met; empty where it met the street."""


def simulated_sweeps(
    request: SweepRequest,
    log: DrivingScene,
    scene: GaussianScene,
    channel: LidarChannel,
    lidar: MountedLidar,
) -> Iterator[WrittenSweep]:
    """What a LiDAR would measure, at the times of the log's own sweeps.

    Args:
        request: which sweeps, by which sensor, from where.
        log: with its poses as the fit found them.
        scene: the fit, or a change of it.
        channel: what was learnt of the log's LiDAR.
        lidar: the log's own sensor.

    Raises:
        SceneError: no sweep is left.
        ConfigError: the trajectory leads too far.
    """
    own = [sweep for sweep in log.sweeps if sweep.lidar_name == lidar.name]
    wanted = set(log.frame_indices[request.frames or slice(None)])
    if not any(sweep.frame_index in wanted for sweep in own):
        raise SceneError(f"{log.path.name}: no sweep of {lidar.name!r} is left to simulate")
    moving = MovedCameras(
        recorded=log, tracks=scene.tracks, trajectory=request.trajectory, as_rig=True
    )
    path = DrivenPath(
        timestamps_ns=lidar.path.timestamps_ns,
        world_from_body=moving.moved_poses(own, lidar.path.world_from_body),
    )
    rider = replace(lidar, path=path)
    if request.sensor is not None:
        upright = torch.eye(4, dtype=torch.float64)
        rider = replace(rider, sensor=request.sensor, lidar_from_sensor=upright)
    names = ("", *(track.actor_id for track in scene.actors.recorded_tracks))
    for sweep, pose in zip(own, path.world_from_body, strict=True):
        if sweep.frame_index in wanted:
            moved = replace(sweep, world_from_lidar=pose)
            yield _simulated(request, moved, rider, scene, channel, names)


def _simulated(
    request: SweepRequest,
    sweep: Sweep,
    lidar: MountedLidar,
    scene: GaussianScene,
    channel: LidarChannel,
    names: Sequence[str],
) -> WrittenSweep:
    rays = lidar.rays(sweep.timestamp_ns)
    seed = None if request.seed is None else request.seed + sweep.frame_index
    met = channel.simulated(scene, rays, seed=seed)
    within = (met.range_m >= lidar.sensor.min_range_m) & (met.range_m <= lidar.sensor.max_range_m)
    back = (met.is_returned & within).nonzero()[:, 0]
    xyz_m = rays.origin_m[back] + met.range_m[back, None].double() * rays.direction[back]
    points = SweepPoints.of(
        xyz_m.float(),
        intensity=met.intensity[back],
        time_offset_ns=(rays.time_ns[back] - sweep.timestamp_ns).int(),
        ring=rays.beam[back].short(),
    )
    body = met.body[back].clamp(min=0).tolist()
    return WrittenSweep(
        sweep=replace(sweep, num_points=len(back)),
        points=points,
        actor_ids=tuple(names[row] for row in body),
    )


def write_sweep(path: Path, written: WrittenSweep, file_format: str) -> None:
    """Write one simulated sweep.

    Raises:
        WriteError: the disk refuses.
    """
    if file_format in ("npz", "parquet"):
        write = write_npz if file_format == "npz" else write_parquet
        write(path, written.sweep, written.points, written.actor_ids)
        return
    plain: Callable[[Path, Sweep, SweepPoints], None]
    plain = write_pcd if file_format == "pcd" else write_pcd_bin
    plain(path, written.sweep, written.points)
