"""Checks of the sweeps of a scene: ground, origins of LiDARs, clear air, what cameras see of them.

World: z up; lengths are metres.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.checks.sweep_agreement import NEIGHBOURHOOD_M, points_near, sweep_offset_m
from lidarpainter_models.checks.verdicts import Verdict, sampled_positions
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.lone_returns import WEATHER_REACH_M, is_confirmed, stands_alone
from lidarpainter_models.scenes.records import RecordedView

_NUM_SECTORS = 120
"""Of three degrees: some firings fall into each of them, whatever the LiDAR."""
_FEW = 0.001
"""Of the points of a sweep: a single stray one does not widen what is covered."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LidarReach:
    """What one sweep covered, seen from its LiDAR."""

    lidar_from_world: Float[Tensor, "4 4"]
    is_covered: Bool[np.ndarray, " sectors"]
    """By azimuth; a covered sector lies between two that hold points, too."""
    lowest_rad: float
    """Elevation of the lowest beam."""
    range_m: float

    @classmethod
    def of(
        cls, xyz_m: Float[Tensor, "points 3"], world_from_lidar: Float[Tensor, "4 4"]
    ) -> "LidarReach":
        """The reach of a sweep of at least one point in the world."""
        lidar_from_world = invert_rigid(world_from_lidar)
        away_m = transform_points(lidar_from_world.to(xyz_m), xyz_m).numpy()
        holds = np.zeros(_NUM_SECTORS, dtype=bool)
        holds[_sector(away_m)] = True
        range_m = np.linalg.norm(away_m, axis=1)
        elevation_rad = np.arcsin(np.clip(away_m[:, 2] / np.maximum(range_m, 1e-6), -1, 1))
        return cls(
            lidar_from_world=lidar_from_world,
            is_covered=holds & np.roll(holds, 1) & np.roll(holds, -1),
            lowest_rad=float(np.quantile(elevation_rad, _FEW)),
            range_m=float(np.quantile(range_m, 1 - _FEW)),
        )

    def covers(self, direction_world: Float[Tensor, "3"]) -> bool:
        """Whether a direction lies in the sector that was covered, at whatever elevation."""
        direction = self.lidar_from_world[:3, :3] @ direction_world
        return bool(self.is_covered[_sector(direction[None].numpy())[0]])

    def could_hit(self, world_from_box: Float[Tensor, "4 4"], size_m: Float[Tensor, "3"]) -> bool:
        """Whether the middle of a box lies in what was covered, its upper end at least."""
        centre_m = transform_points(self.lidar_from_world, world_from_box[None, :3, 3]).numpy()
        if np.linalg.norm(centre_m) > self.range_m or not self.is_covered[_sector(centre_m)[0]]:
            return False
        level_m = float(np.hypot(centre_m[0, 0], centre_m[0, 1]))
        top_m = float(centre_m[0, 2]) + float(size_m[2]) / 2
        return math.atan2(top_m, level_m) >= self.lowest_rad


def reaches_of(scene: DrivingScene, frame_index: int) -> list[LidarReach]:
    """What each sweep of a frame covered."""
    return [
        LidarReach.of(scene.read_column(sweep, "xyz_m"), sweep.world_from_lidar)
        for sweep in scene.sweeps_of(frame_index)
    ]


def could_any_hit(
    reaches: list[LidarReach], world_from_box: Float[Tensor, "4 4"], size_m: Float[Tensor, "3"]
) -> bool:
    """Whether one of a frame's sweeps could have hit a box."""
    return any(reach.could_hit(world_from_box, size_m) for reach in reaches)


