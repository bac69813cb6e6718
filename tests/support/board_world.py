"""A tiny exact world: textured boards that face the road, with sky behind them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from gaussian_world import (
    LOOK_FORWARD,
    cameras_of,
    car_track,
    map_points,
    round_gaussians,
    scene_of,
    training_view,
)

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.warping import SourceImage
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_vector
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.scenes.driving_scene import ActorTrack

SECOND_NS = 1_000_000_000
WALL_X_M = 12.0
NUM_VIEWS = 5
SKY_RGB = torch.tensor([0.5, 0.7, 0.9])


@dataclass
class Board:
    """An upright board at a world x, between two y and below a height; texture moves with it."""

    x_m: float
    left_m: float = 1e3
    right_m: float = -1e3
    top_m: float = 1e3
    tint: float = 0.0

    def colour(self, y_m: torch.Tensor, z_m: torch.Tensor) -> torch.Tensor:
        y_m = y_m - (self.left_m if self.left_m < 1e3 else 0)
        waves = [torch.sin(1.1 * y_m + 0.3 * z_m), torch.cos(0.9 * z_m), torch.sin(y_m - z_m)]
        return 0.5 + 0.3 * torch.stack(waves, dim=-1) + self.tint


def make_camera(
    x_m=0.0, y_m=0.0, z_m=1.5, *, yaw_rad=0.0, width_px=64, height_px=48, focal_px=60.0
):
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, yaw_rad], dtype=torch.float64))
    place = torch.tensor([x_m, y_m, z_m], dtype=torch.float64)
    pose = rigid_from_rotation(turn @ LOOK_FORWARD.double(), place)
    return Camera.centred(pose, focal_px, width_px=width_px, height_px=height_px)


def draw_boards(camera, boards):
    """Exact image and depth at pixel centres; sky is a function of direction alone."""
    rays = camera.pixel_directions().double() @ camera.world_from_camera[:3, :3].T
    centre = camera.centre_world
    rgb = SKY_RGB + 0.05 * torch.sin(3 * rays[..., 1:2] / rays[..., 0:1])
    depth_m = torch.full(rgb.shape[:2], torch.inf, dtype=torch.float64)
    for board in boards:
        steps = (board.x_m - centre[0]) / rays[..., 0]  # camera z, as directions have z = 1
        hit = centre + steps[..., None] * rays
        y_m, z_m = hit[..., 1], hit[..., 2]
        seen = (steps > 0) & (steps < depth_m) & (y_m < board.left_m) & (y_m > board.right_m)
        seen &= z_m < board.top_m
        rgb = torch.where(seen[..., None], board.colour(y_m, z_m), rgb)
        depth_m = torch.where(seen, steps, depth_m)
    return rgb.float(), depth_m.nan_to_num(posinf=0.0).float()


@pytest.fixture
def camera_at() -> Callable[..., Camera]:
    return make_camera


@pytest.fixture
def board() -> type[Board]:
    return Board


@pytest.fixture
def draw() -> Callable[..., tuple[torch.Tensor, torch.Tensor]]:
    return draw_boards


@pytest.fixture
def source_of() -> Callable[..., SourceImage]:
    def make(camera, boards, *, timestamp_ns=0, frame=0):
        rgb, depth_m = draw_boards(camera, boards)
        return SourceImage(
            key=(frame, "front"),
            camera=camera,
            timestamp_ns=timestamp_ns,
            rgb=rgb,
            depth_m=depth_m,
            alpha=(depth_m > 0).float(),
        )

    return make


@pytest.fixture
def moving_track() -> Callable[..., ActorTrack]:
    def make(starts_m, ends_m, *, size_m=(4.0, 2.0, 2.0), duration_ns=SECOND_NS, actor_id="car"):
        poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        poses[:, :3, 3] = torch.tensor([starts_m, ends_m], dtype=torch.float64)
        return replace(
            car_track(2),
            actor_id=actor_id,
            size_m=torch.tensor(size_m),
            frame_indices=torch.tensor([0, 10]),
            timestamps_ns=torch.tensor([0, duration_ns]),
            world_from_box=poses,
            num_points=torch.tensor([100, 100]),
        )

    return make


def wall_points():
    y_m, z_m = torch.meshgrid(
        torch.arange(-14, 14, 0.25), torch.arange(-12, 4.0, 0.25), indexing="ij"
    )
    return torch.stack([torch.full_like(y_m, WALL_X_M), y_m, z_m], dim=-1).reshape(-1, 3)


@pytest.fixture
def views(camera_at, board, draw):
    found = []
    for frame in range(NUM_VIEWS):
        camera = camera_at(0.4 * frame)
        rgb, depth_m = draw(camera, [board(WALL_X_M, top_m=4.0)])
        rgb_u8 = (rgb * 255).round().to(torch.uint8)
        shown = {"rgb_u8": rgb_u8, "sky_mask": depth_m == 0, "lidar_depth_m": depth_m}
        found.append(training_view(camera, frame=frame, key=(2 * frame, "front"), **shown))
    return found


@pytest.fixture
def scene(views, board):
    """A wall of opaque discs in the board's colours under a plain sky."""
    points = wall_points()
    count, rgb = len(points), board(WALL_X_M).colour(points[:, 1], points[:, 2])
    discs = replace(
        round_gaussians(points, rgb, sigma_m=0.2, sh_degree=0),
        log_scale=torch.tensor([0.01, 0.2, 0.2]).log().repeat(count, 1),
        opacity_logit=torch.full((count,), 4.0),
    )
    cameras = [view.camera for view in views]
    times_ns = torch.tensor([view.timestamp_ns for view in views])
    made = scene_of(discs, cameras, sky_rgb=SKY_RGB, timestamps_ns=times_ns)
    return replace(made, cameras=cameras_of(views))


@pytest.fixture
def lidar_map(board):
    points = wall_points()[::2]
    street = map_points(points, board(WALL_X_M).colour(points[:, 1], points[:, 2]))
    taken_ns = torch.full((len(points),), 200_000_000)
    return LidarMap(street=replace(street, timestamp_ns=taken_ns), actors={})


@pytest.fixture
def builder(scene, lidar_map, views):
    return ConditionBuilder(scene, lidar_map, views)
