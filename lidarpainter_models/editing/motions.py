"""Other ways for an actor: along a trajectory, later, slower, to a stop. World: z up; metres."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_parts import Moments, PathOf, headed
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.lidar.ground_heights import GroundHeights
from lidarpainter_models.scenes.actor_names import path_of_track
from lidarpainter_models.scenes.tracks import ActorTrack, does_move

MOST_STEP_M = 1.5
"""Ground that is so much higher or lower than the path is a roof or a hole: it is not followed."""
AFTER_NS = 1_000_000_000
"""So long before and after the log, edits hold too: cameras expose before its first frame."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LogTimes:
    """The clock of a log, and its ego's way."""

    ego: DrivenPath

    @property
    def start_ns(self) -> int:
        """When it begins."""
        return int(self.ego.timestamps_ns[0])

    @property
    def end_ns(self) -> int:
        """When it ends."""
        return int(self.ego.timestamps_ns[-1])

    @property
    def seconds(self) -> float:
        """How long it is."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def around_ns(self) -> tuple[int, int]:
        """Before and after whatever was recorded."""
        return self.start_ns - AFTER_NS, self.end_ns + AFTER_NS

    def time_ns(self, seconds: float, what: str) -> int:
        """A time of the log.

        Raises:
            ConfigError: it lies behind the end.
        """
        if not 0 <= seconds <= self.seconds:
            raise ConfigError(
                f"{what} {seconds:g} s: expected a time of the log, 0 to {self.seconds:.1f} s"
            )
        return self.start_ns + round(seconds * 1e9)


def rerouted(
    track: ActorTrack, trajectory: Trajectory, log: LogTimes, ground: GroundHeights, path_of: PathOf
) -> ActorTrack:
    """An actor on another way, as high over the ground as it was."""
    road = path_of_track(track)
    count = len(road)
    moments = Moments(
        rows=torch.arange(count),
        seconds=(track.timestamps_ns - log.start_ns).double() * 1e-9,
        progress=torch.arange(count).double() / max(count - 1, 1),
        log_s=log.seconds,
    )
    poses = trajectory.placed(road.world_from_body, road, moments, path_of)
    moved = replace(track, world_from_box=poses)
    if trajectory.tells_height:
        return moved
    return on_ground(moved, road.world_from_body, ground, up_m=trajectory.up_m)


def on_ground(
    track: ActorTrack,
    before: Float[Tensor, "times 4 4"],
    ground: GroundHeights,
    *,
    up_m: float = 0.0,
) -> ActorTrack:
    """A moved track, as high over the ground as it was before, and `up_m` more.

    Its own rise stays where the ground is unknown or no road.
    """
    poses = track.world_from_box.clone()
    there, here = (ground.around(pose[:, :2, 3].float()) for pose in (poses, before))
    own_rise_m = poses[:, 2, 3] - before[:, 2, 3] - up_m
    step_m = (there - here).double() - own_rise_m
    poses[:, 2, 3] += torch.where(step_m.abs() <= MOST_STEP_M, step_m, 0.0)  # NaN fails too
    return replace(track, world_from_box=poses)


def beside_ego(
    log: LogTimes,
    ground: GroundHeights,
    *,
    ahead_m: float,
    left_m: float,
    yaw_rad: float,
    speed_mps: float | None,
    size_m: Float[Tensor, "3"],
) -> tuple[Int[Tensor, " times"], Float[Tensor, "times 4 4"]]:
    """Times and poses of a body that drives along the ego's path, tyres on the ground."""
    ego = log.ego
    rows = torch.arange(len(ego))
    ahead = torch.full((len(ego),), ahead_m, dtype=torch.float64)
    if speed_mps is not None:
        seconds = (ego.timestamps_ns - log.start_ns).double() * 1e-9
        ahead = ahead + speed_mps * seconds - ego.travelled_m
    carried = ego.moved_along(rows, ahead)
    directions = (carried[:, :3, :3] @ ego.directions[..., None])[..., 0]
    left = torch.stack([-directions[:, 1], directions[:, 0], torch.zeros(len(ego))], dim=1)
    centres = (carried @ ego.world_from_body)[:, :3, 3] + left_m * left
    ground_m = ground.around(centres[:, :2].float()).double()
    centres[:, 2] = torch.where(ground_m.isnan(), centres[:, 2], ground_m) + float(size_m[2]) / 2
    heading = torch.atan2(directions[:, 1], directions[:, 0]) + yaw_rad
    return ego.timestamps_ns, headed(centres, heading)


