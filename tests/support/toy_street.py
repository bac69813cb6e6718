"""A street of three surfaces with exact sweeps and images: what LiDAR maps are tested on.

Grey ground, a wall across (red to the left, blue to the right), and a green car that crosses from
right to left at 10 m/s while each sweep takes a tenth of a second.
"""

from pathlib import Path

import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView, Sweep, SweepPoints
from lidarpainter_models.scenes.tracks import ActorTrack

GROUND, RED, BLUE, GREEN, SKY = (
    (100, 100, 100),
    (200, 60, 60),
    (60, 60, 200),
    (40, 170, 40),
    (215, 225, 250),
)
WALL_X_M, WALL_TOP_M = 20.0, 6.0
CAR_SIZE_M = torch.tensor([4.0, 1.8, 1.5])
CAR_X_M, CAR_SPEED_MPS = 10.0, 10.0
EYE = torch.tensor([0.0, 0.0, 1.7])
LOOK_FORWARD = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def car_y_m(time_s):
    return -4.0 + CAR_SPEED_MPS * time_s


def world_from_car(time_s):
    """Length along world y."""
    rotation = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    centre = torch.tensor([CAR_X_M, car_y_m(time_s), CAR_SIZE_M[2] / 2])
    return rigid_from_rotation(rotation, centre).double()


def cast_rays(origin, directions, time_s):
    """Distance along each direction (infinity: sky) and colour of what is hit first."""
    count = directions.shape[0]
    beyond = torch.full((count,), torch.inf)
    ground = torch.where(directions[:, 2] < 0, -origin[2] / directions[:, 2], beyond)
    wall = torch.where(directions[:, 0] > 0, (WALL_X_M - origin[0]) / directions[:, 0], beyond)
    wall_z = origin[2] + wall * directions[:, 2]
    wall = torch.where((wall_z > 0) & (wall_z < WALL_TOP_M), wall, beyond)
    centre = torch.stack(
        [torch.full_like(time_s, CAR_X_M), car_y_m(time_s), time_s * 0 + CAR_SIZE_M[2] / 2], -1
    )
    half = CAR_SIZE_M[[1, 0, 2]] / 2
    near, far = (centre - half - origin) / directions, (centre + half - origin) / directions
    enter, leave = torch.minimum(near, far).amax(-1), torch.maximum(near, far).amin(-1)
    car = torch.where((enter < leave) & (enter > 0), enter, beyond)
    wall_y = origin[1] + wall * directions[:, 1]
    distances = torch.stack([ground, wall, car, beyond], dim=-1)
    nearest = distances.min(dim=-1)
    colours = torch.tensor([GROUND, RED, GREEN, SKY], dtype=torch.uint8)[nearest.indices]
    colours[(nearest.indices == 1) & (wall_y < 0)] = torch.tensor(BLUE, dtype=torch.uint8)
    colours[nearest.values.isinf()] = torch.tensor(SKY, dtype=torch.uint8)
    return nearest.values, colours


class ToyStreet(DrivingScene):
    """A scene that computes what a stored one would read."""

    def __init__(self, num_frames=4, camera_gains=(("front", 1.0),)):
        self.path, self.dataset, self.sequence = Path("toy"), "toy", "street"
        self.camera_gains = dict(camera_gains)
        self.camera_names = tuple(self.camera_gains)
        times_s = [0.1 * frame for frame in range(num_frames)]
        self.frame_indices = tuple(range(num_frames))
        self.frame_timestamps_ns = torch.tensor([round(t * 1e9) for t in times_s])
        self.world_from_ego = torch.eye(4, dtype=torch.float64).expand(num_frames, 4, 4)
        self.tracks = (
            ActorTrack(
                actor_id="car",
                category="Car",
                is_moving=True,
                size_m=CAR_SIZE_M,
                frame_indices=torch.arange(num_frames),
                timestamps_ns=torch.tensor([round(t * 1e9) for t in times_s]),
                world_from_box=torch.stack([world_from_car(t) for t in times_s]),
                num_points=torch.full((num_frames,), 100),
            ),
        )
        pose = rigid_from_rotation(LOOK_FORWARD, EYE).double()
        camera = Camera(
            world_from_camera=pose,
            fx_px=160,
            fy_px=160,
            cx_px=120,
            cy_px=60,
            width_px=240,
            height_px=135,
        )
        self.views = tuple(
            RecordedView(
                frame_index=frame,
                camera_name=name,
                timestamp_ns=round(times_s[frame] * 1e9),
                camera=camera,
                index=0,
            )
            for frame in range(num_frames)
            for name in self.camera_names
        )
        self.sweeps = tuple(
            Sweep(
                frame_index=frame,
                lidar_name="top",
                timestamp_ns=round(times_s[frame] * 1e9),
                world_from_lidar=rigid_from_rotation(torch.eye(3), EYE).double(),
                offset=0,
                num_points=0,
            )
            for frame in range(num_frames)
        )

    def read_image(self, view):
        height, width = view.camera.height_px, view.camera.width_px
        directions = view.camera.pixel_directions().reshape(-1, 3) @ LOOK_FORWARD.T
        time_s = torch.full((height * width,), view.timestamp_ns * 1e-9)
        _, colours = cast_rays(EYE, directions, time_s)
        gain = self.camera_gains[view.camera_name]
        return (colours.float() * gain).round().to(torch.uint8).view(height, width, 3)

    def read_column(self, sweep, name):
        return getattr(self.read_sweep(sweep), name)

    def read_sweep(self, sweep):
        azimuth = torch.deg2rad(torch.arange(-36, 36, 0.3))
        elevation = torch.deg2rad(torch.arange(-20, 14, 0.5))
        a, e = (grid.flatten() for grid in torch.meshgrid(azimuth, elevation, indexing="ij"))
        directions = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], dim=-1)
        offset_s = (a / azimuth.abs().max()) * 0.05
        distance_m, _ = cast_rays(EYE, directions, sweep.timestamp_ns * 1e-9 + offset_s)
        hit = distance_m < 80
        count = int(hit.sum())
        return SweepPoints(
            xyz_m=EYE + distance_m[hit, None] * directions[hit],
            intensity=torch.zeros(count),
            time_offset_ns=(offset_s[hit] * 1e9).round().to(torch.int64),
            ring=torch.zeros(count, dtype=torch.int32),
            return_index=torch.zeros(count, dtype=torch.int32),
            lidar=torch.zeros(count, dtype=torch.int32),
        )
