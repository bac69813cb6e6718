"""LiDAR depth of one sweep as a camera saw it: sparse, occlusion-checked, actors in place.

Depth is camera z in metres, 0 where no point falls. The LiDAR stands higher than the camera and
sees over roofs and behind posts; a point with nearer returns above or beside its pixel is dropped.
Nearer returns below it hide nothing: that is how a road looks.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.actor_separation import ACTOR_MARGIN_M, near_actors
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lone_returns import confirmed_returns
from lidarpainter_models.scenes.records import RecordedView, Sweep
from lidarpainter_models.scenes.tracks import TrackPoses

MIN_DEPTH_M = 1.0  # nearer returns are the car itself or noise
MAX_DEPTH_M = 250.0  # beyond the reach of the sensors in use
OCCLUSION_WINDOW_PX = 5
"""Gaps between beams are a few pixels wide: look for nearer returns in the upper half of a
window of this width."""
OCCLUSION_MARGIN = 0.05  # a point further behind than this part of its depth is hidden
OCCLUSION_MARGIN_M = 0.3
"""... plus this much, so that walls seen at a grazing angle survive."""


def sparse_lidar_depth(
    points_world: Float[Tensor, "points 3"], camera: Camera
) -> Float[Tensor, "height width"]:
    """Nearest visible LiDAR depth of every pixel, 0 where there is none."""
    pixels_uv, depth_m = camera.project(points_world)
    inside = camera.contains(pixels_uv, depth_m, near_m=MIN_DEPTH_M)
    inside &= depth_m < MAX_DEPTH_M
    column, row = pixels_uv[inside].long().unbind(-1)
    nearest = torch.full((camera.height_px * camera.width_px,), torch.inf)
    nearest.scatter_reduce_(0, row * camera.width_px + column, depth_m[inside], reduce="amin")
    nearest = nearest.view(camera.height_px, camera.width_px)
    reach = OCCLUSION_WINDOW_PX // 2
    padded = torch.nn.functional.pad(-nearest[None], (reach, reach, reach, 0), value=-torch.inf)
    front = -torch.nn.functional.max_pool2d(padded, (reach + 1, 2 * reach + 1), 1)[0]
    is_visible = nearest <= front * (1 + OCCLUSION_MARGIN) + OCCLUSION_MARGIN_M
    return torch.where(is_visible & nearest.isfinite(), nearest, torch.zeros_like(nearest))


@dataclass(frozen=True, eq=False)
class _Swept:
    """A sweep in the world, and which of its points moving actors hold, and where."""

    xyz_m: Float[Tensor, "points 3"]
    rows: Int[Tensor, " held"]
    """Positions of what is held."""
    track: Int[Tensor, " held"]
    """Position among the moving actors."""
    xyz_box_m: Float[Tensor, "held 3"]
    """In the box as it stood when the point was measured."""


class FramePoints:
    """The LiDAR points of the frame asked for last, read once for all that its cameras ask.

    Without returns that nothing confirms (`lone_returns`).
    """

    def __init__(self, scene: DrivingScene) -> None:
        """Take the scene; nothing is read yet."""
        self._scene = scene
        self._moving = [track for track in scene.tracks if track.is_moving]
        self._poses = TrackPoses.of(self._moving)
        self._frame_index: int | None = None
        self._sweeps: list[_Swept] = []

    def measured(self, frame_index: int) -> Float[Tensor, "points 3"]:
        """The points in the world, where the LiDARs met them; none where none swept."""
        return torch.cat([torch.zeros(0, 3), *(swept.xyz_m for swept in self._of(frame_index))])

    def at_exposure(self, view: RecordedView) -> Float[Tensor, "points 3"]:
        """The points in the world, moving actors where they are in the view's image."""
        world_from_box = self._poses.all_at(view.timestamp_ns)
        moved = [_at(swept, world_from_box) for swept in self._of(view.frame_index)]
        return torch.cat([torch.zeros(0, 3), *moved])

    def _of(self, frame_index: int) -> list[_Swept]:
        if frame_index != self._frame_index:
            self._sweeps = [self._read(sweep) for sweep in self._scene.sweeps_of(frame_index)]
            self._frame_index = frame_index
        return self._sweeps

    def _read(self, sweep: Sweep) -> _Swept:
        xyz_m, measured_ns = confirmed_returns(self._scene, sweep)
        near = near_actors(xyz_m, measured_ns, self._moving)
        held = near.outside_m <= ACTOR_MARGIN_M
        return _Swept(xyz_m, near.rows[held], near.track[held], near.xyz_box_m[held])


def _at(swept: _Swept, world_from_box: Float[Tensor, "tracks 4 4"]) -> Float[Tensor, "points 3"]:
    """The points of a sweep, what actors hold where the actors are."""
    if not len(swept.rows):
        return swept.xyz_m
    pose = world_from_box.to(swept.xyz_m)[swept.track]
    placed = swept.xyz_m.clone()
    placed[swept.rows] = (pose[:, :3, :3] @ swept.xyz_box_m[..., None])[..., 0] + pose[:, :3, 3]
    return placed
