from dataclasses import replace

import torch
from gaussian_world import FRAME_NS, camera_at, car_track, round_gaussians, scene_of, training_view
from wall_images import image_of_wall, sideways_cameras

from lidarpainter_models.gaussians.initialisation import unreached
from lidarpainter_models.gaussians.initialisation.unreached import (
    FARTHEST_M,
    depth_from_below,
    unreached_gaussians,
)
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Shutter


def test_depth_goes_straight_up_over_gaps():
    depth_m = torch.tensor([[0.0, 0.0], [0.0, 7.0], [5.0, 0.0], [0.0, 0.0]])
    filled = depth_from_below(depth_m)
    assert filled.tolist() == [[5.0, 7.0], [5.0, 7.0], [5.0, FARTHEST_M], [FARTHEST_M, FARTHEST_M]]


def test_actors_are_where_they_were_when_a_late_image_was_taken():
    camera = camera_at(0.0)
    late = replace(camera, shutter=Shutter(late_s=FRAME_NS / 1e9, twist_per_s=torch.zeros(6)))
    nothing = GaussianSet.empty(sh_degree=1)
    scene = scene_of(nothing, [camera] * 4, [car_track(4)])
    of_late, before, then = (
        unreached._moving(scene, training_view(camera, frame=frame))
        for camera, frame in ((late, 1), (camera, 1), (camera, 2))
    )
    assert then.any()
    assert not torch.equal(before, then)
    assert torch.equal(of_late, then)


def views_of_wall(cameras):
    return [
        training_view(
            camera, frame=frame, rgb_u8=(image_of_wall(camera, 10.0) * 255).to(torch.uint8)
        )
        for frame, camera in enumerate(cameras)
    ]


def test_places_without_lidar_are_filled_at_their_depth(monkeypatch):
    cameras = sideways_cameras()
    views = views_of_wall(cameras)
    scene = scene_of(GaussianSet.empty(), cameras)
    monkeypatch.setattr(unreached, "NEAREST_M", 4.0)
    monkeypatch.setattr(unreached, "FARTHEST_M", 100.0)
    monkeypatch.setattr(unreached, "VIEWS_PER_CAMERA", 3)
    seeds = unreached_gaussians(scene, views, budget=900)
    assert 200 < len(seeds) <= 900
    assert abs(float(seeds.means[:, 0].median()) - 10.0) < 1.0
    closed = scene.with_gaussians(seeds).render(cameras[1], FRAME_NS)
    assert float((closed.alpha > 0.5).float().mean()) > 0.9
    again = unreached_gaussians(scene.with_gaussians(seeds), views, budget=900)
    assert len(again) < 0.1 * len(seeds)


def test_sky_and_covered_places_ask_for_nothing():
    cameras = sideways_cameras()
    views = views_of_wall(cameras)
    sky = [replace(view, sky_mask=torch.ones(64, 96, dtype=torch.bool)) for view in views]
    scene = scene_of(GaussianSet.empty(), cameras)
    assert len(unreached_gaussians(scene, sky, budget=100)) == 0
    y, z = torch.meshgrid(torch.linspace(-9, 9, 60), torch.linspace(-5, 7, 40), indexing="ij")
    wall_m = torch.stack([torch.full_like(y, 10.0), y, z], -1).flatten(0, 1)
    wall = round_gaussians(wall_m, torch.rand(2400, 3), sigma_m=0.3)
    covered = scene_of(wall, cameras)
    assert len(unreached_gaussians(covered, views, budget=100)) == 0


def test_nothing_is_put_under_the_ground(monkeypatch):
    """A gap in the road is clear and no sky; what is seen through it would be far below."""
    camera = camera_at(0.0, width_px=96, height_px=64)
    x, y = torch.meshgrid(torch.arange(2.0, 40, 0.5), torch.arange(-12.0, 12, 0.5), indexing="ij")
    road = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)
    road = road[(road[:, 0] < 3) | (road[:, 0] > 12)]  # the gap
    gaussians = round_gaussians(road, torch.full_like(road, 0.4), sigma_m=0.3)
    cameras = [camera.at(pose) for pose in _poses_ahead(camera, 3)]
    grey = torch.full((64, 96, 3), 102, dtype=torch.uint8)
    sky_mask = torch.arange(64)[:, None].expand(64, 96) < 34
    views = [
        training_view(one, frame=frame, rgb_u8=grey, sky_mask=sky_mask)
        for frame, one in enumerate(cameras)
    ]
    scene = scene_of(gaussians, cameras)
    put = unreached_gaussians(scene, views, budget=500)
    monkeypatch.setattr(unreached, "MOST_BELOW_GROUND_M", 1e6)
    all_put = unreached_gaussians(scene, views, budget=500)
    assert float(all_put.means[:, 2].min()) < -1.5
    assert len(put) == 0 or float(put.means[:, 2].min()) > -1.2


def _poses_ahead(camera, count):
    poses = camera.world_from_camera.repeat(count, 1, 1)
    poses[:, 0, 3] += 0.3 * torch.arange(count)
    return poses
