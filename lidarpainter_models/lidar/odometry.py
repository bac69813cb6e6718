"""Where the car drove, from its LiDAR sweeps alone.

Each sweep is laid onto planes of those before it (point-to-plane ICP, Chen and Medioni, 1992, with
Geman and McClure's weights), beginning where the motion so far leads, and its points are moved as
the car moved while it turned (as KISS-ICP does, Vizzo et al., 2023). Where the drive comes back,
loops are closed; at last all sweeps are laid onto one another (`sweep_registration`).
World: the car's frame at its first swept frame, x forward, y left, z up; metres, float64.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.timed_poses import moved_meanwhile, poses_at
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.loop_closure import with_loops_closed
from lidarpainter_models.lidar.sweep_registration import (
    RANGES_M,
    Placed,
    SweptFrame,
    laid,
    planes_of,
    settled,
)
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road

Progress = Callable[[int, int], None]
"""Told frames done and frames in all."""
THIN_M = 0.2
"""One point per cell is kept of a turn."""
MOST_COMPARED = 3000
FIRST_SPEEDS_MPS = (0.0, 8.0, 16.0, 24.0, 32.0)
"""Tried for the first two sweeps, of which nothing tells yet how the car moves."""
LATEST, KEPT, KEPT_APART_M = 5, 20, 2.0
"""Frames of the map: the latest, and some that are farther back."""


def drive_of(scene: DrivingScene, progress: Progress = lambda _done, _total: None) -> DrivenPath:
    """`world_from_ego` at the time of every frame, found from the sweeps.

    What the scene says of poses is only used to take its points back to the car.

    Raises:
        SceneError: fewer than two frames have sweeps, or a sweep meets nothing it could lie on.
    """
    turns = _turns(scene)
    odometry, total = _Odometry(), len(turns) + 2
    for done, turn in enumerate(turns):
        odometry.add(turn)
        progress(done, total)
    path = with_loops_closed(odometry.path(), odometry.frames)
    progress(total - 1, total)
    path = _settled(turns, path)
    progress(total, total)
    times_ns = scene.frame_timestamps_ns
    poses = poses_at(path.world_from_body, path.timestamps_ns.numpy(), times_ns.numpy())
    return DrivenPath(timestamps_ns=times_ns, world_from_body=poses)


class Turn(NamedTuple):
    """The points of one frame as the car met them: each in the car's frame of its own time."""

    place: str
    time_ns: int
    xyz_m: Float32[np.ndarray, "points 3"]
    times_ns: Int64[np.ndarray, " points"]

    def at(self, path: DrivenPath) -> Float[np.ndarray, "points 3"]:
        """The points in the world of a path, each by the pose of its time."""
        known_ns = path.timestamps_ns.numpy()
        return moved_meanwhile(
            self.xyz_m,
            self.times_ns,
            lambda at_ns: poses_at(path.world_from_body, known_ns, at_ns),
            known_ns,
        )


def _turns(scene: DrivingScene) -> list[Turn]:
    frames = scene.swept_frames
    if len(frames) < 2:
        raise SceneError(
            f"{scene.path}: {len(frames)} frames with LiDAR sweeps, expected two at least: nothing "
            "else tells where the car drove"
        )
    recorded = driven_road(scene)
    known_ns = recorded.timestamps_ns.numpy()

    def back(at_ns: np.ndarray) -> Tensor:
        return invert_rigid(poses_at(recorded.world_from_body, known_ns, at_ns))

    found = []
    for frame_index in frames:
        sweeps = scene.sweeps_of(frame_index)
        world_m = scene.read_positions(frame_index).numpy()
        times_ns = torch.cat([scene.measured_ns(sweep) for sweep in sweeps]).numpy()
        xyz_m = moved_meanwhile(world_m, times_ns, back, known_ns).astype(np.float32)
        range_m = np.linalg.norm(xyz_m, axis=1)
        rows = np.flatnonzero((range_m > RANGES_M[0]) & (range_m < RANGES_M[1]))
        cells = np.floor(xyz_m[rows] / THIN_M).astype(np.int64) + (1 << 20)
        keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
        rows = rows[np.sort(np.unique(keys, return_index=True)[1])]
        time_ns = int(scene.frame_timestamps_ns[scene.frame_position(frame_index)])
        found.append(
            Turn(f"{scene.path}, frame {frame_index}", time_ns, xyz_m[rows], times_ns[rows])
        )
    return found