def retimed(track: ActorTrack, log: LogTimes, *, delay_s: float, speed: float) -> ActorTrack:
    """The same way, begun later than it was first seen, faster or slower; who stands stays.

    Raises:
        ConfigError: nothing of it is left within the log.
    """
    if not does_move(track.world_from_box[:, :3, 3]):
        return track
    first_ns = max(int(track.timestamps_ns[0]), log.start_ns)
    since_ns = (track.timestamps_ns - first_ns).double()
    times_ns = first_ns + (since_ns / speed).round().long() + round(delay_s * 1e9)
    if int(times_ns[-1]) < log.start_ns or int(times_ns[0]) > log.end_ns:
        from_s, to_s = ((int(times_ns[row]) - log.start_ns) * 1e-9 for row in (0, -1))
        raise ConfigError(
            f"{track.actor_id!r} would be there from {from_s:.1f} to {to_s:.1f} s, "
            f"expected some of the log's 0 to {log.seconds:.1f} s"
        )
    return replace(track, timestamps_ns=times_ns)


def stopped(track: ActorTrack, at_ns: int, log: LogTimes, *, over_s: float) -> ActorTrack:
    """The same way up to a time, then evenly braked.

    Who stands before it is last seen stays there as long as the log goes on.
    """
    since_s = (track.timestamps_ns - at_ns).double() * 1e-9
    braking = since_s.clamp(0, over_s)
    way = braking - braking**2 / (2 * over_s) if over_s > 0 else torch.zeros_like(since_s)
    wanted_ns = at_ns + (torch.where(since_s <= 0, since_s, way) * 1e9).round().long()
    braked = replace(track, world_from_box=path_of_track(track).at(wanted_ns).world_from_body)
    last_ns, stays_ns = int(track.timestamps_ns[-1]), log.around_ns[1]
    if at_ns + round(over_s * 1e9) > last_ns or last_ns >= stays_ns:
        return braked
    times_ns = torch.cat([braked.timestamps_ns, torch.tensor([stays_ns])])
    poses = torch.cat([braked.world_from_box, braked.world_from_box[-1:]])
    frames = torch.cat([braked.frame_indices, braked.frame_indices[-1:]])
    return replace(with_poses(braked, times_ns, poses), frame_indices=frames)


def standing(track: ActorTrack, at_ns: int, log: LogTimes) -> ActorTrack:
    """An actor that stands where it is at a time, as long as the log goes on."""
    pose = track.pose_at(at_ns)
    times_ns = torch.tensor(log.around_ns)
    return with_poses(track, times_ns, pose.double().expand(2, 4, 4).clone())


def continued(track: ActorTrack, log: LogTimes, ground: GroundHeights) -> ActorTrack:
    """Who is there from the first frame to the last is so before and after, driving on."""
    before_ns, after_ns = (torch.tensor([one]) for one in log.around_ns)
    times_ns, way = torch.cat([before_ns, track.timestamps_ns, after_ns]), path_of_track(track)
    longer = with_poses(track, times_ns, way.driven_on(times_ns).world_from_body)
    return on_ground(longer, way.at(times_ns).world_from_body, ground)


def within(track: ActorTrack, log: LogTimes) -> ActorTrack:
    """The same way, as far as the log goes."""
    times_ns = track.timestamps_ns.clamp(log.start_ns, log.end_ns).unique()
    return with_poses(track, times_ns, path_of_track(track).at(times_ns).world_from_body)


def with_poses(
    track: ActorTrack, times_ns: Int[Tensor, " times"], world_from_box: Float[Tensor, "times 4 4"]
) -> ActorTrack:
    """An actor at other places, where no LiDAR saw it."""
    return replace(
        track,
        frame_indices=torch.zeros_like(times_ns),
        timestamps_ns=times_ns,
        world_from_box=world_from_box,
        num_points=torch.zeros_like(times_ns),
    )
