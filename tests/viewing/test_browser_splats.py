"""What the browser is given of a scene is what our own renderer draws, as far as it can be."""

import torch
from gaussian_world import build_world, camera_at, round_gaussians, scene_of

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.viewing.scene_nodes import recorded_rgb, sky_panels, splats_by_body

AHEAD_M = torch.tensor([[8.0, 0.0, 1.0]])
GREY = torch.full((1, 3), 0.5)


def coloured_by_direction(gaussians: GaussianSet) -> GaussianSet:
    """Redder to whoever looks along x, bluer from elsewhere."""
    gaussians.sh_rest[:, 2] = torch.tensor([-0.4, 0.1, 0.3])
    return gaussians


def test_a_gaussian_has_the_colour_in_which_the_recorded_camera_sees_it():
    gaussians = coloured_by_direction(round_gaussians(AHEAD_M, GREY, sigma_m=1.0, opacity=0.99))
    camera = camera_at(0.0)
    scene = scene_of(gaussians, [camera])
    found = recorded_rgb(scene, [(camera, 0)])[0]
    drawn = scene.render(camera, 0)
    row, column = (drawn.alpha == drawn.alpha.max()).nonzero()[0].tolist()
    sky = (1 - drawn.alpha[row, column]) * torch.tensor([0.6, 0.7, 0.9])
    assert torch.allclose(found, (drawn.rgb[row, column] - sky) / drawn.alpha.max(), atol=2e-3)
    assert not torch.allclose(found, GREY[0], atol=0.1)


def test_a_gaussian_that_no_camera_sees_keeps_its_constant_colour():
    gaussians = coloured_by_direction(round_gaussians(-AHEAD_M, GREY, sigma_m=1.0))
    camera = camera_at(0.0)
    assert torch.equal(recorded_rgb(scene_of(gaussians, [camera]), [(camera, 0)]), GREY)


def test_bodies_are_parted_and_what_is_too_faint_is_left_out():
    world = build_world()
    gaussians = world.scene.gaussians
    gaussians.opacity_logit[:5] = -10.0
    rgb = torch.rand(len(gaussians), 3, generator=torch.Generator().manual_seed(0))
    parts = splats_by_body(gaussians, rgb)
    assert {body: len(part.centres) for body, part in parts.items()} == {0: 40 * 24 - 5, 1: 120}
    assert torch.equal(parts[0].centres, gaussians.means[5 : 40 * 24])
    assert torch.equal(parts[1].rgb, rgb[40 * 24 :])


def test_a_covariance_is_long_where_the_gaussian_is():
    turned = round_gaussians(AHEAD_M, GREY, sigma_m=0.1)
    turned.log_scale[0, 0] = torch.tensor(2.0).log()
    turned.rotation_wxyz[0] = torch.tensor([0.9, 0.1, -0.3, 0.2])
    (splats,) = splats_by_body(turned, GREY).values()
    values, vectors = torch.linalg.eigh(splats.covariances[0])
    assert torch.allclose(values, torch.tensor([0.01, 0.01, 4.0]), atol=1e-5)
    long_axis = rotation_from_quaternion(turned.rotation_wxyz)[0, :, 0]
    assert abs(float(vectors[:, 2] @ long_axis)) > 0.9999


def test_every_side_of_the_sky_shows_the_texture_in_its_direction():
    camera = camera_at(0.0)
    scene = scene_of(round_gaussians(AHEAD_M, GREY, sigma_m=1.0), [camera])
    rows, columns = scene.sky.weight.shape
    scene.sky.rgb[..., 0] = torch.linspace(0, 1, columns)[None]
    scene.sky.rgb[..., 1] = torch.linspace(1, 0, rows)[:, None]
    front = next(panel for panel in sky_panels(scene.sky) if panel.name == "front")
    middle = front.rgb.shape[0] // 2
    ahead = scene.sky.sample(scene.sky.rays(camera))
    own = ahead[int(camera.cy_px), int(camera.cx_px)]
    assert torch.allclose(front.rgb[middle, middle], own, atol=0.03)  # a texel or two
    assert front.rgb[middle, middle + 9, 0] > front.rgb[middle, middle - 9, 0]
    assert front.rgb[middle - 9, middle, 1] > front.rgb[middle, middle, 1]
