"""Every pixel knows whose it is."""

import pytest
import torch
from gaussian_world import FRAME_NS, camera_at, car_track, round_gaussians, scene_of

from lidarpainter_models.gaussians.model import instance_images
from lidarpainter_models.gaussians.model.instance_images import SKY, STREET, instance_image


def world_of_cars(num_cars):
    """Cars side by side on a dark ground, each a ball; the second to last is not there yet."""
    ground = torch.cartesian_prod(torch.arange(1.5, 12.0, 0.4), torch.arange(-6.0, 6.0, 0.4))
    ground = torch.cat([ground, torch.zeros(len(ground), 1)], dim=1)
    gaussians = round_gaussians(ground, torch.full((len(ground), 3), 0.2), sigma_m=0.2)
    tracks = []
    for car in range(num_cars):
        track = car_track(2)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.tensor([6.0, car - (num_cars - 1) / 2, 1.0])
        track.world_from_box[:] = pose
        if car == num_cars - 2:
            track.timestamps_ns[:] = torch.tensor([50, 51]) * FRAME_NS
        tracks.append(track)
        ball = round_gaussians(
            torch.zeros(20, 3), torch.ones(20, 3), sigma_m=0.12, body=car + 1, opacity=0.9
        )
        gaussians = gaussians.append(ball)
    return scene_of(gaussians, [camera_at(0.0), camera_at(0.1)], tracks)


@pytest.mark.parametrize("together", [1, 3, 16])
def test_cars_are_told_apart_from_street_and_sky(monkeypatch, together):
    monkeypatch.setattr(instance_images, "_NUM_TOGETHER", together)
    scene = world_of_cars(4)
    camera = camera_at(0.0)
    who = instance_image(scene, camera, 0)
    assert set(who.unique().tolist()) == {STREET, 1, 2, 4, SKY}
    for car in (1, 2, 4):
        centre = scene.tracks[car - 1].world_from_box[0, :3, 3]
        pixels, _ = camera.project(centre[None])
        column, row = pixels[0].long().tolist()
        assert int(who[row, column]) == car
    assert int(who[0, 0]) == SKY
    assert int(who[-1, camera.width_px // 2]) == STREET


def test_a_log_without_actors_has_street_and_sky():
    assert set(instance_image(world_of_cars(0), camera_at(0.0), 0).unique().tolist()) == {
        STREET,
        SKY,
    }
