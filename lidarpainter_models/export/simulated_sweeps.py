"""Simulated sweeps, from the LiDAR of a log or any other, where it went or where nobody drove."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from lidarpainter_models.conditioning.moved_cameras import MovedCameras
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.export.formats import SWEEP_FORMATS
from lidarpainter_models.export.lidar_files import WrittenSweep
from lidarpainter_models.gaussians.lidar_returns.channel import LidarChannel, Returns
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
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
    """One of `SWEEP_FORMATS`."""
    seed: int | None = 0
    """Draws noise and what is lost; None takes what is likelier."""

    def __post_init__(self) -> None:
        """Refuse a format that nobody writes."""
        if self.file_format not in SWEEP_FORMATS:
            raise ConfigError(
                f"format {self.file_format!r} of sweeps, expected {', '.join(SWEEP_FORMATS)}"
            )


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
    nearest_m, farthest_m = lidar.sensor.min_range_m, lidar.sensor.max_range_m
    found = met.returns(lidar.sensor.returns)
    within = (found.range_m >= nearest_m) & (found.range_m <= farthest_m)
    found = Returns(*(column[within] for column in found))
    points = SweepPoints.of(
        found.xyz_m(rays).float(),
        intensity=met.intensity[found.ray],
        time_offset_ns=(rays.time_ns[found.ray] - sweep.timestamp_ns).int(),
        ring=rays.beam[found.ray].short(),
        return_index=found.number.to(torch.int8),
    )
    return WrittenSweep(
        sweep=replace(sweep, lidar_name=lidar.sensor.name, num_points=points.num_points),
        points=points,
        actor_ids=tuple(names[row] for row in found.body.clamp(min=0).tolist()),
    )
