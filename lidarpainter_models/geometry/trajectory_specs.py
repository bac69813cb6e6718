"""Trajectories by name: what a user writes for where a camera, a car or an actor should go.

A trajectory is either steps off the recorded path, at every moment of it, or another path
altogether and steps off that; so it can be followed at any speed and for any length of log.
Parts are added with `+`: `lateral:2+up:1.5`, `follow:car-7+up:2`. The same words move a camera, the
whole rig (body: ego) and an actor (body: box).
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.shifts import MAX_SHIFT_M
from lidarpainter_models.geometry.trajectory_parts import (
    Moments,
    Offsets,
    PathOf,
    offsets_of,
    other_poses,
)
from lidarpainter_models.geometry.trajectory_words import (
    ConstantStep,
    PathWords,
    Step,
    read_trajectory_words,
)
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rigid_from_rotation,
    rotation_about_up,
)
from lidarpainter_models.geometry.waypoints import Waypoints, read_waypoints

CAMERA_FROM_EGO = torch.tensor(
    [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64
)
"""Of a camera that looks along x."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where a body goes in place of where it was."""

    spec: str
    """As the user wrote it."""
    steps: tuple[Step, ...]
    other: PathWords | None = None
    """The path that the steps lead off; None is the recorded one."""
    max_shift_m: float | None = MAX_SHIFT_M
    """How far the steps may lead off the recorded path; None sets no limit."""
    waypoints: Waypoints | None = None
    """What the file of the other path says."""

    @property
    def name(self) -> str:
        """The spec as a file name."""
        return re.sub(r"[^A-Za-z0-9.-]+", "_", self.spec.replace(":", "-"))

    @property
    def files(self) -> tuple[Path, ...]:
        """What was read beside the text."""
        return (Path(self.other.file),) if self.other and self.other.file else ()

    @property
    def is_recorded(self) -> bool:
        """Whether it leads nowhere else."""
        return self.other is None and not self.steps

    @property
    def up_m(self) -> float:
        """How far its steps lead up."""
        return sum((one.up_m for one in self.steps if isinstance(one, ConstantStep)), start=0.0)

    @property
    def tells_height(self) -> bool:
        """Whether it says how high the body is; other ways lead over the ground."""
        has_heights = self.waypoints is not None and self.waypoints.z_m is not None
        return has_heights or (self.other is not None and self.other.looks)

    def placed(
        self,
        bodies: Float[Tensor, "moments 4 4"],
        road: DrivenPath,
        moments: Moments,
        path_of: PathOf,
        *,
        is_camera: bool = False,
    ) -> Float[Tensor, "moments 4 4"]:
        """`world_from_body` at every moment.

        `road` is the ego's path for cameras and for itself, an actor's own for the actor; `path_of`
        looks actors up. A camera turns about itself, and looks where the path says.

        Raises:
            ConfigError: it leads too far out of the ends of the recorded path, or an actor is
                not known.
        """
        if self.other is not None:
            poses = other_poses(self.other, self.waypoints, moments, road, path_of)
            looks = is_camera and self.other.looks
            egos_from_bodies = invert_rigid(road.world_from_body[moments.rows]) @ bodies
            bodies = poses @ (invert_rigid(CAMERA_FROM_EGO) if looks else egos_from_bodies)
            if not self.other.looks:  # else the recorded road says what is left and ahead
                times_ns = road.timestamps_ns[moments.rows]
                road = DrivenPath(timestamps_ns=times_ns, world_from_body=poses)
                moments = moments._replace(rows=torch.arange(len(poses)))
        found = Offsets.none(len(bodies))
        for step in self.steps:
            found = found.plus(offsets_of(step, moments, road))
        directions = road.directions[moments.rows]
        if bool((found.along_m != 0).any()):
            self._check_ends(road, moments, found)
            carried = road.moved_along(moments.rows, found.along_m)
            bodies = carried @ bodies
            directions = (carried[:, :3, :3] @ directions[..., None])[..., 0]
        return _moved_aside(bodies, directions, found)

    def _check_ends(self, road: DrivenPath, moments: Moments, offsets: Offsets) -> None:
        if self.max_shift_m is None or self.other is not None:
            return
        if (beyond_m := road.beyond_m(moments.rows, offsets.along_m)) > self.max_shift_m:
            raise ConfigError(
                f"trajectory {self.spec!r} leads {beyond_m:.1f} m out of the ends of the recorded "
                f"path, expected at most {self.max_shift_m:g} m"
            )


def parse_trajectory(spec: str, *, max_shift_m: float | None = MAX_SHIFT_M) -> Trajectory:
    """Read `recorded`, steps such as `lateral:2+up:1.5`, or another path and steps off it.

    Lateral is to the left of the driving direction, along is ahead; a turn is counter-clockwise
    seen from above. `lane-change:3.5@2s+3s` begins after two seconds of the log and takes three,
    the heading following; without times it takes all that is followed, the heading kept. Steps may
    lead `max_shift_m` off the recorded path; other paths go anywhere.

    Raises:
        ConfigError: the text is no trajectory, or one that leads too far away.
    """
    steps, path = read_trajectory_words(spec, max_shift_m=max_shift_m)
    found = Trajectory(spec, steps, path, max_shift_m)
    return replace(found, waypoints=read_waypoints(found.files[0])) if found.files else found


def _moved_aside(
    bodies: Float[Tensor, "moments 4 4"], directions: Float[Tensor, "moments 3"], offsets: Offsets
) -> Float[Tensor, "moments 4 4"]:
    """Poses moved left and up relative to the road, and turned about up where they are."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=bodies.dtype)
    left = torch.linalg.cross(up.expand_as(directions), directions.to(bodies))
    if bool((left.norm(dim=1) < 1e-6).any()):
        raise ConfigError("the road direction is vertical: no lateral direction is defined")
    left = torch.nn.functional.normalize(left, dim=1)
    away = offsets.lateral_m[:, None] * left + offsets.up_m[:, None] * up
    return rigid_from_rotation(
        rotation_about_up(offsets.yaw_rad) @ bodies[:, :3, :3], bodies[:, :3, 3] + away
    )
