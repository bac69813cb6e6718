"""A car that a policy drives through a recorded street, seen by the cameras of a renderer.

The car is a kinematic bicycle: its rear axle goes where it points, and turns by the steering of
the front axle over the wheelbase; between two decisions steering and acceleration are held. It
stands on the ground by its four wheels. Actors move as recorded, whatever the car does. World
frame, z up, metres; the ego frame of the log is taken to stand on the rear axle.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.view_confidence import PROMISED
from lidarpainter_models.export.simulator_bundle import RIG_AHEAD_M, RIG_SIZE_M
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_rotation
from lidarpainter_models.lidar.collisions import (
    GROUND_CLEARANCE_M,
    MovingBody,
    clearances_m,
    find_collisions,
)
from lidarpainter_models.lidar.ground_surface import GroundSurface
from lidarpainter_models.lidar.surroundings import Surroundings
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses
from lidarpainter_models.serving.policies import (
    WHEELBASE_M,
    Observation,
    Policy,
    SeenActor,
    changed_lane,
)
from lidarpainter_models.serving.sensor_client import SeenFrame

STEP_S = 0.1
"""Between two decisions."""
MOST_STEERING_RAD, MOST_STEERING_RATE = 0.6, 0.8
"""Of the front wheels; radians, and radians a second."""
HARDEST_BRAKING_MPS2, MOST_ACCELERATION_MPS2 = 8.0, 4.0
TRACK_WIDTH_M = 1.6
"""Between the wheels of an axle."""
LANE_CHANGE_S, SHORTEST_CHANGE_M = 2.5, 8.0
"""A lane is changed over the way of this time, and not sharper."""
SPEED_OVER_S = 0.2
"""Over which an actor's speed is told from where it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CarState:
    """Where the rear axle is and how it moves."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    steering_rad: float = 0.0

    def after(self, acceleration_mps2: float, steering_rad: float, seconds: float) -> "CarState":
        """The state of a kinematic bicycle a moment later; limits of the car are kept."""
        acceleration = min(max(acceleration_mps2, -HARDEST_BRAKING_MPS2), MOST_ACCELERATION_MPS2)
        turn = MOST_STEERING_RATE * seconds
        wanted = min(max(steering_rad, -MOST_STEERING_RAD), MOST_STEERING_RAD)
        steering = min(max(wanted, self.steering_rad - turn), self.steering_rad + turn)
        if self.speed_mps + acceleration * seconds < 0:
            acceleration = -self.speed_mps / seconds  # it stops, and does not reverse
        way_m = self.speed_mps * seconds + acceleration * seconds**2 / 2
        turned = way_m * math.tan(steering) / WHEELBASE_M
        half = self.yaw_rad + turned / 2
        chord_m = way_m * np.sinc(turned / 2 / np.pi)  # of the arc
        return CarState(
            x_m=self.x_m + chord_m * math.cos(half),
            y_m=self.y_m + chord_m * math.sin(half),
            yaw_rad=self.yaw_rad + turned,
            speed_mps=self.speed_mps + acceleration * seconds,
            steering_rad=steering,
        )

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Directions ahead and to the left, as rows."""
        cosine, sine = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[cosine, sine], [-sine, cosine]])

    @property
    def wheels_m(self) -> Float[np.ndarray, "4 2"]:
        """World x and y of the wheels: rear right, rear left, front right, front left."""
        half = TRACK_WIDTH_M / 2
        places = [[0, -half], [0, half], [WHEELBASE_M, -half], [WHEELBASE_M, half]]
        return np.array(places) @ self.axes + [self.x_m, self.y_m]


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """One moment of a drive."""

    time_s: float
    timestamp_ns: int
    state: CarState
    acceleration_mps2: float
    frames: Mapping[str, SeenFrame]
    """What the cameras saw then, before the decision."""
    is_off_road: bool
    """Whether a wheel is beside all lanes of the map."""
    is_off_ground: bool
    """Whether a wheel is where the ground mesh has a hole or an end."""
    aside_m: float
    """From the recorded path."""


Sensors = Callable[
    [Float[Tensor, "4 4"], int, Mapping[str, Float[Tensor, "4 4"]]], dict[str, SeenFrame]
]
"""Pose of the rig in the world, microseconds, poses of actors: what the cameras see."""


