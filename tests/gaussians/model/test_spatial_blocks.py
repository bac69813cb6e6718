"""What is left out by blocks is what the rasteriser would have left out."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, camera_at, car_track, round_gaussians, scene_of

from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.fitting.state import most_sigmas
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.drawing import camera_from_body, draw_gaussians
from lidarpainter_models.gaussians.model.spatial_blocks import SpatialBlocks
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.kernels.sparse_adam import MOST_UNITS

RATES = LearningRates()
REACH_SIGMAS = most_sigmas(RATES)


def scattered(count, seed):
    """Specks and giants all around the cameras, some of them in a car."""
    generator = torch.Generator().manual_seed(seed)
    means = 40.0 * torch.randn(count, 3, generator=generator)
    gaussians = round_gaussians(means, torch.rand(count, 3, generator=generator), sigma_m=0.1)
    gaussians.log_scale += 1.3 * torch.randn(count, 3, generator=generator)
    gaussians.rotation_wxyz.copy_(torch.randn(count, 4, generator=generator))
    gaussians.body_index[: count // 10] = 1
    gaussians.means[: count // 10] *= 0.02
    return gaussians


def view_at(scene, seed):
    """A camera that looks anywhere, and the bodies at the first frame."""
    twist = torch.randn(6, generator=torch.Generator().manual_seed(seed)).double()
    camera = camera_at(0.0)
    camera = camera.at(camera.world_from_camera @ rigid_from_tangent(twist))
    bodies = camera_from_body(camera.world_from_camera, *scene.actors.refined_poses(0))
    return camera, bodies


@pytest.mark.parametrize("seed", range(8))
def test_every_gaussian_that_is_drawn_is_in_view(seed):
    scene = scene_of(scattered(2000, seed), [camera_at(0.0)], [car_track(2)])
    blocks = SpatialBlocks.of(scene.gaussians, REACH_SIGMAS)
    camera, bodies = view_at(scene, seed)
    drawn = draw_gaussians(scene.gaussians, bodies, camera).visible
    is_in_view = blocks.in_view([(camera, bodies)])
    assert bool((is_in_view | ~drawn).all())
    assert int(is_in_view.sum()) < 0.8 * 2000


@pytest.mark.parametrize("seed", range(4))
def test_bounds_hold_what_momentum_can_do(seed):
    """The farthest that any row can drift and grow, towards the camera."""
    scene = scene_of(scattered(2000, seed), [camera_at(0.0)])
    scene.gaussians.body_index.zero_()
    blocks = SpatialBlocks.of(scene.gaussians, REACH_SIGMAS)
    camera, bodies = view_at(scene, seed)
    is_in_view = blocks.in_view([(camera, bodies)])
    ahead = camera.world_from_camera[:3, :3].float() @ torch.tensor([0.0, 0.0, 10.0])
    towards = camera.centre_world.float() + ahead - scene.gaussians.means
    largest = scene.gaussians.log_scale.amax(dim=1, keepdim=True).exp()
    unit = towards / towards.norm(dim=1, keepdim=True)
    drift_m = MOST_UNITS * max(RATES.means) * largest * unit
    scene.gaussians.means += torch.minimum(drift_m.abs(), towards.abs()) * drift_m.sign()
    scene.gaussians.log_scale += MOST_UNITS * max(RATES.log_scale)
    scene.gaussians.opacity_logit += 100.0
    assert bool((is_in_view | ~draw_gaussians(scene.gaussians, bodies, camera).visible).all())


def test_most_units_bound_what_moments_can_still_do():
    """The worst gradients that Cauchy and Schwarz allow come close to the bound."""
    first = second = 0.0
    for step in range(400):
        gradient = (0.9 / 0.99) ** (399 - step)
        first, second = 0.9 * first + 0.1 * gradient, 0.99 * second + 0.01 * gradient**2
    moved = sum(first * 0.9**k / (second * 0.99**k) ** 0.5 for k in range(1, 400))
    assert 0.99 * MOST_UNITS < moved <= MOST_UNITS * (1 + 1e-9)


def test_several_views_see_the_union():
    scene = scene_of(scattered(2000, 3), [camera_at(0.0)], [car_track(2)])
    blocks = SpatialBlocks.of(scene.gaussians, REACH_SIGMAS)
    views = [view_at(scene, seed) for seed in (1, 2)]
    both = blocks.in_view(views[:1]) | blocks.in_view(views[1:])
    assert torch.equal(blocks.in_view(views), both)


def test_moved_gaussian_is_found_after_a_refresh():
    gaussians = round_gaussians(torch.tensor([[-30.0, 0.0, 1.0]]), torch.rand(1, 3), sigma_m=0.1)
    scene = scene_of(gaussians, [camera_at(0.0)])
    blocks = SpatialBlocks.of(scene.gaussians, REACH_SIGMAS)
    view = (
        camera_at(0.0),
        camera_from_body(camera_at(0.0).world_from_camera, *scene.actors.refined_poses(0)),
    )
    assert blocks.in_view([view]).tolist() == [False]
    gaussians.means[0, 0] = 30.0
    blocks.refresh(gaussians, torch.tensor([0]))
    assert blocks.in_view([view]).tolist() == [True]


def test_gaussians_that_are_not_finite_spoil_no_block():
    gaussians = scattered(200, 5)
    gaussians.means[3], gaussians.log_scale[4] = torch.nan, torch.inf
    gaussians.means[5] = torch.inf
    scene = scene_of(gaussians, [camera_at(0.0)], [car_track(2)])
    blocks = SpatialBlocks.of(gaussians, REACH_SIGMAS)
    view = view_at(scene, 1)
    camera, bodies = view
    drawn = draw_gaussians(scene.gaussians, bodies, camera).visible
    assert bool((blocks.in_view([view]) | ~drawn).all())


def test_absent_actor_is_out_of_view():
    scene = scene_of(scattered(500, 6), [camera_at(0.0)], [car_track(2)])
    camera = camera_at(0.0)
    poses, present = scene.actors.refined_poses(0)
    bodies = camera_from_body(camera.world_from_camera, poses, torch.zeros_like(present))
    is_in_view = SpatialBlocks.of(scene.gaussians, REACH_SIGMAS).in_view([(camera, bodies)])
    assert bool((scene.gaussians.body_index[is_in_view] == 0).all())


def test_slack_takes_in_an_actor_that_may_move_into_view():
    scene = scene_of(scattered(500, 7), [camera_at(0.0)], [car_track(2)])
    blocks, camera = SpatialBlocks.of(scene.gaussians, REACH_SIGMAS), camera_at(0.0)
    poses, present = scene.actors.refined_poses(0)
    poses[0, 1, 3] = 40.0  # far to the left
    view = (camera, camera_from_body(camera.world_from_camera, poses, present))
    of_actor = [
        int((scene.gaussians.body_index[blocks.in_view([view], actor_slack_m=slack_m)] > 0).sum())
        for slack_m in (0.0, 40.0)
    ]
    assert of_actor == [0, 50]


def same_image(one, other):
    return all(torch.equal(getattr(one, name), value) for name, value in vars(other).items())


@pytest.mark.parametrize("across_s", [(0.0, 0.0), (0.0, 0.03), (0.02, 0.0)])
@pytest.mark.parametrize("seed", range(4))
def test_a_view_is_drawn_from_what_it_can_show_alone(across_s, seed):
    scene = scene_of(scattered(2000, seed), [camera_at(0.0)], [car_track(3)])
    twist = torch.tensor([0.02, 0.3, -0.1, 0.5, 0.0, 15.0], dtype=torch.float64)
    shutter = Shutter(across_s=across_s, twist_per_s=twist)
    camera = replace(view_at(scene, seed)[0], shutter=shutter)
    of_a_fit = scene.with_gaussians(scene.gaussians.as_leaves())
    assert same_image(scene.render(camera, FRAME_NS), of_a_fit.render(camera, FRAME_NS))
    assert len(scene.drawable(camera, FRAME_NS).rows) < 0.8 * 2000
    assert len(of_a_fit.drawable(camera, FRAME_NS).rows) == 2000


def test_limbs_that_reach_into_a_view_are_drawn():
    scene = scene_of(scattered(500, 7), [camera_at(0.0)])
    track = car_track(2)
    poses = track.world_from_box.clone()
    poses[:, 1, 3] = 15.0  # to the left of all that the camera sees
    tracks = [replace(track, world_from_box=poses)]
    times_ns = torch.arange(2) * FRAME_NS
    scene = replace(scene, actors=Actors.uncorrected(tracks, times_ns, bent=[0]))
    assert float(scene.render(camera_at(0.0), 0).actor_alpha.max()) == 0
    scene.actors.bending.offset_m[..., 0] = -12.0  # along the car: to the right
    bent = scene.render(camera_at(0.0), 0)
    assert float(bent.actor_alpha.max()) > 0
    of_a_fit = scene.with_gaussians(scene.gaussians.as_leaves())
    assert same_image(bent, of_a_fit.render(camera_at(0.0), 0))