class _Odometry:
    """The poses and planes of the frames so far."""

    def __init__(self) -> None:
        self.frames: list[SweptFrame] = []
        self._times_ns: list[int] = []
        self._poses: list[Float[Tensor, "4 4"]] = []
        self._first: Turn | None = None

    def path(self) -> DrivenPath:
        """The way so far."""
        return DrivenPath(
            timestamps_ns=torch.tensor(self._times_ns), world_from_body=torch.stack(self._poses)
        )

    def add(self, turn: Turn) -> None:
        """Lay the next turn onto what is there."""
        if self._first is None:
            self._first = turn
            self._keep(turn, torch.eye(4, dtype=torch.float64), None)
        elif len(self._poses) == 1:
            self._begin(self._first, turn)
        else:
            last = self.path()
            times_ns = last.timestamps_ns.numpy()[-2:]
            guess = poses_at(last.world_from_body[-2:], times_ns, np.array([turn.time_ns]))[0]
            self._lay(turn, guess, rounds=2)

    def _begin(self, first: Turn, second: Turn) -> None:
        """The first two turns, by the speed under which they lie on each other best."""
        seconds = (second.time_ns - first.time_ns) * 1e-9
        best, most = torch.eye(4, dtype=torch.float64), -1.0
        for speed_mps in FIRST_SPEEDS_MPS:
            guess = torch.eye(4, dtype=torch.float64)
            guess[0, 3] = speed_mps * seconds
            pose, share = self._begun(first, second, guess)
            if share > most:
                best, most = pose, share
        self._begun(first, second, best)

    def _begun(
        self, first: Turn, second: Turn, guess: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "4 4"], float]:
        """Begin anew with a guess; the second pose, and the share of points that lie on planes."""
        self.frames, self._times_ns, self._poses = [], [], []
        start = torch.eye(4, dtype=torch.float64)
        ends = torch.tensor([first.time_ns, second.time_ns])
        both = DrivenPath(timestamps_ns=ends, world_from_body=torch.stack([start, guess]))
        self._keep(first, start, both)
        share = self._lay(second, guess, rounds=2)
        return self._poses[-1], share

    def _lay(self, turn: Turn, guess: Float[Tensor, "4 4"], *, rounds: int) -> float:
        """Find the pose of a turn from a guess; returns the share of points that lie on planes."""
        onto, pose, share = self._map(), guess, 0.0
        for _ in range(rounds):  # the motion tells where the points are, and they the motion
            points_m = turn.at(self._until(turn, pose))
            some_m = points_m[:: max(1, len(points_m) // MOST_COMPARED)]
            motion, share = laid(some_m, onto, pose[:3, 3].numpy())
            if motion is None:
                raise SceneError(
                    f"{turn.place}: its LiDAR points meet no plane of the frames before, expected "
                    "a street that stays in sight"
                )
            pose = torch.from_numpy(motion) @ pose
        self._keep(turn, pose, self._until(turn, pose))
        return share

    def _until(self, turn: Turn, pose: Float[Tensor, "4 4"]) -> DrivenPath:
        """The last step of the way to a pose at the time of a turn."""
        return DrivenPath(
            timestamps_ns=torch.tensor([self._times_ns[-1], turn.time_ns]),
            world_from_body=torch.stack([self._poses[-1], pose]),
        )

    def _keep(self, turn: Turn, pose: Float[Tensor, "4 4"], path: DrivenPath | None) -> None:
        self._times_ns.append(turn.time_ns)
        self._poses.append(pose)
        self.frames.append(swept_at(turn, path or self.path(), pose))

    def _map(self) -> Placed:
        """Planes of the last frames, and of some that the car has come by before."""
        chosen = list(range(max(0, len(self.frames) - LATEST), len(self.frames)))
        for number in range(chosen[0] - 1, -1, -1):
            away = self.frames[chosen[0]].centre_m - self.frames[number].centre_m
            if len(chosen) < LATEST + KEPT and np.linalg.norm(away) >= KEPT_APART_M:
                chosen.insert(0, number)
        return planes_of([self.frames[number] for number in chosen])


def swept_at(turn: Turn, path: DrivenPath, pose: Float[Tensor, "4 4"]) -> SweptFrame:
    """The planes of a turn in the world of a path."""
    return SweptFrame.of(turn.at(path), pose[:3, 3].numpy(), turn.time_ns)


def _settled(turns: Sequence[Turn], path: DrivenPath) -> DrivenPath:
    """All sweeps laid onto one another, moved to where the first is at the origin."""
    swept = [
        swept_at(turn, path, pose) for turn, pose in zip(turns, path.world_from_body, strict=True)
    ]
    poses = settled(swept).at_times(path.timestamps_ns) @ path.world_from_body
    return DrivenPath(
        timestamps_ns=path.timestamps_ns, world_from_body=invert_rigid(poses[0]) @ poses
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PathDifference:
    """How one path differs from another of the same times."""

    way_m: float
    """Of the latter."""
    translation_share: float
    """Mean error of the motion over stretches of ten metres (all of a shorter way), by their
    length."""
    turn_deg_per_10m: float
    """Mean turn between the two over such stretches."""


def path_difference(path: DrivenPath, other: DrivenPath) -> PathDifference | None:
    """Hold a path against another; None where that one goes less than a metre.

    Motion between two poses is compared, so where the worlds of the paths lie counts nothing.
    """
    travelled = other.travelled_m
    way_m = float(travelled[-1])
    if way_m < 1.0:
        return None
    stretch_m = min(10.0, 0.999 * way_m)
    shares, turns = [], []
    for start in range(len(travelled)):
        end = int(torch.searchsorted(travelled, travelled[start] + stretch_m))
        if end == len(travelled):
            break
        length_m = float(travelled[end] - travelled[start])
        moved, truly = (
            invert_rigid(one.world_from_body[start]) @ one.world_from_body[end]
            for one in (path, other)
        )
        off = invert_rigid(truly) @ moved
        shares.append(float(off[:3, 3].norm()) / length_m)
        turned = Rotation.from_matrix(off[:3, :3].numpy()).magnitude()
        turns.append(float(np.degrees(turned)) * 10.0 / length_m)
    return PathDifference(
        way_m=way_m,
        translation_share=float(np.mean(shares)),
        turn_deg_per_10m=float(np.mean(turns)),
    )
