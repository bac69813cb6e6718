import math

import pytest
import torch
from gaussian_world import camera_at

from lidarpainter_models.gaussians.fitting.pixel_terms import composed
from lidarpainter_models.gaussians.model.sky import (
    SkyConfig,
    SkyTexture,
    adam_reference,
    push_pull,
    seen_as_sky,
    sky_from_images,
    sky_layout,
)
from lidarpainter_models.gaussians.model.sky_sampling import (
    SkyLayout,
    locate,
    sample_reference,
    sample_sky,
    scatter_gradient,
    scatter_reference,
    sky_rays,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_vector
from lidarpainter_models.kernels.gaussian_raster import SplatImage


def full_turn(columns=64, rows=16):
    return SkyLayout(
        azimuth_left_rad=math.pi,
        elevation_top_rad=math.pi / 2,
        texel_rad=2 * math.pi / columns,
        columns=columns,
        rows=rows,
    )


def turned_camera(yaw_rad):
    base = camera_at(0.0)
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, yaw_rad]).double())
    return base.at(
        rigid_from_rotation(turn @ base.world_from_camera[:3, :3], torch.zeros(3).double())
    )


def random_texture(layout, seed=0):
    return torch.rand(layout.rows, layout.columns, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, 3.1, -2.5])
def test_fast_sampling_agrees_with_plain_torch(yaw_rad):
    layout, camera = full_turn(), turned_camera(yaw_rad)
    texture = random_texture(layout)
    expected = sample_reference(texture, camera, layout)
    actual = sample_sky(texture, sky_rays(camera, layout), layout)
    # the arc tangent polynomial is good to 2e-6 rad, a texel is 0.1 rad
    assert torch.allclose(actual, expected, atol=2e-4)


def test_fast_scatter_is_the_transpose_of_sampling():
    layout, camera = full_turn(), turned_camera(0.4)
    gradient = torch.randn(camera.height_px, camera.width_px, 3)
    weight = (torch.rand(camera.height_px, camera.width_px) > 0.5).float()
    rays = sky_rays(camera, layout)
    fast, fast_weight = scatter_gradient(gradient, weight, rays, layout)
    plain, plain_weight = scatter_reference(gradient, weight, rays, layout)
    assert torch.allclose(fast, plain, atol=1e-4)
    assert torch.allclose(fast_weight, plain_weight, atol=1e-4)
    texture = random_texture(layout).requires_grad_(True)
    (sample_reference(texture, camera, layout) * gradient * weight[..., None]).sum().backward()
    assert torch.allclose(fast, texture.grad, atol=2e-3)


def test_fast_adam_agrees_with_plain_torch():
    layout = full_turn()
    first = SkyTexture.constant(layout, torch.full((3,), 0.5))
    second = first.clone()
    camera = turned_camera(0.0)
    rays = sky_rays(camera, layout)
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        gradient = torch.randn(camera.height_px, camera.width_px, 3, generator=generator)
        weight = torch.rand(camera.height_px, camera.width_px, generator=generator)
        first.observe(gradient, weight, rays, 0.01)
        texel_gradient, texel_weight = scatter_gradient(gradient, weight, rays, layout)
        adam_reference(second, texel_gradient, texel_weight, 0.01)
    assert torch.allclose(first.rgb, second.rgb, atol=1e-5)


def test_left_of_the_image_is_left_in_the_texture():
    layout = full_turn()
    places = locate(turned_camera(0.0), layout)
    assert bool((places[:, 1:, 0] > places[:, :-1, 0]).all())
    assert bool((places[1:, :, 1] > places[:-1, :, 1]).all())


def test_looking_back_meets_no_seam():
    layout, camera = full_turn(), turned_camera(math.pi)
    columns = torch.arange(layout.columns).float()
    smooth = (2 * math.pi * (columns + 0.5) / layout.columns).cos()[None, :, None] * 0.5 + 0.5
    texture = smooth.expand(layout.rows, layout.columns, 3).contiguous()
    row = sample_sky(texture, sky_rays(camera, layout), layout)[20, :, 0]
    assert float((row[1:] - row[:-1]).abs().max()) < 0.02


def test_crop_holds_every_ray_of_its_cameras():
    cameras = [camera_at(0.0), camera_at(2.0)]
    layout = sky_layout(cameras, SkyConfig())
    assert not layout.wraps
    places = locate(cameras[0], layout)
    assert float(places[..., 0].min()) > 0
    assert float(places[..., 0].max()) < layout.columns
    assert float(places[..., 1].min()) > 0


def test_cameras_all_round_get_the_whole_turn():
    cameras = [turned_camera(yaw) for yaw in (0.0, 1.5, 3.0, -1.5)]
    assert sky_layout(cameras, SkyConfig()).wraps


def test_opaque_pixels_send_no_gradient_to_the_sky():
    alpha = torch.tensor([[0.0, 0.5, 0.79, 0.81, 1.0]])
    sky_rgb = torch.rand(1, 5, 3, requires_grad=True)
    splat = SplatImage(
        rgb=torch.zeros(1, 5, 3),
        depth_m=torch.zeros(1, 5),
        alpha=alpha,
        features=torch.zeros(1, 5, 0),
        visible=torch.zeros(0, dtype=torch.bool),
        radius_px=torch.zeros(0),
    )
    composed(splat, sky_rgb, 0.2).sum().backward()
    expected = torch.tensor([[1.0, 0.5, 0.21, 0.0, 0.0]])
    assert torch.allclose(sky_rgb.grad, expected[..., None].expand(1, 5, 3), atol=1e-6)


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
    layout = sky_layout([camera], SkyConfig())
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
    layout = sky_layout([camera], SkyConfig())
    assert layout.rows >= 2
    assert layout.columns >= 2


def test_a_direction_is_sky_for_all_views_if_it_is_for_one():
    ahead, turned = turned_camera(0.0), turned_camera(0.2)
    layout = sky_layout([ahead, turned], SkyConfig())
    mask = torch.zeros(ahead.height_px, ahead.width_px, dtype=torch.bool)
    mask[:20] = True
    nothing = torch.zeros_like(mask)
    own, other = seen_as_sky(layout, [ahead, turned], [mask, nothing])
    assert bool(own[mask].all())
    assert not bool(own[22:].any())
    # turned to the left, the view shares its right part with the other's left part
    assert bool(other[:18, ahead.width_px // 2 :].all())
    assert not bool(other[:, 0].any())
    assert not bool(other[30:].any())
