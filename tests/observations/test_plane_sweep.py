import torch
from wall_images import image_of_wall, sideways_cameras

from lidarpainter_models.observations.plane_sweep import (
    choose_depth,
    depth_between,
    sweep_cost,
    sweep_depths,
)


def test_sweep_finds_the_depth_of_a_wall():
    cameras = sideways_cameras()
    images = [image_of_wall(camera, 10.0) for camera in cameras]
    depths_m = sweep_depths(4.0, 100.0, 25)
    others = list(zip(cameras[1:], images[1:], strict=True))
    cost = sweep_cost(cameras[0], images[0], others, depths_m)
    unknown = torch.full(images[0].shape[:2], 100.0)
    found = choose_depth(cost, depths_m, unknown, prior=0.0)[16:-16, 16:-32]
    step = 1 / depths_m[0] - 1 / depths_m[1]
    assert float(((1 / found - 1 / 10.0).abs() < 0.25 * step).float().mean()) > 0.9


def test_without_texture_the_surroundings_decide():
    cameras = sideways_cameras()
    plain = torch.full((64, 96, 3), 0.5)
    depths_m = sweep_depths(4.0, 100.0, 25)
    cost = sweep_cost(cameras[0], plain, [(cameras[1], plain)], depths_m)
    expected_m = torch.full((64, 96), 20.0)
    found = choose_depth(cost, depths_m, expected_m, prior=0.03)[20:-20, 30:-30]
    assert float((found - 20.0).abs().max()) < 3.0


def test_what_is_farther_than_all_depths_stays_at_the_last():
    depths_m = sweep_depths(4.0, 100.0, 25)
    cost = torch.linspace(1, 0, 25)[:, None, None].expand(25, 3, 3)
    assert torch.equal(depth_between(cost, cost.argmin(dim=0), depths_m), depths_m[-1].expand(3, 3))