def _sector(away_m: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """Which sector of azimuth each point lies in."""
    share = (np.arctan2(away_m[:, 1], away_m[:, 0]) + np.pi) / (2 * np.pi)
    return np.minimum((share * _NUM_SECTORS).astype(int), _NUM_SECTORS - 1)


MIN_COVERAGE = 0.15
MOST_TILTED = 0.7
"""Sine of the elevation beyond which no camera of a car looks."""
MAX_SWEEP_OFFSET_M = 0.15
"""By which a sweep must be moved onto the next."""
MAX_GROUND_SLOPE_RAD = 0.15
MIN_ORIGIN_HEIGHT_M = 0.4
"""Over the road: no LiDAR is mounted lower, but cars' own origins lie there."""
MOST_LEFT_OUT = 0.025
"""Of the returns from where drops return; in dry air 0.023 where a LiDAR fires once a degree."""
NEAREST_M = 3.0
"""Nearer returns may be of the car itself."""
NUM_FRAMES = 8
_WRONG_ORIGIN = "world_from_lidar must be where the LiDAR is, not the car's own origin"
_AROUND_ORIGIN_M, _LEAST_AROUND = 4.0, 100
_RAISED_M = (1.0, 1.7, 2.4)
"""From so much higher returns are looked at that stand alone as seen from a LiDAR's origin."""
_LEAST_OF_RAIN = 0.4
"""Drops stand alone from everywhere, in the least so large a part of them."""
_COVERAGE_CELLS = (9, 16)
_GROUND_CELL_M = 2.0
_GROUND_THICKNESS_M = 0.3
_NUM_GROUND_TRIES = 1000
_POINT_STRIDE = 3
"""Every third point tells as well which cells of an image are covered."""


def check_ground(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether up is up: the lowest points around the car form a level plane below it."""
    position = scene.world_from_ego[0, :3, 3]
    xyz_m = scene.read_positions(scene.sweeps[0].frame_index).double() - position
    near = xyz_m[(xyz_m[:, :2].norm(dim=1) < NEIGHBOURHOOD_M) & (xyz_m[:, 2].abs() < 4)].numpy()
    if len(near) < 100:
        return "warn", f"only {len(near)} points within {NEIGHBOURHOOD_M:.0f} m of the car"
    slope_rad, height_m = _ground_plane(_lowest_in_cells(near))
    detail = f"{height_m:+.2f} m from the ego origin, slope {np.degrees(slope_rad):.1f} degrees"
    if slope_rad > MAX_GROUND_SLOPE_RAD:
        return "fail", f"{detail}: is z up?"
    return "ok", detail


def check_origins(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether each LiDAR's origin is where a LiDAR can be: over the road."""
    said, low = [], []
    for name in scene.lidar_names:
        sweep = next(sweep for sweep in scene.sweeps if sweep.lidar_name == name)
        origin_m = sweep.world_from_lidar[:3, 3]
        around_m = points_near(scene.read_positions(sweep.frame_index), origin_m) - origin_m.numpy()
        around_m = around_m[np.abs(around_m[:, 2]) < _AROUND_ORIGIN_M]
        if len(around_m) < _LEAST_AROUND:
            said.append(f"{name} cannot be told (few points near it)")
            continue
        height_m = -_ground_plane(_lowest_in_cells(around_m))[1]
        said.append(f"{name} {height_m:.2f} m")
        if height_m < MIN_ORIGIN_HEIGHT_M:
            low.append(name)
    detail = f"over the road: {', '.join(said)}"
    if low:
        return "warn", f"{detail}; {', '.join(low)}: {_WRONG_ORIGIN}"
    return "ok", detail


def check_sweeps_agree(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether consecutive sweeps lie on each other in the world: poses and motion compensation."""
    frames = scene.swept_frames
    if len(frames) < 2:
        return "warn", "a single sweep: nothing to compare"
    offsets_m = []
    for position in sampled_positions(len(frames) - 1):
        first, second = frames[position : position + 2]
        offset_m = sweep_offset_m(_points_near_ego(scene, first), _points_near_ego(scene, second))
        if offset_m is not None:
            offsets_m.append(offset_m)
    if not offsets_m:
        return "warn", f"no surface within {NEIGHBOURHOOD_M:.0f} m of the car is in two sweeps"
    detail = f"surfaces of two sweeps near the car lie up to {max(offsets_m):.3f} m apart"
    return ("ok" if max(offsets_m) <= MAX_SWEEP_OFFSET_M else "fail"), detail


def check_clear_air(scene: DrivingScene) -> tuple[Verdict, str]:
    """Whether a fit keeps the returns, or leaves out many that stand alone."""
    step = len(scene.frame_indices) // NUM_FRAMES | 1  # odd, as every other frame may be unlike
    num_near = num_lone = num_left_out = 0
    num_raised = np.zeros(len(_RAISED_M), int)
    for frame_index in scene.frame_indices[::step]:
        for sweep in scene.sweeps_of(frame_index):
            xyz_m = scene.read_column(sweep, "xyz_m")
            offset_m = xyz_m - sweep.world_from_lidar[:3, 3].to(xyz_m)
            range_m = offset_m.norm(dim=1)
            is_near = (range_m >= NEAREST_M) & (range_m <= WEATHER_REACH_M)
            is_left_out = is_near & ~is_confirmed(offset_m)
            num_near += int(is_near.sum())
            num_lone += int((is_near & stands_alone(offset_m)).sum())
            num_left_out += int(is_left_out.sum())
            if is_left_out.any():
                for place, raised_m in enumerate(_RAISED_M):
                    from_above_m = offset_m - torch.tensor([0.0, 0.0, raised_m])
                    num_raised[place] += int((is_near & stands_alone(from_above_m)).sum())
    reach = f"of the returns {NEAREST_M:g} to {WEATHER_REACH_M:g} m away"
    found = f"{num_lone / max(num_near, 1):.1%} {reach} stand alone"
    if num_left_out > MOST_LEFT_OUT * num_near:
        best = int(num_raised.argmin())
        if num_raised[best] < _LEAST_OF_RAIN * num_lone:
            return "warn", (
                f"{found} and are left out, seen from {_RAISED_M[best]:g} m higher "
                f"{num_raised[best] / num_near:.1%} would: {_WRONG_ORIGIN}"
            )
        return "warn", f"{found}, as of rain, snow or spray: they are left out"
    return "ok", f"{found}: they are left out where they are many" if num_left_out else found


def check_coverage(scene: DrivingScene) -> tuple[Verdict, str]:
    """How much of each camera's image the LiDAR reaches, in cells of a 16 x 9 grid."""
    covered: dict[str, list[float]] = {name: [] for name in scene.camera_names}
    frames = scene.swept_frames
    for frame in (frames[position] for position in sampled_positions(len(frames))):
        xyz_m = scene.read_positions(frame)[::_POINT_STRIDE]
        for view in scene.views:
            if view.frame_index == frame:
                covered[view.camera_name].append(_covered_share(view, xyz_m))
    shares = {name: float(np.mean(found or [0.0])) for name, found in covered.items()}
    detail = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
    unseeing = [name for name, share in shares.items() if share == 0]
    if any(_looks_where_a_lidar_does(scene, name) for name in unseeing):
        return "fail", f"{detail}: a camera sees no point"
    if unseeing:
        return "warn", f"{detail}: {', '.join(unseeing)} looks where no LiDAR does"
    return ("ok" if min(shares.values()) >= MIN_COVERAGE else "warn"), detail


def _looks_where_a_lidar_does(scene: DrivingScene, camera_name: str) -> bool:
    """Whether points are due in a camera's images: it looks up, down, or into a LiDAR's sector."""
    view = scene.views_of(camera_name)[0]
    axis = view.camera.world_from_camera[:3, 2]
    if abs(float(axis[2])) > MOST_TILTED:
        return True
    return any(reach.covers(axis) for reach in reaches_of(scene, view.frame_index))


def _covered_share(view: RecordedView, xyz_m: Float[Tensor, "points 3"]) -> float:
    """Share of the cells of an image that a point falls into."""
    camera, (num_rows, num_columns) = view.camera, _COVERAGE_CELLS
    pixels_uv, depth_m = camera.project(xyz_m)
    seen = pixels_uv[camera.contains(pixels_uv, depth_m)]
    rows = (seen[:, 1] / camera.height_px * num_rows).long()
    columns = (seen[:, 0] / camera.width_px * num_columns).long()
    return len(torch.unique(rows * num_columns + columns)) / (num_rows * num_columns)


def _points_near_ego(scene: DrivingScene, frame_index: int) -> np.ndarray:
    centre_m = scene.world_from_ego[scene.frame_position(frame_index), :3, 3]
    return points_near(scene.read_positions(frame_index), centre_m)


def _lowest_in_cells(points_m: np.ndarray) -> np.ndarray:
    """The lowest point over every square cell of the ground."""
    cells = np.floor(points_m[:, :2] / _GROUND_CELL_M).astype(int)
    order = np.lexsort((points_m[:, 2], cells[:, 1], cells[:, 0]))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return points_m[order[first]]


def _ground_plane(points_m: np.ndarray) -> tuple[float, float]:
    """Slope (rad) of the plane that most points lie on, and its height below the origin (m)."""
    import open3d

    open3d.utility.random.seed(0)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_m))
    plane, _ = cloud.segment_plane(_GROUND_THICKNESS_M, 3, _NUM_GROUND_TRIES)
    slope_rad = np.arctan2(np.hypot(plane[0], plane[1]), abs(plane[2]))
    return float(slope_rad), float(-plane[3] / np.copysign(max(abs(plane[2]), 1e-9), plane[2]))