def num_moments(seconds: float) -> int:
    """How many moments a drive has, its first and its last one included."""
    return round(seconds / STEP_S) + 1


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoop:
    """A street to drive in."""

    surroundings: Surroundings
    path: DrivenPath
    """Where the recording car drove."""
    moving: Sequence[ActorTrack]
    """Who is drawn by the renderer where a request puts them."""
    parked: Sequence[ActorTrack] = ()
    """Who stands, and is part of the street."""
    lane_change_m: float = 0.0
    """How far to the left of its line the policy is to drive."""

    def drive(
        self, policy: Policy, sensors: Sensors, *, start_ns: int, seconds: float
    ) -> Iterator[Moment]:
        """Let a policy drive, moment by moment, from where the recording car was at a time.

        Args:
            policy: who drives.
            sensors: what its cameras see.
            start_ns: when the drive begins.
            seconds: how long it lasts.
        """
        begin = self.path.driven_on(torch.tensor([start_ns])).world_from_body[0]
        state = self._begun(begin, start_ns)
        rig_from_ground = invert_rigid(self._ground_pose(state)) @ begin
        lines = self._lines(state)
        for number in range(num_moments(seconds)):
            time_ns = start_ns + round(number * STEP_S * 1e9)
            there, poses = self._actors(time_ns)
            placed = {
                track.actor_id: pose
                for track, pose in zip(there, poses, strict=True)
                if track.is_moving
            }
            world_from_rig = self._ground_pose(state) @ rig_from_ground
            frames = sensors(world_from_rig, time_ns // 1000, placed)
            seen = self._observation(state, number * STEP_S, time_ns, lines, frames)
            acceleration, steering = policy(seen)
            around, here = self.surroundings, np.array([[state.x_m, state.y_m]])
            yield Moment(
                time_s=number * STEP_S,
                timestamp_ns=time_ns,
                state=state,
                acceleration_mps2=acceleration,
                frames=frames,
                is_off_road=not bool(around.road.holds(state.wheels_m).all()),
                is_off_ground=bool(np.isnan(around.ground.at(state.wheels_m)).any()),
                aside_m=float(np.abs(around.road.line.coordinates(here)[0, 1])),
            )
            state = state.after(acceleration, steering, STEP_S)

    def judged(self, moments: Sequence[Moment]) -> dict[str, Any]:
        """What is to be said of a drive, as JSON types: the table of `drive`."""
        body = self._body(moments)
        tracks = [*self.moving, *self.parked]
        clearance_m = clearances_m(body, tracks)
        found: dict[str, Any] = {"nearest_actor_m": None, "nearest_actor": None}
        if bool(clearance_m.isfinite().any()):
            track, row = divmod(int(clearance_m.argmin()), len(moments))
            found["nearest_actor_m"] = float(clearance_m[track, row])
            found["nearest_actor"] = tracks[track].actor_id
            found["nearest_at_s"] = moments[row].time_s
        start_ns = moments[0].timestamp_ns
        hits = find_collisions(body, self.surroundings.street, tracks, start_ns=start_ns)
        said = [
            frame.confidence
            for moment in moments
            for frame in moment.frames.values()
            if frame.confidence is not None
        ]
        states = [moment.state for moment in moments]
        return {
            "seconds": moments[-1].time_s,
            "way_m": sum(
                math.dist((one.x_m, one.y_m), (two.x_m, two.y_m)) for one, two in pairwise(states)
            ),
            "off_road_s": STEP_S * sum(moment.is_off_road for moment in moments[1:]),
            "off_ground_s": STEP_S * sum(moment.is_off_ground for moment in moments[1:]),
            **found,
            "collisions": [asdict(hit) for hit in hits],
            "most_aside_m": max(moment.aside_m for moment in moments),
            "frames": sum(len(moment.frames) for moment in moments),
            "trusted_share": fmean(one >= PROMISED for one in said) if said else None,
            "least_confidence": min(said, default=None),
        }

    def _begun(self, world_from_rig: Float[Tensor, "4 4"], time_ns: int) -> CarState:
        """The state of the recording car at a time."""
        nearest = int((self.path.timestamps_ns - time_ns).abs().argmin())
        ahead = self.path.directions[nearest]
        x_m, y_m, _ = world_from_rig[:3, 3].tolist()
        yaw_rad = math.atan2(float(ahead[1]), float(ahead[0]))
        speed = float(self.path.speed_mps[nearest])
        return CarState(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, speed_mps=speed)

    @cached_property
    def _everywhere(self) -> GroundSurface:
        """The ground without holes: wheels stand somewhere, also where none was seen."""
        return self.surroundings.ground.everywhere()

    @cached_property
    def _tracks(self) -> TrackPoses:
        """Those of who moves, then of who stands."""
        return TrackPoses.of([*self.moving, *self.parked])

    def _ground_pose(self, state: CarState) -> Float[Tensor, "4 4"]:
        """The pose of the ground below the rear axle, by the heights under the wheels."""
        wheels = np.column_stack([state.wheels_m, self._everywhere.at(state.wheels_m)])
        rear, front = wheels[:2].mean(axis=0), wheels[2:].mean(axis=0)
        ahead = front - rear
        ahead /= np.linalg.norm(ahead)
        left = wheels[[1, 3]].mean(axis=0) - wheels[[0, 2]].mean(axis=0)
        up = np.cross(ahead, left)
        up /= np.linalg.norm(up)
        rotation = np.stack([ahead, np.cross(up, ahead), up], axis=1)
        return rigid_from_rotation(torch.from_numpy(rotation), torch.from_numpy(rear))

    def _lines(self, state: CarState) -> tuple[np.ndarray, np.ndarray]:
        """The middle of the lane and the recorded way, both with the change of lane in them."""
        road = self.surroundings.road
        lane = road.line.place(road.line.s_m, road.lane.middle_d_m)
        fastest = max(float(self.path.speed_mps.max()), state.speed_mps)
        over_m = max(SHORTEST_CHANGE_M, LANE_CHANGE_S * fastest)
        here = [state.x_m, state.y_m]
        return (
            changed_lane(lane, here, self.lane_change_m, over_m),
            changed_lane(road.line.xy_m, here, self.lane_change_m, over_m),
        )

    def _actors(self, time_ns: int) -> tuple[list[ActorTrack], Float[Tensor, "actors 4 4"]]:
        """Everybody who is there at a time, and where."""
        tracks = [*self.moving, *self.parked]
        there = self._tracks.present(time_ns)
        present = [
            track for track, is_there in zip(tracks, there.tolist(), strict=True) if is_there
        ]
        return present, self._tracks.all_at(time_ns)[there]

    def _observation(
        self,
        state: CarState,
        time_s: float,
        time_ns: int,
        lines: tuple[np.ndarray, np.ndarray],
        frames: Mapping[str, SeenFrame],
    ) -> Observation:
        """What the policy is told."""
        there, now = self._actors(time_ns)
        earlier_ns, is_there = time_ns - round(SPEED_OVER_S * 1e9), self._tracks.present(time_ns)
        before = self._tracks.all_at(earlier_ns)[is_there]
        nearest = int((self.path.timestamps_ns - time_ns).abs().argmin())
        speeds = ((now - before)[:, :3, 3] * now[:, :3, 0]).sum(dim=1) / SPEED_OVER_S
        actors = tuple(
            SeenActor(
                actor_id=track.actor_id,
                category=track.category,
                position_m=(float(pose[0, 3]), float(pose[1, 3])),
                yaw_rad=math.atan2(float(pose[1, 0]), float(pose[0, 0])),
                speed_mps=float(speed),
                length_m=float(track.size_m[0]),
                width_m=float(track.size_m[1]),
            )
            for track, pose, speed in zip(there, now, speeds, strict=True)
        )
        return Observation(
            time_s=time_s,
            position_m=(state.x_m, state.y_m),
            yaw_rad=state.yaw_rad,
            speed_mps=state.speed_mps,
            lane_m=lines[0],
            recorded_m=lines[1],
            recorded_speed_mps=float(self.path.speed_mps[nearest]),
            desired_speed_mps=float(self.path.speed_mps.max()),
            actors=actors,
            images={name: frame.rgb_u8 for name, frame in frames.items()},
            confidence={name: frame.confidence for name, frame in frames.items()},
        )

    def _body(self, moments: Sequence[Moment]) -> MovingBody:
        """The car's box without what is low enough to be road, at every moment."""
        poses = torch.stack([self._ground_pose(moment.state) for moment in moments])
        length_m, width_m, height_m = RIG_SIZE_M
        centre = torch.tensor([RIG_AHEAD_M, 0.0, (height_m + GROUND_CLEARANCE_M) / 2, 1.0])
        poses[:, :3, 3] = (poses @ centre.double())[:, :3]
        return MovingBody(
            world_from_box=poses,
            timestamps_ns=torch.tensor([moment.timestamp_ns for moment in moments]),
            size_m=torch.tensor([length_m, width_m, height_m - GROUND_CLEARANCE_M]),
        )
