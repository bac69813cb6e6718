import torch
from gaussian_world import camera_at, car_track, round_gaussians, scene_of

from lidarpainter_models.gaussians.fitting.shape_limits import (
    LEAST_SIGMA_M,
    MOST_ELONGATION,
    MOST_SIGMA,
    limit_shapes,
    viewing_rays,
)


def limited(scales_m, *, x_m=10.0, num_cameras=2, step_m=0.1):
    gaussian = round_gaussians(torch.tensor([[x_m, 0.0, 1.0]]), torch.rand(1, 3), sigma_m=1.0)
    gaussian.log_scale[0] = torch.tensor(scales_m).log()
    scene = scene_of(gaussian, [camera_at(step_m * frame) for frame in range(num_cameras)])
    limit_shapes(scene.gaussians, viewing_rays(scene))
    return scene.gaussians.scale_m[0].tolist()


def test_needle_along_the_ray_is_shortened():
    # cameras look along x, so the first axis lies along the ray
    found = limited([0.5, 0.05, 0.02])
    assert abs(found[0] - 0.1) < 1e-6
    assert abs(found[1] - 0.05) < 1e-6


def test_needle_across_the_ray_may_be_longer():
    found = limited([0.02, 0.9, 0.05])
    assert abs(found[1] - MOST_ELONGATION * 0.05) < 1e-6


def test_rays_from_all_sides_pin_the_depth_themselves():
    # seen from 1 m and from 9 m away and beside: the rays differ by much
    found = limited([0.3, 0.05, 0.02], x_m=9.0, num_cameras=3, step_m=4.0)
    assert abs(found[0] - 0.1) < 1e-6
    aside = round_gaussians(torch.tensor([[9.0, 3.0, 1.0]]), torch.rand(1, 3), sigma_m=1.0)
    aside.log_scale[0] = torch.tensor([0.3, 0.05, 0.02]).log()
    scene = scene_of(aside, [camera_at(x) for x in (0.0, 4.0, 8.0)])
    limit_shapes(scene.gaussians, viewing_rays(scene))
    assert float(scene.gaussians.scale_m[0, 0]) > 0.29


def test_film_is_thickened_and_giant_shrunk():
    found = limited([2.0, 2.0, 1e-5])
    assert abs(found[2] - LEAST_SIGMA_M) < 1e-6
    assert max(found) < 10.0 * MOST_SIGMA + 1e-4


def test_rays_of_an_actor_are_taken_in_its_box_frame():
    gaussian = round_gaussians(torch.zeros(1, 3), torch.rand(1, 3), sigma_m=0.1, body=1)
    scene = scene_of(gaussian, [camera_at(0.0), camera_at(0.1)], [car_track(2)])
    rays = viewing_rays(scene)
    # the car drives to the left, so the camera sees it from its left side: along its -y
    direction = rays.mean_direction[0] / rays.mean_direction[0].norm()
    assert float(direction[1]) < -0.9
    assert abs(float(rays.distance_m[0]) - 6.0) < 0.5


def test_every_camera_of_a_rig_is_asked_what_it_saw():
    # five look ahead and one back, in turn; the Gaussian lies six metres behind
    ahead = camera_at(0.0)
    turned = ahead.world_from_camera.clone()
    turned[:2, :3] *= -1  # half a turn about z
    rig = [*5 * [ahead], ahead.at(turned)]
    behind = round_gaussians(torch.tensor([[-6.0, 0.0, 1.0]]), torch.rand(1, 3), sigma_m=1.0)
    rays = viewing_rays(scene_of(behind, 14 * rig))
    assert abs(float(rays.distance_m) - 6.0) < 0.3
    assert float(rays.mean_direction[0, 0]) < -0.9
