import pytest
import torch
from gaussian_world import camera_at, turned_camera

from lidarpainter_models.gaussians.model.sky import (
    SkyTexture,
    push_pull,
    seen_as_sky,
    sky_from_images,
    sky_layout,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_vector
from lidarpainter_models.kernels.sky_texture import scatter_gradient, sky_rays, step_texels


def test_crop_holds_every_ray_of_its_cameras():
    cameras = [camera_at(0.0), camera_at(2.0)]
    layout = sky_layout(cameras)
    assert not layout.wraps
    places = sky_rays(cameras[0], layout).places
    assert float(places[..., 0].min()) > 0
    assert float(places[..., 0].max()) < layout.columns
    assert float(places[..., 1].min()) > 0


def test_cameras_all_round_get_the_whole_turn():
    cameras = [turned_camera(yaw) for yaw in (0.0, 1.5, 3.0, -1.5)]
    assert sky_layout(cameras).wraps


def test_unseen_texels_are_filled_from_seen_ones():
    rgb = torch.zeros(9, 13, 3)
    known = torch.zeros(9, 13)
    rgb[:, :5] = torch.tensor([0.2, 0.4, 0.6])
    rgb[:, 5:] = 99.0
    known[:, :5] = 1.0
    filled = push_pull(rgb, known)
    assert torch.allclose(filled, torch.tensor([0.2, 0.4, 0.6]).expand(9, 13, 3), atol=1e-5)


def test_sky_of_images_shows_their_colours():
    camera = camera_at(0.0)
    layout = sky_layout([camera])
    image = torch.full((camera.height_px, camera.width_px, 3), 0.25)
    mask = torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
    mask[:20] = True
    sky = sky_from_images(layout, [camera], [image], [mask])
    assert torch.allclose(sky.rgb, torch.full_like(sky.rgb, 0.25), atol=1e-4)
    nothing = sky_from_images(layout, [camera], [image], [torch.zeros_like(mask)])
    assert bool(nothing.rgb.isfinite().all())


def test_camera_below_the_horizon_gets_a_small_texture():
    down = camera_at(0.0)
    tilt = rotation_from_vector(torch.tensor([0.0, 1.2, 0.0]).double())
    pose = rigid_from_rotation(tilt @ down.world_from_camera[:3, :3], torch.zeros(3).double())
    camera: Camera = down.at(pose)
    layout = sky_layout([camera])
    assert layout.rows >= 2
    assert layout.columns >= 2


def test_a_direction_is_sky_for_all_views_if_it_is_for_one():
    ahead, turned = turned_camera(0.0), turned_camera(0.2)
    layout = sky_layout([ahead, turned])
    mask = torch.zeros(ahead.height_px, ahead.width_px, dtype=torch.bool)
    mask[:20] = True
    nothing = torch.zeros_like(mask)
    asked = torch.ones_like(mask)
    asked[:, -1] = False
    own, other = seen_as_sky(layout, [ahead, turned], [mask, nothing], [asked, asked])
    assert bool(own[mask & asked].all())
    assert not bool(other[:, -1].any())
    assert not bool(own[22:].any())
    # turned to the left, the view shares its right part with the other's left part
    assert bool(other[:18, ahead.width_px // 2 : -1].all())
    assert not bool(other[:, 0].any())
    assert not bool(other[30:].any())


@pytest.mark.parametrize("yaw_rad", [0.0, 1.5, 3.1])
def test_a_camera_moves_the_texels_it_sees_as_if_all_were_looked_at(yaw_rad):
    layout = sky_layout([turned_camera(yaw) for yaw in (0.0, 1.5, 3.1, -1.5)])
    assert layout.wraps
    camera = turned_camera(yaw_rad)
    generator = torch.Generator().manual_seed(1)
    size = (camera.height_px, camera.width_px)
    gradient = torch.randn(*size, 3, generator=generator)
    clear = torch.rand(size, generator=generator) * (torch.arange(size[0]) < 20)[:, None]
    rays = sky_rays(camera, layout, clear > 0)
    found, whole = (SkyTexture.constant(layout, torch.full((3,), 0.5)) for _ in range(2))
    for _ in range(3):
        found.observe(gradient, clear, rays, 0.01)
        texel_gradient, texel_weight = scatter_gradient(gradient, clear, rays, layout)
        whole.weight.add_(texel_weight)
        step_texels(whole.rgb, whole.moments, texel_gradient, texel_weight, 0.01)
    assert bool((whole.weight > 0).any())
    assert torch.equal(found.rgb, whole.rgb)
    assert torch.equal(found.weight, whole.weight)
    assert torch.equal(found.moments.visits, whole.moments.visits)
    found.observe(gradient, torch.zeros(size), rays, 0.01)
    assert torch.equal(found.rgb, whole.rgb)
